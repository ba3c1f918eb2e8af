"""Thresholds of one sensor after the other, coarse first and refined after, as `sweep` computes them.

Parts that earlier sensors have in common with a later one are kept, as in a sweep. Background and NETD do not
change a threshold SNR. A threshold contrast is that on the display, so the gain does not change it either.
"""

from __future__ import annotations

import gc
import math
import pickle
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sensor_sim.chain.sampling import field_detectors
from sensor_sim.chain.sensor import Sensor
from sensor_sim.explorer.limits import Shares, decision_shares
from sensor_sim.thresholds.curve_plan import Level, coarse_plan, plan_curve
from sensor_sim.thresholds.predict import (
    FoldedChain,
    PredictedThreshold,
    covariance_at,
    pooled,
    predicted_on_lattices,
)
from sensor_sim.thresholds.sharing import Shared, as_computed
from todframes.observers.interface import Observer
from todframes.psychometrics.fit import FitSettings
from todframes.scoring.error_budget import REPLICATES

SHARED_MB = 32
"""Largest size of the parts that are kept, in units of 2**20 bytes."""

THRESHOLDS_KEPT = 2000

SEED = 1
"""Seed of the places, that of `curve` if no other is asked for."""


class Request(NamedTuple):
    """Thresholds to compute: `sizes` are places in the curve and sizes in detectors, `tolerances` the relative
    errors to reach, of coarse and refined thresholds; the others are those of `LiveCurves.curves`. The observer is
    pickled.
    """

    number: int
    sensor: Sensor
    observer: bytes
    sizes: tuple[tuple[int, float], ...]
    p_correct: float
    tolerances: tuple[float, float]
    level: Level = "snr"
    n_points: int = 0


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """A threshold at the place `index` of the curve, and the slope dP / d ln level there, NaN without one."""

    index: int
    threshold: PredictedThreshold
    shares: Shares
    slope: float
    is_refined: bool


class ThresholdEngine:
    """Computes thresholds, and keeps the parts that the next sensor may need.

    `check` is called every few milliseconds; it raises an exception when the computation is no longer wanted. Kept
    parts stay valid.
    """

    def __init__(self, check: Callable[[], None]) -> None:
        self._check = check
        self._shared = Shared.of(SHARED_MB * 2**20, check)
        self._pickled, self._observer = b"", Observer()
        self._known: OrderedDict[Hashable, CurvePoint] = OrderedDict()

    def answers(self, request: Request) -> Iterator[CurvePoint]:
        """Yield coarse thresholds of all sizes and then refined ones, the easiest first.

        A refined threshold that is already known is yielded at once, instead of the coarse one. SettingsError if
        the observer is not linear, or the proportion, a size or a field is out of range.
        """
        FitSettings(p_correct=request.p_correct)  # checks it
        for _, size in request.sizes:
            field_detectors(request.sensor, size)  # checks it
        sensor = as_computed(request.sensor)
        if request.level == "contrast":  # there is no detector noise
            sensor = replace(sensor, photons=None, scene=None, display=replace(sensor.display, gain=1.0))
        request = request._replace(sensor=sensor, number=0)
        if request.observer != self._pickled:
            self._pickled, self._observer = request.observer, pickle.loads(request.observer)
            gc.collect()  # the observer before refers to itself through its caches
        todo = []
        for index, size in request.sizes:
            refined = request._replace(sizes=((0, size),))
            coarse = refined._replace(n_points=0)
            point = self._known.get((refined, True)) or self._point(coarse, is_refined=False)
            yield replace(point, index=index)
            if not point.is_refined:
                threshold, error = point.threshold.threshold, point.threshold.numerical_error
                todo.append((error / threshold if threshold and error else 0.0, index, refined))
        for _, index, refined in sorted(todo, key=lambda item: item[:2]):
            yield replace(self._point(refined, is_refined=True), index=index)

    def _point(self, request: Request, *, is_refined: bool) -> CurvePoint:
        """Return the threshold of the only size of a request, as it is known or computed now."""
        key = request, is_refined
        if key not in self._known:
            self._check()
            self._known[key] = self._computed(request, is_refined=is_refined)
            if len(self._known) > THRESHOLDS_KEPT:
                self._known.popitem(last=False)
        return self._known[key]

    def _computed(self, request: Request, *, is_refined: bool) -> CurvePoint:
        """Compute a threshold, the slope there and what limits it."""
        ((index, size),) = request.sizes
        sensor, observer, p_correct, level = request.sensor, self._observer, request.p_correct, request.level
        tolerance = request.tolerances[is_refined]
        if is_refined:
            plan = plan_curve(
                sensor, observer, size, tolerance=tolerance, p_correct=p_correct, level=level, shared=self._shared
            )
        else:
            plan = coarse_plan(sensor, observer, size, level=level, shared=self._shared)
        chain = FoldedChain(sensor, observer, size, plan)
        found, on_places = predicted_on_lattices(
            chain,
            p_correct=p_correct,
            tolerance=tolerance,
            seed=SEED,
            n_points=request.n_points,
            level=level,
            check=self._check,
        )
        slope = on_places[max(on_places)].slope if on_places else math.nan
        return CurvePoint(index, found, _shares(chain, level, found.threshold), slope, is_refined)


def _shares(chain: FoldedChain, level: Level, threshold: float | None) -> Shares:
    """Return the shares at a threshold, or without one at the strongest signal."""
    value, nothing = threshold or chain.largest_level, np.zeros((4, 4))
    phases = pooled(chain.replicates(chain.lattices[0], SEED, REPLICATES if threshold else 1))
    internal = chain.noise_covariance / (value**2 if level == "contrast" or chain.variance is not None else 1.0)
    noise = [np.array(covariance_at(level, value, nothing, part, chain.variance), ndmin=4) for part in phases]
    return decision_shares(phases, internal, [of_part.mean(axis=(0, 1)) for of_part in noise])
