"""The page's plots as files: SVG and PNG in the style of all figures."""

from __future__ import annotations

import base64
import threading
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from todframes.results.figure import ReportFigure
from todframes.results.figure_style import COLOURS, INK, MARKERS, add_legend, label_text, plain_ticks

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Text = Annotated[str, Meta(max_length=400)]
Numbers = Annotated[list[float], Meta(max_length=64)]
Format = Literal["svg", "png"]

PAGE_COLOURS = tuple(COLOURS[place] for place in (0, 4, 1, 5, 6, 2, 3))
"""Colours of the present curve, and of the pinned ones by their numbers as in `explorer.css`."""

_TURN = threading.Lock()
"""Figures are drawn one at a time: Matplotlib's settings belong to the whole process."""


class Drawn(msgspec.Struct):
    """A curve of a plot: its number on the page, where it is, its values, and half-widths of 95 % intervals."""

    number: Annotated[int, Meta(ge=0, lt=len(PAGE_COLOURS))]
    label: Text
    x: Numbers
    y: Annotated[list[Annotated[float, Meta(gt=0.0)]], Meta(max_length=64)]
    error: Numbers


class PlotAsked(msgspec.Struct):
    """A request for the plot of threshold curves as a file. `never_reached` are the abscissae at which the present
    one has no threshold.
    """

    format: Format
    title: Text
    x_label: Text
    y_label: Text
    curves: Annotated[list[Drawn], Meta(min_length=1, max_length=8)]
    never_reached: Numbers = []


def curve_plot(asked: PlotAsked) -> dict[str, str]:
    """Return the file of a plot of curves; see `file_of`."""
    note = "Bands: 95 % intervals of the computation." + " Crosses: never reached." * bool(asked.never_reached)
    return file_of(
        ReportFigure(asked.title, note, partial(draw_curves, asked=asked), "tod_curve.png"), asked.format
    )


def file_of(picture: ReportFigure, form: Format) -> dict[str, str]:
    """Return the name of a picture's file, and its content in base64."""
    with _TURN:
        content = picture.svg() if form == "svg" else picture.png()
    name = picture.file.removesuffix("png") + form
    return {"file": name, "base64": base64.b64encode(content).decode()}


def draw_curves(axes: Axes, *, asked: PlotAsked) -> None:
    """Draw curves with their bands, and crosses on the axis where the present one is never reached."""
    for curve in asked.curves:
        colour, marker = PAGE_COLOURS[curve.number], MARKERS[curve.number]
        x, y, error = np.array(curve.x), np.array(curve.y), np.array(curve.error)
        order = np.argsort(x)
        line, width = ("--", 1.4) if curve.number else ("-", 2.2)
        label = label_text(curve.label)
        axes.plot(x[order], y[order], color=colour, marker=marker, label=label, ls=line, lw=width)
        low, high = np.maximum(y - error, y / 10.0), y + error
        axes.fill_between(x[order], low[order], high[order], color=colour, alpha=0.2, lw=0.0)
    crosses = np.array(asked.never_reached)
    axes.plot(crosses, np.zeros(len(crosses)), "x", color=INK, transform=axes.get_xaxis_transform(), clip_on=False)
    axes.set(xlabel=label_text(asked.x_label), ylabel=label_text(asked.y_label), yscale="log")
    axes.set_xlim(left=0.0)
    plain_ticks(axes.yaxis, [value for curve in asked.curves for value in curve.y])
    add_legend(axes)
