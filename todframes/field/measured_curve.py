"""Conversion of a result's thresholds to a curve over spatial frequency, in angles of the field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from todframes.base.errors import DataError, SettingsError, argument
from todframes.field.target import Quantity
from todframes.field.threshold_curve import Psychometric, ThresholdCurve, ln_sd_of_interval
from todframes.results.data import Fit, ResultWarning
from todframes.results.thresholds import Thresholds
from todframes.results.wording import unit_of, value_text
from todframes.stimulus import LEVELS, level_of

SIZES = ("object_size_mrad", "size_mrad", "size_detectors")
"""Columns of sizes, the best first. `size_mrad` is as displayed: it is in the field only for the eye itself."""

NAMELESS = "level"
"""Level of counts, whose quantity nobody has named."""

USUAL_GUESS_RATE = 0.25
"""Guess rate of four orientations."""


def measured_curve(
    result: Thresholds,
    where: str,
    *,
    quantity: Quantity,
    group: Mapping[str, str] | None = None,
    magnification: float | None = None,
) -> tuple[ThresholdCurve, tuple[ResultWarning, ...]]:
    """Return the curve of a result's thresholds, and the warnings about it; messages begin with `where`.

    `quantity` is that of a level without a name of its own. `group` has the values of the columns that tell one
    curve from the others. DataError if there are no thresholds over sizes, or their level is no contrast of the
    field; SettingsError if the result has several curves and `group` does not name one.
    """
    fits = _of_group(result.thresholds, where, dict(group or {}))
    size = next((name for name in SIZES if fits and name in fits[0].group), None)
    if size is None:
        raise DataError(f"{where}: found no column of sizes, expected one of {', '.join(SIZES)}")
    factor, warnings = _to_field_mrad(result, size, where, magnification)
    if fits[0].level == NAMELESS:
        unit = "K" if quantity == "delta_t_k" else "Weber contrast"
        message = f"the level has no unit; it is taken for that of the target's contrast, {unit}"
        warnings = (*warnings, ResultWarning(code="level_without_unit", message=message))
    quantity, level_factor = (quantity, 1.0) if fits[0].level == NAMELESS else _level(fits, where)
    known = sorted((one for one in fits if one.threshold is not None), key=lambda one: -float(one.group[size]))
    sizes = factor * np.array([float(one.group[size]) for one in known])
    thresholds = np.array([_threshold(one) for one in known])
    extrapolated = [value_text(one.group[size]) for one in known if one.status == "extrapolated"]
    if extrapolated:
        message = (
            f"the thresholds at {', '.join(extrapolated)} {unit_of(size)} are extrapolated from the levels shown"
        )
        warnings = (*warnings, ResultWarning(code="extrapolated_thresholds", message=message))
    curve = ThresholdCurve.of_sizes(
        sizes,
        level_factor * thresholds,
        unreached_mrad=[factor * float(one.group[size]) for one in fits if one.status == "never_reached"],
        quantity=quantity,
        ln_sd=_ln_sd(known),
        psychometric=_psychometric(known),
        p_correct=known[0].p_correct if known else None,
        name=where,
    )
    return curve, warnings


def _of_group(fits: Sequence[Fit], where: str, group: dict[str, str]) -> list[Fit]:
    """Return the fits whose other columns have the values of `group`: those of one curve."""
    others = [name for name in (fits[0].group if fits else ()) if not unit_of(name)]
    for name in group:
        if name not in others:
            known = ", ".join(others) or "none"
            raise SettingsError(
                f"{argument.group}: found {name!r}, expected one of the columns {known} of {where}"
            )
    chosen = [
        one for one in fits if all(value_text(one.group[name]) == str(value) for name, value in group.items())
    ]
    curves = {tuple(one.group[name] for name in others) for one in chosen}
    if len(curves) > 1 or not chosen:
        all_curves = [", ".join(f"{name}={value_text(one.group[name])}" for name in others) for one in fits]
        named = "; ".join(dict.fromkeys(all_curves))
        raise SettingsError(
            f"{argument.group}: found {len(curves)} curves in {where}, expected a choice of one: {named}"
        )
    return chosen


def _to_field_mrad(
    result: Thresholds, size: str, where: str, magnification: float | None
) -> tuple[float, tuple[ResultWarning, ...]]:
    """Return the factor from a column of sizes to mrad in the field, and the warnings about it."""
    if magnification is not None and size != "size_mrad":
        raise SettingsError(
            f"{argument.magnification}: is given but not used, because the sizes of {where} are in the field "
            f"already ({size})"
        )
    if size == "size_detectors":
        try:
            detector, optics = (result.settings["sensor"].get(name, {}) for name in ("detector", "optics"))
            if "pitch_um" in detector:
                return float(detector["pitch_um"]) / float(optics["focal_length_mm"]), ()
            return float(detector["pitch_mrad"]), ()
        except (AttributeError, TypeError, KeyError, ValueError, ZeroDivisionError):
            raise DataError(
                f"{where}: found sizes in detectors but no detector pitch, expected the result of a sensor's curve"
            ) from None
    if size == "size_mrad" and magnification is None and result.dataset is not None:
        message = (
            "the sizes are those on the display; they are taken for angles in the field, as for a display that "
            f"magnifies once ({argument.magnification} gives another)"
        )
        return 1.0, (ResultWarning(code="size_at_the_eye", message=message),)
    return 1.0 / (magnification or 1.0), ()


def _level(fits: Sequence[Fit], where: str) -> tuple[Quantity, float]:
    """Return the quantity of the thresholds and the factor to it; that of an SNR is its ΔT."""
    level = fits[0].level
    known = level_of(level)
    if known.quantity is not None:
        return known.quantity, known.factor
    if level == "snr" and all(one.delta_t_mk is not None for one in fits if one.threshold is not None):
        return "delta_t_k", 1e-3
    hint = ""
    if level == "snr":
        hint = "; netd_mk in [noise] gives ΔT; a camera that counts photons (preset low_light) has contrasts"
    names = ", ".join(name for name, one in LEVELS.items() if one.quantity)
    raise DataError(f"{where}: found thresholds in {level}, expected one of {names}{hint}")


def _threshold(fit: Fit) -> float:
    return float(fit.delta_t_mk if fit.level == "snr" and fit.delta_t_mk is not None else fit.threshold or 0.0)


def _ln_sd(fits: Sequence[Fit]) -> np.ndarray | None:
    """Return the errors of ln(threshold) below and above, from intervals or numerical errors; None if unknown."""
    if not fits or all(one.threshold_ci95 is None and one.threshold_numerical_error is None for one in fits):
        return None
    ends = []
    for one in fits:
        threshold = float(one.threshold or 0.0)
        low, high = one.threshold_ci95 or (None, None)
        if one.threshold_ci95 is None and one.threshold_numerical_error is not None:
            high = threshold + one.threshold_numerical_error
        ends.append((threshold, low, high))
    ln_sd = ln_sd_of_interval(*np.array(ends, np.float64).T)  # None becomes NaN
    # A point without both ends has the largest error of the others, and none if there are no others.
    return np.where(np.isnan(ln_sd), np.nanmax(ln_sd, initial=0.0), ln_sd)


def _psychometric(fits: Sequence[Fit]) -> Psychometric | None:
    """Return the psychometric functions, fitted or through computed points; None if one has none."""
    slopes = [one.beta if one.beta is not None else _slope_of_points(one) for one in fits]
    if any(one is None for one in slopes):
        return None
    errors = [_slope_error(one) if one.beta is not None and one.n_trials else (0.0, 0.0) for one in fits]
    known = [one for one in errors if one is not None]
    if not known:
        return None
    # A slope that the answers leave open has the largest error of the others.
    open_ended = (max(one[0] for one in known), 0.0)
    sd, correlation = np.array([open_ended if one is None else one for one in errors]).T
    return Psychometric(
        beta=np.array(slopes, dtype=np.float64),
        lapse_rate=np.array([one.lapse_rate or 0.0 for one in fits]),
        ln_beta_sd=sd,
        correlation=correlation,
        guess_rate=USUAL_GUESS_RATE if fits[0].guess_rate is None else fits[0].guess_rate,
        p_correct=fits[0].p_correct,
    )


def _slope_error(fit: Fit) -> tuple[float, float] | None:
    """Return the standard deviation of ln β, and its correlation with that of ln(threshold); None if unknown.

    Their covariance is the inverse Fisher information of answers at the levels shown, for a Weibull function of
    known guess and lapse rates, scaled so that the error of the threshold is that of its interval.
    """
    if fit.alpha is None or fit.beta is None:
        return None
    guess, lapse = fit.guess_rate or 0.0, fit.lapse_rate or 0.0
    span = 1.0 - lapse - guess
    trials = np.array([one.n_trials for one in fit.points], dtype=np.float64)
    z = fit.beta * np.log([one.level / fit.alpha for one in fit.points])
    halves = np.exp(np.minimum(z, 6.0))  # beyond, an answer says nothing
    p = 1.0 - lapse - span * np.exp2(-halves)
    slope = span * np.log(2.0) * halves * np.exp2(-halves)
    known = trials * slope**2 / np.maximum(p * (1.0 - p), np.finfo(float).tiny)
    to_parameters = np.stack([np.full(z.size, -fit.beta), z])
    information = (to_parameters * known) @ to_parameters.T
    if np.linalg.matrix_rank(information) != 2:
        return None
    to_threshold = np.array([[1.0, -np.log(np.log2(span / (1.0 - lapse - fit.p_correct))) / fit.beta], [0.0, 1.0]])
    covariance = to_threshold @ np.linalg.inv(information) @ to_threshold.T
    sd = np.sqrt(np.diag(covariance))
    of_interval = _ln_sd([fit])
    scale = 1.0 if of_interval is None else float(of_interval.mean()) / sd[0]
    return float(scale * sd[1]), float(covariance[0, 1] / (sd[0] * sd[1]))


def _slope_of_points(fit: Fit) -> float | None:
    """Return β of a Weibull function through computed points, by least squares in ln level."""
    low, high = (0.3, 0.97)
    seen = [(one.level, one.p_correct) for one in fit.points if low < one.p_correct < high]
    if len({level for level, _ in seen}) < 2:
        return None
    level, p = np.log([one for one, _ in seen]), np.array([one for _, one in seen])
    height = np.log(np.log2((1.0 - USUAL_GUESS_RATE) / (1.0 - p)))
    slope = float(np.polyfit(level, height, 1)[0])
    return slope if slope > 0.0 else None
