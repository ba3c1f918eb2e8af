"""Range at which a person with a sensor can do a task, where thresholds meet the contrast that arrives.

Both ways to a range solve threshold(κ R / size) = contrast(R), with R in km, size in m and frequency in mrad⁻¹:

- TOD: κ = k of the task. A triangle of √area size / k is judged with the proportion correct that is asked for.
- Cycles: κ = N, the line pairs across the target. Of observers with N = a · N50, a^γ / (1 + a^γ) do the task,
  γ = 2.7 + 0.7 a (target transfer probability function, as in ACQUIRE).

Contrast falls and thresholds rise with range, so there is one such range at most.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from msgspec import Struct, structs
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError, SettingsError, argument
from todframes.field.atmosphere import LEAST_THERMAL_UM, Atmosphere
from todframes.field.target import Target
from todframes.field.threshold_curve import ThresholdCurve
from todframes.results.data import as_read

Method = Literal["tod", "cycles"]

Limit = Literal["contrast", "resolution", "air"]

Status = Literal[
    "ok", "limited_by_sampling", "beyond_curve", "nearer_than_curve", "beyond_air_table", "never_reached"
]

DRAWS = 1000
"""Number of curves drawn from the errors. An end of a 95 % interval errs by 4 % of its distance to the middle:
√(0.025 · 0.975 / 1000) / φ(1.96) = 0.085 standard deviations of 1.96."""

PLACES = 121
"""Number of ranges of the probability curve."""

MARGIN = 1.15
"""End of the probability curve, divided by the longest range or end of an interval that is reported."""

CELLS = 16
"""Number of cells between two points of the curve in which a crossing is searched."""

SEARCH_TIME_CONSTANT_S = 3.4
"""Time constant of search, divided by the probability without time limit (ACQUIRE, as in dstl's RET)."""

ACUITY_STEP = 1.1
"""Largest factor between the curve's last size or frequency and the next one, which no contrast reaches, at which
the last one is the limit."""

LIMITS: tuple[Limit, ...] = ("contrast", "resolution", "air")

TO_THE_LAST_DIGIT: dict[str, float] = {"xtol": 1e-300, "rtol": 4.0 * np.finfo(float).eps}
"""Tolerances of a root: the least that SciPy takes."""

STEP, LEAST_SLOPE = 1e-3, 1e-9
"""Relative step of a difference quotient over range; least slope of a margin, where gains have no end."""

GAIN = 0.1
"""Improvement of contrast, resolution or air, as a share, whose gain in range says what limits."""


def transfer_probability(ratio: ArrayLike) -> FloatArray:
    """Compute the probability to do a task at N / N50 >= 0, of any shape: a^γ / (1 + a^γ), γ = 2.7 + 0.7 a."""
    a = np.asarray(ratio, dtype=np.float64)
    with np.errstate(divide="ignore"):
        exponent = (2.7 + 0.7 * a) * np.log(a)
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(exponent, -700.0, 700.0))))


def cycles_ratio(probability: float) -> float:
    """Return N / N50 at a probability in (0, 1), the inverse of `transfer_probability`."""
    from scipy.optimize import brentq

    return float(brentq(lambda a: transfer_probability(a) - probability, 0.0, 100.0, **TO_THE_LAST_DIGIT))


def with_search(probability: ArrayLike, time_s: float) -> FloatArray:
    """Compute the probability to find the target in a time: P∞ (1 − exp(−P∞ t / 3.4 s)), from P∞ of any shape."""
    unlimited = np.asarray(probability, dtype=np.float64)
    return unlimited * -np.expm1(-unlimited * time_s / SEARCH_TIME_CONSTANT_S)


Ends = tuple[float | None, float | None]

Numbers = tuple[float, ...]


