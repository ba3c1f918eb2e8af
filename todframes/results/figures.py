"""Figures of results: one style, the picture that a feature draws, and those of thresholds.

Ink on paper, and colours that stand out from black and from white: a figure can be printed and shown on a dark
screen.
"""

from __future__ import annotations

import io
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from todframes.base._typing import FloatArray, Json
from todframes.psychometrics.curves import observer_curve, weibull
from todframes.results.data import Fit
from todframes.results.wording import (
    FIELD_AXES,
    by_curve,
    group_phrase,
    interval_phrase,
    level_heading,
    level_name,
    plain,
    quantity,
    size_column,
    subsample,
    threshold_heading,
    unit_of,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure


Colour = tuple[float, float, float, float]

INK, PAPER = "#1f2328", "#ffffff"

COLOURS = ("#3b76c4", "#1f8f8a", "#5a9136", "#a68217", "#cb6a2c", "#c94f6d", "#8a62c2")
"""Colours of curves, in the order of the rainbow because sizes have an order, and of about the same lightness."""

MARKERS = "os^DvPX"

LONGEST_LABEL = 40

STYLE: dict[str, Any] = {
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK),
    "axes.linewidth": 0.6,
    "figure.constrained_layout.w_pad": 0.14,
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
    """Set the style of all figures for the block, in which they must be made and saved. Settings of the user, from
    a file or from the program that runs, have no effect.
    """
    import matplotlib as mpl

    look: Any = STYLE
    with mpl.rc_context(), warnings.catch_warnings():
        mpl.rcdefaults()
        mpl.rcParams.update(look)
        # The browser's font has letters that matplotlib's own font lacks.
        warnings.filterwarnings("ignore", "Glyph .* missing from", UserWarning)
        yield


def new_figure() -> tuple[Figure, Axes]:
    """Return a new figure with one pair of axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.6, 4.2), layout="constrained")
    return figure, figure.add_subplot()


def svg_file(figure: Figure) -> bytes:
    """Return the SVG of a figure, inside `style`, without a date; drawn once as in `save_png`."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    canvas: Any = FigureCanvasSVG(figure)
    buffer = io.BytesIO()
    canvas.print_svg(buffer, metadata={"Date": None})
    return buffer.getvalue()


def within(value: float) -> float:
    """Return the value, or the nearest that a logarithmic axis can show without overflow in its margins."""
    return min(max(value, 1e-99), 1e99)


def add_legend(axes: Axes) -> None:
    """Add a legend within the axes, which keep their size."""
    axes.legend().set_in_layout(False)


def label_text(text: str) -> str:
    """Return a name as a label: no mathematics between dollars, not hidden by an underscore, not too long."""
    text = "".join(character if character.isprintable() else " " for character in text)
    text = text if len(text) <= LONGEST_LABEL else text[: LONGEST_LABEL - 1] + "…"
    return " " * text.startswith("_") + text.replace("$", r"\$")


def colour_scale(values: FloatArray) -> Normalize:
    """Return the scale of colours of some values, linear or logarithmic."""
    from matplotlib.colors import LogNorm, Normalize

    kind = LogNorm if values.min() > 0.0 and values.max() > 3.0 * values.min() else Normalize
    return kind(float(values.min()), float(values.max()))


def add_colour_bar(axes: Axes, drawn: Any, label: str) -> None:
    """Add the scale of colours of what has been drawn into the axes, as high as they are."""
    figure = axes.figure
    bar = figure.colorbar(drawn, cax=axes.inset_axes((1.04, 0.0, 0.045, 1.0)), label=label_text(label))
    norm = drawn.norm
    if type(norm).__name__ == "LogNorm":
        plain_ticks(bar.ax.yaxis, [norm.vmin, norm.vmax])
    bar.outline.set_linewidth(0.6)


class CurveStyle(NamedTuple):
    """Colour and marker of one curve of several."""

    colour: Colour
    marker: str


def plain_ticks(axis: Any, values: Sequence[float]) -> None:
    """Set tick labels without exponents: at 1, 2, 5 of each of a few decades, at more places of a single one."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    span = max(values) / min(values)
    if span >= 1e4:
        return
    subs = (1.0, 2.0, 5.0) if span > 8.0 else (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
    axis.set_major_locator(LogLocator(subs=subs) if span > 2.5 else MaxNLocator(5, steps=[1, 2, 5, 10]))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


def curve_style(number: int, of: int) -> CurveStyle:
    """Return the style of curve `number` out of `of`; if `COLOURS` has too few colours, they are interpolated."""
    from matplotlib.colors import LinearSegmentedColormap, to_rgba

    marker = MARKERS[number % len(MARKERS)]
    if of <= len(COLOURS):
        return CurveStyle(to_rgba(COLOURS[round(number * (len(COLOURS) - 1) / max(of - 1, 1))]), marker)
    return CurveStyle(LinearSegmentedColormap.from_list("sizes", COLOURS)(number / (of - 1)), marker)


def reference_style() -> CurveStyle:
    """Return the style of what others are compared with: ink, which no curve of several has."""
    from matplotlib.colors import to_rgba

    return CurveStyle(to_rgba(INK), "*")


class ReportFigure(NamedTuple):
    """A figure to be drawn, for the page and as a PNG.

    `note` explains how to read it; `file` is the name of the PNG, or "" if only the page shows it. One that
    `is_folded` is closed on the page if others are open.
    """

    title: str
    note: str
    draw: Callable[[Axes], None]
    file: str = ""
    is_folded: bool = False

    def figure(self) -> Figure:
        """Return the picture as a figure of its own, in the style of all figures."""
        figure, axes = new_figure()
        self.draw(axes)
        return figure

    def _titled(self) -> Figure:
        figure = self.figure()
        figure.axes[0].set_title(label_text(self.title))
        return figure

    def png(self) -> bytes:
        """Return the picture as a PNG with its title above and its note below."""
        with style():
            return save_png(self._titled(), self.note)

    def svg(self) -> bytes:
        """Return the picture as an SVG file with its title above and its note below."""
        import matplotlib as mpl

        with style(), mpl.rc_context({"svg.hashsalt": self.file}):
            figure = self._titled()
            _add_note(figure, self.note)
            return svg_file(figure)


def save_png(figure: Figure, note: str = "") -> bytes:
    """Return the PNG of a figure with a note below it, inside `style`; the same figure gives the same bytes. A
    canvas draws the figure once. `Figure.savefig` draws it twice, first for its layout alone.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    _add_note(figure, note)
    canvas: Any = FigureCanvasAgg(figure)
    buffer = io.BytesIO()
    figure.set_dpi(160)
    canvas.print_png(buffer, metadata={"Software": None})  # a version would change the bytes
    return buffer.getvalue()


def _add_note(figure: Figure, note: str) -> None:
    if note:
        figure.supxlabel(textwrap.fill(note, 95), fontsize="x-small", x=0.02, ha="left")


def drawn(draw: Callable[[Axes], None], ax: Axes | None) -> Axes:
    """Draw into the given axes, or those of a new pyplot figure, over the user's settings. Returns the axes."""
    import matplotlib as mpl

    look: Any = STYLE
    with mpl.rc_context(look):
        if ax is None:
            from matplotlib import pyplot

            _, ax = pyplot.subplots(layout="constrained")
        draw(ax)
    return ax


Styles = Mapping[object, CurveStyle]
"""Style of the curves of each condition, by its name."""

NO_STYLES: Styles = {}

MOST_CURVES = 24

MOST_IN_LEGEND = 12

MOST_SIZES_NAMED = 8

MOST_MAPS = 4

FIELD_LABEL_POINTS = (3.0, 8.0)
"""Smallest and largest letters of the numbers in a map of the field, in points; as large as the places allow."""

FIELD_LABEL_EM = (8.8, 5.8)
"""Width of the numbers of a place in a map of the field, and height with the disc, in sizes of the letters."""

NO_THRESHOLD_MARKERS = {"never_reached": "x", "always_exceeded": "v"}
"""Markers of places without a threshold by status; another status has a plus sign."""


def pictures(fits: Sequence[Fit]) -> list[ReportFigure]:
    """List the figures of thresholds, the most important first."""
    listed = tod_figures(fits, {}, "tod_curve.png")
    for number, (label, of_map) in enumerate(subsample(list(by_field_map(fits).items()), MOST_MAPS)):
        draw = partial(draw_field_map, fits=of_map)
        file = "" if number else "field_map.png"
        listed.append(ReportFigure(f"Map of the field{label}", _field_note(of_map), draw, file))
    return listed + psychometric_figures(fits, {}, "psychometric.png")


def tod_figures(fits: Sequence[Fit], styles: Styles, file: str = "", *, bands: bool = False) -> list[ReportFigure]:
    """Return the figure of the TOD curves, with `bands` between the ends of their intervals; an empty list if
    there is no curve.
    """
    if not has_tod_curve(fits):
        return []
    draw = partial(draw_tod, fits=fits, styles=styles, bands=bands)
    return [ReportFigure("TOD curve", tod_note(fits), draw, file)]


def psychometric_figures(
    fits: Sequence[Fit], styles: Styles, file: str = "", *, of: str = ""
) -> list[ReportFigure]:
    """Return the figure of psychometric functions, with what they are of; an empty list if there are no points."""
    seen = [fit for fit in fits if fit.points]
    if not seen:
        return []
    guesses = "; dotted: the guess rate" if seen[0].guess_rate is not None else ""
    note = f"Proportion correct against {level_name(seen[0].level)}; dashed: the criterion{guesses}."
    if len(seen) > MOST_CURVES:
        note += f" {MOST_CURVES} of {len(seen)} curves are drawn."
    draw = partial(draw_psychometric, fits=seen, styles=styles)
    return [ReportFigure(of or "Psychometric functions", note, draw, file, is_folded=True)]


def tod_note(fits: Sequence[Fit]) -> str:
    """Return the explanation of a TOD curve."""
    first = fits[0]
    note = f"Threshold {level_name(first.level)} at {100 * first.p_correct:g} % correct against 1 / size."
    note += " Filled: within the levels shown; open: extrapolated." if any(fit.n_trials for fit in fits) else ""
    intervals = [fit.threshold_ci95 for fit in fits if fit.threshold_ci95 is not None]
    if intervals:
        open_ended = any(None in interval for interval in intervals)
        note += f" Vertical lines are 95 % intervals{', dotted where the data leave an end open' * open_ended}."
    return note


def by_field_map(fits: Sequence[Fit]) -> dict[str, list[Fit]]:
    """Return the fits of each map of the field, by a title: those of a chart at two or more places of the picture.
    Fits of one map differ in their places alone.
    """
    maps: dict[str, list[Fit]] = {}
    for fit in fits:
        if all(isinstance(fit.group.get(name), float) for name in FIELD_AXES):
            others = {name: value for name, value in fit.group.items() if name not in FIELD_AXES}
            maps.setdefault(f" at {group_phrase(others)}" if others else "", []).append(fit)
    return {
        label: of_map
        for label, of_map in maps.items()
        if len({_field_place(fit) for fit in of_map}) > 1 and any(fit.threshold is not None for fit in of_map)
    }


def _field_place(fit: Fit) -> tuple[float, float]:
    x, y = (float(fit.group[name]) for name in FIELD_AXES)
    return x, y


def _field_note(fits: Sequence[Fit]) -> str:
    first = fits[0]
    note = (
        f"Threshold {level_name(first.level)} at {100 * first.p_correct:g} % correct and its 95 % interval, where "
        "the chart was in the picture, with down as in the picture. The cross is the frame's middle."
    )
    if any(fit.status == "extrapolated" for fit in fits):
        note += " A dashed rim: extrapolated."
    if any(fit.threshold is None for fit in fits):
        note += " Without a disc: no threshold, and why."
    return note


def draw_field_map(axes: Axes, fits: Sequence[Fit]) -> None:
    """Draw thresholds over the field of a camera: a disc and its numbers at each place, equal angles equally long.
    At least one fit must have a threshold, and two must have different places.
    """
    places = np.array([_field_place(fit) for fit in fits])
    known = [fit.threshold for fit in fits if fit.threshold is not None]
    steps = np.abs(places[:, None] - places[None, :])
    steps = steps[steps.any(axis=2)]
    margin = 0.6 * np.linalg.norm(steps, axis=1).min()
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), aspect="equal")
    axes.set(xlabel="right of the frame's middle (mrad)", ylabel="below the frame's middle (mrad)")
    axes.plot(0.0, 0.0, "+", color=INK, markersize=12.0, alpha=0.5, zorder=1)
    # The colour bar, titles and ticks leave about 0.7 of the width and 0.75 of the height.
    page_inches = np.array([axes.figure.bbox.width, axes.figure.bbox.height]) / axes.figure.dpi
    inches_per_mrad = float((page_inches * (0.7, 0.75) / (high - low)).min())
    room = 72.0 * inches_per_mrad * (steps / FIELD_LABEL_EM).max(axis=1).min()
    points = float(np.clip(room, *FIELD_LABEL_POINTS))
    has = [fit.threshold is not None for fit in fits]
    # The scale spans the intervals, so that colours differ no more than the thresholds are known.
    ends = [end for fit in fits if fit.threshold_ci95 is not None for end in fit.threshold_ci95 if end is not None]
    drawn = axes.scatter(
        places[has, 0], places[has, 1], c=known, s=(3.0 * points) ** 2, norm=colour_scale(np.array(known + ends)),
        cmap="viridis_r", edgecolors=INK, linewidths=0.8, zorder=2,
        linestyles=["--" if fit.status == "extrapolated" else "-" for fit in fits if fit.threshold is not None],
    )  # fmt: skip
    for (x, y), fit in zip(places.tolist(), fits, strict=True):
        if fit.threshold is None:
            marker = NO_THRESHOLD_MARKERS.get(fit.status, "+")
            axes.plot(x, y, marker, color=INK, markersize=2.0 * points, zorder=2)
            text = fit.status.replace("_", " ")
        else:
            interval = "" if fit.threshold_ci95 is None else f"\n{interval_phrase(fit.threshold_ci95)}"
            text = f"{plain(fit.threshold)}{interval}"
        axes.annotate(
            text, (x, y), (0.0, -1.7 * points), textcoords="offset points", ha="center", va="top", fontsize=points
        )
    add_colour_bar(axes, drawn, threshold_heading(fits[0].level))


