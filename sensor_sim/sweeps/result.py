"""The result of a sweep: thresholds of many designs of a sensor, as tables, sentences, figures and files."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sensor_sim.chain.vary import NETD_HELD
from sensor_sim.sweeps.designs import NAME_COLUMN
from sensor_sim.sweeps.goals import (
    BY_SIZE,
    OF_ACUITY,
    OF_RANGE,
    has_threshold,
    heading,
    in_words,
    phrase,
)
from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, argument
from todframes.psychometrics.threshold_search import IMPOSSIBLE
from todframes.results.figures import (
    COLOURS,
    INK,
    ReportFigure,
    add_colour_bar,
    add_legend,
    colour_scale,
    curve_style,
    drawn,
    plain_ticks,
)
from todframes.results.result import Result
from todframes.results.tables import Column, Table
from todframes.results.wording import count, listed, plain, subsample

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ROWS_SHOWN = 20
"""Largest number of designs in the table for the terminal and the page."""

MOST_CURVES = 200

MOST_MAPS = 4

MOST_VECTORS = 400
"""Largest number of cells or points that a page shows as vectors; more become one picture."""

MARKS = {IMPOSSIBLE: "_", "never_reached": "x", "always_exceeded": "."}
"""Marker of a design without a threshold, by status."""

SIDES_PT, MAP_PT = (4.0, 24.0), 180.0
"""Smallest and largest side of a design on a map, and of a grid of designs, in points."""

RANGE_MARKS = {
    "ok": "",
    "limited_by_sampling": "",
    "never_reached": "never_reached",
    "beyond_curve": "always_exceeded",
}
"""Status of a threshold whose mark stands for a status of a range; others have that of an impossible design."""

LOG_SPAN = 10.0
"""Smallest ratio of the largest to the smallest value on a logarithmic axis."""


class Sweep(Result, frozen=True, kw_only=True):
    """Thresholds of many designs of a sensor.

    Attributes
    ----------
    columns : dict of list
        Columns of `sweep.csv`: each has a value for each design and size, those of a design together; None where
        there is none.
    keys : tuple of str
        Keys that the designs differ in, which are columns.
    n_designs : int
        Number of designs, impossible ones included.
    n_computed : int
        Number of thresholds that were computed; designs that differ in noise alone have theirs in common.
    from_store : int
        Number of thresholds that an earlier, interrupted run had computed.
    holds_netd : bool
        Whether the light on a detector differs between the designs, but not their NETD.
    """

    columns: dict[str, list[Any]]
    keys: tuple[str, ...]
    n_designs: int
    n_computed: int
    from_store: int = 0
    holds_netd: bool = False

    @property
    def name(self) -> str:
        """Return the sensor's name."""
        return str(self.settings["sensor"]["name"])

    @property
    def sizes(self) -> list[float]:
        """Sizes in detectors."""
        return list(self.settings["size_detectors"])

    @property
    def objectives(self) -> dict[str, int]:
        """Columns of the trade-off front, 1 if one is to be low and −1 if high; the first orders the designs."""
        return dict.fromkeys(self.settings["minimise"], 1) | dict.fromkeys(self.settings["maximise"], -1)

    @property
    def threshold_column(self) -> str:
        """The column of the thresholds that figures and tables show."""
        return next(column for column in reversed(BY_SIZE) if column in self.columns)

    def column(self, name: str) -> NDArray[Any]:
        """Return the values of a column for each design and size; numbers have NaN where there is none."""
        values = self.columns[name]
        is_text = any(isinstance(value, str) for value in values)
        return np.array(values, object if is_text else np.float64).reshape(self.n_designs, -1)

    @cached_property
    def values(self) -> FloatArray:
        """Values of the keys: (designs, keys)."""
        return np.stack([self.column(key)[:, 0] for key in self.keys], axis=1)

    @cached_property
    def on_front(self) -> NDArray[np.bool_]:
        """Mask of the designs on the trade-off front at each size: (designs, sizes)."""
        return self.column("on_front") > 0.0

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """Mask of the thresholds found: (designs, sizes)."""
        known: NDArray[np.bool_] = np.isfinite(self.column(self.threshold_column))
        return known

    @property
    def has_threshold(self) -> NDArray[np.bool_]:
        """Mask of the designs that are compared at each size: (designs, sizes)."""
        return has_threshold(self.known, self.objectives)

    @property
    def at_size(self) -> str:
        """The first size, at which designs are ordered if a column of the front has a value for each."""
        return f" at {self.sizes[0]:g} detectors" if set(BY_SIZE) & self.objectives.keys() else ""

    def records(self) -> Iterator[dict[str, Any]]:
        """Yield a record for each design and size, with the design's values in each."""
        return (dict(zip(self.columns, row, strict=True)) for row in zip(*self.columns.values(), strict=True))

    def table(self) -> Table:
        """Return the table of all designs: a row for each design and size."""
        return Table.of("All designs and sizes", "sweep.csv", self.columns, self.records())

    def tables(self) -> list[Table]:
        """List the best designs and the thresholds that there are not."""
        return [table for table in (self.best(), self.problems()) if table is not None]

    def data_files(self) -> dict[str, bytes]:
        """Return the table of all designs beside the others."""
        return {**super().data_files(), "sweep.csv": self.table().csv().encode()}

    def best(self) -> Table | None:
        """Return the table of the designs on the trade-off front at the first size, or of the best ones, if any.

        Each design has one row, with its thresholds at all sizes.
        """
        (first, sign), sizes = next(iter(self.objectives.items())), self.sizes
        cost = sign * self.column(first)[:, 0]
        is_front = len(self.objectives) > 1
        rows = np.flatnonzero(self.on_front[:, 0] if is_front else np.isfinite(cost) & self.has_threshold[:, 0])
        rows = rows[np.argsort(cost[rows], kind="stable")]
        if not len(rows):
            return None
        title = f"{'Trade-off front' if is_front else 'Best designs'}{self.at_size}"
        if len(rows) > ROWS_SHOWN:
            title += f": the first {ROWS_SHOWN} of {len(rows)}"
        # A narrow terminal first drops the larger sizes; what is varied stays.
        columns = [Column(key="design")]
        columns += [Column(key=NAME_COLUMN, rank=3)] if NAME_COLUMN in self.columns else []
        columns += [Column(key=key, header=heading(key)) for key in self.keys]
        columns += [Column(key="netd_mk", header="NETD (mK)")] if "netd_mk" in self.columns else []
        unit = {"threshold_snr": "SNR", "delta_t_mk": "mK"}.get(self.threshold_column, "contrast")
        columns += [
            Column(key=f"at_{number}", header=f"{unit} at {size:g}", rank=min(number, 2))
            for number, size in enumerate(sizes)
        ]
        columns += [Column(key=key, header=heading(key), rank=1) for key in OF_ACUITY if key in self.columns]
        if OF_RANGE in self.columns:
            columns += [
                Column(key=OF_RANGE, header=heading(OF_RANGE)),
                Column(key="range_status", rank=2, is_key=True),
            ]
        thresholds, n = self.columns[self.threshold_column], len(sizes)
        of_design = [column.key for column in columns if column.key in self.columns]
        records = [
            {key: self.columns[key][row * n] for key in of_design}
            | {f"at_{number}": thresholds[row * n + number] for number in range(n)}
            for row in rows[:ROWS_SHOWN].tolist()
        ]
        return Table.of(title, "best.csv", columns, records)

    def problems(self) -> Table | None:
        """Return the table of statuses other than "ok" with their reasons, by frequency; None if all are "ok"."""
        designs: dict[tuple[str, str | None], list[int]] = {}
        for design, *pair in zip(*(self.columns[key] for key in ("design", "status", "reason")), strict=True):
            if pair[0] != "ok":
                designs.setdefault((pair[0], pair[1]), []).append(design)
        if not designs:
            return None
        records = [
            {"status": pair[0], "thresholds": len(numbers), "first_design": numbers[0], "reason": pair[1]}
            for pair, numbers in sorted(designs.items(), key=lambda item: -len(item[1]))[:ROWS_SHOWN]
        ]
        columns = [
            Column(key="status", is_key=True),
            Column(key="thresholds"),
            Column(key="first_design"),
            Column(key="reason", wraps=True),
        ]
        table = Table.of("Designs and sizes without a threshold", "problems.csv", columns, records)
        return table.without_empty_columns()

    def findings(self) -> list[str]:
        """Return the findings in words, the best design first."""
        known = self.known
        texts = [self._answer()]
        if len(self.objectives) > 1:
            names = listed(
                f"{'low' if sign > 0 else 'high'} {in_words(name)[0]}" for name, sign in self.objectives.items()
            )
            number = int(self.on_front[:, 0].sum())
            texts.append(f"{count(number, 'design')} on the trade-off front of {names}.")
        texts.append(
            f"{count(self.n_designs, 'design')} at {count(known.shape[1], 'size')}: {int(known.sum())} of "
            f"{known.size} thresholds found, from {count(self.n_computed, 'computation')}."
        )
        impossible = np.flatnonzero(self.column("status")[:, 0] == IMPOSSIBLE)
        if impossible.size:
            why = f"design {impossible[0] + 1}: {self.column('reason')[impossible[0], 0]}"
            texts.append(f"{count(impossible.size, 'design')} cannot be made or computed; the first is {why}.")
        beyond = self.column("range_at_least_km")[:, 0] if OF_RANGE in self.columns else np.empty(0)
        beyond = beyond[np.isfinite(beyond)]
        if beyond.size:
            texts.append(
                f"The range of {count(beyond.size, 'design')} is beyond the smallest size, at "
                f"{plain(float(beyond.max()))} km or more; add smaller sizes."
            )
        if self.holds_netd:
            texts.append(NETD_HELD.format(argument.couple_netd))
        return texts

    def _answer(self) -> str:
        """Return the sentence about the design that is best by the first objective, or why there is none."""
        name, sign = next(iter(self.objectives.items()))
        values = self.column(name)[:, 0]
        cost = np.where(self.has_threshold[:, 0], sign * values, np.nan)
        words, unit = in_words(name)
        if not np.isfinite(cost).any():
            if not self.at_size:
                return f"No design has a value of {words}, by which designs are ordered."
            advice = "take larger sizes"
            if self.known.any():
                others = listed(f"{size:g}" for size in np.array(self.sizes)[self.known.any(axis=0)].tolist())
                advice = f"there is one at {others} detectors: name such a size first"
            return f"No design has a {words}{self.at_size}, which orders designs; {advice}."
        row = int(np.nanargmin(cost))
        of_design = ", ".join(map(phrase, self.keys, self.values[row].tolist()))
        end = "lowest" if sign > 0 else "highest"
        value = f"{plain(float(values[row]))} {unit}".rstrip()
        return f"Design {row + 1} ({of_design}) has the {end} {words}{self.at_size}: {value}."

    def figures(self) -> list[ReportFigure]:
        """List the figures, the most important first."""
        names = [in_words(self.keys[number])[0] for number in varied(self)]
        others = len(names) > 2
        figures = []
        if len(self.objectives) > 1:
            note = (
                f"Grey: all designs; coloured: those that no other one beats in all of "
                f"{listed(in_words(name)[0] for name in self.objectives)}."
            )
            draw = partial(draw_front, result=self, size=0)
            figures.append(ReportFigure(f"Trade-off{self.at_size}", note, draw, "front.png"))
        if len(names) > 1 and OF_RANGE in self.columns and np.isfinite(self.column(OF_RANGE)).any():
            note = (
                f"Range over {names[0]} and {names[1]}. Dots: beyond the smallest size; crosses: never reached;"
                " dashes: none for another reason." + " The longest over the others that vary." * others
            )
            figures.append(
                ReportFigure("Map of range", note, partial(draw_range_map, result=self), "range_map.png")
            )
        if len(names) > 1:
            seen = np.flatnonzero(self.known.any(axis=0)).tolist()
            note = (
                f"Threshold over {names[0]} and {names[1]}. Dashes: impossible; crosses: never reached;"
                " dots: always exceeded." + " The lowest over the others that vary." * others
            )
            for size in subsample(seen, MOST_MAPS):
                draw = partial(draw_map, result=self, size=size)
                file = "map.png" if size == seen[0] else ""
                figures.append(ReportFigure(f"Map at {self.sizes[size]:g} detectors", note, draw, file))
        elif names:
            draw = partial(draw_lines, result=self)
            figures.append(
                ReportFigure(f"Threshold against {names[0]}", "A line for each size.", draw, "by_key.png")
            )
        if (self.known.sum(axis=1) > 1).any():
            note = f"Threshold against 1 / size of up to {MOST_CURVES} designs"
            note += f", coloured by {names[0]}." if names else "."
            figures.append(ReportFigure("TOD curves", note, partial(draw_curves, result=self), "tod_curves.png"))
        return figures

    def plot_tod(self, ax: Axes | None = None) -> Axes:
        """Draw the TOD curves of the designs, coloured by the first varied key; returns the axes."""
        return drawn(lambda axes: draw_curves(axes, self), ax)

    def plot_map(self, size: int = 0, ax: Axes | None = None) -> Axes:
        """Draw the thresholds over the first two varied keys, at one size by its place; returns the axes."""
        return drawn(lambda axes: draw_map(axes, self, size), ax)

    def plot_range_map(self, ax: Axes | None = None) -> Axes:
        """Draw the range over the first two varied keys; returns the axes."""
        return drawn(lambda axes: draw_range_map(axes, self), ax)

    def plot_front(self, size: int = 0, ax: Axes | None = None) -> Axes:
        """Draw all designs over the first two objectives, and their trade-off front; returns the axes."""
        return drawn(lambda axes: draw_front(axes, self, size), ax)


