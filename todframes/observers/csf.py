"""An observer with people's contrast sensitivity: a filter, an aperture, white noise and four templates.

The filter is the sensitivity of the fovea, fitted to the thresholds of 16 people for 43 stimuli (ModelFest).
Pooling with an exponent of 2 makes the observer linear: the best template is then the filtered triangle itself,
P(answer) stays in closed form, and filter, aperture and template fold into one weight image for each answer.

Watson & Ahumada 2005, J. Vision 5(9):6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import Positive, check_values
from todframes.observers.eye import MRAD_PER_DEG, pupil_of, sensitivity_ratio
from todframes.observers.interface import (
    MODELFEST_CD_M2,
    REFERENCE_AGE_YEARS,
    Detection,
    EyeSettings,
    OmittedWeights,
    Readout,
    keeps_last,
)
from todframes.observers.internal_noise import Bands, summed_variance
from todframes.observers.pyramid import NeuronObserver, framed, ideal_weights
from todframes.observers.retina import RetinaGrid
from todframes.stimulus import Centre, Stimulus

GAIN_PER_DEG = 509.37
"""Sensitivity of the linear observer: at a threshold of ModelFest the filtered contrast, seen through the
aperture, has a root of its integrated square of 1 / 509.37 degrees."""

D_PRIME_AT_THRESHOLD = 1.406
"""d′ at a threshold of ModelFest, 84 % correct of two intervals: √2 Φ⁻¹(0.84)."""

NOISE_DEG = 1.0 / (D_PRIME_AT_THRESHOLD * GAIN_PER_DEG)
"""Root of the spectral density of the white internal noise, in degrees."""

WIDE_GRATING_DEG = 0.35 * math.sqrt(math.pi / 2.0)
"""Root of the integrated square of a grating of contrast 1, wider than the aperture of 0.35°, in degrees."""

FEWEST_ROWS, LAST_CYC_PER_DEG, LEAST_PEAK = 4, (4.0, 200.0), 3.0
"""Rows of a table of sensitivity, the range of its last frequency, and what its largest value exceeds: people see
neither less, in other units, nor more."""

FIELD_MRAD, APERTURE_SDS = 6.0, 4.0
"""Half-width of the field, beyond the size of the triangle or so many standard deviations of the aperture,
whichever is less. Beyond it the weights of a score have a root sum of squares of less than 1e-3 of all, for
triangles of 0.5 to 30 mrad."""

MOST_STEPS = 2000
"""Largest number of steps to an ideal template."""

FRAMES = "frames"
"""Setting of a spectrum that is to be measured in the frames of a dataset."""

LARGEST_SIDE = 4097
"""Largest side of the retina grid; its readout takes 1.5 GB."""

LARGEST_PITCH_MRAD = 0.2
"""Largest pitch of the retina: at its Nyquist frequency, 44 cycles/degree, the filter passes 0.7 % of its peak."""


def contrast_sensitivity(frequency_cyc_per_deg: FloatArray) -> FloatArray:
    """Compute the relative sensitivity of people to a frequency >= 0 near 0° or 90°: 0.151 at 0, 0.582 at its peak
    of 3.45 cycles/degree. Watson & Ahumada 2005, the filter of their standard model, without its gain.
    """
    high, low = (frequency_cyc_per_deg / 4.1726) ** 0.7786, frequency_cyc_per_deg / 1.3625
    return _sech(high) - 0.8493 * _sech(low)


def oblique_effect(frequency_x: FloatArray, frequency_y: FloatArray) -> FloatArray:
    """Compute the loss of sensitivity to oblique gratings at frequencies in cycles/degree: 1 along both axes and
    below 3.48 cycles/degree, least at 45°. Watson & Ahumada 2005.
    """
    squared = frequency_x**2 + frequency_y**2
    # sin 2θ = 2 f_x f_y / f²
    sine = 2.0 * frequency_x * frequency_y / np.where(squared > 0.0, squared, 1.0)
    loss = -np.expm1(-np.maximum(np.sqrt(squared) - 3.48, 0.0) / 13.57)
    return np.asarray(1.0 - loss * sine**2)


def _sech(x: FloatArray) -> FloatArray:
    decay = np.exp(-x)  # no overflow at large frequencies
    return np.asarray(2.0 * decay / (1.0 + decay**2))


@dataclass(frozen=True, slots=True, kw_only=True)
class CsfSettings(EyeSettings):
    """Settings of the observer with people's contrast sensitivity, and those of its eye.

    The filter is that of ModelFest, 30 cd/m², times the ratio of people's sensitivity in the two lights.

    Attributes
    ----------
    sensitivity : tuple of (float, float)
        Sensitivity of one's own in place of ModelFest's, at least 4 pairs: frequencies in cycles/degree,
        ascending, and 1 / contrast of a grating along an axis, wider than an aperture of 0.35°, that is seen in
        84 % of two intervals. Between rows it is linear on log axes; below the first it is flat; beyond the last
        its logarithm falls with frequency as between the last two.
    centre : {"centroid", "bounding_box"}
        Point that the four templates share, on the grid's middle, where the aperture is.
    retina_pitch_mrad : float
        Visual angle of a retina sample. It is the step of a computation and no property of the eye: the filter
        undoes the averaging over a sample.
    position_jitter_samples : float
        The grid is displaced by up to this many samples along x and y in each trial; 0: never.
    aperture_sd_deg : float
        Standard deviation of the Gaussian aperture within which contrast is seen, in degrees; it is centred on the
        grid's middle. 0.35 is that of a linear observer for ModelFest, whose stimuli people fixated.
    template : {"matched", "ideal"}
        Expected activity itself, the best template for the internal noise alone; or the best one for internal and
        external noise together, which prewhitens.
    external_noise_deg : float
        Root of the spectral density of the frames' noise at 1 cycle/degree, in contrast × degrees, for which the
        ideal template is best: of white noise, its standard deviation times the width of a sample in degrees.
    external_noise_exponent : float
        Its density falls as frequency to this power: 0 white, 2 an amplitude of 1/f.
    external_noise_spectrum : tuple of (float, float), or "frames"
        Frequencies in cycles/degree, ascending, and spectral densities in squared contrast × squared degrees, in
        place of the two settings above; or that of the frames, which `score` and `compare` measure.
    efficiency : float
        Squared ratio of a person's d′ to that of ModelFest's average person: contrast thresholds are divided by
        its root.
    """

    sensitivity: tuple[tuple[Positive, Positive], ...] = ()
    centre: Centre = "centroid"
    retina_pitch_mrad: Annotated[float, Meta(ge=1e-3, le=1e6)] = 0.1
    position_jitter_samples: Annotated[float, Meta(ge=0.0, le=1e3)] = 0.0
    aperture_sd_deg: Annotated[float, Meta(ge=0.05, le=10.0)] = 0.35
    template: Literal["matched", "ideal"] = "matched"
    external_noise_deg: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    external_noise_exponent: Annotated[float, Meta(ge=0.0, le=4.0)] = 0.0
    external_noise_spectrum: tuple[tuple[Positive, Positive], ...] | Literal["frames"] = ()
    efficiency: Annotated[float, Meta(ge=1e-6, le=1e6)] = 1.0

    def __post_init__(self) -> None:
        check_values(self)
        if isinstance(self.external_noise_spectrum, tuple):
            _check_ascending("external_noise_spectrum", self.external_noise_spectrum)
        if self.sensitivity:
            _check_sensitivity(self.sensitivity)
        if self.retina_pitch_mrad > LARGEST_PITCH_MRAD:
            nyquist = MRAD_PER_DEG / (2.0 * self.retina_pitch_mrad)
            raise SettingsError(
                f"retina_pitch_mrad: found {self.retina_pitch_mrad:g}, whose Nyquist frequency is {nyquist:.3g} "
                f"cycles/degree, which people see; expected at most {LARGEST_PITCH_MRAD:g}"
            )

    @property
    def noise_sd(self) -> float:
        """Standard deviation of the noise on each sample of the filtered contrast."""
        return NOISE_DEG * MRAD_PER_DEG / (self.retina_pitch_mrad * math.sqrt(self.efficiency))


class CsfObserver(NeuronObserver):
    """A linear observer with people's contrast sensitivity, without a free parameter but the efficiency.

    Parameters are as for `Observer`, with `CsfSettings`; `wider` is a factor of the field's width. Watson &
    Ahumada 2005, with the pooling exponent 2.

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.naked_eye(size_mrad=2.4, observer=tod.CsfObserver())
    """

    settings_type: ClassVar[type[CsfSettings]] = CsfSettings
    settings: CsfSettings
    omitted_part: ClassVar[str] = "outer field"

    def __init__(self, settings: CsfSettings | None = None, *, wider: float = 1.0, **changes: Any) -> None:
        super().__init__(settings, **changes)
        self._wider = wider

    def grid(self, stimulus: Stimulus) -> RetinaGrid:
        """Return the grid of retina samples that the observer looks at, as wide as triangle, filter and aperture;
        SettingsError if there are too many samples.
        """
        pitch, aperture_mrad = self.settings.retina_pitch_mrad, self.settings.aperture_sd_deg * MRAD_PER_DEG
        half_mrad = self._wider * (FIELD_MRAD + min(stimulus.size_mrad, APERTURE_SDS * aperture_mrad))
        side = 2 * math.ceil(half_mrad / pitch) + 1
        if side > LARGEST_SIDE:
            raise SettingsError(
                f"retina_pitch_mrad: found {pitch:g}, {side} samples along a side of the field for a triangle of "
                f"{stimulus.size_mrad:g} mrad, expected at most {LARGEST_SIDE}: take a larger pitch, or a smaller "
                "aperture_sd_deg"
            )
        return RetinaGrid(side, pitch)

    @keeps_last(1)
    def with_extra_level(self) -> CsfObserver:
        """Return the observer with a field twice as wide."""
        return type(self)(self.settings, wider=2.0 * self._wider)

    def with_retina_step(self, factor: float) -> CsfObserver:
        """Return the observer on a retina of so many times the pitch; SettingsError if that is not allowed."""
        pitch = factor * self.settings.retina_pitch_mrad
        return type(self)(replace(self.settings, retina_pitch_mrad=pitch), wider=self._wider)

    def omitted_bands(self, stimulus: Stimulus) -> OmittedWeights:
        """Compute the weights beyond the field, to twice its width, on the coarsest retina allowed.

        They are of low frequency: beyond the field there is nothing of the triangle.
        """
        coarse = type(self)(replace(self.settings, retina_pitch_mrad=LARGEST_PITCH_MRAD), wider=self._wider)
        small, large = coarse.make_readout(stimulus), coarse.with_extra_level().make_readout(stimulus)
        kept = np.array([framed(image, large.grid.side // 2) for image in small.deviations])
        noise = large.noise_covariance - small.noise_covariance
        return OmittedWeights(large.grid, kept, large.deviations - kept, noise)

    def noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Draw Gaussian noise for each sample of the filtered contrast."""
        return rng.normal(0.0, self.settings.noise_sd, shape)

    def activity(self, contrast: FloatArray) -> Bands:
        """Compute the filtered contrast as seen through the aperture, for a retina image: one (side, side)."""
        seen = self._filtered(contrast)
        seen *= self._aperture(len(contrast))
        return (seen,)

    def _filtered(self, image: FloatArray) -> FloatArray:
        """Filter a retina image (side, side); beyond it there is nothing. The filter is its own adjoint."""
        return _convolved(image, self._transfer(_padded(len(image))))

    @keeps_last(2)
    def _transfer(self, side: int) -> FloatArray:
        """Compute the filter of a retina image: (side, side // 2 + 1)."""
        pitch_deg = self.settings.retina_pitch_mrad / MRAD_PER_DEG
        x, _ = self._frequencies(side)
        y = x[:, None]
        quarter = self._seen_transfer(x, y) / (np.sinc(pitch_deg * x) * np.sinc(pitch_deg * y))
        row = np.arange(side)  # frequencies ±f along y pass alike
        return quarter[np.minimum(row, side - row)]

    def _seen_transfer(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Compute the filter of what is in front of the eye, at frequencies in cycles/degree."""
        frequency = np.hypot(x, y)
        settings = self.settings
        own = _own_sensitivity(frequency, settings.sensitivity) if settings.sensitivity else None
        transfer = np.asarray((contrast_sensitivity(frequency) if own is None else own) * oblique_effect(x, y))
        is_natural = settings.pupil_mm is None and settings.age_years == REFERENCE_AGE_YEARS
        if is_natural and settings.luminance_cd_m2 == MODELFEST_CD_M2:
            return transfer
        return transfer * sensitivity_ratio(
            frequency,
            luminance_cd_m2=settings.known_luminance,
            pupil_mm=None if is_natural else pupil_of(settings),
        )

    def _frequencies(self, side: int) -> tuple[FloatArray, FloatArray]:
        """Return the frequencies of a real transform along x and y, in cycles/degree, that broadcast together."""
        pitch_deg = self.settings.retina_pitch_mrad / MRAD_PER_DEG
        x = np.asarray(np.fft.rfftfreq(side, pitch_deg), dtype=np.float64)
        return x, np.asarray(np.fft.fftfreq(side, pitch_deg), dtype=np.float64)[:, None]

    def _aperture(self, side: int) -> FloatArray:
        place_deg = (np.arange(side) - side // 2) * self.settings.retina_pitch_mrad / MRAD_PER_DEG
        along = np.exp(-(place_deg**2) / (2.0 * self.settings.aperture_sd_deg**2))
        return np.outer(along, along)

    def external_noise_density(self, frequency_x: FloatArray, frequency_y: FloatArray) -> FloatArray:
        """Return the spectral density of the frames' noise, in squared contrast × squared degrees, at frequencies
        in cycles/degree that broadcast; 0 has the density of the lowest other one.

        A subclass may replace it by any function that is even along both axes and the same after a quarter turn.
        """
        settings, frequency = self.settings, np.hypot(frequency_x, frequency_y)
        if settings.external_noise_spectrum == FRAMES:
            raise SettingsError(
                "external_noise_spectrum: found frames where there are no frames, expected pairs of frequency and "
                "density"
            )
        if settings.external_noise_spectrum:
            return _interpolated(frequency, np.array(settings.external_noise_spectrum))
        lowest = float(frequency[frequency > 0.0].min())
        decay = np.maximum(frequency, lowest) ** -settings.external_noise_exponent
        return np.asarray(settings.external_noise_deg**2 * decay)

    def _expected(self, image: FloatArray) -> Bands:
        return self.template_of(self.activity(image))

    def template_of(self, expected: Bands) -> Bands:
        """Return the weights of an expected activity: itself, or K⁻¹ of it, K being the covariance of all noise.

        K = σ²I + A F N F A, with the internal noise σ, the aperture A, the filter F and the noise's density N,
        divided by σ². Without external noise both templates are the same. SettingsError if the weights are not
        found.
        """
        if self.settings.template == "matched":
            return expected
        side = len(expected[0])
        aperture = self._aperture(side)
        x, y = self._frequencies(_padded(side))
        # Activity is of samples: the density over the area of a sample is the variance of white noise on it.
        sample_deg = self.settings.retina_pitch_mrad / MRAD_PER_DEG
        power = self.external_noise_density(x, y) / sample_deg**2 * self._seen_transfer(x, y) ** 2
        power /= self.settings.noise_sd**2

        def covariance(weights: Bands) -> Bands:
            return (weights[0] + aperture * _convolved(aperture * weights[0], power),)

        weights = ideal_weights(covariance, expected, MOST_STEPS)
        if weights is None:
            raise SettingsError(
                f"template: the ideal one is not found in {MOST_STEPS} steps; expected less external noise"
            )
        return weights

    def make_readout(self, stimulus: Stimulus) -> Readout:
        """Fold filter, aperture and templates onto the retina."""
        return self._folded(stimulus, self._template_deviation(stimulus), self._fold)

    def _fold(self, bands: Bands) -> FloatArray:
        """Compute the weights on the retina of weights of the activity: the adjoint of `activity`."""
        return self._filtered(bands[0] * self._aperture(len(bands[0])))

    def detection(self, pattern: FloatArray, width_mrad: float, half_width: int) -> Detection:
        """Fold the observer of a pattern onto the middle of its retina; see `Observer.detection`."""
        weights = self.pattern_template(pattern, self.grid(Stimulus(width_mrad)).side)
        return Detection(framed(self._fold(weights), half_width), summed_variance(weights, self.settings.noise_sd))


def _check_ascending(name: str, pairs: Sequence[tuple[float, float]]) -> None:
    """Raise SettingsError unless the frequencies of pairs ascend."""
    for (before, _), (frequency, _) in pairwise(pairs):
        if frequency <= before:
            raise SettingsError(
                f"{name}: found {frequency:g} after {before:g}, expected pairs with ascending frequencies"
            )


def _check_sensitivity(table: Sequence[tuple[float, float]]) -> None:
    """Raise SettingsError unless a table of sensitivity is one that an eye can have, in the right units."""
    _check_ascending("sensitivity", table)
    if len(table) < FEWEST_ROWS:
        raise SettingsError(f"sensitivity: found {len(table)} rows, expected at least {FEWEST_ROWS}")
    (last, end), peak, (least, most) = table[-1], max(value for _, value in table), LAST_CYC_PER_DEG
    problem = ""
    if not least <= last <= most:
        problem = (
            f"found {last:g} as the last frequency, expected {least:g} to {most:g} cycles/degree, up to where "
            "little is seen; 1 cycle/mrad is 17.45 cycles/degree"
        )
    elif peak <= LEAST_PEAK:
        problem = (
            f"found at most {peak:g}, expected a largest value above {LEAST_PEAK:g}: 1 / contrast, not its "
            "logarithm and not the contrast"
        )
    elif end >= table[-2][1]:
        problem = (
            f"found {end:g} after {table[-2][1]:g} in the last row, expected that it falls at the end; add rows "
            "up to where little is seen"
        )
    if problem:
        raise SettingsError(f"sensitivity: {problem}")


def _own_sensitivity(frequency: FloatArray, table: Sequence[tuple[float, float]]) -> FloatArray:
    """Return the filter that a table of sensitivity gives; the settings state what is between and beyond rows."""
    (before, more), (last, least) = table[-2:]
    beyond = np.exp(math.log(least / more) / (last - before) * np.maximum(frequency - last, 0.0))
    return _interpolated(frequency, np.array(table)) * beyond / (GAIN_PER_DEG * WIDE_GRATING_DEG)


def _interpolated(frequency: FloatArray, spectrum: FloatArray) -> FloatArray:
    """Interpolate a spectrum, (n, 2), on log axes; beyond its ends it is flat."""
    known, density = np.log(spectrum).T
    return np.asarray(np.exp(np.interp(np.log(np.maximum(frequency, spectrum[0, 0])), known, density)))


def _padded(side: int) -> int:
    """Return the period of a transform in which an image and its filtered copies do not meet."""
    from scipy.fft import next_fast_len

    return int(next_fast_len(2 * side, real=True))


def _convolved(image: FloatArray, transfer: FloatArray) -> FloatArray:
    """Apply a filter of this transfer, (period, period // 2 + 1), to an image that is 0 beyond its edges."""
    from scipy.fft import irfft2, rfft2

    side, period = len(image), (len(transfer),) * 2
    return np.ascontiguousarray(irfft2(rfft2(image, period) * transfer, period)[:side, :side])
