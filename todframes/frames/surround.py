"""The luminance of the background about a triangle: a smooth surface, fitted robustly to the pixels around it."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError

Range = tuple[int, int]

HOLE_IN_SIZES, HOLE_MARGIN_PX = 1.1, 2.0
"""Radius about the centroid within which the triangle, turned or mirrored too, may lie: its corners
are at 0.88 sizes."""

REACH_IN_SIZES, LEAST_RING_PX = 3.0, 8.0
"""Distance from the centroid to the window's edges, in sizes, and the least distance beyond the hole in pixels."""

BLOCKS_PER_SIZE = 4
"""Number of square blocks along a triangle's size; the surface is fitted to their means."""

STEP, STEP_NEXT_TO_HOLE, STEP_IN_ERRORS = 0.03, 0.1, 6.0
"""Relative change from block to block that ends the background, unless it is within `STEP_IN_ERRORS` standard
errors. Next to the hole a larger one is allowed, because the slope of the background is not known there."""

BIWEIGHT = 6.0
"""Deviation at which a block has no weight in the surface, in standard deviations of the blocks."""

DEGREES = (2, 1, 4)
"""Degrees of the surface that are tried after the constant, in this order. The first degree is tried only if the
blocks do not determine the second."""

BETTER = 1.1
"""Factor by which the second degree must describe the blocks better than a constant; noise alone hardly reaches
it. The fourth degree needs the square of this factor, the first degree its square root."""

EVEN = 1e-4
"""Relative deviation of the blocks from the surface below which no higher degree is tried."""


class TrianglePlace(NamedTuple):
    """The centroid of a triangle and its size √(area), in pixels of a frame."""

    x_px: float
    y_px: float
    size_px: float


class Window(NamedTuple):
    """Half-open ranges of rows and columns of a frame."""

    rows: Range
    columns: Range


def hole_radius_px(size_px: float) -> float:
    """Return the radius about the centroid within which the triangle may lie, in pixels."""
    return HOLE_IN_SIZES * size_px + HOLE_MARGIN_PX


def surround_window(triangle: TrianglePlace, *, rows: Range, columns: Range) -> Window:
    """Return the square about a triangle that its background is measured in, clipped to the given ranges."""
    size_px = min(triangle.size_px, 1e9)
    reach = max(REACH_IN_SIZES * size_px, hole_radius_px(size_px) + LEAST_RING_PX)
    return Window(*(_clipped(at, reach, *span) for at, span in ((triangle.y_px, rows), (triangle.x_px, columns))))


def _clipped(at: float, reach: float, first: int, stop: int) -> Range:
    begin, end = (min(max(round(at + way), first), stop) for way in (-reach, reach))
    return begin, min(end + 1, stop)


_NOT_CONSTANT = np.ones((5, 5), np.bool_)
_NOT_CONSTANT[0, 0] = False


