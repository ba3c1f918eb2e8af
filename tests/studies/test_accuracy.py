"""Error against run time: its arithmetic on data with known answers, methods against what they estimate."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from test_predict import UNDER_SAMPLED

from sensor_sim.chain.camera import resolve
from sensor_sim.studies.accuracy import STAR_LIKE, external_noise
from sensor_sim.thresholds.curve_plan import full_plan
from sensor_sim.thresholds.predict import FoldedChain, predict_threshold
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.naked_eye import contrast_threshold
from todframes.studies.accuracy import measure as studies
from todframes.studies.accuracy.measure import (
    AccuracyScene,
    Budget,
    Converged,
    ThresholdEstimate,
    TimeAt,
    find_scenes,
    measure,
    time_of_draws,
    time_of_rule,
)
from todframes.studies.accuracy.retina import naked_eye_small, recorded

ROOT = Path(__file__).parents[2]


def draws(constant: float, each_s: float, set_up_s: float) -> list[Budget]:
    """An error that falls as constant/√N, in blocks of 1 to 64 trials."""
    return [
        Budget(n, 640 // n, set_up_s + n * each_s, math.nan, constant / math.sqrt(n)) for n in 2 ** np.arange(7)
    ]


def test_time_of_draws_along_the_square_root():
    points = draws(constant=0.2, each_s=0.01, set_up_s=0.5)
    # 0.2/√N is 0.05 at 16 trials, and 0.001 at 40,000, of which 640 were drawn.
    assert time_of_draws(points, 0.5, 640, 0.05) == TimeAt(0.05, pytest.approx(0.66), extrapolated=False)
    assert time_of_draws(points, 0.5, 640, 0.001) == TimeAt(0.001, pytest.approx(400.5), extrapolated=True)
    assert time_of_draws([], 0.5, 0, 0.001) == TimeAt(0.001, None)


def test_time_of_a_rule_between_its_budgets():
    # The error is 1/t²: 1 % after 10 s.
    points = [Budget(n, 1, t, math.nan, t**-2.0) for n, t in enumerate((2.0, 4.0, 7.0, 12.0, 20.0))]
    assert time_of_rule(points, 0.01).cpu_s == pytest.approx(10.0)
    assert time_of_rule(points, 0.5) == TimeAt(0.5, 2.0, at_most=True)
    assert time_of_rule(points, 1e-3) == TimeAt(1e-3, None)

    # A small error by chance is not the last one: from 5 % at 4 s to 0.1 % at 8 s, in logarithms.
    chance = enumerate([(1, 0.1), (2, 0.001), (4, 0.05), (8, 0.001)])
    points = [Budget(n, 1, t, math.nan, error) for n, (t, error) in chance]
    assert time_of_rule(points, 0.01).cpu_s == pytest.approx(4.0 * 2.0 ** (math.log(5.0) / math.log(50.0)))


def known() -> AccuracyScene:
    """Bernoulli trials of 75 %, a slope of 0.5, and a closed form whose threshold is off by 1/n."""
    converged = Converged(2.0, 1e-9, 0.5)
    return AccuracyScene(
        name="known",
        title="known",
        description="As it is.",
        level="contrast",
        converged=converged,
        literal=lambda: lambda n, rng: (rng.random((n, 1)) < 0.75).astype(float),
        expected=lambda: lambda n, rng: rng.normal(0.75, 0.1, (n, 1)),
        closed_form=lambda: lambda n, _: ThresholdEstimate(0.75 + 0.5 / n, 2.0 * math.exp(1.0 / n)),
        budgets=(10, 100, 1000, 10_000),
        repeats=2,
        estimate=converged.estimate,
        smallest=64,
        fewest=4096,
        p_correct_error_bound=1e-3,
    )


@pytest.fixture(scope="module")
def measured():
    return measure(known(), seconds=0.2)


@pytest.mark.parametrize(("number", "deviation"), [(0, math.sqrt(0.1875)), (1, 0.1)])
def test_errors_of_drawn_trials(measured, number, deviation):
    method = measured.estimators[number]
    points = method.points
    assert [point.trials for point in points] == [64 * 2**k for k in range(len(points))]
    for point in points:
        # The deviation over √N of P, and that over the slope of ln threshold; a root mean square of so many.
        expected = deviation / math.sqrt(point.trials)
        assert point.p_correct_error == pytest.approx(expected, rel=4.0 / math.sqrt(2.0 * point.repeats))
        assert point.threshold_error == pytest.approx(point.p_correct_error / 0.5, rel=1e-9)
    # An error of 1 % takes (deviation / (0.5 · 1 %))² trials, 7,500 of answers.
    each_s = (points[0].cpu_s - method.set_up_cpu_s) / points[0].trials
    expected_s = (deviation / 0.005) ** 2 * each_s + method.set_up_cpu_s
    assert method.cpu_s_at[0].cpu_s == pytest.approx(expected_s, rel=8.0 / math.sqrt(2.0 * points[0].repeats))


def test_errors_of_a_closed_form(measured):
    literal, _, closed_form = measured.estimators
    for point in closed_form.points:
        assert point.threshold_error == pytest.approx(1.0 / point.trials)
        assert point.p_correct_error == pytest.approx(0.5 / point.trials)
    # Its errors are 10, 1, 0.1 %...: the second and third budget are the times of the two targets.
    for at, point in zip(closed_form.cpu_s_at, closed_form.points[1:3], strict=True):
        assert at.cpu_s == pytest.approx(point.cpu_s, rel=1e-6)
    for (first, ratio, last), drawn in zip(measured.pairs, literal.cpu_s_at, strict=True):
        assert ratio == pytest.approx(drawn.cpu_s / last.cpu_s)
        assert first == drawn


SMALL_CAMERA = partial(external_noise, UNDER_SAMPLED, 3.0, 1e-3)
SCENES = {
    "naked eye": partial(naked_eye_small, converged_nodes=(6, 8)),
    "external noise": SMALL_CAMERA,
    "recorded": partial(recorded, ROOT / "sample_frames" / "naked_eye", every=3, converged_nodes=(3, 4)),
}


@pytest.fixture(scope="module", params=[*[*SCENES][:-1], pytest.param("recorded", marks=pytest.mark.slow)])
def scene(request) -> AccuracyScene:
    return SCENES[request.param]()


@pytest.mark.every_case
@pytest.mark.parametrize("name", ["literal", "expected"])
def test_independent_trials_have_the_converged_mean(scene, name):
    """Their own P(correct) where it is one level; recorded frames through the fit of their mean."""
    n = 25 if scene.name == "recorded" else 300
    outcomes = getattr(scene, name)()(n, np.random.default_rng(1))
    assert len(outcomes) == n
    found = scene.estimate(outcomes.mean(axis=0)).p_correct
    parts = [scene.estimate(outcomes[part::5].mean(axis=0)).p_correct for part in range(5)]
    error = np.std(parts, ddof=1) / math.sqrt(5)
    # Student's t with four degrees of freedom: once in 1,000. The literal's noise is not quite Gaussian.
    assert abs(found - 0.75) < 8.6 * error + scene.p_correct_error_bound
    assert error < 0.05


@pytest.mark.every_case
def test_closed_form_goes_to_the_converged_value(scene):
    compute, converged = scene.closed_form(), scene.converged
    rng = np.random.default_rng(2)
    budget = 4 if scene.name == "recorded" else max(n for n in scene.budgets if n <= 250)
    for _ in range(4 if scene.repeats > 1 else 1):
        estimate = compute(budget, rng)
        # Some 200 evenly placed trials: 0.5 % is far beyond any of these scenes' error.
        assert estimate.threshold == pytest.approx(converged.threshold, rel=5e-3)
        # P at the converged threshold and the threshold say the same, to first order.
        off = math.log(estimate.threshold / converged.threshold)
        assert estimate.p_correct - 0.75 == pytest.approx(-off * converged.slope, abs=0.1 * abs(off) + 1e-6)


def test_naked_eye_converges_to_its_threshold():
    found = naked_eye_small(size_mrad=1.0, converged_nodes=(8, 12)).converged
    other = contrast_threshold(PyramidObserver(), size_mrad=1.0)
    assert abs(found.threshold - other.threshold) <= found.bound + other.numerical_error
    assert found.bound < 1e-3 * found.threshold


def test_camera_converges_to_its_threshold_with_nothing_left_out():
    found, camera = SMALL_CAMERA().converged, resolve(UNDER_SAMPLED)
    chain = FoldedChain(camera, PyramidObserver(), 3.0, full_plan(camera, PyramidObserver(), 3.0))
    other = predict_threshold(chain, tolerance=1e-3, seed=2)
    assert abs(found.threshold - other.threshold) <= found.bound + other.numerical_error
    assert found.bound < 2e-3 * found.threshold


def test_detector_noise_decides_as_the_description_says():
    chain = FoldedChain(resolve(STAR_LIKE), PyramidObserver(), 6.0)
    (part,) = chain.phases(11, np.random.default_rng(0))
    external = part.noise.mean(axis=0) / 1.05**2
    difference = np.array([1.0, -1.0, 0.0, 0.0])
    share = (difference @ external @ difference) / (difference @ (external + chain.noise_covariance) @ difference)
    assert share == pytest.approx(0.88, abs=0.01)


def test_registered_scenes_have_the_names_they_are_found_by(monkeypatch):
    monkeypatch.chdir(ROOT)
    found = find_scenes(())
    assert {*found} == {"naked_eye_small", "camera_external_noise", "recorded"}
    assert found["naked_eye_small"](converged_nodes=(1, 2)).name == "naked_eye_small"
    assert found["camera_external_noise"](tolerance=0.1).name == "camera_external_noise"
    assert found["recorded"](every=9, converged_nodes=(1, 2)).name == "recorded"


def test_without_recorded_frames(todframes, monkeypatch, tmp_path: Path, make_dataset):
    """Left out of all scenes with a remark; an error where they are asked for."""
    makers = {"known": known, "recorded": recorded}
    monkeypatch.setattr(studies, "find_scenes", lambda names: {name: makers[name] for name in names or makers})
    status, out, err = todframes("accuracy", "--dataset", make_dataset(contrasts=(0.01,)).path)
    assert (status, out) == (1, "")
    assert "the scene has no threshold (too_few_levels); expected one that is ok" in err and err.count("\n") == 1
    monkeypatch.chdir(tmp_path)
    status, out, err = todframes("accuracy", "--time", "0.05", "--json")
    assert status == 0
    assert [scene["name"] for scene in json.loads(out)["scenes"]] == ["known"]
    assert err.startswith("left out: recorded: ") and err.count("\n") == 1
    assert todframes("accuracy", "--time", "0.05", "--json", "--quiet")[2] == ""
    status, out, err = todframes("accuracy", "--scene", "recorded")
    assert (status, out) == (1, "")
    assert "sample_frames" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        ("--scene naked_eye_smal", 2, "--scene: unknown key 'naked_eye_smal'; the nearest valid one is"),
        ("--scene recorded --dataset nowhere", 1, "nowhere: not a folder"),
        ("--scene naked_eye_small --dataset nowhere", 2, "--dataset: found scenes naked_eye_small"),
        ("--time 0", 2, "time: found 0.0, expected a"),
        ("--time nan", 2, "time: found nan, expected a"),
    ],
)
def test_bad_input(todframes, arguments, status, message):
    found, out, err = todframes("accuracy", *arguments.split())
    assert (found, out) == (status, "")
    assert err.startswith(f"error: {message}") and err.count("\n") == 1
