"""Retina samples from display pixels, by exact area overlap."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import check_positive

if TYPE_CHECKING:
    from scipy.sparse import csr_array


MOST_DENSE = 2**13
"""Largest number of values of an overlap matrix that is not sparse: it takes less time, and no import of scipy."""

MOST_SUMMED = 512
"""Largest side of a grid whose weights are summed, which then take 17 MB."""

MOST_PIXELS_A_SAMPLE = 1.0 / 12.0
"""Largest number of pixels for each sample of the grid at which products by sums take less time."""


@dataclass(frozen=True, slots=True)
class RetinaGrid:
    """A square grid of retina samples. The observer looks at the place of its middle sample.

    Attributes
    ----------
    side : int
        Number of samples along each side, odd.
    pitch_mrad : float
        Visual angle from one sample to the next, which is also the width of each.
    """

    side: int
    pitch_mrad: float

    def __post_init__(self) -> None:
        if self.side < 1 or self.side % 2 == 0:
            raise SettingsError(f"side: found {self.side}, expected an odd number >= 1")
        check_positive("pitch_mrad", self.pitch_mrad)

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
    """Pieces of equal cells of one axis, each within one of another axis's cells, which are the columns.

    Attributes
    ----------
    column : ndarray of int, shape (cells, pieces)
    length : ndarray, shape (cells, pieces)
        In widths of a column; 0 for pieces that a cell does not have.
    """

    column: NDArray[np.intp]
    length: FloatArray

    def matrix(self, n_columns: int, dtype: DTypeLike = np.float64) -> csr_array:
        """Return the lengths as a sparse array, (cells, n_columns)."""
        from scipy.sparse import csr_array

        kept = self.length > 0.0
        row_start = np.concatenate([[0], np.cumsum(np.count_nonzero(kept, axis=1))]).astype(np.int32)
        entries = self.length[kept].astype(dtype), self.column[kept].astype(np.int32), row_start
        return csr_array(entries, shape=(len(kept), n_columns))

    def dense(self, n_columns: int) -> FloatArray:
        """Return the lengths as an array, (cells, n_columns)."""
        matrix = np.zeros((len(self.length), n_columns))
        np.put_along_axis(matrix, self.column, self.length, axis=1)
        return matrix


def overlaps(edge: ArrayLike, width: float, n_cells: int, n_columns: int) -> Overlaps:
    """Divide the cells of one axis at the boundaries of another axis's cells.

    Parameters
    ----------
    edge : array_like, shape (places,) or scalar
        Where the first cell begins, in columns from the first column's outer edge; several places follow each
        other.
    width : float
        Width of a cell in columns, > 0.
    n_cells, n_columns : int

    Returns
    -------
    Overlaps
        Of places × n_cells cells. The pieces of a cell inside the columns add up to its width, and those of a
        column inside the cells to one.
    """
    start = np.add.outer(edge, width * np.arange(float(n_cells))).reshape(-1, 1)
    n_pieces = min(math.ceil(min(width, n_columns)) + 1, n_columns)
    # Pieces that the last cells do not have lie before them.
    first = np.minimum(np.maximum(np.floor(start), 0.0), float(n_columns - n_pieces))
    column = first + np.arange(n_pieces)
    start = start - column
    length = np.minimum(np.maximum(start + width, 0.0), 1.0)
    length -= np.minimum(np.maximum(start, 0.0, out=start), 1.0, out=start)
    return Overlaps(column.astype(np.intp), length)


def _shares(
    grid: RetinaGrid, centre_px: float, pixel_pitch_mrad: float, first_pixel: int, n_pixels: int
) -> Overlaps:
    """Divide the retina samples at the pixels' boundaries; lengths in widths of a sample."""
    width = grid.pitch_mrad / pixel_pitch_mrad
    pieces = overlaps(centre_px + 0.5 - first_pixel - grid.side / 2.0 * width, width, grid.side, n_pixels)
    return pieces._replace(length=pieces.length / width)


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
    """Average the contrast over each retina sample's own area, the display taken as piecewise constant: (side,
    side).

    `contrast` is the part of a frame whose first pixel is (first_row, first_column); elsewhere the contrast is 0.
    The grid's middle lies at (x_px, y_px) on the frame. Hogervorst et al. 2001, section 4.1.
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
    """Return the rows of `resample` that the pixels touch, and the number of the first row. Parameters are the
    same."""
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
    rows = _shares(grid, y_px, pixel_pitch_mrad, first_row, n_rows)
    columns = _shares(grid, x_px, pixel_pitch_mrad, first_column, n_columns)
    if grid.side * max(n_rows, n_columns) <= MOST_DENSE:
        return top, np.asarray(rows.dense(n_rows)[top:bottom] @ contrast @ columns.dense(n_columns).T)
    down, along = rows.matrix(n_rows)[top:bottom], columns.matrix(n_columns)
    # Either order is exact; the larger array is the one not to make, or to copy.
    if n_rows > grid.side:
        return top, np.asarray((along @ (down @ contrast).T).T)
    return top, np.asarray(down @ (along @ contrast.T).T)


class SummedWeights:
    """Weight images on a grid whose products with pixels are computed without resampling these: exact as well.

    The images are summed over the samples above and to the left of each corner. Between corners such a sum is
    linear along each axis, and four of them are the weight of a pixel.

    Parameters
    ----------
    grid : RetinaGrid
    weights : ndarray, shape (k, side, side)
    """

    def __init__(self, grid: RetinaGrid, weights: FloatArray) -> None:
        self._grid, self._n_images = grid, len(weights)
        # Lines of eight numbers, the width of a cache line, are copied in half the time.
        sums = np.zeros((grid.side + 1, grid.side + 1, -(-len(weights) // 8) * 8))
        sums[1:, 1:, : len(weights)] = np.moveaxis(weights, 0, -1).cumsum(axis=0).cumsum(axis=1)
        self._sums = sums.reshape(-1, sums.shape[2])

    @staticmethod
    def pays(grid: RetinaGrid, n_pixels: int, pixel_pitch_mrad: float) -> bool:
        """Return whether products take less time this way, and little memory: with few and coarse pixels."""
        is_coarse = pixel_pitch_mrad >= grid.pitch_mrad and n_pixels <= MOST_PIXELS_A_SAMPLE * grid.side**2
        return is_coarse and grid.side <= MOST_SUMMED

    def on_pixels(
        self,
        *,
        x_px: float,
        y_px: float,
        pixel_pitch_mrad: float,
        first_row: int,
        first_column: int,
        n_rows: int,
        n_columns: int,
    ) -> Callable[[FloatArray], FloatArray]:
        """Return the function of the products for pixels at a place; parameters are those of `resample`.

        It takes contrast, (n_rows, n_columns), and returns the sums of its products with each image, (k,): those
        of the images with what `resample` returns.
        """
        side, spans = self._grid.side, ((y_px, first_row, n_rows), (x_px, first_column, n_columns))
        edges = [
            np.clip(_pixel_edges(self._grid, at, pixel_pitch_mrad, first, n), 0.0, side) for at, first, n in spans
        ]
        row, column = (np.minimum(of_axis.astype(np.intp), side - 1) for of_axis in edges)
        below, beyond = edges[0] - row, edges[1] - column
        shares = np.multiply.outer([1.0 - below, below], [1.0 - beyond, beyond]).swapaxes(1, 2)
        corners = np.add.outer((side + 1) * np.array([row, row + 1]), np.array([column, column + 1])).swapaxes(
            1, 2
        )
        sums = self._sums.take(corners.reshape(-1), axis=0)

        def products(contrast: FloatArray) -> FloatArray:
            at_corners = np.zeros((n_rows + 1, n_columns + 1))
            at_corners[1:, 1:] = contrast
            at_corners[:-1] -= at_corners[1:]
            at_corners[:, :-1] -= at_corners[:, 1:]
            return np.asarray(((at_corners * shares).reshape(-1) @ sums)[: self._n_images])

        return products


def gaussian_blur(image: FloatArray, sigma: float) -> FloatArray:
    """Blur a retina image by a Gaussian of standard deviation `sigma` samples, mirrored at its border.

    Only the part that is not zero is blurred: a triangle covers little of its grid.
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


def mirrored_frequencies(side: int, pitch: float) -> tuple[FloatArray, FloatArray]:
    """Return the frequencies along x and y, in cycles per unit of `pitch`, of the cosines of a mirrored image."""
    frequency = np.arange(side) / (2.0 * (side - 1) * pitch)
    return frequency, frequency[:, None]


def mirror_filtered(image: FloatArray, transfer: FloatArray) -> FloatArray:
    """Filter an image that is mirrored about its outermost samples. The transfer, of the image's shape, is at
    `mirrored_frequencies`, real and even along both axes.
    """
    from scipy.fft import dctn, idctn

    return np.asarray(idctn(dctn(image, type=1) * transfer, type=1))


def mirror_filtered_adjoint(image: FloatArray, transfer: FloatArray) -> FloatArray:
    """Apply the adjoint of `mirror_filtered`, symmetric under weights of one half on the outermost samples."""
    half = np.ones(image.shape[0])
    half[[0, -1]] = 0.5
    border = np.outer(half, half)
    return border * mirror_filtered(image / border, transfer)


def mean_of_turns(image: FloatArray) -> FloatArray:
    """Compute the mean of a square image and its three quarter turns."""
    return np.asarray(sum(np.rot90(image, -k) for k in range(4)) / 4.0)
