"""`todframes new`: names of files become a dataset that can be scored, and nothing is overwritten unasked."""

from __future__ import annotations

import re
import shlex
import shutil
from itertools import product
from pathlib import Path

import pytest

import todframes as tod
from todframes.base.errors import DataError, OutputError, SettingsError
from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.display.display import find_display
from todframes.stimulus import ORIENTATIONS

ROOT = Path(__file__).parents[2]
PATTERN = "frames/s{size_mrad}_c{contrast}_{orientation}_{n}.png"


@pytest.fixture
def folder(tmp_path: Path):
    """Makes empty files of these names in a folder."""

    def make(*names: str) -> Path:
        for name in names:
            (tmp_path / "made" / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / "made" / name).touch()
        return tmp_path / "made"

    return make


def test_names_become_trials(folder) -> None:
    path = folder("frames/s4_c0.2_up_10.png", "frames/s4_c0.2_left_9.png", "frames/s2.5_c1e-2_down_1.png")
    assert tod.new_dataset(path, PATTERN) == (3, ())
    data = tod.load_dataset(path)
    assert data.bad_rows == ()
    # Numbers in names are in their order: 2.5 before 4; left before up.
    assert [(one.name, one.orientation.value, one.level, one.group) for one in data.trials] == [
        ("frames/s2.5_c1e-2_down_1.png", "down", 0.01, (2.5,)),
        ("frames/s4_c0.2_left_9.png", "left", 0.2, (4.0,)),
        ("frames/s4_c0.2_up_10.png", "up", 0.2, (4.0,)),
    ]
    assert data.display == find_display("reference_sdr").display
    head, _ = (path / "manifest.csv").read_text(encoding="utf-8").split("\n", 1)
    assert head == "frame,orientation,size_mrad,contrast,n"


@pytest.mark.parametrize(("name", "pattern", "level", "wanted"), [
    ("2p5U.exr", "{size_mrad}{orientation}.exr", "size_mrad", {"size_mrad": 2.5, "orientation": "up"}),
    ("a/0,5/L-3.png", "*/{snr}/{orientation}-{size_mrad}.png", "snr", {"level": 0.5, "orientation": "left"}),
    (
        "s1_n3_Right_neg_7.25_8.png",
        "s{size_mrad}_n{snr}_{orientation}_{polarity}_{x_px}_{y_px}.png",
        "snr",
        {"polarity": -1, "x_px": 7.25, "y_px": 8.0, "orientation": "right"},
    ),
    ("+ (1) 2.d.png", "+ ({size_mrad}) {snr}.{orientation}.png", "snr", {"level": 2.0, "orientation": "down"}),
])  # fmt: skip
def test_ways_to_write_names(folder, name: str, pattern: str, level: str, wanted: dict) -> None:
    path = folder(name)
    tod.new_dataset(path, pattern, level=level)
    (trial,) = tod.load_dataset(path).trials
    found = {"orientation": trial.orientation.value, "level": trial.level, "x_px": trial.x_px, "y_px": trial.y_px}
    found |= {"size_mrad": trial.stimulus.size_mrad, "polarity": trial.stimulus.polarity}
    assert found.items() >= wanted.items()


def test_trials_are_numbered_anew_for_each_stimulus(folder) -> None:
    path = folder(*("2_{}_0.{}_t{}_f{}.png".format(*one) for one in product("ud", (1, 2), (1, 2), (1, 2))))
    tod.new_dataset(path, "{size_mrad}_{orientation}_{contrast}_t{trial}_f{n}.png")
    data = tod.load_dataset(path)
    assert not data.bad_rows
    assert [len(trial.frames) for trial in data.trials] == [2] * 8


def test_other_files_are_told(folder, capsys) -> None:
    path = folder("notes.txt", *(f"frames/{name}" for name in ("s4_c0.2_up_1.png", "a.txt", "Thumbs.db", ".x")))
    assert run(cli, ["new", str(path), "--from", PATTERN]) == 0
    out, err = capsys.readouterr()
    assert err == "note: 2 files beside the frames without a match, left out: frames/Thumbs.db, frames/a.txt\n"
    assert out.startswith(f"written: {path}/dataset.toml, and {path}/manifest.csv: 1 frame\n")
    assert sorted(one.name for one in path.iterdir()) == ["dataset.toml", "frames", "manifest.csv", "notes.txt"]


