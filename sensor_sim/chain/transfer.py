"""Modulation transfer functions, as plain functions of frequency.

Before sampling, frequencies are in cycles/mrad in the scene. After it they may also be in cycles per display
pixel: each width is in the reciprocal unit of its frequency.

The optics are computed in two dimensions, from the radial frequency: a product of one-dimensional curves
would not be circularly symmetric (Hogervorst et al. 2001, section 3).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from sensor_sim.chain.sensor import Detector, Optics, Sensor
from todframes.base._typing import FloatArray


def diffraction_mtf(frequency_cyc_per_mrad: ArrayLike, *, wavelength_um: float, aperture_mm: float) -> FloatArray:
    """Return the modulation transfer of a diffraction-limited circular aperture.

    With x the frequency over the cut-off and u = 2 arccos x, eq. 1 is (u − sin u) / π; both terms are nearly equal
    near the cut-off, so their difference is summed as a series there.

    Parameters
    ----------
    frequency_cyc_per_mrad : array_like, any shape
        Radial spatial frequency in object space.
    wavelength_um, aperture_mm : float
        Both > 0. The cut-off is aperture_mm / wavelength_um cycles/mrad.

    Returns
    -------
    ndarray, same shape, in [0, 1]; exactly 0 at and beyond the cut-off.

    Hogervorst et al. 2001, eq. 1.
    """
    x = np.abs(np.asarray(frequency_cyc_per_mrad, dtype=np.float64)) / (aperture_mm / wavelength_um)
    # arccos x = 2 arcsin √((1 − x)/2), without arccos's loss of digits at 1.
    u = np.minimum(4.0 * np.arcsin(np.sqrt(np.maximum(1.0 - x, 0.0) / 2.0)), np.pi)
    return np.piecewise(u, [u < 1.0], [_u_minus_sin_u_series, lambda u: u - np.sin(u)]) / np.pi


def _u_minus_sin_u_series(u: FloatArray) -> FloatArray:
    """Sum u³/3! − u⁵/5! + …; for u <= 1 the first term left out is below 1e-17 of the sum."""
    total = np.ones_like(u)
    for n in (16, 14, 12, 10, 8, 6, 4):
        total = 1.0 - np.square(u) / (n * (n + 1)) * total
    return np.asarray(u**3 / 6.0 * total)


def gaussian_mtf(frequency: ArrayLike, *, sigma: float) -> FloatArray:
    """Return the modulation transfer of a Gaussian blur of standard deviation `sigma`: exp(−2π²σ²f²).

    It describes optics, electronics or display spot; `sigma` is in the reciprocal unit of the (radial) frequency.
    Other tools give a width b with the transfer exp(−πb²f²): σ = b/√(2π).

    Returns
    -------
    ndarray, the shape of `frequency`, in [0, 1]

    Hogervorst et al. 2001, eq. 2.
    """
    return np.asarray(np.exp(-2.0 * (np.pi * sigma * np.asarray(frequency, dtype=np.float64)) ** 2))


def box_mtf(frequency: ArrayLike, *, width: float) -> FloatArray:
    """Return the transfer along one axis of a mean over `width`: sin(πwf)/(πwf), signed.

    It describes the active width of a detector, and with the pitch for `width` sample & hold. In two dimensions
    the transfer is exactly the product of the axes.

    Returns
    -------
    ndarray, the shape of `frequency`, in [−0.22, 1]

    Hogervorst et al. 2001, sections 3.2 and 3.4.
    """
    return np.sinc(width * np.asarray(frequency, dtype=np.float64))


def optics_mtf(radial_frequency_cyc_per_mrad: ArrayLike, *, optics: Optics) -> FloatArray:
    """Return diffraction × Gaussian blur, in the shape of the frequency; exactly 0 at and beyond the cut-off.

    Hogervorst et al. 2001, section 3.1.
    """
    diffraction = diffraction_mtf(
        radial_frequency_cyc_per_mrad, wavelength_um=optics.wavelength_um, aperture_mm=optics.aperture_mm
    )
    if optics.blur_sigma_mrad == 0.0:
        return diffraction
    return diffraction * gaussian_mtf(radial_frequency_cyc_per_mrad, sigma=optics.blur_sigma_mrad)


def band_limit_cyc_per_mrad(optics: Optics) -> float:
    """Return the end of the optics' transfer: the cut-off, or the frequency with a Gaussian below 1e-17."""
    if optics.blur_sigma_mrad == 0.0:
        return optics.cut_off_cyc_per_mrad
    return min(optics.cut_off_cyc_per_mrad, 1.42 / optics.blur_sigma_mrad)


