"""Threshold curves of a sensor over spatial frequency: TOD, MRTD or MRC, from tables and results."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.reading import check_columns, read_table
from todframes.field.target import Quantity
from todframes.psychometrics.bootstrap import NORMAL_95
from todframes.psychometrics.curves import weibull_level
from todframes.results.data import Fit, ResultWarning
from todframes.results.thresholds import Thresholds
from todframes.results.wording import unit_of, value_text
from todframes.stimulus import LEVELS, level_of

Pattern = Literal["triangle", "bars"]

CYC_PER_MRAD_IN_CYC_PER_DEG = 0.18 / np.pi
"""Cycles/mrad in one cycle/deg: a degree is π / 0.18 mrad."""

PER_MRAD = (0.01, 1000.0)
"""Range of the highest frequency or inverse size of a curve in mrad⁻¹: no camera shows 100 mrad at best. Others
are mistakes in the input, such as cycles/rad."""

UNREACHED = 500.0
"""ln(contrast / threshold) of what no contrast reaches: its exponential is finite, and its square too."""

LOWEST: dict[Quantity, tuple[float, float, str, str]] = {
    "delta_t_k": (1e-4, 10.0, " K", "are they in K, or in mK?"),
    "contrast": (1e-6, 10.0, "", "are they in thousandths, or in %?"),
}
"""Least and largest value of the lowest threshold of a curve, their unit, and the mistake beyond either."""

FREQUENCIES: dict[str, tuple[Pattern, float]] = {
    "frequency_cyc_per_mrad": ("bars", 1.0),
    "frequency_cyc_per_deg": ("bars", CYC_PER_MRAD_IN_CYC_PER_DEG),
    "size_mrad": ("triangle", 1.0),
}
"""Columns of a table that say where a threshold is: the pattern, and the factor to mrad."""

THRESHOLDS: dict[str, tuple[Quantity, float]] = {
    "mrtd_k": ("delta_t_k", 1.0),
    "mrtd_mk": ("delta_t_k", 1e-3),
    "delta_t_k": ("delta_t_k", 1.0),
    "delta_t_mk": ("delta_t_k", 1e-3),
    "mrc": ("contrast", 1.0),
    "contrast": ("contrast", 1.0),
}
"""Columns of a table that hold thresholds: the quantity, and the factor to K or Weber contrast."""


class Psychometric(NamedTuple):
    """Weibull functions of contrast / threshold at the points of a TOD (Hogervorst et al. 2001, eq. 3).

    All but `guess_rate` and `p_correct`, that of the thresholds, have a value a point, shape (n,). `ln_beta_sd` is
    the standard deviation of ln β, and `correlation` that of the errors of ln β and ln(threshold).
    """

    beta: FloatArray
    lapse_rate: FloatArray
    ln_beta_sd: FloatArray
    correlation: FloatArray
    guess_rate: float
    p_correct: float

    def betas(self, drawn: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw β with errors that go with those of ln(threshold), in standard deviations, shape (draws, n)."""
        apart = np.sqrt(1.0 - self.correlation**2) * rng.standard_normal(drawn.shape)
        return np.asarray(self.beta * np.exp(self.ln_beta_sd * (self.correlation * drawn + apart)))

    def ln_ratio(self, p_correct: float, beta: FloatArray) -> FloatArray:
        """Compute ln(contrast / threshold) at a proportion correct for β of shape (..., n).

        It is `UNREACHED` from the ceiling on.
        """
        asked, known = (self._halves(p, self.lapse_rate) for p in (p_correct, self.p_correct))
        with np.errstate(divide="ignore"):
            return np.minimum(np.log(asked / known) / beta, UNREACHED)

    def _halves(self, p_correct: float, lapse_rate: FloatArray) -> FloatArray:
        """Return (x/α)^β at a proportion correct: 0 at the guess rate, infinity from the ceiling on."""
        return weibull_level(p_correct, alpha=1.0, beta=1.0, guess_rate=self.guess_rate, lapse_rate=lapse_rate)

    def probability(self, ln_ratio: FloatArray, beta: FloatArray, weights: FloatArray) -> FloatArray:
        """Compute the proportion correct at ln(contrast / threshold), shape (..., m), for β of shape (..., n).

        `weights`, shape (n, m), are those of the n points at each of the m places between them.
        """
        slope, lapse = np.exp(np.log(beta) @ weights), self.lapse_rate @ weights
        halves = self._halves(self.p_correct, lapse)
        with np.errstate(over="ignore"):
            exponent = halves * np.exp(np.minimum(slope * ln_ratio, UNREACHED))
        return np.asarray((1.0 - lapse) - (1.0 - lapse - self.guess_rate) * np.exp2(-exponent))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ThresholdCurve:
    """Thresholds over spatial frequency; between points ln(threshold) is linear in frequency.

    The pattern is a triangle for a TOD, or bars for MRTD and MRC. Thresholds, shape (n,), are ΔT in K, or Weber
    contrast (MRC: modulation); `per_mrad`, shape (n,), are rising frequencies in cycles/mrad, or 1 / √area in
    mrad⁻¹. `ln_sd`, shape (2, n), are the standard deviations of ln(threshold) below and above it; None if not
    known. `p_correct` is that of a TOD's thresholds. `unreached_per_mrad` is the first frequency above those of
    the curve at which no contrast suffices, if one was found. DataError for a curve that no camera has.
    """

    pattern: Pattern
    quantity: Quantity
    per_mrad: FloatArray
    threshold: FloatArray
    ln_sd: FloatArray | None = None
    psychometric: Psychometric | None = None
    p_correct: float | None = None
    unreached_per_mrad: float | None = None
    name: str = ""

    def __post_init__(self) -> None:
        n = self.per_mrad.size
        if n < 2:
            raise DataError(f"{self.name}: found thresholds at {n} sizes or frequencies, expected two or more")
        if not (np.diff(self.per_mrad) > 0.0).all() or not self.per_mrad[0] > 0.0:
            raise DataError(f"{self.name}: found a size or frequency twice, expected each once and above 0")
        name, highest = "frequency" if self.pattern == "bars" else "inverse size", float(self.per_mrad[-1])
        if not PER_MRAD[0] <= highest <= PER_MRAD[1]:
            raise DataError(
                f"{self.name}: found {highest:g} per mrad as the highest {name}, expected {PER_MRAD[0]:g} to "
                f"{PER_MRAD[1]:g}; are the angles in rad or µrad, or the frequencies in cycles/rad?"
            )
        least, most, unit, hint = LOWEST[self.quantity]
        if not least <= (lowest := float(self.threshold.min())) <= most:
            raise DataError(
                f"{self.name}: found {lowest:g}{unit} as the lowest threshold, expected {least:g} to "
                f"{most:g}{unit}; {hint}"
            )

    @classmethod
    def of_sizes(
        cls, size_mrad: FloatArray, threshold: FloatArray, *, unreached_mrad: Iterable[float] = (), **others: Any
    ) -> ThresholdCurve:
        """Return a TOD from thresholds over sizes in the field, which descend; `others` are further attributes.

        `unreached_mrad` are the sizes at which no contrast sufficed; only those below all other sizes count.
        """
        per_mrad = 1.0 / size_mrad
        finer = [one for one in (1.0 / size for size in unreached_mrad) if one > max(per_mrad, default=0.0)]
        unreached = min(finer, default=None)
        return cls(
            pattern="triangle", per_mrad=per_mrad, threshold=threshold, unreached_per_mrad=unreached, **others
        )

    @property
    def is_rising(self) -> bool:
        """Whether no threshold is below that at a lower frequency."""
        return bool((np.diff(self.threshold) >= 0.0).all())

    def as_bars(self, cycles_per_size: float) -> ThresholdCurve:
        """Return a TOD as the curve of bars that are as hard: f = cycles_per_size / √area, the same thresholds."""
        unreached = self.unreached_per_mrad
        return replace(
            self,
            pattern="bars",
            per_mrad=self.per_mrad * cycles_per_size,
            psychometric=None,
            p_correct=None,
            unreached_per_mrad=None if unreached is None else unreached * cycles_per_size,
        )


