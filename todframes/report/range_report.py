"""The range of a sensor in the field as numbers, sentences, pictures and a page."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from todframes import __version__
from todframes.base._typing import Json
from todframes.field.acquisition import GAIN, Acquisition, KRange, TaskCurve, TaskRange
from todframes.field.threshold_curve import RangeWarning
from todframes.report.data import ResultWarning
from todframes.report.figure_style import INK, add_legend, curve_style, label_text, plain_ticks
from todframes.report.figures import ReportFigure
from todframes.report.html import figure_items, notebook_page, render, table_item
from todframes.report.result import Plotting, Result
from todframes.report.table import Column, Table
from todframes.report.tables import records_table
from todframes.report.wording import interval_phrase, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EQUATIONS = {
    "tod": "TOD(1/S) = C(R), S = size / (k R): the triangle of size / k at range R is judged as often as asked.",
    "cycles": (
        "N = f(C(R)) · size / R, f the highest frequency resolved at the contrast C(R) that arrives; P = a^γ / "
        "(1 + a^γ), γ = 2.7 + 0.7 a, a = N / N50."
    ),
}
"""Equation of each road, with R in km, size in m, angles in mrad."""

K_IS_YOURS = "No public value of k exists: the range is as good as the k that you have validated."

NO_RANGE = {
    "never_reached": "the contrast stays below all thresholds, however near",
    "nearer_than_curve": "it is nearer than the curve begins; measure larger triangles or lower frequencies",
    "beyond_curve": "it is farther than the curve ends; measure smaller triangles or higher frequencies",
    "beyond_air_table": "it is farther than the table of the air ends",
}
"""Reasons for a missing range, by status."""

LIMIT_COLUMNS = ("contrast", "resolution", "air")

MOST_CURVES = 7

ABOVE_CONTRAST = 10.0
"""Highest threshold in the figure of the crossing, divided by the contrast at the target."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeResult(Plotting):
    """Range of a sensor for a target in the field, with methods that make text, figures and files of it.

    `plot` draws the probability of each task against range, with its 95 % band.

    Attributes
    ----------
    acquired : Acquisition
        `ranges` has a record for each task and probability; `curves` the probability against range.
    facts : tuple of RangeWarning
        Facts about curve and air that make the range less certain.
    seed : int
        Seed of the curves that were drawn from the errors.
    """

    acquired: Acquisition
    facts: tuple[RangeWarning, ...]
    seed: int
    started: float = field(repr=False)

    def __repr__(self) -> str:
        return f"<Range: {' '.join(self.sentences())}>"

    @property
    def warnings(self) -> tuple[ResultWarning, ...]:
        """Facts that make the range less certain, each with a code."""
        return tuple(ResultWarning(code=one.code, message=one.message) for one in self.facts)

    @property
    def is_tod(self) -> bool:
        """Whether the range is that of a TOD with k."""
        return self.acquired.road == "tod"

    def table(self) -> Table:
        """Return the ranges, a row for each task and probability."""
        records = [_record(one) for one in self.acquired.ranges]
        columns = [
            Column(key="task", is_name=True),
            Column(key="criterion", header="k" if self.is_tod else "N50", digits=3, rank=1),
            Column(key="probability", header="P(correct)" if self.is_tod else "P", digits=3, is_name=True),
            Column(key="range_km", header="range (km)"),
            Column(key="range_ci95_km", header="95 % interval", interval="range_ci95_km", digits=3),
            Column(key="at_least_km", header="at least (km)", digits=3),
            Column(key="at_most_km", header="at most (km)", digits=3),
            Column(key="limited_by", header="limited by", rank=2),
            *(
                Column(key=f"gain_{name}_percent", header=f"10 % {_more(name)}", digits=2, is_detail=True)
                for name in LIMIT_COLUMNS
            ),
            Column(key="status"),
        ]
        table = Table.of(f"Range: {about(self.acquired)}", "ranges.csv", columns, records)
        return table.without_empty_columns("range_km", "range_ci95_km")

    def probability_table(self) -> Table:
        """Return the probability of each task against range."""
        records = [
            {"task": one.task, "range_km": range_km, "probability": p, "probability_ci95": ends, "bound": bound}
            | {"limited_by": limit}
            for one in self.acquired.curves
            for range_km, p, ends, bound, limit in _rows(one)
        ]
        columns = [
            Column(key="task", is_name=True),
            Column(key="range_km", header="range (km)", digits=3),
            Column(key="probability", header="P(correct)" if self.is_tod else "P", digits=3),
            Column(key="probability_ci95", header="95 % interval", interval="probability_ci95", digits=3),
            Column(key="bound", header="off the curve", none=""),
            Column(key="limited_by", header="limited by"),
        ]
        return Table.of("Probability against range", "probability.csv", columns, records)

    @property
    def _k_shown(self) -> list[KRange]:
        """Ranges against k; none if no k has one, or on the road of cycles."""
        found = self.acquired.against_k() if self.is_tod else []
        return found if any(km is not None for _, km, _ in found) else []

    def k_table(self) -> Table | None:
        """Return the range of a TOD at its own criterion for other values of k.

        None for a range by line pairs, and if the range lies beyond the curve for each k.
        """
        if not self._k_shown:
            return None
        records = [{"k": k, "range_km": km, "range_ci95_km": ends} for k, km, ends in self._k_shown]
        columns = [
            Column(key="k", digits=3),
            Column(key="range_km", header="range (km)"),
            Column(key="range_ci95_km", header="95 % interval", interval="range_ci95_km", digits=3),
        ]
        title = f"Range at {self._criterion()} against k"
        return Table.of(title, "range_against_k.csv", columns, records)

    def sentences(self) -> list[str]:
        """Return the findings in words: a range for each task, and the conventions on which the numbers depend."""
        found = [_sentence(one, self.is_tod) for one in self._named()]
        found.append(self._limits())
        return [*filter(None, found), *self.notes()]

    def notes(self) -> list[str]:
        """Return the conventions on which the numbers depend."""
        acquired = self.acquired
        found = [K_IS_YOURS] if self.is_tod else [f"N50: {self._criteria()}."]
        if acquired.curve.ln_sd is None:
            found.append("The curve has no errors (ci95_low, ci95_high), so the ranges have no interval.")
        if not self.is_tod and acquired.target.cycles_per_size is not None:
            found.append(
                f"The TOD was converted to line pairs: {acquired.target.cycles_per_size:g} cycles in √area, which "
                "is your convention."
            )
        if acquired.atmosphere.is_humidity_form:
            found.append(
                "The extinction from humidity is that of dstl's RET; in 8–12 µm it is 1.4 to 2 times MODTRAN's, "
                "so the range is rather longer."
            )
        distance_m = acquired.target.r46_distance_m
        if distance_m is not None:
            found.append(f"By its pixels alone (UN R46), the system shows the target up to {plain(distance_m)} m.")
        if acquired.target.search_time_s is not None:
            found.append(f"With {acquired.target.search_time_s:g} s to search.")
        return found

    def _named(self) -> list[TaskRange]:
        """Return the range of each task that a sentence names: at 50 %, for a TOD at its own criterion."""
        wanted = self.acquired.own_probability
        firsts = {one.task: one for one in reversed(self.acquired.ranges)}
        return [
            next((one for one in self.acquired.ranges if one.task == task and one.probability == wanted), first)
            for task, first in reversed(firsts.items())
        ]

    def _limits(self) -> str:
        known = [one for one in self._named() if one.gains is not None]
        if not known or known[0].gains is None:
            return ""
        one, gains = known[0], known[0].gains
        parts = ", ".join(
            f"{_more(name)} gains {plain(100 * getattr(gains, name), 2)} %" for name in LIMIT_COLUMNS
        )
        return f"What limits {one.task}: {gains.limit}. In range, {100 * GAIN:.0f} % more {parts}."

    def _criteria(self) -> str:
        cycles = self.acquired.target.cycles
        tasks = self.acquired.criteria.items()
        named = ", ".join(
            f"{task} {value:g}" if isinstance(cycles, str) else f"{value:g}" for task, value in tasks
        )
        return f"{named} line pairs on the target ({cycles if isinstance(cycles, str) else 'your own'})"

    def _criterion(self) -> str:
        p_correct = self.acquired.curve.p_correct
        return "the criterion" if p_correct is None else f"{100 * p_correct:g} % correct"

    def to_json(self) -> bytes:
        """Return one JSON object of the same form as the results of other commands, with the key `range`."""
        acquired, curve = self.acquired, self.acquired.curve
        found: Json = {
            "road": acquired.road,
            "equation": EQUATIONS[acquired.road],
            "target": asdict(acquired.target),
            "atmosphere": asdict(acquired.atmosphere),
            "curve": {
                "name": curve.name,
                "pattern": curve.pattern,
                "quantity": curve.quantity,
                "per_mrad": curve.per_mrad.tolist(),
                "threshold": curve.threshold.tolist(),
                "ln_threshold_sd": None if curve.ln_sd is None else curve.ln_sd.tolist(),
                "p_correct": curve.p_correct,
            },
            "criteria": acquired.criteria,
            "r46_distance_m": acquired.target.r46_distance_m,
            "ranges": [_record(one) for one in acquired.ranges],
            "probability": [
                one.json() | {"bound": one.bound.tolist(), "limited_by": list(one.limit)}
                for one in acquired.curves
            ],
        }
        table = self.k_table()
        if table is not None:
            found["against_k"] = [dict(one) for one in table.records]
        made: Any = Result.made("range", self.started, seed=self.seed, acquisition=found, warnings=self.warnings)
        return bytes(made.to_json())

    def draw(self, axes: Axes) -> None:
        """Draw into axes in the style that is set; `plot` sets that of all figures."""
        draw_probability(axes, acquired=self.acquired)

    def _pictures(self) -> list[ReportFigure]:
        """List the figures, the most important first."""
        found = [probability_figure(self.acquired)] if self.acquired.curves else []
        note = (
            "Falling: the contrast that arrives. Rising: the threshold of the detail that each task needs, within "
            "the curve's ends. A task can be done up to their crossing."
        )
        found.append(ReportFigure("Contrast at the aperture", note, self._draw_crossing, "crossing.png"))
        if self._k_shown:
            draw = partial(_draw_against_k, found=self._k_shown, criteria=self.acquired.criteria)
            title = f"Range at {self._criterion()} against k"
            found.append(ReportFigure(title, f"{K_IS_YOURS} Vertical: yours.", draw, "range_against_k.png"))
        return found

    def to_html(self) -> str:
        """Return one self-contained HTML page, the content of `report.html`."""
        more = [one for one in (self.k_table(), self.probability_table()) if one is not None and one.records]
        values = [
            {"setting": name, "value": value}
            for part, of in (("target", self.acquired.target), ("atmosphere", self.acquired.atmosphere))
            for name, value in ((f"{part}.{key}", value) for key, value in asdict(of).items())
            if value is not None and value != ""
        ]
        settings = records_table("Target and air", "settings.csv", values)
        content: Json = {
            "title": "Range in the field",
            "about": about(self.acquired),
            "warnings": [one.message for one in self.warnings],
            "verdict": self.sentences(),
            "figures": figure_items(self._pictures()),
            "tables_shown": [
                table_item(self.table().without_details()),
                *(table_item(one, folded=True) for one in more),
            ],
            "examples": [],
            "without": [],
            "remarks": [EQUATIONS[self.acquired.road]],
            "details": [table_item(settings, folded=True)],
            "version": __version__,
            "can_be_made_again": False,
        }
        return render(content)

    def _repr_html_(self) -> str:
        shown = [(one.figure, f"{one.title}. {one.note}") for one in self._pictures()[:1]]
        return notebook_page(self.sentences(), self.table().without_details(), shown)

    def files(self) -> dict[str, bytes]:
        """Return the content of all files by name."""
        tables = [self.table(), self.probability_table(), self.k_table()]
        return {
            **{one.file: one.csv().encode() for one in tables if one is not None and one.records},
            **{one.file: one.png() for one in self._pictures()},
            "report.html": self.to_html().encode(),
            "result.json": self.to_json(),
        }

    def _draw_crossing(self, axes: Axes) -> None:
        acquired = self.acquired
        curve, target = acquired.curve, acquired.target
        known = acquired.threshold_curves()
        tasks = list(acquired.criteria.items())[:MOST_CURVES]
        ends = [float(curve.per_mrad[-1]) * target.size_m / criterion for _, criterion in tasks]
        found = [one.range_km for one in acquired.ranges if one.range_km is not None]
        most = min(1.3 * max(found), max(ends)) if found else max(ends)
        most = min(most, acquired.atmosphere.longest_km)
        ranges = np.linspace(most / 400, most, 400)
        arriving = np.exp(acquired.ln_contrast(ranges))
        axes.plot(ranges, arriving, color=INK, lw=1.8, label="contrast that arrives")
        values = [float(arriving[-1]), float(arriving[0])]
        for number, (task, criterion) in enumerate(tasks):
            colour = curve_style(number, len(tasks)).colour
            knots = curve.per_mrad * target.size_m / criterion
            axes.plot(knots, np.exp(known[0]), "o-", color=colour, markersize=3.5, label=label_text(task))
            if curve.ln_sd is not None:
                low, high = np.exp(np.quantile(known[1:], (0.025, 0.975), axis=0))
                axes.fill_between(knots, low, high, color=colour, alpha=0.2, lw=0.0)
            values += np.exp(known[0][knots <= most]).tolist()
        heading = "ΔT (K)" if curve.quantity == "delta_t_k" else "contrast"
        axes.set(yscale="log", xlabel="range (km)", ylabel=f"{heading}, arriving and needed", xlim=(0.0, most))
        low, high = 0.7 * min(values), min(1.5 * max(values), ABOVE_CONTRAST * float(arriving[0]))
        axes.set_ylim(low, high)
        plain_ticks(axes.yaxis, [low, high])
        add_legend(axes)


