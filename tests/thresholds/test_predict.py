"""Computed thresholds: against frames, against brute force over phases, in the limits, and their stated error."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from overlaps import weights_at

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sampling import field_detectors, field_sampler
from sensor_sim.chain.sensor import Detector, Electronics, Noise, Optics, Sensor, SensorDisplay, load_sensor
from sensor_sim.chain.simulation import Simulator, plan_trials
from sensor_sim.thresholds.curve_plan import full_plan, plan_curve
from sensor_sim.thresholds.predict import FoldedChain, predict_threshold
from sensor_sim.thresholds.threshold import (
    LADDER_DETECTORS,
    chosen_sizes,
    computed_sizes,
    given_sizes,
    smallest_size,
)
from todframes.base.errors import SettingsError
from todframes.observers.decision import answer_probabilities
from todframes.observers.interface import Observer, Readout
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import RetinaGrid, resample
from todframes.psychometrics.fit import FitSettings, fit_trials
from todframes.scoring.naked_eye import contrast_threshold
from todframes.stimulus import ORIENTATIONS, Stimulus, bounding_box_offset

STAR_LIKE = Path(__file__).parents[2] / "sample_frames" / "star_like.toml"


def display(pixels: int, distance_mm: float, **more) -> SensorDisplay:
    """Of 0.25 mm pixels."""
    common = {"pixel_pitch_mm": 0.25, "background_luminance_cd_m2": 50.0}
    return SensorDisplay(pixels_per_detector=pixels, viewing_distance_mm=distance_mm, **common, **more)


# No fixed pattern: it is one draw for all frames of a seed, of which an interval over frames knows nothing.
UNDER_SAMPLED = Sensor(
    optics=Optics(aperture_mm=100.0, wavelength_um=10.0),
    detector=Detector(pitch_mrad=0.2, width_mrad=0.2),
    display=display(4, 1500.0, blur_sigma_px=1.0),
)
WELL_SAMPLED = Sensor(
    optics=Optics(aperture_mm=50.0, wavelength_um=10.0, blur_sigma_mrad=0.1),
    detector=Detector(pitch_mrad=0.1, width_mrad=0.1),
    noise=Noise(distribution="gaussian"),
    display=display(3, 1500.0, blur_sigma_px=0.8, gain=1.5),
)
LOW_FILL_FACTOR = Sensor(
    optics=Optics(aperture_mm=200.0, wavelength_um=4.0, blur_sigma_mrad=0.01),
    detector=Detector(pitch_mrad=0.1, width_mrad=0.05),
    noise=Noise(frames_integrated=4),
    electronics=Electronics(blur_sigma_px=0.7),
    display=display(5, 2000.0, blur_sigma_px=1.2),
)
SENSORS = {
    "under-sampled": (UNDER_SAMPLED, 3.0),
    "well sampled": (WELL_SAMPLED, 8.0),
    "low fill factor": (LOW_FILL_FACTOR, 4.0),
}
sensors = pytest.mark.parametrize(("sensor", "size"), SENSORS.values(), ids=SENSORS.keys())


@pytest.fixture(scope="module")
def observer() -> PyramidObserver:
    return PyramidObserver()


def phases_of(chain: FoldedChain, places: int = 9, seed: int = 1):
    return chain.phases(places, np.random.default_rng(seed))


class Seen(NamedTuple):
    """Frames as the observer sees them: level, correct answer, retina image and its displacement's P(correct)."""

    level: np.ndarray
    correct: np.ndarray
    retina: list[np.ndarray]
    p_correct: np.ndarray


def seen_frames(sensor: Sensor, observer: Observer, size: float, levels, trials: int, seed: int) -> Seen:
    """Frames simulated and read out one by one, displaced on the retina as `score` does."""
    simulator = Simulator(sensor, size, seed=seed)
    pixel, rng = sensor.display.pixel_pitch_mrad, np.random.default_rng([seed, 1])
    readout = observer.readout(Stimulus(size * sensor.display.detector_pitch_mrad))
    planned = plan_trials([size], list(levels), trials)
    retina = []
    for start in range(0, len(planned), 50):
        for frame in simulator.frames(planned[start : start + 50]):
            jitter = rng.uniform(-0.5, 0.5, 2) * readout.grid.pitch_mrad / pixel
            contrast = frame.luminance_cd_m2 / sensor.display.background_luminance_cd_m2 - 1.0
            place = {"x_px": frame.x_px + jitter[0], "y_px": frame.y_px + jitter[1], "pixel_pitch_mrad": pixel}
            retina.append(resample(contrast, readout.grid, **place))
    correct = np.array([trial.orientation.quarter_turns for trial in planned])
    deviations = np.array([readout.score_deviations(image) for image in retina])
    answers = answer_probabilities(deviations, readout.noise_covariance)
    level = np.array([trial.level for trial in planned])
    return Seen(level, correct, retina, answers[np.arange(len(correct)), correct])