class TaskRange(Struct, frozen=True, kw_only=True):
    """The range at which a task is done with a probability.

    `range_km` is None if it is not on the curve: it then is at least `at_least_km` or at most `at_most_km`, as far
    as these are known, and `status` says why. `probability` is None at a TOD's own criterion if that is not known.
    An end of `range_ci95_km` is None if the curve leaves it open; the whole is None if the curve has no errors, or
    both ends are open. `kappa` is k, or N in line pairs; None if no number of line pairs is enough in the time to
    search. Gains in range are those by a tenth more contrast, resolution, or transparency of the air; `limited_by`
    names the largest.
    """

    task: str
    criterion: float
    probability: float | None
    kappa: float | None = None
    range_km: float | None = None
    range_ci95_km: Ends | None = None
    status: Status
    at_least_km: float | None = None
    at_most_km: float | None = None
    limited_by: Limit | None = None
    gain_contrast_percent: float | None = None
    gain_resolution_percent: float | None = None
    gain_air_percent: float | None = None


class TaskCurve(Struct, frozen=True, kw_only=True):
    """Probability of a task against range, with the ends of its 95 % band.

    `bound` has 1 where the probability is at least that, because the curve ends at a smaller detail; -1 where it
    is at most that; 0 elsewhere.
    """

    task: str
    range_km: Numbers
    probability: Numbers
    low: Numbers | None
    high: Numbers | None
    bound: Numbers


