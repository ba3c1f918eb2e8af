"""The commands and the code of the README and of the documentation, and the sample datasets, do what they say."""

from __future__ import annotations

import ast
import inspect
import json
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import get_args

import click
import numpy as np
import pytest
from scipy.io import loadmat

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.sensor import (
    Detector,
    Electronics,
    Motion,
    Noise,
    Optics,
    PhotonNoise,
    Scene,
    SensorDisplay,
    Turbulence,
)
from sensor_sim.cli import cli as sensor_sim
from todframes import __version__
from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.enhancement.algorithm import Declaration
from todframes.enhancement.finding import find_enhancement
from todframes.frames.dataset import WarningCode
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.psychometrics.fit import FitSettings
from todframes.scoring.naked_eye import contrast_threshold

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
SAMPLES = ["naked_eye", "grabbed_8bit", "staring_camera", "enhancement"]
README = (ROOT / "README.md").read_text(encoding="utf-8")
ENHANCEMENT = (DOCS / "explanation" / "enhancement.md").read_text(encoding="utf-8")
COMMANDS = {"todframes": cli, "sensor-sim": sensor_sim}


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def block(language: str) -> str:
    found = blocks(README, language)
    assert found, f"README has no block {language}"
    return found[0]


def test_the_tests_that_pages_name_exist() -> None:
    named = {
        name for page in DOCS.glob("[!_]*/*.md") for name in re.findall(r"test_\w+\.py", page.read_text("utf-8"))
    }
    assert named and named <= {path.name for path in (ROOT / "tests").rglob("test_*.py")}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder that sees the sample frames; a page's commands may write into it."""
    (tmp_path / "sample_frames").symlink_to(ROOT / "sample_frames")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    return tmp_path


def run_commands(text: str) -> None:
    """Every command of a block, as if typed in the working folder."""
    for line in text.replace("\\\n", " ").splitlines():
        program, *arguments = shlex.split(line)
        assert run(COMMANDS[program], arguments) == 0, line


def run_code(*parts: str) -> dict:
    """Code of a page, in one go."""
    names: dict = {}
    exec(compile("\n".join(parts), "page", "exec"), names)
    return names


def page(name: str) -> str:
    (path,) = DOCS.glob(f"[!_]*/{name}")
    return path.read_text(encoding="utf-8")


