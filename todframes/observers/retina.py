"""Retina samples from display pixels, by exact area overlap."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.stimulus import Centre, Orientation, coverage_of

MOST_DENSE = 2**13
"""Largest number of values of an overlap matrix that is not sparse: it takes less time, and no import of scipy."""


@dataclass(frozen=True, slots=True)
class RetinaGrid:
    """A square grid of retina samples. The observer looks at the place of its middle sample.

    Attributes
    ----------
    side : int
        Number of samples along each side, odd.
    pitch_mrad : float
        Visual angle from one sample to the next, which is also the width of each.

    Examples
    --------
    >>> import todframes as tod
    >>> grid = tod.PyramidObserver().readout(tod.Stimulus(size_mrad=2.4)).grid
    >>> round(grid.pitch_mrad, 4)
    0.153
    """

    side: int
    pitch_mrad: float

    def __post_init__(self) -> None:
        if self.side < 1 or self.side % 2 == 0:
            raise SettingsError(f"side: found {self.side}, expected an odd number >= 1")
        if not 0.0 < self.pitch_mrad < math.inf:
            raise SettingsError(f"pitch_mrad: found {self.pitch_mrad}, expected a finite number > 0")

    @property
    def width_mrad(self) -> float:
        """Visual angle of the whole grid, outer edge to outer edge."""
        return self.side * self.pitch_mrad

    def touched(
        self, y_px: Sequence[float], x_px: Sequence[float], *, pixel_pitch_mrad: float, shape: tuple[int, int]
    ) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return the rows and columns, half-open, of the pixels of a frame that the grid touches when its middle
        lies at any of these places. A range is empty if the frame has none of them.
        """
        half_px = self.width_mrad / pixel_pitch_mrad / 2.0
        ranges = []
        for places, n_pixels in zip((y_px, x_px), shape, strict=True):
            # Clipped first: floor and ceil of what lies beyond all pixels may be no integers.
            first = math.floor(min(max(min(places) - half_px + 0.5, 0.0), n_pixels))
            ranges.append((first, math.ceil(min(max(max(places) + half_px + 0.5, first), n_pixels))))
        return ranges[0], ranges[1]


def _shares(
    grid: RetinaGrid, centre_px: float, pixel_pitch_mrad: float, first_pixel: int, n_pixels: int
) -> tuple[NDArray[np.intp], FloatArray]:
    """Divide the retina samples at the pixels' boundaries: pixels and shares of the sample, (side, pieces) each.
    Shares are 0 for pieces that a sample does not have.
    """
    width = grid.pitch_mrad / pixel_pitch_mrad
    edge = centre_px + 0.5 - first_pixel - grid.side / 2.0 * width
    start = (edge + width * np.arange(float(grid.side)))[:, None]
    n_pieces = min(math.ceil(min(width, n_pixels)) + 1, n_pixels)
    # Pieces that the last samples do not have lie before them.
    first = np.minimum(np.maximum(np.floor(start), 0.0), float(n_pixels - n_pieces))
    pixel = first + np.arange(n_pieces)
    start = start - pixel
    length = np.minimum(np.maximum(start + width, 0.0), 1.0)
    length -= np.minimum(np.maximum(start, 0.0, out=start), 1.0, out=start)
    return pixel.astype(np.intp), length / width


@lru_cache(maxsize=16)
def _overlaps(
    grid: RetinaGrid,
    centre_px: float,
    pixel_pitch_mrad: float,
    pixels: tuple[int, int],
    kept: tuple[int, int],
    is_dense: bool,
) -> Any:
    """Return the share of each pixel, of (first, number), in the kept samples, half-open: an array or a sparse
    one, (sample, pixel). It is remembered, for frames in turn often have the same place, and nobody may change it.
    """
    pixel, share = _shares(grid, centre_px, pixel_pitch_mrad, *pixels)
    pixel, share = pixel[slice(*kept)], share[slice(*kept)]
    if is_dense:
        matrix = np.zeros((len(share), pixels[1]))
        np.put_along_axis(matrix, pixel, share, axis=1)
        return matrix
    from scipy.sparse import csr_array

    overlaps = share > 0.0
    row_start = np.concatenate([[0], np.cumsum(np.count_nonzero(overlaps, axis=1))]).astype(np.int32)
    values = share[overlaps], pixel[overlaps].astype(np.int32), row_start
    return csr_array(values, shape=(len(share), pixels[1]))