@pytest.mark.parametrize("there", ["dataset.toml", "manifest.csv"])
def test_nothing_is_overwritten(folder, there: str) -> None:
    path = folder("frames/s4_c0.2_up_1.png")
    (path / there).write_text("mine", encoding="utf-8")
    with pytest.raises(OutputError, match=rf"{there}: is there already; move it away or remove it"):
        tod.new_dataset(path, PATTERN)
    assert sorted(one.name for one in path.iterdir()) == sorted(["frames", there])
    assert (path / there).read_text(encoding="utf-8") == "mine"


def test_a_table_of_luminances_comes_along_but_not_over_another(folder, tmp_path: Path) -> None:
    path = folder("frames/s4_c0.2_up_1.png")
    (tmp_path / "measured.csv").write_text("code_value,luminance_cd_m2\n0,0.5\n1,80\n", encoding="utf-8")
    monitor = tmp_path / "monitor.toml"
    display = '[display]\neotf = "lut"\nlut = "measured.csv"\npixel_pitch_mrad = 0.3\n'
    monitor.write_text(f"schema = 1\n{display}", encoding="utf-8")
    (path / "lut.csv").touch()
    with pytest.raises(OutputError, match=r"lut\.csv: is there already"):
        tod.new_dataset(path, PATTERN, display=str(monitor))
    (path / "lut.csv").unlink()
    tod.new_dataset(path, PATTERN, display=str(monitor))
    assert tod.load_dataset(path).display.lut.luminance_cd_m2.tolist() == [0.5, 80.0]


@pytest.mark.parametrize(("pattern", "error", "wanted"), [
    ("s{size_mrad}_{orientation}.png", SettingsError, r"\{contrast\} is missing in s.*; level names"),
    ("{contrast}_{orientation}.png", SettingsError, r"\{size_mrad\} is missing .*found \{contrast\}"),
    ("frames/*.png", SettingsError, r"\{orientation\} is missing in frames/\*\.png; found no names in braces"),
    ("{n}{n}{size_mrad}{contrast}{orientation}", SettingsError, r"found \{n\} twice, expected each column"),
    ("{frame}{size_mrad}", SettingsError, r"found \{frame\}, expected the name of a column"),
    ("{n:03d}{size_mrad}", SettingsError, r"found \{n:03d\}, expected the name of a column"),
    (f"made/{PATTERN}", DataError, r"no file that matches made/.*there is none in that folder"),
    (PATTERN.replace("png", "exr"), DataError, r"such as frames/s0_c0\.2_up_1\.png\); expected the path"),
    (PATTERN, DataError, r"s0_c0\.2_up_1\.png: size_mrad: found '0', expected a finite number > 0"),
])  # fmt: skip
def test_a_mistake_is_told_and_nothing_is_written(folder, pattern: str, error, wanted: str) -> None:
    path = folder("frames/s0_c0.2_up_1.png")
    with pytest.raises(error, match=wanted):
        tod.new_dataset(path, pattern)
    assert [one.name for one in path.iterdir()] == ["frames"]


def test_no_folder() -> None:
    with pytest.raises(DataError, match="gone: not a folder; expected one with frames"):
        tod.new_dataset("gone", PATTERN)


def test_command_of_the_page(tmp_path: Path, monkeypatch, capsys) -> None:
    """The names of a sample dataset give its stimuli again."""
    page = (ROOT / "docs" / "how_to" / "own_frames.md").read_text(encoding="utf-8")
    program, *arguments = shlex.split(re.search(r"^```console\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)[1])
    sample = ROOT / "sample_frames" / "grabbed_8bit"
    monkeypatch.chdir(tmp_path)
    shutil.copytree(sample / "frames", tmp_path / "my_camera" / "frames")
    assert (program, run(cli, arguments)) == ("todframes", 0)
    assert "do not match" not in capsys.readouterr().err
    ours, theirs = tod.load_dataset("my_camera"), tod.load_dataset(sample)

    def shown(data: tod.Dataset) -> set:
        return {(one.name, one.orientation, one.stimulus.size_mrad) for one in data.trials}

    assert shown(ours) == shown(theirs)
    assert {one.orientation for one in ours.trials} == set(ORIENTATIONS)
