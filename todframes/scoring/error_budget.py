"""What a computation does and what it leaves out: decided once, before it starts, and obeyed everywhere.

A plan is a list of steps. Each thing that is left out carries a bound on its effect on P(correct), found by
weighing it on a few trials; what is left out by an identity carries none. A thing whose bound does not fit into
the share of the tolerance that it has is kept.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from todframes._typing import FloatArray

PlanName = Literal["needed", "full"]


LEFT_OUT_SHARE = 0.5
"""Of the tolerance; the rest is for the number of trials."""


SAFETY = 2.0
"""What is left out is weighed on a few trials; others may differ from them, but not by as much as this."""


class Step(NamedTuple):
    """A line of a plan.

    Attributes
    ----------
    stage : str
        What could be left out.
    kept : bool
    why : str
        What is done, and the reason.
    bound : float
        On the change of P(correct); 0 if nothing changes.
    saves_s, saves_once_s : float
        Estimated time saved at each place that is computed, and once for all of them, in seconds.
    """

    stage: str
    kept: bool
    why: str
    bound: float = 0.0
    saves_s: float = 0.0
    saves_once_s: float = 0.0


def plan_object(steps: Sequence[Step], places: float) -> list[dict[str, Any]]:
    """A plan as it stands in `result.json`, with the time that it saves in all places together."""
    return [
        {
            "stage": step.stage,
            "kept": step.kept,
            "why": step.why,
            "bound": step.bound,
            "saves_s": round(step.saves_once_s + max(step.saves_s, 0.0) * places, 3),
        }
        for step in steps
    ]


def total_bound(steps: Sequence[Step]) -> float:
    """Bound on the change of P(correct) by everything that is left out together."""
    return math.fsum(step.bound for step in steps if not step.kept)


def decision_change(score_change: FloatArray, covariance: FloatArray, covariance_change: FloatArray) -> FloatArray:
    """Bound on the change of P(each answer) when scores and their covariance change.

    The answer is k while the differences D_j of score k from the others are positive. Moving their means by δ_j
    changes that with probability Σ |δ_j| / (σ_j √(2π)) at most, as no density of D_j exceeds 1/(σ_j √(2π)).
    Changing their covariance by E, relative to itself, changes the probability of any event by the total
    variation at most, which is ‖E‖/√8 by Pinsker's inequality, to first order in E.

    Parameters
    ----------
    score_change : ndarray, shape (..., 4)
    covariance, covariance_change : ndarray, shape (..., 4, 4)
        Broadcast against it.

    Returns
    -------
    ndarray, shape (..., 4)
        At most 1; 1 where differences have no noise.
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
    # In units of the standard deviations first, for the inversion's sake.
    units = scale[..., :, None] * scale[..., None, :]
    eigenvalues, vectors = np.linalg.eigh(before / units)
    root = vectors / np.sqrt(np.maximum(eigenvalues, 1e-12))[..., None, :]
    relative = root.swapaxes(-1, -2) @ (change / units) @ root
    by_noise = np.sqrt(np.square(relative).sum(axis=(-2, -1)) / 8.0)
    noiseless = (variance <= 0.0).any(axis=-1)
    return np.asarray(np.where(noiseless, 1.0, np.minimum(by_means + by_noise, 1.0)))