def resample(
    contrast: FloatArray,
    grid: RetinaGrid,
    *,
    x_px: float,
    y_px: float,
    pixel_pitch_mrad: float,
    first_row: int = 0,
    first_column: int = 0,
    onto: FloatArray | None = None,
) -> FloatArray:
    """Average the contrast over each retina sample's own area, the display taken as piecewise constant. `contrast`
    is the part of a frame whose first pixel is (first_row, first_column); elsewhere the contrast is 0. The grid's
    middle lies at (x_px, y_px) on the frame. The result, (side, side), is added to `onto` if that is given.
    Hogervorst et al. 2001, section 4.1.
    """
    rows, columns = grid.touched(
        [y_px - first_row], [x_px - first_column], pixel_pitch_mrad=pixel_pitch_mrad, shape=contrast.shape
    )
    contrast = contrast[slice(*rows), slice(*columns)]
    first_row, first_column = first_row + rows[0], first_column + columns[0]
    n_rows, n_columns = contrast.shape
    samples_per_pixel = pixel_pitch_mrad / grid.pitch_mrad
    upper, lower = (
        (row - 0.5 - y_px) * samples_per_pixel + grid.side / 2.0 for row in (first_row, first_row + n_rows)
    )
    top = min(max(math.floor(upper), 0), grid.side)
    bottom = max(min(math.ceil(lower), grid.side), top)
    if not (top < bottom and n_rows and n_columns):
        return np.zeros((grid.side, grid.side)) if onto is None else onto
    is_dense = grid.side * max(n_rows, n_columns) <= MOST_DENSE
    down = _overlaps(grid, y_px, pixel_pitch_mrad, (first_row, n_rows), (top, bottom), is_dense)
    along = _overlaps(grid, x_px, pixel_pitch_mrad, (first_column, n_columns), (0, grid.side), is_dense)
    if is_dense:
        seen = down @ contrast @ along.T
    else:  # either order is exact; the larger array is the one not to make, or to copy
        seen = (along @ (down @ contrast).T).T if n_rows > grid.side else down @ (along @ contrast.T).T
    if onto is None:
        if len(seen) == grid.side:
            return np.asarray(seen)
        onto = np.zeros((grid.side, grid.side))
    onto[top:bottom] += seen
    return onto


def triangle_on(
    grid: RetinaGrid,
    size_mrad: float,
    orientation: Orientation = Orientation.UP,
    *,
    x: float = 0.0,
    y: float = 0.0,
    centre: Centre = "centroid",
) -> FloatArray:
    """Draw a triangle of contrast 1 on the retina, its `centre` so many samples from the middle one."""
    side, middle = grid.side, grid.side // 2
    size, x_px, y_px = size_mrad / grid.pitch_mrad, middle + x, middle + y
    image = coverage_of((side, side), orientation, size_px=size, x_px=x_px, y_px=y_px, centre=centre)
    return np.ascontiguousarray(image)


def gaussian_blur(image: FloatArray, sigma: float) -> FloatArray:
    """Blur a retina image by a Gaussian of standard deviation `sigma` samples, mirrored at its border. Only the
    part that is not zero is blurred: a triangle covers little of its grid.
    """
    import cv2

    # Cut at 8 standard deviations, where the kernel is 1e-14 of its middle.
    reach = int(8.0 * sigma + 0.5)
    filled = [np.flatnonzero(image.any(axis=axis)) for axis in (1, 0)]
    if any(len(places) == 0 for places in filled):
        return image.copy()
    kernel = cv2.getGaussianKernel(2 * reach + 1, sigma, cv2.CV_64F)
    box = tuple(slice(max(places[0] - reach, 0), places[-1] + reach + 1) for places in filled)
    blurred = np.zeros_like(image)
    # The mirror image of what is filled, in the border of zeros, adds 1e-14 at most.
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
