"""Thermal charts: plates with a triangular hole in front of a black body, and the settings to record."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from todframes.base.errors import SettingsError
from todframes.base.reading import check_values
from todframes.base.safe_text import csv_text
from todframes.charts.design import FIELD_PER_SIZE, Condition, Design, write_drawings
from todframes.charts.layout import LARGEST_ON_CHART, Chart, Page, Triangle
from todframes.charts.page_drawing import Drawing, Outline, Shape, Text, area, rectangle
from todframes.parameters import Progress
from todframes.stimulus import HEIGHT_PER_SIZE, SIDE_PER_SIZE, Orientation, vertices

LEAST_HOLE_SIZE_MM = 1.0
"""Smallest √(area) of a hole: corners of smaller ones cannot be cut sharp enough."""

BORDER_MM = 20.0
"""Border of the drawing around the plate, for the text."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plate:
    """Square plates of one side; by default five sizes of the largest triangle, rounded up to whole cm."""

    plate_mm: Annotated[float, Meta(ge=1.0, le=LARGEST_ON_CHART)] | None = None

    def __post_init__(self) -> None:
        check_values(self)


def make_thermal_chart(design: Design, plate: Plate, folder: Path, progress: Progress | None) -> Chart:
    """Lay out plates with one hole each, and write their drawings and a schedule to fill in into an empty folder.
    All settings of a plate come one after the other. In each block of a plate, the temperature differences are in
    random order. For each of them, the plate is turned to the four orientations, in random order too. Raises
    SettingsError if a hole is too small to be cut, or the plate too small for a hole.
    """
    largest_mm = design.size_mm(max(design.sizes_mrad))
    needed_mm = FIELD_PER_SIZE * largest_mm
    side_mm = math.ceil(needed_mm / 10.0) * 10.0 if plate.plate_mm is None else plate.plate_mm
    design.check_size(min(design.sizes_mrad), LEAST_HOLE_SIZE_MM, "whose corners cannot be cut")
    if side_mm < needed_mm:
        raise SettingsError(
            f"plate_mm: found {side_mm:g}, expected at least {needed_mm:.4g}: five sizes of the largest triangle "
            f"({largest_mm:.4g} mm), the part of the background that the observer needs"
        )
    middle_mm = side_mm / 2.0
    pages = (
        Page(
            number=number,
            triangles=(
                Triangle(
                    orientation=condition.orientation,
                    size_mrad=condition.size_mrad,
                    size_mm=design.size_mm(condition.size_mrad),
                    x_mm=middle_mm,
                    y_mm=middle_mm,
                    delta_t_k=design.polarity * condition.level,
                ),
            ),
        )
        for number, condition in enumerate(_order(design))
    )
    chart = design.chart("thermal", side_mm, side_mm, pages)
    drawings = [(f"plates/plate_{size:g}_mrad.svg", _drawing(design, size, side_mm)) for size in design.sizes_mrad]
    write_drawings(folder, chart, drawings, "plates.pdf", progress)
    (folder / "schedule.csv").write_text(_schedule(chart), encoding="utf-8")
    return chart


def _order(design: Design) -> Iterator[Condition]:
    generator = np.random.default_rng(design.seed)
    for size in generator.permutation(design.sizes_mrad):
        for _ in range(design.repeats):
            for level in generator.permutation(design.levels):
                for turn in generator.permutation(len(Orientation)):
                    yield Condition(float(size), float(level), tuple(Orientation)[turn])


def _drawing(design: Design, size_mrad: float, side_mm: float) -> Drawing:
    """Draw a plate with its hole, upright, and the lengths that it is cut by."""
    size_mm = design.size_mm(size_mrad)
    x_mm, y_mm = BORDER_MM + side_mm / 2.0, BORDER_MM + side_mm / 2.0
    hole = area(vertices(size=size_mm, orientation=Orientation.UP, x=x_mm, y=y_mm), 0)
    far = BORDER_MM + side_mm
    lines = [
        f"{design.name}: {size_mrad:g} mrad at {design.distance_m:g} m, scale 1 : 1, plate {side_mm:g} mm",
        f"Hole: equilateral, side {SIDE_PER_SIZE * size_mm:.3f} mm, height {HEIGHT_PER_SIZE * size_mm:.3f} mm, "
        f"area ({size_mm:.4g} mm)²",
        f"Centroid in the middle of the plate, {HEIGHT_PER_SIZE * size_mm / 3.0:.3f} mm from each side",
    ]
    height_mm = min(3.0, (side_mm + 2.0 * BORDER_MM - 6.0) / 0.55 / max(map(len, lines)))
    shapes: list[Shape] = [
        Outline(rectangle(BORDER_MM, BORDER_MM, side_mm, side_mm, 0).corners_mm),
        Outline(hole.corners_mm),
        *(Text(3.0, 4.0 + 1.5 * height_mm * k, line, height_mm) for k, line in enumerate(lines)),
    ]
    # Marks at the plate's edges show its middle, also when it is turned.
    for end in (BORDER_MM - 3.0, far):
        shapes += [rectangle(x_mm, end, 0.1, 3.0, 0), rectangle(end, y_mm, 3.0, 0.1, 0)]
    page_mm = side_mm + 2.0 * BORDER_MM
    return Drawing(page_mm, page_mm, tuple(shapes))


def _schedule(chart: Chart) -> str:
    """Return the table of settings as `todframes import --schedule` reads it, files and times still empty."""
    header = ["file", "start_s", "end_s", "orientation", "size_mrad", "delta_t_k", "polarity"]
    holes = [hole for page in chart.pages for hole in page.triangles]
    empty = ["", "", ""]
    rows = [[*empty, hole.orientation, hole.size_mrad, abs(hole.strength), chart.polarity] for hole in holes]
    return csv_text([header, *rows])
