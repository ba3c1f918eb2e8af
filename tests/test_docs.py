"""The README's commands and code, and the sample datasets, do what they say."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import sys
from pathlib import Path

import pytest

from todframes.cli import cli
from todframes.command import run
from todframes.naked_eye import contrast_threshold
from todframes.observer import PyramidObserver

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def block(language: str) -> str:
    found = re.search(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
    assert found, f"README has no block {language}"
    return found[1]


def test_first_command_scores_the_samples(tmp_path: Path, monkeypatch, capsys) -> None:
    """All of it but the installation, which a test cannot repeat in its own environment."""
    make, install, *commands = (part.strip() for part in block("sh run").split("&&"))
    assert (make, install) == ("python3 -m venv .venv", ".venv/bin/pip install -q .")
    assert len(commands) == 2
    (tmp_path / "sample_frames").symlink_to(ROOT / "sample_frames")
    monkeypatch.chdir(tmp_path)
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == ".venv/bin/todframes"
        assert run(cli, arguments) == 0
    shown = capsys.readouterr().out
    result = json.loads((tmp_path / "tod_result" / "result.json").read_text(encoding="utf-8"))
    assert [fit["status"] for fit in result["fits"]] == ["ok"] * 4
    assert (tmp_path / "tod_result" / "tod_curve.png").stat().st_size > 10_000
    # The README shows this very table; sizes and thresholds at least must be those.
    rows = [line.split()[:2] for line in block("text").splitlines() if re.match(r" +\d", line)]
    assert len(rows) == 4
    shown_rows = [line.split()[:2] for line in shown.splitlines() if re.match(r" +\d", line)]
    assert rows == shown_rows[:4]
    assert len(shown_rows) == 7


def test_python_example(monkeypatch, capsys) -> None:
    monkeypatch.chdir(ROOT)
    exec(compile(block("python"), "README.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    for line, size in zip(lines, (0.6, 0.9, 1.4, 2.4), strict=True):
        threshold, low, high = map(float, re.fullmatch(rf"\({size},\) (\S+) \((\S+), (\S+)\)", line).groups())
        assert low <= threshold <= high


def test_documented_files_exist() -> None:
    for name in re.findall(r"\]\(([\w./]+)\)", README):
        assert (ROOT / name).exists(), name


def test_documented_settings_are_the_settings() -> None:
    from dataclasses import fields

    from todframes.observer import PyramidSettings
    from todframes.psychometric import FitSettings

    text = (ROOT / "docs" / "model.md").read_text(encoding="utf-8")
    documented = re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)
    assert sorted(documented) == sorted(f.name for kind in (PyramidSettings, FitSettings) for f in fields(kind))


@pytest.fixture(scope="module")
def made_again(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample datasets, made by the command that their README names."""
    folder = tmp_path_factory.mktemp("samples")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["make_samples.py", str(folder)])
        runpy.run_path(str(ROOT / "sample_frames" / "make_samples.py"), run_name="__main__")
    return folder


@pytest.mark.parametrize("name", ["naked_eye", "grabbed_8bit", "staring_camera"])
def test_samples_can_be_made_again(made_again: Path, name: str) -> None:
    ours, theirs = ROOT / "sample_frames" / name, made_again / name
    files = sorted(path.relative_to(ours) for path in ours.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(theirs) for path in theirs.rglob("*") if path.is_file())
    assert len(files) > 140
    for file in files:
        assert (ours / file).read_bytes() == (theirs / file).read_bytes(), file


@pytest.mark.parametrize("name", ["naked_eye", "grabbed_8bit", "staring_camera"])
def test_samples_are_valid(name: str, capsys) -> None:
    assert run(cli, ["validate", str(ROOT / "sample_frames" / name)]) == 0
    assert "all good" in capsys.readouterr().out


def test_grabbed_frames_have_thresholds(capsys) -> None:
    assert run(cli, ["score", str(ROOT / "sample_frames" / "grabbed_8bit"), "--json"]) == 0
    fits = json.loads(capsys.readouterr().out)["fits"]
    for fit in fits:
        # Pixels and noise of a display cannot make it easier than for the naked eye; here they make it less than
        # three times as hard.
        naked = contrast_threshold(PyramidObserver(), size_mrad=fit["group"]["size_mrad"]).threshold
        assert naked < fit["threshold"] < 3 * naked


def test_samples_are_small() -> None:
    total = sum(path.stat().st_size for path in (ROOT / "sample_frames").rglob("*") if path.is_file())
    assert total < 15 * 2**20
