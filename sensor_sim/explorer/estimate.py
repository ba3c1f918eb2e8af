"""Estimate of a threshold within milliseconds, and its error, from a few lattices of places.

The mean over the place of the triangle on the detectors is taken on `REPLICATES` lattices, each displaced into
another fifth of a lattice's step. What one of them gets wrong is mostly what the others get wrong the other way:
the spread between them, taken as if they were independent, overstates the error of their mean.

The places are the same for every sensor. So two sensors that are nearly alike have nearly the same error, and the
threshold of one that is known better corrects the estimate of the other: the spread of their ratios says how well.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensor_sim.curve_plan import CurvePlan, centre_offset
from sensor_sim.folding import Folding, is_unblurred
from sensor_sim.predict import KRONECKER_STEPS, Phases
from sensor_sim.sampling import TriangleSampler, field_detectors, smallest_field
from sensor_sim.sensor import Sensor
from sensor_sim.sharing import Shared
from todframes._typing import FloatArray
from todframes.observers.decision import answer_probability
from todframes.observers.interface import Observer
from todframes.observers.retina import RetinaGrid
from todframes.psychometrics.threshold_search import crossing
from todframes.stimulus import ORIENTATIONS

REPLICATES = 5
"""Number of lattices."""

FEW_PLACES, MORE_PLACES = 4, 7
"""Places along each axis of a lattice, and those to try if the error is too large with the former."""

STRATA = (np.arange(REPLICATES) + np.random.default_rng(3).random(REPLICATES))[
    [[0, 0], [1, 2], [2, 4], [3, 1], [4, 3]]
]
"""Displacements of the lattices along x and y, in fifths of a lattice's step: one in each, at random within it.
Both axes have the same ones, so that what is computed for a place along one serves the other as well."""

STANDARD_ERRORS_95 = 2.776
"""Half-width of a 95 % interval in standard errors: Student's t with one degree of freedom less than lattices."""

ORTHANT_TOLERANCE = 1e-5
"""Error of each P(correct)."""

FIELD_IN_SIZES = 2.0
"""Side of the detectors' field in sizes of the triangle, without the reach of blur: the least that plans leave."""

SMALL_JITTER = 0.03
"""Displacement of the retina, in detectors, that is left out: the hold of a detector blurs 300 times as much."""

LEFT_OUT = 3e-4
"""Change of P(correct) that `quick_plan` and `SMALL_JITTER` may cause; over sensors at random it is below half."""

STEP = 0.05
"""Distance in ln level between the two points from which the slope is taken."""


Level = Literal["snr", "contrast"]
"""Quantity that is varied: the detectors' noise under a triangle of contrast 1, or, without detector noise, the
contrast of a large triangle on the display."""


class Reference(NamedTuple):
    """A sensor whose threshold is known better than the lattices give it.

    Attributes
    ----------
    deviations : ndarray, shape (REPLICATES,)
        As of `Estimate`.
    correction : float
        ln of the known threshold over the estimate.
    error : float
        Relative error of the known threshold, half-width of a 95 % interval.
    """

    deviations: FloatArray
    correction: float
    error: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """An estimate of a threshold.

    Attributes
    ----------
    status : str
        As of `PredictedThreshold`; if it is not "ok", the others are NaN.
    threshold : float
        Without correction by a reference.
    deviations : ndarray, shape (REPLICATES,)
        ln of each lattice's threshold over that of all.
    slope : float
        dP/d ln level at the threshold.
    """

    status: Literal["ok", "never_reached", "always_exceeded"]
    threshold: float
    deviations: FloatArray
    slope: float

    def corrected(self, reference: Reference | None) -> tuple[float, float]:
        """Return the threshold and the half-width of its 95 % interval, by the reference if that is narrower."""
        half_width, correction = _half_width(self.deviations), 0.0
        if reference is not None:
            by_ratio = _half_width(self.deviations - reference.deviations) + reference.error
            if by_ratio < half_width:
                half_width, correction = by_ratio, reference.correction
        threshold = self.threshold * math.exp(correction)
        return threshold, (half_width + LEFT_OUT / self.slope) * threshold

    def as_reference(self, threshold: float, error: float) -> Reference:
        """Return the reference that this sensor is with a threshold that is known better."""
        return Reference(self.deviations, math.log(threshold / self.threshold), error / threshold)


