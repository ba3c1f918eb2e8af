"""The protocol of accuracy scenes: a triangle seen through something, and ways to find its threshold there.

Some draw independent trials (`MonteCarlo`), some place them evenly (`Quadrature`). Packages name scenes under the
entry-point group `todframes.accuracy_scenes`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np

from todframes.base._typing import FloatArray, IntArray
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_keys
from todframes.base.user_code import registered
from todframes.observers.decision import answer_probabilities

ENTRY_POINT_GROUP = "todframes.accuracy_scenes"

P_CORRECT = 0.75
"""Criterion of all thresholds."""


class Converged(NamedTuple):
    """The threshold with which estimators are compared.

    `bound` is the half-width of its own error, 95 % where that is random; `slope` is dP(correct) / d ln(level).
    """

    threshold: float
    bound: float
    slope: float


class ThresholdEstimate(NamedTuple):
    """P(correct) at the converged threshold, and the threshold; NaN where there is none."""

    p_correct: float
    threshold: float


class FoldedTrials(NamedTuple):
    """Independent trials as the folded observer sees them: score deviations without noise, (n, columns, 4), the
    covariance of the noise on them, (n, columns, 4, 4), and the number of the correct answer, (n, columns), both
    broadcast.

    `probabilities` is the function from scores to the probability of each answer; by default under Gaussian noise.
    """

    score: FloatArray
    covariance: FloatArray
    correct: IntArray
    probabilities: Callable[[FloatArray], FloatArray] | None = None


@dataclass(frozen=True, slots=True)
class MonteCarlo:
    """An estimator that draws independent trials.

    `prepare` sets up and returns `draw(n, rng)`: P(correct) of n independent trials, or 1 and 0 for answers, (n,
    columns). A column is a condition: one level, or each of many frames. `share` is that of a scene's time; from
    `smallest` trials on the error falls as 1/√N, and `fewest` are drawn at least.
    """

    name: str
    label: str
    prepare: Callable[[], Callable[[int, np.random.Generator], FloatArray]]
    share: float
    smallest: int = 1
    fewest: int = 64


@dataclass(frozen=True, slots=True)
class Quadrature:
    """An estimator that places its trials evenly.

    `prepare` sets up and returns `run(n, rng)`, an estimate from n trials. `budgets` are the numbers of trials to
    try, ascending; `share` is that of a scene's time; errors are taken over `repeats` estimates, 1 if nothing is
    drawn at random.
    """

    name: str
    label: str
    prepare: Callable[[], Callable[[int, np.random.Generator], ThresholdEstimate]]
    budgets: tuple[int, ...]
    share: float
    repeats: int = 1


@dataclass(frozen=True, slots=True)
class Variant:
    """A quadrature of one size with one change; the first one of a scene is the one that the others change.

    `prepare` gives `run(rng)`; the same `rng` must give the same trials.
    """

    label: str
    prepare: Callable[[], Callable[[np.random.Generator], ThresholdEstimate]]


@dataclass(frozen=True)
class StudyScene:
    """Base class of the scenes that estimators are tried on.

    `name` is that on the command line and in file names, `level` the kind of level that the threshold is.
    """

    name: str
    title: str
    description: str
    level: str

    def converge(self) -> Converged:
        """Compute the threshold with far less error than any estimator is given time for."""
        raise NotImplementedError

    def estimators(self, converged: Converged) -> Sequence[MonteCarlo | Quadrature]:
        """List the estimators, the literal Monte Carlo first; a `Quadrature` is a closed form."""
        raise NotImplementedError

    def variants(self, converged: Converged) -> Sequence[Variant]:
        """List the closed form as it is, then with single changes."""
        raise NotImplementedError

    def estimate(self, outcomes: FloatArray, converged: Converged) -> ThresholdEstimate:
        """Estimate the threshold from the mean of independent trials, (columns,): by default of one level, the
        converged one, to first order, and the slope there is taken as known.

        No way to choose levels needs fewer trials, and none of these knows the threshold beforehand.
        """
        p_correct = float(outcomes.mean())
        threshold = converged.threshold * math.exp((P_CORRECT - p_correct) / converged.slope)
        return ThresholdEstimate(p_correct, threshold)

    def non_gaussian_bound(self) -> float:
        """Bound the error in P(correct) of expected decisions from noise that is not Gaussian."""
        raise NotImplementedError


def monte_carlos(
    answers: Callable[[], Callable[[int, np.random.Generator], FloatArray]],
    trials: Callable[[], Callable[[int, np.random.Generator], FoldedTrials]],
    smallest: int = 1,
    fewest: int = 64,
) -> tuple[MonteCarlo, MonteCarlo, MonteCarlo]:
    """Make the three Monte Carlos that every linear observer has, from `prepare` of the literal one and a function
    that returns `draw(n, rng)` of `FoldedTrials`.
    """

    def drawn() -> Callable[[int, np.random.Generator], FloatArray]:
        draw = trials()

        def outcomes(n: int, rng: np.random.Generator) -> FloatArray:
            shown = draw(n, rng)
            # By eigenvectors, for the covariance of deviations from their mean is singular.
            values, vectors = np.linalg.eigh(shown.covariance)
            root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
            noise = (root @ rng.standard_normal((*shown.score.shape, 1)))[..., 0]
            return np.asarray((shown.score + noise).argmax(axis=-1) == shown.correct, dtype=np.float64)

        return outcomes

    def expected() -> Callable[[int, np.random.Generator], FloatArray]:
        draw = trials()

        def outcomes(n: int, rng: np.random.Generator) -> FloatArray:
            shown = draw(n, rng)
            if shown.probabilities is not None:
                answers = shown.probabilities(shown.score)
            else:
                answers = answer_probabilities(shown.score, shown.covariance)
            correct = np.broadcast_to(shown.correct, answers.shape[:-1])[..., None]
            return np.take_along_axis(answers, correct, axis=-1)[..., 0]

        return outcomes

    return (
        MonteCarlo("literal", "literal Monte Carlo", answers, 0.5, smallest, fewest),
        MonteCarlo("folded", "Monte Carlo on folded scores", drawn, 0.1, smallest, fewest),
        MonteCarlo("expected", "expected decisions, random phases", expected, 0.1, smallest, fewest),
    )


def find_scenes(names: Sequence[str]) -> dict[str, Callable[[], StudyScene]]:
    """Return the functions that make the scenes of these names, or all registered scenes if no name is given;
    SettingsError if there is no scene of a name, or it cannot be imported.
    """
    found = registered(ENTRY_POINT_GROUP)
    check_keys(names, found, argument.scene)
    scenes = {}
    for name in names or found:
        try:
            scenes[name] = cast("Callable[[], StudyScene]", found[name].load())
        except (ImportError, AttributeError) as error:
            raise SettingsError(f"{argument.scene}: {name!r} cannot be loaded ({error})") from None
    return scenes
