"""How like two images are by the usual measures, which know nothing of an observer."""

from __future__ import annotations

import math

from todframes._typing import FloatArray

WINDOW_PX = 11
"""Side of the Gaussian window of SSIM: 3.5 standard deviations of 1.5 pixels either way."""


def squared_error_and_ssim(
    image: FloatArray, reference: FloatArray, *, data_range: float
) -> tuple[float, float | None]:
    """Mean squared error and mean structural similarity of two images of the same shape, (rows, columns).

    Returns
    -------
    (float, float or None)
        SSIM is None for images with a side of fewer than 11 pixels.

    Wang et al. 2004, IEEE Trans. Image Process. 13, 600, with its Gaussian window and constants.
    """
    from skimage.metrics import mean_squared_error, structural_similarity

    error = float(mean_squared_error(reference, image))
    if min(image.shape) < WINDOW_PX:
        return error, None
    ssim = structural_similarity(
        reference, image, data_range=data_range, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    return error, float(ssim)


def psnr_db(squared_error: float | None, *, data_range: float) -> float | None:
    """Peak signal-to-noise ratio in dB of a mean squared error; None if there is no error or it is not known."""
    if not squared_error:
        return None
    return 10.0 * math.log10(data_range**2 / squared_error)
