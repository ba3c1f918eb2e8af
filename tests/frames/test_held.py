"""Frames whose pixels are held give the pixels of their files, and are decoded once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from todframes.diagnosis.inspection import inspect, sampled
from todframes.frames import contrast, files
from todframes.frames.contrast import HeldFrame, HoldingDataset
from todframes.frames.dataset import Dataset, load_dataset
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.score import score_dataset

SAMPLES = Path(__file__).parents[2] / "sample_frames"


def holding(name: str) -> tuple[Dataset, Dataset]:
    data = load_dataset(SAMPLES / name)
    measured = [trial for trials, _ in sampled(data, data.trials) for trial in trials]
    return data, HoldingDataset.of(data, measured, "centroid")


@pytest.mark.parametrize("most_mb", [contrast.MOST_HELD_MB, 0])
def test_held_pixels_are_those_of_the_file(most_mb: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within the rectangle that is held, across its border, beyond it, and where nothing may be held."""
    monkeypatch.setattr(contrast, "MOST_HELD_MB", most_mb)
    data, kept = holding("enhancement")
    assert isinstance(kept, HoldingDataset)
    frame = next(frame for trial in data.trials for frame in trial.frames if frame.path in kept.held)
    rectangles = ((20, 30), (25, 31)), ((22, 28), (0, 200)), (None, None), ((0, 2), (3, 9))
    for rows, columns in rectangles:
        with data.open(frame) as plain, kept.open(frame) as file:
            assert isinstance(file, HeldFrame)
            found, expected = (one.read(rows=rows, columns=columns) for one in (file, plain))
        assert (found.first_row, found.first_column) == (expected.first_row, expected.first_column)
        np.testing.assert_array_equal(found.stored, expected.stored)


@pytest.mark.parametrize("name", ["naked_eye", "staring_camera"])
def test_what_scoring_decodes_is_measured_without_decoding(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data, kept = holding(name)
    score_dataset(kept, PyramidObserver())
    expected = inspect(data, data.trials)
    monkeypatch.setattr(files.FrameFile, "_decode", lambda *_: pytest.fail("decoded again"))
    assert inspect(kept, kept.trials) == expected
