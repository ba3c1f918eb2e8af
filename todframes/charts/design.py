"""The triangles of a chart, the order in which they are shown, and the page by which a camera is measured.

All combinations of size, level and orientation appear once in each block, and each block has its own random order.
So they are equally frequent, also in a recording that ends early, and a slow drift of camera or light favours none
of them.

That page has a slanted square for the MTF, and a grey wedge for the noise. The square is turned by arctan(1/8): on
a monitor its sides then are stairs with one step every eight pixels, whose mean profile is an edge blurred by the
width of just one pixel. That is known, so it can be divided out of an MTF.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from msgspec import Meta

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import check_values
from todframes.charts.layout import (
    LARGEST_ON_CHART,
    MOST_PAGES,
    Chart,
    Edge,
    Length,
    Page,
    Patch,
    Triangle,
)
from todframes.frames.surround import REACH_IN_SIZES
from todframes.parameters import ChartKind
from todframes.stimulus import ORIENTATIONS, Orientation

FIELD_PER_SIZE = 5.0
"""Side of the square around a triangle that is kept free, in sizes: the width of the observer's field."""

SURROUND_PER_SIZE = 2.0 * REACH_IN_SIZES
"""Side of the square around a triangle that markers along the borders keep free, in sizes: its background is
measured there."""

STEEPNESS = 8
"""Pixels along a side of the square for a step of one."""

SQUARE_SHARE = 0.45
"""Largest part of the width that the square and its surround take."""

SIDE_SHARE = 0.5
"""Side of the square relative to that of its surround."""

N_PATCHES = 12
"""Number of patches of the wedge; the first has the grey of the background."""

EDGE_RATIO, BRIGHTEST = 3.0, 0.9
"""Grey of the square relative to the background, and the largest relative to white: a brighter background gets a
darker square."""


class Condition(NamedTuple):
    """A triangle to show: its size, its level without sign, and its orientation."""

    size_mrad: float
    level: float
    orientation: Orientation


@dataclass(frozen=True, slots=True, kw_only=True)
class Design:
    """Triangles, distance and order of a chart. Sizes are √(area) in object space; levels are contrasts, or
    temperature differences in K, without sign. Each value is there once. `repeats` is the number of blocks. With a
    polarity of 1, triangles are brighter (warmer) than their background. Raises SettingsError if a value is out of
    range, or there are more triangles than pages can be numbered.
    """

    distance_m: Length
    sizes_mrad: tuple[float, ...]
    levels: tuple[float, ...]
    repeats: Annotated[int, Meta(ge=1)] = 1
    seed: Annotated[int, Meta(ge=0)] = 1
    polarity: Literal[1, -1] = 1
    name: str = "todframes chart"

    def __post_init__(self) -> None:
        check_values(self)
        for name, values in (("sizes_mrad", self.sizes_mrad), ("contrasts or delta_t_k", self.levels)):
            if not values:
                raise SettingsError(f"{name}: found none, expected at least one")
            for value in values:
                if not (math.isfinite(value) and 1.0 / LARGEST_ON_CHART <= value <= LARGEST_ON_CHART):
                    raise SettingsError(
                        f"{name}: found {value!r}, expected numbers from {1.0 / LARGEST_ON_CHART:g} "
                        f"to {LARGEST_ON_CHART:g}"
                    )
            if len(set(values)) < len(values):
                raise SettingsError(f"{name}: found {', '.join(map(repr, values))}, expected each value once")
        if not self.name.isprintable():
            raise SettingsError(
                f"name: found {self.name!r}, expected a text of one line without control characters"
            )
        if self.n_triangles > MOST_PAGES:
            raise SettingsError(
                f"found {self.n_triangles} triangles (sizes × levels × 4 orientations × repeats), expected at "
                f"most {MOST_PAGES}, the number of pages that markers can distinguish"
            )

    @property
    def n_triangles(self) -> int:
        """Number of triangles in all blocks."""
        return len(self.sizes_mrad) * len(self.levels) * len(ORIENTATIONS) * self.repeats

    def size_mm(self, size_mrad: float) -> float:
        """Return √(area) on the page."""
        return size_mrad * self.distance_m

    def triangle(
        self, condition: Condition, *, x_mm: float, y_mm: float, contrast: float, dithered: bool = False
    ) -> Triangle:
        """Return the description of a triangle that is drawn with a Weber contrast, to six digits. It has the
        contrast asked for as well, if that is another. Its centroid is at (x_mm, y_mm) of the page.
        """
        drawn, asked = float(f"{contrast:.6g}"), self.polarity * condition.level
        return Triangle(
            orientation=condition.orientation,
            size_mrad=condition.size_mrad,
            size_mm=self.size_mm(condition.size_mrad),
            x_mm=x_mm,
            y_mm=y_mm,
            contrast=drawn,
            contrast_asked=None if drawn == asked else asked,
            dithered=dithered,
        )

    def check_size(self, size_mrad: float, least_mm: float, why: str) -> float:
        """Return √(area) on the page; SettingsError, with the reason, if it is less than a least one."""
        size_mm = self.size_mm(size_mrad)
        if size_mm < least_mm:
            raise SettingsError(
                f"sizes_mrad: {size_mrad:g} mrad at {self.distance_m:g} m are {size_mm:.3g} mm, {why}; expected "
                f"at least {least_mm:g} mm ({least_mm / self.distance_m:.3g} mrad), or a larger distance"
            )
        return size_mm

    def chart(
        self, kind: ChartKind, width_mm: float, height_mm: float, pages: Iterable[Page], **parts: Any
    ) -> Chart:
        """Return the chart with some pages and its key; `parts` are the screen and the markers, if any."""
        chart = Chart(
            kind=kind,
            name=self.name,
            seed=self.seed,
            distance_m=self.distance_m,
            page_width_mm=width_mm,
            page_height_mm=height_mm,
            polarity=self.polarity,
            pages=tuple(pages),
            **parts,
        )
        return chart.with_key()

    @property
    def conditions(self) -> list[Condition]:
        """All combinations of size, level and orientation."""
        return [
            Condition(size, level, orientation)
            for size in self.sizes_mrad
            for level in self.levels
            for orientation in ORIENTATIONS
        ]

    def order(self) -> list[Condition]:
        """Return `repeats` blocks of all conditions, each block in a random order of its own."""
        streams = map(np.random.default_rng, np.random.SeedSequence(self.seed).spawn(self.repeats))
        conditions = self.conditions
        return [conditions[k] for rng in streams for k in rng.permutation(len(conditions))]


