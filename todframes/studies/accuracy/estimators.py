"""The protocol of accuracy scenes: a triangle seen through something, and ways to find its threshold there.

Some draw independent trials (`MonteCarlo`), some place them evenly (`Quadrature`). Packages name scenes under the
entry-point group `todframes.accuracy_scenes`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, cast

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
    """Independent trials as the folded observer sees them.

    Attributes
    ----------
    score : ndarray, shape (n, columns, 4)
        Score deviations without noise.
    covariance : ndarray, broadcast against (n, columns, 4, 4)
        Covariance of the noise on the scores.
    correct : ndarray of int, broadcast against (n, columns)
    probabilities : callable
        Function from scores to the probability of each answer; by default under Gaussian noise.
    """

    score: FloatArray
    covariance: FloatArray
    correct: IntArray
    probabilities: Callable[[FloatArray], FloatArray] | None = None


@dataclass(frozen=True, slots=True)
class MonteCarlo:
    """An estimator that draws independent trials.

    Attributes
    ----------
    name, label : str
    prepare : callable
        Function that sets up and returns `draw(n, rng)`: P(correct) of n independent trials, or 1 and 0 for
        answers, (n, columns). A column is a condition: one level, or each of many frames.
    share : float
        Share of a scene's time.
    smallest, fewest : int
        Trials from which on the error falls as 1/√N, and that are drawn at least.
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

    Attributes
    ----------
    name, label : str
    prepare : callable
        Function that sets up and returns `run(n, rng)`, an estimate from n trials.
    budgets : tuple of int
        Numbers of trials to try, ascending.
    share : float
        Share of a scene's time.
    repeats : int
        Estimates that an error is taken over; 1 if nothing is drawn at random.
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


class StudyScene(Protocol):
    """Protocol of a scene that estimators are tried on; register a callable that makes one."""

    @property
    def name(self) -> str:
        """Name on the command line and in file names."""

    @property
    def title(self) -> str:
        """Title in a few words."""

    @property
    def description(self) -> str:
        """Description of the scene, in a sentence or two."""

    @property
    def level(self) -> str:
        """Kind of level that the threshold is: contrast, snr."""

    def converge(self) -> Converged:
        """Compute the threshold with far less error than any estimator is given time for."""

    def estimators(self, converged: Converged) -> Sequence[MonteCarlo | Quadrature]:
        """List the estimators, the literal Monte Carlo first; a `Quadrature` is a closed form."""

    def variants(self, converged: Converged) -> Sequence[Variant]:
        """List the closed form as it is, then with single changes."""

    def estimate(self, outcomes: FloatArray, converged: Converged) -> ThresholdEstimate:
        """Estimate the threshold from the mean of independent trials: (columns,)."""

    def non_gaussian_bound(self) -> float:
        """Bound the error in P(correct) of expected decisions from noise that is not Gaussian."""


def monte_carlos(
    answers: Callable[[], Callable[[int, np.random.Generator], FloatArray]],
    trials: Callable[[], Callable[[int, np.random.Generator], FoldedTrials]],
    smallest: int = 1,
    fewest: int = 64,
) -> tuple[MonteCarlo, MonteCarlo, MonteCarlo]:
    """Make the three Monte Carlos that every linear observer has.

    Parameters
    ----------
    answers : callable
        `prepare` of the literal one.
    trials : callable
        Function that returns `draw(n, rng)` of `FoldedTrials`.
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


def estimate_at_one_level(outcomes: FloatArray, converged: Converged) -> ThresholdEstimate:
    """Estimate a threshold from trials at the converged one, to first order: the slope there is taken as known.

    No way to choose levels needs fewer trials, and none of these knows the threshold beforehand.
    """
    p_correct = float(outcomes.mean())
    threshold = converged.threshold * math.exp((P_CORRECT - p_correct) / converged.slope)
    return ThresholdEstimate(p_correct, threshold)


def find_scenes(names: Sequence[str]) -> dict[str, Callable[[], StudyScene]]:
    """Return the functions that make the scenes of these names, or all registered scenes if no name is given.

    Raises
    ------
    SettingsError
        If there is no scene of a name, or it cannot be imported.
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
