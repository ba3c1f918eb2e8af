"""Estimate of a threshold within milliseconds, and its error, from a few lattices of places.

P(correct) is averaged over places of the triangle on the detectors. These places form `LATTICES` lattices, each
shifted into another fifth of the distance between two places. Together the shifts cover that distance evenly, so
the errors of the lattices partly cancel. The spread among the lattices, taken as if they were independent,
therefore overstates the error of their mean.

The places are the same for every sensor. So two similar sensors have nearly the same error. If the threshold of
one of them is known more exactly, it corrects the estimate of the other, and the spread of the lattices' ratios
gives the error that remains.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensor_sim.chain.sampling import field_detectors, field_sampler, smallest_field
from sensor_sim.chain.sensor import Sensor
from sensor_sim.chain.transfer import blur_mrad
from sensor_sim.thresholds.curve_plan import (
    CurvePlan,
    centre_offset,
    is_alike_when_turned,
    lines_of,
    seen_detectors,
)
from sensor_sim.thresholds.folding import Folding, is_unblurred
from sensor_sim.thresholds.predict import (
    KRONECKER_STEPS_4D,
    Lattice,
    Phases,
    PooledThreshold,
    Reference,
    phases_on,
    pooled,
)
from sensor_sim.thresholds.sharing import Shared
from todframes.base._typing import FloatArray
from todframes.observers.interface import Observer
from todframes.observers.retina import RetinaGrid
from todframes.scoring.error_budget import half_width_95
from todframes.stimulus import ORIENTATIONS

LATTICES = 5
"""Number of lattices."""

FEW_PLACES, MORE_PLACES = 4, 7
"""Places along each axis of a lattice, and those to try if the error is too large with the former."""

SHIFTS = (np.arange(LATTICES) + np.random.default_rng(3).random(LATTICES))[
    [[0, 0], [1, 2], [2, 4], [3, 1], [4, 3]]
] / LATTICES
"""Shifts of the lattices along x and y: one in each fifth of the distance of two places, at random within it. Both
axes have the same shifts, so results for a place along one axis are used for the other as well."""

QUICK_ORTHANT_TOLERANCE = 1e-5
"""Error of each P(correct)."""

FIELD_IN_SIZES = 2.0
"""Side of the detectors' field in sizes of the triangle, without the reach of blur: the least that plans leave."""

SMALL_JITTER = 0.03
"""Displacement of the retina, in detectors, that is left out: the hold of a detector blurs 300 times as much."""

LEFT_OUT = 3e-4
"""Change of P(correct) that `quick_plan` and `SMALL_JITTER` may cause; over sensors at random it is below half."""


def corrected(found: PooledThreshold, reference: Reference | None) -> tuple[float, float]:
    """Return a threshold and the half-width of its 95 % interval, corrected by the reference if that is
    narrower."""
    half_width, correction = half_width_95(found.deviations, is_refined=False), 0.0
    if reference is not None:
        by_ratio = half_width_95(found.deviations - reference.deviations, is_refined=False) + reference.error
        if by_ratio < half_width:
            half_width, correction = by_ratio, reference.correction
    threshold = found.threshold * math.exp(correction)
    return threshold, (half_width + LEFT_OUT / found.slope) * threshold


def quick_field(sensor: Sensor, size_detectors: float) -> int:
    """Return the detectors along each side of the field of an estimate."""
    blur = 6.0 * blur_mrad(sensor.optics, sensor.motion) / sensor.detector.pitch_mrad
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
    """Return a plan that leaves out, without a test, what most plans leave out: the far field and double
    precision."""
    whole = quick_field(sensor, size_detectors)
    field = min(whole, seen_detectors(sensor, observer, size_detectors))
    sampler = shared.samplers.get(
        ("quick", sensor.optics, sensor.motion, sensor.detector, size_detectors, whole),
        lambda: field_sampler(sensor, size_detectors, whole),
    ).within(field)
    return CurvePlan(
        observer=observer,
        field=field,
        sampler=sampler,
        dtype=np.float32,
        orientations=ORIENTATIONS[:1] if symmetric and is_alike_when_turned(sensor) else ORIENTATIONS,
        three_templates=True,
        merge_pixels=is_unblurred(sensor),
        lines=lines_of(sensor),
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
    counts_photons: bool = False,
) -> list[Phases]:
    """Return the trials of each orientation on all lattices, as `pooled`.

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
    counts_photons : bool
        Whether the trials need `Phases.of_light`.
    """
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

    def weights_by_row(number: int, x: FloatArray, y: FloatArray) -> NDArray[Any]:
        key = (name, sensor.display, sensor.electronics, plan.field, places, number, x[0], y[0])
        weights: NDArray[Any] = plan.shared.weights.get(key, lambda: folding().weights_by_row(x, y))
        return weights

    return pooled(
        [
            phases_on(
                Lattice.at(
                    places,
                    shift=shift,
                    first=number * KRONECKER_STEPS_4D.sum(axis=0),
                    jitter=jitter if jitter > SMALL_JITTER else 0.0,
                ),
                plan,
                plan.orientations,
                size_detectors=size_detectors,
                gain=sensor.display.gain,
                weights_by_row=partial(weights_by_row, number),
                counts_photons=counts_photons,
            )
            for number, shift in enumerate(SHIFTS)
        ]
    )