def assert_frames_have_the_threshold(seen: Seen, threshold: float, numerical_error: float) -> None:
    fit = fit_trials(seen.level, seen.p_correct, settings=FitSettings(), rng=np.random.default_rng(1))
    assert fit.status == "ok"
    bound = fit.threshold_ci95[int(threshold > fit.threshold)]
    interval = math.hypot(math.log(bound / fit.threshold), numerical_error / threshold)
    # The interval that this is held against must not be so wide that all agrees with it.
    assert abs(math.log(threshold / fit.threshold)) < interval < 0.15


@pytest.mark.slow
@sensors
def test_frames_have_the_computed_threshold(sensor, size, observer):
    """2,000 frames, and the literal observer with noise on every neuron on 300 of them."""
    found = predict_threshold(FoldedChain(resolve(sensor), observer, size))
    assert found.status == "ok"
    levels = found.threshold * 2.0 ** np.array([-0.75, -0.25, 0.0, 0.25, 0.75])
    seen = seen_frames(sensor, observer, size, levels, 400, seed=1)
    assert_frames_have_the_threshold(seen, found.threshold, found.numerical_error)

    stimulus = Stimulus(size * sensor.display.detector_pitch_mrad)
    every = slice(0, 2000, 20)
    these = np.r_[every, slice(7, 2000, 20), slice(14, 2000, 20)]
    rng = np.random.default_rng(2)
    answers = [observer.respond(seen.retina[k], stimulus, rng).quarter_turns for k in these]
    right = np.count_nonzero(answers == seen.correct[these])
    p = seen.p_correct[these]
    assert len(p) == 300
    # Binomial with a probability of its own for each frame: four standard errors. That the summed noise is not
    # quite Gaussian is below 0.003 of P, a tenth of one.
    assert abs(right - p.sum()) < 4 * math.sqrt((p * (1 - p)).sum())


def brute_force(sensor: Sensor, observer: Observer, size: float, snr: float, n: int, seed: int) -> np.ndarray:
    """P(correct) of n trials, each at a random place, displacement and orientation; the noise as covariance."""
    field, sampler, pitch = (
        field_detectors(resolve(sensor), size),
        field_sampler(resolve(sensor), size),
        sensor.display.detector_pitch_mrad,
    )
    readout, rng = observer.readout(Stimulus(size * pitch)), np.random.default_rng(seed)
    proportions = np.empty(n)
    for trial in range(n):
        orientation = ORIENTATIONS[trial % 4]
        x, y = rng.uniform(-0.5, 0.5, 2)
        jitter = observer.position_jitter_samples * rng.uniform(-1.0, 1.0, 2) * readout.grid.pitch_mrad / pitch
        offset = np.array(bounding_box_offset(orientation) if observer.centre == "bounding_box" else (0.0, 0.0))
        weights = sensor.display.gain * weights_at(sensor, readout, field, *(x, y) + size * offset + jitter)
        samples = sampler.samples(x, y, orientation=orientation).ravel()
        covariance = readout.noise_covariance + weights @ weights.T / snr**2
        proportions[trial] = answer_probabilities(weights @ samples, covariance)[orientation.quarter_turns]
    return proportions


SMOOTHED = replace(UNDER_SAMPLED, display=replace(UNDER_SAMPLED.display, blur_sigma_px=1.6, gain=1.2))


class LopsidedObserver(Observer):
    """The pyramid observer with two weaker corners, that is surer of some answers than of others."""

    position_jitter_samples = 4.0

    def grid(self, stimulus: Stimulus) -> RetinaGrid:
        return PyramidObserver().grid(stimulus)

    def make_readout(self, stimulus: Stimulus) -> Readout:
        readout = PyramidObserver().readout(stimulus)
        place = np.linspace(-4.0, 4.0, readout.grid.side)  # about one at the triangle's edge
        gain = 1.0 + 0.8 * np.tanh(np.multiply.outer(place, place)) + 0.2 * np.tanh(place)
        deviations = gain * readout.deviations * np.array([1.0, 0.6, 1.4, 0.8])[:, None, None]
        deviations = np.ascontiguousarray(deviations - deviations.mean(axis=0))
        more = np.diag([0.0, 0.5, 1.0, 2.0]) * readout.noise_covariance[0, 0]
        return replace(readout, deviations=deviations, noise_covariance=readout.noise_covariance + more)


