"""Noise of detectors: relative to the signal of a triangle, or of photons and electrons, computed and drawn.

Relative to the signal of a large triangle, 1, the standard deviation of the noise in one sample **as displayed**
is 1/SNR. That sample is the mean over the frames the eye integrates: its variance is that of the dynamic part over
the number of frames, plus that of the fixed pattern, which no integration reduces (Hogervorst et al. 2001,
sections 3.3 and 8).

A camera that counts photons has noise of its own, as contrast.

A triangle of the contrast C on a background that gives μ electrons adds C·μ·s electrons to a pixel that it covers
by the share s. All noise is divided by μ, so that a sample is a contrast. Its variance is then

    [σ_d² + D + 1/(12 K²) + μ (1 + C s)] / (n μ²)  +  DSNU² / μ²  +  PRNU² (1 + C s)²

with the dark noise σ_d and the electrons D of the dark current, the gain K, and n frames integrated. Rounding is
noise of 1/12 of a square digital number, if a frame's noise averages the steps out. Rows and columns add what
their pixels have in common.

EMVA Standard 1288, release 4.0 linear, sections 2 and 4.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from sensor_sim.chain.sensor import Distribution, Noise, PhotonNoise
from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError

if TYPE_CHECKING:
    from sensor_sim.chain.camera import Camera

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
    if noise.netd_mk is None:
        raise SettingsError("netd_mk: is missing, expected a number of mK to convert SNR to a temperature")
    return np.asarray(snr, dtype=np.float64) * (noise.netd_mk / k_factor(noise))


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


LARGEST_CONTRAST = 1e9

LEAST_NOISE_DN = 0.5
"""Noise of a frame, in digital numbers, that averages the steps of rounding out: to 1.4 % of a small contrast."""

MOST_DRAWN = 1e18
"""Largest number of electrons that is drawn; a Poisson number must fit into 63 bits."""


class ContrastVariance(NamedTuple):
    """Variance of a displayed sample in units of squared contrast. `white` is that of a pixel by itself, where
    there is no triangle; `row` and `column` that of what the pixels of a line have in common. `per_signal` and
    `per_squared_signal` are added to `white` for each unit of signal (the contrast times the covered share), and
    of its square.
    """

    white: float
    row: float
    column: float
    per_signal: float
    per_squared_signal: float


def largest_contrast(camera: Camera) -> float:
    """Return the contrast at which a large triangle saturates the pixels; beyond it, it looks the same."""
    photons, electrons = _photons_of(camera), camera.background_electrons
    room = photons.saturation_electrons - photons.dark_electrons
    return min(room / electrons - 1.0, LARGEST_CONTRAST)


def contrast_variance(camera: Camera) -> ContrastVariance:
    """Return the variance of a displayed sample; see the text of this module."""
    photons, electrons = _photons_of(camera), camera.background_electrons
    n, prnu = photons.frames_integrated, photons.prnu_percent / 100.0
    gain = photons.system_gain_dn_per_electron
    rounding = 0.0 if gain is None else 1.0 / 12.0 / gain**2
    in_dark = photons.dark_noise_electrons**2 + photons.dark_electrons + rounding

    def lines(noise: float, pattern: float) -> float:
        return (noise**2 / n + pattern**2) / electrons**2

    return ContrastVariance(
        white=((in_dark + electrons) / n + photons.dsnu_electrons**2) / electrons**2 + prnu**2,
        row=lines(photons.row_noise_electrons, photons.row_pattern_electrons),
        column=lines(photons.column_noise_electrons, photons.column_pattern_electrons),
        per_signal=1.0 / (n * electrons) + 2.0 * prnu**2,
        per_squared_signal=prnu**2,
    )


def check_rounding(camera: Camera) -> float:
    """Return the largest change of small contrasts because numbers are rounded, 2 exp(−2π²σ²) for the noise σ of a
    frame in digital numbers. SettingsError if the noise is below `LEAST_NOISE_DN`: thresholds then depend on where
    the background lies between two numbers.
    """
    photons = camera.photons
    if photons is None or photons.system_gain_dn_per_electron is None:
        return 0.0
    lines = photons.row_noise_electrons**2 + photons.column_noise_electrons**2
    variance = photons.dark_noise_electrons**2 + lines + photons.dark_electrons + camera.background_electrons
    noise_dn = photons.system_gain_dn_per_electron * math.sqrt(variance)
    distortion = min(2.0 * math.exp(-2.0 * (math.pi * noise_dn) ** 2), 1.0)
    if noise_dn < LEAST_NOISE_DN:
        raise SettingsError(
            f"noise.system_gain_dn_per_electron: the noise of a frame is {noise_dn:.2g} digital numbers, expected "
            f"{LEAST_NOISE_DN:g} or more: rounding changes small contrasts by up to {100.0 * distortion:.2g} %, "
            "depending on where the background lies between two numbers. Take a mode with more bits or gain, or "
            "more light, or simulate frames"
        )
    return distortion


def sample_cumulants(camera: Camera, signal: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the second, third and fourth cumulant of displayed samples in units of contrast, for signals, (n,):
    contrast times covered share. Frames share as much of the higher cumulants as of the variance.
    """
    photons, electrons, white = _photons_of(camera), camera.background_electrons, contrast_variance(camera)
    gain, n = photons.system_gain_dn_per_electron, photons.frames_integrated
    counted = np.maximum(electrons * (1.0 + signal), 0.0) + photons.dark_electrons
    variance = white.white + white.per_signal * signal + white.per_squared_signal * signal**2
    of_rounding = 0.0 if gain is None else 1.0 / 120.0 / gain**4
    return variance, counted / n**2 / electrons**3, (counted + of_rounding) / n**3 / electrons**4


