"""Warnings that follow from thresholds alone, whatever they were measured with."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from todframes.report.data import Algorithm, ContrastPoint, Fit, ResultWarning
from todframes.report.wording import listed, plain

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

SAME_GAIN, SURE_GAIN = 0.1, 3.0
"""Relative difference of two contrast gains that counts as none, and standard errors beyond which it is sure."""

FEW_SCENES = "an end of the 95 % interval is open because scenes differ and are few"
"""Reason for an open interval that more levels or trials on the same scenes would not close."""

WIDE = "Smaller sizes are easier: the triangle is wider than what the observer looks at; take smaller sizes"
SMALL = "The size is below the acuity; take larger sizes"
"""Reasons why a size has a threshold contrast above 1."""

HELPS_FROM = 0.5
"""Proportion correct from which stronger levels will help; below it something else may be wrong."""


def above_contrast_1(
    fits: Sequence[Fit], is_easier_if_smaller: Callable[[Fit], bool]
) -> tuple[ResultWarning, ...]:
    """Return a warning for each threshold contrast above 1, which no triangle darker than its background has.

    `is_easier_if_smaller` returns whether a smaller triangle has a lower threshold.
    """
    return tuple(
        ResultWarning(
            code="above_contrast_1",
            group=fit.group,
            message=(
                f"the threshold contrast of {plain(fit.threshold)} is above 1, which "
                f"bright triangles may have, but dark ones never. {WIDE if is_easier_if_smaller(fit) else SMALL}"
            ),
            found=fit.threshold,
            expected=1.0,
        )
        for fit in fits
        if fit.level == "contrast" and fit.threshold is not None and fit.threshold > 1.0
    )


def levels_to_add(fits: Sequence[Fit]) -> tuple[ResultWarning, ...]:
    """Return a warning for each threshold that the data leave open, with levels that would settle it.

    Where scenes alone leave it open, the warning asks for more of them, and for no levels.

    Nothing is said about curves that stay near chance at all levels: stronger ones are not known to help there.
    """
    found = []
    for fit in fits:
        reason = _open_reason(fit)
        if reason:
            levels = [] if reason == FEW_SCENES else _levels_near_threshold(fit)
            advice = "take more scenes" if reason == FEW_SCENES else "show more trials"
            if levels:
                advice = f"add levels near {listed(f'{level:g}' for level in levels)}"
            message = f"{reason}; {advice}"
            shown = [point.level for point in fit.points]
            found.append(
                ResultWarning(code="levels_to_add", group=fit.group, message=message, found=shown, expected=levels)
            )
    return tuple(found)


def not_proportional(algorithms: Sequence[Algorithm]) -> tuple[ResultWarning, ...]:
    """Return a warning where an algorithm's gain of contrast is another at threshold than at the highest level.

    A comparison with a plain gain, which has the gain of the highest level, then compares with a wrong one.
    """
    found = []
    for one in algorithms:
        for fit, response, ratio in zip(one.fits, one.contrast_responses, one.ratios, strict=False):
            points = [point for point in response.points if point.gain is not None and point.gain > 0.0]
            if ratio.beyond_gain is None or fit.threshold is None or len(points) < 2:
                continue
            near = min(points, key=lambda point, at=fit.threshold: abs(math.log(point.level / at)))  # type: ignore[misc]
            top = points[-1]
            if near.gain is None or top.gain is None or not _gains_differ(near, top):
                continue
            message = (
                f"its gain of contrast is {plain(near.gain, 3)} ± {plain(near.gain_standard_error, 1)} near the "
                f"threshold, at {near.level:.3g}, and {plain(top.gain, 3)} at the highest level: beyond_gain, "
                "which takes the latter, does not hold; see the table of the contrast before and after"
            )
            group = {"algorithm": one.name} | fit.group
            found.append(
                ResultWarning(
                    code="not_proportional", group=group, message=message, found=near.gain, expected=top.gain
                )
            )
    return tuple(found)


def _gains_differ(one: ContrastPoint, other: ContrastPoint) -> bool:
    """Return whether two gains differ by more than is usual, and more than their errors allow."""
    assert one.gain is not None
    assert other.gain is not None
    difference = abs(one.gain - other.gain)
    error = math.hypot(one.gain_standard_error or 0.0, other.gain_standard_error or 0.0)
    return difference > SAME_GAIN * other.gain and difference > SURE_GAIN * error


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
        reached = f"at most {100.0 * best.p_correct:.0f} % correct is reached, at {best.level:.3g}"
        return f"all levels are below the threshold of {criterion}: {reached}" * (best.p_correct >= HELPS_FROM)
    if fit.status == "extrapolated" and fit.threshold is not None:
        side = "below" if fit.threshold < levels[0] else "above"
        return f"the threshold lies {side} all levels shown, {levels[0]:.3g} to {levels[-1]:.3g}"
    if len(levels) < FEWEST_LEVELS_SHOWN:
        return f"found {len(levels)} level{'s' * (len(levels) > 1)}, too few to see how the curve rises"
    if fit.threshold is None:
        return ""
    below = max((level for level in levels if level <= fit.threshold), default=levels[0])
    above = min((level for level in levels if level >= fit.threshold), default=levels[-1])
    if above > WIDEST_GAP * below:
        return f"no level lies between {below:.3g} and {above:.3g}, where the threshold is"
    if fit.threshold_ci95 is not None and None in fit.threshold_ci95:
        if fit.threshold_ci95_same_scenes is not None and None not in fit.threshold_ci95_same_scenes:
            return FEW_SCENES
        return "the data leave an end of the 95 % interval open"
    return ""


def _levels_near_threshold(fit: Fit) -> list[float]:
    """Return levels about the threshold, or about an estimate of it, that are not among those shown."""
    shown = [point.level for point in fit.points]
    wanted = [float(f"{step * _estimate(fit):.2g}") for step in ADDED_LEVELS]
    return [one for one in wanted if not any(one / SAME_LEVEL <= level <= one * SAME_LEVEL for level in shown)]


def _estimate(fit: Fit) -> float:
    """Return the threshold; without one, where a curve of the usual slope through the nearest point has it."""
    if fit.threshold is not None:
        return fit.threshold
    nearest = min(fit.points, key=lambda point: abs(point.p_correct - fit.p_correct))
    guess_rate = 0.25 if fit.guess_rate is None else fit.guess_rate

    def distance(p_correct: float) -> float:
        """Return level / α of a curve without lapses."""
        share = (1.0 - min(max(p_correct, guess_rate + 0.05), 0.98)) / (1.0 - guess_rate)
        return float((-math.log2(share)) ** (1.0 / USUAL_SLOPE))

    return nearest.level * distance(fit.p_correct) / distance(nearest.p_correct)