class RangeAtK(Struct, frozen=True, kw_only=True):
    """Range of a TOD at its own criterion for a divisor k of its sizes, with its 95 % interval."""

    k: float
    range_km: float | None
    range_ci95_km: Ends | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Acquisition:
    """Ranges and probabilities of a target, seen through air with a sensor whose curve is known.

    `draws` and `betas`, shape (draws, points), are curves of ln(threshold) and slopes β that are drawn from their
    errors. `curves` is empty for a TOD whose psychometric functions are not known.
    """

    target: Target
    atmosphere: Atmosphere
    curve: ThresholdCurve
    road: Method
    draws: FloatArray
    betas: FloatArray
    asked_probability: float | None = None
    ranges: tuple[TaskRange, ...] = ()
    curves: tuple[TaskCurve, ...] = ()

    def ln_contrast(self, range_km: ArrayLike) -> FloatArray:
        """Compute ln of the contrast that arrives, over ranges in km."""
        return math.log(self.target.signal) + self.atmosphere.ln_contrast_left(range_km)

    @property
    def criteria(self) -> dict[str, float]:
        """Criterion of each task: k, or N50."""
        return dict((self.target.k or {}) if self.road == "tod" else self.target.n50_cycles)

    @property
    def own_probability(self) -> float | None:
        """Probability of the criterion itself: 50 %, or the proportion correct of a TOD's thresholds, if known."""
        return 0.5 if self.road == "cycles" else self.curve.p_correct

    @property
    def probabilities(self) -> tuple[float | None, ...]:
        """Probabilities at which ranges are known; for a TOD they are proportions correct."""
        if self.road == "cycles" or self.curve.psychometric is not None:
            asked = set() if self.asked_probability is None else {self.asked_probability}
            return tuple(sorted({0.5, 0.75, 0.9} | asked))
        return (self.own_probability,)

    def threshold_curves(self, probability: float | None = None) -> FloatArray:
        """Return ln(threshold) of the curve and of all drawn ones, none falling; shape (1 + n, points).

        For a TOD, at a proportion correct; by default at that of the curve.
        """
        known = np.vstack([np.log(self.curve.threshold)[None, :], self.draws])
        psychometric = self.curve.psychometric
        if self.road == "tod" and psychometric is not None and probability is not None:
            known = known + psychometric.ln_ratio(probability, np.vstack([psychometric.beta, self.betas]))
        # A running maximum: a target is seen only as far as all coarser detail is, which is the safe reading of a
        # curve that errs.
        return np.maximum.accumulate(known, axis=-1)

    def crossing(self, kappa: float, ln_threshold: FloatArray) -> tuple[FloatArray, float, float]:
        """Find the ranges in km, (n,), at which `threshold_curves` meet the contrast, and those of their ends.

        `kappa` is k, or the line pairs across the target. A range is 0 nearer than the curve's first point, and
        infinity beyond its last or the table of the air. If that ends before the first point, the contrast at its
        end shows which.
        """
        knots = self.curve.per_mrad * self.target.size_m / kappa
        end = min(float(knots[-1]), self.atmosphere.longest_km)
        if end <= knots[0]:
            is_seen = self.ln_contrast(end) >= ln_threshold[:, 0]
            return np.where(is_seen, np.inf, 0.0), float(knots[0]), end
        edges = np.append(knots[knots < end], end)
        cells = np.linspace(edges[:-1], edges[1:], CELLS, endpoint=False, axis=1)
        first = self._first_crossing(knots, ln_threshold, np.append(cells.ravel(), end))
        if np.isfinite(first[0]) and first[0] > 0.0:
            from scipy.optimize import brentq

            near, cell = float(first[0]), float(np.diff(knots).max()) / CELLS
            first[0] = brentq(
                lambda km: float(self.ln_contrast(km) - np.interp(km, knots, ln_threshold[0])),
                max(near - cell, float(knots[0])),
                min(near + cell, end),
                **TO_THE_LAST_DIGIT,
            )
        return first, float(knots[0]), end

    def _first_crossing(self, knots: FloatArray, ln_threshold: FloatArray, grid: FloatArray) -> FloatArray:
        margin = self.ln_contrast(grid) - ln_threshold @ _weights(knots, grid)
        n_above = (margin >= 0.0).sum(axis=1)  # margins fall with range
        cell = np.clip(n_above, 1, grid.size - 1)
        rows = np.arange(len(margin))
        above, below = margin[rows, cell - 1], margin[rows, cell]
        share = above / np.maximum(above - below, 1e-300)
        crossing = grid[cell - 1] + share * (grid[cell] - grid[cell - 1])
        return np.where(n_above == 0, 0.0, np.where(n_above == grid.size, np.inf, crossing))

    def task_range(self, task: str, probability: float | None) -> TaskRange:
        """Return the range of a task at a probability, with its interval and what limits it."""
        criterion = self.criteria[task]
        kappa = self._kappa(criterion, probability)
        made = TaskRange(
            task=task, criterion=criterion, probability=probability, kappa=kappa, status="never_reached"
        )
        if kappa is None:
            return made
        ln_threshold = self.threshold_curves(probability)
        ranges, first, end = self.crossing(kappa, ln_threshold)
        range_km = float(ranges[0])
        made = structs.replace(made, range_ci95_km=self._interval(ranges[1:]))
        if 0.0 < range_km < np.inf:
            gains = (100.0 * self._gains(range_km, kappa, ln_threshold[0])).tolist()
            return structs.replace(
                made,
                range_km=range_km,
                status="ok",
                limited_by=LIMITS[int(np.argmax(gains))],
                gain_contrast_percent=gains[0],
                gain_resolution_percent=gains[1],
                gain_air_percent=gains[2],
            )
        if range_km == 0.0:
            is_never = math.log(self.target.signal) < ln_threshold[0, 0]
            return made if is_never else structs.replace(made, status="nearer_than_curve", at_most_km=first)
        curve, km_mrad = self.curve, self.target.size_m / kappa
        is_of_curve = float(curve.per_mrad[-1]) * km_mrad <= self.atmosphere.longest_km
        most = None if curve.unreached_per_mrad is None else curve.unreached_per_mrad * km_mrad
        if is_of_curve and self._ends_at_acuity:
            gains = {
                "gain_contrast_percent": 0.0,
                "gain_resolution_percent": 100.0 * GAIN,
                "gain_air_percent": 0.0,
            }
            own = {"status": "limited_by_sampling", "range_km": end, "limited_by": "resolution"}
            return structs.replace(made, **own, **gains)
        status: Status = "beyond_curve" if is_of_curve else "beyond_air_table"
        return structs.replace(made, status=status, at_least_km=end, at_most_km=most)

    @property
    def _ends_at_acuity(self) -> bool:
        """Whether no contrast suffices for detail just finer than the curve's last."""
        unreached = self.curve.unreached_per_mrad
        return unreached is not None and unreached <= ACUITY_STEP * float(self.curve.per_mrad[-1])

    def _kappa(self, criterion: float, probability: float | None) -> float | None:
        """Return k, or the line pairs that a probability needs; None if no number is enough in the time."""
        from scipy.optimize import brentq

        if self.road == "tod" or probability is None:
            return criterion
        time_s = self.target.search_time_s
        if time_s is None:
            return criterion * cycles_ratio(probability)
        if float(with_search(1.0, time_s)) <= probability:
            return None
        unlimited = brentq(lambda p: with_search(p, time_s) - probability, 0.0, 1.0, **TO_THE_LAST_DIGIT)
        return criterion * cycles_ratio(float(unlimited)) if unlimited < 1.0 else None

    def _interval(self, drawn_km: FloatArray) -> Ends | None:
        """Return the middle 95 % of drawn ranges; an end off the curve is None."""
        if self.curve.ln_sd is None:
            return None
        ends = np.quantile(drawn_km, (0.025, 0.975), method="inverted_cdf").tolist()
        low, high = map(_on_curve, ends)
        return None if low is None and high is None else (low, high)

    def _gains(self, range_km: float, kappa: float, ln_threshold: FloatArray) -> FloatArray:
        """Return what a tenth more of each of `LIMITS` gains, from the slopes of both sides of the equation.

        With s = d ln(threshold) / d ln(frequency) and a = −d ln(contrast) / d ln(range), a tenth more contrast
        gains 0.1 / (s + a), resolution s times that, and air a times that.
        """
        knots, frequency = self.curve.per_mrad, range_km * kappa / self.target.size_m
        cell = np.clip(np.searchsorted(knots, frequency), 1, knots.size - 1)
        slope = np.diff(ln_threshold)[cell - 1] / np.diff(knots)[cell - 1] * frequency
        near, far = (float(self.ln_contrast(range_km * (1.0 + step))) for step in (-STEP, STEP))
        air = (near - far) / math.log((1.0 + STEP) / (1.0 - STEP))
        return np.asarray(GAIN * np.array([1.0, slope, air]) / max(slope + air, LEAST_SLOPE))

    def at_distances(self, distances_m: Sequence[float]) -> tuple[TaskCurve, ...]:
        """Return the probability of each task at distances; SettingsError if the curve or the air has none."""
        if not distances_m:
            return ()
        ranges = np.array(distances_m) / 1e3
        if ranges[-1] > self.atmosphere.longest_km:
            most = 1e3 * self.atmosphere.longest_km
            raise SettingsError(
                f"{argument.distance_m}: found {distances_m[-1]:g}, expected at most {most:g}, where the air ends"
            )
        if self.road == "tod" and self.curve.psychometric is None:
            raise SettingsError(
                f"{argument.distance_m}: {self.curve.name} has no psychometric functions, so no probability at a "
                "distance is known; expected none, or a target without k"
            )
        return self._curves(ranges)

    def task_curves(self, ends_km: tuple[float, float]) -> tuple[TaskCurve, ...]:
        """Return the probability of each task against range between two ranges."""
        return self._curves(np.linspace(*ends_km, PLACES))

    def _curves(self, ranges: FloatArray) -> tuple[TaskCurve, ...]:
        if self.road == "tod":
            return tuple(self._of_triangles(*one, ranges) for one in self.criteria.items())
        return self._of_bars(ranges)

    def _of_triangles(self, task: str, k: float, ranges: FloatArray) -> TaskCurve:
        psychometric = self.curve.psychometric
        assert psychometric is not None
        knots = self.curve.per_mrad
        frequency = ranges * k / self.target.size_m
        weights = _weights(knots, np.clip(frequency, knots[0], knots[-1]))
        ln_threshold = self.threshold_curves()
        margin = self.ln_contrast(ranges) - ln_threshold @ weights
        probability = psychometric.probability(margin, np.vstack([psychometric.beta, self.betas]), weights)
        bound = np.where(frequency < knots[0], 1.0, np.where(frequency > knots[-1], -1.0, 0.0))
        return _task_curve(task, ranges, (probability[0], *self._ends(probability[1:])), bound)

    def _of_bars(self, ranges: FloatArray) -> tuple[TaskCurve, ...]:
        """Return the probabilities from the highest frequency that is resolved, N = f(contrast) · size / R."""
        contrast, ln_threshold = self.ln_contrast(ranges), self.threshold_curves()
        knots, size_m, time_s = self.curve.per_mrad, self.target.size_m, self.target.search_time_s
        # np.interp needs rising abscissae; the steps are far below the errors of measured thresholds.
        steps = 1e-12 * np.arange(knots.size)
        resolved = np.stack([np.interp(contrast, one + steps, knots) for one in ln_threshold])
        above = (contrast > ln_threshold[0, -1]) & (not self._ends_at_acuity)
        below = contrast < ln_threshold[0, 0]
        bound = np.where(above, 1.0, np.where(below, -1.0, 0.0))
        frequencies = (resolved[0], *self._ends(resolved[1:]))

        def probability(frequency: FloatArray, n50: float) -> FloatArray:
            unlimited = transfer_probability(frequency * size_m / (ranges * n50))
            return unlimited if time_s is None else with_search(unlimited, time_s)

        return tuple(
            _task_curve(
                task, ranges, [one if one is None else probability(one, n50) for one in frequencies], bound
            )
            for task, n50 in self.criteria.items()
        )

    def _ends(self, drawn: FloatArray) -> tuple[FloatArray | None, FloatArray | None]:
        if self.curve.ln_sd is None:
            return None, None
        low, high = np.quantile(drawn, (0.025, 0.975), axis=0)
        return low, high

    def against_k(self) -> tuple[RangeAtK, ...]:
        """Return k, range and 95 % interval for divisors k of a TOD at its own criterion; None off the curve."""
        curves, found = self.threshold_curves(), []
        for k in np.geomspace(1.0, 16.0, 17).tolist():
            ranges = self.crossing(k, curves)[0]
            interval = self._interval(ranges[1:])
            found.append(RangeAtK(k=k, range_km=_on_curve(float(ranges[0])), range_ci95_km=interval))
        return tuple(found)


