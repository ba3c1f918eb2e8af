"""People that are models: they sit an experiment without a browser and answer by the literal model.

Every answer is made as the paper says: the picture on the monitor falls on a displaced retina, each neuron gets
its own noise, the largest of four correlations answers. Nothing is folded and no probability is computed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from todframes.experiment.answers import AnswerFile, data_path, sidecar_path, write_sidecar
from todframes.experiment.monitor import (
    Calibration,
    Monitor,
    calibrated,
    shown_codes,
    shown_contrast,
    trial_image,
    viewing_distance_mm,
)
from todframes.experiment.order import TrialOrder
from todframes.experiment.session import make_picture, new_record, shown_dataset
from todframes.frames.contrast import ContrastPatch
from todframes.frames.dataset import Dataset
from todframes.frames.trials import Trial
from todframes.observers.pyramid import PyramidObserver
from todframes.parameters import Method
from todframes.scoring.trial_scores import TrialPatches, retina_image
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus

Answer = Callable[[Trial, int], Orientation]
"""Function that answers a trial with a seed of its dither."""


MEASURES = Calibration(
    device_pixel_ratio=1.0,
    pixel_pitch_mm=0.25,
    viewing_distance_mm=1000.0,
    gamma=2.2,
    screen_px=(1920, 1080),
    viewport_px=(1900, 1000),
)
"""Measures of a monitor that shows the frames of small datasets as they are."""


def a_monitor(pitch_mrad: float, *, dither: bool = True) -> Monitor:
    """A monitor at the distance from which its pixels have a visual angle."""
    distance_mm = viewing_distance_mm(pixel_pitch_mm=0.25, pixel_pitch_mrad=pitch_mrad)
    return calibrated(replace(MEASURES, viewing_distance_mm=distance_mm), background=0.5, dither=dither)


def model_person(
    dataset: Dataset, monitor: Monitor, *, noise: float, rng: np.random.Generator, lapses: float = 0.0
) -> Answer:
    """A person whose neurons have this internal noise, and who guesses with the probability `lapses`."""
    observer = PyramidObserver(internal_noise=noise)
    ratio = monitor.pixel_pitch_mrad / dataset.display.pitch_mrad

    def answer(trial: Trial, dither_seed: int) -> Orientation:
        if rng.random() < lapses:
            return ORIENTATIONS[rng.integers(4)]
        image = trial_image(dataset, trial)
        contrast = shown_contrast(shown_codes(image.contrast, monitor, dither_seed), monitor)
        place = image.triangle
        shown = TrialPatches(
            (ContrastPatch(contrast, 0, 0, 0),), (place.x_px,), (place.y_px,), monitor.pixel_pitch_mrad, 0
        )
        stimulus = Stimulus(trial.stimulus.size_mrad * ratio, trial.stimulus.polarity)
        dx, dy = rng.uniform(-0.5, 0.5, 2)
        return observer.respond(retina_image(shown, observer.grid(stimulus), (dx, dy)), stimulus, rng)

    return answer


def sit(
    dataset: Dataset,
    folder: Path,
    answer: Answer,
    monitor: Monitor,
    *,
    subject: str = "a1",
    method: Method = "constant",
    n_trials: int | None = None,
    practice: int = 0,
    seed: int = 1,
) -> Path:
    """Answer the trials of a session in the order that a page would show them; return its data file."""
    design = {
        "method": method,
        "seed": seed,
        "trials": len(dataset.trials) if n_trials is None else n_trials,
        "practice": practice,
        "practice_correct": 0.0,
        "break_every": 0,
        "dither": monitor.dither,
    }
    record = replace(new_record(dataset, shown_dataset(dataset), subject, design), monitor=monitor)
    path = data_path(folder, subject)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_sidecar(sidecar_path(path), record)
    order = TrialOrder(dataset.trials, record)
    with AnswerFile(path) as file:
        file.begin(record.dataset)
        while (following := order.next(file.rows)) is not None:
            row, seed = make_picture(dataset, monitor, following).row, following.dither_seed
            response = answer(dataset.trials[following.row], seed)
            file.append(replace(row, response=response, response_time_ms=500.0, dither_seed=seed))
    return path