class Surface(NamedTuple):
    """A background: a polynomial of the position, within the part of the window that it describes. The luminance
    in cd/m² is Σ c[i, j] v^i u^j with `coefficients` of shape (5, 5), u and v the distances along x and y from
    `middle`, the row and column of the pixel at the triangle's centroid, in units of `scale_px`. The rows and
    columns of `extent`, a part of the searched `window`, belong to the background; beyond them lies something
    else, such as a dark border. `noise_cd_m2` is the standard deviation of the means of neighbouring blocks.
    """

    coefficients: FloatArray
    middle: tuple[int, ...]
    scale_px: float
    extent: Window
    window: Window
    noise_cd_m2: float

    def luminance(self, rows: Range, columns: Range) -> FloatArray:
        """Compute the background's luminance in cd/m² in half-open ranges of rows and columns: (rows, columns)."""
        if not self.coefficients.any(where=_NOT_CONSTANT):
            return np.full((rows[1] - rows[0], columns[1] - columns[0]), self.middle_cd_m2)
        return self.luminance_at(*(np.arange(*span, dtype=np.float64) for span in (rows, columns)))

    def luminance_at(self, y_px: FloatArray, x_px: FloatArray) -> FloatArray:
        """Compute the background's luminance in cd/m² at all pairs of two sets of places: (y, x)."""
        v, u = (
            ((places - at) / self.scale_px)[:, None] ** np.arange(5)
            for places, at in zip((y_px, x_px), self.middle, strict=True)
        )
        return np.asarray(v @ self.coefficients @ u.T)

    def has(self, y_px: FloatArray, x_px: FloatArray) -> NDArray[np.bool_]:
        """Return which pairs of two sets of places belong to the background: (y, x)."""
        inside = (
            (places > first - 0.5) & (places < stop - 0.5)
            for places, (first, stop) in zip((y_px, x_px), self.extent, strict=True)
        )
        return np.asarray(np.logical_and.outer(*inside))

    @property
    def middle_cd_m2(self) -> float:
        """The luminance at the triangle's centroid."""
        return float(self.coefficients[0, 0])

    def contrast(self, luminance: FloatArray, row: int, column: int) -> FloatArray:
        """Compute the Weber contrast of a rectangle of luminance whose first pixel is at (row, column). Pixels
        that do not belong to the background or the triangle are shown as background: 0.
        """
        n_rows, n_columns = luminance.shape
        contrast = luminance / self.luminance((row, row + n_rows), (column, column + n_columns)) - 1.0
        (top, bottom), (left, right) = self.extent
        contrast[: max(top - row, 0)] = 0.0
        contrast[max(bottom - row, 0) :] = 0.0
        contrast[:, : max(left - column, 0)] = 0.0
        contrast[:, max(right - column, 0) :] = 0.0
        return contrast


def block_sums(values: FloatArray, row: int, column: int, block_px: int) -> tuple[FloatArray, tuple[int, int]]:
    """Sum a rectangle over square blocks; return the sums and the row and column of the first block. The first
    value is at (row, column) of a grid of blocks that begins at (0, 0).
    """
    first = row // block_px, column // block_px
    if block_px == 1:
        return values, first
    sums = values
    for axis, begin in ((1, column), (0, row)):
        blocks = (begin + np.arange(values.shape[axis])) // block_px
        sums = np.add.reduceat(sums, np.flatnonzero(np.diff(blocks, prepend=-1)), axis=axis)
    return sums, first


class SurroundSums:
    """Sums of the luminance over square blocks of a window, collected band by band."""

    def __init__(self, triangle: TrianglePlace, window: Window) -> None:
        self.triangle, self.window = triangle, window
        self.block_px = max(int(triangle.size_px / BLOCKS_PER_SIZE), 1)
        self.sums = np.zeros([math.ceil((stop - first) / self.block_px) for first, stop in window])

    def add(self, luminance: FloatArray, row: int, column: int) -> None:
        """Add a rectangle of luminance with all columns of the window, its first pixel at (row, column)."""
        (top, bottom), (left, right) = self.window
        part = luminance[max(top - row, 0) : max(bottom - row, 0), left - column : right - column]
        if part.size:
            sums, (first, _) = block_sums(part, max(row, top) - top, 0, self.block_px)
            self.sums[first : first + len(sums)] += sums

    def surface(self) -> Surface:
        """Fit the background. First the extent of the background is found: in each of the four directions, from
        the triangle outwards, it ends at the first row or column of blocks whose median differs from a prediction
        from those before it. A surface is then fitted to the blocks around the triangle, outliers without weight.
        It is a constant unless a higher degree describes the blocks better and is as certain under the triangle as
        the mean of one block. Raises DataError if the window has no pixels around the triangle, or the background
        is not positive.
        """
        window, triangle = self.window, self.triangle
        centroid = triangle.y_px, triangle.x_px
        middle = tuple(
            round(min(max(at, first), stop - 1)) for at, (first, stop) in zip(centroid, window, strict=True)
        )
        spans = tuple((first - at, stop - at) for at, (first, stop) in zip(middle, window, strict=True))
        hole = hole_radius_px(triangle.size_px)
        blocks = _SurroundBlocks.of(spans, self.block_px, hole)
        if not blocks.around.any():
            raise DataError(
                "no pixels around the triangle to take the background from: the frame reaches no farther than "
                f"{hole / triangle.size_px:.2g} sizes from its centroid; expected a larger frame, or "
                "background_luminance_cd_m2 as a number"
            )
        means = self.sums / blocks.counts
        noise = blocks.noise(means)
        kept = blocks.extent(means)
        fitted = _SurfaceFit.of(spans, self.block_px, hole, *kept)
        coefficients = fitted.surface(means, noise)
        extent = Window(*(
            (int(edges[first]) + at, int(edges[stop]) + at)
            for edges, (first, stop), at in zip(blocks.edges, kept, middle, strict=True)
        ))  # fmt: skip
        return Surface(coefficients, middle, fitted.scale_px, extent, window, noise)


