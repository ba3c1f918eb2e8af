"""The picture of a comparison: thresholds of each algorithm, and their ratios to the reference's."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from todframes.figure_style import label_text, plain_ticks
from todframes.plots import group_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Json = dict[str, Any]

WIDTH = 0.8
"""Of all algorithms of a group together; groups are 1 apart."""
WIDEST_IN = 40.0
"""Of the picture, however many points it has."""


def compare_plot(algorithms: Sequence[Json]) -> bytes:
    """PNG: thresholds above, ratios below, groups side by side; from `algorithm_objects`."""
    from matplotlib.figure import Figure

    groups = [group_label(fit["group"]) or "all trials" for fit in algorithms[0]["fits"]]
    width = min(max(6.4, 1.6 + 0.25 * len(groups) * len(algorithms)), WIDEST_IN)
    figure = Figure(figsize=(width, 6.4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    for number, one in enumerate(algorithms):
        places = [group + WIDTH * ((number + 0.5) / len(algorithms) - 0.5) for group in range(len(groups))]
        colour = "0.35" if number == 0 else f"C{(number - 1) % 10}"
        fits, ratios = one["fits"], one["ratios"]
        _draw(above, places, [fit["threshold"] for fit in fits], [fit["threshold_ci95"] for fit in fits], colour)
        _draw(below, places, [r["ratio"] for r in ratios], [r["ratio_ci95"] for r in ratios], colour)
        above.plot([], [], "o", color=colour, label=label_text(one["name"]))
        for place, fit in zip(places, fits, strict=True):
            side = {"never_reached": (0.97, "^"), "always_exceeded": (0.03, "v")}.get(fit["status"])
            if side is not None:
                above.plot(
                    place, side[0], side[1], color=colour, transform=above.get_xaxis_transform(), clip_on=False
                )
    below.axhline(1.0, color="0.35", lw=0.8)
    above.set(ylabel=label_text(f"threshold {algorithms[0]['fits'][0]['level']}"), title="Thresholds")
    below.set(ylabel="ratio to the reference", title="Below 1: the algorithm helps")
    below.set_xticks(range(len(groups)), [label_text(group) for group in groups])
    for axes in (above, below):
        axes.set_yscale("log")
        axes.grid(True, axis="y", which="both", alpha=0.25)
        plain_ticks(axes.yaxis, axes.get_ylim())
    figure.legend(loc="outside right upper", fontsize="small")
    buffer = io.BytesIO()
    # No software version among the attributes: the same result gives the same bytes.
    figure.savefig(buffer, format="png", dpi=144, metadata={"Software": None})
    return buffer.getvalue()


def _draw(
    axes: Axes, places: Sequence[float], values: Sequence[float | None], bounds: Sequence[Any], colour: str
) -> None:
    """Points with their intervals; an open end goes to the edge of the picture."""
    for place, value, interval in zip(places, values, bounds, strict=False):
        if value is not None:
            axes.plot(place, value, "o", color=colour, markersize=5)
            low, high = interval or (value, value)
            if low is not None and high is not None:
                axes.plot([place, place], [low, high], "-", color=colour, lw=1.5)
            else:
                axes.plot(place, value, "o", color=colour, markersize=5, markerfacecolor="white")