@pytest.mark.slow
def test_first_command_scores_the_samples(folder: Path, capsys) -> None:
    """All of it but the installation, which a test cannot repeat in its own environment."""
    make, install, *commands = (part.strip() for part in block("sh run").split("&&"))
    assert (make, install) == ("python3 -m venv .venv", ".venv/bin/pip install -q .")
    assert len(commands) == 2
    for command in commands:
        program, *arguments = shlex.split(command)
        assert program == ".venv/bin/todframes"
        assert run(cli, arguments) == 0
    shown = capsys.readouterr().out
    result = json.loads((folder / "tod_result" / "result.json").read_text(encoding="utf-8"))
    assert [fit["status"] for fit in result["fits"]] == ["ok"] * 4
    assert (folder / "tod_result" / "tod_curve.png").stat().st_size > 10_000
    # The README shows this very table; sizes and thresholds at least must be those.
    rows, shown_rows = (
        [line for line in text.splitlines() if re.match(r" +\d", line)] for text in (block("text"), shown)
    )
    assert len(rows) == 4
    for ours, theirs in zip(rows, shown_rows, strict=False):
        assert [float(word) for word in ours.split()[:2]] == [float(word) for word in theirs.split()[:2]]
    # Both tables look like success: thresholds within the levels shown, intervals with both ends.
    assert len(shown_rows) == 7
    assert all("ok" in line.split() and "?" not in line for line in shown_rows)


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLES)
def test_samples_have_thresholds_and_no_warning(name: str, capsys) -> None:
    """Those that their page states, and those that the display of the grabbed frames allows."""
    assert run(cli, ["score", str(ROOT / "sample_frames" / name), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["warnings"] == []
    assert {fit["status"] for fit in result["fits"]} == {"ok"}
    if name == "staring_camera":
        check_stated_thresholds(result["fits"])
    if name == "grabbed_8bit":
        for fit in result["fits"]:
            # Pixels and noise of a display cannot make it easier than for the naked eye; here they make it less
            # than three times as hard.
            naked = contrast_threshold(PyramidObserver(), size_mrad=fit["group"]["size_mrad"]).threshold
            assert naked < fit["threshold"] < 3 * naked


def check_stated_thresholds(fits: list[dict]) -> None:
    text = (ROOT / "sample_frames" / "README.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([\d.]+) \| ([\d.]+) \| ([\d.]+) – ([\d.]+) \| ([\d.]+) \|$", text, re.MULTILINE)
    assert len(rows) == len(fits) == 3
    for row, fit in zip(rows, fits, strict=True):
        size, threshold, low, high, all_cameras = map(float, row)
        assert fit["group"]["size_detectors"] == size
        assert [fit["threshold"], *fit["threshold_ci95"]] == pytest.approx([threshold, low, high], rel=1e-3)
        assert low < all_cameras < high


def test_python_example(monkeypatch, capsys) -> None:
    monkeypatch.chdir(ROOT)
    run_code(block("python"))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    for line, size in zip(lines, (0.6, 0.9, 1.4, 2.4), strict=True):
        pattern = rf"{{'size_mrad': {size}}} (\S+) [(\[](\S+), (\S+)[)\]]"
        threshold, low, high = map(float, re.fullmatch(pattern, line).groups())
        assert low <= threshold <= high


def test_tutorial(folder: Path, capsys) -> None:
    """From an array to a picture in ten lines, with thresholds that are there."""
    make, *score = blocks(page("tutorial.md"), "python")
    assert sum(bool(line.strip()) for part in score for line in part.splitlines()) <= 10
    names = run_code(make, *score)
    assert names["frames"].shape == (180, 96, 96)
    assert [found.status for found in names["result"].thresholds] == ["ok"] * 3
    assert len(capsys.readouterr().out.splitlines()) == 3
    assert (folder / "tod_curve.png").stat().st_size > 10_000


# Files that a page tells its reader to save, by the number of the block that holds them.
SAVED = {
    "charts.md": ("patches.csv", "text", 0),
    "field_range.md": ("mrtd.csv", "text", 0),
    "fit_counts.md": ("counts.csv", "text", 0),
    "own_enhancement.md": ("my_enhancements.py", "python", 0),
}
HOW_TO = [
    *("own_frames.md", "charts.md", "import_recordings.md", "scenes.md", "compare_algorithms.md"),
    "two_cameras.md",
    *("simulate_sensor.md", "sweep.md", "field_range.md", "fit_counts.md", "own_enhancement.md"),
    "other_programs.md",
]


def page_with_its_file(name: str, folder: Path) -> str:
    """Return a page, whose reader has saved the file that it shows."""
    text = page(name)
    if name in SAVED:
        file, language, number = SAVED[name]
        (folder / file).write_text(blocks(text, language)[number], encoding="utf-8")
    return text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "file", "shown"),
    [
        ("camera_noise.md", "noise_of_wall/sensor_noise.toml", "SNR"),
        ("emva.md", "emva_of_camera/sensor_noise.toml", "system gain K             0.2797   DN/e⁻"),
        ("camera_mtf.md", "mtf_of_camera/mtf.csv", "MTF50 0.234"),
    ],
)
def test_commands_of_the_pages_on_cameras(folder: Path, capsys, name: str, file: str, shown: str) -> None:
    text = page(name)
    run_code(*blocks(text, "python"))
    printed = capsys.readouterr().out
    assert printed == blocks(text, "text")[0] or name != "camera_mtf.md"
    for command in blocks(text, "sh"):
        run_commands(command)
    assert (folder / file).is_file()
    assert shown in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("name", HOW_TO)
def test_commands_of_a_how_to_page(name: str, folder: Path) -> None:
    text = page_with_its_file(name, folder)
    commands = blocks(text, "sh")
    assert commands
    for command in commands:
        run_commands(command)


SLOW_CODE = [*HOW_TO, "api.md", "camera_noise.md", "thermal_background.md", "your_camera.md"]
QUICK = ["datasets.md", "own_frames.md", "fit_counts.md", "own_enhancement.md", "results_elsewhere.md"]