Spans = tuple[Range, ...]
"""The rows and columns of a window, counted from the pixel at the triangle's centroid."""


class _SurroundBlocks(NamedTuple):
    """The square blocks of a window: their edges and middles along y and x, those around and next to the hole."""

    edges: tuple[NDArray[np.intp], ...]
    y: FloatArray
    x: FloatArray
    counts: NDArray[np.intp]
    around: NDArray[np.bool_]
    near: NDArray[np.bool_]
    hole: float

    @staticmethod
    @lru_cache(maxsize=64)
    def of(spans: Spans, block_px: int, hole: float) -> _SurroundBlocks:
        edges = tuple(np.append(np.arange(first, stop, block_px), stop) for first, stop in spans)
        y, x = ((edge[1:] + edge[:-1] - 1) / 2.0 for edge in edges)
        away = np.hypot(y[:, None], x) - hole - block_px / 2.0
        counts = np.diff(edges[0])[:, None] * np.diff(edges[1])
        near = (away > 0.0) & (away <= max(2 * block_px, float(away.max()) / 8.0))
        return _SurroundBlocks(edges, y, x, counts, away > 0.0, near if near.any() else away > 0.0, hole)

    def noise(self, means: FloatArray) -> float:
        """Estimate the standard deviation of a block's mean from triples of neighbours, in which a slope
        cancels."""
        bends = []
        for values, known in ((means, self.around), (means.T, self.around.T)):
            bend = values[2:] - 2.0 * values[1:-1] + values[:-2]
            bends.append(bend[known[2:] & known[1:-1] & known[:-2]])
        all_bends = np.concatenate(bends)
        return 1.4826 * median(np.abs(all_bends)) / math.sqrt(6.0) if all_bends.size else 0.0

    def extent(self, means: FloatArray) -> tuple[Range, Range]:
        """Return the rows and the columns of blocks that belong to the background."""
        near = means[self.near]
        scatter = 1.4826 * median(np.abs(near - median(near)))
        rows = self._kept(means, self.y, self.x, scatter)
        columns = self._kept(means.T, self.x, self.y, scatter)
        if self.around[slice(*rows), slice(*columns)].any():
            return rows, columns
        return (0, means.shape[0]), (0, means.shape[1])

    def _kept(self, means: FloatArray, at: FloatArray, across: FloatArray, scatter: float) -> Range:
        strip, inner = np.abs(across) <= self.hole, np.flatnonzero(np.abs(at) <= self.hole)
        profile = np.median(means[:, strip], axis=1)
        error = 2.0 * scatter / math.sqrt(np.count_nonzero(strip))  # neighbours are alike in a blurred frame
        first, stop = int(inner[0]), int(inner[-1]) + 1
        return first - _n_alike(profile[:first][::-1], error), stop + _n_alike(profile[stop:], error)


def _n_alike(profile: FloatArray, error: float) -> int:
    """Count the leading values that agree with a prediction from the values before them."""
    for k in range(1, len(profile)):
        if k == 1:
            expected, slack, factor = profile[0], STEP_NEXT_TO_HOLE, math.sqrt(2.0)
        else:
            expected, slack, factor = 2.0 * profile[k - 1] - profile[k - 2], STEP, math.sqrt(6.0)
        if abs(profile[k] - expected) > max(slack * abs(profile[0]), STEP_IN_ERRORS * factor * error):
            return k
    return len(profile)


