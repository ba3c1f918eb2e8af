"""Accuracy scene of recorded display frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, argument
from todframes.frames.dataset import load_dataset
from todframes.frames.trials import Trial
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.retina_view import read_trial, retina_image
from todframes.scoring.score import groups_of
from todframes.scoring.seen_trials import KRONECKER_STEPS_2D
from todframes.studies.accuracy.retina_scene import RetinaScene, Views

DATASETS = (Path("sample_frames/naked_eye"), Path("sample_frames/staring_camera"))
"""Folders that are searched for recorded frames."""


def by_sequence(n: int, columns: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Place a low-discrepancy sequence, begun anywhere for each trial: (n, columns, 2), and its weights, (n,)."""
    places = rng.random((columns, 2)) + np.arange(n)[:, None, None] * KRONECKER_STEPS_2D
    return 2.0 * (places % 1.0) - 1.0, np.full(n, 1.0 / n)


def recorded(
    path: Path | None = None, *, every: int = 1, converged_nodes: tuple[int, ...] = (6, 8)
) -> RetinaScene:
    """Make the scene of a dataset's middle group, by default of one of the sample sets in the current folder, or
    of `every` so many of its trials. All methods get the same frames, so the difference of these frames from
    others is no part of the error. DataError or SettingsError if there is no dataset, or it cannot be read.
    """
    if path is None:
        path = next((folder for folder in DATASETS if folder.is_dir()), None)
        if path is None:
            places = " or ".join(map(str, DATASETS))
            raise DataError(f"scene recorded: found no {places} here, expected a dataset ({argument.dataset})")
    dataset = load_dataset(path)
    groups = groups_of(dataset.trials)
    values, rows = groups[len(groups) // 2]
    trials = [dataset.trials[int(row)] for row in rows]
    trials = [trial for trial in trials if trial.name not in dataset.spoilt][::every]

    def views(observer: PyramidObserver) -> Views:
        corners = observer.position_jitter_samples * np.array([[-1.0, -1.0], [1.0, 1.0]])

        def image(trial: Trial) -> Callable[[float, float], FloatArray]:
            grid = observer.grid(trial.stimulus)
            shown = read_trial(dataset, trial, observer, grid, corners)
            return lambda x, y: retina_image(shown, grid, (x, y))

        correct = [trial.orientation.quarter_turns for trial in trials]
        return Views(observer, [trial.stimulus for trial in trials], [*map(image, trials)], correct)

    group = zip(dataset.experiment.group_by, values, strict=True)
    label = ", ".join(f"{name} {value}" for name, value in group)
    return RetinaScene(
        name="recorded",
        title=f"recorded frames: {dataset.path.name}, {label}, {len(trials)} trials",
        description="The frames are given, their noise included. What is averaged is the displacement of the "
        "retina and the observer's own noise; the threshold is that of the fitted psychometric function.",
        level=dataset.experiment.level,
        views=views,
        trial_levels=tuple(trial.level for trial in trials),
        place=by_sequence,
        converged_nodes=converged_nodes,
        smallest=4,  # fits to fewer answers of each frame are off by more than 1/√N
        fewest=16,
        label="closed form, low-discrepancy displacements",
        budgets=(1, 2, 4, 8, 16, 32, 64),
        repeats=8,
        variant_trials=4,
    )
