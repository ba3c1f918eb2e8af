"""Range in the field of the curve that the page shows, as `todframes range` gives it for the curve's result."""

from __future__ import annotations

import math
import time
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from sensor_sim.chain.detector_noise import delta_t_mk
from sensor_sim.chain.sensor import Sensor, sensor_settings
from sensor_sim.sweeps.goals import Aim
from todframes.base.errors import SettingsError, argument
from todframes.field.acquisition_range import FieldRange, acquisition_range, range_words
from todframes.psychometrics.curves import FitPoint
from todframes.psychometrics.threshold_search import ComputedThreshold, Status
from todframes.results.data import Fit
from todframes.results.thresholds import Thresholds

Value = Annotated[float, Meta(gt=0.0, le=1e12)]
GUESS_RATE = 0.25


class ThresholdSent(msgspec.Struct):
    """A threshold of the curve that the page shows: SNR, or contrast of a camera that counts photons. `points` are
    pairs of level and proportion correct, and `slope` is dP / d ln level; one of them is known.
    """

    size_detectors: Value
    status: Status
    threshold: Value | None = None
    error: Annotated[float, Meta(ge=0.0)] | None = None
    points: Annotated[list[tuple[Value, float]], Meta(max_length=32)] = []
    slope: Annotated[float, Meta(gt=0.0)] | None = None


SentThresholds = Annotated[list[ThresholdSent], Meta(min_length=1, max_length=12)]


def check_aim(target_in_air: Aim, sensor: Sensor, p_correct: float) -> None:
    """Raise SettingsError if thresholds are not in the quantity of the target, the air is of another kind, or k is
    missing.
    """
    if sensor.photons is None and sensor.noise.netd_mk is None:
        raise SettingsError(f"{argument.target}: needs noise.netd_mk of the sensor")
    target_in_air.check(
        p_correct, quantity="delta_t_k" if sensor.photons is None else "contrast", name=sensor.name
    )


def range_from(
    target_in_air: Aim, sensor: Sensor, thresholds: list[ThresholdSent], p_correct: float
) -> FieldRange:
    """Return the range of a sensor from its thresholds. SettingsError if target and air are not of the curve's
    kind; DataError if there are fewer than two thresholds, or the target is too small for the sensor.
    """
    curve = Thresholds.made(
        "curve",
        time.perf_counter(),
        settings={"sensor": sensor_settings(sensor)},
        fits=tuple(_fit(sensor, one, p_correct) for one in thresholds),
    )
    return acquisition_range(curve, target=target_in_air.target, atmosphere=target_in_air.atmosphere)


def _fit(sensor: Sensor, sent: ThresholdSent, p_correct: float) -> Fit:
    """Return a threshold as the result of a curve has it."""
    in_mk = None
    if sent.threshold is not None and sensor.photons is None and sensor.noise.netd_mk is not None:
        in_mk = float(delta_t_mk(sent.threshold, noise=sensor.noise))
    return Fit.of_computed(
        {"size_detectors": sent.size_detectors},
        sensor.level,
        p_correct,
        ComputedThreshold(sent.status, sent.threshold, sent.error),
        points=tuple(FitPoint(level, 0, p) for level, p in sent.points),
        beta=None if sent.points or sent.slope is None else weibull_slope(sent.slope, p_correct),
        delta_t_mk=in_mk,
    )


def weibull_slope(slope: float, p_correct: float) -> float:
    """Return β of the Weibull function without lapses that has the slope dP / d ln level at a proportion correct.
    P = 1 − (1 − γ) 2^−h with h = (x/α)^β, so dP / d ln x = ln 2 · β h (1 − P).
    """
    halves = math.log2((1.0 - GUESS_RATE) / (1.0 - p_correct))
    return slope / (math.log(2.0) * halves * (1.0 - p_correct))


def range_answer(found: FieldRange) -> dict[str, Any]:
    """Return what the page shows of a range: curves, ranges in words, and what they rest on."""
    return {
        "title": found.name,
        "axis": found.probability_name,
        "criterion": "k" if found.is_tod else "N50",
        "probabilities": list(dict.fromkeys(one.probability for one in found.numbers.ranges)),
        "curves": [
            {name: getattr(one, name) for name in ("task", "range_km", "probability", "low", "high")}
            | {"is_bound": [bound != 0.0 for bound in one.bound]}
            for one in found.numbers.probability
        ],
        "ranges": [
            {
                "task": one.task,
                "criterion": one.criterion,
                "probability": one.probability,
                "words": range_words(one, size_m=found.numbers.target.size_m, is_tod=found.is_tod),
            }
            for one in found.numbers.ranges
        ],
        "sentences": found.sentences(),
        "warnings": [one.message for one in found.warnings],
    }
