"""Accuracy scene of a staring camera whose detector noise decides: the threshold is a signal-to-noise ratio."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import Detector, Optics, Sensor
from sensor_sim.chain.simulation import SimulatedTrial, Simulator
from sensor_sim.thresholds.curve_plan import plan_curve
from sensor_sim.thresholds.predict import FoldedChain, find_threshold, predict_threshold
from todframes.base._typing import FloatArray
from todframes.display.display import SensorDisplay
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import resample
from todframes.stimulus import ORIENTATIONS, Stimulus
from todframes.studies.accuracy.measure import P_CORRECT, AccuracyScene, Converged, Draw, Rule, ThresholdEstimate

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

PLANNED_FOR = 0.02
"""Half-width of the 95 % interval that a curve is planned for: a standard error of 1 %."""

CONVERGED_TOLERANCE = 1e-4
"""Relative error of the threshold to aim at: a tenth of the smallest error at which methods are compared."""


def external_noise(
    sensor: Sensor = STAR_LIKE, size_detectors: float = 6.0, tolerance: float = CONVERGED_TOLERANCE
) -> AccuracyScene:
    """Make the scene of a triangle of contrast 1, under which the noise is varied. The converged threshold is that
    of eight lattices, as many places as there are.
    """
    camera = resolve(sensor)
    whole = FoldedChain(camera, PyramidObserver(), size_detectors)
    found = predict_threshold(whole, tolerance=tolerance, p_correct=P_CORRECT, n_points=0)
    assert found.threshold is not None and found.numerical_error is not None and found.slope is not None
    converged = Converged(found.threshold, found.numerical_error, found.slope)

    def expected() -> Draw:
        chain = FoldedChain(camera, PyramidObserver(), size_detectors)

        def p_correct(rng: np.random.Generator) -> float:
            """Show a triangle with two opposite displacements of the retina."""
            return chain.proportion_correct(chain.phases(1, rng), converged.threshold)

        return lambda n, rng: np.array([[p_correct(rng)] for _ in range(n)])

    def closed_form() -> Rule:
        observer = PyramidObserver()
        plan = plan_curve(camera, observer, size_detectors, tolerance=PLANNED_FOR)
        chain = FoldedChain(camera, observer, size_detectors, plan)

        def estimate(n: int, rng: np.random.Generator) -> ThresholdEstimate:
            trials = chain.phases(math.isqrt(n // 2), rng)
            on_lattice = find_threshold(partial(chain.proportions, trials, level="snr"), P_CORRECT)
            return ThresholdEstimate(chain.proportion_correct(trials, converged.threshold), on_lattice.threshold)

        return estimate

    return AccuracyScene(
        name="camera_external_noise",
        title=f"staring camera: {size_detectors:g} detectors",
        description="Detector noise decides: at threshold it is 88 % of the variance of a score difference. What "
        "is varied is its SNR.",
        level="snr",
        converged=converged,
        p_correct_error_bound=whole.non_gaussian_bound(),
        literal=partial(literal, sensor, size_detectors, snr=converged.threshold),
        expected=expected,
        closed_form=closed_form,
        budgets=tuple(2 * places**2 for places in whole.lattices),  # each with two opposite displacements
        repeats=12,
        estimate=converged.estimate,
    )


def literal(sensor: Sensor, size_detectors: float, *, snr: float) -> Draw:
    """Prepare to draw trials of random orientation and place as `sensor-sim simulate` does, with noise on every
    detector and every neuron: 1 for a right and 0 for a wrong answer, (n, 1). `snr` is the signal of a large
    triangle over the standard deviation of the detector noise.
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
                frame.luminance_cd_m2 / display.background_luminance_cd_m2 - 1.0,
                grid,
                x_px=frame.x_px + dx,
                y_px=frame.y_px + dy,
                pixel_pitch_mrad=display.pixel_pitch_mrad,
            )
            right[k] = observer.respond(seen, stimulus, rng) is orientations[k]
        return right

    return lambda n, rng: np.concatenate([batch(min(AT_ONCE, n - k), rng) for k in range(0, n, AT_ONCE)])
