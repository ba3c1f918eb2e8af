"""Figures of a sweep: TOD curves, a map over two keys and the trade-off front; and the page that shows them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sensor_sim.sweeps.tables import BY_SIZE, CRITERION_UNITS, OF_RANGE, SweepData
from todframes import __version__
from todframes.base._typing import FloatArray
from todframes.base.errors import DataError
from todframes.psychometrics.threshold_search import IMPOSSIBLE
from todframes.results.figure import ReportFigure
from todframes.results.figure_style import (
    COLOURS,
    INK,
    add_colour_bar,
    add_legend,
    colour_scale,
    curve_style,
    label_text,
    plain_ticks,
)
from todframes.results.html import figure_items, render, table_item
from todframes.results.tables import records_table
from todframes.results.wording import evenly, level_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap

MOST_CURVES = 200

MOST_MAPS = 4

MOST_VECTORS = 400
"""Largest number of cells or points that a page shows as vectors; more become one picture."""

MARKS = {IMPOSSIBLE: ("////", "_"), "never_reached": ("xx", "x"), "always_exceeded": ("..", ".")}
"""Hatch of a cell, and marker of a point, without a threshold, by status."""

RANGE_MARKS = {"ok": "", "never_reached": "never_reached", "beyond_curve": "always_exceeded"}
"""Status of a threshold whose mark stands for a status of a range; others have that of an impossible design."""

LOG_SPAN = 10.0
"""Smallest ratio of the largest to the smallest value on a logarithmic axis."""


def pictures(result: SweepData) -> list[ReportFigure]:
    """List the figures of a sweep, the most important first."""
    keys, sizes = result.swept.designs.keys, result.swept.size_detectors
    found = []
    if len(result.objectives) > 1:
        note = (
            f"Grey: all designs; coloured: those that no other one beats in all of "
            f"{', '.join(one.column for one in result.objectives)}."
        )
        title = f"Trade-off at {sizes[0]:g} detectors" if result.depends_on_size else "Trade-off"
        found.append(ReportFigure(title, note, partial(draw_front, result=result, size=0), "front.png"))
    has_range = result.ranges is not None and np.isfinite(result.column(OF_RANGE, 0)).any()
    if len(varied(result)) > 1 and has_range:
        note = "Range over the first two keys that vary. Dotted: beyond the smallest size; crossed: never reached;"
        note += " hatched once: none for another reason."
        note += " The longest over the other keys." * (len(keys) > 2)
        found.append(ReportFigure("Map of range", note, partial(draw_range_map, result=result), "range_map.png"))
    if len(varied(result)) > 1:
        seen = np.flatnonzero(np.isfinite(thresholds(result)[0]).any(axis=0)).tolist()
        for size in evenly(seen, MOST_MAPS):
            note = "Threshold over the first two keys that vary. Hatched once: impossible; crossed: never reached;"
            note += " dotted: always exceeded."
            note += " The lowest over the other keys." * (len(keys) > 2)
            draw = partial(draw_map, result=result, size=size)
            found.append(
                ReportFigure(f"Map at {sizes[size]:g} detectors", note, draw, "" if size != seen[0] else "map.png")
            )
    elif varied(result):
        note = "A line for each size."
        found.append(
            ReportFigure("Threshold against the key", note, partial(draw_lines, result=result), "by_key.png")
        )
    if (np.isfinite(result.swept.threshold).sum(axis=1) > 1).any():
        note = f"Threshold against 1 / size of up to {MOST_CURVES} designs, coloured by the first key that varies."
        found.append(ReportFigure("TOD curves", note, partial(draw_curves, result=result), "tod_curves.png"))
    return found


def varied(result: SweepData) -> list[int]:
    """Return the places of the keys that have more than one value."""
    values = result.swept.designs.values
    return [place for place in range(values.shape[1]) if len(np.unique(values[:, place])) > 1]


def thresholds(result: SweepData) -> tuple[FloatArray, str]:
    """Return thresholds in mK where NETD is known for all designs, else in their level; and their heading."""
    swept = result.swept
    if np.isfinite(swept.mk_per_snr[np.isfinite(swept.pitch_mrad)]).all() and np.isfinite(swept.mk_per_snr).any():
        return swept.delta_t_mk, "threshold ΔT (mK)"
    return swept.threshold, f"threshold {level_name(swept.level)}"


def draw_curves(axes: Axes, result: SweepData) -> None:
    """Draw threshold against 1 / size of up to `MOST_CURVES` designs, coloured by the first key that varies."""
    from matplotlib.collections import LineCollection

    shown, heading = thresholds(result)
    swept = result.swept
    order = np.argsort(swept.size_detectors)[::-1]
    inverse = 1.0 / np.array(swept.size_detectors)[order]
    rows = [row for row in range(result.n_designs) if np.isfinite(shown[row]).sum() > 1]
    if not rows:
        raise DataError("plot_tod: found no design with thresholds at two or more sizes")
    rows = evenly(rows, MOST_CURVES)
    keys = varied(result)
    colour = swept.designs.values[:, keys[0] if keys else 0]
    lines = [np.stack([inverse, shown[row, order]], axis=1)[np.isfinite(shown[row, order])] for row in rows]
    drawn = LineCollection(lines, cmap=colours(), norm=colour_scale(colour), linewidths=1.0, alpha=0.8)
    drawn.set_array(colour[rows])
    axes.add_collection(drawn)
    axes.set(xscale="log", yscale="log", xlabel="1 / size (detectors⁻¹)", ylabel=heading)
    axes.autoscale_view()
    values = shown[rows]
    plain_ticks(axes.xaxis, inverse.tolist())
    plain_ticks(axes.yaxis, values[np.isfinite(values)].tolist())
    if keys:
        add_colour_bar(axes, drawn, swept.designs.keys[keys[0]])


def draw_map(axes: Axes, result: SweepData, size: int) -> None:
    """Draw thresholds at one size over the first two keys that vary: cells of a grid, or points."""
    shown, heading = thresholds(result)
    if not np.isfinite(shown[:, size]).any() and len(varied(result)) > 1:
        raise DataError("plot_map: found no threshold at this size")
    _draw_cells(axes, result, shown[:, size], [one[size] for one in result.swept.status], heading)


def draw_range_map(axes: Axes, result: SweepData) -> None:
    """Draw the range of the designs over the first two keys that vary, as `draw_map` does; the longest on top."""
    ranges = result.ranges or ()
    if not any(np.isfinite(one.range_km) for one in ranges):
        raise DataError("plot_range_map: found no range, expected a target and an atmosphere, and smaller sizes")
    status = [RANGE_MARKS.get(one.status, IMPOSSIBLE) for one in ranges]
    _draw_cells(axes, result, result.column(OF_RANGE, 0), status, "range (km)", best=-1.0)


def _draw_cells(
    axes: Axes, result: SweepData, value: FloatArray, statuses: Sequence[str], heading: str, *, best: float = 1.0
) -> None:
    """Draw a value of each design over the first two keys that vary; `best` is −1 if the highest is best."""
    keys = varied(result)
    if len(keys) < 2:
        raise DataError("plot_map: found one key that varies, expected two or more")
    x, y = result.swept.designs.values[:, keys[:2]].T
    has = np.isfinite(value)
    status = np.array(statuses, dtype=object)
    columns, at_x = np.unique(x, return_inverse=True)
    rows, at_y = np.unique(y, return_inverse=True)
    cells = np.full((len(rows), len(columns)), np.inf)
    np.minimum.at(cells, (at_y[has], at_x[has]), best * value[has])
    cells *= best
    is_grid = len(np.unique(at_y * len(columns) + at_x)) == cells.size
    _scale(axes, x, y)
    cells[np.isinf(cells)] = np.nan
    look: Any = {"cmap": "viridis", "norm": colour_scale(cells[np.isfinite(cells)] if is_grid else value[has])}
    drawn: Any
    if is_grid:
        drawn = axes.pcolormesh(edges(columns), edges(rows), cells, rasterized=cells.size > MOST_VECTORS, **look)
        axes.grid(visible=False)
        of_cell = np.full(cells.shape, "", dtype=object)
        for kind in MARKS:  # a design that is never reached counts before one that is impossible
            of_cell[at_y[status == kind], at_x[status == kind]] = kind
        for kind, (hatch, _) in MARKS.items():
            _hatch(axes, edges(columns), edges(rows), np.isnan(cells) & (of_cell == kind), hatch)
    else:
        order = np.argsort(-best * value[has])  # the best on top
        drawn = axes.scatter(
            x[has][order], y[has][order], c=value[has][order], s=16.0, linewidths=0.0, **look,
            rasterized=has.sum() > MOST_VECTORS,
        )  # fmt: skip
        for kind, (_, marker) in MARKS.items():
            is_kind = status == kind
            axes.scatter(x[is_kind], y[is_kind], marker=marker, s=16.0, color=INK, linewidths=0.8)
    names = [result.swept.designs.keys[key] for key in keys[:2]]
    axes.set(xlabel=label_text(names[0]), ylabel=label_text(names[1]))
    add_colour_bar(axes, drawn, heading)


def _hatch(axes: Axes, x: FloatArray, y: FloatArray, marked: NDArray[np.bool_], hatch: str) -> None:
    """Hatch the cells of a grid that are marked; `x` and `y` are the edges."""
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    cells = [
        Rectangle((x[column], y[row]), x[column + 1] - x[column], y[row + 1] - y[row])
        for row, column in np.argwhere(marked)
    ]
    if cells:
        look: Any = {"facecolor": "none", "edgecolor": INK, "linewidth": 0.0, "alpha": 0.5}
        axes.add_collection(PatchCollection(cells, hatch=hatch, **look))


def draw_lines(axes: Axes, result: SweepData) -> None:
    """Draw the threshold against the one key that varies, a line for each size."""
    shown, heading = thresholds(result)
    key = varied(result)[0]
    x = result.swept.designs.values[:, key]
    order = np.argsort(x)
    sizes = result.swept.size_detectors
    for place, size in enumerate(sizes):
        look = curve_style(place, len(sizes))
        axes.plot(
            x[order], shown[order, place], color=look.colour, marker=look.marker, label=f"{size:g} detectors"
        )
    axes.set(xlabel=label_text(result.swept.designs.keys[key]), ylabel=heading, yscale="log")
    if is_log(x):
        axes.set_xscale("log")
        plain_ticks(axes.xaxis, x.tolist())
    values = shown[np.isfinite(shown)]
    if values.size:
        plain_ticks(axes.yaxis, values.tolist())
    add_legend(axes)


def draw_front(axes: Axes, result: SweepData, size: int) -> None:
    """Draw all designs over the first two objectives at one size, and those on the trade-off front."""
    if len(result.objectives) < 2:
        raise DataError("plot_front: found one column, expected two or more to be low or high")
    first, second = (one.column for one in result.objectives[:2])
    x, y = result.column(second, size), result.column(first, size)
    has = np.isfinite(x) & np.isfinite(y) & result.has_threshold(size)
    is_on = result.on_front[:, size]
    axes.scatter(x[has], y[has], s=9.0, color=INK, alpha=0.25, linewidths=0.0, rasterized=has.sum() > MOST_VECTORS)
    order = np.flatnonzero(is_on)[np.argsort(x[is_on])]
    line = "-" if len(result.objectives) == 2 else ""
    axes.plot(x[order], y[order], marker="o", ls=line, color=COLOURS[4], label="trade-off front", zorder=3)
    axes.set(xlabel=_with_unit(second), ylabel=_with_unit(first))
    _scale(axes, x[has], y[has])
    add_legend(axes)


def _scale(axes: Axes, x: FloatArray, y: FloatArray) -> None:
    """Make axes logarithmic where their values are."""
    for name, values in (("x", x), ("y", y)):
        if values.size and is_log(values):
            axes.set(**{f"{name}scale": "log"})
            plain_ticks(getattr(axes, f"{name}axis"), values.tolist())


def _with_unit(column: str) -> str:
    unit = CRITERION_UNITS.get(column, "")
    name = {"delta_t_mk": "threshold ΔT", "threshold_snr": "threshold SNR"}.get(column, column.replace("_", " "))
    name = name.removesuffix(f" {unit}") if unit else name
    return label_text(f"{name} ({unit})" if unit else column if column not in BY_SIZE else name)


def colours() -> Colormap:
    """Return the colours of the house from low to high."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("designs", COLOURS)