def varied(result: Sweep) -> list[int]:
    """Return the places of the keys that have more than one value."""
    values = result.values
    return [column for column in range(values.shape[1]) if len(np.unique(values[:, column])) > 1]


def draw_curves(axes: Axes, result: Sweep) -> None:
    """Draw threshold against 1 / size of up to `MOST_CURVES` designs, coloured by the first key that varies."""
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LinearSegmentedColormap

    shown = result.column(result.threshold_column)
    order = np.argsort(result.sizes)[::-1]
    inverse = 1.0 / np.array(result.sizes)[order]
    rows = [row for row in range(result.n_designs) if np.isfinite(shown[row]).sum() > 1]
    if not rows:
        raise DataError("plot_tod: found no design with thresholds at two or more sizes")
    rows = subsample(rows, MOST_CURVES)
    keys = varied(result)
    colour = result.values[:, keys[0] if keys else 0]
    lines = [np.stack([inverse, shown[row, order]], axis=1)[np.isfinite(shown[row, order])] for row in rows]
    colours = LinearSegmentedColormap.from_list("designs", COLOURS)
    drawn = LineCollection(lines, cmap=colours, norm=colour_scale(colour), linewidths=1.0, alpha=0.8)
    drawn.set_array(colour[rows])
    axes.add_collection(drawn)
    axes.set(xscale="log", yscale="log", xlabel="1 / size (detectors⁻¹)", ylabel=heading(result.threshold_column))
    axes.autoscale_view()
    values = shown[rows]
    plain_ticks(axes.xaxis, inverse.tolist())
    plain_ticks(axes.yaxis, values[np.isfinite(values)].tolist())
    if keys:
        add_colour_bar(axes, drawn, heading(result.keys[keys[0]]))