class CameraContent(NamedTuple):
    """The content of a page for measuring a camera. It has the corners of the slanted square, clockwise, shape (4,
    2), and its code value; left, top, width and height of each patch, and their code values; and the description
    of the page.
    """

    square_mm: FloatArray
    square_code: int
    patches_mm: list[tuple[float, float, float, float]]
    patch_codes: list[int]
    page: Page


def grey_patches(
    places_mm: Sequence[tuple[float, float, float, float]], levels: Sequence[float], quantity: str
) -> tuple[Patch, ...]:
    """Return patches, given left, top, width and height, with levels of a quantity to six digits. The quantity is
    "luminance_cd_m2" or "reflectance".
    """
    return tuple(
        Patch(
            x_mm=left + width / 2.0,
            y_mm=top + height / 2.0,
            width_mm=width,
            height_mm=height,
            **{quantity: float(f"{level:.6g}")},
        )
        for (left, top, width, height), level in zip(places_mm, levels, strict=True)
    )


def camera_content(
    area_mm: tuple[float, float, float, float],
    light_of_code: FloatArray,
    quantity: str,
    background_code: int,
    file: str,
    *,
    step_mm: float | None = None,
) -> CameraContent:
    """Lay out the square and the wedge in a free area of the first page, the wedge at its right. The area is
    (left, top, width, height). `light_of_code` has the luminance or reflectance, the quantity, of all code values,
    rising. Borders of patches are multiples of `step_mm`, if there is one.
    """
    left_mm, top_mm, width_mm, height_mm = area_mm
    surround_mm = min(height_mm, SQUARE_SHARE * width_mm)
    half_mm = SIDE_SHARE * surround_mm / 2.0
    turn = math.atan(1.0 / STEEPNESS)
    along = np.array([math.cos(turn), math.sin(turn)])
    across = np.array([-along[1], along[0]])
    middle = np.array([left_mm + surround_mm / 2.0, top_mm + height_mm / 2.0])
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    square_mm = middle + half_mm * (signs[:, :1] * along + signs[:, 1:] * across)
    reach_mm = half_mm * (math.cos(turn) + math.sin(turn))
    wedge_mm = left_mm + surround_mm, width_mm - surround_mm
    n_columns = 4 if wedge_mm[1] >= height_mm else 3
    n_rows = N_PATCHES // n_columns
    xs = _grid(*wedge_mm, n_columns, step_mm)
    ys = _grid(top_mm, height_mm, n_rows, step_mm)
    patches = []
    for row in range(n_rows):
        # From row to row to and fro, so that neighbours have neighbouring greys.
        for column in range(n_columns) if row % 2 == 0 else reversed(range(n_columns)):
            patches.append((xs[column], ys[row], xs[column + 1] - xs[column], ys[row + 1] - ys[row]))
    free_mm = min(surround_mm / 2.0 - reach_mm, half_mm)
    ends = np.column_stack([square_mm, np.roll(square_mm, -1, axis=0)]).tolist()
    edges = tuple(Edge(x1_mm=x1, y1_mm=y1, x2_mm=x2, y2_mm=y2, free_mm=free_mm) for x1, y1, x2, y2 in ends)
    black, background, white = light_of_code[[0, background_code, -1]].tolist()
    bright = EDGE_RATIO * background
    wanted = bright if bright <= BRIGHTEST * white else background / EDGE_RATIO
    steps = np.linspace(black, white, N_PATCHES - 1)
    square, *codes = (int(np.argmin(np.abs(light_of_code - level))) for level in (wanted, *steps))
    codes = [background_code, *codes]
    greys = grey_patches(patches, light_of_code[codes].tolist(), quantity)
    return CameraContent(square_mm, square, patches, codes, Page(number=0, file=file, edges=edges, patches=greys))


def _grid(start_mm: float, length_mm: float, n: int, step_mm: float | None) -> list[float]:
    borders = [start_mm + length_mm * k / n for k in range(n + 1)]
    return borders if step_mm is None else [round(border / step_mm) * step_mm for border in borders]
