"""Warnings that follow from thresholds alone, whatever they were measured with."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from todframes.psychometrics.curves import FitPoint
from todframes.results.data import Fit, Group, ResultWarning
from todframes.results.wording import listed, percent_below, plain
from todframes.stimulus import HEIGHT_PER_SIZE, level_of

MISSED = 2.0
"""Numerical error, in tolerances, beyond which the tolerance is missed: the error follows from eight replicates,
and has an error of 27 % itself."""

FEWEST_LEVELS_SHOWN = 3
"""Smallest number of levels that show how fast a curve rises and whether it fits."""

WIDEST_GAP = 4.0
"""Largest ratio of the two levels about a threshold; farther apart they do not show how the curve rises."""

ADDED_LEVELS = (0.7, 1.0, 1.4)
"""Levels to add, in units of the estimated threshold: between 50 and 95 % correct for curves as steep as usual."""

USUAL_SLOPE = 2.0
"""Weibull slope that a threshold outside the levels is estimated with: that of a linear observer is near it."""

SAME_LEVEL = 1.15
"""Largest ratio of a level to add and one shown that counts as the same level."""

FEW_SCENES = "an end of the 95 % interval is open because scenes differ and are few"
"""Reason for an open interval that more levels or trials on the same scenes would not close."""

SMALL = "The size is below the acuity; take larger sizes"
"""Reason why a size has a threshold contrast above 1."""

APERTURE_SDS = 2.0
"""Distance of a triangle's edges from its middle beyond which they are hardly seen, in standard deviations of the
observer's aperture."""

MOST_CONTRAST = 1000.0
"""Largest threshold contrast for which levels are advised: displays show no more."""

HELPS_FROM = 0.5
"""Proportion correct from which stronger levels will help; below it something else may be wrong."""


def above_contrast_1(
    fits: Sequence[Fit], is_easier_if_smaller: Callable[[Fit], bool], aperture_sd_deg: float | None
) -> tuple[ResultWarning, ...]:
    """Return a warning for each threshold contrast above 1, which no triangle darker than its background has.
    `is_easier_if_smaller` returns whether a smaller triangle has a lower threshold. `aperture_sd_deg` is the
    standard deviation of the observer's aperture, if it has one.
    """
    wide = f"Smaller sizes are easier: {_wider(aperture_sd_deg)}; take smaller sizes"
    return tuple(
        ResultWarning(
            code="above_contrast_1",
            group=fit.group,
            message=(
                f"the threshold contrast of {plain(fit.threshold)} is above 1: no dark triangle has such a "
                f"contrast, and a bright one has {plain(1.0 + fit.threshold)} times the luminance around it. "
                f"{wide if is_easier_if_smaller(fit) else SMALL}"
            ),
            found=fit.threshold,
            expected=1.0,
        )
        for fit in fits
        if level_of(fit.level).quantity == "contrast" and fit.threshold is not None and fit.threshold > 1.0
    )


def _wider(aperture_sd_deg: float | None) -> str:
    """Return that a triangle is too wide, with the aperture if it is known."""
    aperture = "" if aperture_sd_deg is None else f" (aperture_sd_deg = {aperture_sd_deg:g})"
    return f"the triangle is wider than what the observer looks at{aperture}"


def _is_too_wide(fit: Fit, aperture_sd_deg: float | None) -> bool:
    """Return whether levels leave a threshold open upwards, and the triangle's edges lie outside the aperture."""
    size_mrad = fit.group.get("size_mrad")
    strongest = max((point.level for point in fit.points), default=math.inf)
    is_open = fit.status == "never_reached" or (fit.threshold or 0.0) > strongest
    if aperture_sd_deg is None or not isinstance(size_mrad, float) or not is_open:
        return False
    edge_deg = math.degrees(HEIGHT_PER_SIZE / 3.0 * size_mrad / 1000.0)  # radius of the inscribed circle
    return edge_deg > APERTURE_SDS * aperture_sd_deg