def has_tod_curve(fits: Sequence[Fit]) -> bool:
    """Return whether there is a column of sizes, and a threshold at two sizes at least."""
    size = size_column(fits)
    return size is not None and len({fit.group[size] for fit in fits if fit.threshold is not None}) >= 2


def draw_tod(
    axes: Axes, fits: Sequence[Fit], styles: Styles = NO_STYLES, *, line: str = "-", bands: bool = False
) -> None:
    """Draw the TOD curve of fits that have one: threshold against size, with intervals, and ΔT if it is known.
    `styles` has that of each condition; `line` is matplotlib's style of the lines between thresholds. `bands` are
    drawn between the ends of the intervals of a curve.
    """
    name = size_column(fits)
    assert name is not None
    size, unit = quantity(name), unit_of(name)
    curves = list(by_curve([fit for fit in fits if fit.threshold is not None]).items())[:MOST_CURVES]
    axes.set(xscale="log", yscale="log", xlabel=label_text(f"1 / {size} ({unit}⁻¹)"))
    axes.set_ylabel(label_text(threshold_heading(fits[0].level)))
    drawn: list[Drawn] = []
    for number, (label, curve) in enumerate(curves):
        line_style = curve_style(number, len(curves))
        if given := styles.get(curve[0].group.get("condition")):
            line_style = given if len(curves) <= len(styles) else line_style._replace(colour=given.colour)
        drawn += _draw_tod_curve(axes, curve, name, label, line_style, line)
        ends = [(1.0 / float(fit.group[name]), *(fit.threshold_ci95 or (None, None))) for fit in curve]
        if bands and len(ends) > 1:
            x, low, high = np.array(ends, np.float64).T  # an open end becomes NaN, and the band has a gap
            axes.fill_between(x, low, high, color=line_style.colour, alpha=0.15, lw=0.0, zorder=1)
    if 1 < len(curves) <= MOST_IN_LEGEND:
        add_legend(axes)
    inverse = sorted({x for x, _, _ in drawn})
    plain_ticks(axes.xaxis, inverse)
    plain_ticks(axes.yaxis, [threshold for _, threshold, _ in drawn])
    _draw_open_ends(axes, drawn)
    top = axes.secondary_xaxis("top")
    top.set_xlabel(label_text(f"{size} ({unit})"))
    named = _apart(inverse)
    top.set_xticks(named, [f"{1.0 / x:.4g}" for x in named])
    top.minorticks_off()
    _temperature_axis(axes, drawn)


