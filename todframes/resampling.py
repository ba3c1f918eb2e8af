"""How sure a fitted threshold is: the bootstrap over trials, and whether the points fit the curve at all."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import fdtri, ndtr, ndtri, xlogy

from todframes.weibull import Array, WeibullModel

_CHI2_95 = 3.841458820694124
_CURVE_TRIALS = 5
_PLUS_TRIALS = 4
_Z_95 = 1.959963984540054
_BATCH_ELEMENTS = 1 << 17


@dataclass(frozen=True, slots=True)
class Observed:
    """Distinct levels, ascending; `trials` has the answers of each level, or is None where all are 0 or 1."""

    level: Array
    n_trials: npt.NDArray[np.int64]
    p_correct: Array
    trials: list[Array] | None

    def moments(self, fitted: Array) -> tuple[Array, Array]:
        """Second and third moment of one trial's answer about the curve, at each level."""
        if self.trials is None:
            return fitted * (1 - fitted), fitted * (1 - fitted) * (1 - 2 * fitted)
        residual = [answers - p for answers, p in zip(self.trials, fitted, strict=True)]
        return np.array([np.mean(r**2) for r in residual]), np.array([np.mean(r**3) for r in residual])

    def dispersion(self, fitted: Array) -> float:
        """Variance of an answer as a share of p(1 − p), which no answer in [0, 1] exceeds; 1 if not known."""
        n, n_parameters = self.n_trials.sum(), 3
        if self.trials is None or n <= n_parameters:
            return 1.0
        most = (self.n_trials * fitted * (1 - fitted)).sum()
        share = (self.n_trials * self.moments(fitted)[0]).sum() / max(most, 1e-300)
        return float(np.clip(share * n / (n - n_parameters), 1e-12, 1 - 1e-6))

    def spread_within(self, fitted: Array) -> tuple[float, float]:
        """Variance of an answer about its level's mean as a share of p(1 − p), and its degrees of freedom."""
        if self.trials is None:
            # Binomial, but for single trials a level, whose squared residuals are nowhere near Gaussian.
            return 1.0, math.inf if self.n_trials.mean() >= 5 else 0.0
        squares = sum(float(np.square(answers - answers.mean()).sum()) for answers in self.trials)
        most = ((self.n_trials - 1) * fitted * (1 - fitted)).sum()
        return max(squares / max(most, 1e-300), 1e-300), float((self.n_trials - 1).sum())

    def resample(self, fitted: Array, guess_rate: float, size: int, rng: np.random.Generator) -> Array:
        """Proportions correct of `size` repeated experiments, (experiment, level)."""
        if self.trials is None:
            n, n_trials = self.n_trials, self.n_trials.sum()
            p = (n * self.p_correct + _CURVE_TRIALS * fitted) / (n + _CURVE_TRIALS)
            p = (n_trials * p + _PLUS_TRIALS * (1 + guess_rate) / 2) / (n_trials + _PLUS_TRIALS)
            return rng.binomial(n, p, (size, len(p))) / n
        drawn = np.empty((size, len(fitted)))
        freedom = max(self.n_trials.sum() - 3, 1)
        share = np.minimum(self.dispersion(fitted) * freedom / rng.chisquare(freedom, size), 1 - 1e-6)
        for level, answers in enumerate(self.trials):
            if len(answers) > 1:
                spread = _resampled_means(answers, size, rng) - answers.mean()
                freedom = len(answers) - 1
                drawn[:, level] = answers.mean() + spread * np.sqrt(freedom / rng.chisquare(freedom, size))
            else:
                p = np.clip(fitted[level], 1e-9, 1 - 1e-9)
                drawn[:, level] = rng.beta(p * (1 / share - 1), (1 - p) * (1 / share - 1))
        return np.clip(drawn, 0.0, 1.0)


