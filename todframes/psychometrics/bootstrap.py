"""Repeated experiments: the resampler of all intervals of thresholds and of their ratios.

The answers of several series to the same trials are drawn together. Two ways of showing a frame share the frame's
noise, the triangle's place and the observer's own noise, which move both thresholds in the same way.

Trials on the same background share more: an algorithm may help on it and not on another. Backgrounds are then a
random effect: they are drawn with all of their trials, the same ones for all series. Trials are not drawn again
within them: the spread of the backgrounds' means has that noise in it already, and would have it twice.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from todframes.base._typing import FloatArray
from todframes.psychometrics.curves import CHI2_95, CurveModel, binomial_loglik

NORMAL_95 = 1.959963984540054
"""Half-width of the central 95 % of a standard normal distribution."""

CURVE_TRIALS, PLUS_TRIALS = 5, 4
"""Trials of the fitted curve that are added to each level with answers of 0 and 1, and trials right by (1 + γ)/2
that are added to the experiment: levels without errors vary too."""

FREE_PARAMETERS = 3

ANSWER_TOLERANCE, PROBABILITY_TOLERANCE = 1e-4, 1e-8
"""Tolerances in log-likelihood of fits to repeated experiments: their square root is 1 % of a standard error, that
of answers of 0 and 1, or of probabilities that vary a hundred times less."""

MOST_BACKGROUNDS = 200
"""Largest number of backgrounds that are drawn one by one; more are drawn in so many sets."""

_BATCH_ELEMENTS = 1 << 17

T = TypeVar("T", bound=np.generic)


@dataclass(frozen=True, slots=True)
class Observed:
    """The answers of one series: distinct levels, ascending, and the answers at each, or None for counts alone.
    `are_probabilities` states whether an answer is neither 0 nor 1.
    """

    level: FloatArray
    n_trials: NDArray[np.int64]
    p_correct: FloatArray
    trials: list[FloatArray] | None
    are_probabilities: bool

    @classmethod
    def of_trials(cls, level: FloatArray, p_correct: FloatArray, order: NDArray[np.intp]) -> Observed:
        """Return the answers to trials in an order of ascending levels."""
        distinct, n_trials = np.unique(level, return_counts=True)
        trials = by_level(p_correct, n_trials, order)
        means = np.array([answers.mean() for answers in trials])
        return cls(distinct, n_trials, means, trials, bool(np.any((p_correct > 0) & (p_correct < 1))))

    def moments(self, fitted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute the second and third moment of one trial's answer about the curve, at each level."""
        if self.trials is None or not self.are_probabilities:
            return fitted * (1 - fitted), fitted * (1 - fitted) * (1 - 2 * fitted)
        residual = [answers - p for answers, p in zip(self.trials, fitted, strict=True)]
        return np.array([np.mean(r**2) for r in residual]), np.array([np.mean(r**3) for r in residual])

    def dispersion(self, fitted: FloatArray) -> float:
        """Compute the variance of an answer as a share of p(1 − p), its largest possible value; 1 if not known."""
        n = self.n_trials.sum()
        if not self.are_probabilities or n <= FREE_PARAMETERS:
            return 1.0
        largest = (self.n_trials * fitted * (1 - fitted)).sum()
        share = (self.n_trials * self.moments(fitted)[0]).sum() / max(largest, 1e-300)
        return float(np.clip(share * n / (n - FREE_PARAMETERS), 1e-12, 1 - 1e-6))

    def falls_through(self, p_correct: float) -> bool:
        """Return whether answers fall with the level, from above a proportion to below it, beyond three standard
        errors of their trend.
        """
        if not self.p_correct[0] > p_correct > self.p_correct[-1]:
            return False
        mean = np.average(self.p_correct, weights=self.n_trials)
        away = np.log(self.level) - np.average(np.log(self.level), weights=self.n_trials)
        trend, variance = self.n_trials * away @ self.p_correct, mean * (1 - mean) * self.n_trials @ away**2
        return bool(trend < -3.0 * math.sqrt(variance))

    @property
    def tolerance(self) -> float:
        """Tolerance of fits to repeated experiments."""
        return PROBABILITY_TOLERANCE if self.are_probabilities else ANSWER_TOLERANCE

    @property
    def shows_its_own_curve(self) -> bool:
        """True if there are enough points, and these are exact enough, to be followed without a fitted curve."""
        return self.are_probabilities and len(self.level) >= 3 and bool(self.n_trials.mean() >= 3)