@pytest.mark.parametrize(
    "observer",
    [
        PyramidObserver(),
        PyramidObserver(centre="bounding_box"),
        PyramidObserver(position_jitter_samples=0.0),
        PyramidObserver(position_jitter_samples=2.0),
        LopsidedObserver(),
    ],
    ids=["default", "bounding box", "no jitter", "wide jitter", "lopsided"],
)
@pytest.mark.parametrize("snr", [1.5, pytest.param(math.inf, marks=pytest.mark.slow)])
def test_proportion_correct_is_the_mean_over_random_phases(observer, snr):
    chain = FoldedChain(resolve(SMOOTHED), observer, 3.0)
    phases = phases_of(chain, 13)
    assert len(phases) == (4 if isinstance(observer, LopsidedObserver) else 1)
    literal = brute_force(SMOOTHED, observer, 3.0, snr, 400, seed=1)
    # Four standard errors; the lattice of 13² places is far better than 400 random ones.
    for part in phases if len(phases) > 1 else ():
        of_part = literal[part.correct :: 4]
        assert abs(chain.proportion_correct([part], snr) - of_part.mean()) < 4 * of_part.std(ddof=1) / 10.0
    error = literal.std(ddof=1) / math.sqrt(len(literal))
    assert error < (0.01 if len(phases) == 1 else 0.015)
    assert abs(chain.proportion_correct(phases, snr) - literal.mean()) < 4 * error


@pytest.mark.parametrize("blur_sigma_px", [0.0, 3.0])
def test_detectors_that_the_plan_leaves_out_of_a_wide_blur_weigh_nothing(blur_sigma_px, observer):
    sensor = replace(
        UNDER_SAMPLED,
        optics=replace(UNDER_SAMPLED.optics, blur_sigma_mrad=16.0),
        display=replace(UNDER_SAMPLED.display, blur_sigma_px=blur_sigma_px),
    )
    camera = resolve(sensor)
    whole, plan = field_detectors(camera, 3.0), full_plan(camera, observer.with_extra_level(), 3.0)
    readout = plan.observer.readout(Stimulus(3.0 * sensor.display.detector_pitch_mrad))
    wide = replace(plan, field=whole).folding(camera, readout, 3.0)
    weights = wide.weights(np.array([-0.5, 0.5]), np.array([0.5, -0.5])).reshape(-1, whole, whole)
    margin = (whole - plan.field) // 2
    assert margin > 40
    weights[:, margin:-margin, margin:-margin] = 0.0
    assert not weights.any()


@pytest.mark.parametrize("size", [1.0, 2.0, 6.0])
def test_a_spot_of_100_detectors_points_nowhere(size, observer):
    optics = replace(UNDER_SAMPLED.optics, blur_sigma_mrad=100.0 * 0.2)
    sensor = replace(UNDER_SAMPLED, optics=optics, display=display(4, 500.0))
    found = predict_threshold(FoldedChain(resolve(sensor), observer, size))
    # A spot of this width has the same score for all orientations: answers are right by chance.
    assert found.status == "never_reached" and found.highest == pytest.approx(0.25, abs=1e-3)


@pytest.mark.parametrize("size_mrad", [0.4, 0.6])
def test_dense_sampling_without_noise_is_the_naked_eye(size_mrad, observer):
    """Ten detectors a retina sample, one pixel each, no blur; the display's gain is the contrast."""
    pitch_mrad = 0.1 * observer.settings.retina_pitch_mrad
    sensor = Sensor(
        optics=Optics(aperture_mm=1e9, wavelength_um=1.0),
        detector=Detector(pitch_mrad=1.0, width_mrad=1.0),
        display=display(1, 0.125 / math.tan(pitch_mrad / 2000.0)),
    )
    assert sensor.display.detector_pitch_mrad == pytest.approx(pitch_mrad, rel=1e-12)
    naked = contrast_threshold(observer, size_mrad=size_mrad)

    def proportion(contrast: float) -> float:
        changed = replace(sensor, display=replace(sensor.display, gain=contrast))
        chain = FoldedChain(resolve(changed), observer, size_mrad / pitch_mrad)
        return chain.proportion_correct(phases_of(chain, 13), math.inf)

    # A lattice of 13² places is wrong by 0.0006 of P (standard deviation), 0.2 % of the threshold.
    assert proportion(0.99 * naked.threshold) < 0.75 < proportion(1.01 * naked.threshold)


def test_without_detector_noise_the_curve_ends_at_what_the_sampling_leaves(observer):
    chain = FoldedChain(resolve(UNDER_SAMPLED), observer, 2.0)
    best = np.mean([chain.proportion_correct(phases_of(chain, 13, seed), math.inf) for seed in range(4)])
    assert 0.5 < best < 0.99
    # A criterion just above it is never reached, one below it far up.
    missed = predict_threshold(chain, p_correct=best + 0.02)
    assert (missed.status, missed.threshold, missed.numerical_error) == ("never_reached", None, None)
    reached = predict_threshold(chain, p_correct=best - 0.02)
    assert reached.status == "ok"
    assert reached.threshold > 2.0 * predict_threshold(chain, p_correct=best - 0.2).threshold


