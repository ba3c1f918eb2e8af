"""Error against run time as people and programs read it: one JSON object, tables, a page with pictures."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from todframes._typing import Json
from todframes.report.convert import encode
from todframes.report.tables import add_row, new_table
from todframes.report.wording import number
from todframes.studies.accuracy.measure import Measured

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.table import Table


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


ESTIMATOR_HEADERS = (
    *("estimator", "trials", "CPU (s)", "wall (s)", "error of P", "of the threshold", "slope"),
    *("CPU (s) at 1 %", "at 0.1 %", "times less at 1 %", "at 0.1 %"),
)


VARIANT_HEADERS = ("closed form, changed", "CPU", "change of P", "of the threshold")


def scene_object(scene: Measured) -> Json:
    """A scene as it stands in `accuracy.json`."""
    threshold, bound, slope = scene.converged
    return {
        "name": scene.name,
        "title": scene.title,
        "description": scene.description,
        "level": scene.level,
        "threshold": threshold,
        "threshold_bound": bound,
        "slope": slope,
        "p_correct_error_bound": scene.p_correct_error_bound,
        "estimators": [
            {
                "name": curve.name,
                "label": curve.label,
                "set_up_cpu_s": curve.set_up_cpu_s,
                "slope": curve.slope,
                "slope_standard_error": curve.slope_error,
                "points": [point._asdict() for point in curve.points],
                "cpu_s_at": [_renamed(at._asdict()) for at in curve.times],
            }
            for curve in scene.estimators
        ],
        "variants": [change._asdict() for change in scene.variants],
        "speed_ratios": [_renamed(ratio._asdict()) for ratio in scene.ratios],
    }


def _renamed(content: Json) -> Json:
    return {"threshold_error": content.pop("error"), **content}


def files(result: Json) -> dict[str, bytes]:
    """What `-o` writes, by file name: the object, a page, a picture for each scene."""
    pictures = {_picture_name(scene): scene_picture(scene) for scene in result["scenes"]}
    return {**pictures, "accuracy.md": page(result).encode(), "accuracy.json": encode(result)}


def tables(scene: Json) -> tuple[Table, Table]:
    """Estimators and variants of a scene for the terminal."""
    return (
        _table(_title(scene), ESTIMATOR_HEADERS, _estimator_rows(scene)),
        _table("", VARIANT_HEADERS, _variant_rows(scene)),
    )


def _table(title: str, headers: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = new_table(title, headers, left={0})
    for row in rows:
        add_row(table, row)
    return table


def _title(scene: Json) -> str:
    return (
        f"{scene['title']}; threshold {scene['level']} {number(scene['threshold'], 6)} "
        f"± {number(scene['threshold_bound'], 1)}"
    )


def _estimator_rows(scene: Json) -> list[list[str]]:
    """A row an estimator: its largest budget, how its error falls, what two errors take."""
    rows = []
    literal = scene["estimators"][0]
    for one in scene["estimators"]:
        points = one["points"]
        last = points[-1] if points else None
        cells = [one["label"]]
        cells += [str(last["trials"]) if last else "–"]
        cells += [number(last[name] if last else None, 2) for name in ("cpu_s", "wall_s")]
        cells += [number(last[name] if last else None, 2) for name in ("p_correct_error", "threshold_error")]
        slope, error = one["slope"], one["slope_standard_error"]
        cells += ["–" if slope is None else f"{slope:.2f}" + ("" if error is None else f" ± {error:.2f}")]
        cells += [_time(at) for at in one["cpu_s_at"]]
        cells += [
            "–" if at["cpu_s"] is None or base["cpu_s"] is None else rounded(base["cpu_s"] / at["cpu_s"])
            for at, base in zip(one["cpu_s_at"], literal["cpu_s_at"], strict=True)
        ]
        rows.append(cells)
    return rows


def _time(at: Json) -> str:
    if at["cpu_s"] is None:
        return "–"
    value = rounded(at["cpu_s"]) if at["cpu_s"] >= 100.0 else number(at["cpu_s"], 2)
    return ("≤ " if at["at_most"] else "") + value + (" *" if at["extrapolated"] else "")


def _variant_rows(scene: Json) -> list[list[str]]:
    return [
        [
            one["label"],
            f"× {one['cpu_ratio']:.2f}",
            *(number(one[name], 2) for name in ("p_correct_change", "threshold_change")),
        ]
        for one in scene["variants"]
    ]


NOTE = "* extrapolated along the measured 1/√N. Errors are root mean squares, that of a threshold relative."


def _picture_name(scene: Json) -> str:
    return f"accuracy_{scene['name']}.png"


def page(result: Json, *, folder: str = "") -> str:
    """Everything as a page of Markdown whose pictures lie in `folder`."""
    settings = result["settings"]
    blocks = [INTRODUCTION.format(seconds=settings["seconds"], version=result["version"])]
    for scene in result["scenes"]:
        level, bound = scene["level"], scene["p_correct_error_bound"]
        blocks += [
            f"## {scene['title'][0].upper()}{scene['title'][1:]}",
            scene["description"],
            f"![Error against CPU time]({folder}{_picture_name(scene)})",
            f"Threshold {level} {number(scene['threshold'], 6)} ± {number(scene['threshold_bound'], 1)}; "
            f"dP / d ln {level} is {number(scene['slope'], 2)} there. That summed noise is not quite Gaussian "
            f"changes P by at most {number(bound, 2)}.",
            _markdown(ESTIMATOR_HEADERS, _estimator_rows(scene)),
            _markdown(VARIANT_HEADERS, _variant_rows(scene)),
        ]
    return "\n\n".join(blocks) + "\n"


def _markdown(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headers, ["---", *["---:"] * (len(headers) - 1)], *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


INTRODUCTION = """\
# Error against run time

What each digit of a threshold costs. Every scene is computed in several ways, each with more and more work, and
held against a converged value that carries its own bound. `todframes accuracy` measures it, here with
`--time {seconds:g}` (CPU seconds a scene) and version {version}. Times are those of one machine; their ratios
hardly depend on it.

| estimator | what it does |
| --- | --- |
| literal Monte Carlo | as in the paper: frames drawn, noise on every neuron, correlation, the largest score |
| Monte Carlo on folded scores | pyramid and templates folded into four weight images, noise into one four-vector |
| expected decisions, random phases | no noise is drawn: P(correct) of each trial is computed |
| closed form | the same, with trials placed evenly; for cameras, planned for an error (`--tolerance`) |

- **Error**: root mean square about the converged value over independent estimates; of the threshold, relative. A
  bar is the standard error of that root mean square, grey what is below the bound on the converged value's error.
- **CPU**: of one estimate, set-up included. The closed form searches its threshold. The Monte Carlos are told
  where it is and how steep P(correct) is there, the least that any choice of levels could take; only on recorded
  frames do they fit a psychometric function, as `score` does.
- **Slope** of the error against the CPU time beyond the set-up, both logarithmic: −½ for independent trials.
- **Times less** CPU than the literal Monte Carlo at equal error. `*` and dashed lines: extrapolated along the
  measured 1/√N.
- The literal Monte Carlo draws uniform noise on detectors and neurons. On folded scores the noise is Gaussian;
  expected decisions and closed forms correct that for neurons. The dotted line bounds what is left.
- The second table changes one thing about the closed form at a time, with equal trials."""
