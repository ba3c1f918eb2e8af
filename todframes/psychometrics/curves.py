"""Psychometric functions of three parameters, and their maximum-likelihood fit to one experiment or many at once.

Weibull's curve is the convention for people's answers. Hogervorst et al. 2001, eq. 3: p(x) = (1 − δ) − (1 − δ −
γ)·2^−(x/α)^β. In ln x it is a complementary log-log model, ln(ln 2) + β·(ln x − ln α), with a guess and a lapse
rate: that is what is fitted.

The observer's curve is that of a choice among four Gaussian scores. The right answer's score exceeds the others by
d′ standard deviations on average. The observer is right with probability P(d′) = ∫ φ(t − d′) Φ(t)³ dt, the largest
of four independent scores. In frames of a fixed noise d′ is proportional to the level x. Noise of the observer's
own limits it where the level is a signal-to-noise ratio, and so do places on the detectors where the triangle is
not recognised: 1/d′² = (α/x)^2β + 1/d_max². The exponent β is 1 for linear chains; enhancement, gamma and clipping
may change it.

Either is a function of ln level, moved along it by its first parameter. The likelihood of proportions is that of
counts, Σ n (p ln P + (1 − p) ln(1 − P)).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray

_Positive = Annotated[float, Meta(gt=0)]

GUESS_RATE = 0.25
LARGEST_D_PRIME = 16.0
"""Largest d′; larger ones count as equal to it: an error has the probability 1e-29."""

SMALLEST_CEILING = 0.1
"""Smallest `max_d_prime` of a fit: P(right) is 0.28 at most."""

_KNOTS_PER_UNIT = 16

SLOPE_RANGE = (1e-2, 1e3)

FLAT = 1e-6
"""Distance of P(right) from floor or ceiling within which a curve no longer rises."""

EXTRAPOLATION_FACTOR = 2.0
"""Largest factor by which a threshold lies outside the levels."""

CHI2_95 = 3.841458820694124
"""95 % point of χ² with one degree of freedom."""

_BATCH_ELEMENTS = 1 << 20

# OpenBLAS starts threads for larger products; on a busy machine their waiting costs more than they save.
_SINGLE_THREAD_PRODUCT = 1 << 18

_LN_LN2 = math.log(math.log(2.0))


class FitPoint(Struct, frozen=True):
    """The proportion correct at one level; `n_trials` is 0 if it was computed without trials."""

    level: _Positive
    n_trials: int
    p_correct: Annotated[float, Meta(ge=0, le=1)]


class CurveParameters(Struct, frozen=True):
    """Parameters of the observer's curve; `max_d_prime` is None where d′ has no limit."""

    alpha: _Positive
    beta: _Positive
    max_d_prime: _Positive | None = None


def weibull(
    level: ArrayLike,
    *,
    alpha: float | FloatArray,
    beta: float | FloatArray,
    guess_rate: float,
    lapse_rate: float | FloatArray,
) -> FloatArray:
    """Compute the proportion correct at levels >= 0, of any shape, in the unit of `alpha`. `alpha` > 0 is the
    level at 1 − δ − (1 − δ − γ)/2, `beta` > 0 the slope, `guess_rate` γ and `lapse_rate` δ the floor and the
    distance of the ceiling from 1. Hogervorst et al. 2001, eq. 3.
    """
    with np.errstate(over="ignore"):
        exponent = (np.asarray(level, dtype=np.float64) / alpha) ** beta
    return np.asarray((1 - lapse_rate) - (1 - lapse_rate - guess_rate) * np.exp2(-exponent))


def weibull_level(
    p_correct: ArrayLike, *, alpha: float, beta: float, guess_rate: float, lapse_rate: float | FloatArray
) -> FloatArray:
    """Return the level of a raw proportion correct, the inverse of `weibull`: 0 up to γ, inf from 1 − δ on."""
    span = 1 - lapse_rate - guess_rate
    left = np.clip(1 - lapse_rate - np.asarray(p_correct, dtype=np.float64), 0.0, span)
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(alpha * np.log2(span / left) ** (1 / beta))


