"""Detector noise: a dynamic part, new in every frame, a fixed pattern, and their relation to SNR and ΔT.

The signal of a large triangle is 1, so the standard deviation of the noise in one sample **as displayed** is
1/SNR. That sample is the mean over the frames the eye integrates: its variance is that of the dynamic part
over the number of frames, plus that of the fixed pattern, which no integration reduces.

Hogervorst et al. 2001, sections 3.3 and 8.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sensor_sim.chain.sensor import Distribution, Noise
from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError

UNIFORM_EXCESS_KURTOSIS = -1.2


class SampleParts(NamedTuple):
    """Standard deviations of the independent parts of one displayed sample; their squares add up to the total's.
    What a detector has by itself, new in each frame or fixed, and what all of its row, or of its column, have in
    common. Lines are Gaussian.
    """

    own_noise: float
    own_pattern: float
    row_noise: float
    row_pattern: float
    column_noise: float
    column_pattern: float


class LineShares(NamedTuple):
    """Shares of the variance of a displayed sample that rows, and columns, have in common."""

    row: float = 0.0
    column: float = 0.0


NO_LINES = LineShares()


class UnitPattern(NamedTuple):
    """The fixed pattern of a sensor in units of its parts' standard deviations: (n, n), (n, 1) and (1, n)."""

    own: FloatArray
    rows: FloatArray
    columns: FloatArray


def k_factor(noise: Noise) -> float:
    """Return the dynamic noise of a single frame divided by the total noise of the integrated sample. σ_tot² =
    σ_dyn²/n + (ratio·σ_dyn)² with n frames: k = σ_dyn/σ_tot, 1.7496 at ratio 0.4 and 6 frames. Hogervorst et al.
    2001, section 8.2, below eq. 4 (printed as 1.75).
    """
    return 1.0 / math.hypot(1.0 / math.sqrt(noise.frames_integrated), noise.fixed_pattern_ratio)


def sample_parts(noise: Noise, *, total_sd: float) -> SampleParts:
    """Return all independent parts of a displayed sample's total standard deviation (1/SNR). Of the parts of
    three-dimensional noise these are tvh, vh, tv, v, th and h (D'Agostino & Webb 1991). Lines are parts of the
    dynamic noise and of the fixed pattern (Hogervorst et al. 2001, section 8.2, below eq. 4).
    """
    single_frame = k_factor(noise) * total_sd
    dynamic = single_frame / math.sqrt(noise.frames_integrated)
    lines = noise.row_noise_ratio**2 + noise.column_noise_ratio**2
    line_patterns = noise.row_pattern_ratio**2 + noise.column_pattern_ratio**2
    return SampleParts(
        own_noise=dynamic * math.sqrt(max(1.0 - lines, 0.0)),
        own_pattern=single_frame * math.sqrt(max(noise.fixed_pattern_ratio**2 - line_patterns, 0.0)),
        row_noise=dynamic * noise.row_noise_ratio,
        row_pattern=single_frame * noise.row_pattern_ratio,
        column_noise=dynamic * noise.column_noise_ratio,
        column_pattern=single_frame * noise.column_pattern_ratio,
    )


def line_shares(noise: Noise) -> LineShares:
    """Return the shares of rows and columns in the variance of a displayed sample."""
    parts = sample_parts(noise, total_sd=1.0)
    return LineShares(
        row=parts.row_noise**2 + parts.row_pattern**2, column=parts.column_noise**2 + parts.column_pattern**2
    )


def delta_t_mk(snr: ArrayLike, *, noise: Noise) -> FloatArray:
    """Convert a signal-to-noise ratio to a temperature difference in mK, of the same shape: ΔT = SNR · NETD / k.
    The SNR is the signal of a large triangle over the standard deviation of one displayed sample. NETD is the
    noise of a single frame, so NETD / k is that of the displayed sample: more frames integrated and less fixed
    pattern lower ΔT at the same SNR. SettingsError if the sensor has no NETD. Hogervorst et al. 2001, section 8.2,
    the text below eq. 4.
    """
    return np.asarray(snr, dtype=np.float64) * (_netd_mk(noise) / k_factor(noise))


def _netd_mk(noise: Noise) -> float:
    if noise.netd_mk is None:
        raise SettingsError("netd_mk: is missing, expected a number of mK to convert SNR to a temperature")
    return noise.netd_mk


def excess_kurtosis(noise: Noise) -> float:
    """Return the excess kurtosis of what detectors have by themselves in a displayed sample. It is that of the
    noise and of the pattern, weighted by their squared variances.
    """
    parts = sample_parts(noise, total_sd=1.0)
    own = parts.own_noise**2 + parts.own_pattern**2
    if noise.distribution == "gaussian" or own == 0.0:
        return 0.0
    return UNIFORM_EXCESS_KURTOSIS * (parts.own_noise**4 + parts.own_pattern**4) / own**2


def draw(
    shape: int | tuple[int, ...], *, sd: float, distribution: Distribution, rng: np.random.Generator
) -> FloatArray:
    """Draw independent noise of zero mean and standard deviation `sd`; uniform noise reaches to ±√3 sd. Hogervorst
    et al. 2001, section 3.3 and footnote 1; the mean is on the display's background.
    """
    if distribution == "gaussian":
        return rng.normal(0.0, sd, shape)
    half_width = math.sqrt(3.0) * sd
    return rng.uniform(-half_width, half_width, shape)


def unit_fixed_pattern(shape: tuple[int, int], *, noise: Noise, seed: int | np.random.SeedSequence) -> UnitPattern:
    """Draw the sensor's fixed pattern, each part of standard deviation 1 over all sensors. It is drawn once per
    sensor: the same seed and shape give the same pattern, whatever frames are made of it.
    """
    rng = np.random.default_rng(seed)
    own = draw(shape, sd=1.0, distribution=noise.distribution, rng=rng)
    return UnitPattern(own, rng.standard_normal((shape[0], 1)), rng.standard_normal((1, shape[1])))


def displayed_noise(
    pattern: UnitPattern, *, total_sd: float, noise: Noise, rng: np.random.Generator
) -> FloatArray:
    """Draw the noise of one displayed image in units of a large triangle's signal: a new dynamic part and the
    sensor's fixed pattern. `total_sd` is 1/SNR. The dynamic part is one draw of the named distribution with the
    standard deviation that integration leaves, as in the paper, not the mean of separate draws: `distribution` is
    that of the displayed sample.
    """
    parts = sample_parts(noise, total_sd=total_sd)
    noise_drawn = draw(pattern.own.shape, sd=parts.own_noise, distribution=noise.distribution, rng=rng)
    noise_drawn += parts.own_pattern * pattern.own
    for sd, fixed_sd, lines in (
        (parts.row_noise, parts.row_pattern, pattern.rows),
        (parts.column_noise, parts.column_pattern, pattern.columns),
    ):
        if sd > 0.0:
            noise_drawn += sd * rng.standard_normal(lines.shape)
        noise_drawn += fixed_sd * lines
    return noise_drawn