def _half_width(deviations: FloatArray) -> float:
    return STANDARD_ERRORS_95 * float(deviations.std(ddof=1)) / math.sqrt(REPLICATES)


def quick_field(sensor: Sensor, size_detectors: float) -> int:
    """Return the detectors along each side of the field of an estimate."""
    blur = 6.0 * sensor.optics.blur_sigma_mrad / sensor.detector.pitch_mrad
    post_sample_px = math.hypot(sensor.display.blur_sigma_px, sensor.electronics.blur_sigma_px)
    blur += 4.0 * post_sample_px / sensor.display.pixels_per_detector
    full = field_detectors(sensor, size_detectors)
    needed = max(math.ceil(FIELD_IN_SIZES * size_detectors + blur) + 2, smallest_field(size_detectors))
    return min(needed + (full - needed) % 2, full)


def seen_samples(sensor: Sensor, observer: Observer, size_detectors: float, grid: RetinaGrid) -> int:
    """Return how many retina samples on each side of the middle see the field.

    It is rounded up to an eighth of the size, so that sensors whose fields differ by a detector share weights.
    """
    per_detector = sensor.display.detector_pitch_mrad / grid.pitch_mrad
    offset = np.abs([centre_offset(observer, orientation, size_detectors) for orientation in ORIENTATIONS]).max()
    needed = (quick_field(sensor, size_detectors) / 2.0 + 0.5 + float(offset)) * per_detector + 1.0
    step = max(size_detectors * per_detector / 8.0, 4.0)
    return min(math.ceil(math.ceil(needed / step) * step), grid.side // 2)


def quick_plan(
    sensor: Sensor, observer: Observer, size_detectors: float, *, symmetric: bool, shared: Shared
) -> CurvePlan:
    """Return a plan that leaves out, untried, what most plans do: the far field, double precision."""
    field = quick_field(sensor, size_detectors)
    sampler = shared.samplers.get(
        ("quick", sensor.optics, sensor.detector, size_detectors, field),
        lambda: TriangleSampler(
            optics=sensor.optics,
            detector=sensor.detector,
            size_detectors=size_detectors,
            field_detectors=field,
            period_detectors=2 * field,
        ),
    )
    return CurvePlan(
        observer=observer,
        field=field,
        sampler=sampler,
        dtype=np.float32,
        orientations=ORIENTATIONS[:1] if symmetric else ORIENTATIONS,
        three_templates=True,
        merge_pixels=is_unblurred(sensor),
        shared=shared,
    )


def lattice_phases(
    sensor: Sensor,
    observer: Observer,
    size_detectors: float,
    plan: CurvePlan,
    *,
    places: int,
    jitter: float,
    name: Hashable,
    pitch_mrad: float,
    images: Callable[[], NDArray[Any]],
) -> list[Phases]:
    """Return the trials of each orientation on all lattices, one lattice after the other.

    Parameters
    ----------
    sensor : Sensor
    observer : Observer
    size_detectors : float
    plan : CurvePlan
    places : int
        Places along each axis of a lattice.
    jitter : float
        Largest displacement of the retina along each axis, in detectors.
    name : hashable
        All that the weights on the retina depend on.
    pitch_mrad : float
        Visual angle from one of these weights to the next.
    images : function of no arguments
        Returns them, (4, side, side); called if they are not folded yet.
    """
    along = np.arange(places) / places - 0.5
    middle_x, middle_y = along + STRATA.T[..., None] / (places * REPLICATES)
    row, column = np.divmod(np.arange(places**2)[:, None], places)
    evenly = row * KRONECKER_STEPS[0] + column * KRONECKER_STEPS[1]
    evenly = (evenly + np.arange(REPLICATES)[:, None, None] * KRONECKER_STEPS.sum(axis=0)) % 1.0
    signs = np.array([[1.0], [-1.0]]) if jitter > SMALL_JITTER else np.zeros((1, 1))
    displacement = jitter * (2.0 * evenly - 1.0).reshape(-1, 1, 2) * signs
    place = np.empty((REPLICATES, places, places, 1, 2))
    place[..., 0, 0], place[..., 0, 1] = middle_x[:, None, :], middle_y[:, :, None]
    x, y = np.ascontiguousarray((place.reshape(-1, 1, 2) - displacement).reshape(-1, 2).T)
    offsets = [centre_offset(observer, orientation, size_detectors) for orientation in plan.orientations]

    @cache
    def folding() -> Folding:
        of_scores = images()
        return Folding(
            sensor,
            RetinaGrid(of_scores.shape[-1], pitch_mrad),
            of_scores,
            n=3,
            field=plan.field,
            reach_detectors=0.5 + float(np.abs(offsets).max()),
            dtype=plan.dtype,
            merge_pixels=plan.merge_pixels,
        )

    trials = []
    for orientation, (dx, dy) in zip(plan.orientations, offsets, strict=True):
        of_lattices = []
        for number in range(REPLICATES):
            at = middle_x[number] + dx, middle_y[number] + dy
            key = (name, sensor.display, sensor.electronics, plan.field, places, number, dx, dy)
            of_lattices.append(plan.shared.weights.get(key, partial(_weights, folding, *at)))
        weights = plan.all_four(np.concatenate(of_lattices).astype(np.float64)) * sensor.display.gain
        samples = plan.samples(x, y, orientation).reshape(len(weights), -1, plan.field**2)
        trials.append(Phases(samples @ weights.swapaxes(1, 2), plan.noise(weights), orientation.quarter_turns))
    return trials


def _weights(folding: Callable[[], Folding], places_x: FloatArray, places_y: FloatArray) -> NDArray[Any]:
    return np.concatenate(folding().weights_by_row(places_x, places_y))


def covariance_at(level: Level, value: float, internal: FloatArray, detector: FloatArray) -> FloatArray:
    """Return the covariance of the scores over the square of the triangle's contrast, at a value of the level.

    Parameters
    ----------
    level : {"snr", "contrast"}
    value : float
    internal : ndarray, shape (4, 4)
        Covariance from the internal noise.
    detector : ndarray, shape (..., 4, 4)
        Covariance from detector noise of standard deviation 1.
    """
    return internal + detector / value**2 if level == "snr" else internal / value**2


def estimate(
    phases: list[Phases],
    internal: FloatArray,
    p_correct: float,
    *,
    level: Level,
    near: float | None,
    slope: float,
) -> Estimate:
    """Estimate a threshold from the trials on all lattices.

    Parameters
    ----------
    phases : list of Phases
        Of each orientation, from `lattice_phases`.
    internal : ndarray, shape (4, 4)
        Covariance of the internal noise on the scores.
    p_correct : float
        Raw proportion correct at threshold.
    level : {"snr", "contrast"}
    near, slope : float
        Threshold of a similar sensor, to begin with, and the slope dP/d ln level there; None if there is none.
    """

    def of_each(value: float) -> FloatArray:
        proportions = [
            answer_probability(
                part.signal,
                covariance_at(level, value, internal, part.noise[:, None]),
                part.correct,
                tolerance=ORTHANT_TOLERANCE,
            )
            .reshape(REPLICATES, -1)
            .mean(axis=1)
            for part in phases
        ]
        return np.asarray(np.mean(proportions, axis=0))

    status, threshold = crossing(lambda value: float(of_each(value).mean()), p_correct, near=near, slope=slope)
    if threshold is None:
        return Estimate(status, math.nan, np.full(REPLICATES, math.nan), math.nan)
    low, high = of_each(threshold * math.exp(-STEP / 2.0)), of_each(threshold * math.exp(STEP / 2.0))
    slope = max(float((high - low).mean()) / STEP, 1e-12)
    middle = (low + high) / 2.0
    return Estimate(status, threshold, (middle.mean() - middle) / slope, slope)
