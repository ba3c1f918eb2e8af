"""The call `acquisition_range`, how far a person with a sensor can do a task, and its result."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct, field, structs

from todframes.base._typing import Json
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.reading import check_positive, checked
from todframes.base.safe_text import in_utf8
from todframes.base.seeds import Rng, seed_of
from todframes.field.acquisition import (
    GAIN,
    LIMITS,
    SEARCH_TIME_CONSTANT_S,
    Method,
    Numbers,
    RangeAtK,
    TaskCurve,
    TaskRange,
    acquire,
)
from todframes.field.atmosphere import Atmosphere, find_atmosphere
from todframes.field.target import Quantity, Target, chosen_target
from todframes.field.threshold_curve import Pattern, ThresholdCurve, measured_curve, read_curve
from todframes.parameters import (
    Cycles,
    CyclesPerSize,
    Distances,
    GroupValues,
    Magnification,
    NamedFile,
    Probability,
    Progress,
    Seconds,
    Seed,
    TargetFactors,
)
from todframes.results.data import ResultWarning, as_read
from todframes.results.figures import INK, ReportFigure, add_legend, curve_style, label_text, plain_ticks
from todframes.results.result import Result, load_result
from todframes.results.tables import Column, Table, records_table
from todframes.results.thresholds import Thresholds
from todframes.results.wording import interval_phrase, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FINER = {
    True: "; smaller triangles show whether finer detail is judged",
    False: "; if that is the highest frequency that the sensor resolves, its sampling limits the range",
}
"""Words about a curve that ends: of a TOD, and of bars."""

FIGURE_7 = 1.0
"""Cycles of bars in √area of a triangle that is as hard (Hogervorst et al. 2001, Figure 7)."""

CONVERTED = (
    "The TOD is taken for line pairs, {:g} in √area of a triangle (1 by Hogervorst et al. 2001, Figure 7), a "
    "convention on which the ranges depend; k or cycles_per_size states yours."
)

SENSORS = "sensor_sim.thresholds.curve"

P_CORRECT = 0.75
"""Criterion of the TOD of a sensor that is computed."""

K_IS_YOURS = "No public value of k exists: the range is as good as the k that you have validated."

NO_RANGE = {
    "never_reached": "the contrast limits it: it stays below all thresholds, however near",
    "nearer_than_curve": "the contrast limits it: at the curve's first size or frequency it does not suffice",
    "beyond_curve": "the curve ends there, and the contrast still suffices",
    "beyond_air_table": "it is farther than the table of the air ends",
}
"""Reasons for a missing range, by status."""

MOST_CURVES = 7


class CurveNumbers(Struct, frozen=True, kw_only=True):
    """The sensor's curve; `needed` is its threshold, or that of coarser detail if that is higher."""

    name: str
    pattern: Pattern
    quantity: Quantity
    per_mrad: Numbers
    threshold: Numbers
    ln_threshold_sd: tuple[Numbers, Numbers] | None
    p_correct: float | None
    needed: Numbers
    needed_ci95: tuple[Numbers, Numbers] | None


