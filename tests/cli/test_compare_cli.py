"""`todframes compare` and `todframes enhancements` as a user meets them."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import todframes as tod
from todframes.enhancement.finding import enhancement_names
from todframes.frames.files import read_frame, write_frame
from todframes.stimulus import Orientation, coverage

OWN = """
from typing import Annotated
from todframes.enhancement.algorithm import algorithm, parameter

def leaves(image):
    raise SystemExit(7)

def shouts(image):
    raise ValueError("\x1b[31mno\\n\u202e")

def twice(image, gain=2.0):
    return 0.5 + gain * (image - 0.5)

@algorithm(domain="luminance")
def flat(image, *, note: object = object()):
    return 0.0 * image + 0.5
"""

QUICKLY = "--set", "resamples=40"


@pytest.fixture
def todframes(todframes):
    """Run a command as the fixture of this name does, `compare` with few resamples."""
    return lambda name, *more: todframes(name, *(QUICKLY if name == "compare" else ()), *more)


@pytest.fixture(scope="module")
def dataset(make_shared_dataset) -> Path:
    made = make_shared_dataset(suffix=".png", sizes_mrad=(1.0, 2.0), contrasts=(0.05, 0.1, 0.2, 0.4))
    (made.path / "clean").mkdir()
    for number, row in enumerate(made.rows):
        row["reference_frame"] = f"clean/{number}.png"
        values = read_frame(made.frame(number)).values
        write_frame(made.path / row["reference_frame"], values)
        noise = np.random.default_rng(number).normal(0.0, 0.01, values.shape)
        write_frame(made.frame(number), values + noise)
    made.save()
    return made.path


@pytest.fixture
def here(working_folder: Path) -> Path:
    """A folder with a user's module, from which commands are run."""
    (working_folder / "my_algorithms.py").write_text(OWN, encoding="utf-8")
    return working_folder


SPECS = ("--enhance", "gaussian:sigma=2", "--enhance", "my_algorithms:twice", "--enhance", "my_algorithms:flat")


@pytest.mark.usefixtures("blank_pictures")
def test_json_and_files(todframes, dataset: Path, here: Path) -> None:
    asked = ("--internal-noise", "0.25", "-o", "result", "--json")
    status, out, err = todframes("compare", dataset, *SPECS, *asked)
    result = json.loads(out)
    # Not all thresholds lie among the levels; algorithms are named with them.
    assert {warning["code"] for warning in result["warnings"]} == {"levels_to_add"}
    lines = [
        f"warning: {one['group']['condition']}, {one['group']['size_mrad']:g} mrad: {one['message']}"
        for one in result["warnings"]
    ]
    assert (status, err.splitlines()) == (0, lines)
    assert {"schema", "command", "version", "settings", "seed", "conditions", "verdict", "skipped"} <= set(result)
    assert (result["schema"], result["command"], result["seed"], result["skipped"]) == (1, "compare", 1, [])
    assert (result["settings"]["internal_noise"], result["settings"]["white"]) == (0.25, 1.0)
    assert result["data_range_cd_m2"] == 100.0
    none, blur, twice, flat = result["conditions"]
    names = ["none", "gaussian", "my_algorithms:twice", "my_algorithms:flat"]
    assert [one["name"] for one in result["conditions"]] == names
    assert [one["domain"] for one in result["conditions"]] == ["code_value"] * 3 + ["luminance"]
    assert (blur["spec"], blur["parameters"]) == ("gaussian:sigma=2", {"sigma": 2.0})
    assert twice["parameters"] == {"gain": 2.0}
    assert flat["parameters"]["note"].startswith("<object object")
    assert (none["ratios"], none["overall"], none["verdict"]) == ([], None, None)
    for one in (blur, twice, flat):
        assert [ratio["group"] for ratio in one["ratios"]] == [{"size_mrad": 1.0}, {"size_mrad": 2.0}]
        assert all(0.0 < ratio["p_value"] <= ratio["p_value_holm"] <= 1.0 for ratio in one["ratios"])
    assert twice["ratios"][0]["ratio"] == twice["fits"][0]["threshold"] / none["fits"][0]["threshold"]
    assert (blur["verdict"], twice["verdict"], flat["verdict"]) == ("worse", "better", "worse")
    # The noise of 0.01 is gone, but so is the triangle.
    assert blur["psnr_change_db"] > 1.0
    assert blur["psnr_db"] == pytest.approx(none["psnr_db"] + blur["psnr_change_db"])
    assert blur["disagrees"] == ["psnr", "ssim"]
    named = [sentence.partition(":")[0] for sentence in result["verdict"]]
    assert named == ["gaussian", "my_algorithms", "my_algorithms"]
    assert "The usual measures disagree: PSNR changes by +" in result["verdict"][0]
    assert "75 % correct is never reached with it and is reached without" in result["verdict"][2]
    assert result["run_time_s"] > 0.0
    folder = here / "result"
    written = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    assert written == json.loads(out) | {"files": written["files"]}
    check_files(folder, result["conditions"])
    # What a result of another command left there would be taken for this one's.
    counts = [0.1, 0.2, 0.4, 0.8], [12, 18, 30, 38], [40] * 4
    tod.fit_counts(*counts, fit=tod.FitSettings(resamples=0)).save(folder)
    assert not (folder / "compare.csv").exists()