def by_level(values: NDArray[T], n_trials: NDArray[np.int64], order: NDArray[np.intp]) -> list[NDArray[T]]:
    """Split values of trials at the levels, in an order of ascending levels."""
    return np.split(values[order], np.cumsum(n_trials)[:-1])


def redrawn(
    series: Sequence[Observed],
    curves: FloatArray,
    size: int,
    rng: np.random.Generator,
    *,
    guess_rate: float,
    each_level: bool = False,
) -> FloatArray:
    """Draw the proportions correct of repeated experiments, (series, experiment, level). All series are answers to
    the same trials, in the same order; `curves`, (series, level), are fitted to them. `each_level` states whether
    a threshold rests on single levels, as a crossing of the points does, and not on a fitted curve.
    """
    if not any(observed.are_probabilities for observed in series):
        return _redrawn_answers(series, curves, guess_rate, size, rng)
    return _redrawn_probabilities(series, curves, size, rng, each_level=each_level)


def _redrawn_answers(
    series: Sequence[Observed], curves: FloatArray, guess_rate: float, size: int, rng: np.random.Generator
) -> FloatArray:
    """Draw answers of 0 and 1 from the shares of right answers, mixed with the curve and with (1 + γ)/2. The
    answers of another series are drawn given those of the first, so that they agree as often as those shown.
    """
    n = series[0].n_trials
    n_all = n.sum()
    p = np.array(
        [
            (n * observed.p_correct + CURVE_TRIALS * curve) / (n + CURVE_TRIALS)
            for observed, curve in zip(series, curves, strict=True)
        ]
    )
    p = (n_all * p + PLUS_TRIALS * (1 + guess_rate) / 2) / (n_all + PLUS_TRIALS)
    # Of 2^53 trials, all of them right, a rounding leaves p above 1.
    p = np.minimum(p, 1.0)
    first = rng.binomial(n, p[0], (size, len(n)))
    drawn = [first]
    shown = n / (n + CURVE_TRIALS) * n_all / (n_all + PLUS_TRIALS)
    for k in range(1, len(series)):
        both_shown, agreement = _agreement(series[0], series[k], curves[0], curves[k])
        rest, other = ((p[j] - shown * series[j].p_correct) / (1 - shown) for j in (0, k))
        both_drawn = agreement * np.minimum(rest, other) + (1 - agreement) * rest * other
        both = shown * both_shown + (1 - shown) * both_drawn
        if_right = np.clip(both / p[0], 0.0, 1.0)
        if_wrong = np.clip((p[k] - both) / (1 - p[0]), 0.0, 1.0)
        drawn.append(rng.binomial(first, if_right) + rng.binomial(n - first, if_wrong))
    return np.array(drawn) / n


def _agreement(
    first: Observed, other: Observed, curve: FloatArray, other_curve: FloatArray
) -> tuple[FloatArray, float]:
    """Return the share of trials that are right in two series, at each level, and the agreement of their answers.
    The agreement is 0 for independent answers, and 1 for the largest possible. Curves lie between 0 and 1.
    """
    assert first.trials is not None and other.trials is not None
    both = np.array([np.mean(a * b) for a, b in zip(first.trials, other.trials, strict=True)])
    unlike = (first.p_correct + other.p_correct - 2 * both) @ first.n_trials
    independent = (other_curve * (1 - curve) + curve * (1 - other_curve)) @ first.n_trials
    least = np.abs(other_curve - curve) @ first.n_trials
    return both, float(np.clip((independent - unlike) / (independent - least), 0.0, 1.0))