class RangeNumbers(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The key `range` of the result.

    Attributes
    ----------
    road : {"tod", "cycles"}
        Range of a TOD with k, or by line pairs.
    target, atmosphere : object
        Their settings.
    curve : CurveNumbers
    criteria : dict of float
        k, or N50 in line pairs, of each task.
    asked_probability : float or None
        Probability that sentences name.
    ranges : tuple of TaskRange
        Range for each task and probability.
    probability : tuple of TaskCurve
        Probability against range for each task.
    at_distance : tuple of TaskCurve
        Probability of each task at the distances that were asked for.
    against_k : tuple of RangeAtK
        Of a TOD whose range lies on the curve for some k.
    """

    road: Method
    target: Target
    atmosphere: Atmosphere
    curve: CurveNumbers
    criteria: dict[str, float]
    asked_probability: float | None = None
    r46_distance_m: float | None = field(default_factory=lambda: None)
    ranges: tuple[TaskRange, ...]
    probability: tuple[TaskCurve, ...]
    at_distance: tuple[TaskCurve, ...] = ()
    against_k: tuple[RangeAtK, ...] = ()


class FieldRange(Result, frozen=True, kw_only=True):
    """Range of a sensor for a target in the field.

    Attributes
    ----------
    numbers : RangeNumbers
        The key `range` of the JSON.
    """

    numbers: RangeNumbers = field(name="range")

    @property
    def name(self) -> str:
        """Return target and air in words."""
        target, air = self.numbers.target, self.numbers.atmosphere
        signal = f"ΔT {target.signal:g} K" if target.quantity == "delta_t_k" else f"contrast {target.signal:g}"
        return f"{target.title or 'target'}, {target.size_m:g} m, {signal}; {air.title or 'air'}"

    @property
    def is_tod(self) -> bool:
        """Return whether the range is that of a TOD with k."""
        return self.numbers.road == "tod"

    @property
    def probability_name(self) -> str:
        """The name of the probability."""
        return "P(correct)" if self.is_tod else "probability"

    def tables(self) -> list[Table]:
        """List the ranges; folded those against k, the probability against range, and target and air."""
        numbers, p_name = self.numbers, "P(correct)" if self.is_tod else "P"
        km = Column(key="range_km", header="range (km)")
        km_ci95 = Column(key="range_ci95_km", header="95 % interval", interval="range_ci95_km", digits=3)
        columns = [
            Column(key="task", is_name=True),
            Column(key="criterion", header="k" if self.is_tod else "N50", digits=3, rank=1),
            Column(key="probability", header=p_name, digits=3, is_name=True),
            km,
            km_ci95,
            Column(key="at_least_km", header="at least (km)", digits=3),
            Column(key="at_most_km", header="at most (km)", digits=3),
            Column(key="limited_by", header="limited by", rank=2),
            *(
                Column(key=f"gain_{name}_percent", header=f"10 % {_more(name)}", digits=2, is_detail=True)
                for name in LIMITS
            ),
            Column(key="status", is_key=True),
        ]
        records = map(structs.asdict, numbers.ranges)
        ranges = Table.of(f"Range: {self.name}", "ranges.csv", columns, records)
        tables = [ranges.without_empty_columns("probability", "range_km", "range_ci95_km")]
        if numbers.at_distance:
            rows = [
                row | {"distance_m": 1e3 * row["range_km"]} for one in numbers.at_distance for row in _rows(one)
            ]
            distance = Column(key="distance_m", header="distance (m)", digits=4)
            columns = self._probability_columns(p_name, distance)
            tables.append(
                Table.of("Probability at distances", "distances.csv", columns, rows).without_empty_columns()
            )
        if numbers.against_k:
            title, records = f"Range at {self._criterion()} against k", map(structs.asdict, numbers.against_k)
            columns = [Column(key="k", digits=3), km, km_ci95]
            tables.append(Table.of(title, "range_against_k.csv", columns, records).folded())
        if numbers.probability:
            columns = self._probability_columns(p_name, Column(key="range_km", header="range (km)", digits=3))
            rows = [row for one in numbers.probability for row in _rows(one)]
            tables.append(Table.of("Probability against range", "probability.csv", columns, rows).folded())
        values = [
            {"setting": f"{part}.{key}", "value": value}
            for part, settings in (("target", numbers.target), ("atmosphere", numbers.atmosphere))
            for key, value in asdict(settings).items()
            if value is not None and value != ""
        ]
        return [*tables, records_table("Target and air", "", values).folded()]

    @staticmethod
    def _probability_columns(p_name: str, distance: Column) -> list[Column]:
        return [
            Column(key="task", is_name=True),
            distance,
            Column(key="probability", header=p_name, digits=3),
            Column(key="probability_ci95", header="95 % interval", interval="probability_ci95", digits=3),
            Column(key="bound", header="off the curve", none=""),
        ]

    def summary_table(self) -> Table:
        """Return the part of a table of several results: the range of each task, and P at distances."""
        columns = [
            Column(key="task", is_name=True),
            Column(key="probability", header="P", digits=3, is_name=True),
            Column(key="range_km", header="range (km)"),
            Column(key="at_least_km", header="at least (km)", digits=3),
            Column(key="at_most_km", header="at most (km)", digits=3),
        ]
        at = {
            (one.task, km): p
            for one in self.numbers.at_distance
            for km, p in zip(one.range_km, one.probability, strict=True)
        }
        names = {km: f"P at {1e3 * km:g} m" for _, km in at}
        columns += [Column(key=name, header=name, digits=3) for name in names.values()]
        columns.append(Column(key="status", is_key=True))
        rows = [
            structs.asdict(one) | {name: at.get((one.task, km)) for km, name in names.items()}
            for one in self._named()
        ]
        return Table.of("", "", columns, rows)

    def findings(self) -> list[str]:
        """Return the findings in words: a range for each task, and what limits the first."""
        named, texts = self._named(), []
        for one in named:
            p = one.probability
            level = "the criterion" if p is None else f"{100 * p:g} %{' correct' * self.is_tod}"
            words = range_words(one, size_m=self.numbers.target.size_m, is_tod=self.is_tod)
            texts.append(f"At {level}, {one.task}: {words}.")
        limited = next((one for one in named if one.limited_by is not None), None)
        if limited is not None:
            contrast, resolution, air = (plain(getattr(limited, f"gain_{name}_percent"), 2) for name in LIMITS)
            texts.append(
                f"The {limited.limited_by} limits {limited.task}: {100 * GAIN:.0f} % more contrast gives "
                f"{contrast} % more range, so much more resolution {resolution} %, and so much clearer air "
                f"{air} %."
            )
        return texts

    def advice(self) -> list[str]:
        """Return the conventions on which the numbers depend."""
        numbers, target = self.numbers, self.numbers.target
        if self.is_tod:
            notes = [K_IS_YOURS]
        else:
            is_named = isinstance(target.cycles, str)
            n50 = ", ".join(f"{f'{task} ' * is_named}{value:g}" for task, value in numbers.criteria.items())
            source = target.cycles if is_named else "your own"
            notes = [f"N50: {n50} line pairs on the target ({source})."]
        if numbers.curve.ln_threshold_sd is None:
            notes.append("The curve has no errors (ci95_low, ci95_high), so the ranges have no interval.")
        if not self.is_tod and target.cycles_per_size is not None:
            notes.append(CONVERTED.format(target.cycles_per_size))
        if numbers.r46_distance_m is not None:
            distance = plain(numbers.r46_distance_m)
            notes.append(f"By its pixels alone (UN R46), the system shows the target up to {distance} m.")
        if target.search_time_s is not None:
            notes.append(f"With {target.search_time_s:g} s to search.")
        return notes

    def _named(self) -> list[TaskRange]:
        """Return the range of each task that a sentence names: at the probability asked for, by default at 50 %,
        for a TOD at its own criterion.
        """
        wanted, ranges = self.numbers.curve.p_correct if self.is_tod else 0.5, self.numbers.ranges
        if self.numbers.asked_probability is not None:
            wanted = self.numbers.asked_probability
        firsts = {one.task: one for one in reversed(ranges)}
        return [
            next((one for one in ranges if one.task == task and one.probability == wanted), first)
            for task, first in reversed(firsts.items())
        ]

    def _criterion(self) -> str:
        p_correct = self.numbers.curve.p_correct
        return "the criterion" if p_correct is None else f"{100 * p_correct:g} % correct"

    def figures(self) -> list[ReportFigure]:
        """List contrast and probability against range."""
        note = (
            "Falling: the contrast that arrives. Rising: the threshold of the detail that each task needs, within "
            "the curve's ends. A task can be done up to the cross."
        )
        figures = [ReportFigure("Contrast at the aperture", note, self._draw_crossing, "crossing.png")]
        if self.numbers.probability:
            note = "Bands: 95 %, from the errors of the curve. " * (self.numbers.curve.ln_threshold_sd is not None)
            note += "Dotted: the curve ends there, and the probability is a bound."
            title = "Probability against range"
            figures.append(ReportFigure(title, note, self._draw_probability, "probability.png"))
        return figures

    def _draw_crossing(self, axes: Axes) -> None:
        numbers = self.numbers
        curve, target, air = numbers.curve, numbers.target, numbers.atmosphere
        per_mrad, needed = np.array(curve.per_mrad), np.array(curve.needed)
        tasks = list(numbers.criteria.items())[:MOST_CURVES]
        ends = [curve.per_mrad[-1] * target.size_m / criterion for _, criterion in tasks]
        known = [one.range_km for one in numbers.ranges if one.range_km is not None]
        most = min(1.3 * max(known, default=math.inf), max(ends), air.longest_km)
        ranges = np.linspace(most / 400, most, 400)
        arriving = target.signal * np.exp(air.ln_contrast_left(ranges))
        axes.plot(ranges, arriving, color=INK, lw=1.8, label="contrast that arrives")
        values = [float(arriving[-1]), float(arriving[0])]
        for number, (task, criterion) in enumerate(tasks):
            colour = curve_style(number, len(tasks)).colour
            knots = per_mrad * target.size_m / criterion
            axes.plot(knots, needed, "o-", color=colour, markersize=3.5, label=label_text(task))
            if curve.needed_ci95 is not None:
                axes.fill_between(knots, *curve.needed_ci95, color=colour, alpha=0.2, lw=0.0)
            values += needed[knots <= most].tolist()
        for one in self._named():
            if one.range_km is not None:
                left = target.signal * np.exp(air.ln_contrast_left(one.range_km))
                axes.plot(one.range_km, left, "x", color=INK, markersize=9)
        heading = "ΔT (K)" if curve.quantity == "delta_t_k" else "contrast"
        axes.set(
            yscale="log", xlabel="range (km)", ylabel=f"{heading}, arriving and needed", xlim=(0.0, 1.03 * most)
        )
        low, high = 0.7 * min(values), min(1.5 * max(values), 10.0 * float(arriving[0]))
        axes.set_ylim(low, high)
        plain_ticks(axes.yaxis, [low, high])
        add_legend(axes)

    def _draw_probability(self, axes: Axes) -> None:
        curves = self.numbers.probability[:MOST_CURVES]
        for number, one in enumerate(curves):
            colour = curve_style(number, len(curves)).colour
            if one.low is not None and one.high is not None:
                axes.fill_between(one.range_km, one.low, one.high, color=colour, alpha=0.2, lw=0.0)
            on_curve = np.where(np.array(one.bound) == 0.0, one.probability, np.nan)
            axes.plot(one.range_km, one.probability, ":", color=colour)
            axes.plot(one.range_km, on_curve, color=colour, label=label_text(one.task))
        for level in sorted({one.probability for one in self.numbers.ranges if one.probability}):
            axes.axhline(level, color=INK, alpha=0.4, ls="--", lw=0.8)
        axes.set(ylim=(0.0, 1.02), xlabel="range (km)", ylabel=self.probability_name)
        axes.set_xlim(left=0.0)
        add_legend(axes)


def _more(limit: str) -> str:
    """Return the improvement of a factor in words."""
    return "clear air" if limit == "air" else limit


def _rows(curve: TaskCurve) -> Iterator[Json]:
    words = {0.0: None, 1.0: "at least", -1.0: "at most"}
    for k, range_km in enumerate(curve.range_km):
        ends = None if curve.low is None or curve.high is None else (curve.low[k], curve.high[k])
        yield {
            "task": curve.task,
            "range_km": range_km,
            "probability": curve.probability[k],
            "probability_ci95": ends,
            "bound": words[curve.bound[k]],
        }


def range_words(one: TaskRange, *, size_m: float, is_tod: bool) -> str:
    """Return a range in words: with its interval, or its bounds, why there is none and what to measure."""
    if one.status == "limited_by_sampling":
        return f"{plain(one.range_km)} km, limited by sampling"
    if one.range_km is not None:
        interval = "" if one.range_ci95_km is None else f" (95 % interval {interval_phrase(one.range_ci95_km)})"
        return f"{plain(one.range_km)} km{interval}"
    ends = [f"at least {plain(one.at_least_km)} km"] if one.at_least_km is not None else []
    ends += [f"at most {plain(one.at_most_km)} km"] if one.at_most_km is not None else []
    reason = NO_RANGE[one.status] + FINER[is_tod] * (one.status == "beyond_curve")
    if one.kappa is None and one.probability is not None:
        least_s = -SEARCH_TIME_CONSTANT_S * math.log1p(-one.probability)
        reason = f"it takes a search of more than {plain(least_s, 2)} s, however near; allow more time"
    if one.status == "beyond_curve" and one.at_least_km and one.at_most_km is not None and one.kappa is not None:
        per_mrad = one.kappa * math.sqrt(one.at_least_km * one.at_most_km) / size_m
        between = f"{1.0 / per_mrad:.2g} mrad" if is_tod else f"{per_mrad:.2g} cycles/mrad"
        reason = (
            "it lies between the curve's last size and the next, which no contrast reaches; measure one between, "
            f"such as {between} at the camera"
        )
    return f"{' and '.join(ends) or 'no range'}; {reason}"


@checked
def acquisition_range(
    result: Result | Path | str,
    *,
    target: Target | NamedFile,
    atmosphere: Atmosphere | NamedFile,
    k: TargetFactors | float | Mapping[str, float] | None = None,
    cycles: Cycles | float | Mapping[str, float] | None = None,
    cycles_per_size: CyclesPerSize | None = None,
    search_time_s: Seconds | None = None,
    p: Probability | None = None,
    distance_m: Distances | None = None,
    group: GroupValues | None = None,
    magnification: Magnification | None = None,
    rng: Seed | Rng = 1,
    progress: Progress | None = None,
) -> FieldRange:
    """Compute how far a person with a sensor can do a task, from its curve, and how sure that is.

    Parameters
    ----------
    result : Result or path
        SENSOR.toml, or the name of a preset such as uncooled_lwir: its TOD is computed from the acuity on. Or
        result.json of `score`, `fit` or `sensor-sim curve`, or its folder, with thresholds over sizes (a TOD); or
        a table of a TOD, MRTD or MRC: a CSV file with a column size_mrad, frequency_cyc_per_mrad or
        frequency_cyc_per_deg, one of delta_t_k, delta_t_mk, contrast, mrtd_k, mrtd_mk and mrc, and, if they are
        known, ci95_low and ci95_high.

        A `Result` is taken as well.
    target : Target or path
        Target: a TOML file, or nato, nato_daylight, person, person_daylight, face, number_plate, car, drone or
        r46.

        A `Target` is taken as well.
    atmosphere : Atmosphere or path
        Air: a TOML file, or visible, swir, mwir or lwir with _23km or _5km behind, which are examples.

        An `Atmosphere` is taken as well.
    k : float, sequence of float, or mapping of str to float, optional
        For a TOD: a task is done if a triangle of size / K is judged, in place of the target's own K.

        A mapping has a K for each task.
    cycles : str, float or mapping of str to float, optional
        N50 in line pairs on the target in place of the target's own: stanag, johnson, or numbers.

        A mapping has a number for each task.
    cycles_per_size : float, optional
        Convert a TOD to line pairs: bars with this number of cycles in √(area) of a triangle are as hard. Default:
        1 for a target without k.
    search_time_s : float, optional
        Time in s that the observer may search. Default: that of the target, or without limit.
    p : float, optional
        Probability of the task, or proportion correct of a TOD with k, that the sentences name. Default: 0.5, or
        that of the TOD's thresholds.
    distance_m : sequence of float, optional
        Distances in m at which the probability of each task is stated.
    group : mapping, optional
        The curve of the result, if it has several: the value of a column that distinguishes it, such as
        condition=clahe.
    magnification : float, optional
        Angle on the display over the angle in the field, for sizes as displayed. Default: 1.
    rng : int, SeedSequence or Generator
        Seed of the curves that are drawn from the errors.
    progress : function of two ints, optional
        Called with the share of a sensor's curve that is computed, and the whole.

    Returns
    -------
    Result
        `numbers.ranges` has a record for each task and probability.

    Raises
    ------
    DataError
        If the result or table cannot be used.
    SettingsError
        If a setting is invalid, or target and air are not of the curve's kind.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> import todframes as tod
    >>> table = pathlib.Path(tempfile.mkdtemp()) / "mrtd.csv"
    >>> text = "frequency_cyc_per_mrad,mrtd_k\\n1,0.054\\n3,0.4\\n5,2.97\\n"
    >>> _ = table.write_text(text)
    >>> found = tod.acquisition_range(table, target="nato", atmosphere=tod.Atmosphere(extinction_per_km=0.2))
    >>> [(one.task, round(one.range_km, 1)) for one in found.numbers.ranges if one.probability == 0.5]
    [('detection', 7.3), ('recognition', 3.1), ('identification', 1.6)]
    """
    started, seed = time.perf_counter(), seed_of(rng)
    chosen = chosen_target(
        target, k=k, cycles=cycles, cycles_per_size=cycles_per_size, search_time_s=search_time_s
    )
    air = find_atmosphere(atmosphere)
    p_correct = p if p is not None and chosen.k is not None else P_CORRECT
    curve, warnings = _curve(
        result, chosen, p_correct=p_correct, group=group, magnification=magnification, progress=progress
    )
    is_converted = curve.pattern == "triangle" and chosen.k is None and chosen.cycles_per_size is None
    _check_used(curve, k=k, cycles=None if is_converted else cycles, cycles_per_size=cycles_per_size)
    if is_converted:
        chosen = replace(chosen, cycles_per_size=FIGURE_7)
    for distance in distance_m or ():
        check_positive(argument.distance_m, distance)
    acquired = acquire(curve, chosen, air, p=p, rng=np.random.default_rng(seed))
    curve, needed = acquired.curve, np.exp(acquired.threshold_curves())
    against_k = acquired.against_k() if acquired.road == "tod" else ()
    numbers: Json = {
        "road": acquired.road,
        "target": chosen,
        "atmosphere": air,
        "curve": {name: getattr(curve, name) for name in CurveNumbers.__struct_fields__ if hasattr(curve, name)}
        | {
            "ln_threshold_sd": curve.ln_sd,
            "needed": needed[0],
            "needed_ci95": None if curve.ln_sd is None else np.quantile(needed[1:], (0.025, 0.975), axis=0),
        },
        "criteria": acquired.criteria,
        "asked_probability": p,
        "r46_distance_m": chosen.r46_distance_m,
        "ranges": acquired.ranges,
        "probability": acquired.curves,
        "at_distance": acquired.at_distances(sorted(set(distance_m or ()))),
        "against_k": against_k if any(one.range_km is not None for one in against_k) else (),
    }
    found = as_read(numbers, RangeNumbers)
    warnings = (*warnings, *_warnings(curve, air))
    return FieldRange.made("range", started, seed=seed, warnings=warnings, numbers=found)


def _curve(
    result: Result | Path | str,
    chosen: Target,
    *,
    p_correct: float,
    group: Mapping[str, str] | None,
    magnification: float | None,
    progress: Progress | None,
) -> tuple[ThresholdCurve, tuple[ResultWarning, ...]]:
    """Return the curve of a table, sensor or result, and the warnings about it; DataError if there is none."""
    where = "the result" if isinstance(result, Result) else in_utf8(str(result))
    if not isinstance(result, Result):
        is_preset = not (Path(where).suffix or Path(where).exists())
        sensor = result if is_preset or where.endswith(".toml") else None
        if (sensor is not None or where.endswith(".csv")) and (group or magnification is not None):
            raise SettingsError(f"{where}: is one curve in the field, expected no group and no magnification")
        if where.endswith(".csv"):
            return read_curve(Path(result)), ()
        if sensor is not None:
            return _computed_curve(sensor, chosen, p_correct=p_correct, progress=progress)
        result = load_result(result)
    if not isinstance(result, Thresholds):
        hint = "; its thresholds are in mrtd.csv, which `todframes range` reads" * (result.command == "mrtd")
        raise DataError(f"{where}: command: found {result.command!r}, expected one that gives thresholds{hint}")
    return measured_curve(result, where, quantity=chosen.quantity, group=group, magnification=magnification)


def _computed_curve(
    sensor: Path | str, chosen: Target, *, p_correct: float, progress: Progress | None
) -> tuple[ThresholdCurve, tuple[ResultWarning, ...]]:
    """Return the curve of a sensor from its acuity on. It has no psychometric functions: near the acuity
    P(correct) ends below 1.
    """
    sensors = import_module(SENSORS)  # by name: this package knows nothing of sensors
    thresholds, warnings = sensors.field_curve(sensor, p_correct=p_correct, progress=progress)
    curve, others = measured_curve(thresholds, in_utf8(str(sensor)), quantity=chosen.quantity)
    return replace(curve, psychometric=None), (*warnings, *others)


def _check_used(curve: ThresholdCurve, *, k: object, cycles: object, cycles_per_size: object) -> None:
    """Raise SettingsError if a criterion is given that the road does not use."""
    pattern = "of bars"
    unused = {"k": k, "cycles_per_size": cycles_per_size}
    if curve.pattern == "triangle":
        pattern = f"of triangles, without {argument.cycles_per_size}"
        unused = {"cycles": cycles if cycles_per_size is None else None}
    for name in (name for name, value in unused.items() if value is not None):
        raise SettingsError(f"{getattr(argument, name)}: is given but not used: {curve.name} is a curve {pattern}")


def _warnings(curve: ThresholdCurve, air: Atmosphere) -> Iterator[ResultWarning]:
    if not curve.is_rising:
        message = (
            "the curve falls somewhere towards finer detail; each threshold counts as at least that of all "
            "coarser detail"
        )
        yield ResultWarning(code="curve_not_rising", message=message)
    if air.varies_unseen and air.band_um is not None:
        low, high = air.band_um
        message = (
            f"one extinction for all ranges in {low:g} to {high:g} µm is wrong by up to a factor of 5 between 1 "
            "and 20 km; give a table of transmission over range"
        )
        yield ResultWarning(code="one_extinction", message=message)
