"""Every trial of a dataset through one job, in threads: in any order, with the same result."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from todframes.dataset import Dataset, Skipped, Trial
from todframes.errors import DataError, FrameError
from todframes.readout import Observer
from todframes.viewing import left_out

FloatArray = NDArray[np.float64]
Job = Callable[[Trial], FloatArray]
TaskResult = tuple[list[Trial], list[FloatArray], list[Skipped]]

TRIALS_PER_TASK = 16
# First element of the spawn keys of random streams, so that no trial shares one with a fit.
TRIAL_STREAMS, FIT_STREAMS, RATIO_STREAMS = 0, 1, 2


def run_trials(
    dataset: Dataset,
    job: Job,
    *,
    skip_bad_frames: bool = False,
    workers: int = 1,
    progress: Callable[[int], None] | None = None,
) -> tuple[tuple[Trial, ...], FloatArray, list[Skipped]]:
    """Do a job for every trial: the trials that could be used and the numbers of each, in the manifest's order.

    `job` gives an array of one shape for each trial, or raises FrameError. The rest is as in `score_dataset`.

    Raises
    ------
    FrameError, DataError
        The first thing wrong with a row or frame, unless bad ones are skipped.
    """
    if dataset.bad_rows and not skip_bad_frames:
        raise DataError(dataset.bad_rows[0].error)
    whole = [trial for trial in dataset.trials if trial.name not in dataset.spoilt]
    # Trials of one stimulus together, so that few readouts are held at a time.
    order = sorted(whole, key=lambda trial: (trial.stimulus.size_mrad, trial.stimulus.polarity))
    tasks = [order[start : start + TRIALS_PER_TASK] for start in range(0, len(order), TRIALS_PER_TASK)]
    task = _Task(dataset, job, skip_bad_frames)
    trials: list[Trial] = []
    tables: list[FloatArray] = []
    skipped = list(dataset.bad_rows)
    for trial in dataset.trials:
        if trial.name in dataset.spoilt:
            skipped += left_out(dataset, trial, f"another frame of trial {trial.name} cannot be used")
    for task_trials, task_tables, task_skipped in _map(task, tasks, workers):
        trials += task_trials
        tables += task_tables
        skipped += task_skipped
        if progress is not None:
            progress(len(task_trials) + len(task_skipped))
    if not trials:
        raise DataError(f"{dataset.path}: no frame can be scored; the first: {skipped[0].error}")
    order_of_manifest = np.argsort([trial.number for trial in trials])
    return tuple(trials[place] for place in order_of_manifest), np.array(tables)[order_of_manifest], skipped


@dataclass(frozen=True, slots=True)
class _Task:
    """Does a job for a few trials; holds nothing that changes, so threads share it."""

    dataset: Dataset
    job: Job
    skip_bad_frames: bool

    def __call__(self, trials: list[Trial]) -> TaskResult:
        seen, tables, skipped = [], [], []
        for trial in trials:
            try:
                tables.append(self.job(trial))
                seen.append(trial)
            except FrameError as error:
                if not self.skip_bad_frames:
                    raise
                skipped += left_out(self.dataset, trial, error)
        return seen, tables, skipped


def trial_draws(observer: Observer, trial: Trial, seed: int) -> tuple[np.random.Generator, tuple[float, float]]:
    """A trial's own random stream, and the displacement along x and y drawn from it, in retina samples."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(TRIAL_STREAMS, trial.number)))
    jitter = observer.position_jitter_samples
    dx, dy = (float(d) for d in rng.uniform(-jitter, jitter, 2))
    return rng, (dx, dy)


def _map(job: _Task, tasks: list[list[Trial]], workers: int) -> Iterator[TaskResult]:
    if workers == 1:
        yield from map(job, tasks)
        return
    # Threads: decoding releases the interpreter lock, and no worker process can die and take results along.
    with ThreadPoolExecutor(workers) as pool:
        try:
            yield from pool.map(job, tasks)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