@pytest.mark.parametrize(
    "name", [*QUICK, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW_CODE if name not in QUICK)]
)
def test_code_of_a_page(name: str, folder: Path, capsys) -> None:
    text = page_with_its_file(name, folder)
    if name == "results_elsewhere.md":
        pytest.importorskip("pandas", reason="pandas comes with the group dev")
    if name == "two_cameras.md":
        run_commands(blocks(text, "sh")[0])
    run_code(*blocks(text, "python"))
    if name == "own_frames.md":
        assert capsys.readouterr().out == "never_reached\n"
    if name in ("datasets.md", "camera_noise.md", "thermal_background.md", "results_elsewhere.md"):
        assert capsys.readouterr().out == blocks(text, "text")[0]
    if name == "results_elsewhere.md":
        columns = loadmat("thresholds.mat")
        assert [name.item() for name in columns["observer"].ravel()] == ["MH", "PB"]
        assert columns["threshold"].shape == (2, 1)
    if name == "your_camera.md":
        assert capsys.readouterr().out == blocks(text, "text")[-1]


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
def test_frames_go_wrong_and_right_again(capsys) -> None:
    """The copy with a wrong background has the warnings shown, and with "surround" none."""
    text = page("frames_go_wrong.md")
    run_code(*blocks(text, "python"))
    assert capsys.readouterr().out == blocks(text, "text")[0] + "()\n"
    run_commands(blocks(text, "sh")[0])


def test_each_warning_has_a_section_and_its_picture() -> None:
    text = page("warnings.md")
    sections = dict(re.findall(r"^### `(\w+)`\n\n(.*)$", text, re.MULTILINE))
    assert sorted(sections) == sorted(get_args(WarningCode))
    pictures = {code: re.search(r"\((.*)\.png\)$", line) for code, line in sections.items()}
    assert {code for code, found in pictures.items() if not found} == {
        *("above_contrast_1", "below_chance", "channels_chosen", "displacement_varies", "edge_brightness"),
        *("falling_answers", "group_left_out", "levels_to_add", "lossy_compression"),
        *("metadata_ignored", "not_proportional", "not_repeatable", "numerical_error"),
        *("sensor_mismatch", "unverified_frames"),
    }
    assert all(found[1] == f"frames_go_wrong/{code}" for code, found in pictures.items() if found)
    files = sorted(DOCS.glob("reference/frames_go_wrong/*.png"))
    assert [file.stem for file in files] == sorted(code for code, found in pictures.items() if found)
    assert sum(file.stat().st_size for file in files) < 600_000


