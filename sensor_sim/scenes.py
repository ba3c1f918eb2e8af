"""Detector samples of any scene that is given as an image.

Hogervorst et al. 2001, sections 3.1 and 3.2.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sensor_sim.sampling import MAX_FREQUENCIES, too_many_frequencies
from sensor_sim.sensor import Detector, Optics
from sensor_sim.transfer import band_limit_cyc_per_mrad, pre_sample_mtf
from todframes.errors import SettingsError

FloatArray = NDArray[np.float64]


def sample_image(
    image: FloatArray,
    *,
    pixel_pitch_mrad: float,
    optics: Optics,
    detector: Detector,
    field_detectors: int,
    x_detectors: float = 0.0,
    y_detectors: float = 0.0,
) -> FloatArray:
    """Detector samples of any scene, by FFT.

    The scene is constant over each pixel and repeats with the image's sides. Its spectrum, the pixels' sinc
    included, is summed up to the optics' cut-off: exact for such a scene, at any ratio of the pitches.

    Parameters
    ----------
    image : ndarray, shape (rows, columns)
    pixel_pitch_mrad : float
        In the scene, > 0.
    x_detectors, y_detectors : float
        Where the middle of the image lies, from the middle of the field.

    Returns
    -------
    ndarray, shape (field, field)

    Raises
    ------
    SettingsError
        If the pitch is not a positive number, the image is smaller than the field, or the optics pass too
        many frequencies.
    """
    if not (math.isfinite(pixel_pitch_mrad) and pixel_pitch_mrad > 0.0):
        raise SettingsError(f"pixel_pitch_mrad: found {pixel_pitch_mrad!r}, expected a finite number > 0")
    pixel = pixel_pitch_mrad / detector.pitch_mrad
    sides = [n * pixel for n in image.shape]
    if min(sides) < field_detectors * (1.0 - 1e-12):
        largest = f"at most the image's smaller side, {min(sides):g} detectors"
        raise SettingsError(f"field_detectors: found {field_detectors}, expected {largest}")
    highest = band_limit_cyc_per_mrad(optics) * detector.pitch_mrad
    place = np.arange(field_detectors) - (field_detectors - 1) / 2.0
    from_corner = [
        (place - at + side / 2.0) / pixel for at, side in zip((y_detectors, x_detectors), sides, strict=True)
    ]
    n_frequencies = 2.0 * highest**2 * sides[0] * sides[1]
    if n_frequencies > MAX_FREQUENCIES:
        raise SettingsError(too_many_frequencies(n_frequencies))
    n_y, n_x = image.shape
    k_y = np.arange(-math.floor(highest * sides[0]), math.floor(highest * sides[0]) + 1)
    k_x = np.arange(math.floor(highest * sides[1]) + 1)
    transfer = pre_sample_mtf(
        k_x / (n_x * pixel_pitch_mrad), k_y[:, None] / (n_y * pixel_pitch_mrad), optics=optics, detector=detector
    )
    transfer *= np.sinc(k_x / n_x) * np.sinc(k_y / n_y)[:, None] * np.where(k_x == 0, 1.0, 2.0)
    scene = np.fft.fft2(image)[np.ix_(k_y % n_y, k_x % n_x)] / image.size
    waves_y = np.exp(2j * np.pi / n_y * np.outer(from_corner[0] - 0.5, k_y))
    waves_x = np.exp(2j * np.pi / n_x * np.outer(from_corner[1] - 0.5, k_x))
    return np.asarray((waves_y @ (scene * transfer) @ waves_x.T).real)