def _task_curve(
    task: str, ranges: FloatArray, probability: Sequence[FloatArray | None], bound: FloatArray
) -> TaskCurve:
    """Return the record of a probability and the ends of its band."""
    numbers: Json = dict(zip(("probability", "low", "high"), probability, strict=True))
    numbers |= {"task": task, "range_km": ranges, "bound": bound}
    return as_read(numbers, TaskCurve)


def _on_curve(range_km: float) -> float | None:
    return range_km if 0.0 < range_km < np.inf else None


def _weights(knots: FloatArray, points: FloatArray) -> FloatArray:
    """Return the weights of knots, shape (knots, points), that interpolate linearly between them."""
    cell = np.clip(np.searchsorted(knots, points, side="right"), 1, knots.size - 1)
    share = (points - knots[cell - 1]) / (knots[cell] - knots[cell - 1])
    weights = np.zeros((knots.size, points.size))
    columns = np.arange(points.size)
    weights[cell - 1, columns] = 1.0 - share
    weights[cell, columns] = share
    return weights


def acquire(
    curve: ThresholdCurve,
    target: Target,
    atmosphere: Atmosphere,
    *,
    p: float | None = None,
    rng: np.random.Generator,
) -> Acquisition:
    """Compute ranges and probabilities for all tasks of a target, also at the probability p."""
    made = replace(_prepared(curve, target, atmosphere, rng), asked_probability=p)
    _check_probability(made)
    ranges = tuple(made.task_range(task, p) for task in made.criteria for p in made.probabilities)
    curves: tuple[TaskCurve, ...] = ()
    if made.road == "cycles" or made.curve.psychometric is not None:
        known = [one.range_km or one.at_least_km or one.at_most_km or 0.0 for one in ranges]
        known += [end for one in ranges for end in one.range_ci95_km or () if end is not None]
        most = MARGIN * max(known) or _farthest_km(made)
        curves = made.task_curves((most / PLACES, min(most, atmosphere.longest_km)))
    return replace(made, ranges=ranges, curves=curves)


