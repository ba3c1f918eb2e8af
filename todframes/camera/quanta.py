"""Noise-equivalent quanta (NEQ) of a camera: sharpness and noise in one number at each frequency.

NEQ(f) = (μ MTF(f))² / NPS(f), with the mean μ above black and the power spectrum NPS of the noise: the number of
photons by which a camera without faults would show a pattern of this frequency in the same noise. Keelan 2016,
"Imaging applications of noise equivalent quanta", Electronic Imaging, IQSP-213; Koren 2024, "Image information
metrics from slanted edges", Electronic Imaging. The MTF is that of ISO 12233.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from todframes.base._typing import FloatArray
from todframes.camera.noise3d import luma
from todframes.parameters import Box
from todframes.psychometrics.bootstrap import NORMAL_95
from todframes.recordings.recording import Recording

RING_CYC_PER_PIXEL = 1.0 / 32.0
"""Half the width of the ring of frequencies over which the noise power is averaged."""


class Quanta(Struct, frozen=True, kw_only=True):
    """Noise-equivalent quanta of a pixel at a frequency.

    Attributes
    ----------
    frequency_cyc_per_pixel, mtf : float
    noise_power : float
        Power spectrum of the noise in squared values, times a pixel: the variance of a pixel if it is white.
    neq, neq_ci95 : float, (float, float)
        Noise-equivalent quanta, with the interval by the errors of noise power and MTF.
    snr : float
        Their root: the signal-to-noise ratio of a pattern of full contrast in the area of a pixel.
    """

    frequency_cyc_per_pixel: float
    mtf: float
    noise_power: float
    neq: float
    neq_ci95: tuple[float, float]
    snr: float


def noise_powers(recording: Recording, region: Box, frequencies: Sequence[float]) -> list[tuple[float, float]]:
    """Return the noise power in an even part of the frames at some frequencies in cycles/pixel, and its error.

    It is the mean over frames and directions of the squared Fourier transform of a frame, over the number of
    pixels, without a surface of second order that the light may have. Fixed pattern counts. The standard error
    is that of the mean over the frequencies of a ring, each of which stands there twice.
    """
    left, top, width, height = region
    y, x = (axis.ravel() for axis in np.meshgrid(*(np.linspace(-1, 1, n) for n in (height, width)), indexing="ij"))
    surface = np.linalg.qr(np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y]))[0]
    power, n_frames = np.zeros((height, width)), 0
    for frame in recording.frames():
        values = luma(frame.values[top : top + height, left : left + width]).ravel()
        rest = values - surface @ (surface.T @ values)
        power += np.abs(np.fft.fft2(rest.reshape(height, width))) ** 2 / values.size
        n_frames += 1
    radius = np.hypot(np.fft.fftfreq(height)[:, np.newaxis], np.fft.fftfreq(width))
    rings = [np.abs(radius - frequency) <= RING_CYC_PER_PIXEL for frequency in frequencies]
    found = [power[ring] / n_frames for ring in rings]
    return [(float(of_ring.mean()), float(of_ring.std() / math.sqrt(of_ring.size / 2))) for of_ring in found]


def quanta(
    signal: float,
    frequency: FloatArray,
    curves: Sequence[FloatArray],
    frequencies: Sequence[float],
    powers: Sequence[tuple[float, float]],
) -> list[Quanta]:
    """Return the NEQ at some frequencies from the signal above black, an MTF over frequency, and noise powers with
    their standard errors. `curves` are the MTF and, if it has a 95 % band, the ends of that.
    """
    found = []
    for at, (power, power_error) in zip(frequencies, powers, strict=True):
        mtf, *band = (float(np.interp(at, frequency, curve)) for curve in curves)
        neq = (signal * mtf) ** 2 / power if power > 0.0 else math.inf
        mtf_error = (band[1] - band[0]) / (2.0 * NORMAL_95) if band else 0.0
        relative = math.hypot(power_error / power, 2.0 * mtf_error / mtf) if power > 0.0 and mtf > 0.0 else 0.0
        factor = math.exp(NORMAL_95 * relative)
        found.append(
            Quanta(
                frequency_cyc_per_pixel=at,
                mtf=mtf,
                noise_power=power,
                neq=neq,
                neq_ci95=(neq / factor, neq * factor),
                snr=math.sqrt(neq),
            )
        )
    return found
