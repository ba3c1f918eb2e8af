"""Shares of the causes that limit a sensor at its threshold: internal noise, detector noise and sampling.

The decision is a comparison of scores: the right answer wins while the three differences D of its score from the
others are positive. At threshold, over trials, each D varies for three reasons:

- **internal**: the noise on the observer's neurons;
- **detector**: the noise of the detectors, at the threshold;
- **sampling**: the place of the triangle on the detectors, and of the retina on the display, moves the mean of D.

By the law of total variance, Var D = E[Var(D | place)] + Var(E[D | place]); the first term is the sum of internal
and detector noise, which are independent. So the three are shares of one variance, with the sum 1, and follow from
the trials that gave the threshold: they are the mean over the three differences, each with its own variance.
Where a threshold is never reached, the shares are those of the strongest signal: without detector noise, or for a
camera that counts photons, at the contrast that saturates its pixels.

Shares say what makes answers uncertain, not what makes the signal small: the transfer of optics and display lowers
the mean of D, and so raises all three.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sensor_sim.thresholds.curve_plan import Level
from sensor_sim.thresholds.predict import FoldedChain, SensorTrials, covariance_at, pooled
from todframes.base._typing import FloatArray
from todframes.scoring.error_budget import REPLICATES

WITHOUT_NOISE, SATURATING = "without detector noise", "at the contrast that saturates the pixels"
"""The strongest signal of a sensor with an SNR, and that of a camera that counts photons."""

SEED = 1
"""Seed of the places, that of `curve` if no other is asked for."""

LEADING_SHARE = 0.5
"""Share from which one of the three causes is named as the only limit."""


class Shares(NamedTuple):
    """Shares of the variance of the decision at threshold; their sum is 1."""

    internal: float
    detector: float
    sampling: float


NAMES = ("the observer's internal noise", "detector noise", "sampling")


def decision_shares(
    phases: Sequence[SensorTrials], internal: FloatArray, detector: Sequence[FloatArray]
) -> Shares:
    """Return the shares of the variance of the score differences that decide. The trials of each orientation are
    those of a triangle of contrast 1. `internal`, (4, 4), is the covariance of the internal noise on the scores
    over the square of the triangle's contrast, and `detector` that of the detectors' noise, for each orientation.
    """
    shares = []
    for part, of_detectors in zip(phases, detector, strict=True):
        others = np.delete(np.eye(4)[part.correct] - np.eye(4), part.correct, axis=0)
        by_internal = np.einsum("ik,kl,il->i", others, internal, others)
        by_detector = np.einsum("ik,kl,il->i", others, of_detectors, others)
        by_sampling = (part.signal.reshape(-1, 4) @ others.T).var(axis=0)
        of_each = np.stack([by_internal, by_detector, by_sampling])
        shares.append((of_each / np.maximum(of_each.sum(axis=0), np.finfo(float).tiny)).mean(axis=1))
    return Shares(*np.mean(shares, axis=0).tolist())


def shares_at(chain: FoldedChain, level: Level, threshold: float | None, seed: int = SEED) -> Shares:
    """Return the shares at a threshold, or without one at the strongest signal, of the trials of a seed."""
    value, nothing = threshold or chain.largest_level, np.zeros((4, 4))
    trials = pooled(chain.replicates(chain.lattices[0], seed, REPLICATES if threshold else 1))
    phases = [chain.at(part, value) for part in trials]
    internal = chain.noise_covariance / (value**2 if level == "contrast" or chain.variance is not None else 1.0)
    noise = [np.array(covariance_at(level, value, nothing, part, chain.variance), ndmin=4) for part in phases]
    return decision_shares(phases, internal, [of_part.mean(axis=(0, 1)) for of_part in noise])


def what_limits(
    sizes_detectors: Sequence[float],
    shares: Sequence[Shares],
    statuses: Sequence[str],
    strongest: str = WITHOUT_NOISE,
) -> tuple[Shares, str]:
    """Return the mean shares of the sizes with a threshold, and what limits a curve in one sentence. If none has
    one, the means are over all sizes. `strongest` is the signal, in words, that never reached a threshold.
    """
    chosen = [share for share, status in zip(shares, statuses, strict=True) if status == "ok"]
    mean = Shares(*np.mean(chosen or list(shares), axis=0).tolist())
    (most, first), *others = sorted(zip(mean, NAMES, strict=True), reverse=True)
    rest = [f"{name} {100.0 * share:.0f} %" for share, name in others if share > 0.0] or ["nothing else does"]
    verb = "limits" if most >= LEADING_SHARE else "weighs most"
    at = [f"{size:g}" for size, status in zip(sizes_detectors, statuses, strict=True) if status == "never_reached"]
    without = f"no threshold at {', '.join(at)} detectors, even {strongest}"
    weights = f"{first} {verb}: {100.0 * most:.0f} % of what makes answers vary at threshold ({', '.join(rest)})"
    unknown = "no threshold is known well enough to say what limits it"
    parts = [*([weights] if chosen else []), *([without] if at else [])] or [unknown]
    sentence = "; ".join(parts) + "."
    return mean, sentence[0].upper() + sentence[1:]
