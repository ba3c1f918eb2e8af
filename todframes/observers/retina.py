"""Retina samples from display pixels, by exact area overlap."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes._typing import FloatArray
from todframes.errors import SettingsError

if TYPE_CHECKING:
    from scipy.sparse import csr_array


MOST_DENSE = 2**13
"""Largest number of values of an overlap matrix that is not kept sparse."""


@dataclass(frozen=True, slots=True)
class RetinaGrid:
    """A square grid of retina samples with one in its middle, the place the observer looks at.

    `side` is odd; `pitch_mrad` is the visual angle from one sample to the next and the width of each.
    """

    side: int
    pitch_mrad: float

    def __post_init__(self) -> None:
        if self.side < 1 or self.side % 2 == 0:
            raise SettingsError(f"side: found {self.side}, expected an odd number >= 1")
        if not (np.isfinite(self.pitch_mrad) and self.pitch_mrad > 0):
            raise SettingsError(f"pitch_mrad: found {self.pitch_mrad!r}, expected a finite number > 0")

    @property
    def width_mrad(self) -> float:
        """Visual angle of the whole grid, outer edge to outer edge."""
        return self.side * self.pitch_mrad

    def pixel_range(self, *, centre_px: float, pixel_pitch_mrad: float, n_pixels: int) -> tuple[int, int]:
        """Return the display pixels, half-open, that the grid touches when its middle lies at `centre_px`.

        Pixels outside of [0, n_pixels) do not exist and are left out; the range is empty when all are.
        """
        half_px = self.width_mrad / pixel_pitch_mrad / 2.0
        # Clipped first: floor and ceil of what lies beyond all pixels may be no integers.
        first = math.floor(min(max(centre_px - half_px + 0.5, 0.0), n_pixels))
        stop = math.ceil(min(max(centre_px + half_px + 0.5, first), n_pixels))
        return first, stop


class Overlaps(NamedTuple):
    """Pieces of an axis that lie in one retina sample and on one display pixel each, in the axis's order.

    Attributes
    ----------
    sample, pixel : ndarray of int, shape (pieces,)
        Ascending; pixels are counted from the first one.
    length : ndarray, shape (pieces,)
        In widths of a sample.
    """

    sample: NDArray[np.int32]
    pixel: NDArray[np.int32]
    length: FloatArray


def overlaps(
    grid: RetinaGrid, *, centre_px: float, pixel_pitch_mrad: float, first_pixel: int, n_pixels: int
) -> Overlaps:
    """Merge the boundaries of retina samples and display pixels along one axis.

    The pieces of a pixel inside the grid add up to its width, and those of a sample inside the display to one.

    Parameters
    ----------
    grid : RetinaGrid
    centre_px : float
        Place of the grid's middle, in display pixels of the whole frame.
    pixel_pitch_mrad : float
        Visual angle of a display pixel, > 0.
    first_pixel, n_pixels : int
        Pixels first_pixel ... first_pixel + n_pixels - 1 of the frame are there.

    Returns
    -------
    Overlaps
    """
    pixel_edges = _pixel_edges(grid, centre_px, pixel_pitch_mrad, first_pixel, n_pixels)
    inner = pixel_edges[(pixel_edges > 0.0) & (pixel_edges < grid.side)]
    edges = np.sort(np.concatenate([np.arange(grid.side + 1.0), inner]))
    length = np.diff(edges)
    middle = (edges[1:] + edges[:-1]) / 2.0
    sample = np.minimum(middle.astype(np.int32), grid.side - 1)
    pixel = (np.searchsorted(pixel_edges, middle) - 1).astype(np.int32)
    inside = (pixel >= 0) & (pixel < n_pixels) & (length > 0.0)
    return Overlaps(sample[inside], pixel[inside], length[inside])


def overlap_matrix(
    grid: RetinaGrid, *, centre_px: float, pixel_pitch_mrad: float, first_pixel: int, n_pixels: int
) -> csr_array:
    """Compute the share of each retina sample's width that lies on each display pixel, along one axis.

    Parameters
    ----------
    grid, centre_px, pixel_pitch_mrad, first_pixel, n_pixels
        The same as for `overlaps`.

    Returns
    -------
    sparse array, shape (grid.side, n_pixels)
        Rows sum to the share of the sample that lies on these pixels.
    """
    from scipy.sparse import csr_array

    sample, pixel, length = overlaps(
        grid, centre_px=centre_px, pixel_pitch_mrad=pixel_pitch_mrad, first_pixel=first_pixel, n_pixels=n_pixels
    )
    row_start = np.searchsorted(sample, np.arange(grid.side + 1, dtype=np.int32)).astype(np.int32)
    return csr_array((length, pixel, row_start), shape=(grid.side, n_pixels))


def _dense_overlap(
    grid: RetinaGrid, *, centre_px: float, pixel_pitch_mrad: float, first_pixel: int, n_pixels: int
) -> FloatArray:
    """Compute `overlap_matrix` as an array: if values are few, it takes half the time and no import of scipy."""
    pixel_edges = _pixel_edges(grid, centre_px, pixel_pitch_mrad, first_pixel, n_pixels)
    sample_edges = np.arange(grid.side + 1.0)[:, None]
    overlap = np.minimum(sample_edges[1:], pixel_edges[1:])
    overlap -= np.maximum(sample_edges[:-1], pixel_edges[:-1])
    return np.asarray(np.maximum(overlap, 0.0, out=overlap))


def _pixel_edges(
    grid: RetinaGrid, centre_px: float, pixel_pitch_mrad: float, first_pixel: int, n_pixels: int
) -> FloatArray:
    """Boundaries of display pixels in retina samples, the outer edge of the first sample at 0: (n_pixels + 1,)."""
    samples_per_pixel = pixel_pitch_mrad / grid.pitch_mrad
    return np.asarray(
        (np.arange(n_pixels + 1.0) + (first_pixel - 0.5 - centre_px)) * samples_per_pixel + grid.side / 2.0
    )


def resample(
    contrast: FloatArray,
    grid: RetinaGrid,
    *,
    x_px: float,
    y_px: float,
    pixel_pitch_mrad: float,
    first_row: int = 0,
    first_column: int = 0,
) -> FloatArray:
    """Average the contrast over each retina sample's own area, the display taken as piecewise constant.

    Parameters
    ----------
    contrast : ndarray, shape (rows, columns)
        Part of a frame whose first pixel is (first_row, first_column); elsewhere the contrast is 0.
    grid : RetinaGrid
    x_px, y_px : float
        Place of the grid's middle on the frame.
    pixel_pitch_mrad : float
        Visual angle of a display pixel, > 0.

    Returns
    -------
    ndarray, shape (grid.side, grid.side)

    Hogervorst et al. 2001, section 4.1.
    """
    top, part = resampled_rows(
        contrast,
        grid,
        x_px=x_px,
        y_px=y_px,
        pixel_pitch_mrad=pixel_pitch_mrad,
        first_row=first_row,
        first_column=first_column,
    )
    if len(part) == grid.side:
        return part
    image = np.zeros((grid.side, grid.side))
    image[top : top + len(part)] = part
    return image


def resampled_rows(
    contrast: FloatArray,
    grid: RetinaGrid,
    *,
    x_px: float,
    y_px: float,
    pixel_pitch_mrad: float,
    first_row: int,
    first_column: int,
) -> tuple[int, FloatArray]:
    """Those rows of `resample` that the pixels touch, and the number of the first; parameters are the same."""
    touched = [
        grid.pixel_range(centre_px=at - first, pixel_pitch_mrad=pixel_pitch_mrad, n_pixels=n_pixels)
        for at, first, n_pixels in zip((y_px, x_px), (first_row, first_column), contrast.shape, strict=True)
    ]
    contrast = contrast[slice(*touched[0]), slice(*touched[1])]
    first_row, first_column = first_row + touched[0][0], first_column + touched[1][0]
    n_rows, n_columns = contrast.shape
    edges = _pixel_edges(grid, y_px, pixel_pitch_mrad, first_row, n_rows)
    top = min(max(math.floor(edges[0]), 0), grid.side)
    bottom = max(min(math.ceil(edges[-1]), grid.side), top)
    if not (top < bottom and n_rows and n_columns):
        return top, np.zeros((0, grid.side))
    if pixel_pitch_mrad >= grid.pitch_mrad:
        column_edges = _pixel_edges(grid, x_px, pixel_pitch_mrad, first_column, n_columns)
        across = _averaged(contrast.T, column_edges, 0, grid.side)
        return top, _averaged(across.T, edges, top, bottom)
    is_dense = grid.side * max(n_rows, n_columns) <= MOST_DENSE
    overlap = _dense_overlap if is_dense else overlap_matrix
    rows = overlap(grid, centre_px=y_px, pixel_pitch_mrad=pixel_pitch_mrad, first_pixel=first_row, n_pixels=n_rows)
    columns = overlap(
        grid, centre_px=x_px, pixel_pitch_mrad=pixel_pitch_mrad, first_pixel=first_column, n_pixels=n_columns
    )
    if bottom - top < grid.side:
        rows = rows[top:bottom]
    if is_dense:
        return top, np.asarray(rows @ contrast @ columns.T)
    # Either order is exact; the larger array is the one not to make, or to copy.
    if n_rows > grid.side:
        return top, np.asarray((columns @ (rows @ contrast).T).T)
    return top, np.asarray(rows @ (columns @ contrast.T).T)


def _averaged(values: FloatArray, edges: FloatArray, first: int, stop: int) -> FloatArray:
    """Average pixels that are no narrower than a sample over each sample's width, along the first axis.

    Such a sample lies on one pixel or on two: this takes half the time of a sparse matrix.

    Parameters
    ----------
    values : ndarray, shape (pixels, m)
    edges : ndarray, shape (pixels + 1,)
        Boundaries of the pixels in samples; beyond them the values are 0.
    first, stop : int
        Samples first ... stop - 1.

    Returns
    -------
    ndarray, shape (stop - first, m)
    """
    # Row 2k + 1 is what a sample sees of both sides of edge k; the others are the pixels, between rows of zeros.
    rows = np.zeros((2 * len(values) + 3, values.shape[1]))
    rows[2:-1:2] = values
    beyond = (np.ceil(edges) - edges)[:, None]
    rows[1::2] = (1.0 - beyond) * rows[:-1:2]
    rows[1::2] += beyond * rows[2::2]
    start = np.arange(first, stop, dtype=np.float64)
    row = np.searchsorted(edges, start, side="right") + np.searchsorted(edges, start + 1.0, side="left")
    return rows.take(row, axis=0)


def gaussian_blur(image: FloatArray, sigma: float) -> FloatArray:
    """Blur a retina image by a Gaussian of standard deviation `sigma` samples, mirrored at its border.

    Only where there is something to blur: a triangle covers little of its grid.
    """
    import cv2

    # Cut at 8 standard deviations, where the kernel is 1e-14 of its middle.
    reach = int(8.0 * sigma + 0.5)
    filled = [np.flatnonzero(image.any(axis=axis)) for axis in (1, 0)]
    if any(len(places) == 0 for places in filled):
        return image.copy()
    kernel = cv2.getGaussianKernel(2 * reach + 1, sigma, cv2.CV_64F)
    box = tuple(slice(max(places[0] - 2 * reach, 0), places[-1] + 2 * reach + 1) for places in filled)
    blurred = np.zeros_like(image)
    # Two reaches of zeros about what is filled: the mirror image of the box's own border is zero there.
    blurred[box] = cv2.sepFilter2D(image[box], cv2.CV_64F, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
    return blurred
