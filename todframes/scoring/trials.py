"""A trial → the numbers that decide it: its frames through the observer, with one or many displacements."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple, Protocol, TypeVar

import numpy as np

from todframes._typing import FloatArray
from todframes.errors import FrameError, SettingsError
from todframes.frames.contrast import skipped_frames
from todframes.frames.dataset import Dataset, Skipped, Trial
from todframes.observers.interface import Readout
from todframes.observers.retina import RetinaGrid
from todframes.scoring.plan import ScorePlan
from todframes.scoring.retina_view import Reader, read_as_it_is, retina_image
from todframes.threads import map_in_threads

T = TypeVar("T")


T_co = TypeVar("T_co", covariant=True)


ReadoutOf = Callable[[Trial], Readout | None]


Decisions = Literal["expected", "sampled"]


TRIALS_PER_TASK = 16


NO_ANSWER = -1


# First element of the spawn keys of random streams, so that no trial shares one with a fit.
TRIAL_STREAMS, FIT_STREAMS, DISPLACEMENT_STREAMS, RATIO_STREAMS = range(4)


REPLICATES = 8
"""Independent sets of displacements, which tell how well the displacements are averaged over."""


KRONECKER_STEPS = np.array([0.7548776662466927, 0.5698402909980532])
"""Powers of the root of x³ = x + 1: a two-dimensional low-discrepancy sequence (Roberts 2018)."""


class SeenTrial(NamedTuple):
    """What the observer made of a trial.

    Attributes
    ----------
    trial : Trial
    displacement_samples : ndarray, shape (d, 2)
        Of the retina grid along x and y.
    scores, deviations : ndarray, shape (d, 4)
        Noise-free inner products with the templates, and the same less their mean with all digits; NaN where the
        observer is not linear.
    answer : int
        The one drawn, an index into `ORIENTATIONS`, or `NO_ANSWER`.
    n_negative : int
        Display pixels with a luminance below zero.
    seconds : float
        That it took.
    """

    trial: Trial
    displacement_samples: FloatArray
    scores: FloatArray
    deviations: FloatArray
    answer: int
    n_negative: int
    seconds: float


class Scorer(Protocol[T_co]):
    """What `see_trials` does with each trial, from any thread."""

    @property
    def dataset(self) -> Dataset:
        """Where the trials are from."""

    @property
    def plan(self) -> ScorePlan:
        """Whose readouts it is given."""

    def __call__(self, trial: Trial, readout_of: ReadoutOf) -> T_co:
        """Show one trial; FrameError if a frame cannot be used."""


@dataclass(frozen=True, slots=True)
class TrialScorer:
    """Scores trials; holds nothing that changes, so threads share it.

    `displacements` is how many each trial has in each of the replicates; 0: one alone, from its own stream.
    """

    dataset: Dataset
    plan: ScorePlan
    decisions: Decisions
    seed: int
    displacements: int = 0

    def __call__(self, trial: Trial, readout_of: ReadoutOf) -> SeenTrial:
        """Show one trial.

        Raises
        ------
        FrameError
            If a frame cannot be used.
        SettingsError
            If the observer is not linear and its answer is not drawn.
        """
        (seen,) = self.see(trial, readout_of, read_as_it_is)
        return seen

    def see(self, trial: Trial, readout_of: ReadoutOf, read: Reader) -> list[SeenTrial]:
        """Show one trial in each of the ways that `read` gives, with the same displacements and the same noise.

        Errors are those of showing one, and of `read`.
        """
        started = time.perf_counter()
        observer = self.plan.observer_of(trial.stimulus)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(TRIAL_STREAMS, trial.number)))
        displaced = self._displacements(trial, rng, observer.position_jitter_samples)

        def grid_of() -> RetinaGrid:
            observer.grid(trial.stimulus)  # refuses what is too large before its readout is made
            readout = readout_of(trial)
            return observer.grid(trial.stimulus) if readout is None else readout.grid

        ways = read(self.dataset, trial, observer, grid_of, displaced, whole=self.plan.whole_frames)
        reading_s = (time.perf_counter() - started) / len(ways)
        readout, grid = readout_of(trial), grid_of()
        if readout is None and self.decisions == "expected":
            raise SettingsError("decisions: found 'expected', but this observer is not linear; expected 'sampled'")
        seen, state = [], rng.bit_generator.state
        for shown in ways:
            started = time.perf_counter()
            scores = deviations = np.full((len(displaced), 4), np.nan)
            answer = NO_ANSWER
            if readout is not None:
                pairs = [_scores(readout, retina_image(shown, grid, (dx, dy))) for dx, dy in displaced]
                scores, deviations = (np.array(part) for part in zip(*pairs, strict=True))
            if self.decisions == "sampled":
                image = retina_image(shown, grid, (displaced[0, 0], displaced[0, 1]))
                rng.bit_generator.state = state
                answer = observer.respond(image, trial.stimulus, rng).quarter_turns
            seconds = reading_s + time.perf_counter() - started
            seen.append(SeenTrial(trial, displaced, scores, deviations, answer, shown.n_negative, seconds))
        return seen

    def _displacements(self, trial: Trial, rng: np.random.Generator, jitter: float) -> FloatArray:
        if not self.displacements:
            return rng.uniform(-jitter, jitter, (1, 2))
        key = (DISPLACEMENT_STREAMS, self.displacements, trial.number)
        shifts = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key)).random((REPLICATES, 1, 2))
        evenly = (shifts + np.arange(self.displacements)[:, None] * KRONECKER_STEPS) % 1.0
        return np.asarray(jitter * (2.0 * evenly.reshape(-1, 2) - 1.0))


def _scores(readout: Readout, contrast: FloatArray) -> tuple[FloatArray, FloatArray]:
    deviations = readout.score_deviations(contrast)
    # Without noise, or where contrast is huge, nothing but rounding may tell scores apart that are the same.
    rounding = 1e-13 * readout.norm * float(np.linalg.norm(contrast))
    deviations = np.where(np.abs(deviations) < rounding, 0.0, deviations)
    return deviations + readout.common_score(contrast), deviations


def see_trials(
    scorer: Scorer[T],
    trials: Sequence[Trial],
    *,
    skip_bad_frames: bool,
    workers: int,
    progress: Callable[[int], None] | None,
) -> tuple[list[T], list[Skipped]]:
    """Show trials, in threads, and list the frames of those that cannot be used, if they may be skipped.

    Raises
    ------
    FrameError
        The first thing wrong with a frame, unless bad ones are skipped.
    """
    # Trials of one stimulus together, so that few readouts are held at a time.
    order = sorted(trials, key=lambda trial: (trial.stimulus.size_mrad, trial.stimulus.polarity))
    tasks = [order[start : start + TRIALS_PER_TASK] for start in range(0, len(order), TRIALS_PER_TASK)]
    readout_of_stimulus = lru_cache(maxsize=4)(scorer.plan.readout)

    def see(task: list[Trial]) -> tuple[list[T], list[Skipped]]:
        seen, skipped = [], []
        for trial in task:
            try:
                seen.append(scorer(trial, lambda one: readout_of_stimulus(one.stimulus)))
            except FrameError as error:
                if not skip_bad_frames:
                    raise
                skipped += skipped_frames(scorer.dataset, trial, error)
        return seen, skipped

    # Threads: decoding releases the interpreter lock, and no worker process can die and take results along.
    all_seen: list[T] = []
    all_skipped: list[Skipped] = []
    with closing(map_in_threads(see, tasks, workers)) as results:
        for seen, skipped in results:
            all_seen += seen
            all_skipped += skipped
            if progress is not None:
                progress(len(seen) + len(skipped))
    return all_seen, all_skipped