def about(acquired: Acquisition) -> str:
    """Return target and air in words."""
    target, air = acquired.target, acquired.atmosphere
    signal = f"ΔT {target.signal:g} K" if target.quantity == "delta_t_k" else f"contrast {target.signal:g}"
    return f"{target.title or 'target'}, {target.size_m:g} m, {signal}; {air.title or 'air'}"


def probability_axis(acquired: Acquisition) -> str:
    """Return the name of the probability."""
    return "P(correct)" if acquired.road == "tod" else "probability"


def probability_figure(acquired: Acquisition) -> ReportFigure:
    """Return the figure of the probability of each task against range."""
    note = "Bands: 95 %, from the errors of the curve. " * (acquired.curve.ln_sd is not None)
    note += "Dotted: the curve ends there, and the probability is a bound."
    draw = partial(draw_probability, acquired=acquired)
    return ReportFigure("Probability against range", note, draw, "probability.png")


def draw_probability(axes: Axes, *, acquired: Acquisition) -> None:
    """Draw the probability of each task against range, with its band."""
    curves = acquired.curves[:MOST_CURVES]
    for number, one in enumerate(curves):
        colour = curve_style(number, len(curves)).colour
        if one.low is not None and one.high is not None:
            axes.fill_between(one.range_km, one.low, one.high, color=colour, alpha=0.2, lw=0.0)
        on_curve = np.where(one.bound == 0.0, one.probability, np.nan)
        axes.plot(one.range_km, one.probability, ":", color=colour)
        axes.plot(one.range_km, on_curve, color=colour, label=label_text(one.task))
    for level in acquired.probabilities:
        axes.axhline(level, color=INK, alpha=0.4, ls="--", lw=0.8)
    axes.set(ylim=(0.0, 1.02), xlabel="range (km)", ylabel=probability_axis(acquired))
    axes.set_xlim(left=0.0)
    add_legend(axes)


