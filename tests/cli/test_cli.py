"""The commands as a user meets them."""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from todframes import load_result, score
from todframes.cli.console import print_result, print_table
from todframes.frames.files import write_frame
from todframes.psychometrics.fit import FitSettings
from todframes.results.tables import Column, Table


@pytest.mark.usefixtures("blank_pictures")
def test_score_writes_what_it_prints(todframes, make_dataset, tmp_path: Path) -> None:
    path = make_dataset(sizes_mrad=(1.0, 2.0), contrasts=(0.05, 0.1, 0.2)).path
    out_folder = tmp_path / "result"
    options = ("--internal-noise", "0.25", "--set", "kernel_a=0.4")
    status, out, _ = todframes("score", path, "-o", out_folder, "--json", *options)
    assert status == 0
    settings, fits = (json.loads(out)[name] for name in ("settings", "fits"))
    assert (settings["internal_noise"], settings["kernel_a"]) == (0.25, 0.4)
    assert [fit["group"] for fit in fits] == [{"size_mrad": 1.0}, {"size_mrad": 2.0}]
    assert fits[0]["threshold"] > fits[1]["threshold"], "larger is easier"
    names = {"report.html", "result.json", "scores.csv", "psychometric.png", "tod_curve.png"}
    assert {file.name for file in out_folder.iterdir()} == names
    written = json.loads((out_folder / "result.json").read_text(encoding="utf-8"))
    assert written == json.loads(out) | {"files": written["files"]}
    with (out_folder / "scores.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 24
    for row in rows:
        probabilities = [float(row[f"p_{name}"]) for name in ("up", "right", "down", "left")]
        assert sum(probabilities) == pytest.approx(1.0, abs=1e-12)
        assert float(row["p_correct"]) == float(row[f"p_{row['orientation']}"])
    by_level = [float(row["p_correct"]) for row in rows if (row["size_mrad"], row["contrast"]) == ("1.0", "0.1")]
    point = json.loads(out)["fits"][0]["points"][1]
    assert point["p_correct"] == pytest.approx(np.mean(by_level), abs=1e-12)
    assert sorted(path.parent.glob(".*")) == []  # no temporary folder is left


@pytest.mark.usefixtures("blank_pictures")
def test_no_formula_in_scores(todframes, make_dataset, tmp_path: Path) -> None:
    """A text that a spreadsheet would compute has an apostrophe before it, in rows and above them."""
    dataset = make_dataset(contrasts=(0.1, 0.4), experiment={"group_by": ["@lens", "shift"]})
    for number, row in enumerate(dataset.rows):
        row |= {"@lens": "=HYPERLINK(1)", "shift": "-1.5", "trial": f"+{number}%"}
    dataset.save()
    out_folder = tmp_path / "result"
    assert todframes("score", dataset.path, "-o", out_folder, "--set", "resamples=0")[0] == 0
    with (out_folder / "scores.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["'@lens"] for row in rows} == {"'=HYPERLINK(1)"}
    assert [row["trial"] for row in rows] == [f"'+{number}%" for number in range(8)]
    assert {row["shift"] for row in rows} == {"-1.5"}


def test_a_narrow_terminal_has_fewer_columns_and_whole_numbers(make_dataset, capsys, monkeypatch) -> None:
    """Every line fits, and thresholds have the digits that they have on a wide one."""
    made = make_dataset(sizes_mrad=(1.0, 2.0), contrasts=(0.02, 0.05, 0.1, 0.2), suffix=".png")
    result = score(made.path, tolerance=0.02, fit=FitSettings(resamples=200), examples=False)

    def shown() -> str:
        print_result(result)
        return capsys.readouterr().out

    wide = shown()
    for width in (80, 60):
        monkeypatch.setenv("COLUMNS", str(width))
        narrow = shown()
        rows, expected = (
            [re.split("  +", line.strip()) for line in text.splitlines() if re.match(" +[0-9]", line)]
            for text in (narrow, wide)
        )
        assert [row[:3] for row in rows] == [row[:3] for row in expected]
        assert [len(row) for row in expected] == [6] * 2
        assert all(len(line) <= width for line in narrow.splitlines())
        assert "…" not in narrow


def test_a_narrow_table_has_whole_words(capsys, monkeypatch) -> None:
    """Names are broken behind a slash, other texts and open intervals between their words."""
    columns = [
        Column(key="condition", is_name=True, wraps=True),
        Column(key="size_mrad", header="size (detectors)", is_name=True),
        Column(key="threshold", header="threshold contrast"),
        Column(key="ratio"),
        Column(key="ratio_ci95", header="95 % interval", interval="ratio", digits=3),
        Column(key="verdict", wraps=True),
    ]
    values = ("onnx:networks/denoiser.onnx", 6.0, 0.6897, 2.671, (1.804, None), "no difference shown")
    table = Table.of(
        "Ratios", "ratios.csv", columns, [dict(zip([one.key for one in columns], values, strict=True))]
    )
    monkeypatch.setenv("COLUMNS", "80")
    print_table(table)
    *_, first, second, third, _ = capsys.readouterr().out.splitlines()
    assert max(map(len, (first, second, third))) <= 80
    assert first.split() == ["onnx:networks/", "6", "0.6897", "2.671", "from", "1.80,", "no"]
    assert second.split() == ["denoiser.onnx", "open", "above", "difference"]
    assert third.split() == ["shown"]


def test_settings_file_and_which_goes_first(todframes, make_dataset, tmp_path: Path) -> None:
    file = tmp_path / "observer.toml"
    file.write_text('internal_noise = 0.1\nkernel_a = 0.4\ncentre = "bounding_box"\n', encoding="utf-8")
    arguments = ["--observer-settings", file, "--set", "kernel_a=0.3", "--set", "internal_noise=0.2"]
    _, out, _ = todframes("score", make_dataset().path, *arguments, "--internal-noise", "0.3", "--json")
    settings = json.loads(out)["settings"]
    assert (settings["centre"], settings["kernel_a"], settings["internal_noise"]) == ("bounding_box", 0.3, 0.3)


@pytest.mark.usefixtures("blank_pictures")
def test_naked_eye(todframes, tmp_path: Path) -> None:
    """It writes what it prints."""
    status, out, err = todframes("naked-eye", "--size-mrad", "1.0,1.5", "-o", tmp_path / "out", "--json")
    assert (status, err) == (0, "")
    names = {"report.html", "result.json", "tod_curve.png"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    written = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert written == json.loads(out) | {"files": written["files"]}
    assert [*written["files"]] == ["report.html", "tod_curve.png"]
    one, two = json.loads(out)["fits"]
    assert one["threshold"] == pytest.approx(0.1462, rel=0.005)
    assert two["threshold"] < one["threshold"]
    assert one["level"] == "contrast"
    assert one["threshold_numerical_error"] < 1e-3
    _, out, _ = todframes("naked-eye", "--contrast", "0.1462", "--json")
    (acuity,) = json.loads(out)["fits"]
    assert (acuity["level"], acuity["group"]) == ("size_mrad", {"contrast": 0.1462})
    assert acuity["threshold"] == pytest.approx(1.0, rel=0.005)


def test_an_error_as_large_as_the_threshold_leaves_none(todframes) -> None:
    """At 0.2 mrad the retina's samples of 0.1 mrad give 303, samples of 0.05 mrad 964 and of 0.0125 mrad 1,000."""
    status, out, err = todframes("naked-eye", "--observer", "csf", "--size-mrad", "0.2", "--json")
    (fit,), (warning,) = json.loads(out)["fits"], json.loads(out)["warnings"]
    assert (status, fit["status"], fit["threshold"]) == (0, "too_uncertain", None)
    assert warning["code"] == "numerical_error" and "more than 30 % of the threshold, so there is none" in err
    fine = ("--set", "retina_pitch_mrad=0.05", "--json")
    (fit,) = json.loads(todframes("naked-eye", "--observer", "csf", "--size-mrad", "0.2", *fine)[1])["fits"]
    # The error is the difference from a quarter of the step, which itself has a sixteenth of it.
    error = 17.0 / 16.0 * fit["threshold_numerical_error"]
    assert (fit["status"], fit["threshold"]) == ("ok", pytest.approx(1000.0, abs=error))


def test_fit(todframes, tmp_path: Path) -> None:
    """Counts that lie on a curve: α = 2, β = 1.5, no lapses; 75 % at α · log₂(3)^(1/β)."""
    path = tmp_path / "counts.csv"
    levels = [0.5, 1.0, 2.0, 4.0, 8.0]
    n = 10**6
    counts = [round(n * (1 - 0.75 * 2 ** -((x / 2.0) ** 1.5))) for x in levels]
    rows = "".join(f"{x},{k},{n},left\n" for x, k in zip(levels, counts, strict=True))
    path.write_text("level,n_correct,n_trials,eye\n" + rows, encoding="utf-8")
    status, out, _ = todframes("fit", path, "--json")
    assert status == 0
    (fit,) = json.loads(out)["fits"]
    assert fit["group"] == {"eye": "left"}
    assert fit["threshold"] == pytest.approx(2.0 * np.log2(3.0) ** (1 / 1.5), rel=1e-3)
    assert fit["n_trials"] == 5 * n
    assert "left" in todframes("fit", path, "-o", tmp_path / "fitted")[1]
    assert load_result(tmp_path / "fitted").thresholds[0].n_trials == 5 * n


@pytest.mark.parametrize("module", ["todframes.cli.main", "sensor_sim.cli"])
def test_help_imports_nothing_slow(module: str) -> None:
    code = f"import sys; from todframes.cli.console import run; from {module} import cli; run(cli, ['--help']); "
    code += "sys.exit(bool({'numpy', 'scipy', 'cv2', 'OpenImageIO', 'rich', 'matplotlib'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


def test_a_size_that_is_left_out_is_a_warning(todframes, make_dataset) -> None:
    made = make_dataset(sizes_mrad=(1.5, 2.0), side_px=64)
    for number, row in enumerate(made.rows):
        if row["size_mrad"] == "1.5":
            made.frame(number).write_bytes(b"no frame")
    n_lost = sum(row["size_mrad"] == "1.5" for row in made.rows)
    status, out, err = todframes("score", made.path, "--on-error", "skip", "--json", "--strict")
    (warning,) = (one for one in json.loads(out)["warnings"] if one["code"] == "group_left_out")
    assert (status, warning["group"], warning["expected"]) == (1, {"size_mrad": 1.5}, n_lost)
    assert f"warning: 1.5 mrad: its {n_lost} trials cannot be used and are left out" in err


def test_locate_and_skip_go_together(todframes, make_dataset) -> None:
    """A group in which nothing stands out, and a frame with a wrong checksum, do not stop the rest."""
    made = make_dataset(sizes_mrad=(1.5, 2.0), side_px=64, contrasts=(0.1, 0.2, 0.4))
    for number, row in enumerate(made.rows):
        row["sha256"] = ""
        if row["size_mrad"] == "1.5":
            noise = np.random.default_rng(number).normal(size=(64, 64))
            write_frame(made.frame(number), 50.0 + noise, pixel_type="float")
    made.rows[-1]["sha256"] = "0" * 64
    made.save()
    status, out, _ = todframes("score", made.path, "--locate", "--on-error", "skip", "--json")
    assert status == 0
    result = json.loads(out)
    assert [fit["group"] for fit in result["fits"]] == [{"size_mrad": 2.0}]
    spoilt = {row["frame"] for row in [*made.rows[:12], made.rows[-1]]}
    assert {one["frame"] for one in result["skipped"]} == spoilt
    assert todframes("score", made.path, "--locate")[0] == 1


def test_libraries_are_kept_to_one_thread() -> None:
    """Unless the environment says otherwise."""
    ask = "keep_libraries_to_one_thread(); import cv2; print(cv2.getNumThreads())"
    script = f"from todframes.cli.console import keep_libraries_to_one_thread; {ask}"
    names = ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    bare = {name: value for name, value in os.environ.items() if name not in names}
    for environment, expected in ((bare, "1\n"), (bare | {names[1]: "2"}, "2\n")):
        command = [sys.executable, "-c", script]
        assert subprocess.check_output(command, text=True, env=environment) == expected