def sharpness_bound(optics: Optics, *, width_mrad: float) -> float:
    """Return a bound on the change that the optics make to the mean over a square of a scene within [0, 1].

    Moving the scene by u changes it by at most (|u_x| + |u_y|)/width, and by at most 1. The mean of that over
    the Gaussian is 2√(2/π)·σ/width. Over the Airy pattern, whose energy beyond r is J₀² + J₁² at πcr, c the
    cut-off, it is at most √2/v · (1 + 2/π·ln(1 + v)) with v = πc·width.
    """
    v = np.pi * optics.cut_off_cyc_per_mrad * width_mrad
    of_blur = math.sqrt(8.0 / math.pi) * optics.blur_sigma_mrad / width_mrad
    return of_blur + math.sqrt(2.0) / v * (1.0 + 2.0 / math.pi * math.log1p(v))


def pre_sample_mtf(
    frequency_x_cyc_per_mrad: ArrayLike, frequency_y_cyc_per_mrad: ArrayLike, *, optics: Optics, detector: Detector
) -> FloatArray:
    """Return optics × detector at frequencies that broadcast against each other, in the broadcast shape.

    Hogervorst et al. 2001, section 3.6.
    """
    radial = np.hypot(frequency_x_cyc_per_mrad, frequency_y_cyc_per_mrad)
    along_x = box_mtf(frequency_x_cyc_per_mrad, width=detector.width_mrad)
    along_y = box_mtf(frequency_y_cyc_per_mrad, width=detector.width_mrad)
    return np.asarray(optics_mtf(radial, optics=optics) * along_x * along_y)


def post_sample_mtf(radial_frequency_cyc_per_mrad: ArrayLike, *, sensor: Sensor) -> FloatArray:
    """Return electronics × display spot, in the shape of the frequency, which is in object space.

    Hogervorst et al. 2001, section 3.6.
    """
    px_per_mrad = sensor.display.pixels_per_detector / sensor.detector.pitch_mrad
    cyc_per_px = np.asarray(radial_frequency_cyc_per_mrad, dtype=np.float64) / px_per_mrad
    electronics = gaussian_mtf(cyc_per_px, sigma=sensor.electronics.blur_sigma_px)
    return electronics * gaussian_mtf(cyc_per_px, sigma=sensor.display.blur_sigma_px)


def stages(frequency_cyc_per_mrad: ArrayLike, *, sensor: Sensor) -> dict[str, FloatArray]:
    """Return every stage's transfer along x, in the order of the signal chain, and the two products.

    Parameters
    ----------
    frequency_cyc_per_mrad : array_like, any shape
        Spatial frequency in object space.

    Returns
    -------
    dict of ndarray
        "diffraction", "optics_blur", "detector", "hold", "electronics", "display", then "pre_sample"
        (the first three) and "post_sample" (electronics and display).

    Hogervorst et al. 2001, section 3.
    """
    frequency = np.asarray(frequency_cyc_per_mrad, dtype=np.float64)
    optics, detector = sensor.optics, sensor.detector
    cyc_per_px = frequency * detector.pitch_mrad / sensor.display.pixels_per_detector
    return {
        "diffraction": diffraction_mtf(
            frequency, wavelength_um=optics.wavelength_um, aperture_mm=optics.aperture_mm
        ),
        "optics_blur": gaussian_mtf(frequency, sigma=optics.blur_sigma_mrad),
        "detector": box_mtf(frequency, width=detector.width_mrad),
        "hold": box_mtf(frequency, width=detector.pitch_mrad),
        "electronics": gaussian_mtf(cyc_per_px, sigma=sensor.electronics.blur_sigma_px),
        "display": gaussian_mtf(cyc_per_px, sigma=sensor.display.blur_sigma_px),
        "pre_sample": pre_sample_mtf(frequency, np.zeros_like(frequency), optics=optics, detector=detector),
        "post_sample": post_sample_mtf(frequency, sensor=sensor),
    }