def test_no_warning_has_a_code_of_its_own() -> None:
    """Type checkers see the codes of warnings about datasets; those of results, as of ranges, are any text."""
    codes = {
        keyword.value.value
        for file in (ROOT / "todframes").rglob("*.py")
        if file.parent.name != "field" and "ResultWarning" in (text := file.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "ResultWarning"
        for keyword in node.keywords
        if keyword.arg == "code" and isinstance(keyword.value, ast.Constant)
    }
    assert {"levels_to_add"} <= codes <= set(get_args(WarningCode))


@pytest.mark.oracle
def test_each_command_and_each_key_has_its_page() -> None:
    """The pages that are made when the site is built: every option with its text, every key with its meaning."""
    pytest.importorskip("numpydoc", reason="the pages need the docs extra")
    from command_pages import commands_of, descriptions, pages

    from todframes.comparison.records import ComparedCondition
    from todframes.results.data import Fit
    from todframes.results.result import RESULT_TYPES, Result

    made = pages()
    for program, group in COMMANDS.items():
        for name, command in commands_of(group).items():
            text = made[f"commands/{program}-{name}.md"]
            terms = re.findall(r"^`(-.*)`\n: \S", text, re.MULTILINE)
            options = [one.opts[-1] for one in command.params if isinstance(one, click.Option)]
            assert [re.search(r"--[\w-]+", term)[0] for term in terms] == options, name
            assert f"[`{program} {name}`]" in made[f"commands/{program}.inc"]
    for record in {Result, Fit, ComparedCondition, *(kind.result_type for kind in RESULT_TYPES.values())}:
        known = descriptions(record)
        assert not [one for one in record.__struct_fields__ if not known.get(one)], record
    assert "| `gamma` | number or null | Parameters α, β, γ and δ" in made["commands/keys.inc"]


WITHOUT_EXAMPLE = {
    *("calibrate", "compare_frames", "explore", "import_answers", "import_recordings", "run_experiment", "worth")
}
"""Calls that need people, a film, a server or another result; pages show them."""

OF_CALLS = {"GL07", "GL08", "PR01", "PR02", "PR03", "PR04", "PR05", "PR06", "PR07", "RT01", "SS01", "SS03", "EX01"}
"""Checks of numpydoc for calls: sections in order, all parameters with type and text, a result, an example."""


@pytest.mark.oracle
def test_docstrings_of_calls_pass_the_checks_of_numpydoc() -> None:
    validate = pytest.importorskip("numpydoc.validate", reason="numpydoc comes with the docs extra").validate
    found = {}
    for package in (tod, ss):
        for name in dir(package):
            call = getattr(package, name)
            if inspect.isfunction(call):
                allowed = {"EX01"} if name in WITHOUT_EXAMPLE else set()
                errors = {code for code, _ in validate(f"{call.__module__}.{name}")["errors"]}
                if wrong := errors & OF_CALLS - allowed:
                    found[name] = wrong
    assert found == {}


def test_own_observer_by_its_module(folder: Path, capsys) -> None:
    text = page("own_observer.md")
    (folder / "retina_samples.py").write_text(blocks(text, "python")[0], encoding="utf-8")
    run_commands(blocks(text, "sh module")[0])
    (folder / "checked.py").write_text("\n".join(blocks(text, "python")), encoding="utf-8")
    runpy.run_path(str(folder / "checked.py"))  # the check has nothing to report
    sys.modules.pop("retina_samples", None)
    assert " 8 " in capsys.readouterr().out


def test_documented_files_exist() -> None:
    for text in (README, (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")):
        for name in re.findall(r"\]\(([\w./]+)\)", text):
            assert (ROOT / name).exists(), name


def test_version_licences_and_paper_are_one() -> None:
    """Those of the package, of its metadata and of the citation; a file of its pages has a licence of its own."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.*)$", citation, re.MULTILINE)[1] == project["version"] == __version__
    listed = re.search(r"^license:.*\n((?:  - .*\n)+)", citation, re.MULTILINE)[1]
    assert re.findall(r"- (.*)", listed) == project["license"].split(" AND ") == ["BSD-3-Clause", "MIT"]
    assert f"https://doi.org/{re.search(r'doi: (.*)', citation)[1]}" == project["urls"]["Paper"]


@pytest.mark.slow
@pytest.mark.oracle
def test_site_has_no_warnings_and_loads_nothing(tmp_path: Path) -> None:
    """Built by the README's command; no page needs anything from elsewhere, and options keep their hyphens."""
    pytest.importorskip("sphinx", reason="the site needs the docs extra")
    program, *arguments = shlex.split(block("sh docs").partition("&&")[2])
    assert (program, arguments[-2:]) == (".venv/bin/sphinx-build", ["docs", "docs/_build"])
    command = [sys.executable, "-m", "sphinx", *arguments[:-1], str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (built.returncode, built.stderr) == (0, "")
    pages = sorted(tmp_path.rglob("*.html"))
    assert len(pages) > 20
    for html in pages:
        text = html.read_text("utf-8")
        assert not re.search(r"(?<!\w)–[a-z]", text), html
        loaded = re.findall(r"<(?:script|link|img|iframe)\b[^>]*?(?:src|href)=\"([^\"]*)\"", text)
        assert not [address for address in loaded if re.match(r"(?:https?:)?//", address)], html


def test_own_functions_of_the_enhancement_page(tmp_path: Path, monkeypatch) -> None:
    """The functions it shows can be used as it says."""
    code = "\n".join(blocks(page("own_enhancement.md"), "python"))
    (tmp_path / "own_of_docs.py").write_text(code, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    image = np.full((6, 8), 0.6, np.float32)
    assert np.allclose(find_enhancement("own_of_docs:stretched:gain=3").run(image)[0], 0.8, atol=1e-6)
    finer = find_enhancement("own_of_docs:finer")
    assert (finer.declaration.domain, finer.magnification) == ("luminance", 2.0)
    assert finer.run(image)[0].shape == (12, 16)
    clip = np.stack([7.0 * image, 14.0 * image, 0.0 * image, 7.0 * image])
    after, _ = find_enhancement("own_of_docs:fading:before=2").run_clip(clip, np.array([2, 3]), None)
    assert np.allclose(after, np.array([5.0, 6.0])[:, None, None] * image, rtol=1e-6)  # weights 1/7, 2/7, 4/7


@pytest.mark.weekly
@pytest.mark.usefixtures("folder")
def test_enhancement_of_the_samples_is_as_shown(capsys) -> None:
    """The page's command gives the page's thresholds, ratios and verdicts: one helps, one hurts, one neither."""
    command = re.search(r"^```sh\n(.*?)^```$", ENHANCEMENT, re.MULTILINE | re.DOTALL)[1]
    program, *arguments = shlex.split(command.replace("\\\n", " "))
    assert (program, run(cli, arguments)) == ("todframes", 0)
    stated = re.search(r"^```text\n(.*?)^```$", ENHANCEMENT, re.MULTILINE | re.DOTALL)[1]
    verdicts = "better|worse|no difference shown|reference"
    rows = re.compile(rf"(all|[\d.]+) +(?:\w+ +)?([\d.]+|–)(?: +([\d.]+))? .* ({verdicts})\b", re.M)
    tables = (text.partition("Algorithms and")[0] for text in (stated, capsys.readouterr().out))
    shown, found = map(rows.findall, tables)
    assert len(shown) == len(found) == 3 + 3 * 4
    assert [row[-1] for row in found if row[0] == "all"] == ["better", "worse", "no difference shown"]
    for (size, *ours, verdict), (found_size, *theirs, found_verdict) in zip(shown, found, strict=True):
        assert (size, verdict) == (found_size, found_verdict)
        # Other versions of the libraries that do the enhancement may round otherwise.
        our_numbers, their_numbers = ([float(x.strip("–") or 0) for x in row] for row in (ours, theirs))
        assert our_numbers == pytest.approx(their_numbers, rel=0.02)


@pytest.mark.parametrize(
    ("name", "begin", "kinds"),
    [
        ("model.md", "", (PyramidSettings, FitSettings)),
        ("own_enhancement.md", "What the decorator", (Declaration,)),
    ],
)
def test_documented_settings_are_the_settings(name: str, begin: str, kinds: tuple[type, ...]) -> None:
    table = page(name).partition(begin)[2] if begin else page(name)
    table = table.partition("\n\nA package")[0] if begin else table
    documented = dict(re.findall(r"^\| `(\w+)` \|([^|]*)\|", table, re.MULTILINE))
    defaults = {field.name: field.default for kind in kinds for field in fields(kind)}
    assert sorted(documented) == sorted(defaults)
    for name, default in defaults.items():
        if isinstance(default, (int, float)):
            assert documented[name].strip() in (f"{default:g}", str(default).lower()), name


def test_documented_defaults_of_a_sensor_are_the_defaults() -> None:
    kinds = {"optics": Optics, "motion": Motion, "noise": Noise, "electronics": Electronics}
    kinds |= {"turbulence": Turbulence, "display": SensorDisplay, "detector": Detector, "scene": Scene}
    n_checked = 0
    for line in page("sensor.md").splitlines():
        if table := re.match(r"\| \*\*\[(\w+)\]", line):
            kind = PhotonNoise if "`model`" in line else kinds[table[1]]
        if stated := re.search(r"\| (?:.*; )?default ([\d.]+|false) \|$", line):
            for name in re.findall(r"`(\w+)`", line.split("|")[1]):
                n_checked += 1
                assert float(stated[1].replace("false", "0")) == {f.name: f.default for f in fields(kind)}[name]
    assert n_checked == 23


@pytest.fixture(scope="module")
def made_again(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample datasets, made by the command that their README names."""
    folder = tmp_path_factory.mktemp("samples")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["make_samples.py", str(folder)])
        runpy.run_path(str(ROOT / "sample_frames" / "make_samples.py"), run_name="__main__")
    return folder


@pytest.mark.slow
# Frames of `staring_camera` state the version that made them; `test_samples.py` compares their pixels.
@pytest.mark.parametrize("name", sorted({*SAMPLES} - {"staring_camera"}))
def test_samples_can_be_made_again(made_again: Path, name: str) -> None:
    ours, theirs = ROOT / "sample_frames" / name, made_again / name
    files = sorted(path.relative_to(ours) for path in ours.rglob("*") if path.is_file())
    assert files == sorted(path.relative_to(theirs) for path in theirs.rglob("*") if path.is_file())
    assert len(files) > 140
    for file in files:
        assert (ours / file).read_bytes() == (theirs / file).read_bytes(), file


def test_samples_are_small() -> None:
    total = sum(path.stat().st_size for path in (ROOT / "sample_frames").rglob("*") if path.is_file())
    assert total < 15 * 2**20