class PhotonCamera:
    """A camera with `field` × `field` pixels whose fixed patterns are drawn once: the seed is the camera."""

    def __init__(self, camera: Camera, field: int, *, seed: int | np.random.SeedSequence) -> None:
        self.photons, self.electrons = _photons_of(camera), camera.background_electrons
        photons, rng = self.photons, np.random.default_rng(seed)
        self.response = 1.0 + photons.prnu_percent / 100.0 * rng.standard_normal((field, field))
        self.offset = photons.dsnu_electrons * rng.standard_normal((field, field))
        self.offset += photons.row_pattern_electrons * rng.standard_normal((field, 1))
        self.offset += photons.column_pattern_electrons * rng.standard_normal((1, field))

    def contrast(self, signal: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Return the contrast that the camera reports for a signal: contrast times covered share. It is that of
        the mean of frames in electrons, as they follow from the converter's numbers. The offset of the converter
        lies so high that noise never falls below 0.
        """
        photons, field = self.photons, len(signal)
        light = np.maximum(self.electrons * (1.0 + signal) * self.response, 0.0)
        if not light.max() <= MOST_DRAWN:
            raise SettingsError(
                f"contrast: a triangle gives {light.max():.3g} electrons in a pixel, expected at most "
                f"{MOST_DRAWN:g}"
            )
        gain, total = photons.system_gain_dn_per_electron, np.zeros_like(signal)
        for _ in range(photons.frames_integrated):
            electrons = rng.poisson(light + photons.dark_electrons).astype(np.float64)
            if photons.full_well_electrons is not None:
                electrons = np.minimum(electrons, photons.full_well_electrons)
            electrons += self.offset + photons.dark_noise_electrons * rng.standard_normal(signal.shape)
            electrons += photons.row_noise_electrons * rng.standard_normal((field, 1))
            electrons += photons.column_noise_electrons * rng.standard_normal((1, field))
            if gain is not None:
                number = np.rint(gain * electrons)
                if photons.bits is not None:
                    number = np.minimum(number, 2**photons.bits - 1)
                electrons = number / gain
            total += electrons
        mean = total / photons.frames_integrated
        return np.asarray((mean - photons.dark_electrons) / self.electrons - 1.0)


def _photons_of(camera: Camera) -> PhotonNoise:
    assert camera.photons is not None
    return camera.photons
