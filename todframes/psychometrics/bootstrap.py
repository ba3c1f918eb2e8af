"""Bootstrap interval of a threshold over trials, for the fitted curve and for the points themselves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from todframes.base._typing import FloatArray
from todframes.psychometrics.likelihood import CHI2_95, CurveModel, binomial_loglik

NORMAL_95 = 1.959963984540054
"""Half-width of the central 95 % of a standard normal distribution."""
CURVE_TRIALS = 5
PLUS_TRIALS = 4
ANSWER_TOLERANCE, PROBABILITY_TOLERANCE = 1e-4, 1e-8
"""Tolerances in log-likelihood of fits to repeated experiments: their square root is 1 % of a standard error, that
of answers of 0 and 1, or of probabilities that vary a hundred times less."""

_BATCH_ELEMENTS = 1 << 17


@dataclass(frozen=True, slots=True)
class Observed:
    """Distinct levels, ascending; `trials` has the answers of each level, or is None where all are 0 or 1."""

    level: FloatArray
    n_trials: NDArray[np.int64]
    p_correct: FloatArray
    trials: list[FloatArray] | None

    def moments(self, fitted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute the second and third moment of one trial's answer about the curve, at each level."""
        if self.trials is None:
            return fitted * (1 - fitted), fitted * (1 - fitted) * (1 - 2 * fitted)
        residual = [answers - p for answers, p in zip(self.trials, fitted, strict=True)]
        return np.array([np.mean(r**2) for r in residual]), np.array([np.mean(r**3) for r in residual])

    def dispersion(self, fitted: FloatArray) -> float:
        """Compute the variance of an answer as a share of p(1 − p), its largest possible value; 1 if not known."""
        n, n_parameters = self.n_trials.sum(), 3
        if self.trials is None or n <= n_parameters:
            return 1.0
        largest = (self.n_trials * fitted * (1 - fitted)).sum()
        share = (self.n_trials * self.moments(fitted)[0]).sum() / max(largest, 1e-300)
        return float(np.clip(share * n / (n - n_parameters), 1e-12, 1 - 1e-6))

    @property
    def shows_its_own_curve(self) -> bool:
        """True if there are enough points, and these are exact enough, to be followed without a fitted curve."""
        return self.trials is not None and len(self.level) >= 3 and bool(self.n_trials.mean() >= 3)

    def resample(self, fitted: FloatArray, guess_rate: float, size: int, rng: np.random.Generator) -> FloatArray:
        """Draw the proportions correct of `size` repeated experiments, (experiment, level)."""
        if self.trials is None:
            n, n_trials = self.n_trials, self.n_trials.sum()
            p = (n * self.p_correct + CURVE_TRIALS * fitted) / (n + CURVE_TRIALS)
            p = (n_trials * p + PLUS_TRIALS * (1 + guess_rate) / 2) / (n_trials + PLUS_TRIALS)
            # Of 2^53 trials, all of them right, a rounding leaves p above 1.
            return rng.binomial(n, np.minimum(p, 1.0), (size, len(p))) / n
        drawn = np.empty((size, len(fitted)))
        freedom = max(self.n_trials.sum() - 3, 1)
        share = np.minimum(self.dispersion(fitted) * freedom / rng.chisquare(freedom, size), 1 - 1e-6)
        for level, answers in enumerate(self.trials):
            if len(answers) > 1:
                spread = resampled_means(answers, size, rng) - answers.mean()
                freedom = len(answers) - 1
                drawn[:, level] = answers.mean() + spread * np.sqrt(freedom / rng.chisquare(freedom, size))
            else:
                p = np.clip(fitted[level], 1e-9, 1 - 1e-9)
                drawn[:, level] = rng.beta(p * (1 / share - 1), (1 - p) * (1 / share - 1))
        return np.clip(drawn, 0.0, 1.0)


def resampled_means(answers: FloatArray, size: int, rng: np.random.Generator) -> FloatArray:
    """Draw means of all answers but one, `size` times with replacement, in batches because there may be many.

    Answers lie along the last axis, draws along that of the result; those on other axes are drawn together.
    """
    n_trials = answers.shape[-1]
    shapes = [(n, n_trials - 1) for n in batches(size, n_trials - 1)]
    return np.concatenate([answers[..., rng.integers(n_trials, size=shape)].mean(axis=-1) for shape in shapes], -1)


