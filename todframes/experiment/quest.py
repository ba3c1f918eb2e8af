"""QUEST+: the adaptive choice of the next level. It is the level with the least expected entropy of the posterior.

Watson 2017, "QUEST+: a general multidimensional Bayesian adaptive psychometric method", J. Vision 17(3):10.
The posterior of threshold, slope and lapse rate is held on a grid. The psychometric function is Weibull's, with
the parameters of Hogervorst et al. 2001, eq. 3. Trials are independent, so the posterior follows from the counts
of right and wrong answers at each level, in whatever order they came.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.psychometrics.curves import GUESS_RATE, weibull

BEYOND_LEVELS = 3.0
"""Factor by which the thresholds of the grid reach beyond the smallest and the largest level."""

N_ALPHA, SLOPES, N_SLOPES, LAPSE_RATES, N_LAPSE_RATES = 61, (0.5, 8.0), 9, (0.0, 0.05), 6
"""Ranges and numbers of the grid's parameters: α and β evenly in their logarithm, δ evenly."""

SMALLEST_P = 1e-300
"""Smallest probability of an answer; its logarithm is finite."""


@dataclass(frozen=True, slots=True, eq=False)
class QuestGrid:
    """A grid of psychometric functions, and the probabilities of the answers to each level under each of them.
    `levels`, (l,), rise; the parameters have shape (g,), and `p_answer`, (2, l, g), are the probabilities of a
    wrong and of a right answer.
    """

    levels: FloatArray
    alpha: FloatArray
    beta: FloatArray
    lapse_rate: FloatArray
    p_answer: FloatArray

    @classmethod
    def of_levels(cls, levels: ArrayLike) -> QuestGrid:
        """Return the grid for levels > 0; its parameters have equal prior probabilities."""
        levels = np.unique(np.asarray(levels, np.float64))
        alpha = np.geomspace(levels[0] / BEYOND_LEVELS, levels[-1] * BEYOND_LEVELS, N_ALPHA)
        each = np.meshgrid(
            alpha, np.geomspace(*SLOPES, N_SLOPES), np.linspace(*LAPSE_RATES, N_LAPSE_RATES), indexing="ij"
        )
        alpha, beta, lapse_rate = (values.ravel() for values in each)
        right = weibull(levels[:, None], alpha=alpha, beta=beta, guess_rate=GUESS_RATE, lapse_rate=lapse_rate)
        return cls(levels, alpha, beta, lapse_rate, np.maximum(np.stack([1.0 - right, right]), SMALLEST_P))

    def posterior(self, n_wrong: ArrayLike, n_right: ArrayLike) -> FloatArray:
        """Compute the posterior probabilities of the grid's functions, (…, g), from the numbers of wrong and right
        answers at each level, (…, l).
        """
        counts = [np.asarray(n, np.float64) for n in (n_wrong, n_right)]
        ln = sum(n @ np.log(p) for n, p in zip(counts, self.p_answer, strict=True))
        likelihood = np.exp(ln - np.max(ln, axis=-1, keepdims=True))
        return np.asarray(likelihood / likelihood.sum(axis=-1, keepdims=True))

    def expected_entropy(self, posterior: FloatArray) -> FloatArray:
        """Compute the entropy of the posterior that is expected after one trial at each level, in nats, (…, l).
        The posterior after answer r at level x is p(r|x, θ)·p(θ)/p(r|x), with p(r|x) = Σ p(r|x, θ)·p(θ). Its
        entropy, weighted by p(r|x), is p(r|x)·ln p(r|x) − Σ p(r|x, θ)·p(θ)·ln(p(r|x, θ)·p(θ)): products of the
        tables with vectors.
        """
        weighted = posterior * np.log(np.maximum(posterior, SMALLEST_P))
        entropy = np.zeros((*posterior.shape[:-1], self.levels.size))
        for p in self.p_answer:
            of_answer = posterior @ p.T
            entropy += of_answer * np.log(np.maximum(of_answer, SMALLEST_P))
            entropy -= posterior @ (p * np.log(p)).T + weighted @ p.T
        return entropy