def first_range(curve: ThresholdCurve, target: Target, atmosphere: Atmosphere) -> TaskRange:
    """Compute the first task's range, without interval: at 50 % or, for a TOD with k, at the curve's criterion."""
    made = _prepared(replace(curve, ln_sd=None), target, atmosphere, None)
    return made.task_range(next(iter(made.criteria)), made.own_probability)


def _prepared(
    curve: ThresholdCurve, target: Target, atmosphere: Atmosphere, rng: np.random.Generator | None
) -> Acquisition:
    """Choose the road and draw curves; the errors are those of `acquire`."""
    _check_kind(curve, target, atmosphere)
    road: Method = "cycles"
    if curve.pattern == "triangle":
        if target.cycles_per_size is not None:
            curve = curve.as_bars(target.cycles_per_size)
        elif target.k is None:
            raise SettingsError(
                f"{argument.k}: is missing, and {curve.name} is a TOD; no public value exists: give that of your "
                "task, with which the target is seen if a triangle of size / k is"
            )
        else:
            road = "tod"
    if road == "tod" and target.search_time_s is not None:
        raise SettingsError("search_time_s: is given but not used with a TOD and k, whose answers are never free")
    draws = betas = np.empty((0, curve.threshold.size))
    if curve.ln_sd is not None and rng is not None:
        errors = rng.standard_normal((DRAWS, curve.threshold.size))
        # Errors in standard deviations, those of their side.
        draws = np.log(curve.threshold) + errors * np.where(errors < 0.0, *curve.ln_sd)
        betas = betas if curve.psychometric is None else curve.psychometric.betas(errors, rng)
    made = Acquisition(target=target, atmosphere=atmosphere, curve=curve, road=road, draws=draws, betas=betas)
    if (farthest := _farthest_km(made)) < 1e-3:
        raise DataError(
            f"{curve.name}: the target of {target.size_m:g} m is smaller than the curve's smallest detail beyond "
            f"{1e3 * farthest:.2g} m, expected a larger target or a curve of finer detail"
        )
    return made