def check_files(folder: Path, algorithms: list[dict]) -> None:
    """A result folder has all files, and in the tables what the JSON says."""
    names = {"result.json", "report.html", "compare.csv", "scores.csv", "compare.png"}
    names |= {"contrast_response.csv", "contrast_response.png", "bands.csv", "bands.png"}
    assert {file.name for file in folder.iterdir()} == names
    rows = list(csv.DictReader(io.StringIO((folder / "compare.csv").read_text(encoding="utf-8"))))
    places = [(row["condition"], row["size_mrad"]) for row in rows[:5]]
    assert places == [("none", "1.0"), ("none", "2.0"), *(("gaussian", size) for size in ("1.0", "2.0", "all"))]
    ratios = [ratio["ratio"] for one in algorithms[1:] for ratio in one["ratios"]]
    shown = [row["ratio"] for row in rows[2:] if row["size_mrad"] != "all"]
    assert shown == ["" if ratio is None else str(ratio) for ratio in ratios]
    assert (rows[0]["ratio"], rows[0]["verdict"]) == ("1.0", "")
    scores = list(csv.DictReader(io.StringIO((folder / "scores.csv").read_text(encoding="utf-8"))))
    assert len(scores) == 4 * 32
    for name in ("none", "gaussian:sigma=2"):
        mine = [row for row in scores if row["condition"] == name]
        assert [row["trial"] for row in mine] == [row["trial"] for row in scores[:32]]
        displaced = [row["displacement_x_samples"] for row in scores[:32]]
        assert [row["displacement_x_samples"] for row in mine] == displaced


def test_one_group_and_frames_without_a_reference(todframes, make_dataset) -> None:
    """Two algorithms of one name have their parameters as names; the cost is shown when asked for."""
    made = make_dataset(suffix=".png", contrasts=(0.05, 0.1, 0.2, 0.4), experiment={"group_by": []})
    specs = ("--enhance", "gaussian:sigma=3", "--enhance", "gaussian", "--enhance", "median")
    status, out, _ = todframes("compare", made.path, *specs, "--json")
    _, one, *_ = algorithms = json.loads(out)["conditions"]
    assert [each["name"] for each in algorithms] == ["none", "gaussian:sigma=3", "gaussian", "median"]
    assert (status, one["overall"], len(one["ratios"]), one["ratios"][0]["group"]) == (0, None, 1, {})
    assert one["verdict"] == "worse"
    assert (one["psnr_db"], one["ssim"], one["disagrees"]) == (None, None, [])


HOSTILE = "import pathlib, sys\npathlib.Path(__file__).with_name('ran').touch()\nsys.exit('ran')\n"
TALKS = """
import os
from sys import stdout
print("chatter: import")

def same(image):
    print("chatter: print")
    stdout.write("chatter: write\\n")
    os.write(1, b"chatter: descriptor\\n")
    return image
"""


def started(command: list[str], data: Path, folder: Path, spec: str, *options: str):
    """Run `compare` in a process of its own."""
    line = [sys.executable, *command, "compare", data, "--enhance", spec, *QUICKLY, *options]
    return subprocess.run(line, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("spec", ["median", "my_algorithms:twice"])
@pytest.mark.parametrize("start", ["script", "-m"])
def test_nothing_else_runs_from_the_present_folder(
    make_dataset, here: Path, start: str, spec: str, tmp_path: Path
) -> None:
    """A dataset may hold files that are called as modules are, installed ones or Python's own.

    As by `python -m`, and as by a console script, which has its own folder first on the path.
    """
    for name in ("skimage", "cv2", "numpy", "click", "tomllib", "typing"):
        (here / f"{name}.py").write_text(HOSTILE, encoding="utf-8")
    (tmp_path / "bin").mkdir()
    script = tmp_path / "bin" / "todframes"
    script.write_text("from todframes.cli.main import main\nmain()\n", encoding="utf-8")
    command = [str(script)] if start == "script" else ["-m", "todframes"]
    done = started(command, make_dataset(suffix=".png").path, here, spec, "--json")
    assert not (here / "ran").exists(), done.stderr
    assert json.loads(done.stdout)["conditions"][1]["name"] == spec


@pytest.mark.slow
@pytest.mark.parametrize("options", [["--json"], []])
def test_standard_output_is_for_the_result_alone(make_dataset, here: Path, options: list[str]) -> None:
    """Whatever a user's module prints, in whatever way, goes to standard error."""
    (here / "talks.py").write_text(TALKS, encoding="utf-8")
    done = started(["-m", "todframes"], make_dataset(suffix=".png").path, here, "talks:same", *options)
    assert done.returncode == 0
    assert "chatter" not in done.stdout
    for what in ("import", "print", "write", "descriptor"):
        assert f"chatter: {what}\n" in done.stderr
    if options:
        assert json.loads(done.stdout)["command"] == "compare"
    else:
        assert "threshold" in done.stdout and "talks:same" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["--enhance", "medain"], 2, "enhance 'medain': expected a registered name or module:function: "
         "unknown key 'medain'; the nearest valid one is 'median'"),
        ([], 2, "conditions: found 1, expected two or more, or one with --enhance or --by"),
        (["--enhance", "my_algorithms:twice:gain=9"], 1, "my_algorithms:twice:gain=9: "),
        (["--enhance", "my_algorithms:leaves"], 1, "my_algorithms:leaves: called sys.exit"),
        pytest.param(["--enhance", "my_algorithms:leaves", "--workers", "2"], 1,
                     "my_algorithms:leaves: called sys.exit", marks=pytest.mark.slow),
        (["--enhance", "my_algorithms:shouts"], 1, r"my_algorithms:shouts: ValueError: \x1b[31mno \u202e"),
    ],
)  # fmt: skip
@pytest.mark.usefixtures("here")
def test_failures_are_one_line(todframes, dataset: Path, arguments: list[str], status: int, message: str) -> None:
    found, out, err = todframes("compare", dataset, *arguments, "-o", "result")
    error, *notes = err.splitlines()
    assert (found, out) == (status, "")
    assert message in error
    if notes:  # what the other algorithms have finished is kept
        assert [note.partition(";")[0] for note in notes] == ["note: what is finished is kept in result"]
    else:
        assert not Path("result").exists()