def _draw_against_k(axes: Axes, found: list[KRange], criteria: dict[str, float]) -> None:
    known = [(k, km, ends) for k, km, ends in found if km is not None]
    axes.plot([k for k, _, _ in known], [km for _, km, _ in known], color=curve_style(0, 1).colour)
    banded = [(k, *ends) for k, _, ends in known if ends is not None and None not in ends]
    if banded:
        k, low, high = zip(*banded, strict=True)
        axes.fill_between(k, low, high, color=curve_style(0, 1).colour, alpha=0.2, lw=0.0)
    for value in criteria.values():
        axes.axvline(value, color=INK, alpha=0.5, ls="--", lw=0.8)
    axes.set(xlabel="k", ylabel="range (km)")
    if known:
        axes.set(xscale="log", yscale="log")
        plain_ticks(axes.xaxis, [k for k, _, _ in known])
        plain_ticks(axes.yaxis, [km for _, km, _ in known])


def _more(limit: str) -> str:
    """Return the improvement of a factor in words."""
    return "clear air" if limit == "air" else limit


def _record(one: TaskRange) -> Json:
    gains = {
        f"gain_{name}_percent": None if one.gains is None else 100.0 * getattr(one.gains, name)
        for name in LIMIT_COLUMNS
    }
    values = one._asdict()
    del values["gains"]
    return values | {"limited_by": None if one.gains is None else one.gains.limit} | gains


