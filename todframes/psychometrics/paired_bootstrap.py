"""The ratio of two thresholds from the same trials, its interval, and verdicts of several ratios together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from msgspec import structs
from numpy.typing import NDArray
from scipy.special import ndtri

from todframes.base._typing import FloatArray
from todframes.psychometrics.bootstrap import (
    NORMAL_95,
    BackgroundDraws,
    Observed,
    by_level,
    interval_of_draws,
    on_drawn_backgrounds,
    redrawn,
)
from todframes.psychometrics.curves import observer_curve, weibull
from todframes.psychometrics.fit import FitSettings, PsychometricFit, curve_model

SAME = 0.01
"""Largest |ln ratio| that counts as a ratio of 1: a person does not notice 1 %, and fitted curves are not more
exact."""


class RatioDraws(NamedTuple):
    """A threshold divided by the reference's, and the same in repeated experiments. `ratio` is that of the fitted
    thresholds, `points_ratio` that of the points' own crossings; None where one of the two thresholds does not
    exist, and `points_ratio` where the curve is no convention. `ln_ratios` has shape (resample,): −∞ or ∞ where
    only one experiment has a threshold within reach, 0 where neither has or nothing is known.
    """

    ratio: float | None
    points_ratio: float | None
    ln_ratios: FloatArray


class ThresholdRatio(NamedTuple):
    """A ratio of thresholds, its 95 % interval, and the p-value of it being within 1 % of 1. Without a ratio there
    is no interval; an end of it is None where the data leave it open. The p-value is two-sided and not below 2 /
    (resamples + 1). `is_lower` states whether the ratio is below 1 in more experiments than above.
    """

    ratio: float | None
    ratio_ci95: tuple[float | None, float | None] | None
    p_value: float
    is_lower: bool


class ThresholdDraws(NamedTuple):
    """A threshold, and ln thresholds of repeated experiments, shape (resample,): −∞ or ∞ where one has none within
    reach, NaN where nothing is known. `points_threshold` is the points' own crossing; None where the curve is no
    convention. `widening` are factors of the deviations of `ln_thresholds` from the threshold.
    """

    threshold: float | None
    points_threshold: float | None
    ln_thresholds: FloatArray
    widening: FloatArray | float = 1.0


def threshold_draws(
    level: FloatArray,
    p_correct: FloatArray,
    fits: Sequence[PsychometricFit],
    *,
    settings: FitSettings,
    rng: np.random.Generator,
    backgrounds: NDArray[np.integer] | None = None,
    drawn_backgrounds: BackgroundDraws | None = None,
) -> list[ThresholdDraws]:
    """Repeat the experiment of series of answers, (series, trial), to the same trials. In each repeated experiment
    the trials of a level are drawn with replacement, the same ones for all series, and curves are fitted to all.
    If the trials' backgrounds are given, indices into the columns of `drawn_backgrounds.weights`, these are drawn
    in place of trials. `fits` are those of the series, all with the same curve.
    """
    if len(np.unique(level)) < 2:
        return [ThresholdDraws(None, None, np.full(settings.resamples, np.nan)) for _ in fits]
    order = np.argsort(level, kind="stable")
    series = [Observed.of_trials(level, answers, order) for answers in p_correct]
    curves = np.array([_fitted(fit, series[0].level) for fit in fits])
    widening: FloatArray | float = 1.0
    if backgrounds is not None and drawn_backgrounds is not None:
        numbers = by_level(backgrounds, series[0].n_trials, order)
        drawn = on_drawn_backgrounds(series, curves, numbers, drawn_backgrounds.weights)
        widening = drawn_backgrounds.widening
    else:
        drawn = redrawn(series, curves, settings.resamples, rng, guess_rate=settings.guess_rate)
    tolerance = min(observed.tolerance for observed in series)
    draws = []
    for fit, observed, answers in zip(fits, series, drawn, strict=True):
        model = curve_model(observed, fit.curve, settings)
        ln_thresholds = model.centre + model.thresholds_within_reach(model.fit_many(answers, tolerance=tolerance))
        points = fit.points_threshold if fit.curve == "weibull" else None
        draws.append(ThresholdDraws(fit.threshold, points, ln_thresholds, widening))
    return draws


def draws_of_interval(
    threshold: float | None,
    interval: tuple[float | None, float | None] | None,
    *,
    resamples: int,
    rng: np.random.Generator,
) -> ThresholdDraws:
    """Draw thresholds from an interval of 95 % alone: normal deviates of ln threshold, with the half of the
    interval below it for those below, and that above for those above. Beyond an open end lies anything.
    """
    if threshold is None:
        return ThresholdDraws(None, None, np.full(resamples, np.nan))
    normal = rng.permutation(ndtri((np.arange(resamples) + 0.5) / resamples)) / NORMAL_95
    low, high = interval or (threshold, threshold)
    ln_threshold = math.log(threshold)
    below = -math.inf if low is None else math.log(low) - ln_threshold
    above = math.inf if high is None else math.log(high) - ln_threshold
    with np.errstate(invalid="ignore"):
        drawn = np.where(normal < 0.0, below, above) * np.abs(normal)
    return ThresholdDraws(threshold, None, ln_threshold + np.where(normal == 0.0, 0.0, drawn))


def interpolated(left: ThresholdDraws, right: ThresholdDraws, share: float) -> ThresholdDraws:
    """Return the threshold, and its draws, between two of a curve: ln threshold is linear, with `share` of the
    right one. There is none between thresholds of which one is missing.
    """
    if left.threshold is None or right.threshold is None:
        return ThresholdDraws(None, None, np.full(len(left.ln_thresholds), np.nan))
    ln_threshold = (1.0 - share) * math.log(left.threshold) + share * math.log(right.threshold)
    with np.errstate(invalid="ignore"):
        drawn = ln_threshold + (1.0 - share) * _deviations(left) + share * _deviations(right)
    drawn = np.nan_to_num(drawn, nan=ln_threshold, posinf=np.inf, neginf=-np.inf)
    return ThresholdDraws(math.exp(ln_threshold), None, drawn)


def ratio_draws(draws: ThresholdDraws, reference: ThresholdDraws) -> RatioDraws:
    """Divide a threshold by that of a reference, with the draws of both in their order: those of the same repeated
    experiments if the trials are the same, and of others if they are not.
    """
    ratio = _quotient(draws.threshold, reference.threshold)
    with np.errstate(invalid="ignore"):
        if ratio is None:
            difference = draws.ln_thresholds - reference.ln_thresholds
        else:
            difference = _deviations(draws) - _deviations(reference) + math.log(ratio)
    ln_ratios = np.nan_to_num(difference, nan=0.0, posinf=np.inf, neginf=-np.inf)
    return RatioDraws(ratio, _quotient(draws.points_threshold, reference.points_threshold), ln_ratios)


def _deviations(draws: ThresholdDraws) -> FloatArray:
    return np.asarray((draws.ln_thresholds - math.log(draws.threshold or 1.0)) * draws.widening)


def threshold_ratio(groups: Sequence[RatioDraws], weights: FloatArray | None = None) -> ThresholdRatio:
    """Pool the ratio of one group of trials, or of several by geometric mean, with interval and p-value. The
    groups have equal weights, or some of sum 1. The
    interval is that of the draws, extended to the ratio and, where a Weibull curve was fitted to probabilities, to
    the ratio of their own crossings: that curve is a convention that observers do not follow exactly. If one of
    these is on the other side of 1 than the draws are, no difference is shown.
    """
    ratio = _geometric_mean([group.ratio for group in groups], weights)
    points_ratio = _geometric_mean([group.points_ratio for group in groups], weights)
    with np.errstate(invalid="ignore"):
        mean = np.average([group.ln_ratios for group in groups], axis=0, weights=weights)
    ln_ratios = np.nan_to_num(mean, nan=0.0, posinf=np.inf, neginf=-np.inf)
    n = len(ln_ratios)
    below, above = (int(np.count_nonzero(side)) for side in (ln_ratios <= SAME, ln_ratios >= -SAME))
    p_value = min(1.0, 2 * (min(below, above) + 1) / (n + 1))
    if ratio is None:
        return ThresholdRatio(None, None, p_value, below > above)
    estimates = [math.log(estimate) for estimate in (ratio, points_ratio) if estimate is not None]
    if any(estimate * (above - below) < 0 for estimate in estimates):
        p_value = 1.0
    low, high = interval_of_draws(ln_ratios, estimates)
    return ThresholdRatio(ratio, (_exp(low), _exp(high)), p_value, below > above)


def _fitted(fit: PsychometricFit, level: FloatArray) -> FloatArray:
    """Evaluate the fitted curve at some levels; the mean proportion where none was fitted."""
    if fit.observer_curve is not None:
        curve = observer_curve(level, **structs.asdict(fit.observer_curve))
    elif fit.curve == "observer" or fit.alpha is None or fit.beta is None or fit.lapse_rate is None:
        curve = np.full(len(level), sum(point.p_correct * point.n_trials for point in fit.points) / fit.n_trials)
    else:
        curve = weibull(
            level, alpha=fit.alpha, beta=fit.beta, guess_rate=fit.guess_rate, lapse_rate=fit.lapse_rate
        )
    return np.asarray(np.clip(curve, 1e-6, 1 - 1e-6))


def _quotient(value: float | None, reference: float | None) -> float | None:
    return None if value is None or reference is None else value / reference


def _geometric_mean(ratios: Sequence[float | None], weights: FloatArray | None) -> float | None:
    known = [math.log(ratio) for ratio in ratios if ratio is not None]
    return math.exp(np.average(known, weights=weights)) if len(known) == len(ratios) else None


def _exp(bound: float) -> float | None:
    return math.exp(bound) if math.isfinite(bound) else None
