"""Conversion of detector samples to display pixels: sample & hold, electronics, display spot; and the adjoint.

The conversion is separable, so a square field of samples X becomes B X Bᵀ with one matrix B, and weights on the
display, Y, become Bᵀ Y B on the detectors.

Blur acts on pixel values, as a Gaussian sampled at whole pixels. Held samples and the frame are both constant
over each pixel, and a convolution of pixel values widens the one into the other by just the variance of the
kernel. Means over pixels of the continuously blurred signal would add 1/6 pixel² on top. Sampling by
itself makes narrow kernels narrower (0.008 instead of 0.09 pixel² at 0.3 pixel): they are sampled
from a wider Gaussian such that their variance, and so the transfer at low frequencies, is right.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from todframes.base._typing import FloatArray
from todframes.display.display import SensorDisplay

ALIAS_FREE_SIGMA_PX = 1.5
"""Smallest σ at which the variance of a sampled Gaussian is σ² to 1e-16 (Poisson summation: e^(−2π²σ²))."""


def gaussian_kernel(sigma_px: float) -> FloatArray:
    """Return non-negative, symmetric weights of sum 1 and variance σ² at whole pixels −m … m. The kernel is cut at
    9 standard deviations, where a weight is below 1e-17 of the middle one. Below 1e-8 pixels it is the single
    weight 1. Hogervorst et al. 2001, eq. 2, for pixels.
    """
    if sigma_px < 1e-8:
        return np.ones(1)
    radius = max(math.ceil(9.0 * sigma_px), 10)
    squares = np.square(np.arange(-radius, radius + 1, dtype=np.float64))
    if sigma_px >= ALIAS_FREE_SIGMA_PX:
        return _sampled_gaussian(squares, 0.5 / sigma_px**2)
    # The variance falls as the exponent rises; its logarithm is bracketed and halved to the last digit.
    low, high = math.log(0.5 / (sigma_px + 0.5) ** 2), math.log(0.5 / sigma_px**2)
    for _ in range(60):
        middle = (low + high) / 2.0
        if float(_sampled_gaussian(squares, math.exp(middle)) @ squares) > sigma_px**2:
            low = middle
        else:
            high = middle
    return _sampled_gaussian(squares, math.exp(high))


def _sampled_gaussian(squares: FloatArray, exponent: float) -> FloatArray:
    weights = np.exp(-exponent * squares)
    return np.asarray(weights / weights.sum())


def axis_matrix(n_detectors: int, *, pixels_per_detector: int, blur_px: Sequence[float]) -> FloatArray:
    """Return the matrix of sample & hold and post-sample blur along one axis, (pixels, detectors). Outside of the
    field the signal is zero: rows sum to 1 where the blur does not reach beyond it. Blurs are Gaussian: their
    variances add. Hogervorst et al. 2001, sections 3.4 and 3.5.
    """
    n_px = n_detectors * pixels_per_detector
    kernel = gaussian_kernel(math.hypot(*blur_px))
    half = np.zeros(max(n_px, kernel.size // 2 + 1))
    half[: kernel.size // 2 + 1] = kernel[kernel.size // 2 :]
    # A detector's contribution to a pixel depends on their distance alone, so all such sums are made once.
    around = np.concatenate([half[n_px - 1 : 0 : -1], half[:n_px]])
    of_detector = np.lib.stride_tricks.sliding_window_view(around, pixels_per_detector).sum(axis=-1)
    distance = np.subtract.outer(np.arange(n_px - 1, -1, -1), -pixels_per_detector * np.arange(n_detectors))
    return np.asarray(of_detector[distance])


def display_signal(samples: FloatArray, matrix: FloatArray) -> FloatArray:
    """Compute the signal in each display pixel, (pixels, pixels): B X Bᵀ, with B of `axis_matrix`."""
    return matrix @ samples @ matrix.T


def display_position_px(offset_detectors: float, *, n_detectors: int, display: SensorDisplay) -> float:
    """Return the pixel along one axis, pixel 0's centre at 0, of a point so far from the middle of the field."""
    return (n_detectors / 2.0 + offset_detectors) * display.pixels_per_detector - 0.5
