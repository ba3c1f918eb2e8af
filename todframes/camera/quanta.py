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
    neq : float
        Noise-equivalent quanta.
    snr : float
        Their root: the signal-to-noise ratio of a pattern of full contrast in the area of a pixel.
    """

    frequency_cyc_per_pixel: float
    mtf: float
    noise_power: float
    neq: float
    snr: float


def noise_powers(recording: Recording, region: Box, frequencies: Sequence[float]) -> list[float]:
    """Return the noise power in an even part of the frames at some frequencies in cycles/pixel.

    It is the mean over frames and directions of the squared Fourier transform of a frame, over the number of
    pixels, without a surface of second order that the light may have. Fixed pattern counts.
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
    return [float(power[ring].mean()) / n_frames for ring in rings]


def quanta(
    signal: float, frequency: FloatArray, mtf: FloatArray, frequencies: Sequence[float], powers: Sequence[float]
) -> list[Quanta]:
    """Return the NEQ at some frequencies from the signal above black, an MTF over frequency, and noise powers."""
    found = []
    for at, power in zip(frequencies, powers, strict=True):
        passed = float(np.interp(at, frequency, mtf))
        neq = (signal * passed) ** 2 / power if power > 0.0 else math.inf
        found.append(
            Quanta(frequency_cyc_per_pixel=at, mtf=passed, noise_power=power, neq=neq, snr=math.sqrt(neq))
        )
    return found
