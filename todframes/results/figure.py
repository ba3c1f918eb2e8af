"""A figure that a feature draws, as part of a page, as a PNG or SVG file, and in the user's own axes."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from todframes.results.figure_style import STYLE, label_text, new_figure, style, svg_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
