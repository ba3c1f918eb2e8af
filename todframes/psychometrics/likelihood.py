"""Maximum-likelihood fits of a psychometric function with three parameters, to one experiment or to many at once.

A curve is a function of ln level, moved along it by its first parameter. The likelihood of proportions is that of
counts, Σ n (p ln P + (1 − p) ln(1 − P)).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray

SLOPE_RANGE = (1e-2, 1e3)

EXTRAPOLATION_FACTOR = 2.0
"""Largest factor by which a threshold lies outside the levels."""

CHI2_95 = 3.841458820694124
"""95 % point of χ² with one degree of freedom."""

_BATCH_ELEMENTS = 1 << 20

# OpenBLAS starts threads for larger products; on a busy machine their waiting costs more than they save.
_SINGLE_THREAD_PRODUCT = 1 << 18


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
        slope, place, offset, ceiling = np.meshgrid(*parts, self.start_ceilings(), indexing="ij")
        grid = np.stack([place - offset / slope, np.log(slope), ceiling], axis=-1)
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
