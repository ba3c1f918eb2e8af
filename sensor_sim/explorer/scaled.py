"""Observers whose internal noise is one factor, so that a readout is kept and used for all its values."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Hashable
from dataclasses import replace
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from sensor_sim.thresholds.curve_plan import is_symmetric, not_linear
from sensor_sim.thresholds.sharing import Kept
from todframes.base._typing import FloatArray
from todframes.observers.csf import CsfObserver
from todframes.observers.interface import KEPT, Observer, OmittedWeights, Readout
from todframes.observers.oriented import OrientedObserver
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import RetinaGrid
from todframes.stimulus import Centre, Stimulus


class Unit(NamedTuple):
    """An observer, pickled, and the factor that its internal noise is to be scaled with."""

    pickled: bytes
    noise_sd: float


def unit_of(observer: Observer) -> Unit:
    """Return the observer with a usual internal noise, and the ratio of its own standard deviation to that.

    Observers whose weights may depend on the noise stay as they are, with the factor 1.
    """
    if type(observer) in {PyramidObserver, OrientedObserver}:
        settings = cast("PyramidObserver", observer).settings
        of_unit_noise: Any = type(observer)(replace(settings, internal_noise=0.0, internal_noise_sd=1.0))
        return Unit(pickle.dumps(of_unit_noise), settings.noise_sd)
    if type(observer) is CsfObserver and observer.settings.template == "matched":
        average = CsfObserver(replace(observer.settings, efficiency=1.0))
        return Unit(pickle.dumps(average), observer.settings.noise_sd / average.settings.noise_sd)
    return Unit(pickle.dumps(observer), 1.0)


class ReadoutNoise(NamedTuple):
    """Noise covariance and symmetry of a readout, without its weights. The noise is not scaled."""

    noise_covariance: FloatArray
    is_symmetric: bool
    nbytes: int = 0


class Weights(NamedTuple):
    """Weights of a readout in single precision. A symmetric readout has the first image only; its turns are the
    others."""

    images: NDArray[np.float32]

    @property
    def nbytes(self) -> int:
        """Size in bytes."""
        return self.images.nbytes

    def all_four(self) -> NDArray[np.float32]:
        """Return the weights of the four scores, (4, side, side)."""
        if len(self.images) == 4:
            return self.images
        return np.stack([np.rot90(self.images[0], -k) for k in range(4)])


class ScaledObserver(Observer):
    """A linear observer as a curve needs it, with its internal noise scaled.

    Parameters
    ----------
    make : function of no arguments
        Makes the observer anew.
    name : hashable
        Key that distinguishes this observer from all others.
    scale : float
        Factor of the standard deviation of the internal noise.
    kept : Kept
        Looks and weights of readouts, for all scales.
    """

    def __init__(self, make: Callable[[], Observer], name: Hashable, scale: float, kept: Kept[Any]) -> None:
        self.name, self._make, self._scale, self._kept = name, make, scale, kept
        self._base = make()

    @property
    def centre(self) -> Centre:
        """Point of the triangle on which the grid's middle lies."""
        return self._base.centre

    @property
    def position_jitter_samples(self) -> float:
        """Largest displacement of the grid, in retina samples."""
        return self._base.position_jitter_samples

    @property
    def omitted_part(self) -> str:  # type: ignore[override] # of the class elsewhere
        """Name of what the readout omits."""
        return self._base.omitted_part

    def times(self, factor: float) -> ScaledObserver:
        """Return the observer with its internal noise scaled once more."""
        return ScaledObserver(self._make, self.name, factor * self._scale, self._kept)

    def grid(self, stimulus: Stimulus) -> RetinaGrid:
        """Return the retina samples that the observer looks at."""
        return self._base.grid(stimulus)

    def readout(self, stimulus: Stimulus) -> Readout | None:
        """Return the readout with its noise scaled; None if the observer is not linear."""
        kept: list[_Whole] = self._kept.get((self.name, stimulus, "whole"), lambda: self._whole(stimulus))
        if not kept:
            return None
        readout = kept[0].readout
        readout = replace(readout, noise_covariance=self._scale**2 * readout.noise_covariance)
        # Instead of a hash of the weights, which takes longer than the weights of a place.
        vars(readout)["weights_key"] = (self.name, stimulus)
        return readout

    def noise(self, stimulus: Stimulus, half_width: int) -> ReadoutNoise:
        """Return the noise of a readout, and keep its weights within `half_width` samples as well.

        Raises
        ------
        SettingsError
            If the observer is not linear.
        """
        noise: ReadoutNoise = self._kept.get((self.name, stimulus), lambda: self._parts(stimulus, half_width)[0])
        return noise._replace(noise_covariance=self._scale**2 * noise.noise_covariance)

    def weights(self, stimulus: Stimulus, half_width: int) -> NDArray[np.float32]:
        """Return the weights of a readout within at least `half_width` samples of the middle, (4, side, side)."""
        kept: Weights = self._kept.get(
            (self.name, stimulus, half_width), lambda: self._parts(stimulus, half_width)[1]
        )
        return kept.all_four()

    def _parts(self, stimulus: Stimulus, half_width: int) -> tuple[ReadoutNoise, Weights]:
        """Compute the parts of a readout that are kept, and keep both."""
        if type(self._base) is PyramidObserver:
            upright, covariance = self._base.weights_within(stimulus, half_width, np.float32)
            noise, weights = ReadoutNoise(covariance, is_symmetric=True), Weights(upright[None])
        else:
            whole = self._whole(stimulus)
            if not whole:
                raise not_linear()
            readout = whole[0].readout
            symmetric = is_symmetric(readout)
            noise = ReadoutNoise(readout.noise_covariance, symmetric)
            weights = Weights(readout.deviations[: 1 if symmetric else 4].astype(np.float32))
        self._kept.get((self.name, stimulus), lambda: noise)
        self._kept.get((self.name, stimulus, half_width), lambda: weights)
        return noise, weights

    def _whole(self, stimulus: Stimulus) -> list[_Whole]:
        """Return the readout on the whole retina, not scaled; none if the observer is not linear."""
        base = self._make()
        readout = base.readout(stimulus)
        vars(base).pop(KEPT, None)  # the readout and the observer refer to each other, and would live on for long
        return [] if readout is None else [_Whole(readout)]

    def with_extra_level(self) -> ScaledObserver:
        """Return the observer with one extra level; itself if it has none."""
        base = self._make()
        if base.with_extra_level() is base:
            return self
        return self._variant("more", lambda base: base.with_extra_level())

    def with_fewer_levels(self, stimulus: Stimulus) -> ScaledObserver | None:
        """Return the observer with one level fewer; None if that is not possible."""
        if self._make().with_fewer_levels(stimulus) is None:
            return None
        return self._variant("fewer", lambda base: base.with_fewer_levels(stimulus))

    def _variant(self, name: str, change: Callable[[Observer], Observer | None]) -> ScaledObserver:
        make = self._make

        def make_variant() -> Observer:
            return cast("Observer", change(make()))

        return ScaledObserver(make_variant, (self.name, name), self._scale, self._kept)

    def omitted_bands(self, stimulus: Stimulus) -> OmittedWeights | None:
        """Estimate what the readout omits."""
        omitted = self._make().omitted_bands(stimulus)
        if omitted is None:
            return None
        return omitted._replace(noise_covariance=self._scale**2 * omitted.noise_covariance)


class _Whole(NamedTuple):
    readout: Readout

    @property
    def nbytes(self) -> int:
        return self.readout.deviations.nbytes
