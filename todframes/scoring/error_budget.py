"""The steps of a plan: which stages a computation keeps or leaves out, and bounds on the resulting error.

A plan is made once, before a computation starts, and is a list of steps. Each stage that is left out has a bound
on its effect on P(correct), estimated on a few trials; a stage that is left out without any effect has the bound
0. A stage whose bound exceeds its share of the tolerance is kept. What is computed is a mean over independent
replicates of a low-discrepancy sequence, each shifted at random, whose spread gives its error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray

LEFT_OUT_SHARE = 0.5
"""Share of the tolerance for the stages that are left out; the rest is for the number of trials."""

SAFETY = 2.0
"""Safety factor of a bound: it is estimated on a few trials, and others may differ from them by less than this."""


class Step(NamedTuple):
    """A line of a plan: a stage of the computation that could be left out, whether it is kept, and why. `bound` is
    the bound on the change of P(correct), 0 if nothing changes, and `saves_s` the time that is saved, in seconds,
    if it was measured.
    """

    stage: str
    kept: bool
    why: str
    bound: float = 0.0
    saves_s: float | None = None


def plan_object(steps: Sequence[Step]) -> list[dict[str, Any]]:
    """Return a plan as written to `result.json`."""
    return [
        {name: getattr(step, name) for name in ("stage", "kept", "why", "bound")}
        | ({} if step.saves_s is None else {"saves_s": round(step.saves_s, 3)})
        for step in steps
    ]


def total_bound(steps: Sequence[Step]) -> float:
    """Return the bound on the change of P(correct) by all stages that are left out together."""
    return math.fsum(step.bound for step in steps if not step.kept)


def decision_change(score_change: FloatArray, covariance: FloatArray, covariance_change: FloatArray) -> FloatArray:
    """Compute a bound on the change of P(each answer), (…, 4), for a change of scores and of their covariance.

    The answer is k while the differences D_j of score k from the others are positive. Moving their means by δ_j
    changes that with probability Σ |δ_j| / (σ_j √(2π)) at most, as no density of D_j exceeds 1/(σ_j √(2π)).
    Changing their covariance by E, relative to itself, changes the probability of any event by the total variation
    at most, which is ‖E‖/√8 by Pinsker's inequality, to first order in E.

    `score_change`, (…, 4), is the change of the mean scores; the covariance of the scores and its change, (…, 4,
    4), are broadcast against it. The bound is at most 1; 1 if the score differences have no noise.
    """
    to_differences = np.array([np.delete(np.eye(4)[k] - np.eye(4), k, axis=0) for k in range(4)])
    mean = np.einsum("kij,...j->...ki", to_differences, score_change)
    before, change = (
        to_differences @ of_scores[..., None, :, :] @ to_differences.swapaxes(-1, -2)
        for of_scores in (covariance, covariance_change)
    )
    variance = np.diagonal(before, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    by_means = (np.abs(mean) / scale).sum(axis=-1) / math.sqrt(2.0 * math.pi)
    # Division by the standard deviations keeps the inversion well conditioned.
    units = scale[..., :, None] * scale[..., None, :]
    eigenvalues, vectors = np.linalg.eigh(before / units)
    root = vectors / np.sqrt(np.maximum(eigenvalues, 1e-12))[..., None, :]
    relative = root.swapaxes(-1, -2) @ (change / units) @ root
    by_noise = np.sqrt(np.square(relative).sum(axis=(-2, -1)) / 8.0)
    noiseless = (variance <= 0.0).any(axis=-1)
    return np.asarray(np.where(noiseless, 1.0, np.minimum(by_means + by_noise, 1.0)))


REPLICATES = 8
"""Number of independent replicates whose spread gives the error of their mean."""


def half_width_95(replicates: ArrayLike) -> float:
    """Compute the half-width of the 95 % interval of the mean of `REPLICATES` values. Trials are added until it is
    small enough, so that half of the 5 % is reserved for error estimates that were small by chance.
    """
    values = np.asarray(replicates, dtype=np.float64)
    student_t = 2.8412  # the 98.75 % point with `REPLICATES` − 1 degrees of freedom
    return student_t * float(values.std(ddof=1)) / math.sqrt(len(values))
