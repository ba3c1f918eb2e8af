"""The files of people's answers: what is written is read again, also after a kill, on a full disk and by two."""

from __future__ import annotations

import errno
import json
import os
import re
from dataclasses import replace
from pathlib import Path

import pytest
from people import MEASURES

from todframes.base.errors import DataError, OutputError, SettingsError
from todframes.experiment.answers import (
    DESCRIPTION_FILE,
    AnswerFile,
    Consent,
    SessionRecord,
    ShownDataset,
    TrialRow,
    columns,
    count_file,
    data_path,
    flagged,
    make_folders,
    read_answers,
    read_rows,
    read_sidecar,
    sidecar_path,
    write_counts,
    write_sidecar,
)
from todframes.experiment.monitor import calibrated
from todframes.psychometrics.fit import read_counts
from todframes.stimulus import Orientation

SHOWN = ShownDataset(
    path="frames",
    manifest_sha256="0" * 64,
    pixel_pitch_mrad=0.25,
    level="contrast",
    group_by=("size_mrad", "lamp"),
)

READINGS = ((0, 0.3), (64, 8.0), (128, 40.0), (255, 180.0))
MONITOR = calibrated(replace(MEASURES, gamma=None, photometer=READINGS), background=0.5, dither=True)

RECORD = SessionRecord(
    subject="P1",
    started="2026-01-01T00:00:00+00:00",
    software={"todframes": "0"},
    consent=Consent(text="A line.\n<script>alert(1)</script>", agreed_at="2026-01-01T00:00:01+00:00"),
    dataset=SHOWN,
    method="quest",
    seed=3,
    trials=10,
    practice=1,
    break_every=0,
    time_limit_s=1.5,
    background=0.5,
    dither=True,
    monitor=MONITOR,
)

