"""Schedules: rows arrive as typed trials, and each mistake is one line with its place."""

from __future__ import annotations

from pathlib import Path

import pytest

from todframes.base.errors import DataError
from todframes.importing.schedule import assign_recordings, read_schedule
from todframes.stimulus import Orientation


@pytest.fixture
def schedule(tmp_path: Path):
    def read(*lines: str, level: str = "contrast"):
        path = tmp_path / "schedule.csv"
        path.write_text("\n".join([*lines, ""]), encoding="utf-8")
        return read_schedule(path, level=level)

    return read


def test_rows_arrive(schedule) -> None:
    first, second = schedule(
        "file,start_s,end_s,orientation,size_mrad,delta_t_k,x_px,y_px,polarity,operator",
        "a.mkv,0.5,2,up,4,0.1,100.5,80,-1,Ann",
        "b.mkv,,,left,2.5,0.2,,,, Bo ",
        level="delta_t_k",
    )
    assert (first.file, first.start_s, first.end_s) == ("a.mkv", 0.5, 2.0)
    assert (first.orientation, first.size_mrad, first.size_px, first.level) == (Orientation.UP, 4.0, None, 0.1)
    assert (first.x_px, first.y_px, first.polarity, first.other) == (100.5, 80.0, -1, {"operator": "Ann"})
    assert (second.file, second.start_s, second.end_s) == ("b.mkv", None, None)
    assert (second.x_px, second.y_px, second.polarity, second.other) == (None, None, 1, {"operator": "Bo"})


def test_parts_may_touch_and_stand_in_any_order(schedule) -> None:
    rows = schedule("start_s,end_s,orientation,size_px,contrast", "2,3,up,10,0.1", "0,2,down,10,0.1")
    assert [(one.file, one.start_s, one.size_mrad, one.size_px) for one in rows] == [
        (None, 2.0, None, 10.0),
        (None, 0.0, None, 10.0),
    ]


HEADER = "file,start_s,end_s,orientation,size_mrad,contrast"


@pytest.mark.parametrize(("lines", "wanted"), [
    ([HEADER], r"schedule\.csv: no trials; expected a row a trial"),
    (["file,orientation,size_mrad", "a,up,1"], r"column 'contrast' is missing; found file, orientation"),
    (["file,orientation,contrast", "a,up,1"], r"line 2: found no size, expected size_mrad or size_px"),
    (["file,start,end,orientation,size_mrad,contrast", "a,0,1,up,1,1"], r"found column 'start'; write start_s"),
    (["File,orientation,size_mrad,contrast", "a,up,1,1"], r"found column 'File'; write file"),
    (["file,x_px,orientation,size_mrad,contrast", "a,1,up,1,1"], r"one of the columns x_px and y_px"),
    ([HEADER, "a,0,1,Up,4,0.1"], r"line 2: orientation: found 'Up', expected up, right, down or left; write up"),
    ([HEADER, "a,0,1,up,4,0"], r"line 2: contrast: found '0', expected a finite number > 0"),
    ([HEADER, "a,1,,up,4,0.1"], r"line 2: found one of start_s and end_s"),
    ([HEADER, "a,1,1,up,4,0.1"], r"line 2: found start_s 1 and end_s 1, expected 0 <= start_s < end_s"),
    ([HEADER, "a,-1,1,up,4,0.1"], r"found start_s -1 and end_s 1"),
    ([HEADER, "a,0,1,up,4"], r"line 2: found 5 fields, expected 6"),
    ([HEADER, "a,1,3,up,4,1", "b,0,9,up,4,1", "a,0,2,up,4,1"], r"line 2: found a part of .* that line 4 has, too"),
    ([HEADER, "a,,,up,4,1", "a,5,6,up,4,1"], r"line 3: found a part of the file that line 2 has, too"),
    ([f"{HEADER},polarity", "a,0,1,up,4,1,dark"], r"polarity: found 'dark', expected 1 or -1"),
])  # fmt: skip
def test_a_mistake_is_told(schedule, lines: list[str], wanted: str) -> None:
    with pytest.raises(DataError, match=wanted):
        schedule(*lines)


def test_recordings_are_found_by_path_and_by_name(schedule, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    paths = [Path("night/a.mkv"), Path("day/a.mkv"), tmp_path / "b.mkv"]
    rows = schedule(
        "file,orientation,size_mrad,contrast", "day/a.mkv,up,1,1", "b.mkv,up,1,1", f"{tmp_path}/night/a.mkv,up,1,1"
    )
    assert assign_recordings(rows, paths, schedule=tmp_path / "schedule.csv") == (1, 2, 0)
    # The schedule lies elsewhere than the recordings, and only the name's end agrees.
    (row,) = schedule("file,orientation,size_mrad,contrast", "a.mkv,up,1,1")
    assert assign_recordings([row], [Path("/elsewhere/a.mkv")], schedule=tmp_path / "schedule.csv") == (0,)
    with pytest.raises(DataError, match=r"line 2: file: found a\.mkv, which 2 recordings are called; write more"):
        assign_recordings([row], paths, schedule=tmp_path / "schedule.csv")
    with pytest.raises(DataError, match=r"found a\.mkv, expected one of the recordings: b\.mkv"):
        assign_recordings([row], paths[2:], schedule=tmp_path / "schedule.csv")


def test_one_recording_needs_no_name(schedule, tmp_path: Path) -> None:
    rows = schedule("start_s,end_s,orientation,size_mrad,contrast", "0,1,up,1,1", "1,2,up,1,1")
    assert assign_recordings(rows, [Path("a.mkv")], schedule=tmp_path / "s.csv") == (0, 0)
    with pytest.raises(DataError, match="line 2: file: is missing, expected the name of one of 2 recordings"):
        assign_recordings(rows, [Path("a.mkv"), Path("b.mkv")], schedule=tmp_path / "s.csv")
