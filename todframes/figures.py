"""Figures of a result: psychometric functions, the TOD curve, ratios of thresholds, error against run time.

They are drawn in ink on paper and in colours that stand out from black and from white, so that one figure does for
print and for a dark screen.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from todframes.result import Algorithm, Fit, evenly
from todframes.verdict import by_curve, group_phrase, level_name, size_column
from todframes.weibull import weibull

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Json = dict[str, Any]
Colour = tuple[float, float, float, float]

INK, PAPER = "#1f2328", "#ffffff"
COLOURS = ("#3b76c4", "#1f8f8a", "#5a9136", "#a68217", "#cb6a2c", "#c94f6d", "#8a62c2")
"""In the order of the rainbow, for sizes have one, and of about the same lightness."""
MARKERS = "os^DvPX"
MOST_CURVES = 24
MOST_IN_LEGEND = 12
LONGEST_LABEL = 40
STYLE: dict[str, Any] = {
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK),
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": INK,
    "grid.alpha": 0.15,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": "small",
    "lines.linewidth": 1.3,
    "lines.markersize": 5.5,
}


@contextmanager
def style() -> Iterator[None]:
    """The look of all figures; they are to be made and saved within."""
    import matplotlib as mpl

    look: Any = STYLE
    with mpl.rc_context(look), warnings.catch_warnings():
        # A browser has the letters that matplotlib's own font has not.
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        yield


def _figure() -> tuple[Figure, Axes]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.6, 4.2), layout="constrained")
    return figure, figure.add_subplot()


def _within(value: float) -> float:
    """A value, or the nearest that a logarithmic axis can show; matplotlib's margins overflow beyond."""
    return min(max(value, 1e-99), 1e99)


def _legend(axes: Axes) -> None:
    """Within the axes, which do not shrink for its sake."""
    axes.legend().set_in_layout(False)


def _plain(text: str) -> str:
    """Names are data: no mathematics between dollars, no label hidden by an underscore, no line of any length."""
    text = "".join(character if character.isprintable() else " " for character in text)
    text = text if len(text) <= LONGEST_LABEL else text[: LONGEST_LABEL - 1] + "…"
    return " " * text.startswith("_") + text.replace("$", r"\$")


def has_tod_curve(fits: Sequence[Fit]) -> bool:
    """Whether there is a column of sizes, and a threshold at two of them at least."""
    size = size_column(fits)
    return size is not None and len({fit.group[size] for fit in fits if fit.threshold is not None}) >= 2


def tod_figure(fits: Sequence[Fit]) -> Figure:
    """Threshold against size of fits that have a TOD curve, with intervals; ΔT on the right where it is known."""
    figure, axes = _figure()
    name = size_column(fits)
    assert name is not None
    unit = name.removeprefix("size_")
    curves = list(by_curve([fit for fit in fits if fit.threshold is not None]).items())[:MOST_CURVES]
    axes.set(
        xscale="log",
        yscale="log",
        xlabel=_plain(f"1 / size ({unit}⁻¹)"),
        ylabel=_plain(f"threshold {level_name(fits[0].level)}"),
    )
    drawn = [
        place
        for number, (label, curve) in enumerate(curves)
        for place in _draw_tod_curve(axes, curve, name, label, _look(number, len(curves)))
    ]
    if 1 < len(curves) <= MOST_IN_LEGEND:
        _legend(axes)
    inverse = sorted({place.x for place in drawn})
    _plain_ticks(axes.xaxis, inverse)
    _plain_ticks(axes.yaxis, [place.threshold for place in drawn])
    _draw_open_ends(axes, drawn)
    top = axes.secondary_xaxis("top")
    top.set_xlabel(_plain(f"size ({unit})"))
    top.set_xticks(inverse, [f"{1.0 / x:g}" for x in inverse])
    top.minorticks_off()
    _temperature_axis(axes, drawn)
    return figure


class _Look(NamedTuple):
    """How one curve of several is drawn."""

    colour: Colour
    marker: str


class _Place(NamedTuple):
    """A threshold in the figure of a TOD curve."""

    x: float
    threshold: float
    fit: Fit


def _draw_tod_curve(axes: Axes, fits: Sequence[Fit], name: str, label: str, look: _Look) -> list[_Place]:
    places = [
        _Place(1.0 / _within(float(fit.group[name])), _within(fit.threshold), fit)
        for fit in fits
        if fit.threshold is not None
    ]
    style_of_points: Json = {"color": look.colour, "marker": look.marker}
    x, thresholds = [place.x for place in places], [place.threshold for place in places]
    axes.plot(x, thresholds, label=_plain(label), zorder=2, **style_of_points)
    for place in places:
        low, high = place.fit.threshold_ci95 or (None, None)
        if low is not None or high is not None:
            ends = [_within(end or place.threshold) for end in (low, high)]
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
    _plain_ticks(right.yaxis, [place.threshold * factor for place in places])