def _check_probability(made: Acquisition) -> None:
    """Raise SettingsError if the probability asked for is none, or a TOD has none but its own."""
    p, psychometric = made.asked_probability, made.curve.psychometric
    least = psychometric.guess_rate if made.road == "tod" and psychometric is not None else 0.0
    if p is None or (least < p < 1.0 and p in made.probabilities):
        return
    if least < p < 1.0:
        found = f"expected that of the thresholds, {made.own_probability}: the curve has no psychometric functions"
    else:
        found = f"expected a probability above {least:g} and below 1"
    raise SettingsError(f"{argument.p}: found {p:g}, {found}")


def _farthest_km(made: Acquisition) -> float:
    """Return the range at which the easiest task needs the curve's smallest detail."""
    return float(made.curve.per_mrad[-1]) * made.target.size_m / min(made.criteria.values())


def _check_kind(curve: ThresholdCurve, target: Target, atmosphere: Atmosphere) -> None:
    words = {"delta_t_k": "a temperature difference", "contrast": "a contrast"}
    is_thermal, name = curve.quantity == "delta_t_k", curve.name
    if curve.quantity != target.quantity:
        raise SettingsError(
            f"target: found {words[target.quantity]}, expected {words[curve.quantity]}, as the thresholds of "
            f"{name} are"
        )
    problem = ""
    if atmosphere.band_um is not None:
        low, high = atmosphere.band_um
        if (high < LEAST_THERMAL_UM) if is_thermal else (low >= LEAST_THERMAL_UM):
            problem = f"a band of {low:g} to {high:g} µm"
    if is_thermal and atmosphere.is_daylight:
        problem = "sky_to_ground_ratio or visibility_km, which are of daylight"
    if problem:
        kind = "air of a thermal band, such as a table" if is_thermal else "air of reflected light"
        raise SettingsError(f"atmosphere: found {problem}, expected {kind}, as the thresholds of {name} are")