def _redrawn_probabilities(
    series: Sequence[Observed], curves: FloatArray, size: int, rng: np.random.Generator, *, each_level: bool
) -> FloatArray:
    """Draw the mean probabilities of each level's trials, n − 1 of n, the same ones for all series. That makes
    their variance unbiased (McCarthy & Snowden 1985). The variance is an estimate, so deviations are stretched by
    √(ν/χ²) (Student 1908). With `each_level`, ν is that of the level; otherwise it is a third of that of the
    experiment, because the threshold of a curve rests on the levels about it. A level with a single trial is drawn
    from the distances of all trials from the curve, in units of √p(1 − p) (McCullagh & Nelder 1989, chapter 9).
    With three trials or fewer in all, answers of 0 and 1 are drawn: no others with these means vary more.
    """
    n_trials = series[0].n_trials
    n_all = int(n_trials.sum())
    of_curve = max((n_all - FREE_PARAMETERS) / 3.0, 1.0)
    freedom = np.where(n_trials > 1, n_trials - 1.0, of_curve) if each_level else np.array([of_curve])
    stretch = np.sqrt(freedom / rng.chisquare(freedom, (size, len(freedom))))
    stretch = np.broadcast_to(stretch, (size, len(n_trials)))
    unbiased = math.sqrt(n_all / max(n_all - FREE_PARAMETERS, 1))
    unit = np.sqrt(curves * (1 - curves))
    trials = [observed.trials or [] for observed in series]
    answers = [np.array([of_series[level] for of_series in trials]) for level in range(len(n_trials))]
    residuals = np.concatenate(
        [(a - curves[:, [k]]) / np.maximum(unit[:, [k]], 1e-300) for k, a in enumerate(answers)], axis=1
    )
    drawn = np.empty((len(series), size, len(n_trials)))
    for level, n in enumerate(n_trials.tolist()):
        if n > 1:
            mean = answers[level].mean(axis=1)[:, None]
            spread = resampled_means(answers[level], size, rng) - mean
            drawn[..., level] = mean + spread * stretch[:, level]
        elif n_all > FREE_PARAMETERS:
            residual = residuals[:, rng.integers(n_all, size=size)]
            drawn[..., level] = curves[:, [level]] + unit[:, [level]] * residual * unbiased * stretch[:, level]
        else:
            drawn[..., level] = rng.random(size) < curves[:, [level]]
    return np.clip(drawn, 0.0, 1.0)


