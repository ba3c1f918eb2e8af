"""What a curve's computation does, as one value: made by `planning`, obeyed by `predict`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from sensor_sim.folding import Folding
from sensor_sim.sampling import TriangleSampler, field_detectors, field_sampler
from sensor_sim.sensor import Sensor
from todframes.errors import SettingsError
from todframes.planning import Step, total_bound
from todframes.readout import Observer, Readout, Stimulus
from todframes.stimulus import ORIENTATIONS, Orientation, bounding_box_offset

FloatArray = NDArray[np.float64]

FULL_PLACES = 17
"""Of a plan that leaves nothing out; twelve times as many trials as are enough for most."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CurvePlan:
    """How thresholds of a sensor for one size are computed.

    Attributes
    ----------
    observer : Observer
        With the pyramid levels that are needed.
    field : int
        Detectors along each side of the field.
    sampler : TriangleSampler
        Of the triangle in this field.
    dtype : float32 or float64
        Of the folding.
    orientations : tuple of Orientation
        Those computed; one stands for all where the others are the same, turned.
    three_templates : bool
        Fold three of the four score deviations: they add up to zero.
    merge_pixels : bool
        Count display pixels that must be alike as one.
    external_noise : bool
        Whether detector noise is looked at.
    fewest_places : int
        Along each axis of a detector, to begin with.
    steps : tuple of Step
    unit_s : float
        Time that folding and sampling took at each place tried.
    """

    observer: Observer
    field: int
    sampler: TriangleSampler
    dtype: DTypeLike = np.float64
    orientations: tuple[Orientation, ...] = ORIENTATIONS
    three_templates: bool = False
    merge_pixels: bool = False
    external_noise: bool = True
    fewest_places: int = 1
    steps: tuple[Step, ...] = ()
    unit_s: float = math.inf

    @property
    def bound(self) -> float:
        """On the change of P(correct) by all that is left out."""
        return total_bound(self.steps)

    def folding(self, sensor: Sensor, readout: Readout, size_detectors: float) -> Folding:
        """The readout's weights on the way to the detectors."""
        offsets = [centre_offset(self.observer, orientation, size_detectors) for orientation in ORIENTATIONS]
        return Folding(
            sensor,
            readout.grid,
            readout.deviations,
            n=3 if self.three_templates else 4,
            field=self.field,
            reach_detectors=0.5 + max(map(abs, np.ravel(offsets))),
            dtype=self.dtype,
            merge_pixels=self.merge_pixels,
        )

    def all_four(self, weights: FloatArray) -> FloatArray:
        """Weights of all four scores, (..., 4, n), from those that were folded."""
        if not self.three_templates:
            return weights
        return np.concatenate([weights, -weights.sum(axis=-2, keepdims=True)], axis=-2)

    def noise(self, weights: FloatArray) -> FloatArray:
        """Covariance of the scores, (..., 4, 4), under detector noise of standard deviation 1."""
        return noise_covariance(weights) if self.external_noise else np.zeros((*weights.shape[:-1], 4))


def noise_covariance(weights: FloatArray) -> FloatArray:
    """Covariance of weighted sums, (..., n, n), of white noise of standard deviation 1; weights (..., n, m)."""
    return np.asarray(weights @ weights.swapaxes(-1, -2))


def full_plan(sensor: Sensor, observer: Observer, size_detectors: float) -> CurvePlan:
    """Leaves nothing out but identities that no one would compute.

    Raises
    ------
    SettingsError
        If the size or field is out of range.
    """
    detectors = field_detectors(sensor, size_detectors)
    return CurvePlan(
        observer=observer,
        field=detectors,
        sampler=field_sampler(sensor, size_detectors),
        fewest_places=FULL_PLACES,
        steps=(Step("everything", True, f"as --plan full asks; the field is {detectors} detectors"),),
    )


def linear_readout(sensor: Sensor, observer: Observer, size_detectors: float) -> Readout:
    """The readout for a triangle as displayed; SettingsError if the observer has none."""
    readout = observer.readout(Stimulus(size_detectors * sensor.display.detector_pitch_mrad))
    if readout is None:
        raise SettingsError("observer: it is not linear; no curve can be computed, simulate frames instead")
    return readout


def centre_offset(observer: Observer, orientation: Orientation, size_detectors: float) -> FloatArray:
    """From the triangle's centroid to the point that the retina is centred on, in detectors."""
    offset = bounding_box_offset(orientation) if observer.centre == "bounding_box" else (0.0, 0.0)
    return np.array(offset) * size_detectors


def is_symmetric(readout: Readout) -> bool:
    """Whether the four scores are one and the same, turned, to the last bit."""
    first, covariance = readout.deviations[0], readout.noise_covariance
    return all(
        np.array_equal(readout.deviations[k], np.rot90(first, -k))
        and np.allclose(np.roll(covariance[0], k), covariance[k], rtol=1e-12)
        for k in range(1, 4)
    )
