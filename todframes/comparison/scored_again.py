"""The trials of a saved result, beside the frames of its dataset."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from todframes.base.errors import TodframesError
from todframes.comparison.conditions import columns_of, series_of
from todframes.frames.dataset import Dataset, load_dataset
from todframes.observers.interface import Observer, observer_named, setting_names
from todframes.results.data import DatasetRecord
from todframes.results.result import Result
from todframes.results.thresholds import Thresholds
from todframes.scoring.score import GroupFit, ScoredDataset


def scored_again(result: Result, max_frame_mb: int) -> tuple[Dataset, Observer, ScoredDataset] | None:
    """Return the dataset, observer and answers of a saved result of `score`; None unless the dataset is there as
    it was, its triangles were where the manifest says, all trials were scored and saved, and the observer has a
    name.
    """
    record = result.dataset if isinstance(result, Thresholds) and result.command == "score" else None
    if not isinstance(record, DatasetRecord) or not isinstance(result, Thresholds) or result.located:
        return None
    try:
        data, series = load_dataset(record.path, max_frame_mb=max_frame_mb), series_of(result)
        observer = _observer_of(result.settings)
    except TodframesError:
        return None
    if series is None or observer is None or len(series.p_correct) != len(data.trials):
        return None
    if DatasetRecord.of(data).manifest_sha256 != record.manifest_sha256 or not record.manifest_sha256:
        return None
    columns = columns_of(result.trials)
    displaced = [columns[f"displacement_{axis}_samples"] for axis in "xy"]
    none = np.empty((0, 4))
    scored = ScoredDataset(
        trials=data.trials,
        displacement_samples=np.array(displaced, np.float64).T,
        scores=none,
        probabilities=none,
        answers=np.empty(0, np.intp),
        p_correct=series.p_correct,
        fits=tuple(
            GroupFit(data.trials.groups[data.trials.group_codes[rows[0]]], fit, 0.0, None, 0, math.nan)
            for rows, fit in zip(series.rows, series.fits, strict=True)
        ),
        skipped=(),
        n_negative=0,
    )
    return replace(data, gaze=result.settings.get("gaze", data.gaze)), observer, scored


def _observer_of(settings: dict[str, Any]) -> Observer | None:
    """Return the observer of a result; None if its name is that of a file or class, whose code is not run."""
    name = str(settings.get("observer", ":"))
    if ":" in name:
        return None
    observer: Any = observer_named(name)
    known = {key: settings[key] for key in setting_names(observer.settings) if key in settings}
    own = {key: tuple(value) if isinstance(value, list) else value for key, value in known.items()}
    found: Observer = type(observer)(replace(observer.settings, **own))
    return found
