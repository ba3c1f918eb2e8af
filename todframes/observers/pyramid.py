"""The model observer: a Laplacian pyramid, noise on every neuron, correlation with four templates.

Everything from contrast to scores is linear, so the pyramid and the templates fold into one weight image an answer
(`Readout`), and the noise on thousands of neurons into the covariance of four scores. Only the part about the
triangle, where they are not zero, is folded. The literal path (`PyramidObserver.respond`), with whole images
through all bands, is the definition with which tests compare the folded one.

Hogervorst et al. 2001, section 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, Self

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import DTypeLike, NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import check_values
from todframes.observers.interface import Detection, EyeSettings, Observer, OmittedWeights, Readout, keeps_last
from todframes.observers.internal_noise import (
    UNIFORM_EXCESS_KURTOSIS,
    Bands,
    inner_product,
    summed_noise,
    summed_variance,
)
from todframes.observers.retina import (
    RetinaGrid,
    gaussian_blur,
    mean_of_turns,
    mirror_filtered,
    mirror_filtered_adjoint,
    mirrored_frequencies,
    triangle_on,
)
from todframes.stimulus import HEIGHT_PER_SIZE, ORIENTATIONS, Centre, Orientation, Stimulus, vertices

BORDER = 4
"""Number of zeros around the part that is not zero: the filters of the pyramid reach two samples."""


@dataclass(frozen=True, slots=True)
class LaplacianPyramid:
    """Band-pass images of halving resolution, the finest first, and the low-pass residual last. `kernel_a` is the
    centre weight of the generating kernel [1/4 - a/2, 1/4, a, 1/4, 1/4 - a/2]; 0.375 is [1 4 6 4 1]/16. Borders
    are mirrored about the outermost sample (reflect-101). Burt & Adelson 1983, eqs. 1-8.
    """

    levels: int
    kernel_a: float = 0.375

    def build(self, image: FloatArray) -> list[FloatArray]:
        """Compute bands 0 ... levels - 1 and the residual of an image of any shape (rows, columns)."""
        bands = []
        for _ in range(self.levels):
            reduced = self.reduce(image)
            bands.append(image - self.expand(reduced, image.shape))
            image = reduced
        return [*bands, image.copy()]

    def adjoint(self, bands: Sequence[FloatArray]) -> FloatArray:
        """Return the image Lᵀy with ⟨y, Lx⟩ = ⟨Lᵀy, x⟩ for every image x, L being `build`."""
        image = bands[-1]
        for band in reversed(bands[:-1]):
            image = band + self.reduce_adjoint(image - self.expand_adjoint(band), band.shape)
        return np.array(image)

    def build_middle(self, image: NDArray[Any], half: int) -> list[NDArray[Any]]:
        """Compute the bands and the residual of an image that is zero except in its middle, each in its own
        square, with odd sides, beyond which it is zero. The middle, float32 or float64, has an odd side and
        `BORDER` samples of zeros on each side or more; the whole image reaches `half` samples to each side, a
        multiple of 2 ** levels.
        """
        bands = []
        for level in range(self.levels):
            reduced: NDArray[Any] = np.asarray(self.reduce(image), dtype=image.dtype)
            bands.append(image - np.asarray(self.expand(reduced, image.shape), dtype=image.dtype))
            # What is not zero reaches two samples further, that is one of the next level.
            needed = min(even_half(image.shape[0] // 4 + BORDER), half >> (level + 1))
            image = framed(reduced, max(needed, reduced.shape[0] // 2))
        return [*bands, image.copy()]

    def adjoint_middle(self, bands: Sequence[NDArray[Any]], half: int, half_width: int) -> NDArray[Any]:
        """Compute the middle, `half_width` samples to each side, of `adjoint` of bands that are zero beyond their
        squares, as from `build_middle`, for a whole image of `half` samples to each side.
        """
        wanted = [even_half(half_width)]
        for _ in bands[1:]:
            wanted.append(even_half(wanted[-1] / 2.0 + 2.0))
        # Near the border it is the whole image, as the border is mirrored.
        wanted = [needed if needed < (half >> level) - 6 else half >> level for level, needed in enumerate(wanted)]
        image = framed(bands[-1], wanted[-1])
        for level in range(len(bands) - 2, -1, -1):
            band, needed = bands[level], wanted[level]
            expanded_adjoint = np.asarray(self.expand_adjoint(band), dtype=band.dtype)
            difference = image - framed(expanded_adjoint, wanted[level + 1])
            if needed == half >> level:
                image = np.asarray(self.reduce_adjoint(difference, (2 * needed + 1,) * 2), dtype=band.dtype)
            else:  # away from the border it is EXPAND less its gain
                wider = 2 * wanted[level + 1]
                expanded = np.asarray(self.expand(difference, (2 * wider + 1,) * 2), dtype=band.dtype)
                image = 0.25 * framed(expanded, needed)
            image = image + framed(band, needed)
        return framed(image, half_width)

    def reduce(self, image: FloatArray) -> FloatArray:
        """Filter and keep every second sample: (n + 1) // 2 along each axis (REDUCE)."""
        if self.kernel_a == 0.375:
            # The same sums at a fifth of the time: only the samples that stay are computed.
            return np.asarray(cv2.pyrDown(image, borderType=cv2.BORDER_REFLECT_101))
        return self._filter(image)[::2, ::2]

    def expand(self, image: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Put samples on the even places of `shape` and interpolate the others (EXPAND)."""
        if self.kernel_a == 0.375:
            return _expand_binomial(image, shape)
        spread = np.zeros(shape)
        spread[::2, ::2] = image
        return self._filter(spread, gain=2.0)

    def reduce_adjoint(self, image: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Apply the adjoint of `reduce` for images of a shape. The mirrored filter F is symmetric under weights D
        of one half on the outermost samples: D F = Fᵀ D. With S, which keeps every second sample, (S F)ᵀ = D (F
        Sᵀ) (S D Sᵀ)⁻¹, and F Sᵀ is EXPAND less its gain.
        """
        expanded = self.expand(_weigh_border(image, 2.0, shape), shape)
        expanded /= _expand_gain(shape)
        return _weigh_border(expanded, 0.5, shape, every=1)

    def expand_adjoint(self, image: FloatArray) -> FloatArray:
        """Apply the adjoint of `expand` to the image's shape: (F Sᵀ)ᵀ = (S D Sᵀ) (S F) D⁻¹, times the gain."""
        reduced = self.reduce(_weigh_border(image, 2.0, image.shape, every=1))
        reduced = _weigh_border(reduced, 0.5, image.shape)
        reduced *= _expand_gain(image.shape)
        return reduced

    def _filter(self, image: FloatArray, gain: float = 1.0) -> FloatArray:
        tail = 0.25 - self.kernel_a / 2.0
        kernel = np.array([tail, 0.25, self.kernel_a, 0.25, tail])
        # The gain makes up for the zeros between samples; along an axis of one sample there are none.
        along_y, along_x = (kernel * (gain if length > 1 else 1.0) for length in image.shape)
        # cv2.pyrUp is wrong in the last row and column of odd sizes; a plain separable filter is exact.
        filtered = cv2.sepFilter2D(image, cv2.CV_64F, along_x, along_y, borderType=cv2.BORDER_REFLECT_101)
        return np.asarray(filtered)


def even_half(half: float) -> int:
    """Return the half-width of a square, rounded up to an even number: its REDUCE has a middle sample too."""
    return 2 * math.ceil(half / 2.0)


def framed(image: NDArray[Any], half: int) -> NDArray[Any]:
    """Return the middle of an image, this number of samples to each side, with zeros beyond its edges."""
    excess = half - image.shape[0] // 2
    if excess > 0:
        return np.pad(image, excess)
    return image[-excess : image.shape[0] + excess, -excess : image.shape[0] + excess]


def _expand_binomial(image: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Expand with [1 4 6 4 1]/16 at half the time, on one sample more than needed. cv2.pyrUp is wrong in its last
    rows and columns, so it is given the mirror image's first sample to spoil: of an odd `shape` the mirror goes
    through the last sample, of an even one it lies half a sample beyond.
    """
    borders = [cv2.BORDER_REFLECT_101 if length % 2 else cv2.BORDER_REFLECT for length in shape]
    if borders[0] == borders[1]:
        wider = cv2.copyMakeBorder(image, 0, 1, 0, 1, borders[0])
    else:
        wider = cv2.copyMakeBorder(cv2.copyMakeBorder(image, 0, 1, 0, 0, borders[0]), 0, 0, 0, 1, borders[1])
    return np.asarray(cv2.pyrUp(wider)[: shape[0], : shape[1]])


def _weigh_border(image: FloatArray, weight: float, shape: tuple[int, ...], *, every: int = 2) -> FloatArray:
    """Copy an image of this shape, of which every second or each line is there, its outermost lines weighted."""
    weighted = image.copy()
    for length, lines in zip(shape, (weighted, weighted.T), strict=True):
        if length > 1:
            lines[0] *= weight
            if (length - 1) % every == 0:
                lines[-1] *= weight
    return weighted


def _expand_gain(shape: tuple[int, ...]) -> float:
    """Return the gain that makes up for the zeros between samples; along an axis of one sample there are none."""
    return math.prod(2.0 if length > 1 else 1.0 for length in shape)


class NeuronObserver(Observer):
    """Base class of observers that correlate noisy neurons with four templates. A subclass computes the `activity`
    of its neurons, draws their `noise` and folds templates. The literal path, with noise on every neuron, is the
    definition with which tests compare the folded readout.
    """

    noise_excess_kurtosis: ClassVar[float] = 0.0
    """Excess kurtosis of the noise of a neuron; that of Gaussian noise."""

    def activity(self, contrast: FloatArray) -> Bands:
        """Compute the noise-free activity of all neurons, finest band first, for a retina image (side, side)."""
        raise NotImplementedError

    def noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Draw the noise of a band of neurons."""
        raise NotImplementedError

    def _expected(self, image: FloatArray) -> Bands:
        """Compute the weights of all neurons for an image that the observer expects: by default its activity."""
        return self.activity(image)

    def pattern_template(self, pattern: FloatArray, side: int) -> Bands:
        """Compute the weights of all neurons for a pattern on the middle of a retina of this side."""
        return self._expected(framed(pattern, side // 2))

    def _common_template(self, stimulus: Stimulus) -> Bands:
        """Compute the part that all four templates have in common."""
        return self._expected(mean_of_turns(self._upright(stimulus)))

    def _template_deviation(self, stimulus: Stimulus) -> Bands:
        """Compute the deviation of the upright triangle's template from the common one. The difference is taken
        before blur and bands; after them, the rounding of the common part would be larger than the difference
        needs.
        """
        image = self._upright(stimulus)
        image -= mean_of_turns(image)
        return self._expected(image)

    def turned(self, bands: Bands, quarter_turns: int) -> Bands:
        """Compute the activity that an image turned clockwise causes, from that of the image. The grid's middle is
        every band's middle, so that is the turned activity.
        """
        return tuple(np.ascontiguousarray(np.rot90(band, -quarter_turns)) for band in bands)

    @keeps_last(2)
    def templates(self, stimulus: Stimulus) -> tuple[Bands, ...]:
        """Compute the weights of all neurons in each score, in the order of `ORIENTATIONS`: expected activity."""
        common, upright = self._common_template(stimulus), self._template_deviation(stimulus)
        return tuple(
            tuple(mean + band for mean, band in zip(common, self.turned(upright, turns), strict=True))
            for turns in range(4)
        )

    def _upright(self, stimulus: Stimulus, half: int | None = None) -> FloatArray:
        """Draw the upright triangle, times its polarity, on the retina's middle: by default on all of it."""
        grid = self.grid(stimulus)
        if half is not None:
            grid = RetinaGrid(2 * half + 1, grid.pitch_mrad)
        return stimulus.polarity * triangle_on(grid, stimulus.size_mrad, centre=self.centre)

    def _folded(
        self,
        stimulus: Stimulus,
        upright: Bands,
        fold: Callable[[Bands], FloatArray],
        *,
        n: int = 4,
        is_gaussian: bool = False,
    ) -> Readout:
        """Make the readout of the upright triangle's template deviation, with the noise of all neurons, which may
        be taken as Gaussian. It has the first `n` deviations.
        """
        noise_sd, kurtosis = self.settings.noise_sd, 0.0 if is_gaussian else self.noise_excess_kurtosis
        # In single precision the sums would be no covariance.
        double = tuple(band.astype(np.float64, copy=False) for band in upright)
        noise = summed_noise(double, self.turned, noise_sd, kurtosis)
        folded = fold(upright)
        return Readout(
            grid=RetinaGrid(len(folded), self.grid(stimulus).pitch_mrad),
            find_common=lambda: fold(self._common_template(stimulus)),
            deviations=np.stack([np.rot90(folded, -k) for k in range(n)]),
            **noise._asdict(),
        )

    def noisy_activity(self, contrast: FloatArray, rng: np.random.Generator | None) -> Bands:
        """Compute the activity with noise on every neuron, or without it if `rng` is None."""
        activity = self.activity(contrast)
        return activity if rng is None else tuple(band + self.noise(band.shape, rng) for band in activity)

    def literal_scores(
        self, contrast: FloatArray, stimulus: Stimulus, rng: np.random.Generator | None = None
    ) -> FloatArray:
        """Compute the four scores as the paper does, with noise on every neuron if `rng` is given: (4,)."""
        activity = self.noisy_activity(contrast, rng)
        return np.array([sum(map(inner_product, template, activity)) for template in self.templates(stimulus)])

    def respond(self, contrast: FloatArray, stimulus: Stimulus, rng: np.random.Generator) -> Orientation:
        """Answer with the largest score, ties at random."""
        scores = self.literal_scores(contrast, stimulus, rng)
        return ORIENTATIONS[int(rng.choice(np.flatnonzero(scores == scores.max())))]


SOLVER_TOLERANCE = 1e-10
"""Residual of ideal weights, relative to the matched ones."""


def ideal_weights(covariance: Callable[[Bands], Bands], expected: Bands, most_steps: int) -> Bands | None:
    """Solve K w = d for an expected activity d by conjugate gradients; None if that takes more steps. `covariance`
    multiplies weights by K, the covariance of all noise: so the weights are those of the ideal linear observer.
    """
    from scipy.sparse.linalg import LinearOperator, cg

    ends = np.cumsum([band.size for band in expected])[:-1]

    def bands(flat: FloatArray) -> Bands:
        parts = np.split(flat, ends)
        return tuple(part.reshape(band.shape) for part, band in zip(parts, expected, strict=True))

    def flat(weights: Bands) -> FloatArray:
        return np.concatenate([band.ravel() for band in weights])

    d = flat(expected)
    operator = LinearOperator((d.size, d.size), matvec=lambda w: flat(covariance(bands(w))), dtype=np.float64)
    weights, not_converged = cg(operator, d, rtol=SOLVER_TOLERANCE, maxiter=most_steps)
    return None if not_converged else bands(weights)


MOST_LEVELS = 11
"""Largest number of levels. A retina image then takes half a GB."""

FEWEST_LEVELS = 4

BandNoise = Annotated[float, Meta(ge=1e-3, le=1e6)]

LARGEST_SIZE_SAMPLES = 2**MOST_LEVELS / 0.9


@dataclass(frozen=True, slots=True, kw_only=True)
class PyramidSettings(EyeSettings):
    """Settings of the paper's observer, in which every ambiguity of the paper is one, and those of its eye.

    Attributes
    ----------
    centre : {"centroid", "bounding_box"}
        Point that the four templates share, on the grid's middle.
    retina_pitch_mrad : float
        Visual angle of a retina sample.
    position_jitter_samples : float
        The grid is displaced by up to this many samples along x and y in each trial; 0: never.
    kernel_a : float
        Centre weight of the pyramid's kernel; 0.375 is [1 4 6 4 1]/16.
    levels : int or None
        Pyramid bands. None: enough for the triangle, at least 4, so that further bands and a wider field
        move thresholds by less than 1e-5 of their value with the other settings at their defaults, and by less
        than 1e-3 with bounding-box centring or strong template blur. The grid's side is 4 · 2^levels + 1.
    include_residual : bool
        Whether the low-pass residual takes part in the correlation.
    band_gain : float
        Gain of each band over the next finer one.
    template_blur_samples : float
        Standard deviation of the Gaussian that blurs the templates, in retina samples.
    internal_noise : float
        Full width of the uniform noise on each neuron.
    internal_noise_sd : float or None
        Its standard deviation, instead of internal_noise / √12.
    band_noise : tuple of float
        Internal noise of each band, the finest first, over `internal_noise`; the last is that of all coarser ones.
        Each neuron then counts by its signal over its noise. Empty: 1 in all bands.
    eye_mtf : {"none", "watson2013"}
        Optics in front of the retina: none, or the mean MTF of eyes of Watson 2013.
    """

    centre: Centre = "centroid"
    retina_pitch_mrad: Annotated[float, Meta(ge=1e-6, le=1e6)] = 0.153
    position_jitter_samples: Annotated[float, Meta(ge=0.0, le=1e3)] = 0.5
    kernel_a: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.375
    levels: Annotated[int, Meta(ge=1, le=MOST_LEVELS)] | None = None
    include_residual: bool = False
    band_gain: Annotated[float, Meta(ge=1e-3, le=1e3)] = 1.0
    template_blur_samples: Annotated[float, Meta(ge=0.0, le=1e3)] = 1.2
    internal_noise: Annotated[float, Meta(ge=0.0, le=1e12)] = 0.5
    internal_noise_sd: Annotated[float, Meta(ge=0.0, le=1e12)] | None = None
    band_noise: Annotated[tuple[BandNoise, ...], Meta(max_length=MOST_LEVELS)] = ()
    eye_mtf: Literal["none", "watson2013"] = "none"

    def __post_init__(self) -> None:
        check_values(self)

    @property
    def noise_sd(self) -> float:
        """Standard deviation of the noise on each neuron."""
        if self.internal_noise_sd is not None:
            return self.internal_noise_sd
        return self.internal_noise / math.sqrt(12.0)

    @property
    def fewest_levels(self) -> int:
        """Number of bands for the smallest triangles: all that have a noise of their own, and at least 4."""
        return max(FEWEST_LEVELS, len(self.band_noise))

    def gain_of(self, band: int) -> float:
        """Return the gain of a band, by which the noise is the same in all."""
        gain: float = self.band_gain**band
        if self.band_noise:
            gain /= self.band_noise[min(band, len(self.band_noise) - 1)]
        return gain


class PyramidObserver(NeuronObserver):
    """The paper's observer: a Laplacian pyramid with noise on every neuron, correlated with four templates.

    Parameters
    ----------
    settings : PyramidSettings, optional
        Default: the paper's.
    more_levels : int
        Bands, and octaves of the field, beyond those that a triangle needs.
    **changes
        Settings by name, in place of those of `settings`.

    Raises
    ------
    SettingsError
        If there is no such setting, or a value is out of its range.

    Examples
    --------
    >>> import todframes as tod
    >>> tod.PyramidObserver(internal_noise=0.25).settings.internal_noise
    0.25

    Hogervorst et al. 2001, section 4.
    """

    settings_type: ClassVar[type[PyramidSettings]] = PyramidSettings
    settings: PyramidSettings
    noise_excess_kurtosis: ClassVar[float] = UNIFORM_EXCESS_KURTOSIS

    def __init__(self, settings: PyramidSettings | None = None, *, more_levels: int = 0, **changes: Any) -> None:
        super().__init__(settings, **changes)
        self._more_levels = more_levels

    def grid(self, stimulus: Stimulus) -> RetinaGrid:
        """Return the grid of retina samples that the observer looks at: side 4 · 2^levels + 1, about four sizes.

        The coarsest band's samples are at least 0.9 sizes and at least 16 retina samples apart. With the default
        settings, further bands would change the threshold by less than 1e-5 of its value.
        """
        levels = self._levels(stimulus)
        side = 4 * 2**levels + 1
        apex = 2.0 / 3.0 * HEIGHT_PER_SIZE * self._seen_size_mrad(stimulus) / self.settings.retina_pitch_mrad
        needed = apex + self.settings.position_jitter_samples + 2.0 * self.settings.template_blur_samples
        if side / 2.0 < needed:
            raise SettingsError(
                f"levels: found {levels}, a grid of {side} retina samples; a triangle of "
                f"{stimulus.size_mrad:g} mrad with its blur and displacement needs {2.0 * needed:.0f}"
            )
        return RetinaGrid(side, self.settings.retina_pitch_mrad)

    def _levels(self, stimulus: Stimulus) -> int:
        if self.settings.levels is not None:
            return self.settings.levels
        size = self._seen_size_mrad(stimulus) / self.settings.retina_pitch_mrad
        if size > LARGEST_SIZE_SAMPLES:
            largest = stimulus.size_mrad * LARGEST_SIZE_SAMPLES / size
            raise SettingsError(
                f"size_mrad: found {stimulus.size_mrad:g} mrad at the eye, expected at most {largest:.4g}: take "
                "smaller triangles or a longer viewing distance"
            )
        fewest = self.settings.fewest_levels
        return min(max(fewest, math.ceil(math.log2(0.9 * size))) + self._more_levels, MOST_LEVELS)

    def _seen_size_mrad(self, stimulus: Stimulus) -> float:
        """Return the size of a triangle as wide as this one is seen."""
        return stimulus.size_mrad

    @keeps_last(1)
    def with_extra_level(self) -> Self:
        """Return the observer with one band, and one octave of the field, more than a triangle needs."""
        return type(self)(self.settings, more_levels=1)

    def omitted_bands(self, stimulus: Stimulus) -> OmittedWeights | None:
        """Estimate what one more band and octave of the field would add to the readout, on a coarser retina.

        The coarse bands of a large triangle are those of a small one on a coarse retina, which cost little: the
        finer bands add no more than the blur of their REDUCE kernels. At the same gain, a second band would add a
        sixth of that or less. None if the settings name the levels, or the observer is not linear.
        """
        if self.settings.levels is not None:
            return None
        fewest = self.settings.fewest_levels
        octaves = self._levels(stimulus) - fewest
        coarse = self._coarser(octaves)
        small, large = (
            type(self)(replace(coarse, levels=levels)).readout(stimulus) for levels in (fewest, fewest + 1)
        )
        if small is None or large is None:
            return None
        margin = (large.grid.side - small.grid.side) // 2
        kept = np.zeros_like(large.deviations)
        kept[:, margin:-margin, margin:-margin] = small.deviations
        gain = self.settings.band_gain ** (2 * octaves)
        added, noise = large.deviations - kept, large.noise_covariance - small.noise_covariance
        return OmittedWeights(large.grid, gain * kept, gain * added, gain * noise)

    def _coarser(self, octaves: int) -> PyramidSettings:
        """Return settings that see coarse bands as these do, on a retina of so many octaves less."""
        variance = self.settings.template_blur_samples**2
        variance += max(2.5 - 4.0 * self.settings.kernel_a, 0.0) * (4.0**octaves - 1.0) / 3.0
        return replace(
            self.settings,
            retina_pitch_mrad=self.settings.retina_pitch_mrad * 2.0**octaves,
            template_blur_samples=math.sqrt(variance) / 2.0**octaves,
            position_jitter_samples=0.0,
            band_noise=self.settings.band_noise[octaves:] or self.settings.band_noise[-1:],
        )

    def noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """Draw uniform noise for each neuron of a band."""
        half_width = self.settings.noise_sd * math.sqrt(3.0)
        return rng.uniform(-half_width, half_width, shape)

    def activity(self, contrast: FloatArray) -> Bands:
        """Compute the noise-free activity of all neurons, finest band first, for a retina image (side, side)."""
        return self._as_activity(self._pyramid(len(contrast)).build(self._through_eye(contrast)))

    def _through_eye(self, contrast: FloatArray) -> FloatArray:
        """Blur a retina image by the optics of the eye, if it has any; borders are mirrored as in the bands."""
        if self.settings.eye_mtf == "none":
            return contrast
        return mirror_filtered(contrast, self._eye_transfer(len(contrast)))

    def _before_eye(self, weights: FloatArray) -> FloatArray:
        """Compute the weights in front of the eye of weights behind it: the adjoint of `_through_eye`."""
        if self.settings.eye_mtf == "none":
            return weights
        return mirror_filtered_adjoint(weights, self._eye_transfer(len(weights)))

    @keeps_last(2)
    def _eye_transfer(self, side: int) -> FloatArray:
        from todframes.observers.eye import MRAD_PER_DEG, eye_mtf, pupil_of

        x, y = mirrored_frequencies(side, self.settings.retina_pitch_mrad / MRAD_PER_DEG)
        return eye_mtf(np.hypot(x, y), pupil_mm=pupil_of(self.settings))

    def _expected(self, image: FloatArray) -> Bands:
        """Compute the expected activity for an image whose place is not exactly known."""
        return self.activity(gaussian_blur(image, self.settings.template_blur_samples))

    @keeps_last(2)
    def readout_within(self, stimulus: Stimulus, half_width: int | None) -> Readout:
        """Return the readout with the deviations of the first score alone, of which the others are turns. With a
        `half_width` it is rough: the observer sees so many samples on each side of the retina's middle one, at
        most; in single precision, and with Gaussian noise.
        """
        grid, is_rough = self.grid(stimulus), half_width is not None
        half = grid.side // 2 if half_width is None else min(half_width, grid.side // 2)
        fold = partial(self._fold, grid=grid, half_width=half)
        upright = self._readout_deviation(stimulus, np.float32 if is_rough else np.float64)
        return self._folded(stimulus, upright, fold, n=1, is_gaussian=is_rough)

    def make_readout(self, stimulus: Stimulus) -> Readout | None:
        """Fold pyramid and templates onto the retina."""
        grid = self.grid(stimulus)
        fold = partial(self._fold, grid=grid, half_width=grid.side // 2)
        return self._folded(stimulus, self._readout_deviation(stimulus, np.float64), fold)

    def _readout_deviation(self, stimulus: Stimulus, dtype: DTypeLike) -> Bands:
        """Compute `_template_deviation` where it is not zero: each band in its own square.

        The template of a triangle is zero beyond its blurred corners, and so are its fine bands: for a triangle of
        60 retina samples or more this takes half the time, or less.
        """
        settings, side = self.settings, self.grid(stimulus).side
        corners = vertices(
            size=stimulus.size_mrad / settings.retina_pitch_mrad, orientation=Orientation.UP, centre=self.centre
        )
        reach = float(np.abs(corners).max()) + 8.0 * settings.template_blur_samples + 2.0 + BORDER
        image = self._upright(stimulus, even_half(min(reach, side // 2)))
        return self._expected_middle(image - mean_of_turns(image), side, dtype)

    def _expected_middle(self, image: FloatArray, side: int, dtype: DTypeLike) -> Bands:
        """Compute the expected activity for the middle of an image, each band where it is not zero."""
        if self.settings.eye_mtf != "none":  # what an eye sees of it reaches far
            return tuple(band.astype(dtype) for band in self._expected(framed(image, side // 2)))
        blurred = gaussian_blur(image, self.settings.template_blur_samples)
        return self._as_activity(self._pyramid(side).build_middle(blurred.astype(dtype), side // 2))

    def detection(self, pattern: FloatArray, width_mrad: float, half_width: int) -> Detection | None:
        """Fold the observer of a pattern onto the middle of its retina; see `Observer.detection`."""
        grid = self.grid(Stimulus(width_mrad))
        around = 8.0 * self.settings.template_blur_samples + 2.0 + BORDER
        half = even_half(min(len(pattern) // 2 + around, grid.side // 2))
        expected = self._expected_middle(framed(pattern, half), grid.side, np.float64)
        return Detection(self._fold(expected, grid, half_width), summed_variance(expected, self.settings.noise_sd))

    def _fold(self, bands: Bands, grid: RetinaGrid, half_width: int | None = None) -> FloatArray:
        """Compute the weights on the retina, or its middle, of weights of neurons: the adjoint of `activity`.

        Bands may be given where they are not zero, each in its own square.
        """
        weights = [self.settings.gain_of(k) * band for k, band in enumerate(bands)]
        if not self.settings.include_residual:
            weights.append(np.zeros((1, 1), weights[0].dtype))
        half = grid.side // 2
        needed = half if half_width is None or self.settings.eye_mtf != "none" else half_width
        folded = self._before_eye(self._pyramid(grid.side).adjoint_middle(weights, half, needed))
        return folded if half_width is None or needed == half_width else framed(folded, half_width)

    def _pyramid(self, side: int) -> LaplacianPyramid:
        return LaplacianPyramid((side - 1).bit_length() - 3, self.settings.kernel_a)  # side = 4 · 2^levels + 1

    def _as_activity(self, bands: list[FloatArray]) -> Bands:
        """Return the bands times their gain, with or without the residual."""
        if not self.settings.include_residual:
            bands.pop()
        for k, band in enumerate(bands):
            band *= self.settings.gain_of(k)
        return tuple(bands)