def observer_curve(level: ArrayLike, *, alpha: float, beta: float, max_d_prime: float | None) -> FloatArray:
    """Compute the proportion correct at levels >= 0, of any shape, in the unit of `alpha`. `alpha` > 0 is the
    level where d′ would be 1 without a limit, `beta` > 0 the exponent, `max_d_prime` the limit of d′ at high
    levels, None for no limit.
    """
    with np.errstate(over="ignore", divide="ignore"):
        inverse_square = (np.asarray(level, dtype=np.float64) / alpha) ** (-2.0 * beta)
        inverse_square = inverse_square + (0.0 if max_d_prime is None else max_d_prime**-2.0)
        d_prime = 1.0 / np.sqrt(inverse_square)
    ln_wrong, _ = _ln_wrong(d_prime)
    return np.asarray(-np.expm1(ln_wrong))


def binomial_loglik(share: ArrayLike, p: ArrayLike) -> FloatArray:
    """Compute the log-likelihood of p per trial if this share of the answers is right; 0 · ln 0 counts as 0."""
    share, p = np.asarray(share, np.float64), np.asarray(p, np.float64)
    with np.errstate(divide="ignore"):
        right, wrong = np.log(np.where(share > 0, p, 1.0)), np.log(np.where(share < 1, 1.0 - p, 1.0))
    return np.asarray(share * right + (1.0 - share) * wrong)


