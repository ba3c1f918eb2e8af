"""The Weibull psychometric function and its maximum-likelihood fit, of one experiment or of many at once.

Hogervorst et al. 2001, eq. 3: p(x) = (1 − δ) − (1 − δ − γ)·2^−(x/α)^β. In ln x the curve is a complementary
log-log model, ln(ln 2) + β·(ln x − ln α), with a guess and a lapse rate: that is what is fitted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from todframes._typing import FloatArray

BETA_RANGE = (1e-2, 1e3)
_LN_LN2 = math.log(math.log(2.0))
_BATCH_ELEMENTS = 1 << 20

# OpenBLAS starts threads for larger products; on a busy machine their waiting costs more than they save.
_SINGLE_THREAD_PRODUCT = 1 << 18


def weibull(level: ArrayLike, *, alpha: float, beta: float, guess_rate: float, lapse_rate: float) -> FloatArray:
    """Compute the proportion correct at levels >= 0, of any shape, in the unit of `alpha`.

    `alpha` > 0 is the level at 1 − δ − (1 − δ − γ)/2, `beta` > 0 the slope, `guess_rate` γ and `lapse_rate` δ the
    floor and the distance of the ceiling from 1.

    Hogervorst et al. 2001, eq. 3.
    """
    with np.errstate(over="ignore"):
        exponent = (np.asarray(level, dtype=np.float64) / alpha) ** beta
    return np.asarray((1 - lapse_rate) - (1 - lapse_rate - guess_rate) * np.exp2(-exponent))


def weibull_level(
    p_correct: ArrayLike, *, alpha: float, beta: float, guess_rate: float, lapse_rate: float
) -> FloatArray:
    """Return the level of a raw proportion correct, the inverse of `weibull`: 0 up to γ, inf from 1 − δ on."""
    span = 1 - lapse_rate - guess_rate
    left = np.clip(1 - lapse_rate - np.asarray(p_correct, dtype=np.float64), 0.0, span)
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(alpha * np.log2(span / left) ** (1 / beta))


def binomial_loglik(share: ArrayLike, p: ArrayLike) -> FloatArray:
    """Compute the log-likelihood of p per trial if this share of the answers is right; 0 · ln 0 counts as 0."""
    share, p = np.asarray(share, np.float64), np.asarray(p, np.float64)
    with np.errstate(divide="ignore"):
        right, wrong = np.log(np.where(share > 0, p, 1.0)), np.log(np.where(share < 1, 1.0 - p, 1.0))
    return np.asarray(share * right + (1.0 - share) * wrong)


@dataclass(frozen=True, slots=True)
class WeibullModel:
    """Levels, trials and parameter limits that a psychometric function is fitted with.

    `z` is ln level about its centre; parameters `theta` are (ln α about the same centre, ln β, δ), within `lower`
    and `upper`.
    """

    z: FloatArray
    n_trials: FloatArray
    guess_rate: float
    p_correct: float
    lower: FloatArray
    upper: FloatArray

    def curves(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute P(right), P(wrong), (curve, level), and the first's derivative, (parameter, curve, level)."""
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

    def derivatives(self, theta: FloatArray, answers: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute log-likelihood, score and Fisher information of each row of `answers` under its `theta`."""
        right, wrong, jacobian = self.curves(theta, self.z)
        loglik = np.einsum("bl,l->b", answers * np.log(right) + (1 - answers) * np.log(wrong), self.n_trials)
        residual = self.n_trials * (answers / right - (1 - answers) / wrong)
        score = np.einsum("bl,jbl->bj", residual, jacobian)
        weighted = (self.n_trials / (right * wrong)) * jacobian
        return loglik, score, np.einsum("ibl,jbl->bij", weighted, jacobian)

    def ln_threshold(self, theta: FloatArray) -> FloatArray:
        """Return the ln threshold of each curve, about the centre; +inf where the criterion is above 1 − δ."""
        location, ln_slope, lapse_rate = theta.T
        left = 1 - lapse_rate - self.p_correct
        span = 1 - lapse_rate - self.guess_rate
        reached = left > 0
        ln_log2 = np.log(np.log2(span / np.where(reached, left, span / 2)))
        return np.where(reached, location + ln_log2 / np.exp(ln_slope), np.inf)

    def climb(
        self, theta: FloatArray, answers: FloatArray, *, tolerance: float, steps: int
    ) -> tuple[FloatArray, FloatArray]:
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

    def influence(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return P(right) of a curve at each level, and the move of ln x_c by a residual of 1 there."""
        right, wrong, jacobian = (values.squeeze(-2) for values in self.curves(theta[None], self.z))
        left, span, slope = 1 - theta[2] - self.p_correct, 1 - theta[2] - self.guess_rate, math.exp(theta[1])
        ratio = math.log(span / left)
        gradient = np.array([1, -math.log(ratio / math.log(2)) / slope, (1 / left - 1 / span) / ratio / slope])
        free = (theta > self.lower) & (theta < self.upper)
        root = jacobian[free] * np.sqrt(self.n_trials / (right * wrong))
        # Far from all levels the information, its square, leaves the range of numbers.
        size = max(float(np.abs(root).max(initial=0.0)), 1e-300)
        inverse = np.linalg.pinv(root / size @ (root / size).T, hermitian=True)
        weight: FloatArray = gradient[free] @ inverse @ (jacobian[free] / size) / size
        return right, weight / (right * wrong)

    def starts(self) -> FloatArray:
        """Make a coarse grid of curves, (slope, curve, parameter), steep ones first: the first of equals wins."""
        z = np.quantile(self.z, np.linspace(0, 1, min(len(self.z), 12)))
        slope = np.array([1000.0, 100.0, 20.0, 8.0, 4.0, 2.0, 1.0, 0.4, 0.1, 0.01])
        parts = (slope, np.concatenate([(z[1:] + z[:-1]) / 2, z]), np.array([0.0, -2.0, 1.5]))
        lapse_rates = np.unique(np.linspace(self.lower[2], self.upper[2], 3))
        slope, place, offset, lapse_rate = np.meshgrid(*parts, lapse_rates, indexing="ij")
        grid = np.stack([place - offset / slope, np.log(slope), lapse_rate], axis=-1)
        return grid.reshape(len(grid), -1, 3)

    def grid_terms(self, grid: FloatArray, answers: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return trials right, (row, pool), and the weight and constant of each curve's log-likelihood.

        At most 64 pools of neighbouring levels keep this small for any number of levels.
        """
        first = np.unique(np.linspace(0, len(self.z), 65)[:-1].astype(np.intp))
        n_trials = np.add.reduceat(self.n_trials, first)
        z = np.add.reduceat(self.n_trials * self.z, first) / n_trials
        right, wrong, _ = self.curves(grid, z)
        n_right = np.add.reduceat(answers * self.n_trials, first, axis=1)
        tie_break = 1e-9 * n_trials.sum() * np.linspace(0, 1, len(grid))
        return n_right, np.log(right / wrong).T, np.einsum("gl,l->g", np.log(wrong), n_trials) - tie_break

    def fit_one(self, answers: FloatArray) -> tuple[FloatArray, float]:
        """Return the best of the climbs from the best start of each slope, and its log-likelihood."""
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

    def fit_many(self, answers: FloatArray) -> FloatArray:
        """Fit one curve to each row of `answers`, to about √tolerance = 1 % of a standard error.

        The likelihood may have a second top where the curve is a step, so each row climbs from two starts.
        """
        grid, curves = self.starts(), []
        size = _BATCH_ELEMENTS // len(self.z) + 1
        for batch in np.split(answers, range(size, len(answers), size)):
            steep, steep_loglik = self.climb_from_best(grid[:4].reshape(-1, 3), batch)
            shallow, shallow_loglik = self.climb_from_best(grid[4:].reshape(-1, 3), batch)
            curves.append(np.where((steep_loglik >= shallow_loglik - 1e-9)[:, None], steep, shallow))
        return np.concatenate(curves)

    def climb_from_best(self, grid: FloatArray, answers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Run `climb` on each row of `answers` from its most likely curve of `grid`."""
        n_right, weight, constant = self.grid_terms(grid, answers)
        rows = max(1, _SINGLE_THREAD_PRODUCT // weight.size)
        batches = np.split(n_right, range(rows, len(answers), rows))
        best = np.concatenate([(batch @ weight + constant).argmax(axis=1) for batch in batches])
        return self.climb(grid[best], answers, tolerance=1e-4, steps=25)