def draw_map(axes: Axes, result: Sweep, size: int) -> None:
    """Draw thresholds at one size over the first two keys that vary."""
    shown = result.column(result.threshold_column)
    if not np.isfinite(shown[:, size]).any() and len(varied(result)) > 1:
        raise DataError("plot_map: found no threshold at this size")
    _draw_values(axes, result, shown[:, size], result.column("status")[:, size], heading(result.threshold_column))


def draw_range_map(axes: Axes, result: Sweep) -> None:
    """Draw the range of the designs over the first two keys that vary, as `draw_map` does; the longest on top."""
    values = result.column(OF_RANGE)[:, 0] if OF_RANGE in result.columns else np.empty(0)
    if not np.isfinite(values).any():
        raise DataError("plot_range_map: found no range, expected a target and an atmosphere, and smaller sizes")
    statuses = [RANGE_MARKS.get(status, IMPOSSIBLE) for status in result.column("range_status")[:, 0]]
    _draw_values(axes, result, values, np.array(statuses, object), heading(OF_RANGE), best=-1.0)


def _draw_values(
    axes: Axes, result: Sweep, value: FloatArray, status: NDArray[Any], label: str, *, best: float = 1.0
) -> None:
    """Draw a value of each design over the first two keys that vary; `best` is −1 if the highest is best."""
    keys = varied(result)
    if len(keys) < 2:
        raise DataError("plot_map: found one key that varies, expected two or more")
    x, y = result.values[:, keys[:2]].T
    _scale(axes, x, y)
    known = np.flatnonzero(np.isfinite(value))
    known = known[np.argsort(-best * value[known])]  # the best on top
    side = np.clip(MAP_PT / max(len(np.unique(x)), len(np.unique(y))), *SIDES_PT)
    look: Any = {"cmap": "viridis", "norm": colour_scale(value[known]), "rasterized": len(known) > MOST_VECTORS}
    drawn = axes.scatter(x[known], y[known], c=value[known], s=side**2, marker="s", linewidths=0.0, **look)
    for kind, marker in MARKS.items():
        is_kind = status == kind
        axes.scatter(x[is_kind], y[is_kind], marker=marker, s=16.0, color=INK, linewidths=0.8)
    across, up = (heading(result.keys[key]) for key in keys[:2])
    axes.set(xlabel=across, ylabel=up)
    axes.margins(0.1)
    add_colour_bar(axes, drawn, label)


