"""Pictures of error against run time, one a scene."""

from __future__ import annotations

import io
import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Json = dict[str, Any]

COLOURS = {
    "literal": "0.35",
    "folded": "C1",
    "expected": "C2",
    "closed_form_coarse": "C9",
    "closed_form": "C0",
}
MARKERS = {"literal": "s", "folded": "^", "expected": "v", "closed_form_coarse": "D", "closed_form": "o"}
BOX = {"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8}
TOP = 0.7


def scene_picture(scene: Json) -> bytes:
    """PNG of one scene of `accuracy.json`: threshold error against CPU time, a line an estimator.

    Dashed lines are extrapolated along 1/√N; arrows tell how many times less CPU the fastest closed form takes
    than the literal Monte Carlo at equal error. What lies in grey is below the error of the converged value.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator

    figure = Figure(figsize=(6.8, 4.6), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xscale="log", yscale="log")
    for estimator in scene["estimators"]:
        _draw(axes, estimator)
    errors = [point["threshold_error"] for one in scene["estimators"] for point in one["points"]]
    bottom = max(min([*errors, 1e-3]) / 2.0, 1e-7)
    bound = scene["threshold_bound"] / scene["threshold"]
    if bound > bottom:
        axes.axhspan(bottom, bound, color="0.93", lw=0.0, zorder=0)
    low, high = axes.get_xlim()
    axes.set(xlim=(low, high), ylim=(bottom, TOP))
    for ratio in scene["speed_ratios"]:
        _draw_ratio(axes, scene, ratio)
    model = scene["p_correct_error_bound"] / scene["slope"]
    if bottom < model < TOP:
        axes.axhline(model, color="C3", ls=":", lw=1.0, zorder=1)
        text = "bound: noise not Gaussian "
        axes.annotate(text, (high, model), fontsize="x-small", color="C3", ha="right", va="bottom", bbox=BOX)
    axes.xaxis.set_major_locator(LogLocator(numticks=20))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _seconds(value)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100.0 * value:g} %"))
    axes.set(xlabel="CPU time, set-up included", ylabel=f"error of the threshold {scene['level']}")
    axes.set_title(scene["title"], fontsize="medium")
    axes.grid(alpha=0.2)
    axes.legend(fontsize="small", loc="upper right", framealpha=1.0, edgecolor="none")
    buffer = io.BytesIO()
    # No software version among the attributes: the same result gives the same bytes.
    figure.savefig(buffer, format="png", dpi=90, metadata={"Software": None})
    return buffer.getvalue()


def _draw(axes: Axes, estimator: Json) -> None:
    points = estimator["points"]
    colour = COLOURS.get(estimator["name"], "C4")
    style: Json = {"color": colour, "marker": MARKERS.get(estimator["name"], "D"), "ms": 4.0, "lw": 1.4}
    if estimator["name"] == "closed_form":
        style |= {"ms": 5.5, "lw": 2.2, "zorder": 3}
    x = [point["cpu_s"] for point in points]
    y = [point["threshold_error"] for point in points]
    axes.plot(x, y, label=estimator["label"], **style)
    for point in points:
        if point["repeats"] > 1:
            # The standard error of a root mean square over so many.
            factor = 1.0 + 1.0 / math.sqrt(2.0 * point["repeats"])
            ends = [point["threshold_error"] / factor, point["threshold_error"] * factor]
            axes.plot([point["cpu_s"]] * 2, ends, color=colour, lw=0.8)
    beyond = [at for at in estimator["cpu_s_at"] if at["extrapolated"]]
    if beyond and points:
        # From the last budget on, along the line that they were extrapolated by.
        end, set_up = beyond[-1], estimator["set_up_cpu_s"]
        times = np.geomspace(x[-1], end["cpu_s"], 50)
        errors_there = end["threshold_error"] * np.sqrt((end["cpu_s"] - set_up) / (times - set_up))
        axes.plot(times, errors_there, color=colour, ls="--", lw=1.0)


def _draw_ratio(axes: Axes, scene: Json, ratio: Json) -> None:
    """A dashed line at an error, and an arrow along it from the literal Monte Carlo to the closed form."""
    error = ratio["threshold_error"]
    axes.axhline(error, color="0.6", ls="--", lw=0.8, zorder=0)
    if ratio["ratio"] is None:
        return
    times = {one["name"]: one["cpu_s_at"] for one in scene["estimators"]}
    literal, closed_form = (
        next(at["cpu_s"] for at in times[name] if at["threshold_error"] == error)
        for name in ("literal", ratio["closed_form"])
    )
    arrow = {"arrowstyle": "<|-|>", "color": "C0", "lw": 1.2, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", (closed_form, error), (literal, error), arrowprops=arrow)
    mark = "≥ " if ratio["at_least"] else ""
    text = f"{mark}{rounded(ratio['ratio'])} times less CPU" + (", extrapolated" if ratio["extrapolated"] else "")
    axes.annotate(
        text,
        (math.sqrt(literal * closed_form), error),
        (0, 3),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize="small",
        color="C0",
        bbox=BOX,
    )


def rounded(value: float) -> str:
    """A ratio to two digits, thousands apart."""
    digits = max(math.floor(math.log10(value)) - 1, 0) if value > 0.0 else 0
    return f"{round(value, -digits):,.0f}" if value >= 10.0 else f"{value:.2g}"


def _seconds(value: float) -> str:
    """A power of ten in seconds, for an axis."""
    return f"{1e3 * value:g} ms" if value < 0.999 else f"{value:,.0f} s"