def _apart(ascending: Sequence[float]) -> list[float]:
    """Return the values whose names do not touch on a logarithmic axis."""
    step = (ascending[-1] / ascending[0]) ** (1.0 / MOST_SIZES_NAMED)
    named: list[float] = []
    for value in ascending:
        if not named or value >= named[-1] * step:
            named.append(value)
    return named


Drawn = tuple[float, float, Fit]
"""A threshold in the figure of a TOD curve: 1 / size, the threshold as drawn, and the fit."""


def _draw_tod_curve(
    axes: Axes, fits: Sequence[Fit], name: str, label: str, line_style: CurveStyle, line: str
) -> list[Drawn]:
    drawn = [(1.0 / within(float(fit.group[name])), within(fit.threshold or 0.0), fit) for fit in fits]
    points: Json = {"color": line_style.colour, "marker": line_style.marker}
    x, thresholds, _ = zip(*drawn, strict=True)
    axes.plot(x, thresholds, label=label_text(label), zorder=2, ls=line, **points)
    for at, threshold, fit in drawn:
        if any(fit.threshold_ci95 or ()):
            ends = [within(end or threshold) for end in fit.threshold_ci95 or ()]
            axes.plot([at] * 2, ends, "-_", color=line_style.colour)
        if fit.status == "extrapolated":
            axes.plot(at, threshold, **points, markerfacecolor=PAPER, zorder=3)
    return drawn


