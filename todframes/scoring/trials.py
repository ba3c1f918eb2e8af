"""The scores of single trials: frames are shown to the observer with one or many displacements."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from todframes._typing import FloatArray
from todframes.errors import FrameError, SettingsError
from todframes.frames.contrast import skipped_frames
from todframes.frames.dataset import Dataset, Skipped
from todframes.frames.position import check_place
from todframes.frames.trials import Trial
from todframes.observers.interface import Observer, Readout
from todframes.observers.internal_noise import inner_product
from todframes.observers.retina import RetinaGrid
from todframes.scoring.plan import ScorePlan
from todframes.scoring.retina_view import Shown, read_trial, retina_image
from todframes.stimulus import Stimulus
from todframes.threads import map_in_threads

T = TypeVar("T")


Decisions = Literal["expected", "sampled"]


TRIALS_PER_TASK = 16
"""Number of trials that a thread takes at a time."""


NO_ANSWER = -1
"""Answer of a trial for which none was drawn."""


# First elements of the spawn keys of random streams: they keep the streams of trials and fits apart.
TRIAL_STREAMS, FIT_STREAMS, DISPLACEMENT_STREAMS, RATIO_STREAMS = range(4)


REPLICATES = 8
"""Number of independent sets of displacements; their spread gives the error of the average."""


KRONECKER_STEPS = np.array([0.7548776662466927, 0.5698402909980532])
"""Steps of a two-dimensional low-discrepancy sequence, powers of the root of x³ = x + 1 (Roberts 2018)."""


class SeenTrial(NamedTuple):
    """The observer's scores of a trial and, if drawn, its answer.

    Attributes
    ----------
    trial : Trial
    displacement_samples : ndarray, shape (d, 2)
        Displacements of the retina grid along x and y, in retina samples.
    scores, deviations : ndarray, shape (d, 4)
        Noise-free inner products with the templates, and their deviations from their mean, computed without
        cancellation; NaN if the observer is not linear.
    answer : int
        Answer drawn, an index into `ORIENTATIONS`, or `NO_ANSWER`.
    n_negative : int
        Number of display pixels with a luminance below zero.
    background_luminance_cd_m2 : float
        Luminance that contrast refers to, averaged over the trial's frames.
    seconds : float
        Time that the trial took.
    """

    trial: Trial
    displacement_samples: FloatArray
    scores: FloatArray
    deviations: FloatArray
    answer: int
    n_negative: int
    background_luminance_cd_m2: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Scoring:
    """The settings for the scoring of all trials of a dataset; they do not change, so threads share them.

    `displacements` is the number of displacements of each trial in each replicate; 0: a single one, from the
    trial's own random stream.
    """

    dataset: Dataset
    plan: ScorePlan
    decisions: Decisions
    seed: int
    displacements: int = 0


class Look(NamedTuple):
    """The observer, retina grid and displacements for a trial, the same for all ways in which it is shown.

    `displacement_samples`, (d, 2), are the displacements of the retina grid in retina samples; `rng` is the
    trial's own random stream after they were drawn. `readout` is None if the observer is not linear.
    """

    observer: Observer
    grid: RetinaGrid
    displacement_samples: FloatArray
    rng: np.random.Generator
    readout: Readout | None


def look_at(scoring: Scoring, trial: Trial, readout: Readout | None) -> Look:
    """Return the observer, retina grid and displacements for a trial.

    Raises
    ------
    SettingsError
        If the observer is not linear and its answer is not drawn.
    """
    if readout is None and scoring.decisions == "expected":
        raise SettingsError("decisions: found 'expected', but this observer is not linear; expected 'sampled'")
    observer = scoring.plan.observer_of(trial.stimulus)
    rng = np.random.default_rng(np.random.SeedSequence(scoring.seed, spawn_key=(TRIAL_STREAMS, trial.number)))
    displaced = _displacements(scoring, trial, rng, observer.position_jitter_samples)
    grid = observer.grid(trial.stimulus) if readout is None else readout.grid
    return Look(observer, grid, displaced, rng, readout)


def see(scoring: Scoring, trial: Trial, look: Look, ways: Sequence[Shown], started: float) -> list[SeenTrial]:
    """Show a trial to the observer in each of several ways, with the same displacements and the same noise.

    Parameters
    ----------
    ways : sequence of Shown
        The trial as shown in each way.
    started : float
        Value of `time.perf_counter` at the start of the trial; the time since then is divided among the ways.

    Returns
    -------
    list of SeenTrial
        One for each way.
    """
    reading_s = (time.perf_counter() - started) / len(ways)
    displaced, state = look.displacement_samples, look.rng.bit_generator.state
    seen = []
    for shown in ways:
        started = time.perf_counter()
        scores = deviations = np.full((len(displaced), 4), np.nan)
        answer = NO_ANSWER
        if look.readout is not None:
            pairs = [_scores(look.readout, retina_image(shown, look.grid, (dx, dy))) for dx, dy in displaced]
            scores, deviations = (np.array(part) for part in zip(*pairs, strict=True))
        if scoring.decisions == "sampled":
            image = retina_image(shown, look.grid, (displaced[0, 0], displaced[0, 1]))
            look.rng.bit_generator.state = state
            answer = look.observer.respond(image, trial.stimulus, look.rng).quarter_turns
        seconds = reading_s + time.perf_counter() - started
        background = shown.background_luminance_cd_m2
        seen.append(SeenTrial(trial, displaced, scores, deviations, answer, shown.n_negative, background, seconds))
    return seen


def score_trial(scoring: Scoring, trial: Trial, readout: Readout | None) -> SeenTrial:
    """Read a trial and show it to the observer.

    Raises
    ------
    FrameError
        If a frame cannot be used.
    SettingsError
        If the observer is not linear and its answer is not drawn.
    """
    started = time.perf_counter()
    look = look_at(scoring, trial, readout)
    shown = read_trial(
        scoring.dataset,
        trial,
        look.observer,
        look.grid,
        look.displacement_samples,
        whole=scoring.plan.whole_frames,
    )
    (seen,) = see(scoring, trial, look, [shown], started)
    return seen


def _displacements(scoring: Scoring, trial: Trial, rng: np.random.Generator, jitter: float) -> FloatArray:
    if not scoring.displacements:
        return rng.uniform(-jitter, jitter, (1, 2))
    key = (DISPLACEMENT_STREAMS, scoring.displacements, trial.number)
    shifts = np.random.default_rng(np.random.SeedSequence(scoring.seed, spawn_key=key)).random((REPLICATES, 1, 2))
    evenly = (shifts + np.arange(scoring.displacements)[:, None] * KRONECKER_STEPS) % 1.0
    return np.asarray(jitter * (2.0 * evenly.reshape(-1, 2) - 1.0))


def _scores(readout: Readout, contrast: FloatArray) -> tuple[FloatArray, FloatArray]:
    deviations = readout.score_deviations(contrast)
    # Without noise or with huge contrast, equal scores may differ by rounding alone.
    rounding = 1e-13 * readout.norm * math.sqrt(inner_product(contrast, contrast))
    deviations = np.where(np.abs(deviations) < rounding, 0.0, deviations)
    return deviations + readout.common_score(contrast), deviations


def see_trials(
    scoring: Scoring,
    trials: Sequence[Trial],
    show: Callable[[Scoring, Trial, Readout | None], T],
    *,
    skip_bad_frames: bool,
    workers: int,
    progress: Callable[[int], None] | None,
) -> tuple[list[T], list[Skipped]]:
    """Show trials to the observer in threads; return the results and the frames that were skipped.

    Parameters
    ----------
    scoring : Scoring
    trials : sequence of Trial
    show : function
        Function called for each trial from any thread: `score_trial`, or one that raises the same errors.
    skip_bad_frames : bool
        Skip trials that cannot be read and list their frames, instead of raising the first error.
    workers : int
        Number of threads.
    progress : callable or None
        Called with the number of trials and skipped frames since the last call.

    Raises
    ------
    FrameError
        If a frame cannot be used, unless bad frames are skipped.
    """
    # Trials of one stimulus follow each other, so that few readouts are held at a time.
    order = sorted(trials, key=lambda trial: (trial.stimulus.size_mrad, trial.stimulus.polarity))
    tasks = [order[start : start + TRIALS_PER_TASK] for start in range(0, len(order), TRIALS_PER_TASK)]
    readout_of = lru_cache(maxsize=4)(scoring.plan.readout)
    fitting: set[Stimulus] = set()

    def show_task(task: list[Trial]) -> tuple[list[T], list[Skipped]]:
        seen, skipped = [], []
        for trial in task:
            try:
                if trial.stimulus not in fitting:  # check first: a readout may be huge
                    check_place(scoring.dataset, trial, scoring.plan.observer.centre)
                    fitting.add(trial.stimulus)
                try:
                    readout = readout_of(trial.stimulus)
                except SettingsError as error:  # an error about this row's size
                    raise FrameError(scoring.dataset.frame_path(trial.frames[0]), str(error)) from None
                seen.append(show(scoring, trial, readout))
            except FrameError as error:
                if not skip_bad_frames:
                    raise
                skipped += skipped_frames(scoring.dataset, trial, error)
        return seen, skipped

    # Threads, not processes: decoding releases the interpreter lock, and no worker can die with its results.
    all_seen: list[T] = []
    all_skipped: list[Skipped] = []
    with closing(map_in_threads(show_task, tasks, workers)) as results:
        for seen, skipped in results:
            all_seen += seen
            all_skipped += skipped
            if progress is not None:
                progress(len(seen) + len(skipped))
    return all_seen, all_skipped