class _SurfaceFit(NamedTuple):
    """The blocks that a surface is fitted to, their shares of pixels, and the terms of each degree at them."""

    places: tuple[NDArray[np.intp], ...]
    share: FloatArray
    terms: dict[int, FloatArray]
    scale_px: float

    @staticmethod
    @lru_cache(maxsize=64)
    def of(spans: Spans, block_px: int, hole: float, rows: Range, columns: Range) -> _SurfaceFit:
        blocks = _SurroundBlocks.of(spans, block_px, hole)
        within = np.zeros_like(blocks.around)
        within[slice(*rows), slice(*columns)] = True
        places = np.nonzero(within & blocks.around)
        y, x = blocks.y[places[0]], blocks.x[places[1]]
        scale = max(float(np.abs(y).max()), float(np.abs(x).max()), 1.0)
        terms = {}
        for degree in DEGREES:
            if not (degree == 1 and 2 in terms) and _is_known(degree, x / scale, y / scale, hole / scale):
                terms[degree] = _terms(x / scale, y / scale, degree)
        return _SurfaceFit(places, blocks.counts[places] / block_px**2, terms, scale)

    def surface(self, block_means: FloatArray, noise: float) -> FloatArray:
        """Fit a surface; return its coefficients, (5, 5)."""
        means = block_means[self.places]
        degree, (fitted, scale) = 0, _robust(np.ones((len(means), 1)), means, self.share)
        if not fitted[0] > 0.0:
            raise DataError(f"background luminance around the triangle is {fitted[0]:g} cd/m², expected > 0")
        for higher, terms in self.terms.items():
            if scale <= max(BETTER * noise, EVEN * fitted[0]):
                break
            of_higher, of_scale = _robust(terms, means, self.share)
            if of_scale * BETTER ** (higher / 2.0) < scale and float((terms @ of_higher).min()) > 0.0:
                degree, fitted, scale = higher, of_higher, of_scale
        coefficients = np.zeros((5, 5))
        for (i, j), value in zip(_exponents(degree), fitted, strict=True):
            coefficients[i, j] = value
        return coefficients


def _exponents(degree: int) -> list[tuple[int, int]]:
    """Return the exponents of v and u in the terms of a polynomial, the constant first."""
    return [(i, total - i) for total in range(degree + 1) for i in range(total + 1)]


def _terms(u: FloatArray, v: FloatArray, degree: int) -> FloatArray:
    """Compute the terms of a polynomial at n places: (n, terms)."""
    return np.stack([v**i * u**j for i, j in _exponents(degree)], axis=1)


def _is_known(degree: int, u: FloatArray, v: FloatArray, hole: float) -> bool:
    """Return whether a surface through blocks at (u, v) is as certain under the triangle as the mean of one
    block."""
    terms = _terms(u, v, degree)
    at_hole = _terms(hole * np.array([0, 1, -1, 0, 0]), hole * np.array([0, 0, 0, 1, -1]), degree)
    normal = terms.T @ terms
    if len(u) < 2 * terms.shape[1] or np.linalg.cond(normal) > 1e10:
        return False
    return bool(np.einsum("ij,ij->i", at_hole @ np.linalg.inv(normal), at_hole).max() <= 1.0)


def _robust(terms: FloatArray, means: FloatArray, share: FloatArray) -> tuple[FloatArray, float]:
    """Fit terms to the means of blocks; return their factors and the standard deviation of the blocks. The first
    steps minimise absolute deviations, which finds the majority; in the last, outliers have no weight.
    """
    if terms.shape[1] == 1:
        solution, first = np.array([median(means)]), 3
    else:
        solution, first = np.linalg.lstsq(terms, means, rcond=None)[0], 1
    scale, floor = 0.0, 1e-9 * (median(np.abs(means)) or float(np.abs(means).max())) + 1e-300
    for step in range(first, 6):
        away = np.abs(means - terms @ solution)
        scale = max(1.4826 * median(away), floor)
        if step < 3:
            weights = share / np.maximum(away, scale / 2.0)
        else:
            weights = share * np.square(np.maximum(1.0 - np.square(away / (BIWEIGHT * scale)), 0.0))
        weighted = terms.T * weights
        solution = np.linalg.solve(weighted @ terms, weighted @ means)
    return solution, scale


def median(values: FloatArray) -> float:
    """Return the median; that of NumPy takes many times as long for a few hundred values."""
    middle = (len(values) - 1) // 2, len(values) // 2
    parted = np.partition(values, middle)
    return float(parted[middle[0]] + parted[middle[1]]) / 2.0