@pytest.mark.usefixtures("here")
def test_clipping_and_skipping_are_told(todframes, dataset: Path) -> None:
    arguments = ("compare", dataset, "--enhance", "my_algorithms:twice:gain=4")
    status, _, err = todframes(*arguments, "--allow-clipping")
    assert status == 0
    assert "note: my_algorithms:twice:gain=4: " in err
    assert "values were clipped" in err
    status, out, err = todframes(*arguments, "--on-error", "skip", "--json")
    assert status == 0
    skipped = json.loads(out)["skipped"]
    assert len(skipped) == err.count("skipped: ")
    assert 0 < len(skipped) < 32
    assert all("values lie beyond 0 to 1" in one["error"] for one in skipped)


def test_list_of_enhancements(todframes) -> None:
    status, out, err = todframes("enhancements")
    assert (status, err) == (0, "") and "code_value" not in out
    more = ("clip_limit", "0.1 – 50", "2 px", "8, 16", "OpenCV: createCLAHE", "code values")
    assert [text for text in (*enhancement_names(), *more) if text not in out] == []
    status, out, _ = todframes("enhancements", "--json")
    result = json.loads(out)
    assert (status, result["command"], result["schema"]) == (0, "enhancements", 1)
    listed = {one["name"]: one for one in result["enhancements"]}
    assert set(listed) == set(enhancement_names())
    assert [one["changes_pitch"] for one in (listed["median"], listed["lanczos"])] == [False, True]
    (sigma,) = listed["gaussian"]["parameters"]
    expected = {"name": "sigma", "default": 1.0, "unit": "px", "range": [0.1, 50.0], "choices": None}
    assert sigma == expected | {"what": "standard deviation of the Gaussian"}
    for one in listed.values():
        assert one["what"].endswith(".")
        assert one["library"]
        for parameter in one["parameters"]:
            assert parameter["what"], (one["name"], parameter["name"])
            low, high = parameter["range"] or (min(parameter["choices"]), max(parameter["choices"]))
            assert low <= parameter["default"] <= high


def test_a_registered_one_that_cannot_be_loaded_is_left_out(todframes, monkeypatch) -> None:
    class Entry:
        name, value = "lost", "another_package:lost"

        def load(self):
            raise ImportError("gone")

    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: [Entry()])
    status, out, err = todframes("enhancements", "--json")
    assert (status, json.loads(out)["enhancements"]) == (0, [])
    assert "left out: enhance 'lost': another_package:lost cannot be loaded (ImportError: gone)" in err


def test_located_frames_are_compared_where_the_triangle_is(todframes, make_dataset) -> None:
    """As `score --locate`, number for number: positions are those of the frames as they are."""
    made = make_dataset(side_px=40)
    for number, row in enumerate(made.rows):
        apex = Orientation(row["orientation"])
        triangle = coverage((40, 40), size_px=8.0, x_px=15.5, y_px=20.2, orientation=apex)
        write_frame(made.frame(number), 50.0 * (1.0 + float(row["contrast"]) * triangle), pixel_type="float")
    arguments = ("compare", made.path, "--enhance", "median", "--white", "100", "--json")
    status, out, err = todframes(*arguments, "--locate")
    assert status == 0
    assert err.startswith("located: 2 mrad: x_px 15.50, y_px 20.20 (±")
    compared = json.loads(out)
    assert json.loads(todframes(*arguments)[1])["conditions"][0]["fits"] != compared["conditions"][0]["fits"]
    scored = json.loads(todframes("score", made.path, "--locate", "--json", *QUICKLY)[1])
    assert compared["located"] == scored["located"]
    ours = compared["conditions"][0]["fits"]
    assert [fit["threshold"] for fit in ours] == [fit["threshold"] for fit in scored["fits"]]
