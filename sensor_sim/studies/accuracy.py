"""Accuracy scenes of one staring camera in three kinds of noise.

Where detector noise decides, the threshold is a signal-to-noise ratio. Where the observer's own noise does, that
ratio would mean next to nothing: the threshold is then the contrast of a large triangle on the display, and the
detector noise, if there is any, has a fixed contrast.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import Detector, Optics, Sensor
from sensor_sim.chain.simulation import SimulatedTrial, Simulator
from sensor_sim.thresholds.curve_plan import CurvePlan, plan_curve
from sensor_sim.thresholds.predict import FoldedChain, SensorTrials
from todframes.base._typing import FloatArray
from todframes.display.sensor_display import SensorDisplay
from todframes.observers.decision import answer_probabilities
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import resample
from todframes.parameters import PlanName
from todframes.psychometrics.threshold_search import crossing, find_crossing
from todframes.scoring.naked_eye import CONTRAST_RANGE
from todframes.stimulus import ORIENTATIONS, Stimulus
from todframes.studies.accuracy.measure import (
    P_CORRECT,
    Converged,
    Draw,
    FoldedDraw,
    FoldedTrials,
    Method,
    Rule,
    StudyScene,
    ThresholdEstimate,
    Variant,
)

AT_ONCE = 32
"""Number of frames whose samples are made together, which takes less time."""

STAR_LIKE = Sensor(
    name="star-like",
    optics=Optics(aperture_mm=220.0, wavelength_um=4.0, blur_sigma_mrad=0.01),
    detector=Detector(pitch_mrad=0.0681, width_mrad=0.0681),
    display=SensorDisplay(
        pixels_per_detector=6,
        pixel_pitch_mm=0.25,
        viewing_distance_mm=350.0,
        blur_sigma_px=2.0,
        background_luminance_cd_m2=50.0,
    ),
)
"""The camera of the sample frames without its fixed pattern: that of one camera would be the same in all frames of
the literal Monte Carlo, while a computed threshold is a mean over cameras."""

STUDIED_PLACES = (3, 5, 7, 11, 13, 17, 19, 23, 29)
"""Numbers of places of a lattice, along each axis of a detector."""

REPEATS = 12
CONVERGED_PLACES, FEWEST_LATTICES, MOST_LATTICES = 17, 8, 64

CONVERGED_BOUND = 1e-4
"""Relative error of the threshold: a tenth of the smallest error at which estimators are compared."""

VARIANT_PLACES = 11

COARSE_TOLERANCE, TOLERANCE = 0.0196, 0.00196
"""Half-widths of 95 % intervals: standard errors of 1 % and 0.1 %."""


@dataclass(frozen=True, kw_only=True)
class CameraScene(StudyScene):
    """A triangle of one size through a camera. The level "snr" varies the noise under a triangle of contrast 1,
    "contrast" the triangle's contrast. `noise_contrast` is the standard deviation of the detector noise as
    displayed, where it is not varied; 0: none. `converged_bound` is the relative half-width of the converged
    threshold's 95 % interval to reach.
    """

    noise_contrast: float = 0.0
    sensor: Sensor = STAR_LIKE
    size_detectors: float = 6.0
    converged_bound: float = CONVERGED_BOUND

    def converge(self) -> Converged:
        """Average as many independently shifted lattices as the bound needs; omissions of the plan add to the
        bound.
        """
        chain = self._chain(self._plan())
        streams = np.random.SeedSequence(0).spawn(MOST_LATTICES)
        first = chain.phases(CONVERGED_PLACES, np.random.default_rng(streams[0]))
        near, step = self._threshold(chain, first), 0.05
        low, high = (self._proportion(chain, first, near * math.exp(way * step)) for way in (-1.0, 1.0))
        slope = (high - low) / (2.0 * step)
        p_correct: list[float] = []
        for stream in streams:
            lattice = chain.phases(CONVERGED_PLACES, np.random.default_rng(stream))
            p_correct.append(self._proportion(chain, lattice, near))
            if len(p_correct) >= FEWEST_LATTICES:
                error = float(np.std(p_correct, ddof=1)) / math.sqrt(len(p_correct)) / slope
                if 2.0 * error < self.converged_bound:
                    break
        threshold = near * math.exp((P_CORRECT - float(np.mean(p_correct))) / slope)
        return Converged(threshold, (2.0 * error + chain.plan.bound / slope) * threshold, slope)

    def literal(self, converged: Converged) -> Draw:
        """Set up trials with noise on every detector and every neuron."""
        snr, contrast = self._shown(converged.threshold)
        return literal_answers(self.sensor, self.size_detectors, snr=snr, contrast=contrast)

    def folded(self, converged: Converged) -> FoldedDraw:
        """Set up trials for the folded chain."""
        snr, contrast = self._shown(converged.threshold)
        chain = self._chain(self._plan())

        def draw(n: int, rng: np.random.Generator) -> FoldedTrials:
            drawn = [chain.phases(1, rng)[0] for _ in range(n)]
            score = np.stack([contrast * part.signal[0, :1] for part in drawn])
            noise = np.stack([(contrast / snr) ** 2 * part.noise for part in drawn])
            covariance = chain.noise_covariance + noise
            decide = partial(answer_probabilities, covariance=covariance)
            return FoldedTrials(score, covariance, np.array([drawn[0].correct]), decide)

        return draw

    def closed_forms(self, converged: Converged) -> tuple[Method, ...]:
        """Place trials on lattices, with plans for two errors."""
        # Places that fall on many pixels of a detector, or are too coarse for that to matter; each is seen with
        # two opposite displacements of the retina.
        pixels = self.sensor.display.pixels_per_detector
        fair = (n for n in STUDIED_PLACES if n == STUDIED_PLACES[0] or math.gcd(n, pixels) == 1)
        budgets = tuple(2 * places**2 for places in fair)

        def prepare(tolerance: float) -> Rule:
            chain = self._chain(self._plan(tolerance=tolerance))
            return lambda n, rng: self._estimate(chain, math.isqrt(n // 2), converged, rng)

        coarse, fine = (partial(prepare, tolerance) for tolerance in (COARSE_TOLERANCE, TOLERANCE))
        return (
            Method("closed_form_coarse", "closed form, planned for 1 %", coarse, 0.15, budgets, REPEATS),
            Method("closed_form", "closed form, planned for 0.1 %", fine, 0.25, budgets, REPEATS),
        )

    def variants(self, converged: Converged) -> dict[str, Variant]:
        """List plans that keep one of the omissions, and all of them; planning is part of the time."""

        def variant(plan: Callable[[], CurvePlan]) -> Variant:
            return lambda rng: self._estimate(self._chain(plan()), VARIANT_PLACES, converged, rng)

        def changed(**changes: Any) -> Variant:
            return variant(lambda: replace(self._plan(), **changes))

        def everything() -> CurvePlan:
            # One orientation still, for the same trials: four would see each lattice from four sides.
            return replace(self._plan("full"), orientations=ORIENTATIONS[:1])

        planned, full = self._plan(), everything()
        return {
            f"as planned: {planned.field}² detectors, {np.dtype(planned.dtype)}": variant(self._plan),
            "float64": changed(dtype=np.float64),
            f"{full.field}² detectors": changed(field=full.field, sampler=full.sampler),
            "one pyramid level more": changed(observer=PyramidObserver().with_extra_level()),
            "nothing left out": variant(everything),
        }

    def non_gaussian_bound(self) -> float:
        """Return the bound that the chain states."""
        return self._chain(self._plan()).non_gaussian_bound()

    def _shown(self, level: float) -> tuple[float, float]:
        """Return signal-to-noise ratio and contrast of the triangle at a level."""
        if self.level == "snr":
            return level, 1.0
        return (level / self.noise_contrast if self.noise_contrast else math.inf), level

    def _plan(self, name: PlanName = "needed", tolerance: float = TOLERANCE) -> CurvePlan:
        noisy = self.level == "snr" or self.noise_contrast > 0.0
        return plan_curve(
            resolve(self.sensor),
            PyramidObserver(),
            self.size_detectors,
            name=name,
            tolerance=tolerance,
            p_correct=P_CORRECT,
            level="snr" if noisy else "contrast",
        )

    def _chain(self, plan: CurvePlan) -> FoldedChain:
        return FoldedChain(resolve(self.sensor), plan.observer, self.size_detectors, plan)

    def _proportion(self, chain: FoldedChain, phases: list[SensorTrials], level: float) -> float:
        return chain.proportion_correct(phases, *self._shown(level))

    def _threshold(self, chain: FoldedChain, phases: list[SensorTrials]) -> float:
        def proportion(level: float) -> float:
            return self._proportion(chain, phases, level)

        if self.level == "snr":
            _, threshold = crossing(proportion, P_CORRECT, near=None, slope=math.nan)
        else:
            _, threshold = find_crossing(proportion, P_CORRECT, bounds=CONTRAST_RANGE, start=1.0, factor=2.0)
        return math.nan if threshold is None else threshold

    def _estimate(
        self, chain: FoldedChain, places: int, converged: Converged, rng: np.random.Generator
    ) -> ThresholdEstimate:
        phases = chain.phases(places, rng)
        p_correct = self._proportion(chain, phases, converged.threshold)
        return ThresholdEstimate(p_correct, self._threshold(chain, phases))


SCENES: dict[str, dict[str, Any]] = {
    "external_noise": {
        "title": "staring camera, external noise decides: 6 detectors",
        "description": "At threshold 88 % of the variance of a score difference is detector noise. What is "
        "varied is its SNR.",
        "level": "snr",
    },
    "internal_noise": {
        "title": "staring camera, internal noise decides: 6 detectors",
        "description": "Detector noise of 0.1 in contrast as displayed is 7 % of the variance of a score "
        "difference, the rest is the observer's own. What is varied is the contrast of the triangle.",
        "level": "contrast",
        "noise_contrast": 0.1,
    },
    "no_noise": {
        "title": "staring camera without noise: 6 detectors",
        "description": "Only the observer has noise. What is varied is the contrast of the triangle.",
        "level": "contrast",
    },
}
external_noise, internal_noise, no_noise = (
    partial(CameraScene, name=f"camera_{name}", **values) for name, values in SCENES.items()
)


def literal_answers(sensor: Sensor, size_detectors: float, *, snr: float, contrast: float = 1.0) -> Draw:
    """Prepare to draw trials of random orientation and place as `sensor-sim simulate` does, with noise on every
    detector and every neuron: 1 for a right and 0 for a wrong answer, (n, 1). `snr` is the signal of a large
    triangle over the standard deviation of the detector noise, infinite without any; `contrast` that of the
    triangle, in units of what the display's gain gives it.
    """
    display, observer = sensor.display, PyramidObserver()
    stimulus = Stimulus(size_detectors * display.detector_pitch_mrad)
    observer.templates(stimulus)
    grid, simulator = observer.grid(stimulus), Simulator(sensor, size_detectors, seed=0)
    jitter_px = observer.position_jitter_samples * grid.pitch_mrad / display.pixel_pitch_mrad

    def batch(n: int, rng: np.random.Generator) -> FloatArray:
        stream, right = int(rng.integers(2**32)), np.empty((n, 1))
        orientations = [ORIENTATIONS[turns] for turns in rng.integers(4, size=n)]
        trials = [
            SimulatedTrial((stream, 0, k), size_detectors, snr, orientation)
            for k, orientation in enumerate(orientations)
        ]
        for k, frame in enumerate(simulator.frames(trials)):
            dx, dy = jitter_px * rng.uniform(-1.0, 1.0, 2)
            seen = resample(
                contrast * (frame.luminance_cd_m2 / display.background_luminance_cd_m2 - 1.0),
                grid,
                x_px=frame.x_px + dx,
                y_px=frame.y_px + dy,
                pixel_pitch_mrad=display.pixel_pitch_mrad,
            )
            right[k] = observer.respond(seen, stimulus, rng) is orientations[k]
        return right

    def answers(n: int, rng: np.random.Generator) -> FloatArray:
        return np.concatenate([batch(min(AT_ONCE, n - start), rng) for start in range(0, n, AT_ONCE)])

    return answers
