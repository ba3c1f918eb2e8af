"""The Weibull psychometric function: its maximum-likelihood fit, its threshold and the interval of that.

Hogervorst et al. 2001, eq. 3: p(x) = (1 − δ) − (1 − δ − γ)·2^−(x/α)^β. The threshold is the level at a raw
proportion correct, x_c = α·log2((1 − δ − γ)/(1 − δ − c))^(1/β); α itself is not the 75 % point.

The fit maximises Σ p_i ln p(x_i) + (1 − p_i) ln(1 − p(x_i)) over α, β in 1e-2 … 1e3 and δ. In ln x the curve is a
complementary log-log model, ln(ln 2) + β·(ln x − ln α), with a guess and a lapse rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes._typing import FloatArray
from todframes.config import check_values
from todframes.errors import DataError, SettingsError
from todframes.psychometrics.bootstrap import Observed, crossing_of_points, threshold_interval
from todframes.psychometrics.weibull import BETA_RANGE, WeibullModel, binomial_loglik

Status = Literal["ok", "extrapolated", "never_reached", "always_exceeded", "too_few_levels"]
EXTRAPOLATION_FACTOR = 2.0
MIN_RESAMPLES, MAX_RESAMPLES = 40, 100_000


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """Parameters of the psychometric function that are fixed, ranges of those that are free, and the criterion.

    `lapse_rate` None leaves δ free in [0, lapse_rate_max]. `resamples` 0 gives no interval; fewer than 40 would
    not reach into the 2.5 % tails.

    Raises
    ------
    SettingsError
        If a value is out of its range, or the criterion not between guess rate and 1 − lapse rate.
    """

    guess_rate: float = 0.25
    lapse_rate: float | None = None
    lapse_rate_max: float = 0.05
    p_correct: float = 0.75
    resamples: int = 2000

    def __post_init__(self) -> None:
        check_values(self)
        _require("guess_rate", self.guess_rate, 0 <= self.guess_rate < 1, "0 <= guess_rate < 1")
        room = f"0 to below 1 - guess_rate = {1 - self.guess_rate:g}"
        for key, lapse_rate in (("lapse_rate", self.lapse_rate), ("lapse_rate_max", self.lapse_rate_max)):
            if lapse_rate is not None:
                _require(key, lapse_rate, 0 <= lapse_rate < 1 - self.guess_rate, room)
        top = 1 - (self.lapse_rate or 0.0)
        between = f"strictly between guess_rate = {self.guess_rate:g} and 1 - lapse_rate = {top:g}"
        _require("p_correct", self.p_correct, self.guess_rate < self.p_correct < top, between)
        enough = self.resamples == 0 or MIN_RESAMPLES <= self.resamples <= MAX_RESAMPLES
        _require("resamples", self.resamples, enough, f"0 (no interval) or {MIN_RESAMPLES} to {MAX_RESAMPLES}")


def _require(key: str, found: object, holds: bool, expected: str) -> None:
    if not holds:
        raise SettingsError(f"{key}: found {found!r}, expected {expected}")


@dataclass(frozen=True, slots=True)
class LevelCount:
    """The observed proportion correct at one level."""

    level: float
    n_trials: int
    p_correct: float


@dataclass(frozen=True, slots=True)
class PsychometricFit:
    """A fitted curve and its threshold, the level where the curve passes `p_correct`.

    status
        `ok`: the threshold lies within the levels shown.
        `extrapolated`: it lies outside, by a factor of 2 at most, and at the nearest level the curve is no farther
        from the criterion than half the way to its floor γ or ceiling 1 − δ.
        `never_reached`, `always_exceeded`: the threshold lies farther up or down than that, or the curve is no
        more likely than a flat line at the mean proportion, which is below or not below the criterion.
        `too_few_levels`: fewer than two distinct levels.
        Only `ok` and `extrapolated` have a threshold and an interval. With a flat line or too few levels there is
        no curve either: `alpha`, `beta` and `delta` are None.
    threshold_ci95
        A bound is None where the data do not determine it: it is infinite or more than a factor of 2 outside the
        levels. None altogether without a threshold or with `resamples=0`.
    points_threshold
        Level where the points themselves cross the criterion, with no fitted curve; for probabilities, with three
        levels and three trials a level or more. The interval covers this crossing too, with its own error: a
        Weibull curve is a convention that other observers do not follow exactly.
    """

    status: Status
    threshold: float | None
    threshold_ci95: tuple[float | None, float | None] | None
    p_correct: float
    alpha: float | None
    beta: float | None
    gamma: float
    delta: float | None
    n_trials: int
    points: tuple[LevelCount, ...]
    points_threshold: float | None = None


def fit_trials(
    level: ArrayLike, p_correct: ArrayLike, *, settings: FitSettings = FitSettings(), rng: np.random.Generator
) -> PsychometricFit:
    """Fit a curve to single trials.

    Parameters
    ----------
    level : array_like, (trial,)
        Stimulus strength, finite and > 0.
    p_correct : array_like, (trial,)
        0 or 1 where an answer was drawn, or the probability in [0, 1] that the answer is correct. If all are
        0 or 1, the fit and its interval are those of `fit_counts`.
    settings : FitSettings
    rng : numpy.random.Generator
        Generator of the resamples; the fit itself is deterministic.

    Returns
    -------
    PsychometricFit

    Raises
    ------
    DataError
        If the shapes differ, there is no trial, or a value is out of its range.

    Notes
    -----
    The interval of probabilities resamples the trials within each level, n − 1 of n, which makes their variance
    unbiased (McCarthy & Snowden 1985), and stretches each deviation by √((n − 1)/χ²), because that variance is
    itself an estimate (Student 1908). The spread of a level with a single trial is not known: it takes that of all
    residuals about the curve, as a share of p(1 − p) (McCullagh & Nelder 1989, chapter 9), in a beta distribution;
    with three trials or fewer in all, the whole of p(1 − p), the most that answers in [0, 1] can have.
    """
    x, p = np.asarray(level, dtype=np.float64), np.asarray(p_correct, dtype=np.float64)
    _check_levels(x, "p_correct", p)
    _check(p, (p >= 0) & (p <= 1), "p_correct", "a number in [0, 1]")
    order = np.lexsort((p, x))
    distinct, first, n_trials = np.unique(x[order], return_index=True, return_counts=True)
    trials = np.split(p[order], first[1:])
    means = np.array([answers.mean() for answers in trials])
    fractions = bool(np.any((p > 0) & (p < 1)))
    return _fit(Observed(distinct, n_trials, means, trials if fractions else None), settings, rng)


def fit_counts(
    level: ArrayLike,
    n_correct: ArrayLike,
    n_trials: ArrayLike,
    *,
    settings: FitSettings = FitSettings(),
    rng: np.random.Generator,
) -> PsychometricFit:
    """Fit a curve to counts of 0/1 answers; rows of equal level are pooled.

    Parameters
    ----------
    level, n_correct, n_trials : array_like, (row,)
        Stimulus strength, finite and > 0; whole numbers with 0 <= n_correct <= n_trials, n_trials >= 1.
    settings : FitSettings
    rng : numpy.random.Generator
        Generator of the resamples; the fit itself is deterministic.

    Returns
    -------
    PsychometricFit

    Raises
    ------
    DataError
        If the shapes differ, there is no row, or a value is out of its range.

    Notes
    -----
    The interval resamples each level binomially. The p of a level mixes its observed proportion, for its n trials,
    with the fitted curve, for 5, so that levels without errors vary too and single trials are all but drawn from
    the curve (Wichmann & Hill 2001); and all p are drawn towards (1 + γ)/2 by 4 trials in the whole experiment,
    after Agresti & Coull 1998, because a curve fitted to few trials is too steep.
    """
    x, right, n = (np.asarray(values, dtype=np.float64) for values in (level, n_correct, n_trials))
    _check_levels(x, "n_correct", right)
    _check_levels(x, "n_trials", n)
    _check(n, (n >= 1) & (n == np.floor(n)) & np.isfinite(n), "n_trials", "a whole number >= 1")
    _check(right, (right >= 0) & (right == np.floor(right)), "n_correct", "a whole number >= 0")
    _check(right, right <= n, "n_correct", "at most n_trials")
    distinct, row = np.unique(x, return_inverse=True)
    total = np.bincount(row, n, len(distinct))
    p_correct = np.bincount(row, right, len(distinct)) / total
    return _fit(Observed(distinct, total.astype(np.int64), p_correct, None), settings, rng)


def _check_levels(level: FloatArray, name: str, values: FloatArray) -> None:
    if level.ndim != 1 or values.shape != level.shape or not level.size:
        shapes = f"level {level.shape} and {name} {values.shape}"
        raise DataError(f"found shapes {shapes}, expected one element each per row, and at least one row")
    _check(level, np.isfinite(level) & (level > 0), "level", "a finite number > 0")


def _check(values: FloatArray, valid: NDArray[np.bool_], name: str, expected: str) -> None:
    if not valid.all():
        row = int(np.argmin(valid))
        raise DataError(f"{name}, element {row}: found {values[row]:g}, expected {expected}")


def curve_model(
    level: FloatArray, n_trials: NDArray[np.intp], settings: FitSettings
) -> tuple[WeibullModel, float]:
    """Build the Weibull model for distinct, ascending levels. Returns (model, centre); z = ln(level) − centre."""
    ln_level = np.log(level)
    centre = float(ln_level[0] + ln_level[-1]) / 2
    fixed = settings.lapse_rate
    lapse_rates = (0.0, settings.lapse_rate_max) if fixed is None else (fixed, fixed)
    lower, upper = np.array([(-600.0, 600.0), np.log(BETA_RANGE), lapse_rates]).T
    trials = n_trials.astype(np.float64)
    return WeibullModel(ln_level - centre, trials, settings.guess_rate, settings.p_correct, lower, upper), centre


def _fit(observed: Observed, settings: FitSettings, rng: np.random.Generator) -> PsychometricFit:
    points = tuple(
        map(LevelCount, observed.level.tolist(), observed.n_trials.tolist(), observed.p_correct.tolist())
    )
    nothing = PsychometricFit(
        status="too_few_levels",
        threshold=None,
        threshold_ci95=None,
        p_correct=settings.p_correct,
        alpha=None,
        beta=None,
        gamma=settings.guess_rate,
        delta=None,
        n_trials=int(observed.n_trials.sum()),
        points=points,
    )
    if len(points) < 2:
        return nothing
    model, centre = curve_model(observed.level, observed.n_trials, settings)
    theta, loglik = model.fit_one(observed.p_correct)
    mean = np.average(observed.p_correct, weights=observed.n_trials)
    flat = np.clip(mean, settings.guess_rate, 1 - (settings.lapse_rate or 0.0))
    flat_loglik = float(binomial_loglik(mean, flat))
    if loglik / nothing.n_trials <= flat_loglik + 1e-9:
        return replace(nothing, status="always_exceeded" if mean >= settings.p_correct else "never_reached")
    ln_threshold = float(model.ln_threshold(theta[None])[0])
    location, ln_slope, lapse_rate = theta.tolist()
    curve = replace(
        nothing,
        status=_status(model, theta, ln_threshold),
        alpha=math.exp(min(max(centre + location, -700.0), 700.0)),
        beta=math.exp(ln_slope),
        delta=lapse_rate,
    )
    if curve.status not in ("ok", "extrapolated"):
        return curve
    interval, points_threshold = None, None
    if observed.shows_its_own_curve:
        crossing = float(crossing_of_points(model, theta, observed.p_correct[None])[0])
        points_threshold = math.exp(centre + crossing) if math.isfinite(crossing) else None
    if settings.resamples:
        reach = math.log(EXTRAPOLATION_FACTOR)
        low, high = threshold_interval(model, theta, loglik, observed, settings.resamples, rng)
        interval = (
            math.exp(centre + low) if low >= model.z[0] - reach else None,
            math.exp(centre + high) if high <= model.z[-1] + reach else None,
        )
    return replace(
        curve,
        threshold=math.exp(centre + ln_threshold),
        threshold_ci95=interval,
        points_threshold=points_threshold,
    )


def _status(model: WeibullModel, theta: FloatArray, ln_threshold: float) -> Status:
    if model.z[0] <= ln_threshold <= model.z[-1]:
        return "ok"
    above = ln_threshold > model.z[-1]
    end = model.z[-1] if above else model.z[0]
    nearest = float(model.curves(theta[None], np.array([end]))[0][0, 0])
    limit = model.guess_rate if above else 1 - theta[2]
    near = abs(ln_threshold - end) <= math.log(EXTRAPOLATION_FACTOR)
    if near and abs(nearest - model.p_correct) <= abs(limit - model.p_correct) / 2:
        return "extrapolated"
    return "never_reached" if above else "always_exceeded"
