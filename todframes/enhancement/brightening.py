"""The change of a picture's brightness by an algorithm, measured around the triangle."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.display.display import check_background
from todframes.frames.surround import (
    BIWEIGHT,
    LEAST_RING_PX,
    Range,
    TrianglePlace,
    hole_radius_px,
    median,
    surround_window,
)

BAND_BLOCKS_PER_SIZE, LEAST_BAND_BLOCK_PX = 2, 4
"""Number of square blocks along a triangle's size in which two pictures are compared, and their least side: in
larger ones single bad pixels average out, in smaller ones the edge of a frame stays apart."""


def background_factor(
    before: Callable[[slice, slice], FloatArray],
    after: Callable[[slice, slice], FloatArray],
    triangle: TrianglePlace,
    *,
    rows: Range,
    columns: Range,
    magnification: float = 1.0,
) -> float:
    """Return the factor by which a picture is brighter than another in a band around the triangle. The band is
    that of `surround_window`; in a frame that is large enough, it leaves out what lies next to the frame's edge,
    where filters act otherwise. The factor is the quotient of two means over the same blocks, without those whose
    luminances deviate from it. `before` and `after` return the luminance of rows and columns of the two pictures
    in cd/m²: `after` has `magnification` pixels, along each axis, for one of `before`, in whose pixels the
    triangle and the frame are given. Raises DataError if most of the band has no light.
    """
    block_px = max(int(triangle.size_px / BAND_BLOCKS_PER_SIZE), LEAST_BAND_BLOCK_PX)
    block_px = math.ceil(block_px / min(magnification, 1.0))
    hole = hole_radius_px(triangle.size_px)
    least = 2.0 * (hole + LEAST_RING_PX + block_px)
    inner_rows, inner_columns = (
        (first + block_px, stop - block_px) if stop - first >= least else (first, stop)
        for first, stop in (rows, columns)
    )
    window = surround_window(triangle, rows=inner_rows, columns=inner_columns)
    edges = [
        np.append(np.arange(first, max(stop - block_px, first) + 1, block_px), stop) for first, stop in window
    ]
    y, x = ((edge[1:] + edge[:-1] - 1) / 2.0 for edge in edges)
    away = np.hypot(y[:, None] - triangle.y_px, x - triangle.x_px) - hole
    around = away >= min(block_px / 2.0, float(away.max()))  # in a narrow frame, its corners
    from_first = [edge - first for edge, (first, _) in zip(edges, (rows, columns), strict=True)]
    means_before = _block_means(before, from_first, 1.0)[around]
    means_after = _block_means(after, from_first, magnification)[around]
    check_background(middle := median(means_before))
    factor = median(means_after) / middle
    for _ in range(6):
        apart = np.abs(means_after - factor * means_before)
        limit = BIWEIGHT * max(1.4826 * median(apart), 1e-9 * middle)
        weights = np.square(1.0 - np.square(np.minimum(apart, limit) / limit))
        check_background(mean := float(weights @ means_before / weights.sum()))
        factor = float(weights @ means_after / weights.sum()) / mean
    return factor


def _block_means(
    luminance: Callable[[slice, slice], FloatArray], edges: Sequence[NDArray[np.intp]], scale: float
) -> FloatArray:
    """Return the mean luminance of each block; `edges` are those of rows and of columns, in pixels / `scale`."""
    y, x = (np.floor(scale * edge + 0.5).astype(np.intp) for edge in edges)
    pixels = luminance(slice(y[0], y[-1]), slice(x[0], x[-1]))
    sums = np.add.reduceat(np.add.reduceat(pixels, x[:-1] - x[0], axis=1), y[:-1] - y[0], axis=0)
    return np.asarray(sums / (np.diff(y)[:, None] * np.diff(x)))
