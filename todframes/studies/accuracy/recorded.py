"""Accuracy scene of recorded display frames: averages are over the retina's displacement and the observer's
noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, argument
from todframes.frames.dataset import Dataset, load_dataset
from todframes.frames.trials import Trial
from todframes.observers.interface import Readout
from todframes.observers.pyramid import PyramidObserver
from todframes.psychometrics.curves import weibull
from todframes.psychometrics.fit import FitSettings, PsychometricFit, fit_trials
from todframes.scoring.retina_view import read_trial, retina_image
from todframes.scoring.seen_trials import KRONECKER_STEPS_2D, scoring_of
from todframes.stimulus import Stimulus
from todframes.studies.accuracy.measure import (
    P_CORRECT,
    Converged,
    Draw,
    FoldedDraw,
    FoldedTrials,
    MonteCarlo,
    Quadrature,
    Rule,
    StudyScene,
    ThresholdEstimate,
    Variant,
    monte_carlos,
)

DATASETS = (Path("sample_frames/naked_eye"), Path("sample_frames/staring_camera"))
"""Folders that are searched for recorded frames."""

STUDIED_DISPLACEMENTS = (1, 2, 4, 8, 16, 32, 64)
REPEATS = 8
VARIANT_DISPLACEMENTS = 4


class Frames:
    """Trials, read once, as a linear observer sees them at any displacement of its retina. `readout_of` is the
    function from a stimulus to the readout that looks at it.
    """

    def __init__(
        self,
        dataset: Dataset,
        trials: Sequence[Trial],
        observer: PyramidObserver,
        readout_of: Callable[[Stimulus], Readout | None],
    ) -> None:
        self.jitter = observer.position_jitter_samples
        corners = self.jitter * np.array([[-1.0, -1.0], [1.0, 1.0]])
        of_stimulus = {trial.stimulus: readout_of(trial.stimulus) for trial in trials}
        self.readouts = [readout for trial in trials if (readout := of_stimulus[trial.stimulus]) is not None]
        self._shown = [
            read_trial(dataset, trial, observer, readout.grid, corners)
            for trial, readout in zip(trials, self.readouts, strict=True)
        ]
        self.covariance = np.array([readout.noise_covariance for readout in self.readouts])
        self.correct = np.array([trial.orientation.quarter_turns for trial in trials])

    def retina(self, number: int, displacement: FloatArray) -> FloatArray:
        """Return the retina image of a trial, displaced by shares of the largest displacement along x and y."""
        x, y = (self.jitter * displacement).tolist()
        return retina_image(self._shown[number], self.readouts[number].grid, (x, y))

    def score(self, displacements: FloatArray, dtype: type[np.floating] = np.float64) -> FloatArray:
        """Compute score deviations, (n, trials, 4), at displacements of shape (n, trials, 2)."""
        score = np.empty((*displacements.shape[:2], 4))
        for number, readout in enumerate(self.readouts):
            weights = readout.deviations.reshape(4, -1).astype(dtype)
            for row, displacement in enumerate(displacements[:, number]):
                score[row, number] = weights @ self.retina(number, displacement).ravel().astype(dtype)
        return score

    def p_correct(self, displacements: FloatArray, dtype: type[np.floating] = np.float64) -> FloatArray:
        """Probability of the correct answer, (n, trials)."""
        answers = self.answer_probabilities(self.score(displacements, dtype))
        return np.asarray(answers[:, np.arange(len(self.correct)), self.correct])

    def answer_probabilities(self, score: FloatArray) -> FloatArray:
        """Probability of each answer at score deviations, both (n, trials, 4)."""
        answers = [readout.answer_probabilities(score[:, number]) for number, readout in enumerate(self.readouts)]
        return np.stack(answers, axis=1)


@dataclass(frozen=True)
class Recorded(StudyScene):
    """Frames of one group of a dataset; the threshold is that of the fitted psychometric function. All estimators
    get the same frames, so the difference of these frames from others is no part of the error. The converged value
    is from so many Gauss–Legendre displacements along each axis, the larger number last.
    """

    dataset: Dataset
    trials: tuple[Trial, ...]
    converged_nodes: tuple[int, int] = (6, 8)

    def converge(self) -> Converged:
        """Average Gauss–Legendre displacements of every frame; the bound is the change from fewer of them."""
        frames = self._whole(PyramidObserver())
        coarse, fit = (self._fit(self._by_nodes(frames, nodes)) for nodes in self.converged_nodes)
        if fit.threshold is None or coarse.threshold is None:
            raise DataError(
                f"{self.dataset.path}: the scene has no threshold ({fit.status}); expected one that is ok"
            )
        step = 0.05
        low, high = (_curve(fit, fit.threshold * math.exp(way * step)) for way in (-1.0, 1.0))
        return Converged(fit.threshold, abs(coarse.threshold - fit.threshold), (high - low) / (2.0 * step))

    def estimators(self, converged: Converged) -> tuple[MonteCarlo | Quadrature, ...]:
        """List the literal Monte Carlo, that on folded scores, expected decisions and a sequence of places."""

        def answers() -> Draw:
            observer = PyramidObserver()
            frames = self._whole(observer)
            for trial in self.trials:
                observer.templates(trial.stimulus)

            def draw(n: int, rng: np.random.Generator) -> FloatArray:
                right = np.empty((n, len(self.trials)))
                for pass_, number in np.ndindex(right.shape):
                    seen = frames.retina(number, rng.uniform(-1.0, 1.0, 2))
                    answer = observer.respond(seen, self.trials[number].stimulus, rng)
                    right[pass_, number] = answer.quarter_turns == frames.correct[number]
                return right

            return draw

        def trials() -> FoldedDraw:
            frames = self._planned()

            def draw(n: int, rng: np.random.Generator) -> FoldedTrials:
                displacements = rng.uniform(-1.0, 1.0, (n, len(self.trials), 2))
                score = frames.score(displacements)
                return FoldedTrials(score, frames.covariance, frames.correct, frames.answer_probabilities)

            return draw

        def closed_form() -> Rule:
            frames = self._planned()
            return lambda n, rng: self.estimate(
                frames.p_correct(_sequence(n, len(self.trials), rng)).mean(0), converged
            )

        label = "closed form, low-discrepancy displacements"
        return (
            # Fits to fewer answers of each frame are off by more than that.
            *monte_carlos(answers, trials, smallest=4, fewest=16),
            Quadrature("closed_form", label, closed_form, STUDIED_DISPLACEMENTS, 0.3, REPEATS),
        )

    def variants(self, converged: Converged) -> dict[str, Variant]:
        """List single precision, what the plan leaves out kept, and one pyramid level less."""
        sides = [PyramidObserver().grid(trial.stimulus).side for trial in self.trials]
        levels = max(sides).bit_length() - 3

        def variant(frames_of: Callable[[], Frames], dtype: type[np.floating] = np.float64) -> Variant:
            def run(rng: np.random.Generator) -> ThresholdEstimate:
                frames, displacements = frames_of(), _sequence(VARIANT_DISPLACEMENTS, len(self.trials), rng)
                return self.estimate(frames.p_correct(displacements, dtype).mean(axis=0), converged)

            return run

        def whole(observer: PyramidObserver) -> Variant:
            return variant(lambda: self._whole(observer))

        return {
            "as planned": variant(self._planned),
            "float32": variant(self._planned, np.float32),
            "whole retina": whole(PyramidObserver()),
            "one pyramid level more": whole(PyramidObserver().with_extra_level()),
            "one pyramid level less": whole(PyramidObserver(levels=levels - 1)),
        }

    def estimate(self, outcomes: FloatArray, converged: Converged) -> ThresholdEstimate:
        """Fit P(correct) of each trial. Returns the curve at the converged threshold, and its own threshold."""
        fit = self._fit(outcomes)
        if fit.threshold is None:
            return ThresholdEstimate(math.nan, math.nan)
        return ThresholdEstimate(_curve(fit, converged.threshold), fit.threshold)

    def non_gaussian_bound(self) -> float:
        """Return the bound that the readout states."""
        observer = PyramidObserver()
        return max(observer.linear_readout(trial.stimulus).non_gaussian_bound for trial in self.trials)

    def _whole(self, observer: PyramidObserver) -> Frames:
        return Frames(self.dataset, self.trials, observer, observer.readout)

    def _planned(self) -> Frames:
        observer = PyramidObserver()
        scoring = scoring_of(self.dataset, observer, plan="needed", decisions="expected", seed=1)
        return Frames(self.dataset, self.trials, observer, scoring.readout)

    def _by_nodes(self, frames: Frames, nodes: int) -> FloatArray:
        places, weights = np.polynomial.legendre.leggauss(nodes)
        displacements = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 1, 2)
        p_correct = frames.p_correct(np.broadcast_to(displacements, (nodes**2, len(self.trials), 2)))
        return np.asarray(np.outer(weights, weights).ravel() / 4.0 @ p_correct)

    def _fit(self, p_correct: FloatArray) -> PsychometricFit:
        level = [trial.level for trial in self.trials]
        settings = FitSettings(p_correct=P_CORRECT, resamples=0)
        return fit_trials(level, np.clip(p_correct, 0.0, 1.0), settings=settings, rng=np.random.default_rng(0))


def _sequence(n: int, trials: int, rng: np.random.Generator) -> FloatArray:
    """Draw displacements of each trial, (n, trials, 2): a low-discrepancy sequence begun anywhere for each."""
    places = rng.random((trials, 2)) + np.arange(n)[:, None, None] * KRONECKER_STEPS_2D
    return np.asarray(2.0 * (places % 1.0) - 1.0)


def _curve(fit: PsychometricFit, level: float) -> float:
    assert fit.alpha is not None and fit.beta is not None and fit.lapse_rate is not None
    return float(
        weibull(level, alpha=fit.alpha, beta=fit.beta, guess_rate=fit.guess_rate, lapse_rate=fit.lapse_rate)
    )


def recorded(path: Path | None = None) -> Recorded:
    """Make the scene of a dataset's middle group, by default of one of the sample sets in the current folder;
    DataError or SettingsError if there is none, or it cannot be read.
    """
    if path is None:
        path = next((folder for folder in DATASETS if folder.is_dir()), None)
        if path is None:
            places = " or ".join(map(str, DATASETS))
            raise DataError(f"scene recorded: found no {places} here, expected a dataset ({argument.dataset})")
    dataset = load_dataset(path)
    groups: dict[tuple[float | str, ...], list[Trial]] = {}
    for trial in dataset.trials:
        if trial.name not in dataset.spoilt:
            groups.setdefault(trial.group, []).append(trial)
    # Numbers before texts, each in their order.
    in_order = sorted(groups, key=lambda group: [(isinstance(value, str), value) for value in group])
    trials = tuple(groups[in_order[len(groups) // 2]])
    experiment = dataset.experiment
    group = zip(experiment.group_by, trials[0].group, strict=True)
    label = ", ".join(f"{name} {value}" for name, value in group)
    return Recorded(
        "recorded",
        f"recorded frames: {dataset.path.name}, {label}, {len(trials)} trials",
        "The frames are given, their noise included. What is averaged is the displacement of the retina and the "
        "observer's own noise; the threshold is that of the fitted psychometric function.",
        experiment.level,
        dataset,
        trials,
    )
