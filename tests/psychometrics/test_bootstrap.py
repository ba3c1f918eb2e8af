"""Repeated experiments by hand: a generator that counts up in place of drawing, and published formulas."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq
from scipy.stats import chi2, norm

from todframes.psychometrics import bootstrap
from todframes.psychometrics.bootstrap import Observed, crossing_of_points, interval_of_draws, redrawn
from todframes.psychometrics.curves import WeibullModel, binomial_loglik


class Counting:
    """Numbers of right answers are their mean, χ² is a quarter of its mean, and indices count up."""

    def __init__(self) -> None:
        self.asked: list[np.ndarray] = []

    def binomial(self, n, p, size=None):
        self.asked.append(p)
        return np.broadcast_to(n * p, size or (n * p).shape)

    def chisquare(self, freedom, size):
        self.asked.append(freedom)
        return np.broadcast_to(freedom / 4.0, size)

    def integers(self, n, size):
        return np.resize(np.arange(n), size)

    def random(self, size):
        return (np.arange(size) + 0.6) / size


def observed(*trials: list[float]) -> Observed:
    """Answers at the levels 1, 2, 3 …, given in another order."""
    level = np.repeat(np.arange(len(trials)) + 1.0, [len(answers) for answers in trials])[::-1]
    p_correct = np.concatenate(trials)[::-1]
    return Observed.of_trials(level, p_correct, np.lexsort((np.arange(len(level))[::-1], level)))


def test_the_answers_of_a_series_have_moments() -> None:
    shown = observed([0.2, 0.4], [0.5, 0.7], [1.0])
    assert (shown.level.tolist(), shown.n_trials.tolist(), shown.tolerance) == ([1.0, 2.0, 3.0], [2, 2, 1], 1e-8)
    assert [answers.tolist() for answers in shown.trials] == [[0.2, 0.4], [0.5, 0.7], [1.0]]
    assert shown.p_correct == pytest.approx([0.3, 0.6, 1.0])
    fitted = np.array([0.5, 0.5, 0.8])
    second, third = shown.moments(fitted)
    assert second == pytest.approx([0.05, 0.02, 0.04]) and third == pytest.approx([-0.014, 0.004, 0.008])
    # Σ n r² = 0.18 of Σ n p (1 − p) = 1.16, of five trials with three free parameters.
    assert shown.dispersion(fitted) == pytest.approx(0.18 / 1.16 * 5.0 / 2.0)
    assert shown.dispersion(np.array([0.999, 0.999, 0.1])) == 1.0 - 1e-6
    assert observed(*[[0.5, 0.5]] * 2).dispersion(np.full(2, 0.5)) == 1e-12
    assert observed([0.2], [0.5], [0.7]).dispersion(fitted) == 1.0
    answers = observed([0, 1, 1], [1, 1])
    assert (answers.tolerance, answers.dispersion(fitted[:2])) == (1e-4, 1.0)
    assert np.allclose(answers.moments(np.array([0.2, 0.9])), [[0.16, 0.09], [0.096, -0.072]])
    enough, rows = [0.2, 0.3, 0.4], ([0.2, 0.3], [0.0, 1.0, 1.0])
    assert observed(enough, enough, enough).shows_its_own_curve
    for few in ((enough, enough), (enough, enough, rows[0]), (rows[1],) * 3):
        assert not observed(*few).shows_its_own_curve


@pytest.mark.parametrize(
    ("other", "agreement"), [([[1, 1], [1, 0, 1, 0]], 0.76 / 1.76), ([[0, 1], [0, 0, 0, 1]], 0.0)]
)
def test_answers_of_two_series_are_drawn_together(other: list, agreement: float) -> None:
    """Of n trials, 5 of the curve and, in the whole experiment, 4 with (1 + γ)/2.

    Independent answers of the curves, 0.4 and 0.8, 0.5 and 0.6, differ in 2 · 0.5 + 4 · 0.44 = 2.76 trials, and in
    2 · 0.1 + 4 · 0.2 = 1 at least. Those shown differ in two trials or in all six.
    """
    series, curves = (observed([1, 0], [1, 1, 1, 0]), observed(*other)), np.array([[0.4, 0.8], [0.5, 0.6]])
    counting, n = Counting(), np.array([2.0, 4.0])
    drawn = redrawn(series, curves, 3, counting, guess_rate=0.2)
    shown, curve = n / (n + 5) * 0.6, 5 / (n + 5) * 0.6
    mixed = [shown * of.p_correct + curve * p + 0.4 * 0.6 for of, p in zip(series, curves, strict=True)]
    np.testing.assert_allclose(drawn, np.repeat(np.array(mixed)[:, None], 3, axis=1), rtol=1e-14)
    pairs = zip(series[0].trials, series[1].trials, strict=True)
    both_shown = [np.mean(first * second) for first, second in pairs]
    rest = (curve * curves + 0.4 * 0.6) / (curve + 0.4)
    together = agreement * rest.min(axis=0) + (1 - agreement) * rest.prod(axis=0)
    both = shown * both_shown + (1 - shown) * together
    _, if_right, if_wrong = counting.asked
    np.testing.assert_allclose(if_right * mixed[0], both, rtol=1e-12)
    np.testing.assert_allclose(if_wrong * (1 - mixed[0]), mixed[1] - both, rtol=1e-12)


@pytest.mark.parametrize("each_level", [True, False])
def test_probabilities_are_drawn_about_their_mean(each_level: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """A single trial from all seven residuals, the others one less than there are; deviations are doubled."""
    shown, curve, counting = observed([0.5], [0.2, 0.6], [0.6, 0.7, 0.8, 0.9]), [0.4, 0.5, 0.7], Counting()
    (drawn,) = redrawn([shown], np.array([curve]), 7, counting, guess_rate=0.25, each_level=each_level)
    of_curve = 4 / 3  # a third of seven trials less three parameters
    assert counting.asked[0] == pytest.approx([of_curve, 1.0, 3.0] if each_level else [of_curve])
    residuals = [0.1 / math.sqrt(0.24), -0.6, 0.2, *(step / math.sqrt(0.21) for step in (-0.1, 0.0, 0.1, 0.2))]
    single = [0.4 + 2.0 * math.sqrt(0.24) * math.sqrt(7 / 4) * residual for residual in residuals]
    assert drawn[:, 0] == pytest.approx(np.clip(single, 0.0, 1.0))
    assert drawn[:, 1] == pytest.approx([0.0, 0.8, 0.0, 0.8, 0.0, 0.8, 0.0])
    thrice = [np.mean(values) for values in ([6, 7, 8], [9, 6, 7], [8, 9, 6], [7, 8, 9]) * 2]
    assert drawn[:, 2] == pytest.approx([0.75 + 2.0 * (mean / 10.0 - 0.75) for mean in thrice[:7]])
    three = observed([0.4], [0.9], [0.5])
    (few,) = redrawn([three], np.array([[0.35, 0.8, 0.5]]), 10, Counting(), guess_rate=0.25)
    assert few.mean(axis=0).tolist() == [0.3, 0.8, 0.5]  # answers of 0 and 1, right in three of ten, …
    monkeypatch.setattr(bootstrap, "_BATCH_ELEMENTS", 4)  # two draws of two at once, each from the first on
    means = bootstrap.resampled_means(np.array([[1.0, 2.0, 6.0], [0.0, 0.0, 3.0]]), 5, Counting())
    assert means.tolist() == [[1.5, 3.5, 1.5, 3.5, 1.5], [0.0, 1.5, 0.0, 1.5, 0.0]]


def test_backgrounds_are_drawn_with_their_trials() -> None:
    """Weights of three backgrounds: with answers of 0 and 1, five trials of the curve besides."""
    assert bootstrap.sets_of_backgrounds(np.array([0, 199, 200, 401])).tolist() == [0, 199, 0, 1]
    numbers, weights = [np.array([0, 0, 1]), np.array([2])], np.array([[1.0, 1.0, 0.0], [2.0, 0.0, 0.0]])
    curves = np.array([[0.5, 0.9]])
    (drawn,) = bootstrap.on_drawn_backgrounds([observed([0.2, 0.4, 0.9], [0.7])], curves, numbers, weights)
    assert drawn.ravel() == pytest.approx([0.5, 0.7, 0.3, 0.7])
    (drawn,) = bootstrap.on_drawn_backgrounds([observed([1, 0, 1], [1])], curves, numbers, weights)
    first, second = (2 / 3 * 3 + 5 * 0.5) / 8, (0.5 * 3 + 5 * 0.5) / 8
    assert drawn.ravel() == pytest.approx([first, 5.5 / 6, second, 5.5 / 6])
    assert bootstrap.draw_backgrounds(1, 100, np.random.default_rng(0)) is None
    two = bootstrap.draw_backgrounds(2, 20_000, np.random.default_rng(0))
    three = bootstrap.draw_backgrounds(3, 20_000, np.random.default_rng(0))
    for draws, freedom in ((two, 1), (three, 2)):
        assert (draws.weights.sum(axis=1) == freedom).all()
        # χ²/ν has the mean 1 and the variance 2/ν: four standard errors.
        assert np.mean(draws.widening**-2.0) == pytest.approx(1.0, abs=4 * math.sqrt(2.0 / freedom / 20_000))
        assert draws.weights.mean(axis=0) == pytest.approx(freedom / (freedom + 1), abs=0.02)


def test_the_ends_of_an_interval_are_ranks() -> None:
    draws = np.random.default_rng(0).permutation(np.arange(1.0, 100.0))
    assert interval_of_draws(draws, [50.0]) == (2.0, 98.0)
    assert interval_of_draws(draws, [50.0], (0.10, 0.80)) == (10.0, 80.0)
    assert interval_of_draws(draws, [50.0, 1.5, 98.5]) == (1.5, 98.5)
    assert interval_of_draws(np.array([3.0, 1.0, 2.0]), [2.0]) == (1.0, 3.0)


@pytest.mark.parametrize("skew", [1.0, 0.01, -0.01])
def test_bca(skew: float) -> None:
    """Efron 1987: Φ(z₀ + (z₀ + z)/(1 − a (z₀ + z))), a = Σ l³ / 6 (Σ l²)^1.5 of all trials, −0.1 to 0.1.

    A step between the levels about the estimate, from γ to the ceiling, widens it where it is as likely.
    """
    shown, right = observed([0.1, 0.4], [0.62, 0.6, 0.1], [0.9, 1.0]), np.array([0.3, 0.6, 0.9])
    weight, draws, n, estimate = (
        np.array([0.02, skew, 0.01]),
        np.linspace(-0.5, 1.0, 999) ** 3,
        shown.n_trials,
        0.1,
    )
    second, third = shown.moments(right)
    a = np.clip((n * weight**3 * third).sum() / 6.0 / (n * weight**2 * second).sum() ** 1.5, -0.1, 0.1)
    z0 = norm.ppf(np.mean(draws < estimate))
    tails = [norm.cdf(z0 + (z0 + z) / (1 - a * (z0 + z))) for z in norm.ppf([0.025, 0.975])]
    ranks = draws[math.floor(tails[0] * 1000) - 1], draws[math.ceil(tails[1] * 1000) - 1]
    step = np.sum(n * binomial_loglik(shown.p_correct, np.array([0.25, 0.25, 0.98])))
    for excess, expected in ((1e-9, ranks), (-1e-9, (min(ranks[0], -0.1), max(ranks[1], 0.99)))):
        model = SimpleNamespace(
            influence=lambda _: (right, weight), ln_threshold=lambda curves: curves[:, 0], ceiling=lambda _: 0.98,
            fit_many=lambda *_, **__: draws[:, None], z=np.array([-0.7, -0.1, 0.99]), n_trials=n, guess_rate=0.25,
            is_convention=True, is_step=lambda _: False, likely_thresholds=lambda *_: (math.inf, -math.inf),
        )  # fmt: skip
        theta, loglik = np.array([estimate]), step + chi2.ppf(0.95, 1) * shown.dispersion(right) / 2 + excess
        ends = bootstrap.threshold_interval(model, theta, loglik, shown, 999, np.random.default_rng(0))
        assert ends == pytest.approx(expected, rel=1e-12), a


def test_points_cross_the_criterion_where_scipys_cubic_does() -> None:
    """PCHIP of ln(−ln(1 − F)): of several crossings upwards that nearest to the fitted threshold."""
    z = np.array([-1.0, -0.4, 0.1, 0.9, 1.2])
    p = np.array([
        [0.30, 0.35, 0.60, 0.90, 0.95], [0.25, 0.80, 0.60, 0.70, 0.99], [0.80, 0.74, 0.70, 0.76, 0.90],
        [0.30, 0.31, 0.29, 0.74, 0.95], [0.60, 0.90, 0.65, 0.80, 0.60], [0.20, 0.75, 0.90, 0.90, 1.00],
        [0.30, 0.40, 0.50, 0.60, 0.70], [0.80, 0.90, 0.80, 0.90, 0.90], [0.80, 0.70, 0.60, 0.60, 0.70],
    ])  # fmt: skip
    link = np.log(-np.log1p(-np.clip((p - 0.25) / 0.75, 1e-9, 1 - 1e-9)))
    at = math.log(-math.log(1 / 3))
    expected = []
    for y in link:
        cubic = PchipInterpolator(z, y - at)
        rising = [brentq(cubic, *z[k : k + 2]) for k in range(4) if y[k] < at <= y[k + 1]]
        middles = [(z[k] + z[k + 1]) / 2 for k in range(4) if y[k] < at <= y[k + 1]]
        nearest = int(np.argmin(np.abs(np.array(middles) - 0.3))) if rising else 0
        expected.append(rising[nearest] if rising else math.inf if y[-1] < at else -math.inf)
    model = WeibullModel(0.0, z, np.ones(5), 0.25, 0.75, np.zeros(3), np.zeros(3))
    theta = np.array([0.3 - math.log(math.log2(3.0)) / 2.0, math.log(2.0), 0.0])
    assert float(model.ln_threshold(theta[None])[0]) == pytest.approx(0.3)
    np.testing.assert_allclose(crossing_of_points(model, theta, p), expected, rtol=0.0, atol=1e-10)