def draw_lines(axes: Axes, result: Sweep) -> None:
    """Draw the threshold against the one key that varies, a line for each size."""
    shown = result.column(result.threshold_column)
    key = varied(result)[0]
    x = result.values[:, key]
    order = np.argsort(x)
    sizes = result.sizes
    for number, size in enumerate(sizes):
        look = curve_style(number, len(sizes))
        axes.plot(
            x[order], shown[order, number], color=look.colour, marker=look.marker, label=f"{size:g} detectors"
        )
    axes.set(xlabel=heading(result.keys[key]), ylabel=heading(result.threshold_column), yscale="log")
    if is_log(x):
        axes.set_xscale("log")
        plain_ticks(axes.xaxis, x.tolist())
    values = shown[np.isfinite(shown)]
    if values.size:
        plain_ticks(axes.yaxis, values.tolist())
    add_legend(axes)


def draw_front(axes: Axes, result: Sweep, size: int) -> None:
    """Draw all designs over the first two objectives at one size, and those on the trade-off front."""
    if len(result.objectives) < 2:
        raise DataError("plot_front: found one column, expected two or more to be low or high")
    first, second, *_ = result.objectives
    x, y = result.column(second)[:, size], result.column(first)[:, size]
    has = np.isfinite(x) & np.isfinite(y) & result.has_threshold[:, size]
    is_on = result.on_front[:, size]
    axes.scatter(x[has], y[has], s=9.0, color=INK, alpha=0.25, linewidths=0.0, rasterized=has.sum() > MOST_VECTORS)
    order = np.flatnonzero(is_on)[np.argsort(x[is_on])]
    line = "-" if len(result.objectives) == 2 else ""
    axes.plot(x[order], y[order], marker="o", ls=line, color=COLOURS[4], label="trade-off front", zorder=3)
    axes.set(xlabel=heading(second), ylabel=heading(first))
    _scale(axes, x[has], y[has])
    add_legend(axes)


def _scale(axes: Axes, x: FloatArray, y: FloatArray) -> None:
    """Make axes logarithmic where their values are."""
    for name, values in (("x", x), ("y", y)):
        if values.size and is_log(values):
            axes.set(**{f"{name}scale": "log"})
            plain_ticks(getattr(axes, f"{name}axis"), values.tolist())


def is_log(values: FloatArray) -> bool:
    """Return whether values are shown on a logarithmic axis: their span is large, and all are above 0."""
    return bool(values.min() > 0.0 and values.max() > LOG_SPAN * values.min())
