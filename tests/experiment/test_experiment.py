"""Sessions of an experiment: the order of trials, the steps, what survives, and the server's side of the page."""

from __future__ import annotations

import asyncio
import errno
import hashlib
import json
import math
import os
import re
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from people import MEASURES
from test_experiment_answers import ROW

from todframes.base.errors import DataError, FrameError, OutputError, SettingsError
from todframes.experiment.answers import (
    Flag,
    TrialRow,
    count_file,
    data_path,
    read_answers,
    read_sidecar,
    sidecar_path,
)
from todframes.experiment.monitor import shown_codes, trial_image
from todframes.experiment.order import QuestGrid, TrialOrder
from todframes.experiment.run_experiment import SessionProgress, experiment_app
from todframes.experiment.session import StepError, frames_sha256, open_sitting
from todframes.frames.dataset import load_dataset
from todframes.frames.files import FrameFile
from todframes.psychometrics.fit import read_counts
from todframes.stimulus import Orientation

SHORT = {"trials": 8, "practice": 2, "break_every": 3, "seed": 5}


@pytest.fixture
def dataset(make_dataset):
    """Two sizes, three contrasts, four orientations."""
    return load_dataset(make_dataset(sizes_mrad=(2.0, 3.0), contrasts=(0.02, 0.1, 0.5)).path)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "answers"


def begin(sitting) -> None:
    sitting.consent(True)
    sitting.calibrate(MEASURES)


@contextmanager
def begun(dataset, out, **more: Any) -> Iterator[Any]:
    """Open a session after its consent and calibration."""
    with open_sitting(dataset, out, **({"design": SHORT} | more)) as sitting:
        begin(sitting)
        yield sitting


def answer_rightly(sitting) -> TrialRow:
    """Answer the next trial as the manifest has it, and return its row."""
    asked = sitting.trial()
    orientation = sitting._prepare().row.orientation
    sitting.answer(asked["number"], orientation, 250.0)
    return sitting.rows[-1]


def finish(sitting) -> None:
    while (step := sitting.state()["step"]) != "done":
        if step == "break":
            sitting.go_on()
        answer_rightly(sitting)


def refused(error: type[Exception], message: str, *arguments: Any, **more: Any) -> None:
    """Expect that a session cannot be opened."""
    with pytest.raises(error, match=message), open_sitting(*arguments, **more):
        pass


def order(dataset, out, **design: Any) -> tuple[TrialOrder, Any]:
    with open_sitting(dataset, out, design={"seed": 5} | design) as sitting:
        return TrialOrder(dataset.trials, sitting.record), sitting.record


def row_of(dataset, following, number: int, *, is_right: bool = True, flag: Flag | None = None) -> TrialRow:
    trial = dataset.trials[following.row]
    wrong = Orientation.UP if trial.orientation is not Orientation.UP else Orientation.DOWN
    shown = {"frame": trial.frames[0].path, "orientation": trial.orientation, "level": trial.level}
    shown |= {"group": trial.group, "size_mrad": trial.stimulus.size_mrad, "dither_seed": following.dither_seed}
    response = trial.orientation if is_right else wrong
    return replace(ROW, number=number, phase=following.phase, response=response, flag=flag, **shown)


def sit_through(dataset, found: TrialOrder, answers=lambda _: True, flag_of=lambda _: None) -> list[TrialRow]:
    rows: list[TrialRow] = []
    while (following := found.next(rows)) is not None:
        flag = flag_of(len(rows))
        rows.append(row_of(dataset, following, len(rows) + 1, is_right=answers(following), flag=flag))
    return rows


def test_some_of_the_trials_are_spread_evenly(make_dataset, out):
    data = load_dataset(make_dataset(sizes_mrad=(2.0, 3.0), contrasts=(0.02, 0.1, 0.5), repeats=2).path)
    rows = sit_through(data, order(data, out, trials=24, practice=0)[0])
    assert set(Counter((row.group, row.level, row.orientation) for row in rows).values()) == {1}
    # Not one cell after the other: the levels change more often than in 24 trials sorted by cell.
    assert sum(a.level != b.level for a, b in pairwise(rows)) > 6


