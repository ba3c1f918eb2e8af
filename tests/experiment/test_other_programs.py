"""Trials that another program shows: its pictures, and the files of answers as PsychoPy and jsPsych write them."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import todframes as tod
from todframes.base.errors import DataError, OutputError, SettingsError
from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.experiment.answers import read_answers
from todframes.experiment.calibrate import seen_dataset

MONITOR = {"pixel_pitch_mm": 0.25, "viewing_distance_mm": 1000.0, "gamma": 2.2}
"""Monitor whose pixels are those of small datasets."""


@pytest.fixture
def dataset(make_dataset):
    """Two sizes, three contrasts, four orientations."""
    return make_dataset(sizes_mrad=(2.0, 3.0), contrasts=(0.02, 0.1, 0.5)).path


@pytest.fixture
def folder(dataset, tmp_path: Path) -> Path:
    assert tod.export_trials(dataset, out=tmp_path / "list", **MONITOR) == 24
    return tmp_path / "list"


def listed(folder: Path) -> list[dict[str, str]]:
    with (folder / "trials.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def turned(trial: dict[str, str], number: int) -> str:
    """The answer to a trial: each third one is wrong."""
    wrong = "up" if trial["orientation"] == "down" else "down"
    return wrong if number % 3 == 0 else trial["orientation"]


def trial_handler(trials: list[dict[str, str]], path: Path) -> None:
    """Write answers as `TrialHandler.saveAsWideText` of PsychoPy does: no quotes, and a mark comes first."""
    names = ["participant", "TrialNumber", *trials[0], "ran", "order", "key_resp.keys", "key_resp.rt"]
    lines = [",".join(names)]
    for number, trial in enumerate(trials, 1):
        keys = [f"['{turned(trial, number)}']", "0.4321"] if number != 5 else ["--", "--"]
        lines.append(",".join(["Jo", str(number), *trial.values(), "1.0", f"{number - 1}.0", *keys]))
    path.write_text("\n".join([*lines, ""]), encoding="utf-8-sig")


def experiment_handler(trials: list[dict[str, str]], path: Path) -> None:
    """Write answers as `ExperimentHandler.saveAsWideText` does: a comma ends each line, and routines have rows."""
    names = [*trials[0], "trials.thisN", "start.keys", "key_resp.keys", "key_resp.rt", "date"]
    rows = [{"start.keys": "space"}]
    for number, trial in enumerate(trials, 1):
        rows.append({**trial, "trials.thisN": str(number - 1), "date": "2026-11-29_10h00.00.000"})
        answer = {"key_resp.keys": turned(trial, number), "key_resp.rt": "0.4321"}
        rows[-1] |= answer if number != 5 else {"key_resp.keys": "None"}
    lines = [names, *([row.get(name, "") for name in names] for row in rows)]
    path.write_text("".join(",".join([*line, "\n"]) for line in lines), encoding="utf-8-sig")


def jspsych(trials: list[dict[str, str]], path: Path) -> None:
    """Write answers as `jsPsych.data.get().csv()` does: all is quoted, times are in ms."""
    lines = [["rt", "stimulus", "response", "trial_type", "trial_index", "time_elapsed"]]
    lines.append(["1200", "<p>Press a key</p>", "", "html-keyboard-response", "0", "1300"])
    for number, trial in enumerate(trials, 1):
        key = f"Arrow{turned(trial, number).capitalize()}"
        answer = ("432.1", key) if number != 5 else ("null", "null")
        image = f"https://lab.example/{trial['image']}"
        lines.append([answer[0], image, answer[1], "image-keyboard-response", str(number), "9"])
    path.write_text("\r\n".join(",".join(f'"{text}"' for text in line) for line in lines), encoding="utf-8")


@pytest.mark.parametrize("write", [trial_handler, experiment_handler, jspsych])
def test_answers_of_another_program_are_those_of_a_session(dataset, folder, tmp_path, write) -> None:
    """Who shuffles the list, leaves a trial out and answers one not at all has 22 answers that count."""
    trials = [listed(folder)[k] for k in np.random.default_rng(3).permutation(24)[:23]]
    write(trials, tmp_path / "played.csv")
    found = tod.import_answers(folder, tmp_path / "played.csv", subject="p1")
    assert found == ("p1", 23, 24, 0)
    (session,) = read_answers(folder)
    expected = [turned(trial, number) for number, trial in enumerate(trials, 1)]
    expected[4] = None
    assert [row.response for row in session.rows] == expected
    assert [row.frame for row in session.rows] == [trial["frame"] for trial in trials]
    assert {row.response_time_ms for row in session.main_rows()} == {432.1}

    # What calibrate shows to the observer are the pictures that were played.
    seen = seen_dataset(tod.load_dataset(dataset), session)
    luminance = ((np.arange(256) / 255) ** 2.2).astype(float)
    for trial, (name, (_, row)) in zip(
        [one for k, one in enumerate(trials) if k != 4], seen.originals.items(), strict=True
    ):
        assert row.frame == trial["frame"]
        codes = cv2.imread(str(folder / trial["image"]), cv2.IMREAD_UNCHANGED)
        frame = next(one.frames[0] for one in seen.trials if one.name == name)
        with seen.open(frame, verify=True) as file:
            shown = file.read().stored[..., 0]
        np.testing.assert_allclose(shown, luminance[codes] / luminance[int(trial["background_code"])], rtol=1e-6)

    with (folder / "counts" / "subject-p1_counts.csv").open(encoding="utf-8", newline="") as file:
        counts = list(csv.DictReader(file))
    assert sum(int(row["n_trials"]) for row in counts) == 22
    right = sum(answer == trial["orientation"] for answer, trial in zip(expected, trials, strict=True))
    assert sum(int(row["n_correct"]) for row in counts) == right


def test_list_goes_through_the_commands(dataset, tmp_path, capsys) -> None:
    """Readings of a photometer take the place of gamma; practice and answers within 150 ms do not count."""
    readings = [f"{code},{100 * (code / 255) ** 2.2}" for code in (0, 64, 128, 255)]
    (tmp_path / "meter.csv").write_text("\n".join(["code,luminance_cd_m2", *readings, ""]), encoding="utf-8")
    out = str(tmp_path / "list")
    monitor = [
        "--pixel-pitch-mm",
        "0.25",
        "--viewing-distance-mm",
        "1000",
        "--photometer",
        str(tmp_path / "meter.csv"),
    ]
    assert run(cli, ["export-trials", str(dataset), "-o", out, *monitor, "--seed", "5"]) == 0
    trials = listed(tmp_path / "list")
    assert {trial["background_code"] for trial in trials} == {"186"}  # (186 / 255)^2.2 is the last below a half
    lines = ["image,phase,key,response_time_ms"]
    for number, trial in enumerate(trials):
        phase, time_ms = ("practice" if number == 0 else "main"), (149 if number == 1 else 600)
        lines.append(f"{trial['image']},{phase},{turned(trial, number)},{time_ms}")
    (tmp_path / "p.csv").write_text("\n".join(lines), encoding="utf-8")
    assert run(cli, ["import-answers", out, str(tmp_path / "p.csv"), "--subject", "p1", "--response", "key"]) == 0
    assert "subject p1, 23 answers to 24 trials, 1 with a flag" in capsys.readouterr().out
    assert run(cli, ["fit", f"{out}/counts/subject-p1_counts.csv", "--json"]) == 0
    assert sum(fit["n_trials"] for fit in json.loads(capsys.readouterr().out)["fits"]) == 22
    assert run(cli, ["calibrate", out, str(dataset), "--json"]) == 0
    (person,) = json.loads(capsys.readouterr().out)["persons"]
    assert (person["subject"], person["n_trials"], person["n_flagged"]) == ("p1", 22, {"too_fast": 1})


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"gamma": None}, SettingsError, "found none of them, expected one"),
        ({"viewing_distance_mm": 300.0}, SettingsError, "sit 1000 mm from the screen"),
        ({"trials": 25}, SettingsError, "trials: found 25, expected at most 24"),
    ],
)
def test_monitor_that_cannot_show_the_list_is_refused(
    dataset, tmp_path, changes: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        tod.export_trials(dataset, out=tmp_path / "list", **(MONITOR | changes))
    assert not (tmp_path / "list" / "trials.csv").exists()


def test_columns_of_the_list_are_no_groups(make_dataset, tmp_path) -> None:
    made = make_dataset(experiment={"group_by": ["image"]}, row_changes={k: {"image": "a"} for k in range(4)})
    with pytest.raises(SettingsError, match="found 'image', which is a column of the list"):
        tod.export_trials(made.path, out=tmp_path / "list", **MONITOR)


@pytest.mark.parametrize(
    ("lines", "error", "message"),
    [
        (["image,response,rt", "images/00001.png,x,0.5"], DataError, "line 2: response: found 'x', expected up"),
        (["image,response,rt", "images/00099.png,up,0.5"], DataError, "line 2: image: found 'images/00099.png'"),
        (
            ["image,response,rt", "images/00001.png,up,"],
            DataError,
            "line 2: rt: found '', expected a finite number",
        ),
        (["image,response,rt", ",up,0.5"], DataError, "image: found no picture"),
        (
            ["image,response", "images/00001.png,up", "image,response"],
            DataError,
            "line 3: found the columns again",
        ),
        (["picture,response", "images/00001.png,up"], DataError, "column 'image' is missing"),
        (["image,response", "images/00001.png,up"], DataError, "column 'rt' is missing"),
        (["image,a.keys,b.keys", "images/00001.png,up,up"], DataError, "a.keys and b.keys beside .* by response"),
        (["image,answer", "images/00001.png,up"], DataError, "found no answers beside the images"),
    ],
)
def test_file_that_is_wrong_is_refused_with_its_place(folder, tmp_path, lines, error, message) -> None:
    (tmp_path / "played.csv").write_text("\n".join(lines), encoding="utf-8")
    with pytest.raises(error, match=message):
        tod.import_answers(folder, tmp_path / "played.csv", subject="p1")
    assert not (folder / "data").exists()


def test_person_is_imported_once(folder, tmp_path) -> None:
    jspsych(listed(folder), tmp_path / "played.csv")
    tod.import_answers(folder, tmp_path / "played.csv", subject="p1")
    with pytest.raises(OutputError, match="exists; take another subject, or delete it"):
        tod.import_answers(folder, tmp_path / "played.csv", subject="p1")
    with pytest.raises(SettingsError, match="expected letters and digits"):
        tod.import_answers(folder, tmp_path / "played.csv", subject="Jo Doe")