def is_log(values: FloatArray) -> bool:
    """Return whether values are shown on a logarithmic axis: their span is large, and all are above 0."""
    return bool(values.min() > 0.0 and values.max() > LOG_SPAN * values.min())


def edges(middles: FloatArray) -> FloatArray:
    """Return the edges of cells around ascending values, half-way between them."""
    if is_log(middles):
        return np.asarray(np.exp(edges_between(np.log(middles))))
    return edges_between(middles)


def edges_between(middles: FloatArray) -> FloatArray:
    """Return the edges half-way between ascending values; the outer cells are symmetric."""
    inner = (middles[1:] + middles[:-1]) / 2.0
    return np.concatenate([[2.0 * middles[0] - inner[0]], inner, [2.0 * middles[-1] - inner[-1]]])


def page(result: SweepData) -> str:
    """Return the HTML page of a sweep: sentences, figures and the best designs; `sweep.csv` has all of them."""
    problems = result.problems()
    settings = [
        {"setting": name, "value": value} for name, value in result.settings.items() if not isinstance(value, dict)
    ]
    sensor = result.settings["sensor"]
    for table, values in sensor.items():
        if isinstance(values, dict):
            settings += [{"setting": f"{table}.{name}", "value": value} for name, value in values.items()]
    details = [records_table("Settings", "settings.csv", settings)]
    return render(
        {
            "title": "Designs of a sensor",
            "about": str(sensor["name"]),
            "warnings": [],
            "verdict": result.sentences(),
            "figures": figure_items(pictures(result)),
            "tables_shown": [table_item(one) for one in (result.best(), problems) if one is not None],
            "examples": [],
            "without": [],
            "remarks": [f"Run time {result.run_time_s:.1f} s. All designs and sizes are in sweep.csv."],
            "details": [table_item(one.folded()) for one in details],
            "version": __version__,
            "can_be_made_again": False,
        }
    )