def _draw_open_ends(axes: Axes, drawn: Sequence[Drawn]) -> None:
    """Draw dots from a threshold to the edge of the figure if the data leave that end of the interval open."""
    edges = axes.get_ylim()
    for x, threshold, fit in drawn:
        for end, edge in zip(fit.threshold_ci95 or (), edges, strict=False):
            if end is None:
                axes.plot([x] * 2, [threshold, edge], ":", color=INK, alpha=0.6, lw=1.0, zorder=1)
    axes.set_ylim(edges)


def _temperature_axis(axes: Axes, drawn: Sequence[Drawn]) -> None:
    """Add an axis of ΔT on the right, which is proportional to SNR by one factor for all thresholds."""
    factors = [fit.delta_t_mk / threshold for _, threshold, fit in drawn if fit.delta_t_mk]
    if len(factors) < len(drawn) or min(factors) <= 0.0:
        return
    factor = float(np.median(factors))

    def to_temperature(snr: Any) -> Any:
        return snr * factor

    def to_snr(temperature: Any) -> Any:
        return temperature / factor

    right = axes.secondary_yaxis("right", functions=(to_temperature, to_snr))
    right.set_ylabel("ΔT (mK)")
    plain_ticks(right.yaxis, [threshold * factor for _, threshold, _ in drawn])