def test_practice_has_the_highest_level_of_each_group(dataset, out):
    found, _ = order(dataset, out, trials=1, practice=6)
    rows = sit_through(dataset, found)[:6]
    assert {row.level for row in rows} == {0.5}
    assert [row.group for row in rows] == [(2.0,), (3.0,)] * 3


def test_quest_has_each_group_once_in_a_block_in_random_order(dataset, out):
    found, _ = order(dataset, out, method="quest", trials=24, practice=0)
    groups = [row.group for row in sit_through(dataset, found)]
    blocks = [tuple(groups[k : k + 2]) for k in range(0, 24, 2)]
    assert all(len(set(block)) == 2 for block in blocks)
    assert len(set(blocks)) == 2


def test_quest_shows_the_level_of_least_expected_entropy(dataset, out):
    found, _ = order(dataset, out, method="quest", trials=16, practice=0)
    rng = np.random.default_rng(8)
    rows = sit_through(dataset, found, lambda _: bool(rng.integers(2)))
    grid = QuestGrid.of_levels([0.02, 0.1, 0.5])
    for k, row in enumerate(rows):
        counts = np.zeros((2, 3))
        left = Counter(trial.level for trial in dataset.trials if trial.group == row.group)
        for before in rows[:k]:
            if before.group == row.group:
                counts[int(before.is_correct), [0.02, 0.1, 0.5].index(before.level)] += 1
                left[before.level] -= 1
        entropy = grid.expected_entropy(grid.posterior(*counts))
        possible = [entropy[i] if left[level] else np.inf for i, level in enumerate((0.02, 0.1, 0.5))]
        assert row.level == (0.02, 0.1, 0.5)[int(np.argmin(possible))]


@pytest.mark.parametrize("method", ["constant", "quest"])
def test_flagged_trials_come_again_later_and_leave_the_plan_as_it_was(dataset, out, method):
    """All trials of the dataset have an answer that counts at the end; none comes again at once."""
    found, _ = order(dataset, out, method=method, trials=24, practice=3)
    rows = sit_through(dataset, found, flag_of=lambda k: "too_fast" if k in (6, 7, 13) else None)
    assert [row.phase for row in rows] == ["practice"] * 3 + ["main"] * 27
    rows = rows[3:]
    assert len({row.frame for row in rows if row.flag is None}) == 24
    if method == "constant":
        assert all(a.frame != b.frame for a, b in pairwise(rows))


@pytest.mark.parametrize("method", ["constant", "quest"])
def test_a_person_who_never_looks_comes_to_an_end(dataset, out, method):
    found, _ = order(dataset, out, method=method, trials=10, practice=0)
    rows = sit_through(dataset, found, flag_of=lambda _: "too_fast")
    assert len(rows) == 10 + 3  # a quarter more, rounded up
    assert found.next(rows[:-1]) is not None


def test_practice_goes_on_until_enough_of_the_last_are_correct(dataset, out):
    found, _ = order(dataset, out, trials=4, practice=4, practice_correct=0.75)
    rows: list[TrialRow] = []
    for is_right, flag in (
        *[(True, None)] * 2, *[(False, None)] * 2,  # 2 of 4
        *[(True, None)] * 2, *[(True, "too_fast")] * 2,  # 2 of the last 4 count
        (False, None), *[(True, None)] * 3,  # enough, in the midst of the triangles
    ):  # fmt: skip
        following = found.next(rows)
        assert following.phase == "practice"
        rows.append(row_of(dataset, following, len(rows) + 1, is_right=is_right, flag=flag))
    assert {row.frame for row in rows[:4]} == {row.frame for row in rows[4:8]}
    assert found.practised(rows) == (3, 3)
    assert found.next(rows).phase == "main"