def _plain_ticks(axis: Any, values: Sequence[float]) -> None:
    """Plain numbers at 1, 2, 5 of each decade while there are few decades, and at more where there is but one."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    span = max(values) / min(values)
    if span >= 1e4:
        return
    subs = (1.0, 2.0, 5.0) if span > 8.0 else (1.0, 2.0, 3.0, 4.0, 5.0, 7.0)
    axis.set_major_locator(LogLocator(subs=subs) if span > 2.5 else MaxNLocator(5, steps=[1, 2, 5, 10]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def _look(number: int, of: int) -> _Look:
    """One of so many: the colours above while they suffice, between them where they do not."""
    from matplotlib.colors import LinearSegmentedColormap, to_rgba

    marker = MARKERS[number % len(MARKERS)]
    if of <= len(COLOURS):
        return _Look(to_rgba(COLOURS[round(number * (len(COLOURS) - 1) / max(of - 1, 1))]), marker)
    return _Look(LinearSegmentedColormap.from_list("sizes", COLOURS)(number / (of - 1)), marker)


def psychometric_figure(fits: Sequence[Fit]) -> Figure:
    """Proportion correct against level: the points, the fitted curves, the criterion and the guess rate.

    Of fits with points; there must be one at least.
    """
    figure, axes = _figure()
    fits = evenly([fit for fit in fits if fit.points], MOST_CURVES)
    levels = [_within(point.level) for fit in fits for point in fit.points]
    for number, fit in enumerate(fits):
        _draw_psychometric_curve(axes, fit, _look(number, len(fits)))
    for height, line in ((fits[0].p_correct, "--"), (fits[0].gamma, ":")):
        if height is not None:
            axes.axhline(height, color=INK, alpha=0.6, ls=line, lw=0.8)
    axes.set(xscale="log", ylim=(0.0, 1.02), xlabel=_plain(level_name(fits[0].level)), ylabel="proportion correct")
    if levels and min(levels) < max(levels):
        _plain_ticks(axes.xaxis, levels)
    if len(fits) <= MOST_IN_LEGEND:
        _legend(axes)
    return figure


def _draw_psychometric_curve(axes: Axes, fit: Fit, look: _Look) -> None:
    x = [_within(point.level) for point in fit.points]
    trials = [point.n_trials for point in fit.points]
    axes.scatter(
        x,
        [point.p_correct for point in fit.points],
        s=[24.0 if len(set(trials)) == 1 else 10.0 + 34.0 * n / max(trials) for n in trials],
        color=look.colour,
        marker=look.marker,
        linewidths=0.0,
        label=_plain(group_phrase(fit.group)),
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
    figure, axes = _figure()
    others = [one for one in algorithms if one.ratios][:MOST_IN_LEGEND]
    groups = list(dict.fromkeys(group_phrase(ratio.group) for one in others for ratio in one.ratios))[:MOST_CURVES]
    axes.set_yscale("log")
    for number, one in enumerate(others):
        look, shift = _look(number, len(others)), 0.6 * ((number + 0.5) / len(others) - 0.5)
        points: Json = {"color": look.colour, "marker": look.marker, "ls": ""}
        axes.plot([], [], label=_plain(one.name), **points)
        for ratio in one.ratios:
            if ratio.ratio is None or group_phrase(ratio.group) not in groups:
                continue
            x = groups.index(group_phrase(ratio.group)) + shift
            ends = [_within(end or ratio.ratio) for end in ratio.ratio_ci95 or (None, None)]
            axes.plot([x, x], ends, "-", color=look.colour)
            shown = ratio.verdict in ("better", "worse")
            axes.plot(x, _within(ratio.ratio), **points, markerfacecolor=look.colour if shown else PAPER)
    axes.axhline(1.0, color=INK, lw=0.8)
    axes.set(ylabel="threshold ÷ that of the reference", xlim=(-0.5, max(len(groups), 1) - 0.5))
    axes.set_xticks(range(len(groups)), [_plain(label) for label in groups], rotation=20 if len(groups) > 5 else 0)
    axes.tick_params(axis="x", length=0)
    axes.grid(False, axis="x")
    _plain_ticks(axes.yaxis, axes.get_ylim())
    _legend(axes)
    return figure


def error_figure(runs: Mapping[str, Sequence[tuple[float, float]]], *, x: str, y: str) -> Figure:
    """Error against run time, both logarithmic: a line for each estimator.

    Parameters
    ----------
    runs : mapping
        Pairs (run time, error), both > 0, by the estimator's name.
    x, y : str
        What stands at the axes.
    """
    figure, axes = _figure()
    for number, (name, pairs) in enumerate(runs.items()):
        look, (times, errors) = _look(number, len(runs)), zip(*sorted(pairs), strict=True)
        axes.plot(
            [*map(_within, times)],
            [*map(_within, errors)],
            color=look.colour,
            marker=look.marker,
            label=_plain(name),
        )
    axes.set(xscale="log", yscale="log", xlabel=_plain(x), ylabel=_plain(y))
    if len(runs) <= MOST_IN_LEGEND:
        _legend(axes)
    return figure