def draw_psychometric(axes: Axes, fits: Sequence[Fit], styles: Styles = NO_STYLES) -> None:
    """Draw proportion correct against level: points, fitted curves, criterion and guess rate. At least one fit
    must have points; fits without points are left out.
    """
    fits = subsample([fit for fit in fits if fit.points], MOST_CURVES)
    levels = [within(point.level) for fit in fits for point in fit.points]
    for number, fit in enumerate(fits):
        style = styles.get(fit.group.get("condition")) or curve_style(number, len(fits))
        _draw_psychometric_curve(axes, fit, style)
    for height, line in ((fits[0].p_correct, "--"), (fits[0].guess_rate, ":")):
        if height is not None:
            axes.axhline(height, color=INK, alpha=0.6, ls=line, lw=0.8)
    axes.set(
        xscale="log",
        ylim=(0.0, 1.02),
        xlabel=label_text(level_heading(fits[0].level)),
        ylabel="proportion correct",
    )
    if levels and min(levels) < max(levels):
        plain_ticks(axes.xaxis, levels)
    if len(fits) <= MOST_IN_LEGEND:
        add_legend(axes)


def fitted_curve(fit: Fit) -> Callable[[FloatArray], FloatArray] | None:
    """Return the curve that the threshold was read from, a function of the level; None if none was fitted."""
    curve = fit.observer_curve
    if curve is not None:
        return partial(observer_curve, alpha=curve.alpha, beta=curve.beta, max_d_prime=curve.max_d_prime)
    if fit.curve == "observer" or fit.alpha is None or fit.beta is None:
        return None
    return partial(
        weibull, alpha=fit.alpha, beta=fit.beta, guess_rate=fit.guess_rate or 0.0, lapse_rate=fit.lapse_rate or 0.0
    )


def _draw_psychometric_curve(axes: Axes, fit: Fit, line_style: CurveStyle) -> None:
    x = [within(point.level) for point in fit.points]
    trials = [point.n_trials for point in fit.points]
    axes.scatter(
        x,
        [point.p_correct for point in fit.points],
        s=[24.0 if len(set(trials)) == 1 else 10.0 + 34.0 * n / max(trials) for n in trials],
        color=line_style.colour,
        marker=line_style.marker,
        linewidths=0.0,
        label=label_text(group_phrase(fit.group)),
    )
    curve = fitted_curve(fit)
    if x and curve is not None:
        level = np.geomspace(min(x), max(x), 100)
        axes.plot(level, curve(level), color=line_style.colour)
    elif len(x) > 1 and not any(trials):
        axes.plot(
            x, [point.p_correct for point in fit.points], color=line_style.colour
        )  # computed, with no error to fit
