"""Trials as a table: what goes in comes out, in little memory, and rows that repeat are found."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from todframes.frames.dataset import load_dataset
from todframes.frames.trials import FrameReference, SceneView, Trial, Trials, indices_by
from todframes.stimulus import ORIENTATIONS, Stimulus

DIGEST = "0123456789abcdef" * 4


def trial(number: int, **more) -> Trial:
    frame = FrameReference(f"frames/ä {number}.png", DIGEST, None)
    made = Trial(
        number=number,
        name=frame.path,
        frames=(frame,),
        orientation=ORIENTATIONS[number * 3 % 4],
        stimulus=Stimulus(1.0 + number % 2, (-1) ** (number // 2)),
        level=0.1 * (number % 5 + 1),
        group=(float(number % 3), "left"),
        x_px=None,
        y_px=None,
    )
    return made._replace(**more)


PLAIN = [trial(number) for number in range(12)]
MIXED = [
    trial(0),
    trial(3, name="", x_px=1.5, y_px=-0.0),
    trial(4, name="=4"),
    trial(5, frames=tuple(FrameReference(f"{k}.exr", None, 0.1 * k + 0.1, f"ref/{k}") for k in range(3))),
    trial(9, frames=(FrameReference("odd.exr", DIGEST.upper(), None, None),), group=("7", 7.0)),
    trial(10, frames=(FrameReference("odd.exr", "no checksum", 50.0, "odd.exr"),), name="odd.exr"),
    trial(12, view=SceneView("street", "r90", "0,8")),
    trial(13, view=SceneView("street"), x_px=1.0, y_px=2.0),
    trial(11, frames=(FrameReference("\udcff", f"{DIGEST[:62]} 0", 1.0),), name="\udcff"),
]


@pytest.mark.parametrize("trials", [PLAIN, MIXED, []], ids=["plain", "mixed", "none"])
def test_trials_come_out_as_they_went_in(trials) -> None:
    columns = Trials.of(trial for trial in trials)
    assert list(columns) == trials
    assert [columns[k] for k in range(-len(trials), len(trials))] == trials + trials
    assert len(columns) == len(trials)
    assert list(columns[1::2]) == trials[1::2]
    assert list(reversed(columns)) == trials[::-1]
    assert Trials.of(columns) is columns
    again = pickle.loads(pickle.dumps(columns))
    assert (again, hash(again)) == (columns, hash(columns))
    with pytest.raises(IndexError, match="out of bounds"):
        columns[len(trials)]


def test_columns_are_those_of_the_trials() -> None:
    """Of trials in another order than they were added, and of some of them."""
    order = [6, 3, 0, 5]
    trials, columns = [MIXED[k] for k in order], Trials.of(MIXED).select(order)
    assert columns.numbers.tolist() == [one.number for one in trials]
    assert columns.levels.tolist() == [one.level for one in trials]
    assert [ORIENTATIONS[k] for k in columns.quarter_turns] == [one.orientation for one in trials]
    assert [columns.stimuli[k] for k in columns.stimulus_codes] == [one.stimulus for one in trials]
    assert [columns.groups[k] for k in columns.group_codes] == [one.group for one in trials]
    assert not np.shares_memory(columns.levels, columns.levels)  # nobody changes those of the table
    assert columns.frame_counts.tolist() == [len(one.frames) for one in trials]
    assert columns.n_frames == 6
    assert list(columns.names()) == [one.name for one in trials]
    assert repr(columns) == "<Trials: 4>"
    seen = Trials.of([MIXED[0], MIXED[7], MIXED[6], MIXED[6]._replace(view=SceneView("alley"))])
    assert (seen.has_scenes, columns[3:].has_scenes, columns[3:].scene_numbers) == (True, False, None)
    assert seen.scene_numbers.tolist() == [0, 2, 2, 1]
    assert [indices.tolist() for _, indices in seen.by_view()] == [[0], [1], [2], [3]]
    nan = np.nan
    assert np.array_equal(columns.positions_px, [[nan, nan], [nan, nan], [nan, nan], [nan, nan]], equal_nan=True)
    assert Trials.of(MIXED).positions_px[1].tolist() == [1.5, 0.0]


def test_selections() -> None:
    columns = Trials.of(MIXED)
    assert list(columns.select(columns.levels > 0.25)) == [one for one in MIXED if one.level > 0.25]
    assert list(columns.select([])) == []
    part = columns.select([5, 1]).select([1])
    assert list(part) == [MIXED[1]]
    assert list(pickle.loads(pickle.dumps(part))) == [MIXED[1]]
    assert part == Trials.of([MIXED[1]])
    assert part != columns
    assert list(columns.indices_of_group(("7", 7.0))) == [4]
    assert list(columns.indices_of_group((8.0, "left"))) == []


def test_positions_can_be_replaced_in_a_selection() -> None:
    placed = Trials.of(PLAIN).select([7, 2]).placed(np.array([[1.0, 2.0], [np.nan, np.nan]]))
    assert list(placed) == [PLAIN[7]._replace(x_px=1.0, y_px=2.0), PLAIN[2]]


def test_indices_are_in_the_order_of_the_first() -> None:
    assert [part.tolist() for part in indices_by(np.array([5, 2, 5, 9, 2]))] == [[0, 2], [1, 4], [3]]
    assert indices_by(np.array([], int)) == []


def test_rows_of_a_trial_need_not_follow_each_other(make_dataset) -> None:
    made = make_dataset(contrasts=(0.5,), repeats=2)
    for number, row in enumerate(made.rows):
        row["trial"] = f"t{number % 4}"
        row["orientation"] = ORIENTATIONS[number % 4]
    made.rows[7]["size_mrad"] = "3.0"
    made.save()
    data = load_dataset(made.path)
    assert [[frame.path for frame in one.frames] for one in data.trials] == [
        [made.rows[k]["frame"] for k in pair] for pair in ((0, 4), (1, 5), (2, 6), (3,))
    ]
    assert "size_mrad: found 3.0, expected 2.0 as in the other frames of trial 't3'" in data.bad_rows[0].error
    assert (data.spoilt, data.trials.numbers.tolist()) == ({"t3"}, [0, 1, 2, 3])