def test_a_session_from_consent_to_the_last_answer(dataset, out):
    with open_sitting(dataset, out, subject="P1", design=SHORT, contact="Jo <jo@lab.example>") as sitting:
        steps = [sitting.state()["step"]]
        assert "Jo <jo@lab.example>" in sitting.consent(False)["consent_text"]
        steps.append(sitting.consent(True)["step"])
        steps.append(sitting.calibrate(MEASURES)["step"])
        while steps[-1] != "done":
            if steps[-1] == "break":
                sitting.go_on()
            answer_rightly(sitting)
            steps.append(sitting.state()["step"])
    main = ["main"] * 3 + ["break"] + ["main"] * 2 + ["break"] + ["main"] + ["done"]
    assert steps == ["consent", "monitor", "practice", "practice", *main]
    (session,) = read_answers(out)
    assert session.record.consent is not None
    assert "Nothing is sent anywhere" in session.record.consent.text
    assert session.subject == "P1"
    assert [row.number for row in session.rows] == list(range(1, 11))
    assert all(row.is_correct for row in session.rows)
    ((group, counts), *_) = read_counts(count_file(out, "P1"))
    assert list(group) == ["size_mrad"]
    assert (counts[:, 1] == counts[:, 2]).all()


def test_each_row_says_which_pixels_were_shown(dataset, out):
    with begun(dataset, out) as sitting:
        while sitting.state()["step"] != "break":
            asked = sitting.trial()
            with FrameFile("memory.png", content=sitting.picture(asked["number"])) as file:
                shown = file.read().stored[..., 0]
            row, monitor = answer_rightly(sitting), sitting.record.monitor
            trial = next(one for one in dataset.trials if one.frames[0].path == row.frame)
            contrast = trial_image(dataset, trial).contrast
            np.testing.assert_array_equal(shown, shown_codes(contrast, monitor, row.dither_seed))
            assert row.sha256 == hashlib.sha256((dataset.path / row.frame).read_bytes()).hexdigest()
            assert (asked["height"], asked["width"]) == shown.shape
            assert asked["background_code"] == monitor.background_code == shown[0, 0]


def test_a_trial_of_several_frames_is_one_answer(make_dataset, out):
    changes = {row: {"trial": f"t{row // 2}"} for row in range(8)}
    data = load_dataset(make_dataset(contrasts=(0.1,), repeats=2, row_changes=changes).path)
    with begun(data, out, design={"practice": 0}) as sitting:
        assert sitting.state()["total"] == 4
        row = answer_rightly(sitting)
    trial = next(one for one in data.trials if one.frames[0].path == row.frame)
    lines = [f"{hashlib.sha256((data.path / one.path).read_bytes()).hexdigest()}\n" for one in trial.frames]
    assert row.sha256 == hashlib.sha256("".join(lines).encode()).hexdigest() == frames_sha256(data, trial)


def test_an_answer_given_twice_is_saved_once(dataset, out):
    with begun(dataset, out) as sitting:
        asked = sitting.trial()
        assert asked == sitting.trial()  # until it is answered
        right = sitting._prepare().row.orientation
        first = sitting.answer(asked["number"], right, 400.0)
        again = sitting.answer(asked["number"], None, 500.0)
        assert again == first
        assert [row.response for row in sitting.rows] == [right]


def test_requests_out_of_step_are_refused(dataset, out):
    with open_sitting(dataset, out, design=SHORT) as sitting:
        with pytest.raises(StepError, match="at the step consent, which has no trial"):
            sitting.trial()
        begin(sitting)
        for call, message in (
            (lambda: sitting.consent(True), "at the step practice, expected consent"),
            (lambda: sitting.picture(1), "trial 1 is not shown"),
            (lambda: sitting.answer(0, Orientation.UP, 1.0), "trial 0 is not shown, but 1"),
            (lambda: sitting.answer(1, None, 1.0), "found none, which only a time limit gives"),
        ):
            with pytest.raises(StepError, match=message):
                call()
        sitting.calibrate(replace(MEASURES, viewing_distance_mm=990.0))  # before the first answer
        said = sitting.answer(1, Orientation.UP, 5.0)
        assert (said["flag"], said["correct"]) == ("too_fast", None)  # and not whether it was right
        with pytest.raises(StepError, match="at the step practice, expected monitor"):
            sitting.calibrate(MEASURES)


