"""The Laplacian pyramid of Burt & Adelson (1983), its inverse and its adjoint, for any size."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray

BORDER = 4
"""Number of zeros around the part that is not zero: the filters of the pyramid reach two samples."""


@dataclass(frozen=True, slots=True)
class LaplacianPyramid:
    """Band-pass images of halving resolution, the finest first, and the low-pass residual last. `kernel_a` is the
    centre weight of the generating kernel [1/4 - a/2, 1/4, a, 1/4, 1/4 - a/2]; 0.375 is [1 4 6 4 1]/16. Borders
    are mirrored about the outermost sample (reflect-101). Burt & Adelson 1983, eqs. 1-8.
    """

    levels: int
    kernel_a: float = 0.375

    def build(self, image: FloatArray) -> list[FloatArray]:
        """Compute bands 0 ... levels - 1 and the residual of an image of any shape (rows, columns)."""
        bands = []
        for _ in range(self.levels):
            reduced = self.reduce(image)
            bands.append(image - self.expand(reduced, image.shape))
            image = reduced
        return [*bands, image.copy()]

    def adjoint(self, bands: Sequence[FloatArray]) -> FloatArray:
        """Return the image Lᵀy with ⟨y, Lx⟩ = ⟨Lᵀy, x⟩ for every image x, L being `build`."""
        image = bands[-1]
        for band in reversed(bands[:-1]):
            image = band + self.reduce_adjoint(image - self.expand_adjoint(band), band.shape)
        return np.array(image)

    def build_middle(self, image: NDArray[Any], half: int) -> list[NDArray[Any]]:
        """Compute the bands and the residual of an image that is zero except in its middle, each in its own
        square, with odd sides, beyond which it is zero. The middle, float32 or float64, has an odd side and
        `BORDER` samples of zeros on each side or more; the whole image reaches `half` samples to each side, a
        multiple of 2 ** levels.
        """
        bands = []
        for level in range(self.levels):
            reduced: NDArray[Any] = np.asarray(self.reduce(image), dtype=image.dtype)
            bands.append(image - np.asarray(self.expand(reduced, image.shape), dtype=image.dtype))
            # What is not zero reaches two samples further, that is one of the next level.
            needed = min(even_half(image.shape[0] // 4 + BORDER), half >> (level + 1))
            image = framed(reduced, max(needed, reduced.shape[0] // 2))
        return [*bands, image.copy()]

    def adjoint_middle(self, bands: Sequence[NDArray[Any]], half: int, half_width: int) -> NDArray[Any]:
        """Compute the middle, `half_width` samples to each side, of `adjoint` of bands that are zero beyond their
        squares, as from `build_middle`, for a whole image of `half` samples to each side.
        """
        wanted = [even_half(half_width)]
        for _ in bands[1:]:
            wanted.append(even_half(wanted[-1] / 2.0 + 2.0))
        # Near the border it is the whole image, as the border is mirrored.
        wanted = [needed if needed < (half >> level) - 6 else half >> level for level, needed in enumerate(wanted)]
        image = framed(bands[-1], wanted[-1])
        for level in range(len(bands) - 2, -1, -1):
            band, needed = bands[level], wanted[level]
            expanded_adjoint = np.asarray(self.expand_adjoint(band), dtype=band.dtype)
            difference = image - framed(expanded_adjoint, wanted[level + 1])
            if needed == half >> level:
                image = np.asarray(self.reduce_adjoint(difference, (2 * needed + 1,) * 2), dtype=band.dtype)
            else:  # away from the border it is EXPAND less its gain
                wider = 2 * wanted[level + 1]
                expanded = np.asarray(self.expand(difference, (2 * wider + 1,) * 2), dtype=band.dtype)
                image = 0.25 * framed(expanded, needed)
            image = image + framed(band, needed)
        return framed(image, half_width)

    def reduce(self, image: FloatArray) -> FloatArray:
        """Filter and keep every second sample: (n + 1) // 2 along each axis (REDUCE)."""
        if self.kernel_a == 0.375:
            # The same sums at a fifth of the time: only the samples that stay are computed.
            return np.asarray(cv2.pyrDown(image, borderType=cv2.BORDER_REFLECT_101))
        return self._filter(image)[::2, ::2]

    def expand(self, image: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Put samples on the even places of `shape` and interpolate the others (EXPAND)."""
        if self.kernel_a == 0.375:
            return _expand_binomial(image, shape)
        spread = np.zeros(shape)
        spread[::2, ::2] = image
        return self._filter(spread, gain=2.0)

    def reduce_adjoint(self, image: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Apply the adjoint of `reduce` for images of a shape. The mirrored filter F is symmetric under weights D
        of one half on the outermost samples: D F = Fᵀ D. With S, which keeps every second sample, (S F)ᵀ = D (F
        Sᵀ) (S D Sᵀ)⁻¹, and F Sᵀ is EXPAND less its gain.
        """
        expanded = self.expand(_weigh_border(image, 2.0, shape), shape)
        expanded /= _expand_gain(shape)
        return _weigh_border(expanded, 0.5, shape, every=1)

    def expand_adjoint(self, image: FloatArray) -> FloatArray:
        """Apply the adjoint of `expand` to the image's shape: (F Sᵀ)ᵀ = (S D Sᵀ) (S F) D⁻¹, times the gain."""
        reduced = self.reduce(_weigh_border(image, 2.0, image.shape, every=1))
        reduced = _weigh_border(reduced, 0.5, image.shape)
        reduced *= _expand_gain(image.shape)
        return reduced

    def _filter(self, image: FloatArray, gain: float = 1.0) -> FloatArray:
        tail = 0.25 - self.kernel_a / 2.0
        kernel = np.array([tail, 0.25, self.kernel_a, 0.25, tail])
        # The gain makes up for the zeros between samples; along an axis of one sample there are none.
        along_y, along_x = (kernel * (gain if length > 1 else 1.0) for length in image.shape)
        # cv2.pyrUp is wrong in the last row and column of odd sizes; a plain separable filter is exact.
        filtered = cv2.sepFilter2D(image, cv2.CV_64F, along_x, along_y, borderType=cv2.BORDER_REFLECT_101)
        return np.asarray(filtered)


def even_half(half: float) -> int:
    """Return the half-width of a square, rounded up to an even number: its REDUCE has a middle sample too."""
    return 2 * math.ceil(half / 2.0)


def framed(image: NDArray[Any], half: int) -> NDArray[Any]:
    """Return the middle of an image, this number of samples to each side, with zeros beyond its edges."""
    excess = half - image.shape[0] // 2
    if excess > 0:
        return np.pad(image, excess)
    return image[-excess : image.shape[0] + excess, -excess : image.shape[0] + excess]


def _expand_binomial(image: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Expand with [1 4 6 4 1]/16 at half the time, on one sample more than needed. cv2.pyrUp is wrong in its last
    rows and columns, so it is given the mirror image's first sample to spoil: of an odd `shape` the mirror goes
    through the last sample, of an even one it lies half a sample beyond.
    """
    borders = [cv2.BORDER_REFLECT_101 if length % 2 else cv2.BORDER_REFLECT for length in shape]
    if borders[0] == borders[1]:
        wider = cv2.copyMakeBorder(image, 0, 1, 0, 1, borders[0])
    else:
        wider = cv2.copyMakeBorder(cv2.copyMakeBorder(image, 0, 1, 0, 0, borders[0]), 0, 0, 0, 1, borders[1])
    return np.asarray(cv2.pyrUp(wider)[: shape[0], : shape[1]])


def _weigh_border(image: FloatArray, weight: float, shape: tuple[int, ...], *, every: int = 2) -> FloatArray:
    """Copy an image of this shape, of which every second or each line is there, its outermost lines weighted."""
    weighted = image.copy()
    for length, lines in zip(shape, (weighted, weighted.T), strict=True):
        if length > 1:
            lines[0] *= weight
            if (length - 1) % every == 0:
                lines[-1] *= weight
    return weighted


def _expand_gain(shape: tuple[int, ...]) -> float:
    """Return the gain that makes up for the zeros between samples; along an axis of one sample there are none."""
    return math.prod(2.0 if length > 1 else 1.0 for length in shape)
