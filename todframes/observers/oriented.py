"""An observer whose neurons are oriented: Gabor functions in place of the pyramid's Mexican hats.

All else is as in `PyramidObserver`: noise on every neuron, correlation with the expected activity for four
triangles. With complex cells it is not linear.

Hogervorst et al. 2001, section 9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np
from msgspec import Meta
from numpy.typing import DTypeLike, NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import check_values
from todframes.observers.interface import Detection, Readout, keeps_last
from todframes.observers.internal_noise import Bands
from todframes.observers.pyramid import LaplacianPyramid, PyramidObserver, PyramidSettings, framed
from todframes.observers.retina import RetinaGrid
from todframes.stimulus import Stimulus

Phases = Literal["both", "even", "odd"]

CUT = 4.0
"""Standard deviations at which a Gabor function ends: its envelope is 3e-4 there."""


@dataclass(frozen=True, slots=True)
class GaborPyramid:
    """Gabor functions of many orientations on the levels of a Gaussian pyramid, with parameters as in
    `OrientedSettings`. Daugman 1985; Burt & Adelson 1983. One half of the orientations is the other half after a
    quarter turn, sample by sample. So a turned image causes the turned responses: that of each neuron appears at
    the turned place, in the neuron of the turned orientation. Together the neurons of a place respond to gratings
    of their level's best frequency with the grating's own energy, averaged over its direction, however many
    orientations and phases they are divided into. None responds to a uniform field.
    """

    levels: int
    kernel_a: float = 0.375
    orientations: Annotated[int, Meta(ge=2, le=32)] = 8
    wavelength_samples: Annotated[float, Meta(ge=2.5, le=16.0)] = 4.0
    bandwidth_octaves: Annotated[float, Meta(ge=0.5, le=3.0)] = 1.0
    elongation: Annotated[float, Meta(ge=0.25, le=4.0)] = 1.0
    phases: Phases = "both"

    def __post_init__(self) -> None:
        check_values(self)
        if self.orientations % 2:
            raise SettingsError(f"orientations: found {self.orientations}, expected an even number from 2 to 32")

    @property
    def signs(self) -> tuple[int, ...]:
        """Signs that half a turn gives to the phases, in their order."""
        return {"both": (1, -1), "even": (1,), "odd": (-1,)}[self.phases]

    def build(self, image: FloatArray) -> list[FloatArray]:
        """Compute responses to an image of shape (side, side), finest level first, and the low-pass residual last.
        Those of a level have the shape (phases, orientations, side of the level, side of the level).
        """
        radius, shape = self._radius, (len(self.signs), self.orientations)
        inside = slice(radius, -radius)
        levels = []
        for level in range(self.levels):
            mirrored = _mirrored(len(image), radius)
            padded = image[mirrored][:, mirrored]
            responses = np.array([_correlated(padded, kernel)[inside, inside] for kernel in _kernels(self)])
            levels.append(_gains(self)[level] * responses.reshape(*shape, *image.shape))
            image = self._pyramid.reduce(image)
        return [*levels, image.copy()]

    def adjoint(self, responses: Sequence[FloatArray]) -> FloatArray:
        """Return the image Gᵀy with ⟨y, Gx⟩ = ⟨Gᵀy, x⟩ for every image x, G being `build`."""
        radius, image = self._radius, responses[-1]
        for level in reversed(range(self.levels)):
            side = responses[level].shape[-1]
            mirrored = _mirrored(side, radius)
            padded = np.zeros((len(mirrored),) * 2)
            for response, kernel in zip(responses[level].reshape(-1, side, side), _kernels(self), strict=True):
                padded += _correlated(np.pad(response, radius), kernel[::-1, ::-1])
            rows, columns = np.zeros((side, len(mirrored))), np.zeros((side, side))
            np.add.at(rows, mirrored, _gains(self)[level] * padded)
            np.add.at(columns, mirrored, rows.T)
            image = columns.T + self._pyramid.reduce_adjoint(image, (side, side))
        return np.array(image)

    @property
    def _pyramid(self) -> LaplacianPyramid:
        return LaplacianPyramid(self.levels, self.kernel_a)

    @property
    def _radius(self) -> int:
        return len(_kernels(self)[0]) // 2


@lru_cache(maxsize=8)
def _gains(pyramid: GaborPyramid) -> FloatArray:
    """Return for each level 1 over its response to its best gratings, a root mean square over directions."""
    direction = np.arange(4 * pyramid.orientations) * np.pi / (4 * pyramid.orientations)
    best = np.array([np.cos(direction), np.sin(direction)]) / pyramid.wavelength_samples
    squares = np.square(np.abs(_transfer(_kernels(pyramid), best))).sum(axis=0)
    gains = []
    for level in range(pyramid.levels):
        gains.append(1.0 / math.sqrt(squares.mean()))
        squares *= np.square(_reduce_transfer(best / 2.0 ** (level + 1), pyramid.kernel_a))
    return np.array(gains)


@lru_cache(maxsize=8)
def _kernels(pyramid: GaborPyramid) -> FloatArray:
    """Compute the Gabor functions without gain, shape (phases · orientations, 2 r + 1, 2 r + 1)."""
    octaves = 2.0**pyramid.bandwidth_octaves
    # The Gaussian in frequency is 1/2 at the ends of the bandwidth: f (2ᵇ − 1)/(2ᵇ + 1) on both sides.
    sigma = pyramid.wavelength_samples * math.sqrt(math.log(2.0) / 2.0) / math.pi * (octaves + 1) / (octaves - 1)
    radius = math.ceil(CUT * sigma * max(1.0, pyramid.elongation))
    size = (2 * radius + 1,) * 2
    kernels = []
    for sign in pyramid.signs:
        phase = 0.0 if sign > 0 else math.pi / 2.0
        first = []
        for orientation in range(pyramid.orientations // 2):
            theta = math.pi * orientation / pyramid.orientations
            shape = (size, sigma, theta)
            wave = cv2.getGaborKernel(
                *shape, pyramid.wavelength_samples, 1.0 / pyramid.elongation, phase, ktype=cv2.CV_64F
            )
            envelope = cv2.getGaborKernel(*shape, 1e300, 1.0 / pyramid.elongation, 0.0, ktype=cv2.CV_64F)
            # Blind to a uniform field, as the odd ones are by themselves.
            first.append(wave - envelope * (wave.sum() / envelope.sum()) if sign > 0 else wave)
        kernels += [*first, *(np.rot90(kernel, -1) for kernel in first)]
    return np.array(kernels)


def _transfer(kernels: FloatArray, frequency: FloatArray) -> NDArray[np.complex128]:
    """Compute the transfer of each kernel at each frequency, (2, n) in cycles a sample: (kernels, n)."""
    places = np.arange(kernels.shape[-1]) - kernels.shape[-1] // 2
    along_x, along_y = np.exp(-2j * np.pi * frequency[..., None] * places)
    return np.asarray(np.einsum("kyx,nx,ny->kn", kernels, along_x, along_y))


def _reduce_transfer(frequency: FloatArray, a: float) -> FloatArray:
    """Compute the transfer of the kernel in front of halving, at frequencies (2, n) in cycles a sample: (n,)."""
    turn = 2.0 * np.pi * frequency
    return np.asarray((a + np.cos(turn) / 2.0 + (0.5 - a) * np.cos(2.0 * turn)).prod(axis=0))


def _mirrored(side: int, margin: int) -> NDArray[np.intp]:
    """Return the places of an image with margins, mirrored about its outermost samples (reflect-101)."""
    return np.pad(np.arange(side), margin, mode="reflect")


def _correlated(image: FloatArray, kernel: FloatArray) -> FloatArray:
    return np.asarray(cv2.filter2D(image, cv2.CV_64F, kernel, borderType=cv2.BORDER_CONSTANT))


LARGEST_NEURON_COUNT = 1e8
"""Largest number of neurons. Their activity then takes 0.8 GB, and the arrays computed from it a few times as
much."""


@dataclass(frozen=True, slots=True, kw_only=True)
class OrientedSettings(PyramidSettings):
    """Settings of `PyramidSettings`, its levels being octaves of `GaborPyramid`, and of the Gabor functions.

    Attributes
    ----------
    orientations : int
        Evenly spaced over 180°; even.
    wavelength_samples : float
        Wavelength that the finest neurons respond to best, in retina samples; an octave more on each level.
    bandwidth_octaves : float
        Full width at half the largest response.
    elongation : float
        Length of a receptive field, along the bars, over its width.
    phases : {"both", "even", "odd"}
        Symmetric, antisymmetric receptive fields, or both.
    complex_cells : bool
        Whether the two phases of a place join in one neuron, the root of the sum of their squares, which responds
        to bars of both polarities wherever they lie in its field. The observer is then not linear.
    """

    orientations: int = 8
    wavelength_samples: float = 4.0
    bandwidth_octaves: float = 1.0
    elongation: float = 1.0
    phases: Phases = "both"
    complex_cells: bool = False

    def __post_init__(self) -> None:
        PyramidSettings.__post_init__(self)
        self.filters(0)
        if self.complex_cells and self.phases != "both":
            raise SettingsError(f"phases: found {self.phases!r} with complex_cells, expected both")

    def filters(self, levels: int) -> GaborPyramid:
        """Make the neurons of this number of levels."""
        return GaborPyramid(levels, *(getattr(self, field.name) for field in fields(GaborPyramid)[1:]))


class OrientedObserver(PyramidObserver):
    """An observer with oriented neurons, whose readout is that of the paper's observer. Parameters are as for
    `PyramidObserver`, with `OrientedSettings`. Hogervorst et al. 2001, section 9.

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.naked_eye(size_mrad=2.4, observer=tod.OrientedObserver())
    """

    settings_type: ClassVar[type[OrientedSettings]] = OrientedSettings
    settings: OrientedSettings

    def make_readout(self, stimulus: Stimulus) -> Readout | None:
        """Compute the readout as `PyramidObserver` does; None with complex cells, which are not linear."""
        return None if self.settings.complex_cells else super().make_readout(stimulus)

    def grid(self, stimulus: Stimulus) -> RetinaGrid:
        """Return the retina samples, as `PyramidObserver` does."""
        grid, filters = super().grid(stimulus), self.settings.filters(0)
        neurons = 4 / 3 * grid.side**2 * len(filters.signs) * filters.orientations
        if neurons > LARGEST_NEURON_COUNT:
            raise SettingsError(
                f"orientations: found {filters.orientations}; for a triangle of {stimulus.size_mrad:g} mrad they "
                f"are {neurons:.2g} neurons, expected at most {LARGEST_NEURON_COUNT:g}"
            )
        return grid

    def activity(self, contrast: FloatArray) -> Bands:
        """Compute the noise-free activity of all neurons for a retina image of shape (side, side).

        Each level has an array (phases, orientations, side of the level, side of the level), finest level first.
        """
        settings = self.settings
        bands = self._filters(len(contrast)).build(self._through_eye(contrast))
        if settings.complex_cells:
            bands[:-1] = [np.hypot(*band)[None] for band in bands[:-1]]
        if not settings.include_residual:
            bands.pop()
        return tuple(settings.gain_of(k) * band for k, band in enumerate(bands))

    def turned(self, bands: Bands, quarter_turns: int) -> Bands:
        """Compute the activity that an image turned clockwise causes, from that of the image."""
        for _ in range(quarter_turns):
            bands = tuple(map(self._turned_once, bands))
        return bands

    def _turned_once(self, band: FloatArray) -> FloatArray:
        turned = np.ascontiguousarray(np.rot90(band, -1, axes=(-2, -1)))
        if band.ndim == 2:  # the residual
            return turned
        half = self.settings.orientations // 2
        turned = np.roll(turned, half, axis=1)
        # What a quarter carries beyond 180° is the first half again, seen from the other side.
        for phase, sign in zip(
            turned, (1,) if self.settings.complex_cells else self.settings.filters(0).signs, strict=True
        ):
            phase[:half] *= sign
        return turned

    @keeps_last(2)
    def templates(self, stimulus: Stimulus) -> tuple[Bands, ...]:
        """Compute the weights of all neurons in each score; those of complex cells have no common part, as their
        activity is no sum of two images'.
        """
        if not self.settings.complex_cells:
            return super().templates(stimulus)
        upright = self._expected(self._upright(stimulus))
        return tuple(self.turned(upright, turns) for turns in range(4))

    def _readout_deviation(self, stimulus: Stimulus, dtype: DTypeLike) -> Bands:
        return tuple(band.astype(dtype) for band in self._template_deviation(stimulus))

    def detection(self, pattern: FloatArray, width_mrad: float, half_width: int) -> Detection | None:
        """Fold the observer of a pattern as `PyramidObserver` does; None with complex cells."""
        return None if self.settings.complex_cells else super().detection(pattern, width_mrad, half_width)

    def _expected_middle(self, image: FloatArray, side: int, dtype: DTypeLike) -> Bands:
        expected = self._expected(framed(image, side // 2))
        return tuple(band.astype(dtype) for band in expected)

    def _fold(self, bands: Bands, grid: RetinaGrid, half_width: int | None = None) -> FloatArray:
        weights = [self.settings.gain_of(k) * band for k, band in enumerate(bands)]
        filters = self._filters(grid.side)
        if not self.settings.include_residual:
            weights.append(np.zeros((grid.side // 2**filters.levels + 1,) * 2))
        folded = self._before_eye(filters.adjoint(weights))
        return folded if half_width is None else framed(folded, half_width)

    def _filters(self, side: int) -> GaborPyramid:
        return self.settings.filters((side - 1).bit_length() - 3)  # side = 4 · 2^levels + 1
