"""Figures of a result: psychometric functions, the TOD curve, ratios of thresholds, error against run time."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np

from todframes._typing import Json
from todframes.psychometrics.weibull import weibull
from todframes.report.figure_style import (
    INK,
    PAPER,
    Look,
    add_legend,
    label_text,
    look_of,
    new_figure,
    plain_ticks,
    style,
    within,
)
from todframes.report.result import Algorithm, Fit, Ratio, read_result
from todframes.report.summary import by_curve, size_column
from todframes.report.wording import evenly, group_label, group_phrase, level_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


MOST_CURVES = 24


MOST_IN_LEGEND = 12


MOST_SIZES_NAMED = 8


def has_tod_curve(fits: Sequence[Fit]) -> bool:
    """Whether there is a column of sizes, and a threshold at two of them at least."""
    size = size_column(fits)
    return size is not None and len({fit.group[size] for fit in fits if fit.threshold is not None}) >= 2


def tod_figure(fits: Sequence[Fit]) -> Figure:
    """Threshold against size of fits that have a TOD curve, with intervals; ΔT on the right where it is known."""
    figure, axes = new_figure()
    name = size_column(fits)
    assert name is not None
    unit = name.removeprefix("size_")
    curves = list(by_curve([fit for fit in fits if fit.threshold is not None]).items())[:MOST_CURVES]
    axes.set(
        xscale="log",
        yscale="log",
        xlabel=label_text(f"1 / size ({unit}⁻¹)"),
        ylabel=label_text(f"threshold {level_name(fits[0].level)}"),
    )
    drawn = [
        place
        for number, (label, curve) in enumerate(curves)
        for place in _draw_tod_curve(axes, curve, name, label, look_of(number, len(curves)))
    ]
    if 1 < len(curves) <= MOST_IN_LEGEND:
        add_legend(axes)
    inverse = sorted({place.x for place in drawn})
    plain_ticks(axes.xaxis, inverse)
    plain_ticks(axes.yaxis, [place.threshold for place in drawn])
    _draw_open_ends(axes, drawn)
    top = axes.secondary_xaxis("top")
    top.set_xlabel(label_text(f"size ({unit})"))
    named = evenly(inverse, MOST_SIZES_NAMED)
    top.set_xticks(named, [f"{1.0 / x:g}" for x in named])
    top.minorticks_off()
    _temperature_axis(axes, drawn)
    return figure


class _Place(NamedTuple):
    """A threshold in the figure of a TOD curve."""

    x: float
    threshold: float
    fit: Fit


def _draw_tod_curve(axes: Axes, fits: Sequence[Fit], name: str, label: str, look: Look) -> list[_Place]:
    places = [
        _Place(1.0 / within(float(fit.group[name])), within(fit.threshold), fit)
        for fit in fits
        if fit.threshold is not None
    ]
    style_of_points: Json = {"color": look.colour, "marker": look.marker}
    x, thresholds = [place.x for place in places], [place.threshold for place in places]
    axes.plot(x, thresholds, label=label_text(label), zorder=2, **style_of_points)
    for place in places:
        low, high = place.fit.threshold_ci95 or (None, None)
        if low is not None or high is not None:
            ends = [within(end or place.threshold) for end in (low, high)]
            axes.plot([place.x] * 2, ends, "-_", color=look.colour)
        if place.fit.status != "ok":
            axes.plot(place.x, place.threshold, **style_of_points, markerfacecolor=PAPER, zorder=3)
    return places


def _draw_open_ends(axes: Axes, places: Sequence[_Place]) -> None:
    """Dots from a threshold to the edge of the figure where the data leave that end of the interval open."""
    edges = axes.get_ylim()
    for place in places:
        for end, edge in zip(place.fit.threshold_ci95 or (), edges, strict=False):
            if end is None:
                axes.plot([place.x] * 2, [place.threshold, edge], ":", color=INK, alpha=0.6, lw=1.0, zorder=1)
    axes.set_ylim(edges)


def _temperature_axis(axes: Axes, places: Sequence[_Place]) -> None:
    """ΔT is proportional to SNR: one factor for all."""
    factors = [place.fit.delta_t_mk / place.threshold for place in places if place.fit.delta_t_mk]
    if len(factors) < len(places) or min(factors) <= 0.0:
        return
    factor = float(np.median(factors))

    def to_temperature(snr: Any) -> Any:
        return snr * factor

    def to_snr(temperature: Any) -> Any:
        return temperature / factor

    right = axes.secondary_yaxis("right", functions=(to_temperature, to_snr))
    right.set_ylabel("ΔT (mK)")
    plain_ticks(right.yaxis, [place.threshold * factor for place in places])


def psychometric_figure(fits: Sequence[Fit]) -> Figure:
    """Proportion correct against level: the points, the fitted curves, the criterion and the guess rate.

    Of fits with points; there must be one at least.
    """
    figure, axes = new_figure()
    fits = evenly([fit for fit in fits if fit.points], MOST_CURVES)
    levels = [within(point.level) for fit in fits for point in fit.points]
    for number, fit in enumerate(fits):
        _draw_psychometric_curve(axes, fit, look_of(number, len(fits)))
    for height, line in ((fits[0].p_correct, "--"), (fits[0].gamma, ":")):
        if height is not None:
            axes.axhline(height, color=INK, alpha=0.6, ls=line, lw=0.8)
    axes.set(
        xscale="log", ylim=(0.0, 1.02), xlabel=label_text(level_name(fits[0].level)), ylabel="proportion correct"
    )
    if levels and min(levels) < max(levels):
        plain_ticks(axes.xaxis, levels)
    if len(fits) <= MOST_IN_LEGEND:
        add_legend(axes)
    return figure


def _draw_psychometric_curve(axes: Axes, fit: Fit, look: Look) -> None:
    x = [within(point.level) for point in fit.points]
    trials = [point.n_trials for point in fit.points]
    axes.scatter(
        x,
        [point.p_correct for point in fit.points],
        s=[24.0 if len(set(trials)) == 1 else 10.0 + 34.0 * n / max(trials) for n in trials],
        color=look.colour,
        marker=look.marker,
        linewidths=0.0,
        label=label_text(group_phrase(fit.group)),
    )
    if x and fit.alpha is not None and fit.beta is not None:
        curve = np.geomspace(min(x), max(x), 100)
        p = weibull(
            curve, alpha=fit.alpha, beta=fit.beta, guess_rate=fit.gamma or 0.0, lapse_rate=fit.delta or 0.0
        )
        axes.plot(curve, p, color=look.colour)
    elif len(x) > 1 and not any(trials):
        axes.plot(
            x, [point.p_correct for point in fit.points], color=look.colour
        )  # computed, with no error to fit


def ratio_figure(algorithms: Sequence[Algorithm]) -> Figure:
    """Threshold over that of the reference, for each algorithm and group; filled where a difference is shown."""
    figure, axes = new_figure()
    others = [one for one in algorithms if one.ratios][:MOST_IN_LEGEND]
    compared = [{_ratio_label(ratio): ratio for ratio in (*one.ratios, one.overall) if ratio} for one in others]
    labels = list(dict.fromkeys(label for ratios in compared for label in ratios))[:MOST_CURVES]
    axes.set_yscale("log")
    for number, (one, ratios) in enumerate(zip(others, compared, strict=True)):
        look, shift = look_of(number, len(others)), 0.6 * ((number + 0.5) / len(others) - 0.5)
        points: Json = {"color": look.colour, "marker": look.marker, "ls": ""}
        axes.plot([], [], label=label_text(one.name), **points)
        for place, label in enumerate(labels):
            ratio = ratios.get(label)
            if ratio is None or ratio.ratio is None:
                continue
            ends = [within(end or ratio.ratio) for end in ratio.ratio_ci95 or (None, None)]
            axes.plot([place + shift] * 2, ends, "-", color=look.colour)
            shown = ratio.verdict in ("better", "worse")
            face = look.colour if shown else PAPER
            axes.plot(place + shift, within(ratio.ratio), **points, markerfacecolor=face)
    axes.axhline(1.0, color=INK, lw=0.8)
    axes.set(ylabel="threshold ÷ that of the reference", xlim=(-0.5, max(len(labels), 1) - 0.5))
    rotation = 20 if len(labels) > 5 else 0
    axes.set_xticks(range(len(labels)), [label_text(label) for label in labels], rotation=rotation)
    axes.tick_params(axis="x", length=0)
    axes.grid(False, axis="x")
    plain_ticks(axes.yaxis, axes.get_ylim())
    add_legend(axes)
    return figure


def _ratio_label(ratio: Ratio) -> str:
    return group_phrase(ratio.group) if ratio.group else "all groups"


def error_figure(runs: Mapping[str, Sequence[tuple[float, float]]], *, x: str, y: str) -> Figure:
    """Error against run time, both logarithmic: a line for each estimator.

    Parameters
    ----------
    runs : mapping
        Pairs (run time, error), both > 0, by the estimator's name.
    x, y : str
        What stands at the axes.
    """
    figure, axes = new_figure()
    for number, (name, pairs) in enumerate(runs.items()):
        look, (times, errors) = look_of(number, len(runs)), zip(*sorted(pairs), strict=True)
        axes.plot(
            [*map(within, times)],
            [*map(within, errors)],
            color=look.colour,
            marker=look.marker,
            label=label_text(name),
        )
    axes.set(xscale="log", yscale="log", xlabel=label_text(x), ylabel=label_text(y))
    if len(runs) <= MOST_IN_LEGEND:
        add_legend(axes)
    return figure


def plots(result: Json) -> dict[str, bytes]:
    """PNG pictures of a result by file name: the psychometric functions, and the TOD curve if there is one."""
    fits = read_result(msgspec.json.encode(result), "result").fits
    with style():
        pictures = {"psychometric.png": _png(psychometric_figure(fits), "Psychometric functions")}
        if has_tod_curve(fits):
            pictures["tod_curve.png"] = _png(
                tod_figure(fits), f"TOD curve ({100 * fits[0].p_correct:g} % correct)"
            )
    return pictures


def _png(figure: Figure, title: str) -> bytes:
    figure.axes[0].set_title(title)
    buffer = io.BytesIO()
    # No software version among the attributes: the same result gives the same bytes.
    figure.savefig(buffer, format="png", dpi=160, metadata={"Software": None})
    return buffer.getvalue()


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