def resampled_means(answers: FloatArray, size: int, rng: np.random.Generator) -> FloatArray:
    """Draw means of all answers but one, `size` times with replacement, in batches because there may be many.
    Answers lie along the last axis, draws along that of the result; those on other axes are drawn together.
    """
    n_trials = answers.shape[-1]
    batch = max(1, _BATCH_ELEMENTS // (n_trials - 1))
    sizes = [min(batch, size - start) for start in range(0, size, batch)]
    chosen = (rng.integers(n_trials, size=(n, n_trials - 1)) for n in sizes)
    return np.concatenate([answers[..., rows].mean(axis=-1) for rows in chosen], -1)


class BackgroundDraws(NamedTuple):
    """Draws of backgrounds in repeated experiments. `weights`, (resample, background), are the numbers of times
    that each is drawn. `widening`, (resample,), are factors that make normal deviates those of Student's t, with a
    degree of freedom less than there are backgrounds: of eight, the spread is known to 27 % only.
    """

    weights: FloatArray
    widening: FloatArray


def sets_of_backgrounds(numbers: NDArray[np.integer]) -> NDArray[np.intp]:
    """Return the number of the set that each background, by its number, is drawn with: its own up to 200."""
    return np.asarray(numbers % MOST_BACKGROUNDS, np.intp)


def draw_backgrounds(n_backgrounds: int, resamples: int, rng: np.random.Generator) -> BackgroundDraws | None:
    """Draw all backgrounds but one with replacement: so many have the variance of the mean of all. None for one
    background: how others differ from it is not known.
    """
    if n_backgrounds < 2:
        return None
    freedom = n_backgrounds - 1
    weights = rng.multinomial(freedom, np.full(n_backgrounds, 1.0 / n_backgrounds), size=resamples)
    return BackgroundDraws(weights.astype(np.float64), np.sqrt(freedom / rng.chisquare(freedom, resamples)))


def on_drawn_backgrounds(
    series: Sequence[Observed], curves: FloatArray, backgrounds: Sequence[NDArray[np.integer]], weights: FloatArray
) -> FloatArray:
    """Compute the mean answers of repeated experiments with drawn backgrounds, (series, experiment, level).
    `backgrounds` are those of the trials of each level. A level without a trial on any drawn background keeps the
    mean of all of its trials. Levels with answers of 0 and 1 have trials of the fitted curve besides, or levels
    without errors would not vary.
    """
    curve_trials = 0 if any(observed.are_probabilities for observed in series) else CURVE_TRIALS
    drawn = np.empty((len(series), len(weights), len(backgrounds)))
    for level, numbers in enumerate(backgrounds):
        n, most = len(numbers), weights.shape[1]
        n_drawn = weights @ np.bincount(numbers, minlength=most)
        for k, observed in enumerate(series):
            assert observed.trials is not None
            sums = weights @ np.bincount(numbers, observed.trials[level], minlength=most)
            means = np.divide(
                sums, n_drawn, out=np.full(len(weights), observed.p_correct[level]), where=n_drawn > 0.0
            )
            drawn[k, :, level] = (n * means + curve_trials * curves[k, level]) / (n + curve_trials)
    return np.clip(drawn, 0.0, 1.0)


def interval_of_draws(
    ln_values: FloatArray, estimates: Sequence[float], tails: tuple[float, float] = (0.025, 0.975)
) -> tuple[float, float]:
    """Return the values of two ranks among draws, extended to some estimates."""
    ranked, n = np.sort(ln_values), len(ln_values)
    low = float(ranked[max(math.floor(tails[0] * (n + 1)) - 1, 0)])
    high = float(ranked[min(math.ceil(tails[1] * (n + 1)) - 1, n - 1)])
    return min(low, *estimates), max(high, *estimates)


def threshold_interval(
    model: CurveModel,
    theta: FloatArray,
    loglik: float,
    observed: Observed,
    resamples: int,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """Bound ln x_c by BCa (Efron 1987), acceleration as for several samples (Davison & Hinkley 1997, 5.3). The
    interval also covers thresholds that the likelihood ratio does not reject: those of a step anywhere between two
    levels, and of curves of any slope where few levels are shown, as experiments repeated about a step are steps
    again. If the points show their own curve, and the fitted one is a convention, the interval is that of the
    level at which the points cross the criterion, extended to the fitted threshold.
    """
    right, weight = model.influence(theta)
    second, third = observed.moments(right)
    estimate = float(model.ln_threshold(theta[None])[0])
    follows_points = observed.shows_its_own_curve and model.is_convention
    (repeated,) = redrawn(
        [observed], right[None], resamples, rng, guess_rate=model.guess_rate, each_level=follows_points
    )
    if follows_points:
        return interval_of_draws(crossing_of_points(model, theta, repeated), [estimate])
    if observed.shows_its_own_curve:
        starts = np.tile(theta, (resamples, 1))  # all repeated experiments are near this one
        curves, _ = model.climb(starts, repeated, tolerance=observed.tolerance, steps=25)
    else:
        curves = model.fit_many(repeated, tolerance=observed.tolerance)
    draws = model.ln_threshold(curves)
    below = np.mean(draws < estimate - 1e-9) + np.mean(np.abs(draws - estimate) <= 1e-9) / 2
    bias = NormalDist().inv_cdf(float(np.clip(below, 0.5 / resamples, 1 - 0.5 / resamples)))
    relative = weight / max(np.abs(weight).max(), 1e-300)
    variance = (observed.n_trials * relative**2 * second).sum()
    skew = (observed.n_trials * relative**3 * third).sum()
    acceleration = np.clip(skew / max(6 * variance**1.5, 1e-300), -0.1, 0.1)
    tails = bias + NORMAL_95 * np.array([-1.0, 1.0])
    low_tail, high_tail = ndtr(bias + tails / np.maximum(1 - acceleration * tails, 0.1)).tolist()
    low, high = interval_of_draws(draws, [estimate], (low_tail, high_tail))
    after = int(np.searchsorted(model.z, estimate))
    if 0 < after < len(model.z):
        step = np.where(np.arange(len(model.z)) < after, model.guess_rate, model.ceiling(theta))
        step_loglik = (model.n_trials * binomial_loglik(observed.p_correct, step)).sum()
        if 2 * (loglik - step_loglik) <= CHI2_95 * observed.dispersion(right):
            low, high = min(low, model.z[after - 1]), max(high, model.z[after])
    if not observed.are_probabilities or model.is_step(theta):
        likely_low, likely_high = model.likely_thresholds(theta, observed.p_correct, observed.dispersion(right))
        low, high = min(low, likely_low), max(high, likely_high)
    return float(low), float(high)


def background_draws(
    model: CurveModel,
    theta: FloatArray,
    observed: Observed,
    backgrounds: list[NDArray[np.intp]],
    drawn: BackgroundDraws,
) -> FloatArray:
    """Draw the ln threshold of experiments on other backgrounds, about the centre, with Student's spread."""
    right, _, _ = model.curves(theta[None], model.z)
    (repeated,) = on_drawn_backgrounds([observed], right, backgrounds, drawn.weights)
    draws = model.thresholds_within_reach(model.fit_many(repeated, tolerance=observed.tolerance))
    estimate = model.ln_threshold(theta[None])
    return np.asarray(estimate + (draws - estimate) * drawn.widening)


def crossing_of_points(model: CurveModel, theta: FloatArray, proportions: FloatArray) -> FloatArray:
    """Find where the points themselves, (experiment, level), cross the criterion, upwards and nearest to the
    fitted threshold: ln level about the centre, −∞ or ∞ where all points lie above or below the criterion.
    Monotone cubic interpolation (Fritsch & Butland 1984) of ln(−ln(1 − F)), F = (p − γ)/(1 − γ), against ln level:
    a Weibull curve without lapses is a straight line there, other psychometric functions are nearly one.
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