def _resampled_means(answers: Array, size: int, rng: np.random.Generator) -> Array:
    """Means of `size` draws of all answers but one, with replacement; in batches, for there may be many."""
    count = len(answers) - 1
    batch = max(1, _BATCH_ELEMENTS // count)
    sizes = [min(batch, size - start) for start in range(0, size, batch)]
    return np.concatenate([answers[rng.integers(len(answers), size=(n, count))].mean(axis=1) for n in sizes])


def threshold_interval(
    model: WeibullModel, theta: Array, loglik: float, observed: Observed, resamples: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Bounds of ln x_c by BCa (Efron 1987), acceleration as for several samples (Davison & Hinkley 1997, 5.3).

    Where a step anywhere between two levels is as likely as the curve (likelihood ratio), the interval spans them.
    """
    right, weight = model.influence(theta)
    second, third = observed.moments(right)
    estimate = float(model.ln_threshold(theta[None])[0])
    draws = model.ln_threshold(model.fit_many(observed.resample(right, model.guess_rate, resamples, rng)))
    below = np.mean(draws < estimate - 1e-9) + np.mean(np.abs(draws - estimate) <= 1e-9) / 2
    bias = ndtri(np.clip(below, 0.5 / resamples, 1 - 0.5 / resamples))
    relative = weight / max(np.abs(weight).max(), 1e-300)
    variance = (observed.n_trials * relative**2 * second).sum()
    skew = (observed.n_trials * relative**3 * third).sum()
    acceleration = np.clip(skew / max(6 * variance**1.5, 1e-300), -0.1, 0.1)
    tails = bias + _Z_95 * np.array([-1.0, 1.0])
    ranks = ndtr(bias + tails / np.maximum(1 - acceleration * tails, 0.1)) * (resamples + 1)
    draws.sort()
    low = min(draws[max(math.floor(ranks[0]) - 1, 0)], estimate)
    high = max(draws[min(math.ceil(ranks[1]) - 1, resamples - 1)], estimate)
    after = int(np.searchsorted(model.z, estimate))
    if 0 < after < len(model.z):
        step = np.where(np.arange(len(model.z)) < after, model.guess_rate, 1 - theta[2])
        answers = observed.p_correct
        step_loglik = (model.n_trials * (xlogy(answers, step) + xlogy(1 - answers, 1 - step))).sum()
        if 2 * (loglik - step_loglik) <= _CHI2_95 * observed.dispersion(right):
            low, high = min(low, model.z[after - 1]), max(high, model.z[after])
    return float(low), float(high)


def crossing_of_points(model: WeibullModel, theta: Array, observed: Observed) -> tuple[float, float] | None:
    """Where the points cross the criterion if they do not fit the curve, and the half-width of its 95 % interval.

    The curve is corrected by its residuals, linear between levels, and followed to the criterion to first order;
    both results are in ln level about the centre. None where an F test at 5 % (Fisher 1925) does not tell points
    from curve, where the threshold lies outside of the levels, or with too few trials to know their spread.
    """
    right = model.curves(theta[None], model.z)[0][0]
    estimate = float(model.ln_threshold(theta[None])[0])
    n_free = int((model.lower < model.upper).sum())
    freedom = len(model.z) - n_free
    spread, spread_freedom = observed.spread_within(right)
    if freedom < 1 or spread_freedom < 5 or not model.z[0] <= estimate <= model.z[-1]:
        return None
    residual = observed.p_correct - right
    variance = np.maximum(right * (1 - right), 1e-12) * spread / observed.n_trials
    if not (residual**2 / variance).sum() / freedom > fdtri(freedom, spread_freedom, 0.95):
        return None
    after = max(int(np.searchsorted(model.z, estimate)), 1)
    pair = slice(after - 1, after + 1)
    share = (estimate - model.z[after - 1]) / (model.z[after] - model.z[after - 1])
    weight = np.array([1 - share, share])
    steepness = -float(model.curves(theta[None], np.array([estimate]))[2][0, 0, 0])
    shift = -float(weight @ residual[pair]) / steepness
    half_width = _Z_95 * math.sqrt(float(weight**2 @ variance[pair])) / steepness
    return estimate + shift, half_width