def test_a_time_limit_that_passed_is_a_trial_without_response(dataset, out):
    design = {"trials": 4, "practice": 0, "time_limit_s": 1.5}
    with begun(dataset, out, subject="P1", design=design) as sitting:
        assert sitting.trial()["time_limit_ms"] == 1500.0
        sitting.answer(1, None, 1500.0)
        for _ in range(3):
            answer_rightly(sitting)
        assert sitting.state()["step"] == "done"
    (session,) = read_answers(out)
    assert session.rows[0].response is None
    assert len(session.main_rows()) == 3
    assert sum(counts[:, 2].sum() for _, counts in read_counts(count_file(out, "P1"))) == 3


def test_answers_that_say_nothing_are_flagged_and_their_trials_shown_again(dataset, out):
    """5 ms after the picture nobody has seen it, and nobody sees a page that is hidden."""
    with begun(dataset, out, subject="P1", design={"trials": 4, "practice": 0, "seed": 5}) as sitting:
        for time_ms, lost, flag in (
            (5.0, None, "too_fast"),
            (149.999, None, "too_fast"),
            (150.0, None, None),
            (900.0, "hidden", "hidden"),
            (900.0, "unfocused", "unfocused"),
        ):
            said = sitting.answer(sitting.trial()["number"], Orientation.UP, time_ms, lost=lost)
            assert (said["flag"], sitting.rows[-1].flag) == (flag, flag)
        assert said["total"] == 4 + 1  # a quarter of 4 is shown again at most
        assert said["step"] == "done"
        assert ("Left out", "4: too fast, or given while this page was not in front") in said["summary"]
    assert sum(counts[:, 2].sum() for _, counts in read_counts(count_file(out, "P1"))) == 1


def test_a_session_that_was_stopped_stays_and_goes_on_only_if_it_is_named(dataset, out):
    with open_sitting(dataset, out, subject="P1", design=SHORT) as sitting:
        with pytest.raises(StepError, match="at the step consent, which cannot be stopped"):
            sitting.stop()
        begin(sitting)
        answer_rightly(sitting)
        assert sitting.stop()["step"] == "stopped"
        with pytest.raises(StepError, match="at the step stopped, which has no trial"):
            sitting.trial()
    assert read_sidecar(sidecar_path(data_path(out, "P1"))).stopped_at
    with open_sitting(dataset, out, design=SHORT) as sitting:
        assert sitting.record.subject != "P1"
    with open_sitting(dataset, out, subject="P1", design=SHORT) as sitting:
        assert (sitting.state()["step"], len(sitting.rows)) == ("practice", 1)
    assert read_sidecar(sidecar_path(data_path(out, "P1"))).stopped_at is None


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other permissions")
def test_nobody_but_their_owner_reads_the_answers(dataset, out):
    before = os.umask(0)
    try:
        with begun(dataset, out, subject="P1") as sitting:
            finish(sitting)
    finally:
        os.umask(before)
    found = {str(path.relative_to(out)): path.stat().st_mode & 0o777 for path in [out, *out.rglob("*")]}
    assert set(found) >= {".", "data", "counts", "data/subject-P1_session-1_data.csv", "dataset_description.json"}
    assert found == {name: 0o700 if (out / name).is_dir() else 0o600 for name in found}


def test_a_monitor_that_cannot_show_the_frames_is_refused(make_dataset, out):
    data = load_dataset(make_dataset(contrasts=(0.1, 2.0)).path)
    with open_sitting(data, out, design={"practice": 0}) as sitting:
        sitting.consent(True)
        for changes, message in (
            ({}, "cannot show the contrast"),
            ({"viewport_px": (47, 400)}, "the page has room for"),
            ({"viewing_distance_mm": 300.0}, "sit 1000 mm from the screen"),
            ({"device_pixel_ratio": 1.1}, "resample"),
        ):
            with pytest.raises(SettingsError, match=message):
                sitting.calibrate(replace(MEASURES, **changes))
        assert sitting.state()["step"] == "monitor"
    with open_sitting(data, out, design={"practice": 0, "background": 0.3}) as sitting:
        begin(sitting)


