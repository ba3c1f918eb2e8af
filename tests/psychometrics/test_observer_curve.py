"""The observer's own psychometric curve: against the decision's orthants, exact thresholds and experiments."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import load_sensor
from sensor_sim.thresholds.predict import FoldedChain
from todframes.observers.decision import answer_probability
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import triangle_on
from todframes.psychometrics.bootstrap import Observed
from todframes.psychometrics.curves import (
    ObserverModel,
    WeibullModel,
    binomial_loglik,
    d_prime_of,
    observer_curve,
    weibull_level,
)
from todframes.psychometrics.fit import FitSettings, PsychometricFit, _status, curve_model, fit_trials
from todframes.psychometrics.paired_bootstrap import ratio_draws, threshold_draws, threshold_ratio
from todframes.stimulus import Stimulus

SAMPLES = Path(__file__).parents[2] / "sample_frames"
POINT = FitSettings(resamples=0)
LEVELS = np.geomspace(0.5, 2.0, 7)


def fitted(level, p_correct, chosen: FitSettings = POINT, seed: int = 0) -> PsychometricFit:
    return fit_trials(level, p_correct, curve="observer", settings=chosen, rng=np.random.default_rng(seed))


def level_of(p_correct: float, *, alpha: float, beta: float, max_d_prime: float | None) -> float:
    curve = {"alpha": alpha, "beta": beta, "max_d_prime": max_d_prime}
    return brentq(lambda level: observer_curve(level, **curve) - p_correct, 1e-9, 1e9, xtol=1e-14, rtol=1e-13)


def test_curve_is_the_largest_of_four_independent_scores():
    d_prime = np.linspace(0.0, 12.0, 97)
    scores = d_prime[:, None] * np.array([1.0, 0.0, 0.0, 0.0])
    p_correct = observer_curve(d_prime, alpha=1.0, beta=1.0, max_d_prime=None)
    # The orthants are right to 1e-9, the table of cubics to 1e-8.
    np.testing.assert_allclose(p_correct, answer_probability(scores, np.eye(4), 0), rtol=0, atol=2e-8)


def test_errors_keep_their_digits_at_high_levels():
    # Far out one other score beats the right one: 3 Φ(−d′/√2), less pairs, which are rarer by e^(−d′²/12).
    from scipy.special import ndtr

    wrong = 1.0 - observer_curve(9.0, alpha=1.0, beta=1.0, max_d_prime=None)
    assert wrong == pytest.approx(3.0 * ndtr(-9.0 / math.sqrt(2.0)), rel=0.01)


def test_ends_of_the_curve():
    ends = observer_curve([0.0, 1e-300, 1e300], alpha=1.0, beta=3.0, max_d_prime=None)
    np.testing.assert_allclose(ends, [0.25, 0.25, 1.0], rtol=1e-8)
    limited = observer_curve([0.0, 1e300], alpha=1.0, beta=3.0, max_d_prime=2.0)
    np.testing.assert_allclose(
        limited, [0.25, observer_curve(2.0, alpha=1.0, beta=1.0, max_d_prime=None)], rtol=1e-8
    )


@settings(max_examples=30, deadline=None)
@given(st.floats(0.2501, 0.999999))
def test_d_prime_is_the_inverse_of_the_curve(p_correct: float):
    # P falls by 0.27 a unit of d′ at most, and d′ is known to a rounding.
    found = observer_curve(d_prime_of(p_correct), alpha=1.0, beta=1.0, max_d_prime=None)
    assert found == pytest.approx(p_correct, abs=1e-12)


MODELS = [(WeibullModel, [0.1, 0.3, 0.02], 0.0), (WeibullModel, [0.1, 0.0, 0.02], 7.0),
          (ObserverModel, [0.1, 0.3, 0.1], 0.0), (ObserverModel, [-0.3, 0.0, 0.1], 7.0)]  # fmt: skip


@pytest.mark.parametrize(("kind", "theta", "prior"), MODELS)
def test_derivatives_and_influence_are_those_of_the_fit(kind: type, theta: list[float], prior: float) -> None:
    """By differences of the likelihood, of its derivatives at its top, and of fits to other answers."""
    n, z, top = np.array([3.0, 5.0, 8.0, 4.0, 6.0, 2.0]), np.linspace(-1.0, 1.2, 6), np.array(theta)
    model = kind(0.0, z, n, 0.25, 0.75, np.array([-600.0, -5.0, 0.0]), np.array([600.0, 7.0, 0.2]), prior)
    right, step, unit = model.curves(top[None], z)[0][0], 1e-5, np.eye(3)
    answers = np.tile(np.linspace(0.2, 0.9, 6), (1, 1))
    loglik, score, _ = model.derivatives(top[None], answers)
    assert loglik[0] == pytest.approx((n * binomial_loglik(answers[0], right)).sum() - prior * theta[1] ** 2 / 2.0)
    beside = [[top + sign * step * unit[k] for k in range(3)] for sign in (1, -1)]
    of_answers, of_right = (
        [model.derivatives(np.array(side), np.tile(share, (3, 1))) for side in beside]
        for share in (answers, right)
    )
    # The differences err by step² times third derivatives of some 1e3, and by roundings over the step.
    np.testing.assert_allclose(score[0], (of_answers[0][0] - of_answers[1][0]) / (2 * step), rtol=0.0, atol=1e-6)
    _, _, information = model.derivatives(top[None], right[None])
    curvature = (of_right[1][1] - of_right[0][1]) / (2 * step)
    np.testing.assert_allclose(information[0], curvature, rtol=0.0, atol=1e-5)
    found, weight = model.influence(top)
    np.testing.assert_array_equal(found, right)
    for level in range(6):
        moved = [model.fit_one(right + sign * step * np.eye(6)[level])[0] for sign in (1, -1)]
        ends = model.ln_threshold(np.array(moved))
        assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(n[level] * weight[level], rel=1e-6)


def test_pools_of_levels_have_their_likelihood() -> None:
    """Of 128 levels, two of each, 64 pools; less what makes the first of equal curves win."""
    rng, z = np.random.default_rng(0), np.repeat(np.linspace(-1.0, 1.2, 64), 2)
    n, answers = rng.integers(1, 9, 128).astype(float), rng.random((2, 128))
    model = WeibullModel(0.0, z, n, 0.25, 0.75, np.array([-6.0, -5.0, 0.0]), np.array([6.0, 5.0, 0.05]), 2.0)
    curves = model.starts()[3:6, :50].reshape(-1, 3)
    assert model.starts().shape == (10, 23 * 3 * 3, 3)
    n_right, weight, constant = model.grid_terms(curves, answers)
    assert n_right.shape == (2, 64)
    for row, share in enumerate(answers):
        loglik, _, _ = model.derivatives(curves, np.tile(share, (150, 1)))
        tie_break = 1e-9 * n.sum() * np.arange(150) / 149
        np.testing.assert_allclose(n_right[row] @ weight + constant, loglik - tie_break, rtol=1e-11)


def test_a_threshold_is_within_a_factor_of_two_of_the_levels() -> None:
    model = ObserverModel(math.log(3.0), np.array([-1.0, 1.0]), np.ones(2), 0.25, 0.75, np.zeros(3), np.zeros(3))
    beyond = 1.0 + math.log(2.0)
    assert model.reach == (-beyond, beyond)
    assert model.interval(-beyond, beyond) == pytest.approx((3.0 / math.e / 2.0, 6.0 * math.e))
    assert model.interval(-beyond - 1e-9, beyond + 1e-9) == (None, None)
    at = np.array([-beyond - 1e-9, -beyond + 1e-9, 0.0, beyond - 1e-9, beyond + 1e-9])
    theta = np.stack([at - math.log(d_prime_of(0.75)), np.zeros(5), np.zeros(5)], axis=1)
    assert model.thresholds_within_reach(theta) == pytest.approx([-math.inf, *at[1:4], math.inf])


@pytest.mark.parametrize(
    ("ln_threshold", "nearest", "status"),
    [
        (1.0, 0.3, "ok"),
        (-1.0, 0.9, "ok"),
        (1.69, 0.5, "extrapolated"),
        (1.69, 0.499, "never_reached"),
        (1.70, 0.74, "never_reached"),
        (-1.69, 0.84, "extrapolated"),
        (-1.69, 0.86, "always_exceeded"),
        (-1.70, 0.76, "always_exceeded"),
    ],
)
def test_a_threshold_beyond_the_levels_is_near_and_half_way_there(ln_threshold, nearest, status) -> None:
    """Levels from −1 to 1; from γ = 0.25 up to 0.75, or down from 0.95, at least half is within them."""
    curves = lambda _, z: (np.array([[nearest if z[0] * ln_threshold > 0 else math.nan]]),)  # noqa: E731
    model = SimpleNamespace(z=np.array([-1.0, 1.0]), curves=curves, guess_rate=0.25, p_correct=0.75)
    model.ceiling, model.is_step = lambda _: 0.95, lambda _: False
    assert _status(model, np.zeros(3), ln_threshold) == status


def test_the_slope_that_a_fit_expects_weighs_as_much_as_answers_vary() -> None:
    rng, level = np.random.default_rng(0), np.repeat(LEVELS, 6)
    p = np.clip(observer_curve(level, alpha=0.7, beta=1.0, max_d_prime=None) + rng.normal(0, 0.05, 42), 0.0, 1.0)
    shown = Observed.of_trials(level, p, np.argsort(level, kind="stable"))
    free, expecting = (curve_model(shown, "observer", FitSettings(slope_spread=s)) for s in (None, 0.1))
    assert (free.slope_prior, free.near, expecting.centre) == (0.0, None, pytest.approx(0.0, abs=1e-15))
    theta, _ = free.fit_one(shown.p_correct)
    np.testing.assert_allclose(expecting.near, theta, rtol=0.0, atol=1e-6)
    variance = np.sum((p.reshape(7, 6) - free.curves(theta[None], free.z)[0].T) ** 2)
    largest = 6 * np.prod(free.curves(theta[None], free.z)[:2], axis=0).sum()
    assert expecting.slope_prior == pytest.approx(variance / largest * 42 / 39 / 0.1**2, rel=1e-6)
    assert (expecting.lower.tolist(), expecting.upper[2]) == ([-600.0, math.log(1e-2), 0.0], pytest.approx(100.0))
    fixed = curve_model(shown, "weibull", FitSettings(lapse_rate=0.02))
    assert (fixed.lower[2], fixed.upper[2], fixed.upper[1]) == (0.02, 0.02, math.log(1e3))


@settings(max_examples=15, deadline=None)
@given(st.floats(0.7, 1.4), st.floats(0.8, 1.3), st.sampled_from([None, 3.0, 2.2]), st.floats(1e-5, 1e5))
def test_exact_probabilities_give_back_their_curve(threshold, beta, max_d_prime, unit):
    alpha = threshold / level_of(0.75, alpha=1.0, beta=beta, max_d_prime=max_d_prime)
    curve = {"alpha": alpha, "beta": beta, "max_d_prime": max_d_prime}
    level = np.geomspace(0.2, 6.0, 9)
    fit = fitted(unit * level, observer_curve(level, **curve))
    assert (fit.status, fit.curve) == ("ok", "observer")
    assert fit.threshold == pytest.approx(unit * threshold, rel=1e-6)
    assert fit.observer_curve.alpha == pytest.approx(unit * alpha, rel=1e-5)
    assert fit.observer_curve.beta == pytest.approx(beta, rel=1e-5)
    assert (fit.observer_curve.max_d_prime or 1e3) == pytest.approx(max_d_prime or 1e3, rel=0.01) or (
        max_d_prime is None and fit.observer_curve.max_d_prime > 20.0
    )


BELOW_GUESSING = FitSettings(guess_rate=0.1, p_correct=0.2, resamples=0)


@pytest.mark.parametrize(
    ("alpha", "max_d_prime", "chosen", "status"),
    [
        (0.6, 1.4, POINT, "never_reached"),  # P is 0.68 at d′ = 1.4, whatever the level
        (9.0, None, POINT, "never_reached"),
        (1.5, None, POINT, "extrapolated"),
        (0.02, None, POINT, "always_exceeded"),
        (0.6, None, BELOW_GUESSING, "always_exceeded"),
    ],
)
def test_status(alpha: float, max_d_prime: float | None, chosen: FitSettings, status: str):
    fit = fitted(LEVELS, observer_curve(LEVELS, alpha=alpha, beta=1.0, max_d_prime=max_d_prime), chosen)
    assert fit.status == status
    assert (fit.threshold is None) == (status != "extrapolated")


def test_probabilities_that_do_not_rise_have_no_curve():
    fit = fitted(LEVELS, np.linspace(0.6, 0.4, 7))
    assert (fit.status, fit.observer_curve) == ("never_reached", None)


def test_two_levels_have_a_threshold_between_them():
    p_correct = observer_curve([0.8, 1.6], alpha=0.7, beta=1.0, max_d_prime=None)
    assert fitted([0.8, 1.6], p_correct).threshold == pytest.approx(
        level_of(0.75, alpha=0.7, beta=1.0, max_d_prime=None)
    )


@pytest.fixture(scope="module")
def naked_eye():
    """Score deviations of triangles of 0.6 mrad, contrast 1, at 25 places, and the noise on them."""
    readout = PyramidObserver().readout(Stimulus(0.6))
    steps = (np.arange(5) + 0.5) / 5 - 0.5
    triangles = (triangle_on(readout.grid, 0.6, x=dx, y=dy) for dx in steps for dy in steps)
    signals = [readout.score_deviations(triangle) for triangle in triangles]
    return np.array(signals), readout.noise_covariance


def of_naked_eye(naked_eye, levels) -> np.ndarray:
    signals, covariance = naked_eye
    return answer_probability(np.asarray(levels)[:, None, None] * signals, covariance, 0, tolerance=1e-9)


def test_naked_eye_threshold_is_right_to_two_thousandths(naked_eye):
    """Levels from 30 to 99 % right, the eye's smallest size with such answers; Weibull's curve is 2 % off."""

    def at(p_correct: float) -> float:
        return brentq(lambda level: of_naked_eye(naked_eye, [level]).mean() - p_correct, 1e-2, 1.5, rtol=1e-6)

    truth = at(0.75)
    for n_levels in (5, 7, 12):
        levels = np.geomspace(at(0.3), at(0.99), n_levels)
        fit = fitted(levels, of_naked_eye(naked_eye, levels).mean(axis=1))
        assert fit.threshold == pytest.approx(truth, rel=0.002)
        by_weibull = weibull_level(
            0.75, alpha=fit.alpha, beta=fit.beta, guess_rate=0.25, lapse_rate=fit.lapse_rate
        )
        assert abs(by_weibull / truth - 1) > 0.02


def test_ratio_is_the_quotient_of_the_thresholds(naked_eye):
    """The second series has frames of 0.8 of the contrast: its threshold is 1.25 times as high."""
    levels = 0.31 * LEVELS
    rng = np.random.default_rng(3)
    chosen = rng.integers(25, size=(7, 12))
    series = np.array(
        [of_naked_eye(naked_eye, gain * levels)[np.arange(7)[:, None], chosen].ravel() for gain in (1.0, 0.8)]
    )
    level = np.repeat(levels, 12)
    fits = [fitted(level, p, FitSettings(resamples=200)) for p in series]
    reference, other = threshold_draws(level, series, fits, settings=FitSettings(resamples=200), rng=rng)
    draws = ratio_draws(other, reference)
    found = threshold_ratio([draws])
    assert found.ratio == fits[1].threshold / fits[0].threshold
    assert draws.points_ratio is None
    low, high = found.ratio_ci95
    # Fitted thresholds are right to 0.002, as above, and both series have the same displacements.
    assert low * 0.998 < 1.25 < high * 1.002 < 1.1 * low


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("sensor", "lowest", "highest"), [("star_like", 0.25, 4.0), ("staring_camera", 0.15, 5.0)]
)
def test_camera_near_its_acuity(sensor: str, lowest: float, highest: float) -> None:
    """4 detectors, where P levels off at 91 % and 80 %."""
    chain = FoldedChain(resolve(load_sensor(SAMPLES / f"{sensor}.toml")), PyramidObserver(), 4.0)
    up = chain.phases(17, np.random.default_rng(1))[0]
    signal, external = up.signal.reshape(-1, 4), np.repeat(up.noise, up.signal.shape[1], axis=0)

    def proportion(snr: float) -> float:
        return answer_probability(signal, chain.noise_covariance + external / snr**2, 0, tolerance=1e-9).mean()

    truth = brentq(lambda snr: proportion(snr) - 0.75, 0.5, 10.0, rtol=1e-6)
    levels = truth * np.geomspace(lowest, highest, 7)
    exact = fitted(levels, [proportion(snr) for snr in levels])
    assert exact.threshold == pytest.approx(truth, rel=0.01)


@pytest.mark.weekly
@pytest.mark.parametrize("max_d_prime", [None, 2.0])
def test_interval_holds_the_threshold_as_often_as_stated(max_d_prime: float | None) -> None:
    """A true coverage of 95 % gives 92 to 98 % of 300 experiments in all but 2 % of such tests."""
    curve, rng = {"alpha": 0.8, "beta": 1.0, "max_d_prime": max_d_prime}, np.random.default_rng(4)
    truth = level_of(0.75, **curve)
    level = np.repeat(truth * np.geomspace(0.2, 4.5, 7), 40)
    p, chosen = observer_curve(level, **curve), FitSettings(resamples=200)
    fits = [fitted(level, rng.beta(20 * p, 20 * (1 - p)), chosen, seed=k) for k in range(300)]
    held = [(fit.threshold_ci95[0] or 0.0) <= truth <= (fit.threshold_ci95[1] or math.inf) for fit in fits]
    assert 0.92 <= np.mean(held) <= 0.98