def levels_to_add(fits: Sequence[Fit], aperture_sd_deg: float | None = None) -> tuple[ResultWarning, ...]:
    """Return a warning for each threshold that the data leave open, with levels that would settle it. Where scenes
    alone leave it open, the warning asks for more of them, and for no levels; where the triangle is wider than the
    observer's aperture, whose standard deviation is `aperture_sd_deg`, for smaller sizes. Nothing is said about
    other curves that stay near chance at all levels: stronger ones are not known to help. Answers that fall with
    the level, or are right less often than guesses, have a warning of their own: no level mends them.
    """
    warnings = []
    for fit in fits:
        levels: list[float] = []
        if against := _against_expectation(fit):
            warnings.append(against)
            continue
        if _is_too_wide(fit, aperture_sd_deg):
            reason, advice = _wider(aperture_sd_deg), "take smaller sizes"
        elif not (reason := _open_reason(fit)):
            continue
        elif reason == FEW_SCENES:
            advice = "take more scenes"
        elif (
            level_of(fit.level).quantity == "contrast"
            and fit.status != "always_exceeded"
            and _estimate(fit) > MOST_CONTRAST
        ):
            advice = "no display shows the contrasts that are missing, take larger sizes"
        else:
            levels = _levels_near_threshold(fit)
            near = listed(f"{level:g}" for level in levels) if levels else ""
            advice = f"add levels near {near}" if levels else "show more trials"
        shown = [point.level for point in fit.points]
        message = f"{reason}; {advice}"
        warnings.append(
            ResultWarning(code="levels_to_add", group=fit.group, message=message, found=shown, expected=levels)
        )
    return tuple(warnings)


def _against_expectation(fit: Fit) -> ResultWarning | None:
    """Return a warning if answers fall with the level, or are certainly right less often than guesses."""
    n_trials = sum(point.n_trials for point in fit.points)
    if not n_trials:
        return None
    weakest, strongest = fit.points[0], fit.points[-1]
    if fit.status == "falling":
        message = (
            f"answers get worse as the level grows: {100.0 * weakest.p_correct:.0f} % are correct at "
            f"{weakest.level:g}, and {100.0 * strongest.p_correct:.0f} % at {strongest.level:g}. If the level "
            "makes the task harder, as a distance does, give its inverse; otherwise look at the frames of the "
            "highest levels"
        )
        found, expected = strongest.p_correct, weakest.p_correct
        return ResultWarning(
            code="falling_answers", group=fit.group, message=message, found=found, expected=expected
        )
    expected = 0.25 if fit.guess_rate is None else fit.guess_rate
    found = sum(point.p_correct * point.n_trials for point in fit.points) / n_trials
    if fit.status != "never_reached" or found > expected - 3.0 * math.sqrt(expected * (1.0 - expected) / n_trials):
        return None
    message = (
        f"{100.0 * found:.0f} % of the answers are correct, fewer than the {100.0 * expected:.0f} % of guesses: "
        "the triangle is seen and taken for another; check the orientations, the polarity and the order of the "
        "answers"
    )
    return ResultWarning(code="below_chance", group=fit.group, message=message, found=found, expected=expected)


def numerical_errors(fits: Sequence[Fit], tolerance: float | None) -> tuple[ResultWarning, ...]:
    """Return a warning for each threshold that is too uncertain, or whose numerical error misses the tolerance.
    Without a tolerance the error is not compared with one.
    """
    warnings = []
    for fit in fits:
        error = fit.threshold_numerical_error or fit.threshold_displacement_error
        warning = missed_tolerance(fit.threshold, error, tolerance, group=fit.group, exact="larger sizes")
        if fit.status == "too_uncertain":
            message = (
                "the numerical error is more than 30 % of the threshold, so there is none; larger sizes have "
                "smaller errors"
            )
            warning = ResultWarning(code="numerical_error", group=fit.group, message=message, expected=tolerance)
        if warning is not None:
            warnings.append(warning)
    return tuple(warnings)


