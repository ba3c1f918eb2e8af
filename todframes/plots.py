"""Pictures of a result: psychometric functions and the TOD curve."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from todframes.weibull import weibull

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Json = dict[str, Any]


def group_label(group: Mapping[str, float | str]) -> str:
    """A group in a few words."""
    return ", ".join(
        f"{name} {value:.15g}" if isinstance(value, float) else f"{name} {value}" for name, value in group.items()
    )


def plots(result: Json) -> dict[str, bytes]:
    """PNG pictures of a result by file name: the psychometric functions, and the TOD curve if there is one."""
    pictures = {"psychometric.png": _png(_psychometric_figure(result["fits"]))}
    size_name = _size_column(result["fits"])
    if size_name is not None:
        pictures["tod_curve.png"] = _png(_tod_figure(result["fits"], size_name))
    return pictures


def _size_column(fits: Sequence[Json]) -> str | None:
    """The one group column that is a size, if it has at least two values with a threshold."""
    names = [name for name in (fits[0]["group"] if fits else {}) if name.startswith("size_")]
    if len(names) != 1:
        return None
    known = {fit["group"][names[0]] for fit in fits if fit["threshold"] is not None}
    return names[0] if len([size for size in known if isinstance(size, float)]) >= 2 else None


def _plain(text: str) -> str:
    """Names are data: no mathematics between dollar signs, and no label hidden by an underscore."""
    return " " * text.startswith("_") + text.replace("$", r"\$")


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    # No software version among the attributes: the same result gives the same bytes.
    figure.savefig(buffer, format="png", dpi=144, metadata={"Software": None})
    return buffer.getvalue()


def _figure() -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.8), layout="constrained")
    axes = figure.add_subplot()
    axes.grid(True, which="both", alpha=0.25)
    return figure, axes


def _tod_figure(fits: Sequence[Json], size_name: str) -> Figure:
    figure, axes = _figure()
    unit = size_name.removeprefix("size_")
    known = [fit for fit in fits if fit["threshold"] is not None and isinstance(fit["group"][size_name], float)]
    curves: dict[str, list[Json]] = {}
    for fit in known:
        others = {name: value for name, value in fit["group"].items() if name != size_name}
        curves.setdefault(group_label(others), []).append(fit)
    for number, (label, curve) in enumerate(curves.items()):
        _draw_tod_curve(axes, curve, size_name, f"C{number % 10}", label)
    if len(curves) > 1:
        axes.legend(fontsize="small")
    inverse = sorted({1.0 / fit["group"][size_name] for fit in known})
    threshold = [fit["threshold"] for fit in known]
    axes.set(
        xscale="log",
        yscale="log",
        xlabel=_plain(f"1 / size ({unit}⁻¹)"),
        ylabel=_plain(f"threshold {fits[0]['level']}"),
        title=f"TOD curve ({100 * fits[0]['p_correct']:g} % correct)",
    )
    _plain_ticks(axes, inverse, threshold)
    top = axes.secondary_xaxis("top")
    top.set_xlabel(_plain(f"size ({unit})"))
    top.set_xticks(inverse, [f"{1.0 / x:g}" for x in inverse])
    top.minorticks_off()
    return figure


def _draw_tod_curve(axes: Axes, fits: Sequence[Json], size_name: str, colour: str, label: str) -> None:
    inverse = [1.0 / fit["group"][size_name] for fit in fits]
    axes.plot(
        inverse, [fit["threshold"] for fit in fits], "-", color=colour, lw=1.2, label=_plain(label), zorder=1
    )
    for fit, x in zip(fits, inverse, strict=True):
        low, high = fit["threshold_ci95"] or (None, None)
        if low is not None and high is not None:
            axes.plot([x, x], [low, high], "-_", color=colour, lw=1.2)
        face = colour if fit["status"] == "ok" else "white"
        axes.plot(x, fit["threshold"], "o", color=colour, markerfacecolor=face)


def _plain_ticks(axes: Axes, x: Sequence[float], y: Sequence[float]) -> None:
    """Plain numbers at 1, 2, 5 of each decade while there are few decades."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis, values in ((axes.xaxis, x), (axes.yaxis, y)):
        if max(values) / min(values) < 1e4:
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())


def _psychometric_figure(fits: Sequence[Json]) -> Figure:
    import matplotlib as mpl

    figure, axes = _figure()
    colours = mpl.colormaps["viridis"](np.linspace(0.0, 0.9, max(len(fits), 2)))
    levels = [point["level"] for fit in fits for point in fit["points"]]
    for fit, colour in zip(fits, colours, strict=False):
        x = [point["level"] for point in fit["points"]]
        trials = [point["n_trials"] for point in fit["points"]]
        axes.scatter(
            x,
            [point["p_correct"] for point in fit["points"]],
            s=[18.0 if len(set(trials)) == 1 else 8.0 + 30.0 * n / max(trials) for n in trials],
            color=colour,
            label=_plain(group_label(fit["group"]) or "all trials"),
        )
        if fit["alpha"] is not None:
            curve = np.geomspace(min(x), max(x), 200)
            parameters = {name: fit[name] for name in ("alpha", "beta")}
            p = weibull(curve, **parameters, guess_rate=fit["gamma"], lapse_rate=fit["delta"])
            axes.plot(curve, p, color=colour, lw=1.2)
    for height, style in ((fits[0]["p_correct"], "--"), (fits[0]["gamma"], ":")):
        if height is not None:
            axes.axhline(height, color="0.4", ls=style, lw=0.8)
    axes.set(
        xscale="log",
        ylim=(0.0, 1.02),
        xlabel=_plain(fits[0]["level"]),
        ylabel="proportion correct",
        title="Psychometric functions",
    )
    if levels and min(levels) < max(levels):
        _plain_ticks(axes, levels, [1.0, 1e9])
    if len(fits) <= 12:
        axes.legend(fontsize="small")
    return figure
