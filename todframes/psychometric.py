"""The Weibull psychometric function: its maximum-likelihood fit, its threshold and the interval of that.

Hogervorst et al. 2001, eq. 3: p(x) = (1 − δ) − (1 − δ − γ)·2^−(x/α)^β. The threshold is the level at a raw
proportion correct, x_c = α·log2((1 − δ − γ)/(1 − δ − c))^(1/β); α itself is not the 75 % point.

The fit maximises Σ p_i ln p(x_i) + (1 − p_i) ln(1 − p(x_i)) over α, β in 1e-2 … 1e3 and δ. In ln x the curve is a
complementary log-log model, ln(ln 2) + β·(ln x − ln α), with a guess and a lapse rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr, ndtri, xlogy

from todframes.errors import DataError, SettingsError

Array = npt.NDArray[np.float64]
Status = Literal["ok", "extrapolated", "never_reached", "always_exceeded", "too_few_levels"]

BETA_RANGE = (1e-2, 1e3)
EXTRAPOLATION_FACTOR = 2.0
MIN_RESAMPLES = 40
_LN_LN2 = math.log(math.log(2.0))
_CHI2_95 = 3.841458820694124
_BATCH_ELEMENTS = 1 << 20
# OpenBLAS starts threads for larger products; on a busy machine their waiting costs more than they save.
_SINGLE_THREAD_PRODUCT = 1 << 18
_CURVE_TRIALS = 5
_PLUS_TRIALS = 4
_Z_95 = 1.959963984540054


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings:
    """What is fixed and what is free in a fit.

    `lapse_rate` None leaves δ free in [0, lapse_rate_max]. `resamples` 0 gives no interval; fewer than 40 would
    not reach into the 2.5 % tails.
    """

    guess_rate: float = 0.25
    lapse_rate: float | None = None
    lapse_rate_max: float = 0.05
    p_correct: float = 0.75
    resamples: int = 2000

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "lapse_rate" and value is None:
                continue
            kind = int if field.name == "resamples" else (int, float)
            if isinstance(value, bool) or not isinstance(value, kind):
                expected = "a whole number" if kind is int else "a number"
                raise SettingsError(f"{field.name}: found {value!r}, expected {expected}")
        _require("guess_rate", self.guess_rate, 0 <= self.guess_rate < 1, "0 <= guess_rate < 1")
        room = f"0 to below 1 - guess_rate = {1 - self.guess_rate:g}"
        for key, lapse_rate in (("lapse_rate", self.lapse_rate), ("lapse_rate_max", self.lapse_rate_max)):
            if lapse_rate is not None:
                _require(key, lapse_rate, 0 <= lapse_rate < 1 - self.guess_rate, room)
        top = 1 - (self.lapse_rate or 0.0)
        between = f"strictly between guess_rate = {self.guess_rate:g} and 1 - lapse_rate = {top:g}"
        _require("p_correct", self.p_correct, self.guess_rate < self.p_correct < top, between)
        enough = self.resamples == 0 or self.resamples >= MIN_RESAMPLES
        _require("resamples", self.resamples, enough, f"0 (no interval) or at least {MIN_RESAMPLES}")


def _require(key: str, found: object, holds: bool, expected: str) -> None:
    if not holds:
        raise SettingsError(f"{key}: found {found!r}, expected {expected}")


@dataclass(frozen=True, slots=True)
class Point:
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
    points: tuple[Point, ...]


def weibull(level: npt.ArrayLike, *, alpha: float, beta: float, guess_rate: float, lapse_rate: float) -> Array:
    """Proportion correct at `level` >= 0, any shape. Hogervorst et al. 2001, eq. 3."""
    with np.errstate(over="ignore"):
        exponent = (np.asarray(level, dtype=np.float64) / alpha) ** beta
    return np.asarray((1 - lapse_rate) - (1 - lapse_rate - guess_rate) * np.exp2(-exponent))


def weibull_level(
    p_correct: npt.ArrayLike, *, alpha: float, beta: float, guess_rate: float, lapse_rate: float
) -> Array:
    """Level of a raw proportion correct, the inverse of `weibull`; 0 at γ and below, inf from 1 − δ on."""
    span = 1 - lapse_rate - guess_rate
    left = np.clip(1 - lapse_rate - np.asarray(p_correct, dtype=np.float64), 0.0, span)
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(alpha * np.log2(span / left) ** (1 / beta))


@dataclass(frozen=True, slots=True)
class _Model:
    """What a curve is fitted to, but for the answers. `z` is ln level about its centre, the parameters `theta` are
    (ln α about the same centre, ln β, δ), within `lower` and `upper`.
    """

    z: Array
    n_trials: Array
    guess_rate: float
    p_correct: float
    lower: Array
    upper: Array

    def curves(self, theta: Array, z: Array) -> tuple[Array, Array, Array]:
        """P(right), P(wrong), both (curve, level), and the derivative of P(right), (parameter, curve, level)."""
        location, ln_slope, lapse_rate = (theta[:, k, None] for k in range(3))
        slope = np.exp(ln_slope)
        offset = slope * (z - location)
        # The bounds keep ln P(wrong) >= -500, so that no ratio below overflows; no datum tells it from −∞.
        hazard = np.exp(np.clip(offset + _LN_LN2, -500.0, math.log(500.0)))
        miss = np.exp(-hazard)
        hit = -np.expm1(-hazard)
        span = 1 - self.guess_rate - lapse_rate
        d_offset = span * miss * hazard
        jacobian = np.stack([-slope * d_offset, offset * d_offset, -hit])
        return self.guess_rate + span * hit, lapse_rate + span * miss, jacobian

    def derivatives(self, theta: Array, answers: Array) -> tuple[Array, Array, Array]:
        """Log-likelihood, score and Fisher information of each row of `answers` under its row of `theta`."""
        right, wrong, jacobian = self.curves(theta, self.z)
        loglik = np.einsum("bl,l->b", answers * np.log(right) + (1 - answers) * np.log(wrong), self.n_trials)
        residual = self.n_trials * (answers / right - (1 - answers) / wrong)
        score = np.einsum("bl,jbl->bj", residual, jacobian)
        weighted = (self.n_trials / (right * wrong)) * jacobian
        return loglik, score, np.einsum("ibl,jbl->bij", weighted, jacobian)

    def ln_threshold(self, theta: Array) -> Array:
        """Of each curve, about the centre; +inf where the criterion is above 1 − δ."""
        location, ln_slope, lapse_rate = theta.T
        left = 1 - lapse_rate - self.p_correct
        span = 1 - lapse_rate - self.guess_rate
        reached = left > 0
        ln_log2 = np.log(np.log2(span / np.where(reached, left, span / 2)))
        return np.where(reached, location + ln_log2 / np.exp(ln_slope), np.inf)

    def climb(self, theta: Array, answers: Array, *, tolerance: float, steps: int) -> tuple[Array, Array]:
        """Maximise the likelihood of each row of `answers` from its row of `theta`: all rows at once.

        Levenberg-damped Fisher scoring; a parameter at a bound that its score pushes against stands still
        (Bertsekas 1982). A row is done when its next step promises less than `tolerance` in log-likelihood.
        """
        best, best_loglik = theta.copy(), np.empty(len(theta))
        rows, diagonal = np.arange(len(theta)), np.arange(3)
        loglik, score, information = self.derivatives(theta, answers)
        damping = np.full(len(theta), 1e-3)
        for _ in range(steps):
            held = ((theta <= self.lower) & (score < 0)) | ((theta >= self.upper) & (score > 0))
            push = np.where(held, 0.0, score)
            matrix = np.where(held[:, :, None] | held[:, None, :], 0.0, information)
            matrix[:, diagonal, diagonal] = matrix[:, diagonal, diagonal] * (1 + damping[:, None]) + 1e-12 + held
            step = np.linalg.solve(matrix, push[:, :, None])[:, :, 0]
            moved = np.clip(theta + np.clip(step, -3.0, 3.0), self.lower, self.upper)
            new_loglik, new_score, new_information = self.derivatives(moved, answers)
            better = new_loglik >= loglik - 1e-13 * np.abs(loglik)
            theta = np.where(better[:, None], moved, theta)
            loglik = np.where(better, new_loglik, loglik)
            score = np.where(better[:, None], new_score, score)
            information = np.where(better[:, None, None], new_information, information)
            damping = np.clip(np.where(better, damping * 0.1, damping * 10), 1e-9, 1e9)
            best[rows], best_loglik[rows] = theta, loglik
            going = ((push * step).sum(axis=1) >= tolerance) & (damping < 1e9)
            if not going.any():
                break
            rows, theta, loglik, score = rows[going], theta[going], loglik[going], score[going]
            information, damping, answers = information[going], damping[going], answers[going]
        return best, best_loglik

    def influence(self, theta: Array) -> tuple[Array, Array]:
        """Of one curve: P(right) at each level, and the move of ln x_c for a residual of 1 in one trial there."""
        right, wrong, jacobian = (values.squeeze(-2) for values in self.curves(theta[None], self.z))
        left, span, slope = 1 - theta[2] - self.p_correct, 1 - theta[2] - self.guess_rate, math.exp(theta[1])
        ratio = math.log(span / left)
        gradient = np.array([1, -math.log(ratio / math.log(2)) / slope, (1 / left - 1 / span) / ratio / slope])
        free = (theta > self.lower) & (theta < self.upper)
        information = (jacobian[free] * (self.n_trials / (right * wrong))) @ jacobian[free].T
        weight: Array = gradient[free] @ np.linalg.pinv(information, hermitian=True) @ jacobian[free]
        return right, weight / (right * wrong)

    def starts(self) -> Array:
        """A coarse grid of curves, (slope, curve, parameter), steep ones first: the first of equals is taken."""
        z = np.quantile(self.z, np.linspace(0, 1, min(len(self.z), 12)))
        slope = np.array([1000.0, 100.0, 20.0, 8.0, 4.0, 2.0, 1.0, 0.4, 0.1, 0.01])
        parts = (slope, np.concatenate([(z[1:] + z[:-1]) / 2, z]), np.array([0.0, -2.0, 1.5]))
        lapse_rates = np.unique(np.linspace(self.lower[2], self.upper[2], 3))
        slope, place, offset, lapse_rate = np.meshgrid(*parts, lapse_rates, indexing="ij")
        grid = np.stack([place - offset / slope, np.log(slope), lapse_rate], axis=-1)
        return grid.reshape(len(grid), -1, 3)

    def grid_terms(self, grid: Array, answers: Array) -> tuple[Array, Array, Array]:
        """Trials right, (row, pool), and the weight and constant that make them a log-likelihood of each curve.

        At most 64 pools of neighbouring levels keep this small for any number of levels.
        """
        first = np.unique(np.linspace(0, len(self.z), 65)[:-1].astype(np.intp))
        n_trials = np.add.reduceat(self.n_trials, first)
        z = np.add.reduceat(self.n_trials * self.z, first) / n_trials
        right, wrong, _ = self.curves(grid, z)
        n_right = np.add.reduceat(answers * self.n_trials, first, axis=1)
        tie_break = 1e-9 * n_trials.sum() * np.linspace(0, 1, len(grid))
        return n_right, np.log(right / wrong).T, np.einsum("gl,l->g", np.log(wrong), n_trials) - tie_break

    def fit_one(self, answers: Array) -> tuple[Array, float]:
        """The best of the climbs from the best start of each slope, and its log-likelihood."""
        grid = self.starts()
        n_right, weight, constant = self.grid_terms(grid.reshape(-1, 3), answers[None])
        loglik = (np.einsum("bl,lg->g", n_right, weight) + constant).reshape(grid.shape[:2])
        best = loglik.argmax(axis=1)
        order = np.argsort(-loglik.max(axis=1))
        n_trials = self.n_trials.sum()
        repeated = np.tile(answers, (len(grid), 1))
        tops, heights = self.climb(grid[order, best[order]], repeated, tolerance=1e-20 * n_trials, steps=60)
        first = int(np.argmax(heights >= heights.max() - 1e-10 * n_trials))
        return tops[first], float(heights[first])

    def fit_many(self, answers: Array) -> Array:
        """One curve for each row of `answers`, to about √tolerance = 1 % of a standard error.

        The likelihood may have a second top where the curve is a step, so each row climbs from two starts.
        """
        grid, curves = self.starts(), []
        size = _BATCH_ELEMENTS // len(self.z) + 1
        for batch in np.split(answers, range(size, len(answers), size)):
            steep, steep_loglik = self.climb_from_best(grid[:4].reshape(-1, 3), batch)
            shallow, shallow_loglik = self.climb_from_best(grid[4:].reshape(-1, 3), batch)
            curves.append(np.where((steep_loglik >= shallow_loglik - 1e-9)[:, None], steep, shallow))
        return np.concatenate(curves)

    def climb_from_best(self, grid: Array, answers: Array) -> tuple[Array, Array]:
        """`climb` each row of `answers` from its most likely curve of `grid`."""
        n_right, weight, constant = self.grid_terms(grid, answers)
        rows = max(1, _SINGLE_THREAD_PRODUCT // weight.size)
        batches = np.split(n_right, range(rows, len(answers), rows))
        best = np.concatenate([(batch @ weight + constant).argmax(axis=1) for batch in batches])
        return self.climb(grid[best], answers, tolerance=1e-4, steps=25)


@dataclass(frozen=True, slots=True)
class _Observed:
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
                picks = rng.integers(len(answers), size=(size, len(answers) - 1))
                spread = answers[picks].mean(axis=1) - answers.mean()
                freedom = len(answers) - 1
                drawn[:, level] = answers.mean() + spread * np.sqrt(freedom / rng.chisquare(freedom, size))
            else:
                p = np.clip(fitted[level], 1e-9, 1 - 1e-9)
                drawn[:, level] = rng.beta(p * (1 / share - 1), (1 - p) * (1 / share - 1))
        return np.clip(drawn, 0.0, 1.0)


def fit_trials(
    level: npt.ArrayLike,
    p_correct: npt.ArrayLike,
    *,
    settings: FitSettings = FitSettings(),
    rng: np.random.Generator,
) -> PsychometricFit:
    """Fit a curve to single trials.

    Parameters
    ----------
    level : array_like, (trial,)
        Stimulus strength, finite and > 0.
    p_correct : array_like, (trial,)
        0 or 1 where an answer was drawn, or the probability in [0, 1] that the answer is correct. If all are
        0 or 1, the fit and its interval are those of `fit_counts`.

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
    return _fit(_Observed(distinct, n_trials, means, trials if fractions else None), settings, rng)