def test_published_threshold_of_the_star_like_sensor(observer):
    """Averaged over detector phase, retina jitter and orientation, by brute force and independent code."""
    found = predict_threshold(FoldedChain(resolve(load_sensor(STAR_LIKE)), observer, 4.0))
    assert found.threshold == pytest.approx(2.092, rel=0.005)


DULL = replace(UNDER_SAMPLED, optics=Optics(aperture_mm=0.1, wavelength_um=10.0))
NEAR = replace(UNDER_SAMPLED, display=display(4, 1.0))


@pytest.mark.parametrize(
    ("sensor", "size", "tolerance", "message"),
    [
        *(
            (UNDER_SAMPLED, 2.0, one, "tolerance: found .*, expected a finite number > 0")
            for one in (0.0, -1.0, math.nan)
        ),
        (DULL, 3.0, 0.1, r"optics\.aperture_mm: found .* expected at least"),
        (NEAR, 10.0, 0.1, "size_mrad: found .* mrad at the eye, expected at most"),
    ],
)
def test_what_cannot_be_computed_is_refused(sensor, size, tolerance, message, observer):
    with pytest.raises(SettingsError, match=f"^{message}"):
        predict_threshold(FoldedChain(resolve(sensor), observer, size), tolerance=tolerance)


def test_sizes_that_suit_a_sensor_and_those_asked_for(observer):
    far = replace(UNDER_SAMPLED, display=display(4, 20.0))  # 50 mrad a detector; the observer looks at 348
    assert list(computed_sizes(resolve(far), observer)) == [1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0]
    for smallest, expected in ((1.5, [1.5, 2, 2.5, 3, 4]), (5.0, [5, 6]), (None, [2.5, 3, 4, 5, 6])):
        assert chosen_sizes(resolve(far), observer, smallest) == expected
    assert [given_sizes(resolve(far), *asked) for asked in (([4, 3], ()), ((), [0.6]), ((), ()))] == [
        [4, 3],
        [3],
        [],
    ]
    with pytest.raises(SettingsError, match=r"^optics\.aperture_mm: found"):
        given_sizes(resolve(DULL), (), [0.6])


def test_a_smaller_field_is_bounded_for_any_sign_of_the_signal_outside(observer):
    """The signal outside may have, at each detector, the sign of the weight by which two scores differ there."""
    size = 3.0
    camera = resolve(UNDER_SAMPLED)
    whole, plan = full_plan(camera, observer, size), plan_curve(camera, observer, size, tolerance=1e-2)
    (stated,) = [step.bound for step in plan.steps if step.stage == "field"]
    threshold = predict_threshold(FoldedChain(camera, observer, size, plan), tolerance=1e-2).threshold
    readout = observer.readout(Stimulus(size * UNDER_SAMPLED.display.detector_pitch_mrad))
    folding = whole.folding(camera, readout, size)
    (weights,) = whole.all_four(folding.weights(np.zeros(1), np.zeros(1)))
    weights *= UNDER_SAMPLED.display.gain
    samples = whole.sampler.samples(np.zeros(1), np.zeros(1), orientation=ORIENTATIONS[0]).ravel()
    margin = (whole.field - plan.field) // 2
    outside = np.pad(np.zeros((plan.field, plan.field)), margin, constant_values=1.0).ravel()
    covariance = readout.noise_covariance + weights @ weights.T / threshold**2
    change = 0.0
    for k in (1, 2, 3):
        worst = np.sign(weights[0] - weights[k]) * np.abs(samples) * outside
        variance = covariance[0, 0] + covariance[k, k] - 2.0 * covariance[0, k]
        # No normal density exceeds 1/(σ √(2π)).
        change += (weights[0] - weights[k]) @ worst / math.sqrt(2.0 * math.pi * variance)
    assert margin > 0
    assert 0.0 < change <= stated


@pytest.mark.parametrize(
    ("sensor", "p_correct"), [(UNDER_SAMPLED, 0.75), (WELL_SAMPLED, 0.6), (LOW_FILL_FACTOR, 0.9)]
)
def test_the_smallest_size_is_the_first_that_reaches_the_criterion_when_all_is_computed(
    sensor: Sensor, p_correct: float
) -> None:
    smallest = smallest_size(resolve(sensor), PyramidObserver(), p_correct=p_correct)
    assert smallest is not None
    for size in (size for size in LADDER_DETECTORS if size <= smallest):
        is_reached = FoldedChain(resolve(sensor), PyramidObserver(), size).unreached(p_correct, seed=1) is None
        assert is_reached is (size == smallest)
