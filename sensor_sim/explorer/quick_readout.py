"""Readouts of the pyramid observer, computed only where there is something.

The template of a triangle is zero beyond its blurred corners, and so are its fine bands: they are computed in a
square about the triangle. The weights on the retina are computed in a square that the detectors' field fills. Both
are the same numbers as those of `PyramidObserver.readout`, but for rounding, in a fifth of the time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from todframes._typing import FloatArray
from todframes.observers.laplacian_pyramid import LaplacianPyramid
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import gaussian_blur
from todframes.stimulus import Orientation, Stimulus, coverage, vertices

Image = NDArray[Any]
"""An image in single or double precision; its middle sample lies on the retina's middle."""

BORDER = 4
"""Samples of zeros about what is not zero: the filters of the pyramid reach two samples."""


class QuickReadout(NamedTuple):
    """Weights of the upright triangle's score less the mean of the four, and the noise of all four.

    Attributes
    ----------
    upright : ndarray, shape (side, side)
        The middle of the retina, at least as wide as was asked for. The other scores' weights are its turns.
    noise_covariance : ndarray, shape (4, 4)
    """

    upright: Image
    noise_covariance: FloatArray


def quick_readout(
    observer: PyramidObserver, stimulus: Stimulus, half_width: float, dtype: DTypeLike
) -> QuickReadout:
    """Compute a readout within `half_width` samples of the retina's middle, in float32 or float64."""
    settings, side = observer.settings, observer.grid(stimulus).side
    levels = (side - 1).bit_length() - 3  # side = 4 · 2^levels + 1
    pyramid = LaplacianPyramid(levels, settings.kernel_a)
    bands = _bands(_template(observer, stimulus, side // 2).astype(dtype), pyramid, side // 2)
    if not settings.include_residual:
        bands[-1][:] = 0.0
    gains = [settings.band_gain**level for level in range(levels + 1)]
    template = [gain * band for gain, band in zip(gains, bands, strict=True)]
    weights = [gain * band for gain, band in zip(gains, template, strict=True)]
    same, opposite = (
        sum(float(np.vdot(band, np.ascontiguousarray(np.rot90(band, -k)))) for band in template) for k in (0, 2)
    )
    beside = -(same + opposite) / 2.0  # the four add up to zero
    row = settings.noise_sd**2 * np.array([same, beside, opposite, beside])
    upright = _adjoint(weights, pyramid, side // 2, half_width)
    return QuickReadout(upright, np.array([np.roll(row, k) for k in range(4)]))


def _template(observer: PyramidObserver, stimulus: Stimulus, full: int) -> Image:
    """Draw the upright triangle less the mean of its turns, blurred, in a square that holds it."""
    settings = observer.settings
    size = stimulus.size_mrad / settings.retina_pitch_mrad
    corners = vertices(size=size, orientation=Orientation.UP, centre=settings.centre)
    half = _even(min(float(np.abs(corners).max()) + 8.0 * settings.template_blur_samples + 2.0 + BORDER, full))
    image = stimulus.polarity * coverage(
        (2 * half + 1,) * 2, size_px=size, x_px=half, y_px=half, orientation=Orientation.UP, centre=settings.centre
    )
    pair = image + np.rot90(image, 2)
    return gaussian_blur(image - (pair + np.rot90(pair)) / 4.0, settings.template_blur_samples)


def _bands(image: Image, pyramid: LaplacianPyramid, full: int) -> list[Image]:
    """Compute the bands and the residual of an image whose border is zero, each in its own square."""
    bands = []
    for level in range(pyramid.levels):
        reduced: Image = np.asarray(pyramid.reduce(image), dtype=image.dtype)
        bands.append(image - np.asarray(pyramid.expand(reduced, image.shape), dtype=image.dtype))
        # What is not zero reaches two samples further, that is one of the next level.
        half = min(_even(image.shape[0] // 4 + BORDER), full >> (level + 1))
        image = _framed(reduced, max(half, reduced.shape[0] // 2))
    return [*bands, image.copy()]


def _adjoint(bands: Sequence[Image], pyramid: LaplacianPyramid, full: int, half_width: float) -> Image:
    """Compute the middle of `LaplacianPyramid.adjoint` of bands that are zero beyond their squares."""
    wanted = [_even(half_width)]
    for _ in bands[1:]:
        wanted.append(_even(wanted[-1] / 2.0 + 2.0))
    # Near the border it is the whole image, as the border is mirrored.
    wanted = [half if half < (full >> level) - 6 else full >> level for level, half in enumerate(wanted)]
    image = _framed(bands[-1], wanted[-1])
    for level in range(len(bands) - 2, -1, -1):
        band, half = bands[level], wanted[level]
        difference = image - _framed(np.asarray(pyramid.expand_adjoint(band), dtype=band.dtype), wanted[level + 1])
        if half == full >> level:
            image = np.asarray(pyramid.reduce_adjoint(difference, (2 * half + 1,) * 2), dtype=band.dtype)
        else:  # away from the border it is EXPAND less its gain
            wider = 2 * wanted[level + 1]
            expanded = np.asarray(pyramid.expand(difference, (2 * wider + 1,) * 2), dtype=band.dtype)
            image = 0.25 * _framed(expanded, half)
        image = image + _framed(band, half)
    return image


def _even(half: float) -> int:
    return 2 * math.ceil(half / 2.0)


def _framed(image: Image, half: int) -> Image:
    """Return the middle of an image, so many samples to each side, with zeros where it ends before."""
    excess = half - image.shape[0] // 2
    if excess > 0:
        return np.pad(image, excess)
    return image[-excess : image.shape[0] + excess, -excess : image.shape[0] + excess]
