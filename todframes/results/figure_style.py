"""Style of all figures: ink on paper, and colours that stand out from black and from white.

The same figure can therefore be printed and shown on a dark screen.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

from todframes.base._typing import FloatArray

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