def test_a_frame_that_is_damaged_meanwhile_is_told(dataset, out):
    with begun(dataset, out) as sitting:
        found = TrialOrder(dataset.trials, sitting.record)
        first = found.next([])
        second = found.next([row_of(dataset, first, 1)])
        frames = [dataset.path / dataset.trials[one.row].frames[0].path for one in (first, second)]
        contents = [frame.read_bytes() for frame in frames]
        assert frames[0] != frames[1]
        # The second is read while the first is shown, and again when its turn has come.
        for frame, content in zip(frames, contents, strict=True):
            frame.write_bytes(content[:100])
        for frame, content in zip(frames, contents, strict=True):
            with pytest.raises(FrameError, match=re.escape(str(frame))):
                sitting.trial()
            frame.write_bytes(content)
            answer_rightly(sitting)


@pytest.mark.parametrize("method", ["constant", "quest"])
def test_a_session_that_was_ended_after_each_answer_is_as_one_in_one_go(dataset, tmp_path, method):
    design = {"method": method, "trials": 4, "practice": 2, "break_every": 2, "seed": 5}
    with begun(dataset, tmp_path / "one", subject="P1", design=design) as sitting:
        finish(sitting)
        expected = [replace(row, shown_at="") for row in sitting.rows]
    with open_sitting(dataset, tmp_path / "many", subject="P1", design=design) as sitting:
        begin(sitting)
    for _ in range(6):
        with open_sitting(dataset, tmp_path / "many") as sitting:
            answer_rightly(sitting)
            found = [replace(row, shown_at="") for row in sitting.rows]
    assert found == expected


def test_an_answer_to_a_trial_that_the_server_before_had_shown_is_taken(dataset, out):
    with begun(dataset, out, subject="P1") as sitting:
        asked, right = sitting.trial(), sitting._prepare().row.orientation
    with open_sitting(dataset, out) as sitting:
        assert sitting.answer(asked["number"], right, 800.0)["correct"]
        assert sitting.rows[0].is_correct


def test_unfinished_sessions_and_other_datasets_are_refused(make_dataset, dataset, out):
    for subject in ("P1", "P2"):
        with open_sitting(dataset, out, subject=subject, design=SHORT):
            pass
    refused(SettingsError, "the sessions of P1, P2 are not finished; say which with subject", dataset, out)
    other = load_dataset(make_dataset("other").path)
    refused(SettingsError, "has answers to another dataset", other, out)


def test_a_finished_session_is_followed_by_a_new_one(dataset, out):
    with begun(dataset, out, design={"trials": 1, "practice": 0}) as sitting:
        finish(sitting)
        first = sitting.record.subject
    refused(SettingsError, f"subject: {first} has finished; leave it out", dataset, out, subject=first)
    with open_sitting(dataset, out) as sitting:
        assert sitting.record.subject != first


@pytest.mark.parametrize(
    ("design", "message"),
    [
        ({"method": "quest"}, "method: found quest, the session has constant, but subject P1 has answ"),
        ({"time_limit_s": 2.0}, "time_limit_s: found 2.0, the session has None"),
    ],
)
def test_settings_of_a_session_that_has_begun_stay(dataset, out, design, message):
    with begun(dataset, out, subject="P1") as sitting:
        answer_rightly(sitting)
    refused(SettingsError, message, dataset, out, design=design)
    with open_sitting(dataset, out, design=SHORT) as sitting:  # the same settings are no others
        assert len(sitting.rows) == 1


