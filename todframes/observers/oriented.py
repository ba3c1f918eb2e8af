"""An observer whose neurons are oriented: Gabor functions in place of the pyramid's Mexican hats.

All else is as in `PyramidObserver`: noise on every neuron, correlation with the expected activity for four
triangles. With complex cells it is not linear.

Hogervorst et al. 2001, section 9.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
from numpy.typing import DTypeLike

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.observers.gabor_pyramid import GaborPyramid, Phases
from todframes.observers.interface import Detection, Readout, keeps_last
from todframes.observers.internal_noise import Bands
from todframes.observers.laplacian_pyramid import framed
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.observers.retina import RetinaGrid
from todframes.stimulus import Stimulus

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
