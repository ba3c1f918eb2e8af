"""An observer that uses the informative neurons only, and knows what the display makes of a triangle.

Its templates are the activity that the *displayed* triangle is expected to cause: averaged over detectors, held
and blurred as the settings say. Neurons whose expected activity hardly depends on the orientation are left out.
The others get the weights of the ideal linear observer: the differences of their expected activity while noise is
independent, less of these where the noise of samples reaches many neurons together.

Hogervorst et al. 2001, section 9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta
from numpy.typing import DTypeLike, NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.observers.interface import OmittedWeights
from todframes.observers.internal_noise import Bands
from todframes.observers.pyramid import LARGEST_SIZE_SAMPLES, PyramidObserver, PyramidSettings, ideal_weights
from todframes.observers.retina import RetinaGrid, mirror_filtered, mirror_filtered_adjoint, mirrored_frequencies
from todframes.stimulus import Stimulus

DisplayAngle = Annotated[float, Meta(ge=0.0, le=1e6)]

TRIANGLE_VARIANCE = 3.0**-0.5 / 6.0
"""Variance of a triangle of size 1 along any axis."""

MOST_STEPS = 500
"""Largest number of steps to ideal weights."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HotellingSettings(PyramidSettings):
    """Settings of `PyramidSettings`, and of the display of the frames; all angles are as seen on the display.

    Attributes
    ----------
    presample_blur_mrad : float
        Standard deviation of a Gaussian blur in front of sampling: the optics.
    sample_width_mrad : float or None
        Width over which a sample is averaged, the active width of a detector; None: sample_pitch_mrad.
    sample_pitch_mrad : float
        Distance of the samples, over which each is held on the display; 0: the display is not sampled.
    display_blur_mrad : float
        Standard deviation of the Gaussian blur behind sampling: electronics and display spot.
    sample_noise_sd : float
        Standard deviation of the noise on each sample (on each retina sample if the display is not sampled), in
        contrast as displayed, for which the weights are ideal; 0: for internal noise alone.
    informative_share : float
        The smallest number of neurons is used that has this share of all squared differences between expected
        activities.

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    presample_blur_mrad: DisplayAngle = 0.0
    sample_width_mrad: Annotated[float, Meta(ge=0.0, le=1e6)] | None = None
    sample_pitch_mrad: DisplayAngle = 0.0
    display_blur_mrad: DisplayAngle = 0.0
    sample_noise_sd: Annotated[float, Meta(ge=0.0, le=1e12)] = 0.0
    informative_share: Annotated[float, Meta(ge=1e-3, le=1.0)] = 0.99

    @property
    def averaged_mrad(self) -> float:
        """Width over which a sample is averaged."""
        return self.sample_pitch_mrad if self.sample_width_mrad is None else self.sample_width_mrad


class HotellingObserver(PyramidObserver):
    """The neurons of `PyramidObserver`, read out with the weights that suit the display. Parameters are as there,
    with `HotellingSettings`.

    Its display is described by two transfer functions: `presample_mtf` acts on the triangle alone, and
    `postsample_mtf` on the triangle and on the noise of its samples. A subclass may replace them by any functions
    that are real and even along both axes. The width of their field still follows from the settings. Hogervorst et
    al. 2001, section 9.

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.naked_eye(size_mrad=2.4, observer=tod.HotellingObserver())
    """

    settings_type: ClassVar[type[HotellingSettings]] = HotellingSettings
    settings: HotellingSettings

    def presample_mtf(self, frequency_x: FloatArray, frequency_y: FloatArray) -> FloatArray:
        """Return the transfer of optics and detectors at frequencies in cycles/mrad, broadcast together."""
        settings = self.settings
        radial = np.hypot(frequency_x, frequency_y)
        return _gaussian(radial, settings.presample_blur_mrad) * _box(
            frequency_x, frequency_y, settings.averaged_mrad
        )

    def postsample_mtf(self, frequency_x: FloatArray, frequency_y: FloatArray) -> FloatArray:
        """Return the transfer of sample & hold, electronics and display, as `presample_mtf` does.

        The mean of a held picture over all places of its samples is the picture averaged over the pitch.
        """
        settings = self.settings
        radial = np.hypot(frequency_x, frequency_y)
        return _gaussian(radial, settings.display_blur_mrad) * _box(
            frequency_x, frequency_y, settings.sample_pitch_mrad
        )

    def displayed(self, image: FloatArray) -> FloatArray:
        """Compute the expected retina image, (side, side), of an image of this shape in front of the sensor."""
        frequencies = self._frequencies(image)
        return mirror_filtered(image, self.presample_mtf(*frequencies) * self.postsample_mtf(*frequencies))

    def _seen_size_mrad(self, stimulus: Stimulus) -> float:
        settings = self.settings
        variance = settings.presample_blur_mrad**2 + settings.display_blur_mrad**2
        variance += (settings.averaged_mrad**2 + settings.sample_pitch_mrad**2) / 12.0
        size = math.sqrt(stimulus.size_mrad**2 + variance / TRIANGLE_VARIANCE)
        largest = LARGEST_SIZE_SAMPLES * settings.retina_pitch_mrad
        if stimulus.size_mrad <= largest < size:
            raise SettingsError(
                f"display: behind it, a triangle of {stimulus.size_mrad:g} mrad is as wide as one of "
                f"{size:g} mrad, expected at most {largest:g} mrad"
            )
        return size

    def omitted_bands(self, stimulus: Stimulus) -> OmittedWeights | None:
        """Estimate the omission as `PyramidObserver` does, as if every neuron of further bands were used.

        None with noise of the samples, for which the weights of all bands depend on each other.
        """
        return None if self.settings.sample_noise_sd > 0.0 else super().omitted_bands(stimulus)

    def detection(self, pattern: FloatArray, width_mrad: float, half_width: int) -> None:  # noqa: ARG002
        """Return None: the neurons are weighted for triangles."""
        return

    def _coarser(self, octaves: int) -> PyramidSettings:
        coarse = super()._coarser(octaves)
        assert isinstance(coarse, HotellingSettings)
        return replace(coarse, informative_share=1.0)  # coarse bands alone hold another share

    def _expected(self, image: FloatArray) -> Bands:
        return super()._expected(self.displayed(image))

    def _common_template(self, stimulus: Stimulus) -> Bands:
        return self.activity(np.zeros((self.grid(stimulus).side,) * 2))

    def _template_deviation(self, stimulus: Stimulus) -> Bands:
        upright = super()._template_deviation(stimulus)
        used = self._informative(upright)
        return self._ideal(tuple(map(np.multiply, upright, used)), used, self.grid(stimulus))

    def _readout_deviation(self, stimulus: Stimulus, dtype: DTypeLike) -> Bands:
        return tuple(band.astype(dtype) for band in self._template_deviation(stimulus))

    def _informative(self, upright: Bands) -> tuple[NDArray[np.bool_], ...]:
        share = self.settings.informative_share
        # Opposite quarters first: the sum is then the same, to the last bit, for the four images of a neuron.
        half = [np.square(band) + np.square(np.rot90(band, 2)) for band in upright]
        informations = [band + np.rot90(band) for band in half]
        if share == 1.0:
            return tuple(band > 0.0 for band in informations)
        descending = np.sort(np.concatenate([band.ravel() for band in informations]))[::-1]
        total = np.cumsum(descending)
        # Mirror images are equal but for rounding.
        least = (1.0 - 1e-12) * descending[np.searchsorted(total, share * total[-1])]
        return tuple((band >= least) & (band > 0.0) for band in informations)

    def _ideal(self, difference: Bands, used: Sequence[NDArray[np.bool_]], grid: RetinaGrid) -> Bands:
        """Compute the weights K⁻¹d of the used neurons: d their expected differences, K their noise covariance.

        K = σ²I + P L S Lᵀ P with internal noise σ, pyramid L, the used neurons P and the samples' noise S on the
        retina, taken as the same wherever the samples lie.
        """
        retina_samples = (self.settings.sample_pitch_mrad or grid.pitch_mrad) / grid.pitch_mrad
        internal, external = self.settings.noise_sd**2, (self.settings.sample_noise_sd * retina_samples) ** 2
        if external == 0.0:
            return difference
        internal, external = internal / (internal + external), external / (internal + external)
        transfer = self.postsample_mtf(*self._frequencies(np.empty((grid.side,) * 2)))

        def covariance(weights: Bands) -> Bands:
            on_retina = self._fold(weights, grid)
            noise = self.activity(mirror_filtered(mirror_filtered_adjoint(on_retina, transfer), transfer))
            return tuple(
                internal * band + external * (of_samples * neurons)
                for band, of_samples, neurons in zip(weights, noise, used, strict=True)
            )

        weights = ideal_weights(covariance, difference, MOST_STEPS)
        if weights is None:
            raise SettingsError(
                f"sample_noise_sd: found {self.settings.sample_noise_sd:g}, whose ideal weights are not found in "
                f"{MOST_STEPS} steps; expected less of it, more internal noise or less blur"
            )
        return weights

    def _frequencies(self, image: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the frequencies along x and y, in cycles/mrad, of the cosines that mirrored borders leave."""
        return mirrored_frequencies(image.shape[0], self.settings.retina_pitch_mrad)


def _gaussian(frequency: FloatArray, sigma: float) -> FloatArray:
    return np.asarray(np.exp(-2.0 * (np.pi * sigma * frequency) ** 2))


def _box(frequency_x: FloatArray, frequency_y: FloatArray, width: float) -> FloatArray:
    return np.asarray(np.sinc(width * frequency_x) * np.sinc(width * frequency_y))
