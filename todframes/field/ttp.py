"""Targeting task performance: the eye's contrast threshold, that of a system, and what a target gives of it.

A system shows a target at contrast C. V = size / range · ∫ √(C / CTF_sys(f)) df over the frequencies at which the
contrast is above the threshold, in cycles. Half of the observers do a task at V = V50.

Public codes disagree in some of the constants; docs/explanation/mrtd.md lists the choices made here.

Barten 2003, Proc. SPIE 5294, 231. Vollmerhausen, Jacobs & Driggers 2004, Opt. Eng. 43, 2806, as far as the codes
whale-ir-model (MITRE, Apache-2.0) and MORTICIA have it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.field.threshold_curve import CYC_PER_MRAD_IN_CYC_PER_DEG

V50_CYCLES = {"detection": 2.0, "recognition": 7.5, "identification": 13.0}
"""V at which half of the observers do a task, in cycles (whale-ir-model); 14.8 for identification elsewhere."""

FOOTLAMBERT_CD_M2 = 3.426
"""Luminance of a footlambert."""

NODES = 400
"""Nodes of an integral over frequency."""


def contrast_threshold(
    frequency_cyc_per_deg: ArrayLike, *, luminance_cd_m2: float, width_deg: float
) -> FloatArray:
    """Compute the threshold of the contrast of a sine wave (CTF) for two eyes, at frequencies > 0 of any shape.

    Frequency and `width_deg`, that of the field, are at the eye; `luminance_cd_m2` is the mean. Barten 2003, as
    whale-ir-model has it.
    """
    f = np.asarray(frequency_cyc_per_deg, dtype=np.float64)
    a = 540.0 * (1.0 + 0.7 / luminance_cd_m2) ** -0.2 / (1.0 + 12.0 / (width_deg * (1.0 + f / 3.0) ** 2))
    bf = 0.3 * (1.0 + 100.0 / luminance_cd_m2) ** 0.15 * f
    # exp(−bf) √(1 + 0.06 exp(bf)), written so that no high frequency overflows.
    falls = np.exp(-bf / 2.0) * np.sqrt(np.exp(-bf) + 0.06)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / (a * f * falls))


def pupil_mm(luminance_cd_m2: float) -> float:
    """Return the diameter of the pupils of two eyes at a luminance, as whale-ir-model has it."""
    footlamberts = luminance_cd_m2 / FOOTLAMBERT_CD_M2
    diameter = -9.011 + 13.23 * math.exp(-math.log10(footlamberts) / 21.082) - 0.5
    if not 1.0 <= diameter <= 9.0:
        raise SettingsError(
            f"luminance_cd_m2: found {luminance_cd_m2:g}, at which the pupil would have {diameter:.3g} mm, "
            "expected 1 to 9 mm"
        )
    return diameter


def eye_mtf(frequency_cyc_per_mrad: ArrayLike, *, luminance_cd_m2: float) -> FloatArray:
    """Compute the modulation transfer of the eye at frequencies at the eye: optics, retina and tremor.

    exp(−(f / f₀)^i₀) · exp(−0.375 f^1.21) · exp(−0.4441 f²), with f₀ and i₀ of the pupil (whale-ir-model).
    """
    f, pupil = np.asarray(frequency_cyc_per_mrad, dtype=np.float64), pupil_mm(luminance_cd_m2)
    f0 = math.exp(3.663 - 0.04974 * pupil**2 * math.log10(pupil)) / 43.69
    i0 = (0.7155 + 0.277 / math.sqrt(pupil)) ** 2
    return np.asarray(np.exp(-((f / f0) ** i0) - 0.375 * f**1.21 - 0.4441 * f**2))


def channel(frequency: ArrayLike, middle: float) -> FloatArray:
    """Compute the response of the eye's channel at `middle` to frequencies > 0, in the same unit: 1.6 octaves."""
    return np.asarray(np.exp(-2.2 * np.log(np.asarray(frequency, dtype=np.float64) / middle) ** 2))


def noise_gain_root_hz(luminance_cd_m2: float) -> float:
    """Return α, by which noise on the display raises thresholds of n = 2 eyes: √(n γ² Q / (1 + β² Q_p / (L A))).

    A is the area of the pupil in mm² and L the luminance in footlamberts (whale-ir-model).
    """
    area = math.pi / 4.0 * pupil_mm(luminance_cd_m2) ** 2
    footlamberts = luminance_cd_m2 / FOOTLAMBERT_CD_M2
    # Constant of the eye's photon noise in √(troland s), and its bandwidth in Hz.
    photons = 4.9**2 * 4.75 / (footlamberts * area)
    # Inverse of the eye's internal contrast noise, and temporal bandwidth of eye and display.
    return math.sqrt(2.0 * 240.0**2 * 3.538 / (1.0 + photons))


def noise_bandwidth(frequency: ArrayLike, transfer: ArrayLike) -> tuple[FloatArray, float]:
    """Compute the bandwidths of noise in the eye's channels along x, and along y, where there are none.

    They are ∫ |transfer · channel|² df for the channel at each frequency, shape (n,), and ∫ |transfer|² df, over
    both signs of f. Frequencies rise from next to nothing to where the transfer ends, which is that of all that
    follows the noise, the eye included.
    """
    f, square = np.asarray(frequency, dtype=np.float64), np.square(np.asarray(transfer, dtype=np.float64))
    along_x = [np.trapezoid(square * channel(f, middle) ** 2, f) for middle in f]
    return 2.0 * np.array(along_x), 2.0 * float(np.trapezoid(square, f))


def cycles_of_contrast(frequency: ArrayLike, threshold: ArrayLike, contrast: float) -> float:
    """Integrate √(contrast / threshold) over the frequencies at which the contrast is above the threshold (TTP).

    Between two of the rising frequencies ln(threshold) is linear; a threshold is infinite where the system passes
    nothing. The integral has the unit of the frequency; times size / range in mrad it is V.
    """
    f, height = np.asarray(frequency, dtype=np.float64), np.asarray(threshold, dtype=np.float64)
    seen = np.isfinite(height)
    # ln √(contrast / threshold): a straight line in each interval, whose part above 0 counts.
    ln = 0.5 * np.log(contrast / np.where(seen, height, contrast))
    left, right, width = ln[:-1], ln[1:], np.where(seen[:-1] & seen[1:], np.diff(f), 0.0)
    rise = right - left
    share = np.divide(-left, rise, out=np.zeros_like(rise), where=rise != 0.0)
    crosses = (left > 0.0) != (right > 0.0)
    part = np.where(crosses, np.where(left > 0.0, share, 1.0 - share), np.where(left > 0.0, 1.0, 0.0))
    start, end = np.maximum(left, 0.0), np.maximum(right, 0.0)
    step = end - start
    mean = np.where(np.abs(step) > 1e-9, np.expm1(step) / np.where(step == 0.0, 1.0, step), 1.0 + 0.5 * step)
    return float((width * part * np.exp(start) * mean).sum())


def at_the_eye(frequency_cyc_per_mrad: ArrayLike, magnification: float) -> FloatArray:
    """Return frequencies in the scene, in cycles/mrad, as cycles/deg at the eye."""
    f = np.asarray(frequency_cyc_per_mrad, dtype=np.float64)
    return np.asarray(f / magnification / CYC_PER_MRAD_IN_CYC_PER_DEG)