def fit_counts(
    level: npt.ArrayLike,
    n_correct: npt.ArrayLike,
    n_trials: npt.ArrayLike,
    *,
    settings: FitSettings = FitSettings(),
    rng: np.random.Generator,
) -> PsychometricFit:
    """Fit a curve to rows of counts of 0/1 answers, all of shape (row,); rows of equal level are pooled.

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
    return _fit(_Observed(distinct, total.astype(np.int64), p_correct, None), settings, rng)


def _check_levels(level: Array, name: str, values: Array) -> None:
    if level.ndim != 1 or values.shape != level.shape or not level.size:
        shapes = f"level {level.shape} and {name} {values.shape}"
        raise DataError(f"found shapes {shapes}, expected one element each per row, and at least one row")
    _check(level, np.isfinite(level) & (level > 0), "level", "a finite number > 0")


def _check(values: Array, valid: npt.NDArray[np.bool_], name: str, expected: str) -> None:
    if not valid.all():
        row = int(np.argmin(valid))
        raise DataError(f"{name}, element {row}: found {values[row]:g}, expected {expected}")


def _fit(observed: _Observed, settings: FitSettings, rng: np.random.Generator) -> PsychometricFit:
    points = tuple(map(Point, observed.level.tolist(), observed.n_trials.tolist(), observed.p_correct.tolist()))
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
    ln_level = np.log(observed.level)
    centre = (ln_level[0] + ln_level[-1]) / 2
    fixed = settings.lapse_rate
    lapse_rates = (0.0, settings.lapse_rate_max) if fixed is None else (fixed, fixed)
    bounds = zip((-600.0, 600.0), np.log(BETA_RANGE), lapse_rates, strict=True)
    model = _Model(
        ln_level - centre,
        observed.n_trials.astype(np.float64),
        settings.guess_rate,
        settings.p_correct,
        *np.array(list(bounds)),
    )
    theta, loglik = model.fit_one(observed.p_correct)
    mean = np.average(observed.p_correct, weights=observed.n_trials)
    flat = np.clip(mean, settings.guess_rate, 1 - (fixed or 0.0))
    flat_loglik = xlogy(mean, flat) + xlogy(1 - mean, 1 - flat)
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
    interval = None
    if settings.resamples:
        reach = math.log(EXTRAPOLATION_FACTOR)
        low, high = _interval(model, theta, loglik, observed, settings.resamples, rng)
        interval = (
            math.exp(centre + low) if low >= model.z[0] - reach else None,
            math.exp(centre + high) if high <= model.z[-1] + reach else None,
        )
    return replace(curve, threshold=math.exp(centre + ln_threshold), threshold_ci95=interval)


def _status(model: _Model, theta: Array, ln_threshold: float) -> Status:
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


def _interval(
    model: _Model, theta: Array, loglik: float, observed: _Observed, resamples: int, rng: np.random.Generator
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
