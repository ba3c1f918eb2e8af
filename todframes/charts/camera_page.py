"""The page by which a camera is measured: a slanted square for its MTF, and a grey wedge for its noise.

The square is turned by arctan(1/8): on a monitor its sides then are stairs with one step every eight pixels, whose
mean profile is an edge blurred by the width of just one pixel. That is known, so it can be divided out of an MTF.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from todframes.base._typing import FloatArray
from todframes.charts.layout import Edge, Patch

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


class CameraContent(NamedTuple):
    """The places of what a page for measuring a camera shows.

    `square_mm` has the corners of the slanted square, clockwise, shape (4, 2); within `free_mm` of its sides there
    is nothing else. `patches_mm` has left, top, width and height of each patch.
    """

    square_mm: FloatArray
    free_mm: float
    patches_mm: list[tuple[float, float, float, float]]

    @property
    def edges(self) -> tuple[Edge, ...]:
        """The sides of the square."""
        ends = np.column_stack([self.square_mm, np.roll(self.square_mm, -1, axis=0)]).tolist()
        return tuple(Edge(x1_mm=x1, y1_mm=y1, x2_mm=x2, y2_mm=y2, free_mm=self.free_mm) for x1, y1, x2, y2 in ends)


def grey_patches(
    places_mm: Sequence[tuple[float, float, float, float]], levels: Sequence[float], quantity: str
) -> tuple[Patch, ...]:
    """Return patches, given left, top, width and height, with levels of a quantity to six digits.

    The quantity is "luminance_cd_m2" or "reflectance".
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
    left_mm: float, top_mm: float, width_mm: float, height_mm: float, *, step_mm: float | None = None
) -> CameraContent:
    """Lay out the square and the wedge in a free area of a page, the wedge at its right.

    Borders of patches are multiples of `step_mm`, if there is one.
    """
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
    return CameraContent(square_mm, min(surround_mm / 2.0 - reach_mm, half_mm), patches)


def _grid(start_mm: float, length_mm: float, n: int, step_mm: float | None) -> list[float]:
    borders = [start_mm + length_mm * k / n for k in range(n + 1)]
    return borders if step_mm is None else [round(one / step_mm) * step_mm for one in borders]


def camera_codes(light_of_code: FloatArray, background_code: int) -> tuple[int, list[int]]:
    """Return the code values of the square and the patches, given the luminance or reflectance of all, rising."""
    black, background, white = light_of_code[[0, background_code, -1]].tolist()
    bright = EDGE_RATIO * background
    wanted = bright if bright <= BRIGHTEST * white else background / EDGE_RATIO
    steps = np.linspace(black, white, N_PATCHES - 1)
    square, *patches = (int(np.argmin(np.abs(light_of_code - one))) for one in (wanted, *steps))
    return square, [background_code, *patches]
