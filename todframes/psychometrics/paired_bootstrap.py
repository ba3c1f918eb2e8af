"""Interval of the ratio of two thresholds from the same trials, by a bootstrap over pairs of answers.

Two ways of showing a frame share the frame's noise, the triangle's place and the observer's own noise. These move
both thresholds in the same way. Answers to one trial are therefore always drawn together.

Trials on the same background share more: an algorithm may help on it and not on another. Backgrounds are then a
random effect: they are drawn with all of their trials, the same ones in all groups. Trials are not drawn again
within them: the spread of the backgrounds' means has that noise in it already, and would have it twice. The
interval of a single threshold takes backgrounds in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.base._typing import FloatArray
from todframes.parameters import CurveName
from todframes.psychometrics.bootstrap import (
    ANSWER_TOLERANCE,
    CURVE_TRIALS,
    PLUS_TRIALS,
    PROBABILITY_TOLERANCE,
    Observed,
    batches,
    resampled_means,
)
from todframes.psychometrics.fit import (
    EXTRAPOLATION_FACTOR,
    FitSettings,
    PsychometricFit,
    curve_model,
)
from todframes.psychometrics.likelihood import CurveModel
from todframes.psychometrics.observer_curve import observer_curve
from todframes.psychometrics.weibull import weibull

MOST_BACKGROUNDS = 200
"""Largest number of backgrounds that are drawn one by one; more are drawn in so many sets."""

SAME = 0.01
"""Largest |ln ratio| that counts as a ratio of 1: a person does not notice 1 %, and fitted curves are not more
exact."""


class RatioDraws(NamedTuple):
    """A threshold divided by the reference's, and the same in repeated experiments.

    `ratio` is that of the fitted thresholds, `points_ratio` that of the points' own crossings; None where one of
    the two thresholds does not exist, and `points_ratio` where the curve is no convention. `ln_ratios` has shape
    (resample,): −∞ or ∞ where only one experiment has a threshold within reach, 0 where neither has.
    """

    ratio: float | None
    points_ratio: float | None
    ln_ratios: FloatArray


class ThresholdRatio(NamedTuple):
    """A ratio of thresholds, its 95 % interval, and the p-value of it being within 1 % of 1.

    Without a ratio there is no interval; an end of it is None where the data leave it open. The p-value is
    two-sided and not below 2 / (resamples + 1). `is_lower` states whether the ratio is below 1 in more experiments
    than above.
    """

    ratio: float | None
    ratio_ci95: tuple[float | None, float | None] | None
    p_value: float
    is_lower: bool


class BackgroundDraws(NamedTuple):
    """Draws of backgrounds in repeated experiments.

    `weights`, (resample, background), are the numbers of times that each is drawn. `widening`, (resample,), are
    factors that make normal deviates those of Student's t, with a degree of freedom less than there are
    backgrounds: of eight, the spread is known to 27 % only.
    """

    weights: FloatArray
    widening: FloatArray


def sets_of_backgrounds(numbers: NDArray[np.integer]) -> NDArray[np.intp]:
    """Return the number of the set that each background, by its number, is drawn with: its own up to 200."""
    return np.asarray(numbers % MOST_BACKGROUNDS, np.intp)


def draw_backgrounds(n_backgrounds: int, resamples: int, rng: np.random.Generator) -> BackgroundDraws | None:
    """Draw all backgrounds but one with replacement: so many have the variance of the mean of all.

    None for one background: how others differ from it is not known.
    """
    if n_backgrounds < 2:
        return None
    freedom = n_backgrounds - 1
    weights = rng.multinomial(freedom, np.full(n_backgrounds, 1.0 / n_backgrounds), size=resamples)
    return BackgroundDraws(weights.astype(np.float64), np.sqrt(freedom / rng.chisquare(freedom, resamples)))


def ratio_draws(
    level: FloatArray,
    p_correct: FloatArray,
    fits: Sequence[PsychometricFit],
    *,
    pairs: Sequence[tuple[int, int]],
    settings: FitSettings,
    rng: np.random.Generator,
    backgrounds: NDArray[np.integer] | None = None,
    drawn_backgrounds: BackgroundDraws | None = None,
) -> list[RatioDraws]:
    """Compare the thresholds of pairs of series of answers to the same trials.

    In each repeated experiment the trials of a level are drawn with replacement, the same ones for all series, and
    curves are fitted to all. If the trials' backgrounds are given, these are drawn in place of trials.

    Parameters
    ----------
    level : ndarray, shape (trial,)
    p_correct : ndarray, shape (series, trial)
        0 or 1 where an answer was drawn, or the probability in [0, 1] that the answer is correct.
    fits : sequence of PsychometricFit
        Fit of each series to these trials, all with the same curve.
    pairs : sequence of (int, int)
        Series whose threshold is divided, and series that it is divided by; both count from 0.
    backgrounds : ndarray of int, shape (trial,), optional
        Background of each trial, an index into the columns of `drawn_backgrounds.weights`.
    drawn_backgrounds : BackgroundDraws, optional
        As many repeated experiments as `settings.resamples`.

    Returns
    -------
    list of RatioDraws
        One for each pair.
    """
    distinct, place, n_trials = np.unique(level, return_inverse=True, return_counts=True)
    if len(distinct) < 2:
        return [RatioDraws(None, None, np.zeros(settings.resamples)) for _ in pairs]
    by_level = np.split(p_correct[:, np.argsort(place, kind="stable")], np.cumsum(n_trials)[:-1], axis=1)
    curves = np.array([_fitted(fit, distinct) for fit in fits])
    are_probabilities = bool(np.any((p_correct > 0) & (p_correct < 1)))
    if backgrounds is not None and drawn_backgrounds is not None:
        rest = 0.0 if are_probabilities else CURVE_TRIALS
        drawn = _with_backgrounds(p_correct, curves, place, backgrounds, drawn_backgrounds.weights, rest)
        widening = drawn_backgrounds.widening
        tolerance = PROBABILITY_TOLERANCE if are_probabilities else ANSWER_TOLERANCE
    elif are_probabilities:
        drawn = _redrawn_probabilities(by_level, curves, settings.resamples, rng)
        widening, tolerance = _students_widening(len(level), settings.resamples, rng), PROBABILITY_TOLERANCE
    else:
        drawn = _redrawn_answers(by_level, curves, settings, rng)
        widening, tolerance = np.ones(settings.resamples), ANSWER_TOLERANCE
    ln_thresholds = []
    for series, (fit, answers) in enumerate(zip(fits, drawn, strict=True)):
        model, _ = _model(distinct, n_trials, [of_level[series] for of_level in by_level], fit.curve, settings)
        ln_thresholds.append(
            _within_reach(model, model.ln_threshold(model.fit_many(answers, tolerance=tolerance)))
        )
    found = []
    for one, other in pairs:
        fit, reference = fits[one], fits[other]
        ratio = _quotient(fit.threshold, reference.threshold)
        with np.errstate(invalid="ignore"):
            difference = ln_thresholds[one] - ln_thresholds[other]
        ln_ratios = np.nan_to_num(difference, nan=0.0, posinf=np.inf, neginf=-np.inf)
        if ratio is not None:
            ln_ratios = math.log(ratio) + (ln_ratios - math.log(ratio)) * widening
        is_convention = fit.curve == "weibull"
        of_points = _quotient(fit.points_threshold, reference.points_threshold) if is_convention else None
        found.append(RatioDraws(ratio, of_points, ln_ratios))
    return found


def with_backgrounds_as_drawn(
    level: FloatArray,
    p_correct: FloatArray,
    fit: PsychometricFit,
    *,
    settings: FitSettings,
    backgrounds: NDArray[np.integer],
    drawn_backgrounds: BackgroundDraws,
) -> PsychometricFit:
    """Return a fit whose interval takes the backgrounds as drawn from many.

    Parameters
    ----------
    level, p_correct : ndarray, shape (trial,)
        As for `ratio_draws`, of one series.
    fit : PsychometricFit
        Fit to these trials; one without an interval is returned as it is.
    settings, backgrounds, drawn_backgrounds
        As for `ratio_draws`.
    """
    if fit.threshold is None or fit.threshold_ci95 is None:
        return fit
    distinct, place, n_trials = np.unique(level, return_inverse=True, return_counts=True)
    trials = np.split(p_correct[np.argsort(place, kind="stable")], np.cumsum(n_trials)[:-1])
    are_probabilities = bool(np.any((p_correct > 0) & (p_correct < 1)))
    rest = 0.0 if are_probabilities else CURVE_TRIALS
    curves = _fitted(fit, distinct)[None]
    (drawn,) = _with_backgrounds(p_correct[None], curves, place, backgrounds, drawn_backgrounds.weights, rest)
    model, centre = _model(distinct, n_trials, trials, fit.curve, settings)
    tolerance = PROBABILITY_TOLERANCE if are_probabilities else ANSWER_TOLERANCE
    found = _within_reach(model, model.ln_threshold(model.fit_many(drawn, tolerance=tolerance)))
    estimate = math.log(fit.threshold) - centre
    found = estimate + (found - estimate) * drawn_backgrounds.widening
    estimates = [estimate]
    if fit.curve == "weibull" and fit.points_threshold is not None:
        estimates.append(math.log(fit.points_threshold) - centre)
    low, high = _limits(found, estimates)
    reach = math.log(EXTRAPOLATION_FACTOR)
    interval = (
        math.exp(centre + low) if low >= model.z[0] - reach else None,
        math.exp(centre + high) if high <= model.z[-1] + reach else None,
    )
    return replace(fit, threshold_ci95=interval, threshold_ci95_same_scenes=fit.threshold_ci95)


def _model(
    distinct: FloatArray,
    n_trials: NDArray[np.integer],
    trials: list[FloatArray],
    curve: CurveName,
    settings: FitSettings,
) -> tuple[CurveModel, float]:
    """Return the model of a curve for the trials of each level, and the ln level that it counts from."""
    means = np.array([of_level.mean() for of_level in trials])
    are_probabilities = any(bool(np.any((one > 0) & (one < 1))) for one in trials)
    observed = Observed(distinct, n_trials.astype(np.int64), means, trials if are_probabilities else None)
    return curve_model(observed, curve, settings)[:2]


def _limits(ln_values: FloatArray, estimates: Sequence[float]) -> tuple[float, float]:
    """Return the ends of the 95 % interval of draws, extended to some estimates."""
    ranked, n = np.sort(ln_values), len(ln_values)
    low = float(ranked[max(math.floor(0.025 * (n + 1)) - 1, 0)])
    high = float(ranked[min(math.ceil(0.975 * (n + 1)) - 1, n - 1)])
    return min(low, *estimates), max(high, *estimates)


def threshold_ratio(groups: Sequence[RatioDraws]) -> ThresholdRatio:
    """Pool the ratio of one group of trials, or of several by geometric mean, with interval and p-value.

    The interval is that of the draws, extended to the ratio and, where a Weibull curve was fitted to
    probabilities, to the ratio of their own crossings: that curve is a convention that observers do not follow
    exactly. If one of these is on the other side of 1 than the draws are, no difference is shown.
    """
    ratio = _geometric_mean([group.ratio for group in groups])
    points_ratio = _geometric_mean([group.points_ratio for group in groups])
    with np.errstate(invalid="ignore"):
        ln_ratios = np.nan_to_num(
            np.mean([group.ln_ratios for group in groups], axis=0), nan=0.0, posinf=np.inf, neginf=-np.inf
        )
    n = len(ln_ratios)
    below, above = (int(np.count_nonzero(side)) for side in (ln_ratios <= SAME, ln_ratios >= -SAME))
    p_value = min(1.0, 2 * (min(below, above) + 1) / (n + 1))
    if ratio is None:
        return ThresholdRatio(None, None, p_value, below > above)
    estimates = [math.log(found) for found in (ratio, points_ratio) if found is not None]
    if any(estimate * (above - below) < 0 for estimate in estimates):
        p_value = 1.0
    low, high = _limits(ln_ratios, estimates)
    return ThresholdRatio(ratio, (_exp(low), _exp(high)), p_value, below > above)


def holm(p_values: ArrayLike) -> FloatArray:
    """Correct p-values for their number, so that any wrong verdict among all is as rare as for a single test.

    The smallest times their number, the next times one less, and so on, never falling (Holm 1979).
    """
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p)
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1)), 1.0)
    return corrected


def _with_backgrounds(
    p_correct: FloatArray,
    curves: FloatArray,
    place: NDArray[np.intp],
    backgrounds: NDArray[np.integer],
    weights: FloatArray,
    curve_trials: float,
) -> FloatArray:
    """Compute the mean answers of repeated experiments with drawn backgrounds, (series, experiment, level).

    `place` is the level of each trial. A level without a trial on any drawn background keeps the mean of all of
    its trials. Each level has `curve_trials` more, of the fitted curve, or levels without errors would not vary.
    """
    n_levels, n_backgrounds = curves.shape[1], weights.shape[1]
    cell = place * n_backgrounds + backgrounds
    n_cells = n_levels * n_backgrounds
    counts = np.bincount(cell, minlength=n_cells).reshape(n_levels, n_backgrounds).T
    of_all = counts.sum(axis=0)
    n_drawn = weights @ counts
    drawn = np.empty((len(p_correct), len(weights), n_levels))
    for series, answers in enumerate(p_correct):
        sums = np.bincount(cell, answers, minlength=n_cells).reshape(n_levels, n_backgrounds).T
        means = np.broadcast_to(sums.sum(axis=0) / of_all, n_drawn.shape)
        means = np.divide(weights @ sums, n_drawn, out=means.copy(), where=n_drawn > 0.0)
        drawn[series] = (of_all * means + curve_trials * curves[series]) / (of_all + curve_trials)
    return np.clip(drawn, 0.0, 1.0)


def _redrawn_probabilities(
    by_level: Sequence[FloatArray], curves: FloatArray, size: int, rng: np.random.Generator
) -> FloatArray:
    """Draw the mean probabilities of repeated experiments, (series, experiment, level).

    The distances of single trials from the curve, in units of √p(1 − p), are drawn from one another.
    """
    drawn = np.empty((len(curves), size, len(by_level)))
    single = [number for number, answers in enumerate(by_level) if answers.shape[1] == 1]
    if single:
        n, curve = len(single), curves[:, single]
        unit = np.sqrt(curve * (1 - curve))
        residual = (np.concatenate([by_level[number] for number in single], axis=1) - curve) / unit
        chosen = rng.integers(n, size=(size, n))
        drawn[..., single] = curve[:, None] + unit[:, None] * residual[:, chosen] * math.sqrt(n / max(n - 3, 1))
    for number, answers in enumerate(by_level):
        if number not in single:
            drawn[..., number] = resampled_means(answers, size, rng)
    return np.clip(drawn, 0.0, 1.0)


def _students_widening(n_trials: int, size: int, rng: np.random.Generator) -> FloatArray:
    """Draw factors that make normal deviates those of Student's t, for a spread estimated from few trials.

    A threshold rests on the levels about it: a third of the trials' degrees of freedom are counted.
    """
    freedom = max((n_trials - 3) / 3, 1.0)
    return np.sqrt(freedom / rng.chisquare(freedom, size))


def _redrawn_answers(
    by_level: Sequence[FloatArray], curves: FloatArray, settings: FitSettings, rng: np.random.Generator
) -> FloatArray:
    """Draw the proportions correct of repeated experiments, (series, experiment, level), from answers of 0 and 1.

    As in `fit_counts`, a level has 5 trials more, of the fitted curve, and the experiment 4, of (1 + γ)/2, or
    levels without errors would not vary. In these a series agrees with the first as much as in the trials shown.
    """
    agreement = _agreement(by_level, curves)
    plus = PLUS_TRIALS / (PLUS_TRIALS + sum(answers.shape[1] for answers in by_level))
    drawn = np.empty((len(curves), settings.resamples, len(by_level)))
    for level, answers in enumerate(by_level):
        n = answers.shape[1]
        shown, of_curve = np.array([n, CURVE_TRIALS]) / (n + CURVE_TRIALS) * (1 - plus)
        expected = (of_curve * curves[:, level] + plus * (1 + settings.guess_rate) / 2) / (of_curve + plus)
        start = 0
        for size in batches(settings.resamples, n):
            chosen, is_shown = rng.integers(n, size=(size, n)), rng.random((size, n)) < shown
            common = rng.random((size, n))
            for series, of_trials in enumerate(answers):
                luck = np.where(rng.random((size, n)) < agreement[series], common, rng.random((size, n)))
                right = np.where(is_shown, of_trials[chosen], luck < expected[series])
                drawn[series, start : start + size, level] = right.mean(axis=-1)
            start += size
    return drawn


def _agreement(by_level: Sequence[FloatArray], curves: FloatArray) -> FloatArray:
    """Measure the agreement of each series' answers with the first's: from 0, none, to 1, the largest possible."""
    n_trials = np.array([answers.shape[1] for answers in by_level])
    unlike = np.sum([np.count_nonzero(answers != answers[0], axis=1) for answers in by_level], axis=0)
    independent = (curves * (1 - curves[0]) + curves[0] * (1 - curves)) @ n_trials
    least = np.abs(curves - curves[0]) @ n_trials
    return np.asarray(np.clip((independent - unlike) / np.maximum(independent - least, 1e-12), 0.0, 1.0))


def _fitted(fit: PsychometricFit, level: FloatArray) -> FloatArray:
    """Evaluate the fitted curve at some levels; the mean proportion where none was fitted."""
    if fit.observer_curve is not None:
        curve = observer_curve(level, **fit.observer_curve._asdict())
    elif fit.curve == "observer" or fit.alpha is None or fit.beta is None or fit.lapse_rate is None:
        curve = np.full(len(level), sum(point.p_correct * point.n_trials for point in fit.points) / fit.n_trials)
    else:
        curve = weibull(
            level, alpha=fit.alpha, beta=fit.beta, guess_rate=fit.guess_rate, lapse_rate=fit.lapse_rate
        )
    return np.asarray(np.clip(curve, 1e-6, 1 - 1e-6))


def _within_reach(model: CurveModel, ln_threshold: FloatArray) -> FloatArray:
    """Replace thresholds that lie farther outside the levels than a fit can reach by infinity."""
    reach = math.log(EXTRAPOLATION_FACTOR)
    known = np.where(ln_threshold > model.z[-1] + reach, np.inf, ln_threshold)
    return np.where(known < model.z[0] - reach, -np.inf, known)


def _quotient(value: float | None, reference: float | None) -> float | None:
    return None if value is None or reference is None else value / reference


def _geometric_mean(ratios: Sequence[float | None]) -> float | None:
    known = [math.log(ratio) for ratio in ratios if ratio is not None]
    return math.exp(sum(known) / len(known)) if len(known) == len(ratios) else None


def _exp(bound: float) -> float | None:
    return math.exp(bound) if math.isfinite(bound) else None