@pytest.mark.parametrize(
    ("more", "error", "message"),
    [
        ({"design": {"trials": 25}}, SettingsError, "trials: found 25, expected at most 24, the trials"),
        *(
            ({"subject": subject}, SettingsError, "expected letters and digits, at most 64, and no name")
            for subject in ("", "../x", "ü", "a" * 65, "a\n")
        ),
        ({"folder": "no/such"}, OutputError, "cannot be written"),
        ({"folder": "mine"}, OutputError, "mine: holds other files, expected a folder of answers"),
        ({"folder": "mine/thesis.txt"}, OutputError, "holds other files"),
    ],
)
def test_sessions_that_cannot_begin_leave_all_as_it_was(dataset, tmp_path, more, error, message):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("…")
    before = sorted(tmp_path.rglob("*"))
    refused(error, message, dataset, tmp_path / more.pop("folder", "answers"), **more)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"size_mrad": "-1"}, DataError, "size_mrad"),
        ({"lamp": " warm"}, None, ""),
        ({"lamp": "warm\nlight"}, DataError, "expected a text without line breaks"),
    ],
)
def test_datasets_that_the_files_cannot_hold_are_refused(make_dataset, out, change, error, message):
    changes = {row: {"lamp": "warm"} for row in range(8)} | {3: {"lamp": "warm"} | change}
    data = load_dataset(make_dataset(row_changes=changes, experiment={"group_by": ["lamp"]}).path)
    if error is None:
        with open_sitting(data, out):
            return
    refused(error, message, data, out)
    refused(SettingsError, "found frames in memory, expected a dataset", replace(data, manifest_sha256=None), out)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("json", None, None, r"_data\.json: no such file"),
        ("csv", "frames/", "frames/other", r"line 2: frame: found .*, which no trial"),
    ],
)
def test_files_of_a_session_that_are_damaged_are_told(dataset, out, file, old, new, message):
    with begun(dataset, out, subject="P1") as sitting:
        answer_rightly(sitting)
    path = data_path(out, "P1").with_suffix(f".{file}")
    if old is None:
        path.unlink()
    else:
        path.write_text(path.read_text().replace(old, new))
    refused(DataError, message, dataset, out, subject="P1")


class Page:
    """The page's requests, straight into the app."""

    def __init__(self, app) -> None:
        self.app = app

    def request(self, method: str, path: str, body: bytes = b"") -> tuple[int, dict[str, str], bytes]:
        sent: list[dict[str, Any]] = []

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": body}

        async def send(message: dict[str, Any]) -> None:
            sent.append(message)

        scope = {"type": "http", "method": method, "path": path, "query_string": b"", "headers": []}
        asyncio.run(self.app(scope, receive, send))
        headers = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
        return sent[0]["status"], headers, b"".join(one.get("body", b"") for one in sent[1:])

    def post(self, path: str, **body: Any) -> tuple[int, Any]:
        status, _, content = self.request("POST", path, json.dumps(body).encode())
        return status, json.loads(content)


@contextmanager
def opened(dataset, out, **more: Any):
    with open_sitting(dataset, out, **({"design": SHORT} | more)) as sitting:
        yield Page(experiment_app(sitting)), sitting


BODY = asdict(MEASURES)


def test_the_calls_of_the_page(dataset, out):
    with opened(dataset, out) as (page, sitting):
        assert page.post("/api/state")[1]["step"] == "consent"
        assert page.post("/api/consent", agreed=True)[1]["step"] == "monitor"
        status, refused = page.post("/api/monitor", **(BODY | {"device_pixel_ratio": 1.5}))
        assert (status, "resample" in refused["error"]) == (422, True)
        assert page.post("/api/monitor", **BODY)[1]["step"] == "practice"
        status, trial = page.post("/api/trial")
        assert (status, trial["number"], trial["image"]) == (200, 1, "/stimulus/1.png")
        status, headers, content = page.request("GET", trial["image"])
        assert (status, headers["content-type"], content) == (200, "image/png", sitting.picture(1))
        status, state = page.post("/api/answer", number=1, response="up", response_time_ms=312.5)
        assert status == 200
        assert state["correct"] == sitting.rows[0].is_correct
        assert sitting.rows[0].response_time_ms == 312.5
        assert page.post("/api/continue")[1]["step"] == "practice"
        assert page.post("/api/answer", number=5, response="up", response_time_ms=1)[0] == 409
        assert page.request("GET", "/stimulus/1.png")[0] == 409


