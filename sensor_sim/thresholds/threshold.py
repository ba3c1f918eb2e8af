"""The threshold of a sensor at one size: the one way from settings to a number, for curves, sweeps and limits."""

from __future__ import annotations

from typing import Any, NamedTuple

from sensor_sim.chain.sensor import Sensor
from sensor_sim.thresholds.curve_plan import plan_curve
from sensor_sim.thresholds.predict import FoldedChain, PredictedThreshold, predict_threshold
from sensor_sim.thresholds.sharing import NO_CACHE, Caches
from todframes.observers.interface import Observer
from todframes.parameters import PlanName


class Computed(NamedTuple):
    """A threshold, and the chain that it was computed with."""

    found: PredictedThreshold
    chain: FoldedChain


def threshold_at(
    sensor: Sensor,
    observer: Observer,
    size_detectors: float,
    *,
    p_correct: float,
    tolerance: float,
    seed: int,
    plan: PlanName = "needed",
    shared: Caches = NO_CACHE,
    **search: Any,
) -> Computed:
    """Compute the threshold of a size in detectors; `search` is for `predicted_on_lattices`. SettingsError if the
    observer is not linear, or the size or field is out of range.
    """
    steps = plan_curve(
        sensor, observer, size_detectors, name=plan, tolerance=tolerance, p_correct=p_correct, shared=shared
    )
    chain = FoldedChain(sensor, observer, size_detectors, steps)
    found = predict_threshold(chain, p_correct=p_correct, tolerance=tolerance, seed=seed, **search)
    return Computed(found, chain)
