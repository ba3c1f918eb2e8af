"""Reading `dataset.toml` and the manifest: what is meant arrives. What is wrong is in test_bad_input."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from todframes.base.errors import FrameError, SettingsError
from todframes.frames.contrast import (
    centroid_position,
    check_on_frame,
    size_in_px,
)
from todframes.frames.dataset import load_dataset
from todframes.frames.files import FrameHeader
from todframes.frames.trials import FrameReference, SceneView, Trial
from todframes.observers.pyramid import PyramidObserver
from todframes.psychometrics.fit import FitSettings, read_counts
from todframes.scoring.score import score_dataset
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus


def test_rows_become_trials(make_dataset) -> None:
    changes = {1: {"polarity": "-1", "x_px": "23.25", "y_px": "24.5"}}
    made = make_dataset(sizes_mrad=(1.0, 2.0), row_changes=changes)
    data = load_dataset(made.path)
    assert [trial.name for trial in data.trials] == [row["frame"] for row in made.rows]
    first, second = data.trials[:2]
    assert (first.orientation, first.stimulus) == (Orientation.UP, Stimulus(1.0, 1))
    assert (first.level, first.group) == (0.05, (1.0,))
    assert (first.x_px, first.y_px) == (None, None)
    assert (second.orientation, second.stimulus) == (Orientation.RIGHT, Stimulus(1.0, -1))
    assert (second.x_px, second.y_px) == (23.25, 24.5)
    assert data.bad_rows == ()


def test_groups_are_numbers_where_they_read_as_such(make_dataset) -> None:
    made = make_dataset(experiment={"group_by": ["size_mrad", "camera"]})
    for number, row in enumerate(made.rows):
        row["camera"] = "left" if number % 2 else "7"
    made.rows[7]["camera"] = "2024_1"  # Python reads it as the number 20241
    made.save()
    groups = {trial.group for trial in load_dataset(made.path).trials}
    assert groups == {(2.0, "left"), (2.0, 7.0), (2.0, "2024_1")}
    for row in made.rows[:2]:
        row |= {"trial": "t", "orientation": "up"}
    made.rows[2]["frame"] = "frames\\a.exr"  # a name that is there, and is none of Windows
    (made.path / made.rows[2]["frame"]).touch()
    made.save()
    (bad,) = load_dataset(made.path).bad_rows
    assert bad.error.endswith("line 3: camera: found left, expected 7.0 as in the other frames of trial 't'")


def test_scenes_are_read(make_dataset) -> None:
    made = make_dataset()
    for number, row in enumerate(made.rows):
        row |= {"scene": "street", "scene_turn": "m90", "scene_window": f"8,{number}"}
    made.save()
    trials = load_dataset(made.path).trials
    assert trials[1].view == SceneView("street", "m90", "8,1")
    assert [trials.views[code] for code in trials.view_codes] == [one.view for one in trials]


@pytest.mark.parametrize("turn", range(4))
def test_a_triangle_may_touch_the_edges_of_the_pixels_that_a_file_has(turn) -> None:
    """The apex of a triangle is 2/3 of its height above the centroid; the height is 3^(1/4) √(area)."""
    height, half = 6.0 * 3**0.25, 6.0 / 3**0.25
    reach = np.roll([2 * height / 3, half, height / 3, half], turn)  # up, right, down, left
    header = FrameHeader(90, 80, 5, 7, 40, 30, ("Y",), "half", {})
    frame, stimulus = FrameReference("a", None, None), Stimulus(3.0, 1)
    trial = Trial(0, "a", (frame,), ORIENTATIONS[turn], stimulus, 1.0, (), None, None)
    for x, y in ((6.5 + reach[3], 4.5 + reach[0]), (36.5 - reach[1], 44.5 - reach[2])):
        away = np.sign([x - 20, y - 20])
        check_on_frame(Path("a.exr"), trial, header, *((x, y) - 1e-9 * away), 0.5)
        for beyond in ((x + 1e-6 * away[0], y), (x, y + 1e-6 * away[1])):
            found = (
                "it reaches from ({:.6g}, {:.6g}) to ({:.6g}, {:.6g}) px, off the frame (6.5, 4.5) to (36.5, 44.5)"
            )
            ends = x - reach[3], y - reach[0], x + reach[1], y + reach[2]
            with pytest.raises(FrameError, match=re.escape(found.format(*ends))):
                check_on_frame(Path("a.exr"), trial, header, *beyond, 0.5, what="it")
    # At twice the pitch of pixels it is half as large, and its bounding box lies about the middle of the frame.
    assert size_in_px(trial, 1.0) == 3.0
    x, y = centroid_position(trial, header, "bounding_box", 0.5)
    assert (x - reach[3] + x + reach[1], y - reach[0] + y + reach[2]) == pytest.approx((79.0, 89.0))
    assert centroid_position(trial, header, "centroid", 0.5) == (39.5, 44.5)
    moved = frame._replace(motion_px=(1.0, -2.0))
    assert centroid_position(trial._replace(x_px=3.0, y_px=4.0), header, "centroid", 0.5, moved) == (4.0, 2.0)


def test_a_row_with_half_a_scene_is_bad(make_dataset) -> None:
    made = make_dataset()
    for row in made.rows:
        row |= {"scene": "street", "scene_turn": "r0"}
    made.rows[2]["scene"] = ""
    made.save()
    (bad,) = load_dataset(made.path).bad_rows
    assert "scene: found none beside a turn or a window, expected its name" in bad.error


def test_an_unknown_place_is_no_longer_read(make_dataset) -> None:
    """Version 0.2.0 wrote the key and two columns, which are free now."""
    row = {"place": "2", "place_step_px": "6", "x_px": "24", "y_px": "24"}
    changes = dict.fromkeys(range(8), row)
    assert not load_dataset(make_dataset(experiment={"places": 1}, row_changes=changes).path).bad_rows
    with pytest.raises(SettingsError, match="found places, which this version no longer knows; remove the key"):
        load_dataset(make_dataset("other", experiment={"places": 9}, row_changes=changes).path)


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


def test_counts_by_group(tmp_path: Path) -> None:
    path = tmp_path / "counts.csv"
    path.write_text("level,n_correct,n_trials,eye\n1,3,10,left\n2,8,10,left\n1,4,10,right\n", encoding="utf-8")
    (left, rows), (right, other) = read_counts(path)
    assert (left, right) == ({"eye": "left"}, {"eye": "right"})
    assert np.array_equal(rows, [[1, 3, 10], [2, 8, 10]])
    assert np.array_equal(other, [[1, 4, 10]])