ANSWER = {"number": 1, "response": "up", "response_time_ms": 1}

BAD_ANSWERS = [
    b"[]",
    b'{"number": 1, "response": "up"}',
    b'{"number": 1e400, "response": "up", "response_time_ms": 1}',
    *(
        json.dumps(ANSWER | changes).encode()  # NaN, too
        for changes in (
            *({"number": number} for number in (1.5, -1, 2, True)),
            *({"response": response} for response in ("UP", {"a": 1})),
            *({"response_time_ms": time} for time in (math.nan, -1, "1")),
        )
    ),
]

BAD_MONITORS = [
    b"{}",
    *(
        json.dumps(BODY | changes).encode()
        for changes in (
            {"photometer": [[1]]},
            {"photometer": [[k, k] for k in range(100)]},
            {"screen_px": [1, 2, 3]},
            {"viewing_distance_mm": "near"},
            {"pixel_pitch_mm": 1e308},
            {"gamma": -2},
        )
    ),
]


@pytest.mark.parametrize(("path", "bodies"), [("/api/answer", BAD_ANSWERS), ("/api/monitor", BAD_MONITORS)])
def test_bodies_that_are_none_of_the_page_get_one_line_and_change_nothing(dataset, out, path, bodies):
    with opened(dataset, out) as (page, sitting):
        sitting.consent(True)
        if path == "/api/answer":
            sitting.calibrate(MEASURES)
            sitting.trial()
        sidecar = sidecar_path(data_path(out, sitting.record.subject))
        before = sitting.state(), sidecar.read_bytes()
        for body in bodies:
            status, _, content = page.request("POST", path, body)
            assert status in (409, 422)
            assert len(json.loads(content)["error"].splitlines()) == 1
            assert (sitting.state(), sidecar.read_bytes()) == before
        assert page.request("POST", "/api/consent", b'{"agreed": "yes"}')[0] == 422


def test_a_full_disk_is_told_and_the_answer_is_taken_when_there_is_room(dataset, out, monkeypatch):
    with opened(dataset, out) as (page, sitting):
        begin(sitting)
        page.post("/api/trial")
        answer = {"number": 1, "response": "left", "response_time_ms": 400.0}
        with monkeypatch.context() as patched:

            def write(*_: object) -> int:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

            patched.setattr(os, "write", write)
            for _ in range(2):
                status, said = page.post("/api/answer", **answer)
                assert status == 507
                assert re.fullmatch(r".*_data\.csv: cannot be written \(No space left on device\)", said["error"])
        status, said = page.post("/api/answer", **answer)
        assert status == 200
        assert [row.response for row in sitting.rows] == [Orientation.LEFT]


def test_the_command_tells_what_is_wrong_in_one_line(dataset, out, todframes):
    for options, status, message in (
        (["--trials", "1000"], 2, "--trials: found 1000, expected at most 24"),
        (["--consent", "nowhere.txt"], 1, "nowhere.txt: no such file"),
        (["--host", "example.invalid"], 2, "cannot listen at --host 'example.invalid'"),
    ):
        found, _, error = todframes("experiment", dataset.path, "-o", out, *options)
        assert (found, error.count("\n")) == (status, 1) and message in error


def test_the_command_says_how_far_the_session_is(dataset, out, todframes, monkeypatch):
    def run_experiment(_, *, tell, **__):
        tell("Open this page")
        return SessionProgress("P1", 5, 8, 1)

    monkeypatch.setattr("todframes.experiment.run_experiment.run_experiment", run_experiment)
    status, printed, _ = todframes("experiment", dataset.path, "-o", out)
    told = f"{out}: subject P1, 5 of 8 trials, 1 with a flag; the same command goes on"
    assert (status, printed.splitlines()) == (0, ["Open this page", told])