def ln_sd_of_interval(threshold: ArrayLike, low: ArrayLike, high: ArrayLike) -> FloatArray:
    """Return the standard deviations of ln(threshold) below and above, shape (2, n), from 95 % intervals.

    An end that is NaN is open: its side has the error of the other side.
    """
    value = np.log(np.asarray(threshold, dtype=np.float64))
    ends = np.stack([value - np.log(low), np.log(high) - value]) / NORMAL_95
    return np.maximum(np.where(np.isnan(ends), ends[::-1], ends), 0.0)


def read_curve(path: Path) -> ThresholdCurve:
    """Return the curve in a CSV table with units in its header.

    The columns are one of `FREQUENCIES` and one of `THRESHOLDS`; `ci95_low` and `ci95_high`, in the unit of the
    thresholds, are their 95 % intervals. DataError if a column is missing, or a value is not a number > 0.
    """
    header, rows = read_table(path)
    frequency, level = (_one_column(header, known, path) for known in (FREQUENCIES, THRESHOLDS))
    pattern, to_per_mrad = FREQUENCIES[frequency]
    quantity, factor = THRESHOLDS[level]
    ends = ["ci95_low", "ci95_high"] if {"ci95_low", "ci95_high"} & set(header) else []
    check_columns(header, ends, path)
    values = np.array([row.numbers((frequency, level, *ends), positive=True) for row in rows])
    values = values.reshape(-1, 2 + len(ends))
    per_mrad = to_per_mrad / values[:, 0] if pattern == "triangle" else to_per_mrad * values[:, 0]
    order = np.argsort(per_mrad, kind="stable")
    values, per_mrad = values[order], per_mrad[order]
    for threshold, low, high in values[:, 1:] if ends else ():
        if not low <= threshold <= high:
            raise DataError(f"{path}: found the interval {low:g} to {high:g}, expected it to hold {threshold:g}")
    return ThresholdCurve(
        pattern=pattern,
        quantity=quantity,
        per_mrad=per_mrad,
        threshold=factor * values[:, 1],
        ln_sd=ln_sd_of_interval(*values[:, 1:].T) if ends else None,
        name=str(path),
    )


def _one_column(header: Sequence[str], known: Iterable[str], path: Path) -> str:
    names = [name for name in header if name in known]
    if len(names) != 1:
        listed = ", ".join(header) or "none"
        raise DataError(
            f"{path}: found {len(names)} of the columns {', '.join(known)}, expected one; the columns are {listed}"
        )
    return names[0]


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
    curve from the others.
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