def batches(size: int, n_elements: int) -> list[int]:
    """Split `size` into parts, so that arrays of `n_elements` for each in a part stay small."""
    batch = max(1, _BATCH_ELEMENTS // n_elements)
    return [min(batch, size - start) for start in range(0, size, batch)]


def threshold_interval(
    model: CurveModel,
    theta: FloatArray,
    loglik: float,
    observed: Observed,
    resamples: int,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Bound ln x_c by BCa (Efron 1987), acceleration as for several samples (Davison & Hinkley 1997, 5.3).

    Where a step anywhere between two levels is as likely as the curve (likelihood ratio), the interval spans them.
    If the points show their own curve, and the fitted one is a convention, the interval is that of the level at
    which the points cross the criterion, extended to the fitted threshold.
    """
    right, weight = model.influence(theta)
    second, third = observed.moments(right)
    estimate = float(model.ln_threshold(theta[None])[0])
    repeated = observed.resample(right, model.guess_rate, resamples, rng)
    if observed.shows_its_own_curve and model.is_convention:
        crossings = np.sort(crossing_of_points(model, theta, repeated))
        low = crossings[max(math.floor(0.025 * (resamples + 1)) - 1, 0)]
        high = crossings[min(math.ceil(0.975 * (resamples + 1)) - 1, resamples - 1)]
        return min(float(low), estimate), max(float(high), estimate)
    if observed.shows_its_own_curve:
        starts = np.tile(theta, (resamples, 1))  # all repeated experiments are near this one
        curves, _ = model.climb(starts, repeated, tolerance=PROBABILITY_TOLERANCE, steps=25)
    else:
        curves = model.fit_many(repeated, tolerance=ANSWER_TOLERANCE)
    draws = model.ln_threshold(curves)
    below = np.mean(draws < estimate - 1e-9) + np.mean(np.abs(draws - estimate) <= 1e-9) / 2
    bias = NormalDist().inv_cdf(float(np.clip(below, 0.5 / resamples, 1 - 0.5 / resamples)))
    relative = weight / max(np.abs(weight).max(), 1e-300)
    variance = (observed.n_trials * relative**2 * second).sum()
    skew = (observed.n_trials * relative**3 * third).sum()
    acceleration = np.clip(skew / max(6 * variance**1.5, 1e-300), -0.1, 0.1)
    tails = bias + NORMAL_95 * np.array([-1.0, 1.0])
    ranks = ndtr(bias + tails / np.maximum(1 - acceleration * tails, 0.1)) * (resamples + 1)
    draws.sort()
    low = min(draws[max(math.floor(ranks[0]) - 1, 0)], estimate)
    high = max(draws[min(math.ceil(ranks[1]) - 1, resamples - 1)], estimate)
    after = int(np.searchsorted(model.z, estimate))
    if 0 < after < len(model.z):
        step = np.where(np.arange(len(model.z)) < after, model.guess_rate, model.ceiling(theta))
        step_loglik = (model.n_trials * binomial_loglik(observed.p_correct, step)).sum()
        if 2 * (loglik - step_loglik) <= CHI2_95 * observed.dispersion(right):
            low, high = min(low, model.z[after - 1]), max(high, model.z[after])
    return float(low), float(high)


def crossing_of_points(model: CurveModel, theta: FloatArray, proportions: FloatArray) -> FloatArray:
    """Find where the points themselves cross the criterion, upwards and nearest to the fitted threshold.

    Monotone cubic interpolation (Fritsch & Butland 1984) of ln(−ln(1 − F)), F = (p − γ)/(1 − γ), against ln level:
    a Weibull curve without lapses is a straight line there, other psychometric functions are nearly one.

    Parameters
    ----------
    proportions : ndarray, shape (experiment, level)

    Returns
    -------
    ndarray, shape (experiment,)
        ln level about the centre; −∞ or ∞ where all points lie above or below the criterion.
    """
    z, guess_rate = model.z, model.guess_rate

    def link(p: FloatArray | float) -> FloatArray:
        return np.log(-np.log1p(-np.clip((np.asarray(p) - guess_rate) / (1 - guess_rate), 1e-9, 1 - 1e-9)))

    y = link(proportions) - link(model.p_correct)
    width = np.diff(z)
    secant = np.diff(y) / width
    slope = _monotone_slopes(width, secant)
    rising = (y[:, :-1] < 0) & (y[:, 1:] >= 0)
    distance = np.abs((z[1:] + z[:-1]) / 2 - float(model.ln_threshold(theta[None])[0]))
    piece = np.where(rising, distance, np.inf).argmin(axis=1)
    rows = np.arange(len(y))
    left, right = y[rows, piece], y[rows, piece + 1]
    left_slope, right_slope = (width[piece] * slope[rows, piece + k] for k in (0, 1))
    low, high = np.zeros(len(y)), np.ones(len(y))
    for _ in range(50):
        t = (low + high) / 2
        hermite = (1 + 2 * t) * (1 - t) ** 2 * left + t**2 * (3 - 2 * t) * right
        hermite += t * (1 - t) * ((1 - t) * left_slope - t * right_slope)
        low, high = np.where(hermite < 0, t, low), np.where(hermite < 0, high, t)
    crossing = z[piece] + width[piece] * (low + high) / 2
    outside = np.where(y[:, -1] < 0, np.inf, -np.inf)
    return np.where(rising.any(axis=1), crossing, outside)


def _monotone_slopes(width: FloatArray, secant: FloatArray) -> FloatArray:
    """Compute the slopes at the points, (experiment, level), of a monotone cubic interpolation."""
    before, after = secant[:, :-1], secant[:, 1:]
    first, last = 2 * width[1:] + width[:-1], width[1:] + 2 * width[:-1]
    same = before * after > 0
    harmonic = (first + last) / (first / np.where(same, before, 1.0) + last / np.where(same, after, 1.0))
    slope = np.empty((len(secant), len(width) + 1))
    slope[:, 1:-1] = np.where(same, harmonic, 0.0)
    for end, step in ((0, 1), (-1, -1)):
        h0, h1 = width[end], width[end + step]
        d0, d1 = secant[:, end], secant[:, end + step]
        outer = ((2 * h0 + h1) * d0 - h0 * d1) / (h0 + h1)
        outer = np.where(outer * d0 <= 0, 0.0, outer)
        slope[:, end] = np.where((d0 * d1 <= 0) & (np.abs(outer) > 3 * np.abs(d0)), 3 * d0, outer)
    return slope