@dataclass(frozen=True, slots=True)
class CurveModel(ABC):
    """Levels, trials and parameter limits that a psychometric function is fitted with. `z` is ln level about
    `centre`. Parameters `theta` are (ln of a level about the same centre, ln of the slope, and one that lowers the
    ceiling of the curve), within `lower` and `upper`. The slope multiplies the distance of ln level from the first
    parameter.
    """

    centre: float
    z: FloatArray
    n_trials: FloatArray
    guess_rate: float
    p_correct: float
    lower: FloatArray
    upper: FloatArray
    slope_prior: float = 0.0
    """Weight of −(ln slope)²/2 in the log-likelihood: information about the slope, which is expected to be 1."""

    near: FloatArray | None = None
    """Parameters near the most likely ones, (3,), if they are known: a fit to one experiment starts there."""

    start_offsets: ClassVar[tuple[float, ...]]
    """Distances of first guesses from the levels, times the slope."""

    is_convention: ClassVar[bool]
    """Whether the probabilities of observers follow the curve only roughly."""

    @property
    def reach(self) -> tuple[float, float]:
        """Smallest and largest ln level about the centre that a threshold may have."""
        beyond = math.log(EXTRAPOLATION_FACTOR)
        return float(self.z[0]) - beyond, float(self.z[-1]) + beyond

    def level_of(self, ln_level: float) -> float:
        """Return the level of a ln level about the centre."""
        return math.exp(self.centre + ln_level)

    def interval(self, low: float, high: float) -> tuple[float | None, float | None]:
        """Return the levels of an interval of ln level; an end out of `reach` is None."""
        lowest, highest = self.reach
        return self.level_of(low) if low >= lowest else None, self.level_of(high) if high <= highest else None

    def thresholds_within_reach(self, theta: FloatArray) -> FloatArray:
        """Return the ln threshold of each curve, infinite if it lies outside of `reach`."""
        lowest, highest = self.reach
        ln_threshold = self.ln_threshold(theta)
        known = np.where(ln_threshold > highest, np.inf, ln_threshold)
        return np.where(known < lowest, -np.inf, known)

    def is_step(self, theta: FloatArray) -> bool:
        """Return whether a curve, (3,), rises between two neighbouring levels or at a single one, so that steeper
        ones are as likely: the levels tell where the threshold is, and not how the curve rises.
        """
        right, _, _ = self.curves(theta[None], self.z)
        is_rising = (right > self.guess_rate + FLAT) & (right < self.ceiling(theta) - FLAT)
        return not self.slope_prior and bool(np.count_nonzero(is_rising) < 2)

    def likely_thresholds(self, theta: FloatArray, answers: FloatArray, dispersion: float) -> tuple[float, float]:
        """Return the smallest and the largest ln threshold within `reach` that the likelihood ratio does not
        reject at 5 % beside the most likely curve `theta`, whatever the slope and the ceiling; infinite at the
        ends of `reach`. `dispersion` is the variance of an answer as a share of p(1 − p).
        """
        (lowest, highest), (shallow, steep) = self.reach, np.log(SLOPE_RANGE).tolist()
        thresholds, slopes = np.linspace(lowest, highest, 161), np.linspace(shallow, steep, 70)
        slope, third = (part.ravel() for part in np.meshgrid(slopes, self.start_ceilings()))
        above = self.ln_threshold(np.stack([np.zeros_like(slope), slope, third], axis=-1))
        slope, third, above = (part[np.isfinite(above)] for part in (slope, third, above))
        location = thresholds[:, None] - above
        grid = np.stack([location, *np.broadcast_arrays(slope, third, location)[:2]], axis=-1).reshape(-1, 3)
        n_right, weight, constant = self.grid_terms(np.concatenate([grid, theta[None]]), answers[None])
        *logliks, best = (n_right @ weight)[0] + constant
        deviance = 2.0 * (best - np.reshape(logliks, location.shape).max(axis=1))
        likely = np.flatnonzero(deviance <= CHI2_95 * dispersion)
        if not likely.size:  # trials so many that the interval lies between two of these thresholds
            return math.inf, -math.inf
        low, high = (
            float(np.interp(CHI2_95 * dispersion, deviance[[end, beyond]], thresholds[[end, beyond]]))
            for end, beyond in ((likely[0], max(likely[0] - 1, 0)), (likely[-1], min(likely[-1] + 1, 160)))
        )
        return -math.inf if likely[0] == 0 else low, math.inf if likely[-1] == 160 else high

    @abstractmethod
    def curves(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute P(right), P(wrong), (curve, level), and the first's derivative, (parameter, curve, level)."""

    @abstractmethod
    def ln_threshold(self, theta: FloatArray) -> FloatArray:
        """Return the ln threshold of each curve, about the centre; +inf where it is never reached."""

    @abstractmethod
    def ceiling(self, theta: FloatArray) -> float:
        """Return P(right) of one curve, (3,), at an infinite level."""

    @abstractmethod
    def start_ceilings(self) -> FloatArray:
        """Return first guesses of the third parameter."""

    def derivatives(self, theta: FloatArray, answers: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute log-likelihood, score and Fisher information of each row of `answers` under its `theta`."""
        right, wrong, jacobian = self.curves(theta, self.z)
        loglik = np.einsum("bl,l->b", answers * np.log(right) + (1 - answers) * np.log(wrong), self.n_trials)
        residual = self.n_trials * (answers / right - (1 - answers) / wrong)
        score = np.einsum("bl,jbl->bj", residual, jacobian)
        weighted = (self.n_trials / (right * wrong)) * jacobian
        information = np.einsum("ibl,jbl->bij", weighted, jacobian)
        information[:, 1, 1] += self.slope_prior
        score[:, 1] -= self.slope_prior * theta[:, 1]
        return loglik + self.ln_prior(theta), score, information

    def ln_prior(self, theta: FloatArray) -> FloatArray:
        """Return the addition to the log-likelihood of each curve by the expected slope."""
        return np.asarray(-self.slope_prior * theta[..., 1] ** 2 / 2.0)

    def climb(
        self, theta: FloatArray, answers: FloatArray, *, tolerance: float, steps: int
    ) -> tuple[FloatArray, FloatArray]:
        """Maximise the likelihood of each row of `answers` from its row of `theta`: all rows at once.
        Levenberg-damped Fisher scoring; a parameter at a bound stays there while its score points beyond the bound
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

    def influence(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return P(right) of a curve at each level, and the move of ln x_c by a residual of 1 there."""
        right, wrong, jacobian = (values.squeeze(-2) for values in self.curves(theta[None], self.z))
        # P stays at the criterion: ∂P/∂z dz = −Σ ∂P/∂θ dθ, and ∂P/∂z is minus the first derivative.
        at_threshold = self.curves(theta[None], self.ln_threshold(theta[None]))[2][:, 0, 0]
        gradient = at_threshold / at_threshold[0]
        free = (theta > self.lower) & (theta < self.upper)
        root = jacobian[free] * np.sqrt(self.n_trials / (right * wrong))
        # Far from all levels the information, its square, leaves the range of numbers.
        root_prior = math.sqrt(self.slope_prior)
        size = max(float(np.abs(root).max(initial=root_prior)), 1e-300)
        prior = np.diag([0.0, (root_prior / size) ** 2, 0.0])[free][:, free]
        inverse = np.linalg.pinv(root / size @ (root / size).T + prior, hermitian=True)
        weight: FloatArray = gradient[free] @ inverse @ (jacobian[free] / size) / size
        return right, weight / (right * wrong)

    def starts(self) -> FloatArray:
        """Make a coarse grid of curves, (slope, curve, parameter), steep ones first: the first of equals wins."""
        z = np.quantile(self.z, np.linspace(0, 1, min(len(self.z), 12)))
        slope = np.array([1000.0, 100.0, 20.0, 8.0, 4.0, 2.0, 1.0, 0.4, 0.1, 0.01])
        parts = (slope, np.concatenate([(z[1:] + z[:-1]) / 2, z]), np.array(self.start_offsets))
        slope, location, offset, ceiling = np.meshgrid(*parts, self.start_ceilings(), indexing="ij")
        grid = np.stack([location - offset / slope, np.log(slope), ceiling], axis=-1)
        return grid.reshape(len(grid), -1, 3)

    def grid_terms(self, grid: FloatArray, answers: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return trials right, (row, pool), and the weight and constant of each curve's log-likelihood. At most 64
        pools of neighbouring levels keep this small for any number of levels.
        """
        first = np.unique(np.linspace(0, len(self.z), 65)[:-1].astype(np.intp))
        n_trials = np.add.reduceat(self.n_trials, first)
        z = np.add.reduceat(self.n_trials * self.z, first) / n_trials
        right, wrong, _ = self.curves(grid, z)
        n_right = np.add.reduceat(answers * self.n_trials, first, axis=1)
        constant = np.einsum("gl,l->g", np.log(wrong), n_trials) + self.ln_prior(grid)
        tie_break = 1e-9 * n_trials.sum() * np.linspace(0, 1, len(grid))
        return n_right, np.log(right / wrong).T, constant - tie_break

    def fit_one(self, answers: FloatArray, *, steps: int = 60) -> tuple[FloatArray, float]:
        """Return the best of the climbs from `near`, or from the best start of each slope, and its log-likelihood.
        `steps` limits the length of a climb.
        """
        tolerance = 1e-20 * float(self.n_trials.sum())
        if self.near is not None:
            top, height = self.climb(self.near[None], answers[None], tolerance=tolerance, steps=steps)
            return top[0], float(height[0])
        grid = self.starts()
        n_right, weight, constant = self.grid_terms(grid.reshape(-1, 3), answers[None])
        loglik = (np.einsum("bl,lg->g", n_right, weight) + constant).reshape(grid.shape[:2])
        best = loglik.argmax(axis=1)
        order = np.argsort(-loglik.max(axis=1))
        n_trials = self.n_trials.sum()
        repeated = np.tile(answers, (len(grid), 1))
        tops, heights = self.climb(grid[order, best[order]], repeated, tolerance=tolerance, steps=steps)
        first = int(np.argmax(heights >= heights.max() - 1e-10 * n_trials))
        return tops[first], float(heights[first])

    def fit_many(self, answers: FloatArray, *, tolerance: float) -> FloatArray:
        """Fit one curve to each row of `answers`, to about √tolerance of a standard error of answers of 0 and 1.
        The likelihood may have a second top where the curve is a step, so each row climbs from two starts.
        """
        grid, curves = self.starts(), []
        size = _BATCH_ELEMENTS // len(self.z) + 1
        for batch in np.split(answers, range(size, len(answers), size)):
            steep, steep_loglik = self.climb_from_best(grid[:4].reshape(-1, 3), batch, tolerance)
            shallow, shallow_loglik = self.climb_from_best(grid[4:].reshape(-1, 3), batch, tolerance)
            curves.append(np.where((steep_loglik >= shallow_loglik - 1e-9)[:, None], steep, shallow))
        return np.concatenate(curves)

    def climb_from_best(
        self, grid: FloatArray, answers: FloatArray, tolerance: float
    ) -> tuple[FloatArray, FloatArray]:
        """Run `climb` on each row of `answers` from its most likely curve of `grid`."""
        n_right, weight, constant = self.grid_terms(grid, answers)
        rows = max(1, _SINGLE_THREAD_PRODUCT // weight.size)
        batches = np.split(n_right, range(rows, len(answers), rows))
        best = np.concatenate([(batch @ weight + constant).argmax(axis=1) for batch in batches])
        return self.climb(grid[best], answers, tolerance=tolerance, steps=25)


@dataclass(frozen=True, slots=True)
class WeibullModel(CurveModel):
    """Model of the Weibull curve: parameters `theta` are (ln α about the centre, ln β, δ)."""

    start_offsets = (0.0, -2.0, 1.5)
    is_convention = True

    def curves(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute P(right), P(wrong), (curve, level), and the first's derivative, (parameter, curve, level)."""
        location, ln_slope, lapse_rate = (theta[:, k, None] for k in range(3))
        slope = np.exp(ln_slope)
        offset = slope * (z - location)
        # The bounds keep ln P(wrong) >= -500, so that no ratio below overflows; no datum distinguishes it from −∞.
        hazard = np.exp(np.clip(offset + _LN_LN2, -500.0, math.log(500.0)))
        miss = np.exp(-hazard)
        hit = -np.expm1(-hazard)
        span = 1 - self.guess_rate - lapse_rate
        d_offset = span * miss * hazard
        jacobian = np.stack([-slope * d_offset, offset * d_offset, -hit])
        return self.guess_rate + span * hit, lapse_rate + span * miss, jacobian

    def ln_threshold(self, theta: FloatArray) -> FloatArray:
        """Return the ln threshold of each curve, about the centre; +inf where the criterion is above 1 − δ."""
        location, ln_slope, lapse_rate = theta.T
        left = 1 - lapse_rate - self.p_correct
        span = 1 - lapse_rate - self.guess_rate
        reached = left > 0
        ln_log2 = np.log(np.log2(span / np.where(reached, left, span / 2)))
        return np.where(reached, location + ln_log2 / np.exp(ln_slope), np.inf)

    def ceiling(self, theta: FloatArray) -> float:
        """Return 1 − δ."""
        return 1.0 - float(theta[2])

    def start_ceilings(self) -> FloatArray:
        """Return lapse rates from the lower limit to the upper."""
        return np.unique(np.linspace(self.lower[2], self.upper[2], 3))


@cache
def _cubics() -> FloatArray:
    """Return the cubics of ln P(wrong) between knots in d′, (power, piece), in units of the distance of the knots.
    They have the values and slopes of the integral, a sum over steps of 0.1 in t that is exact to rounding for
    functions this smooth. Halving the distance of the knots moves no P by more than 1e-8.
    """
    from scipy.special import ndtr

    d_prime = np.arange(LARGEST_D_PRIME * _KNOTS_PER_UNIT + 1)[:, None] / _KNOTS_PER_UNIT
    t = np.arange(-LARGEST_D_PRIME - 10.0, 10.0, 0.1)
    density = np.exp(-(t**2) / 2.0)
    others, own = ndtr(-(t + d_prime)), ndtr(t + d_prime)
    wrong = density * others * (1.0 + own + own**2)  # 1 − Φ³ without cancellation
    slope = -3.0 * density * own**2 * np.exp(-((t + d_prime) ** 2) / 2.0) / math.sqrt(2.0 * math.pi)
    scale = 0.1 / math.sqrt(2.0 * math.pi)
    value, slope = np.log(scale * wrong.sum(axis=1)), slope.sum(axis=1) / wrong.sum(axis=1) / _KNOTS_PER_UNIT
    rise = np.diff(value)
    powers = [value[:-1], slope[:-1], 3 * rise - 2 * slope[:-1] - slope[1:], slope[:-1] + slope[1:] - 2 * rise]
    return np.stack(powers)


def _ln_wrong(d_prime: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute ln P(wrong) and its derivative at d′ >= 0; the derivative is 0 from `LARGEST_D_PRIME` on."""
    knots = np.minimum(d_prime, LARGEST_D_PRIME) * _KNOTS_PER_UNIT
    piece = np.minimum(knots.astype(np.intp), int(LARGEST_D_PRIME) * _KNOTS_PER_UNIT - 1)
    u = knots - piece
    a, b, c, d = (power.take(piece) for power in _cubics())
    value = a + u * (b + u * (c + u * d))
    slope = np.where(d_prime < LARGEST_D_PRIME, (b + u * (2 * c + 3 * u * d)) * _KNOTS_PER_UNIT, 0.0)
    return value, slope


@cache
def d_prime_of(p_correct: float) -> float:
    """Return the d′ at a proportion correct < 1; 0 at the guess rate and below."""
    low, high = 0.0, LARGEST_D_PRIME
    # Each step halves the range: 60 of them leave 16 / 2^60, a rounding.
    for _ in range(60):
        middle = (low + high) / 2
        is_above = -math.expm1(float(_ln_wrong(np.array(middle))[0])) > p_correct
        low, high = (low, middle) if is_above else (middle, high)
    return low


@dataclass(frozen=True, slots=True)
class ObserverModel(CurveModel):
    """Model of the observer's curve: parameters `theta` are (ln α about the centre, ln β, 1/d_max²)."""

    start_offsets = (0.0, -1.0, 1.0)
    is_convention = False

    def curves(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute P(right), P(wrong), (curve, level), and the first's derivative, (parameter, curve, level)."""
        location, ln_slope, limit = (theta[:, k, None] for k in range(3))
        slope = np.exp(ln_slope)
        offset = slope * (z - location)
        # The bounds keep all powers below within the range of numbers; d′ beyond them is 0 or `LARGEST_D_PRIME`.
        by_level = np.exp(-2.0 * np.clip(offset, -100.0, 100.0))
        d_prime = 1.0 / np.sqrt(by_level + limit)
        ln_wrong, d_ln_wrong = _ln_wrong(d_prime)
        wrong = np.exp(ln_wrong)
        # −dP(wrong)/dd′ · d′³, as every derivative of d′ has this power of it.
        change = -wrong * d_ln_wrong * (d_prime * d_prime * d_prime)
        jacobian = np.stack([-slope * by_level * change, offset * by_level * change, -change / 2.0])
        return -np.expm1(ln_wrong), wrong, jacobian

    def ln_threshold(self, theta: FloatArray) -> FloatArray:
        """Return the ln threshold of each curve, about the centre; +inf where it is never reached."""
        location, ln_slope, limit = theta.T
        d_prime = d_prime_of(self.p_correct)
        if d_prime == 0.0:
            return np.full(len(theta), -np.inf)
        left = d_prime**-2.0 - limit
        reached = left > 0
        return np.where(
            reached, location - np.log(np.where(reached, left, 1.0)) / (2.0 * np.exp(ln_slope)), np.inf
        )

    def ceiling(self, theta: FloatArray) -> float:
        """Return P(right) at the largest d′."""
        limit = float(theta[2])
        return -math.expm1(float(_ln_wrong(np.array(limit**-0.5 if limit else math.inf))[0]))

    def start_ceilings(self) -> FloatArray:
        """Return 1/d_max² of no limit, and of limits at which P(right) is 0.98 and 0.8."""
        return np.unique(np.clip([0.0, 0.1, 0.35], self.lower[2], self.upper[2]))
