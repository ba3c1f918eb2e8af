"""Dataset × observer → scored trials → one psychometric fit a group: a TOD curve."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from todframes.dataset import Dataset, Skipped, Trial
from todframes.decision import answer_probabilities
from todframes.errors import SettingsError
from todframes.psychometric import FitSettings, PsychometricFit, fit_trials
from todframes.readout import Observer, Stimulus
from todframes.running import FIT_STREAMS, run_trials, trial_draws
from todframes.viewing import View, view_trial

FloatArray = NDArray[np.float64]
Decisions = Literal["expected", "sampled"]

# Columns of the numbers kept of each trial.
DISPLACEMENT, SCORES, DEVIATIONS, ANSWER, N_NEGATIVE = slice(0, 2), slice(2, 6), slice(6, 10), 10, 11

NO_ANSWER = -1


@dataclass(frozen=True, slots=True)
class GroupFit:
    """The psychometric fit of the trials that share the values of the `group_by` columns.

    `non_gaussian_bound` bounds the error in P(correct) from taking the summed internal noise as Gaussian; 0 where
    answers were drawn with noise on every neuron.
    """

    group: tuple[float | str, ...]
    fit: PsychometricFit
    non_gaussian_bound: float


@dataclass(frozen=True, slots=True)
class ScoredDataset:
    """Scores of every trial that could be read, and the fits.

    Attributes
    ----------
    trials : tuple of Trial
        In the order of the manifest, as are the rows of the arrays.
    displacement_samples : ndarray, shape (n, 2)
        Of the retina grid along x and y, in retina samples.
    scores, probabilities : ndarray, shape (n, 4)
        Noise-free inner products with the templates and the probability of each answer, in the order of
        `ORIENTATIONS`; NaN where the observer is not linear.
    answers : ndarray of int, shape (n,)
        Answer drawn, or the most probable one; an index into `ORIENTATIONS`.
    p_correct : ndarray, shape (n,)
        Probability of the correct answer; 1 or 0 where an answer was drawn.
    fits : tuple of GroupFit
    skipped : tuple of Skipped
    n_negative : int
        Display pixels with a luminance below zero, among those read.
    """

    trials: tuple[Trial, ...]
    displacement_samples: FloatArray
    scores: FloatArray
    probabilities: FloatArray
    answers: NDArray[np.intp]
    p_correct: FloatArray
    fits: tuple[GroupFit, ...]
    skipped: tuple[Skipped, ...]
    n_negative: int


def score_dataset(
    dataset: Dataset,
    observer: Observer,
    *,
    decisions: Decisions = "expected",
    seed: int = 1,
    fit_settings: FitSettings | None = None,
    skip_bad_frames: bool = False,
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> ScoredDataset:
    """Show every trial to the observer and fit a psychometric function to each group.

    The result depends on the seed alone: each trial has its own random stream, whatever the order or the number
    of workers.

    Parameters
    ----------
    decisions : {"expected", "sampled"}
        Probability of a correct answer under the internal noise, or one answer drawn a trial with noise on every
        neuron, as the paper does.
    skip_bad_frames : bool
        Go on without trials that cannot be read and list them, instead of raising the first error.
    workers : int
        Threads that read and score.
    progress : callable
        Told the number of trials done, whenever some are.

    Raises
    ------
    FrameError, DataError
        The first thing wrong with a row or frame, unless bad ones are skipped.
    SettingsError
        If decisions are "expected" and the observer is not linear.
    """
    job = _Scorer(dataset, observer, decisions, seed)
    trials, table, skipped = run_trials(
        dataset, job, skip_bad_frames=skip_bad_frames, workers=workers, progress=progress
    )
    return assemble(trials, table, skipped, observer, decisions, seed, fit_settings or FitSettings())


@dataclass(frozen=True, slots=True)
class _Scorer:
    """Shows a trial to the observer: the numbers kept of it."""

    dataset: Dataset
    observer: Observer
    decisions: Decisions
    seed: int

    def __call__(self, trial: Trial) -> FloatArray:
        rng, displacement = trial_draws(self.observer, trial, self.seed)
        view = view_trial(self.dataset, trial, self.observer, displacement)
        return scored_view(view, trial, self.observer, self.decisions, rng, displacement)


def scored_view(
    view: View,
    trial: Trial,
    observer: Observer,
    decisions: Decisions,
    rng: np.random.Generator,
    displacement_samples: tuple[float, float],
) -> FloatArray:
    """The numbers kept of a view, shape (12,), before decisions are worked out for all trials together.

    Raises
    ------
    SettingsError
        If decisions are "expected" and the observer is not linear.
    """
    readout = observer.readout(trial.stimulus)
    scores = deviations = np.full(4, np.nan)
    if readout is not None:
        deviations = readout.score_deviations(view.contrast)
        if not readout.noise_covariance.any():
            # Without noise nothing but rounding may tell scores apart that are the same.
            rounding = 1e-13 * np.linalg.norm(readout.deviations) * np.linalg.norm(view.contrast)
            deviations = np.where(np.abs(deviations) < rounding, 0.0, deviations)
        scores = deviations + readout.common_score(view.contrast)
    elif decisions == "expected":
        raise SettingsError("decisions: found 'expected', but this observer is not linear; expected 'sampled'")
    answer = NO_ANSWER
    if decisions == "sampled":
        answer = observer.respond(view.contrast, trial.stimulus, rng).quarter_turns
    return np.array([*displacement_samples, *scores, *deviations, answer, view.n_negative])


def assemble(
    trials: tuple[Trial, ...],
    table: FloatArray,
    skipped: Sequence[Skipped],
    observer: Observer,
    decisions: Decisions,
    seed: int,
    fit_settings: FitSettings,
) -> ScoredDataset:
    """Decisions and fits of trials from `scored_view` of each, shape (trial, 12)."""
    probabilities, bounds = _decide(trials, table, observer)
    correct = np.array([trial.orientation.quarter_turns for trial in trials])
    if decisions == "sampled":
        answers = table[:, ANSWER].astype(np.intp)
        p_correct = (answers == correct).astype(np.float64)
        bounds[:] = 0.0
    else:
        answers = probabilities.argmax(axis=1)
        p_correct = probabilities[np.arange(len(trials)), correct]
    return ScoredDataset(
        trials=trials,
        displacement_samples=table[:, DISPLACEMENT],
        scores=table[:, SCORES],
        probabilities=probabilities,
        answers=answers,
        p_correct=p_correct,
        fits=_fit_groups(trials, p_correct, bounds, seed, fit_settings),
        skipped=tuple(skipped),
        n_negative=int(table[:, N_NEGATIVE].sum()),
    )


def _decide(trials: tuple[Trial, ...], table: FloatArray, observer: Observer) -> tuple[FloatArray, FloatArray]:
    """Probability of each answer, and the bound on its error from noise that is not Gaussian, of each trial."""
    probabilities = np.full((len(trials), 4), np.nan)
    bounds = np.zeros(len(trials))
    places: dict[Stimulus, list[int]] = {}
    for place, trial in enumerate(trials):
        places.setdefault(trial.stimulus, []).append(place)
    for stimulus, these in places.items():
        readout = observer.readout(stimulus)
        if readout is not None:
            deviations = table[these, DEVIATIONS]
            probabilities[these] = answer_probabilities(deviations, readout.noise_covariance)
            bounds[these] = readout.non_gaussian_bound
    return probabilities, bounds


def _fit_groups(
    trials: tuple[Trial, ...],
    p_correct: FloatArray,
    bounds: FloatArray,
    seed: int,
    fit_settings: FitSettings,
) -> tuple[GroupFit, ...]:
    places: dict[tuple[float | str, ...], list[int]] = {}
    for place, trial in enumerate(trials):
        places.setdefault(trial.group, []).append(place)
    level = np.array([trial.level for trial in trials])
    fits = []
    # Numbers before texts, each in their order.
    for number, group in enumerate(sorted(places, key=lambda g: [(isinstance(v, str), v) for v in g])):
        these = places[group]
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(FIT_STREAMS, number)))
        fit = fit_trials(level[these], p_correct[these], settings=fit_settings, rng=rng)
        fits.append(GroupFit(group, fit, float(bounds[these].max())))
    return tuple(fits)