def _rows(one: TaskCurve) -> Iterator[tuple[float, float, tuple[float, float] | None, str | None, str]]:
    words = {0.0: None, 1.0: "at least", -1.0: "at most"}
    for place, (range_km, p) in enumerate(zip(one.range_km.tolist(), one.probability.tolist(), strict=True)):
        ends = None if one.low is None or one.high is None else (float(one.low[place]), float(one.high[place]))
        yield range_km, p, ends, words[float(one.bound[place])], one.limit[place]


def range_words(one: TaskRange) -> str:
    """Return a range with its interval, or its bounds and why there is none, in words."""
    if one.range_km is not None:
        interval = "" if one.range_ci95_km is None else f" (95 % interval {interval_phrase(one.range_ci95_km)})"
        return f"{plain(one.range_km)} km{interval}"
    ends = [f"at least {plain(one.at_least_km)} km"] if one.at_least_km is not None else []
    ends += [f"at most {plain(one.at_most_km)} km"] if one.at_most_km is not None else []
    reason = NO_RANGE[one.status]
    if one.status == "beyond_curve" and one.at_most_km is not None:
        reason = (
            "it lies between the curve's last size and the next, which no contrast reaches; measure sizes between"
        )
    return f"{' and '.join(ends) or 'no range'}; {reason}"


def _sentence(one: TaskRange, is_tod: bool) -> str:
    level = f"{100 * one.probability:g} %" if math.isfinite(one.probability) else "the criterion"
    level = f"{level} correct" if is_tod and math.isfinite(one.probability) else level
    return f"At {level}, {one.task}: {range_words(one)}."
