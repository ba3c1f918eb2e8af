"""The threshold of a sensor at one size, what limits it there, and the sizes worth asking for.

What limits is a share of the variance of the decision. The right answer wins while the three differences D of its
score from the others are positive. At threshold, over trials, each D varies for three reasons: the noise on the
observer's neurons (internal), that of the detectors, and the place of the triangle on the detectors and of the
retina on the display, which moves the mean of D (sampling). By the law of total variance, Var D =
E[Var(D | place)] + Var(E[D | place]); the first term is the sum of internal and detector noise, which are
independent. Where a threshold is never reached, the shares are those of the strongest signal. Shares say what
makes answers uncertain, not what makes the signal small: the transfer of optics and display lowers the mean of D,
and so raises all three.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from sensor_sim.chain.camera import Camera
from sensor_sim.chain.sampling import field_detectors, field_sampler
from sensor_sim.thresholds.curve_plan import Level, coarse_plan, plan_curve
from sensor_sim.thresholds.predict import (
    FoldedChain,
    PredictedThreshold,
    SensorTrials,
    covariance_at,
    pooled,
    predict_threshold,
)
from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import distinct_numbers
from todframes.observers.interface import Observer
from todframes.parameters import PlanName
from todframes.scoring.error_budget import REPLICATES
from todframes.stimulus import Stimulus


class Computed(NamedTuple):
    """A threshold, and the chain that it was computed with."""

    found: PredictedThreshold
    chain: FoldedChain


def threshold_at(
    camera: Camera,
    observer: Observer,
    size_detectors: float,
    *,
    p_correct: float,
    tolerance: float,
    seed: int,
    plan: PlanName = "needed",
    **search: Any,
) -> Computed:
    """Compute the threshold of a size in detectors; `search` is for `predict_threshold`. SettingsError if the
    observer is not linear, or the size or field is out of range.
    """
    steps = plan_curve(camera, observer, size_detectors, name=plan, tolerance=tolerance, p_correct=p_correct)
    chain = FoldedChain(camera, observer, size_detectors, steps)
    found = predict_threshold(chain, p_correct=p_correct, tolerance=tolerance, seed=seed, **search)
    return Computed(found, chain)


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
    internal = chain.noise_covariance / (value**2 if level == "contrast" or chain.variance is not None else 1.0)
    noise = [np.array(covariance_at(level, value, nothing, part, chain.variance), ndmin=4) for part in trials]
    return decision_shares(trials, internal, [of_part.mean(axis=(0, 1)) for of_part in noise])


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


LADDER_DETECTORS = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 24.0, 32.0)
"""Sizes from which those of a sensor are chosen: the smallest one that has a threshold, and the next ones."""

SIZES_CHOSEN = 5
"""Number of sizes that are chosen."""

ACUITY_STEP = 1.02
"""Factor between the smallest size that reaches a criterion and the next one that does not."""

CLOSE = 0.01
"""Distance of P(correct) from a criterion within which the coarse plan does not decide: 30 times its bound."""


def computed_sizes(camera: Camera, observer: Observer) -> Iterator[float]:
    """Yield the sizes of the ladder that are not too large for the sensor's field and the observer's retina."""
    for size in LADDER_DETECTORS:
        try:
            field_detectors(camera, size)
            observer.grid(Stimulus(size * camera.shown_pitch_mrad))
        except SettingsError:
            if size == LADDER_DETECTORS[0]:
                raise
            return
        yield size


def smallest_size(camera: Camera, observer: Observer, *, p_correct: float = 0.75, seed: int = 1) -> float | None:
    """Return the smallest size of the ladder at which the observer reaches a criterion; None if there is none."""
    for size in computed_sizes(camera, observer):
        if _is_reached(camera, observer, size, p_correct=p_correct, seed=seed):
            return size
    return None


def acuity_detectors(
    camera: Camera, observer: Observer, *, p_correct: float, seed: int
) -> tuple[float, float | None] | None:
    """Return the smallest size at which the observer reaches a criterion, and the largest below it, within
    `ACUITY_STEP`, at which it does not, or None if that is below the ladder. None if it reaches it at no size.
    """
    reached = smallest_size(camera, observer, p_correct=p_correct, seed=seed)
    if reached is None or reached == LADDER_DETECTORS[0]:
        return None if reached is None else (reached, None)
    unreached = LADDER_DETECTORS[LADDER_DETECTORS.index(reached) - 1]
    while reached > ACUITY_STEP * unreached:
        middle = float(f"{math.sqrt(reached * unreached):.4g}")
        if _is_reached(camera, observer, middle, p_correct=p_correct, seed=seed):
            reached = middle
        else:
            unreached = middle
    return reached, unreached


def _is_reached(camera: Camera, observer: Observer, size: float, *, p_correct: float, seed: int) -> bool:
    """Return whether a criterion is reached at a size. The coarse plan takes a small part of the time and memory
    of the exact one, and decides unless P(correct) is close to the criterion.
    """
    coarse = FoldedChain(camera, observer, size, coarse_plan(camera, observer, size))
    if coarse.unreached(p_correct - CLOSE, seed) is not None:
        return False
    if coarse.unreached(p_correct + CLOSE, seed) is None:
        return True
    return FoldedChain(camera, observer, size).unreached(p_correct, seed) is None


def chosen_sizes(camera: Camera, observer: Observer, smallest: float | None) -> list[float]:
    """Return the sizes, in detectors, that suit a sensor: its `smallest_size` and the next ones of the ladder; the
    largest ones if none has a threshold.
    """
    sizes = list(computed_sizes(camera, observer))
    return sizes[-SIZES_CHOSEN:] if smallest is None else sizes[sizes.index(smallest) :][:SIZES_CHOSEN]


def given_sizes(camera: Camera, size_detectors: Sequence[float], size_mrad: Sequence[float]) -> list[float]:
    """Return the sizes that are asked for, in detectors; empty if none are. SettingsError if angles are given too,
    a size is not a positive number or is there twice, or an angle is too large to compute.
    """
    if len(size_detectors) and len(size_mrad):
        both = f"{argument.size_detectors} and {argument.size_mrad}"
        raise SettingsError(f"found {both}, expected one of them, or none for sizes that suit the sensor")
    if len(size_mrad):
        return [_in_detectors(angle, camera) for angle in distinct_numbers(argument.size_mrad, size_mrad)]
    return distinct_numbers(argument.size_detectors, size_detectors) if len(size_detectors) else []


def _in_detectors(size_mrad: float, camera: Camera) -> float:
    size = float(f"{size_mrad / camera.pitch_mrad:.6g}")
    try:
        field_sampler(camera, size)
    except SettingsError as error:
        start = f"{argument.size_detectors}: found {size:g}, "
        if not str(error).startswith(start):
            raise
        found = f"{argument.size_mrad}: found {size_mrad:g}, {size:g} detectors, "
        raise SettingsError(found + str(error).removeprefix(start)) from None
    return size
