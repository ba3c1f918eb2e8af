"""Drawings in millimetres, as SVG and PDF: rectangles, polygons, outlines and lines of text in shades of grey.

Places are in mm from the top left corner of the page, x to the right and y down.
"""

from __future__ import annotations

import html
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from todframes.base._typing import FloatArray

MM_PER_INCH = 25.4

POINTS_PER_MM = 72.0 / MM_PER_INCH


@dataclass(frozen=True, slots=True)
class Area:
    """A filled polygon; `grey` is its code value, 0 to 255."""

    corners_mm: Sequence[tuple[float, float]]
    grey: int


@dataclass(frozen=True, slots=True)
class Outline:
    """A closed line in black along a polygon."""

    corners_mm: Sequence[tuple[float, float]]
    width_mm: float = 0.1


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text in black; (x, y) is its place on the base line, by `anchor` its start, middle or end."""

    x_mm: float
    y_mm: float
    text: str
    height_mm: float = 3.0
    anchor: Literal["start", "middle", "end"] = "start"


Shape = Area | Outline | Text


@dataclass(frozen=True, slots=True)
class Drawing:
    """Shapes on a page, each over the ones before."""

    width_mm: float
    height_mm: float
    shapes: tuple[Shape, ...]


def rectangle(x_mm: float, y_mm: float, width_mm: float, height_mm: float, grey: int) -> Area:
    """Return a filled rectangle with its top left corner at (x, y)."""
    right, bottom = x_mm + width_mm, y_mm + height_mm
    return Area(((x_mm, y_mm), (right, y_mm), (right, bottom), (x_mm, bottom)), grey)


def area(corners_mm: FloatArray, grey: int) -> Area:
    """Return a filled polygon; `corners_mm` has shape (n, 2)."""
    return Area([(float(x), float(y)) for x, y in corners_mm], grey)


def svg(drawing: Drawing) -> str:
    """Return a drawing as an SVG document whose size is given in mm."""
    width, height = f"{drawing.width_mm:.6g}", f"{drawing.height_mm:.6g}"
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}" font-family="sans-serif">',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for shape in drawing.shapes:
        match shape:
            case Text():
                attributes = f'x="{shape.x_mm:.4f}" y="{shape.y_mm:.4f}" font-size="{shape.height_mm:.4g}"'
                text = html.escape(shape.text, quote=False)
                lines.append(f'<text {attributes} text-anchor="{shape.anchor}">{text}</text>')
            case Area():
                fill = f'fill="rgb({shape.grey},{shape.grey},{shape.grey})"'
                lines.append(f'<polygon points="{_points(shape.corners_mm)}" {fill}/>')
            case Outline():
                line = f'fill="none" stroke="#000" stroke-width="{shape.width_mm:g}"'
                lines.append(f'<polygon points="{_points(shape.corners_mm)}" {line}/>')
    return "\n".join([*lines, "</svg>", ""])


def _points(corners_mm: Sequence[tuple[float, float]]) -> str:
    return " ".join(f"{x:.5f},{y:.5f}" for x, y in corners_mm)


def pdf(drawings: Iterable[Drawing], title: str) -> bytes:
    """Return drawings as the pages of a PDF in true size; the same drawings give the same bytes."""
    import matplotlib as mpl
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure
    from matplotlib.patches import Polygon

    file = io.BytesIO()
    with mpl.rc_context(), PdfPages(file, metadata={"Title": title, "CreationDate": None}) as pages:
        mpl.rcdefaults()  # no settings of the user
        for drawing in drawings:
            size_inch = drawing.width_mm / MM_PER_INCH, drawing.height_mm / MM_PER_INCH
            figure = Figure(figsize=size_inch)
            axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
            axes.set(xlim=(0.0, drawing.width_mm), ylim=(drawing.height_mm, 0.0))
            axes.axis("off")
            for shape in drawing.shapes:
                match shape:
                    case Text():
                        points = shape.height_mm * POINTS_PER_MM
                        side = {"start": "left", "middle": "center", "end": "right"}[shape.anchor]
                        text = axes.text(shape.x_mm, shape.y_mm, shape.text, fontsize=points, ha=side)
                        text.set_parse_math(False)
                    case Area():
                        axes.add_patch(Polygon(shape.corners_mm, facecolor=str(shape.grey / 255.0), linewidth=0.0))
                    case Outline():
                        line = shape.width_mm * POINTS_PER_MM
                        axes.add_patch(Polygon(shape.corners_mm, fill=False, edgecolor="black", linewidth=line))
            pages.savefig(figure)
    return file.getvalue()
