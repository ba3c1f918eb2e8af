"""The README's commands and code, and the sample datasets, do what they say."""

from __future__ import annotations

import json
import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest

from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.enhancement.algorithm import Declaration, find_enhancement
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.naked_eye import contrast_threshold

ROOT = Path(__file__).parent.parent
SAMPLES = ["naked_eye", "grabbed_8bit", "staring_camera", "enhancement"]
README = (ROOT / "README.md").read_text(encoding="utf-8")
ENHANCEMENT = (ROOT / "docs" / "enhancement.md").read_text(encoding="utf-8")


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
        pattern = rf"{{'size_mrad': {size}}} (\S+) \((\S+), (\S+)\)"
        threshold, low, high = map(float, re.fullmatch(pattern, line).groups())
        assert low <= threshold <= high


def test_documented_files_exist() -> None:
    for name in re.findall(r"\]\(([\w./]+)\)", README):
        assert (ROOT / name).exists(), name
    for name in re.findall(r"\]\(([\w./]+)(?:#[\w-]+)?\)", ENHANCEMENT):
        assert (ROOT / "docs" / name).exists(), name


def test_own_functions_of_the_enhancement_page(tmp_path: Path, monkeypatch) -> None:
    """The functions it shows can be used as it says."""
    found = re.search(r"^```python\n(.*?)^```$", ENHANCEMENT, re.MULTILINE | re.DOTALL)
    (tmp_path / "own_of_docs.py").write_text(found[1], encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    image = np.full((6, 8), 0.6, np.float32)
    assert np.allclose(find_enhancement("own_of_docs:stretched:gain=3").run(image)[0], 0.8, atol=1e-6)
    finer = find_enhancement("own_of_docs:finer")
    assert (finer.declaration.domain, finer.magnification) == ("luminance", 2.0)
    assert finer.run(image)[0].shape == (12, 16)


def test_declarations_of_the_enhancement_page() -> None:
    """Its table of what the decorator takes has all of it."""
    from dataclasses import fields

    table = ENHANCEMENT.partition("What the decorator")[2].partition("\n\nA package")[0]
    assert re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) == [field.name for field in fields(Declaration)]


def test_enhancement_of_the_samples_is_as_shown(tmp_path: Path, monkeypatch, capsys) -> None:
    """The page's command gives the page's thresholds, ratios and verdicts: one helps, one hurts, one neither."""
    command = re.search(r"^```sh\n(.*?)^```$", ENHANCEMENT, re.MULTILINE | re.DOTALL)[1]
    (tmp_path / "sample_frames").symlink_to(ROOT / "sample_frames")
    monkeypatch.chdir(tmp_path)
    program, *arguments = shlex.split(command.replace("\\\n", " "))
    assert (program, run(cli, arguments)) == ("todframes", 0)
    page = re.search(r"^```text\n(.*?)^```$", ENHANCEMENT, re.MULTILINE | re.DOTALL)[1]
    rows = re.compile(
        r"(all|[\d.]+) +([\d.]+)(?: +([\d.]+))? .* (better|worse|no difference shown|reference) *$", re.M
    )
    shown, found = (rows.findall(text.partition("Beside")[0]) for text in (page, capsys.readouterr().out))
    assert len(shown) == len(found) == 3 + 3 * 4
    assert [row[-1] for row in found if row[0] == "all"] == ["better", "worse", "no difference shown"]
    for (size, *ours, verdict), (found_size, *theirs, found_verdict) in zip(shown, found, strict=True):
        assert (size, verdict) == (found_size, found_verdict)
        # Other versions of the libraries that do the enhancement may round otherwise.
        assert [float(x or 0) for x in ours] == pytest.approx([float(x or 0) for x in theirs], rel=0.02)


def test_documented_settings_are_the_settings() -> None:
    from dataclasses import fields

    from todframes.observers.pyramid import PyramidSettings
    from todframes.psychometrics.fit import FitSettings

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


@pytest.mark.parametrize("name", SAMPLES)
def test_samples_can_be_made_again(made_again: Path, name: str) -> None:
    ours, theirs = ROOT / "sample_frames" / name, made_again / name
    files = sorted(path.relative_to(ours) for path in ours.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(theirs) for path in theirs.rglob("*") if path.is_file())
    assert len(files) > 140
    for file in files:
        assert (ours / file).read_bytes() == (theirs / file).read_bytes(), file


@pytest.mark.parametrize("name", SAMPLES)
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
