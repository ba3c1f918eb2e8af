"""Measures of image quality without an observer: mean squared error, PSNR and SSIM."""

from __future__ import annotations

import math

import numpy as np

from todframes.base._typing import FloatArray

WINDOW_PX = 11
"""Side of the Gaussian window of SSIM in pixels: 3.5 standard deviations of 1.5 pixels on either side."""


def squared_error_and_ssim(
    image: FloatArray, reference: FloatArray, *, data_range: float
) -> tuple[float, float | None]:
    """Compute the mean squared error in (cd/m²)² and the mean structural similarity (SSIM) of two images in cd/m².

    SSIM has the Gaussian window and the constants of Wang et al. 2004, IEEE Trans. Image Process. 13, 600. It is
    None for images with a side of fewer than 11 pixels. `data_range` is the luminance of white less that of black.
    """
    from skimage.metrics import structural_similarity  # its mean_squared_error loads all of scipy.stats

    error = float(np.mean(np.square(reference - image)))
    if min(image.shape) < WINDOW_PX:
        return error, None
    ssim = structural_similarity(
        reference, image, data_range=data_range, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    return error, float(ssim)


def psnr_db(squared_error: float | None, *, data_range: float) -> float | None:
    """Convert a mean squared error to a peak signal-to-noise ratio in dB; None if the error is 0 or not known."""
    if not squared_error:
        return None
    return 10.0 * math.log10(data_range**2 / squared_error)
