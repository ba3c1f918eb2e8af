"""Reading `dataset.toml` and the manifest: what is meant arrives. What is wrong is in test_bad_input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from todframes.base.errors import DataError
from todframes.frames.dataset import load_dataset
from todframes.observers.pyramid import PyramidObserver
from todframes.psychometrics.counts import read_counts
from todframes.psychometrics.fit import FitSettings
from todframes.scoring.score import score_dataset
from todframes.stimulus import Orientation, Stimulus


def test_rows_become_trials(make_dataset) -> None:
    made = make_dataset(
        sizes_mrad=(1.0, 2.0), row_changes={1: {"polarity": "-1", "x_px": "23.25", "y_px": "24.5"}}
    )
    data = load_dataset(made.path)
    assert [trial.name for trial in data.trials] == [row["frame"] for row in made.rows]
    first, second = data.trials[:2]
    assert (first.orientation, first.stimulus, first.level, first.group) == (
        Orientation.UP,
        Stimulus(1.0, 1),
        0.05,
        (1.0,),
    )
    assert (first.x_px, first.y_px) == (None, None)
    assert (second.orientation, second.stimulus) == (Orientation.RIGHT, Stimulus(1.0, -1))
    assert (second.x_px, second.y_px) == (23.25, 24.5)
    assert data.bad_rows == ()


def test_frames_of_one_trial_are_gathered_in_order(make_dataset) -> None:
    made = make_dataset(repeats=3)
    for number, row in enumerate(made.rows):
        row["trial"] = f"t{number // 3}"
    made.save()
    trials = load_dataset(made.path).trials
    assert [len(trial.frames) for trial in trials] == [3] * 8
    assert [frame.path for frame in trials[1].frames] == [row["frame"] for row in made.rows[3:6]]
    assert [trial.number for trial in trials] == list(range(0, 24, 3))


def test_groups_are_numbers_where_they_read_as_such(make_dataset) -> None:
    made = make_dataset(experiment={"group_by": ["size_mrad", "camera"]})
    for number, row in enumerate(made.rows):
        row["camera"] = "left" if number % 2 else "7"
    made.save()
    assert {trial.group for trial in load_dataset(made.path).trials} == {(2.0, "left"), (2.0, 7.0)}


def test_any_column_can_be_the_level(make_dataset) -> None:
    made = make_dataset(sizes_mrad=(1.0, 2.0), experiment={"level": "size_mrad", "group_by": []})
    data = load_dataset(made.path)
    assert {trial.level for trial in data.trials} == {1.0, 2.0}
    assert {trial.group for trial in data.trials} == {()}


def test_a_spoilt_row_takes_its_whole_trial_along(make_dataset) -> None:
    made = make_dataset(repeats=2)
    for number, row in enumerate(made.rows):
        row["trial"] = f"t{number // 2}"
    made.rows[3]["orientation"] = "sideways"
    made.save()
    data = load_dataset(made.path)
    assert data.spoilt == {"t1"}
    assert [bad.frame for bad in data.bad_rows] == [made.rows[3]["frame"]]
    scored = score_dataset(data, PyramidObserver(), fit_settings=FitSettings(resamples=0), skip_bad_frames=True)
    assert [trial.name for trial in scored.trials] == ["t0", *(f"t{n}" for n in range(2, 8))]
    # The good frame of the trial is listed as well.
    assert {one.frame for one in scored.skipped} == {made.rows[2]["frame"], made.rows[3]["frame"]}


def test_a_manifest_as_spreadsheets_write_it(make_dataset) -> None:
    """Byte-order mark, carriage returns, quoted fields, blanks around values."""
    made = make_dataset()
    text = made.manifest_file.read_text(encoding="utf-8").replace("up", '" up "').replace("\n", "\r\n")
    made.manifest_file.write_bytes(b"\xef\xbb\xbf" + text.encode())
    data = load_dataset(made.path)
    assert len(data.trials) == 8
    assert data.bad_rows == ()


def test_lut_is_read_from_beside(make_dataset) -> None:
    made = make_dataset(display={"eotf": "lut", "lut": "lut.csv", "white_luminance_cd_m2": None})
    (made.path / "lut.csv").write_text("code_value,luminance_cd_m2\n0,0.5\n1,80\n", encoding="utf-8")
    lut = load_dataset(made.path).display.lut
    assert lut is not None
    assert np.array_equal(lut.luminance_cd_m2, [0.5, 80.0])


def test_counts_by_group(tmp_path: Path) -> None:
    path = tmp_path / "counts.csv"
    path.write_text("level,n_correct,n_trials,eye\n1,3,10,left\n2,8,10,left\n1,4,10,right\n", encoding="utf-8")
    (left, rows), (right, other) = read_counts(path)
    assert (left, right) == ({"eye": "left"}, {"eye": "right"})
    assert np.array_equal(rows, [[1, 3, 10], [2, 8, 10]])
    assert np.array_equal(other, [[1, 4, 10]])


def test_no_dataset() -> None:
    with pytest.raises(DataError, match="nowhere: not a folder"):
        load_dataset("nowhere")


def test_names_with_underscores_stay_names(make_dataset) -> None:
    """Python reads 2024_1 as the number 20241."""
    made = make_dataset(experiment={"group_by": ["run"]})
    for number, row in enumerate(made.rows):
        row["run"] = "2024_1" if number % 2 else "20241"
    made.save()
    assert {trial.group for trial in load_dataset(made.path).trials} == {("2024_1",), (20241.0,)}