def missed_tolerance(
    threshold: float | None, error: float | None, tolerance: float | None, *, group: Group, exact: str
) -> ResultWarning | None:
    """Return a warning if the numerical error of a threshold misses the tolerance. `exact` names what has smaller
    errors."""
    share = (error or 0.0) / (threshold or math.inf)
    if tolerance is None or share <= MISSED * tolerance:
        return None
    message = (
        f"the numerical error of {plain(error, 1)} is {100 * share:.2g} % of the threshold, and the tolerance "
        f"{100 * tolerance:g} %: the last digits are not sure; {exact} have smaller errors"
    )
    return ResultWarning(code="numerical_error", group=group, message=message, found=share, expected=tolerance)


def _open_reason(fit: Fit) -> str:
    """Return what the levels of a fit leave open; "" if nothing."""
    levels = [point.level for point in fit.points]
    if not levels:
        return ""
    criterion = f"{100.0 * fit.p_correct:g} % correct"
    if fit.status == "always_exceeded":
        return f"all levels are above the threshold of {criterion}, the weakest is {levels[0]:.3g}"
    if fit.status == "never_reached":
        best = max(fit.points, key=lambda point: point.p_correct)
        most = percent_below(best.p_correct, fit.p_correct)
        reached = f"at most {most} % correct is reached, at {best.level:.3g}"
        return f"all levels are below the threshold of {criterion}: {reached}" * (best.p_correct >= HELPS_FROM)
    if fit.status == "extrapolated" and fit.threshold is not None:
        side = "below" if fit.threshold < levels[0] else "above"
        return f"the threshold lies {side} all levels shown, {levels[0]:.3g} to {levels[-1]:.3g}"
    below, above = _about_threshold(fit)
    if fit.status == "between_levels":
        rise = " to ".join(f"{100.0 * at.p_correct:.0f} % at {at.level:.3g}" for at in (below, above))
        return f"answers rise from {rise}, and how they rise in between is not known"
    if len(levels) < FEWEST_LEVELS_SHOWN:
        return f"found {len(levels)} level{'s' * (len(levels) > 1)}, too few to see how the curve rises"
    if fit.threshold is None:
        return ""
    if above.level > WIDEST_GAP * below.level:
        return f"no level lies between {below.level:.3g} and {above.level:.3g}, where the threshold is"
    if fit.threshold_ci95 is not None and None in fit.threshold_ci95:
        if fit.threshold_ci95_same_scenes is not None and None not in fit.threshold_ci95_same_scenes:
            return FEW_SCENES
        return "the data leave an end of the 95 % interval open"
    return ""


def _about_threshold(fit: Fit) -> tuple[FitPoint, FitPoint]:
    """Return the points at and below the threshold, and at and above it, next to it."""
    threshold = fit.threshold or 0.0
    below = [point for point in fit.points if point.level <= threshold]
    above = [point for point in fit.points if point.level >= threshold]
    return (below or fit.points)[-1 if below else 0], (above or fit.points)[0 if above else -1]


def _levels_near_threshold(fit: Fit) -> list[float]:
    """Return levels about the threshold, or about an estimate of it, that are not among those shown."""
    shown = [point.level for point in fit.points]
    low = shown[-1] if fit.status == "never_reached" else 0.0
    high = shown[0] if fit.status == "always_exceeded" else math.inf
    wanted = [float(f"{step * _estimate(fit):.2g}") for step in ADDED_LEVELS]
    return [
        near
        for near in wanted
        if low < near < high and not any(near / SAME_LEVEL <= level <= near * SAME_LEVEL for level in shown)
    ]


def _estimate(fit: Fit) -> float:
    """Return the threshold; without one, that of a curve of the usual slope through the nearest of the levels."""
    if fit.status == "between_levels":
        below, above = _about_threshold(fit)
        return math.sqrt(below.level * above.level)
    if fit.threshold is not None:
        return fit.threshold
    nearest = fit.points[-1 if fit.status == "never_reached" else 0]
    guess_rate = 0.25 if fit.guess_rate is None else fit.guess_rate

    def distance(p_correct: float) -> float:
        """Return level / α of a curve without lapses."""
        share = (1.0 - min(max(p_correct, guess_rate + 0.05), 0.98)) / (1.0 - guess_rate)
        return float((-math.log2(share)) ** (1.0 / USUAL_SLOPE))

    return nearest.level * distance(fit.p_correct) / distance(nearest.p_correct)
