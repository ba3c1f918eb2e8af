"""Plans: bounds that hold, work that is not done, and what is left alone."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_plans import camera_at_random, log_uniform, observer_at_random
from scipy import stats
from test_live_curves import PHOTON
from test_predict import UNDER_SAMPLED

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.noise import contrast_variance
from sensor_sim.chain.sampling import TriangleSampler
from sensor_sim.chain.sensor import Optics, load_sensor
from sensor_sim.thresholds.curve_plan import _beyond, _CurvePlanner, full_plan, plan_curve
from sensor_sim.thresholds.predict import FoldedChain, predict_threshold
from todframes.frames.dataset import load_dataset
from todframes.frames.files import FrameFile, write_frame
from todframes.observers.decision import answer_probabilities
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.scoring.error_budget import (
    LEFT_OUT_SHARE,
    Step,
    decision_change,
    half_width_95,
    plan_object,
    total_bound,
)
from todframes.scoring.plan import explain
from todframes.scoring.score import score_dataset
from todframes.scoring.trial_scores import Scoring
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus, coverage

ROOT = Path(__file__).parents[2]
STAR_LIKE = load_sensor(ROOT / "sample_frames" / "star_like.toml")
NAKED_EYE = ROOT / "sample_frames" / "naked_eye"


def test_decisions_change_by_less_than_the_bound():
    rng = np.random.default_rng(1)
    mixing = rng.normal(size=(400, 4, 6))
    covariance = mixing @ mixing.swapaxes(1, 2)
    scores = 2.0 * rng.normal(size=(400, 4))
    size = 10.0 ** rng.uniform(-4.0, -0.5, (400, 1, 1))
    change = size[..., 0] * rng.normal(size=(400, 4))
    # First order in the change of covariance: it stays small.
    other = mixing + 0.3 * size * rng.normal(size=mixing.shape)
    other_covariance = other @ other.swapaxes(1, 2)
    bound = decision_change(change, covariance, other_covariance - covariance)
    moved = answer_probabilities(scores + change, other_covariance) - answer_probabilities(scores, covariance)
    assert (np.abs(moved) <= bound * (1.0 + 5.0 * size[..., 0]) + 1e-9).all()
    # Nor is it so loose that it says nothing.
    assert np.median(np.abs(moved).max(axis=1) / bound.max(axis=1)) > 0.05


def test_without_noise_anything_may_change():
    assert (
        decision_change(np.full(4, 1e-300) * np.arange(4), np.zeros((4, 4)), np.zeros((4, 4))).tolist() == [1] * 4
    )


def test_only_what_is_left_out_counts():
    steps = (Step("a", False, "x", 1e-3, 20.5), Step("b", True, "", 0.5), Step("c", False, "", 2e-3))
    assert total_bound(steps) == pytest.approx(3e-3, rel=1e-15)
    assert plan_object(steps)[0] == {"stage": "a", "kept": False, "why": "x", "bound": 1e-3, "saves_s": 20.5}
    assert "saves_s" not in plan_object(steps)[1]
    values = np.array([3.0, 1.0, 4.0, 1.0, 5.0, 9.0, 2.0, 6.0])
    student = stats.t.ppf(0.9875, len(values) - 1)
    assert half_width_95(values) == pytest.approx(student * stats.sem(values), rel=1e-4)  # 2.8412 has five digits


def test_a_plan_of_a_curve_states_what_is_left_out():
    plan = plan_curve(resolve(UNDER_SAMPLED), PyramidObserver(), 3.0, tolerance=1e-2)
    enough = "a retina of 65 × 65 samples is wide enough for this tolerance"
    assert [step._replace(bound=0.0) for step in plan.steps] == [
        Step("pyramid levels", False, enough),
        Step("field", False, "8 × 8 of 16 × 16 detectors; the others' weights are next to nothing"),
        Step("period", False, "the scene repeats after 16 detectors, not 32"),
        Step("orientations", False, "one stands for all four, which are its turns"),
    ]
    assert [step.bound > 0.0 for step in plan.steps] == [True, True, True, False]
    assert (plan.dtype, plan.field) == (np.float32, 8)
    assert plan.bound == pytest.approx(sum(step.bound for step in plan.steps) + plan.repetition_bound + 3e-6)
    sharp = replace(UNDER_SAMPLED, optics=Optics(aperture_mm=1e9, wavelength_um=1.0))
    steps = {step.stage: step for step in plan_curve(resolve(sharp), PyramidObserver(), 3.0).steps}
    assert steps["optics"].why == "too sharp against the detectors for their frequencies to be counted"
    assert 0.0 < steps["optics"].bound < 1e-4 and not steps["optics"].kept and "period" not in steps
    assert plan_curve(resolve(sharp), PyramidObserver(), 3.0, name="full").repetition_bound == 0.0


@pytest.mark.parametrize("kind", ["snr", "contrast", "photons"])
def test_a_plan_knows_the_threshold_of_the_places_that_it_tries(kind: str):
    """All noise by dense sums over detectors; changes are weighed by the slope there."""
    sensor, observer = PHOTON if kind == "photons" else UNDER_SAMPLED, PyramidObserver()
    full = replace(full_plan(resolve(sensor), observer, 4.0), level="contrast" if kind == "contrast" else "snr")
    planner = _CurvePlanner(resolve(sensor), 4.0, full, 0.75, 1e-2)
    internal, field = planner.readout.noise_covariance, np.ones((full.field, full.field))
    row, column = np.kron(np.eye(full.field), field), np.kron(field, np.eye(full.field))

    def proportion(level: float) -> float:
        p = []
        for weights, signal in zip(planner.weights, planner.samples, strict=True):
            noise = np.eye(signal.size) / level**2 * (kind == "snr")
            if kind == "photons":
                light = contrast_variance(resolve(sensor))
                white = light.white / level**2 + light.per_signal / level * signal
                white += light.per_squared_signal * signal**2
                noise = np.diag(white) + (light.row * row + light.column * column) / level**2
            covariance = internal / (1.0 if kind == "snr" else level**2) + weights @ noise @ weights.T
            p.append(answer_probabilities(weights @ signal, covariance)[0])
        return float(np.mean(p))

    assert proportion(planner.near_level) == pytest.approx(0.75, abs=1e-5)
    ends = [proportion(planner.near_level * math.exp(step)) for step in (-0.01, 0.01)]
    assert planner.slope == pytest.approx((ends[1] - ends[0]) / 0.02, rel=0.01)
    assert planner.budget == pytest.approx(0.5 * 1e-2 * planner.slope)
    noise = planner._noise(planner.weights)
    assert noise == pytest.approx(planner._noise(planner.weights, 1.0) / planner.near_level**2)
    changed, change = np.array([[0.0, 0.1, 0.0, 0.0]]), np.full((1, 4, 4), 1e-3)
    for noise in (None, change):
        change_of_first = decision_change(changed, planner.covariance, 0.0 * change if noise is None else noise)
        assert planner.bound(changed, noise) == pytest.approx(2.0 * change_of_first[:, 0].max())


def test_repetitions_fall_with_the_cube_of_the_period():
    """A change of a / period³ between a period and an endless one: from 10 to 30 detectors, and what is left."""
    assert _beyond(1 / 10**3 - 1 / 30**3, 10, 30) == pytest.approx(1 / 30**3)


@pytest.mark.parametrize(
    ("size_samples", "settings"),
    [
        (40.0, {}),
        (12.0, {"centre": "bounding_box"}),
        (12.0, {"kernel_a": 0.4, "band_gain": 2.0}),
        (12.0, {"eye_mtf": "watson2013", "band_noise": (13.0, 1.0, 0.3, 0.2, 0.3)}),
        (12.0, {"band_noise": (1.0, 1.0, 1.0, 1.0, 0.1, 0.02)}),
    ],
)
def test_left_out_bands_are_those_of_a_wider_readout(size_samples, settings):
    """The readout with two octaves more, less the usual one, over the triangle itself."""
    observer = PyramidObserver(PyramidSettings(retina_pitch_mrad=1.0, position_jitter_samples=0.0, **settings))
    stimulus = Stimulus(size_samples)
    wide = PyramidObserver(observer.settings, more_levels=2).readout(stimulus)
    usual, missing = observer.readout(stimulus), observer.omitted_bands(stimulus)
    side = wide.grid.side
    shape = {"size_px": size_samples, "orientation": ORIENTATIONS[0], "centre": observer.centre}
    image = coverage((side, side), x_px=side // 2, y_px=side // 2, **shape)
    margin = (side - usual.grid.side) // 2
    inner = image[margin:-margin, margin:-margin]
    expected = wide.score_deviations(image) - usual.score_deviations(np.ascontiguousarray(inner))
    coarse = missing.grid.pitch_mrad
    shape["size_px"] = size_samples / coarse
    small = coverage((missing.grid.side,) * 2, x_px=missing.grid.side // 2, y_px=missing.grid.side // 2, **shape)
    found = missing.deviations.reshape(4, -1) @ small.ravel()
    # On the coarser retina the triangle's edges are blurred by one coarse sample more.
    assert found == pytest.approx(expected, abs=0.2 * np.abs(expected).max())
    covariance = wide.noise_covariance - usual.noise_covariance
    assert missing.noise_covariance == pytest.approx(covariance, abs=0.2 * np.abs(covariance).max())


WEEKLY = [pytest.param(seed, marks=pytest.mark.weekly) for seed in range(1000, 1030)]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [*range(100, 106), *WEEKLY])
def test_planned_and_full_thresholds_differ_by_less_than_their_bounds(seed):
    rng = np.random.default_rng(seed)
    sensor, observer, size = camera_at_random(rng), observer_at_random(rng), min(log_uniform(rng, 3.0, 7.0), 5.0)
    plans = [plan_curve(resolve(sensor), observer, size, name=name, tolerance=1e-2) for name in ("needed", "full")]
    chains = [FoldedChain(resolve(sensor), observer, size, plan) for plan in plans]
    planned, full = (predict_threshold(chain, tolerance=1e-2) for chain in chains)
    assert planned.status == full.status
    snr = planned.threshold if planned.threshold is not None else np.inf
    # At the same places of the triangle, for one orientation.
    p = [chain.proportion_correct(chain.phases(3, np.random.default_rng(1))[:1], snr) for chain in chains]
    assert abs(p[0] - p[1]) <= plans[0].bound
    if planned.threshold is not None:
        # The intervals stated are of 95 %, 2.8 standard errors from eight lattices; twice as much is passed once
        # in a thousand (Student's t, 7 degrees of freedom).
        assert abs(planned.threshold - full.threshold) <= 2.0 * (planned.numerical_error + full.numerical_error)


def test_the_repetition_of_the_scene_is_part_of_the_stated_error():
    """A period of four times the longest that is considered stands for a scene that never repeats."""
    observer = PyramidObserver()
    # Everything else is left out alike; the rounding of single precision would hide the change.
    plan = replace(plan_curve(resolve(STAR_LIKE), observer, 4.0), dtype=np.float64)
    endless = TriangleSampler(resolve(STAR_LIKE), 4.0, plan.field, 168)
    chains = [
        FoldedChain(resolve(STAR_LIKE), observer, 4.0, one) for one in (plan, replace(plan, sampler=endless))
    ]
    p, expected = (chain.proportion_correct(chain.phases(2, np.random.default_rng(3)), 2.0) for chain in chains)
    of_period = sum(step.bound for step in plan.steps if step.stage == "period") + plan.repetition_bound
    assert 0.0 < abs(p - expected) < of_period <= plan.bound
    assert plan.repetition_bound > 0.0


def test_a_tighter_tolerance_leaves_out_less():
    observer = PyramidObserver(PyramidSettings(centre="bounding_box"))
    loose, tight = (
        plan_curve(resolve(STAR_LIKE), observer, 4.0, tolerance=tolerance) for tolerance in (1e-2, 1e-6)
    )
    assert tight.bound < 1e-6 < loose.bound < LEFT_OUT_SHARE * 1e-2
    assert "pyramid levels" in {step.stage for step in tight.steps if step.kept}
    assert tight.dtype == np.float64


def test_a_large_frame_is_read_where_the_triangle_is(make_dataset, monkeypatch):
    """10 pixels in 960 × 540: 181 samples of 0.153 mrad are 40 rows, decoded in bands of 16."""
    made = make_dataset(sizes_mrad=(7.0,), contrasts=(0.04,), display={"pixel_pitch_mrad": 0.7})
    rng = np.random.default_rng(0)
    for number, orientation in enumerate(ORIENTATIONS):
        shape = coverage((540, 960), size_px=10.0, x_px=479.5, y_px=269.5, orientation=orientation)
        noise = np.tile(rng.normal(0.0, 0.03, (540, 64)), 15)
        write_frame(made.frame(number), 50.0 * (1.0 + 0.04 * shape + noise))
        made.rows[number]["contrast"] = str(0.04 + 0.001 * number)
    made.save()
    decoded, decode = Counter(), FrameFile._decode

    def counted(self, top, bottom, left, right):
        decoded[self] += bottom - top
        return decode(self, top, bottom, left, right)

    monkeypatch.setattr(FrameFile, "_decode", counted)
    dataset = load_dataset(made.path)
    planned = score_dataset(dataset, PyramidObserver())
    assert max(decoded.values()) < 70
    decoded.clear()
    full = score_dataset(dataset, PyramidObserver(), plan="full")
    assert list(decoded.values()) == [540] * 4
    assert 0.0 < np.abs(planned.p_correct - full.p_correct).max() < 1e-3
    steps = explain(Scoring(dataset, PyramidObserver(), "expected", 1), dataset.trials)
    assert [step["stage"] for step in steps] == ["frame beyond the retina", "pyramid levels", "noise on neurons"]
    assert 0.0 < steps[1]["bound"] < 1e-3
    (kept,) = explain(Scoring(dataset, PyramidObserver(), "expected", 1, plan="full"), dataset.trials)
    assert (kept["kept"], kept["why"]) == (True, "as plan full asks")


@pytest.mark.parametrize("side_px", [25, 27, 28])
def test_a_frame_that_ends_where_the_field_does(make_dataset, side_px):
    """On an uneven background, whose edge a displaced retina sees elsewhere than one that is not displaced."""
    made = make_dataset(side_px=side_px)
    for number, row in enumerate(made.rows):
        middle = (side_px - 1) / 2
        orientation = Orientation(row["orientation"])
        triangle = coverage((side_px,) * 2, size_px=8.0, x_px=middle, y_px=middle, orientation=orientation)
        contrast = 0.05 * triangle - 0.2 * np.square(np.linspace(-1.0, 1.0, side_px))[:, None]
        write_frame(made.frame(number), 50.0 * (1.0 + contrast), pixel_type="float")
    planned, full = (
        score_dataset(load_dataset(made.path), PyramidObserver(), plan=name) for name in ("needed", "full")
    )
    assert np.abs(planned.p_correct - full.p_correct).max() < 1e-3
