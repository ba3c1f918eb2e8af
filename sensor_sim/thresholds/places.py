"""Thresholds where the triangle is at an unknown one of several places, far apart from each other.

The observer has four scores at each place and answers the largest of all. Between places the part that the four
have in common counts too, so whole weights are folded, not their differences, and nothing is left out. Internal
and detector noise of different places are independent, and the probability is one integral
(`todframes.observers.unknown_place`). It takes long, so it is computed on few places of the triangle on the
detectors, and corrected by the threshold at a known place, on these and on many more.
"""

from __future__ import annotations

from dataclasses import replace

from sensor_sim.chain.detector_noise import NO_LINES
from sensor_sim.chain.sensor import Sensor
from sensor_sim.thresholds.curve_plan import (
    PLACES,
    CurvePlan,
    is_alike_when_turned,
    linear_readout,
    lines_of,
    plan_curve,
)
from sensor_sim.thresholds.predict import (
    N_POINTS,
    FoldedChain,
    KnownThreshold,
    PredictedThreshold,
    Progress,
    predict_threshold,
    predicted_on_lattices,
)
from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_whole
from todframes.frames.dataset import MOST_PLACES
from todframes.observers.interface import Observer
from todframes.observers.unknown_place import correct_at_unknown_place
from todframes.scoring.error_budget import Step
from todframes.stimulus import ORIENTATIONS

KNOWN_SHARE = 0.3
"""Share of the tolerance for the threshold at a known place, which takes little time."""

HIGHER = 1.3
"""Threshold at an unknown place over that at a known one, about, for a few places."""


class UnknownPlaceChain(FoldedChain):
    """A sensor and a linear observer that looks for triangles of one size at several places, at least 2.
    SettingsError if the observer is not linear, or the noise is not the same at all places or not independent.
    """

    def __init__(self, sensor: Sensor, observer: Observer, size_detectors: float, places: int) -> None:
        check_places(sensor, places)
        self.places = places
        super().__init__(sensor, observer, size_detectors, _plan(sensor, observer, size_detectors, places))
        known = self.readout
        whole = known.deviations + known.common
        self.readout = replace(known, deviations=whole, noise_covariance=known.full_covariance)
        self.noise_covariance = self.readout.noise_covariance
        self.folding = self.plan.folding(sensor, self.readout, size_detectors)

    def decide(self, scores: FloatArray, covariance: FloatArray, correct: int) -> FloatArray:
        """Compute P(correct), (...,), for mean scores (..., 4) at the triangle's place and their covariance."""
        return correct_at_unknown_place(scores, covariance, correct, empty_places=self.places - 1)

    def non_gaussian_bound(self, level: float | None = None) -> float:
        """Return a bound on the error in P(correct): 4 · places − 1 differences decide instead of three."""
        return (4 * self.places - 1) / 3.0 * super().non_gaussian_bound(level)


def predict_at_unknown_place(
    chain: UnknownPlaceChain,
    known: FoldedChain,
    *,
    p_correct: float,
    tolerance: float,
    seed: int,
    n_points: int = N_POINTS,
    progress: Progress = lambda _: None,
) -> PredictedThreshold:
    """Compute the threshold at an unknown place; `known` is the same sensor and observer at a known one."""
    first, on_places = predicted_on_lattices(
        known, p_correct=p_correct, tolerance=KNOWN_SHARE * tolerance, seed=seed, n_points=0
    )
    start = None
    if first.threshold is not None:
        start = KnownThreshold(first.threshold, on_places, HIGHER * first.threshold)
    return predict_threshold(
        chain,
        p_correct=p_correct,
        tolerance=tolerance,
        seed=seed,
        n_points=n_points,
        known=start,
        progress=progress,
    )


def check_places(sensor: Sensor, places: int) -> None:
    """Raise SettingsError if a number of places is out of range, or the noise is not the same at all places."""
    check_whole(argument.places, places, 1, MOST_PLACES)
    if places == 1:
        return
    if sensor.photons is not None:
        raise SettingsError(
            f"{argument.places}: found {places} for a camera that counts photons, expected 1: the triangle's own "
            "photons are noise at its place alone"
        )
    if lines_of(sensor) != NO_LINES:
        raise SettingsError(
            f"{argument.places}: found {places} with noise that rows or columns have in common, expected 1: the "
            "noise of places in a line is not independent"
        )


def _plan(sensor: Sensor, observer: Observer, size_detectors: float, places: int) -> CurvePlan:
    """Return the plan that leaves out nothing but orientations that are turns of each other."""
    plan = plan_curve(sensor, observer, size_detectors, name="full")
    why = f"the triangle may be at any of {places} places, whose scores are compared whole"
    steps = [Step("everything", True, why)]
    if linear_readout(sensor, plan.observer, size_detectors).is_symmetric and is_alike_when_turned(sensor):
        plan = replace(plan, orientations=ORIENTATIONS[:1])
        steps.append(Step("orientations", False, "one stands for all four, which are its turns"))
    return replace(
        plan, places=PLACES, steps=tuple(steps), repetition_bound=(4 * places - 1) / 3.0 * plan.repetition_bound
    )