ROW = TrialRow(
    number=1,
    phase="main",
    frame='frames/a, "b" <script>.exr',
    sha256="f" * 64,
    orientation=Orientation.UP,
    response=Orientation.UP,
    response_time_ms=512.25,
    level=0.05,
    group=(2.0, "=warm"),
    size_mrad=2.0,
    dither_seed=77,
    clipped_px=0,
    shown_at="2026-01-01T00:00:02+00:00",
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The data file of a folder with the sidecar of a session."""
    path = data_path(tmp_path / "answers", "P1")
    path.parent.mkdir(parents=True)
    write_sidecar(sidecar_path(path), RECORD)
    return path


def rows(n: int) -> list[TrialRow]:
    answers = [Orientation.UP, Orientation.LEFT, None]
    return [replace(ROW, number=k + 1, response=answers[k % 3], level=0.05 * (1 + k % 2)) for k in range(n)]


def write(path: Path, written: list[TrialRow]) -> None:
    with AnswerFile(path) as file:
        file.begin(SHOWN)
        for row in written:
            file.append(row)


def test_what_is_written_is_read_again(path):
    write(path, rows(5))
    (session,) = read_answers(path.parent.parent)
    assert (session.record, session.rows) == (RECORD, tuple(rows(5)))
    assert (session.monitor, session.subject) == (MONITOR, "P1")
    assert [row.number for row in session.main_rows()] == [1, 2, 4, 5]


def test_a_torn_last_line_is_cut_wherever_it_was_torn(path):
    write(path, rows(2))
    whole = path.read_bytes()
    ends = [k + 1 for k, byte in enumerate(whole) if byte == ord("\n")]
    for size in {*range(0, len(whole), 11), *(end + by for end in ends for by in (-1, 0))}:
        path.write_bytes(whole[:size])
        n_whole = max(sum(end <= size for end in ends) - 1, 0)
        assert len(read_rows(path, SHOWN)) == n_whole
        with AnswerFile(path) as file:
            file.begin(SHOWN)
            assert file.rows == rows(2)[:n_whole]
            for row in rows(2)[n_whole:]:
                file.append(row)
        assert path.read_bytes() == whole


@pytest.mark.parametrize("room", [0, 7, None])
def test_a_full_disk_leaves_the_file_as_before_and_the_row_can_be_written_later(path, monkeypatch, room):
    """Room for no byte, for 7, or for all without a flush."""
    write_all, taken = os.write, []

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def write_some(file: int, content: bytes) -> int:
        if taken or not room:
            fail()
        taken.append(write_all(file, content[:room]))
        return taken[-1]

    with AnswerFile(path) as file:
        file.begin(SHOWN)
        file.append(rows(2)[0])
        before = path.read_bytes()
        with monkeypatch.context() as full:
            full.setattr(os, *(("fsync", fail) if room is None else ("write", write_some)))
            with pytest.raises(OutputError, match=re.escape(f"{path}: cannot be written (No space left on")):
                file.append(rows(2)[1])
        assert path.read_bytes() == before
        assert len(file.rows) == 1
        file.append(rows(2)[1])
    assert read_rows(path, SHOWN) == tuple(rows(2))


def test_a_second_server_and_a_folder_are_told(path):
    with AnswerFile(path), pytest.raises(OutputError, match="another server is writing this session"):
        AnswerFile(path)
    path.with_name("taken").mkdir()
    with pytest.raises(OutputError, match="taken: cannot be written"):
        AnswerFile(path.with_name("taken"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (",up,up,1,", ",up,left,1,", "line 2: correct: found 1, but the response was left to up"),
        (",up,up,1,", ",up,north,1,", r"line 2: Invalid enum value 'north' - at `\$\.response`"),
        ("1,main,", "2,main,", "line 2: trial: found 2, expected 1"),
        (",0.05,", ",-0.05,", r"line 2: Expected `float` > 0.0 - at `\$\.level`"),
        (",77,", ",7.7,", "line 2: Expected `int`"),
        (",77,", ",77,,", "line 2: found 16 fields, expected 15"),
        ("trial,", "Trial,", "found the columns Trial, phase"),
        ("1,main", '"1,main', "not CSV of UTF-8"),
    ],
)
def test_damaged_rows_are_named(path, old, new, message):
    write(path, rows(1))
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    with pytest.raises(DataError, match=message):
        read_answers(path.parent.parent)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"schema": 9}, "schema: found 9, expected 1"),
        ({"method": "guess"}, "not the sidecar of a session .*guess"),
        ({"monitor": {"gamma": 2.2}}, "not the sidecar of a session"),
        ({"subject": "../../P2"}, "subject: found '../../P2', expected that of the file's name"),
    ],
)
def test_damaged_sidecars_are_named(path, change, message):
    sidecar = sidecar_path(path)
    sidecar.write_text(json.dumps(json.loads(sidecar.read_text()) | change))
    with pytest.raises(DataError, match=message):
        read_sidecar(sidecar)


def test_a_folder_without_answers_is_told(tmp_path, path):
    write(path, [])
    for folder in (tmp_path / "nothing", path.parent.parent):  # the second has a session that has not begun
        with pytest.raises(DataError, match="no answers; expected data/subject"):
            read_answers(folder)


def test_columns_that_the_file_has_itself_are_refused_but_size_and_orientation():
    for level, group_by in (("trial", ()), ("contrast", ("response",)), ("contrast", ("n_correct",))):
        with pytest.raises(SettingsError, match="which is a column of the answers; rename it in the manifest"):
            columns(level, group_by)
    found = columns("size_mrad", ("orientation",))
    assert (found.count("size_mrad"), found.count("orientation")) == (1, 1)


def test_counts_are_those_of_main_trials_with_a_response(path):
    practice = replace(ROW, phase="practice")
    more = [replace(ROW, group=("warm", 3.0)), replace(ROW, level=0.01, response=Orientation.DOWN)]
    out = count_file(path.parent.parent, "P1")
    out.parent.mkdir()
    write_counts(out, RECORD, [practice, *rows(6), *more])
    found = {tuple(group.values()): values.tolist() for group, values in read_counts(out)}
    # rows(6): up, left, none, up, left, none at 0.05 and 0.1 by turns, right when up.
    expected = {(2.0, "'=warm"): [[0.01, 0, 1], [0.05, 1, 2], [0.1, 1, 2]], ("warm", 3.0): [[0.05, 1, 1]]}
    assert found == expected


def test_flagged_answers_count_only_if_they_are_included(path):
    flags = [None, "hidden", "too_fast", "unfocused", None, "too_fast"]
    answered = zip(rows(6), flags, strict=True)
    write(path, [replace(row, response=Orientation.UP, flag=flag) for row, flag in answered])
    (session,) = read_answers(path.parent.parent)
    assert [row.flag for row in session.rows] == flags
    assert [row.number for row in session.main_rows()] == [1, 5]
    assert flagged(session.rows) == {"hidden": 1, "unfocused": 1, "too_fast": 2}
    (session,) = read_answers(path.parent.parent, include_flagged=True)
    assert len(session.main_rows()) == 6
    for record, n_trials in ((RECORD, 2), (replace(RECORD, include_flagged=True), 6)):
        out = count_file(path.parent.parent, "P1")
        out.parent.mkdir(exist_ok=True)
        write_counts(out, record, session.rows)
        assert sum(counts[:, 2].sum() for _, counts in read_counts(out)) == n_trials


@pytest.mark.parametrize(("distance_mm", "size"), [(1000.0, 2.0), (1003.0, 2.0), (500.0, 4.0)])
def test_counts_have_the_size_at_the_eye(path, distance_mm, size):
    monitor = replace(MONITOR, viewing_distance_mm=distance_mm, pixel_pitch_mrad=250.0 / distance_mm)
    shown = replace(SHOWN, group_by=("size_mrad",))
    out = path.with_name("counts.csv")
    write_counts(out, replace(RECORD, monitor=monitor, dataset=shown), [replace(ROW, group=(2.0,))])
    ((group, _),) = read_counts(out)
    assert group == {"size_mrad": pytest.approx(size, rel=1e-6)}


def test_folder_is_psych_ds(path):
    folder = path.parent.parent
    write(path, rows(2))
    make_folders(folder, SHOWN, {"todframes": "0"})
    found = json.loads((folder / DESCRIPTION_FILE).read_text())
    # The rules of Psych-DS 1.5 whose breach is an error.
    assert found["@context"].rstrip("/") == "https://schema.org"
    assert found["@type"] == "Dataset"
    assert found["name"] and found["description"]
    for data in (folder / "data").glob("*.csv"):
        assert re.fullmatch(r"([a-z]+-[a-zA-Z0-9]+)(_[a-z]+-[a-zA-Z0-9]+)*_data\.csv", data.name)
        header, *lines = data.read_text().splitlines()
        described = {one["name"] for one in found["variableMeasured"]}
        assert set(header.split(",")) <= described
        assert all(len(line) for line in lines)
    names = [one["name"] for one in found["variableMeasured"]]
    assert len(names) == len(set(names))
    assert all(one["description"] for one in found["variableMeasured"])
