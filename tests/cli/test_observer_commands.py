"""Every observer by its name on the command line, with its own settings; docs/explanation/observers.md."""

from __future__ import annotations

import json
import re
import shlex
import sys
import tomllib
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from conftest import error_line

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.mtf import matched_settings
from sensor_sim.chain.sensor import load_sensor
from sensor_sim.cli import cli as sensor_sim
from sensor_sim.thresholds.predict import FoldedChain, predict_threshold
from todframes.cli.console import run
from todframes.cli.main import cli as todframes
from todframes.observers.csf import CsfSettings
from todframes.observers.hotelling import HotellingObserver
from todframes.observers.interface import find_observer
from todframes.observers.pyramid import PyramidObserver, PyramidSettings

ROOT = Path(__file__).parents[2]
DOCS = (ROOT / "docs" / "explanation" / "observers.md").read_text(encoding="utf-8")
OWN = (ROOT / "docs" / "how_to" / "own_observer.md").read_text(encoding="utf-8")
STAR_LIKE = ROOT / "sample_frames" / "star_like.toml"
NEARLY_SHARP = """\
schema = 1
[optics]
aperture_mm = 400.0
wavelength_um = 4.0
[detector]
pitch_mrad = 0.1
width_mrad = 0.1
[display]
pixels_per_detector = 4
pixel_pitch_mm = 0.1
viewing_distance_mm = 1000.0
blur_sigma_px = 1.0
background_luminance_cd_m2 = 50.0
"""
OWN_SETTINGS = {
    "pyramid": {"band_gain": 1.5},
    "informative": {"display_blur_mrad": 0.3, "informative_share": 0.95},
    "oriented": {"orientations": 4, "phases": "even"},
    "csf": {"efficiency": 4.0, "retina_pitch_mrad": 0.125},
}


def arguments(name: str) -> list[str]:
    assignments = [f"--set={key}={value}" for key, value in OWN_SETTINGS[name].items()]
    return ["--observer", name, *assignments, "--json"]


def succeed(cli, capsys, *line: object) -> dict:
    assert run(cli, [str(word) for word in line]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.parametrize("name", OWN_SETTINGS)
def test_every_command_takes_every_observer(name: str, make_dataset, tmp_path: Path, capsys) -> None:
    sensor = tmp_path / "sensor.toml"
    sensor.write_text(NEARLY_SHARP, encoding="utf-8")
    dataset = make_dataset(contrasts=(0.03, 0.06, 0.12, 0.24)).path
    results = [
        succeed(todframes, capsys, "score", dataset, *arguments(name)),
        succeed(todframes, capsys, "score", dataset, "--decisions", "sampled", *arguments(name)),
        succeed(todframes, capsys, "naked-eye", "--size-mrad", "2", *arguments(name)),
        succeed(
            sensor_sim,
            capsys,
            "curve",
            sensor,
            *["--size-detectors", "5", "--tolerance", "0.02"],
            *arguments(name),
        ),
    ]
    for result in results:
        assert result["settings"]["observer"] == name
        assert OWN_SETTINGS[name].items() <= result["settings"].items()
        assert {field.name for field in fields(find_observer(name).settings_type)} <= set(result["settings"])
    scored, _, direct, curve = (result["fits"][0] for result in results)
    assert direct["status"] == curve["status"] == scored["status"] == "ok"
    # A display of quarter-milliradian pixels makes a triangle of 2 mrad somewhat more difficult.
    assert 1.0 < scored["points_threshold"] / direct["threshold"] < 1.3


@pytest.mark.parametrize("cli", [todframes, sensor_sim], ids=["todframes", "sensor-sim"])
@pytest.mark.parametrize(
    ("name", "assignment", "wanted"),
    [
        ("informative", "display_blur=1", "'display_blur'; the nearest valid one is 'display_blur_mrad'"),
        ("informative", "informative_share=2", "informative_share: found 2, expected a number from 0.001 to 1"),
        ("oriented", "phases=evn", "phases: found 'evn', expected one of both, even, odd"),
        ("csf", "internal_noise=0.5", "pyramid; csf has none; its noise follows from its efficiency"),
        ("pyramid", "orientations=8", "orientations is a setting of oriented; pyramid has none"),
        ("orientd", "orientations=8", "unknown key 'orientd'; the nearest valid one is 'oriented'"),
    ],
)
def test_wrong_settings_are_one_line(cli, name: str, assignment: str, wanted: str, capsys) -> None:
    command = (
        ["naked-eye", "--size-mrad", "1"] if cli is todframes else ["curve", STAR_LIKE, "--size-detectors", "5"]
    )
    status = run(cli, [*map(str, command), "--observer", name, "--set", assignment])
    assert wanted in error_line((status, *capsys.readouterr()))


def test_documented_settings_are_the_settings() -> None:
    common = {field.name for field in fields(PyramidSettings)}
    light = {"luminance_cd_m2", "age_years", "pupil_mm"}  # they mean more to csf than to the pyramid's eye
    documented = re.findall(r"^\| `(\w+)` \| ([^|]*) \|", DOCS, re.MULTILINE)
    documented = {name: default.strip("`") for name, default in documented if name not in OWN_SETTINGS}
    own = {
        field.name: field.default
        for name in ("informative", "oriented", "csf")
        for field in fields(find_observer(name).settings_type)
        if field.name not in common or (name == "csf" and field.name in light)
    }
    assert list(documented) == list(own)
    for name, default in own.items():
        if default is not None:
            assert documented[name] == (f"{default:g}" if type(default) is float else str(default).lower()), name


def test_documented_thresholds_are_the_thresholds() -> None:
    """Those at 4 detectors and a display spot of 2 pixels, to their three digits and both numerical errors."""
    header = re.search(r"^\| display blur \| observer \| (.*) \|$", DOCS, re.MULTILINE)[1]
    sizes = [float(cell) for cell in header.split("|")]
    sensor = load_sensor(STAR_LIKE)
    assert sensor.display.blur_sigma_px == 2.0
    for name, observer in (
        ("pyramid", PyramidObserver()),
        ("informative", HotellingObserver(matched_settings(sensor))),
    ):
        row = re.search(rf"^\| 2 px \| {name} \| (.*) \|$", DOCS, re.MULTILINE)[1].split("|")
        documented = float(row[sizes.index(4.0)])
        found = predict_threshold(FoldedChain(resolve(sensor), observer, 4.0), tolerance=1e-2)
        assert found.threshold == pytest.approx(documented, rel=1e-2 + 2e-3 + 5e-3)


@pytest.mark.parametrize(
    "name", [name if name == "csf" else pytest.param(name, marks=pytest.mark.slow) for name in OWN_SETTINGS]
)
def test_documented_naked_eye_is_what_the_command_says(name: str, capsys) -> None:
    header, row = (
        re.search(rf"^\| {first} \| (.*) \|$", DOCS, re.MULTILINE)[1].split(" | ") for first in ("observer", name)
    )
    (fit,) = succeed(todframes, capsys, "naked-eye", "--size-mrad", "1", "--observer", name, "--json")["fits"]
    # Four digits, and the search's own error.
    assert fit["threshold"] == pytest.approx(float(row[header.index("1 mrad")]), rel=5e-4)


def test_settings_that_are_shown_for_a_sensor_can_be_had(monkeypatch, capsys) -> None:
    monkeypatch.chdir(ROOT)
    exec(re.search(r"^```python matched\n(.*?)^```$", DOCS, re.MULTILINE | re.DOTALL)[1], {})
    assert capsys.readouterr().out.startswith("HotellingSettings(")


def test_a_documented_sensitivity_of_ones_own_can_be_had(tmp_path: Path, capsys) -> None:
    """That of the file needs more contrast than ModelFest's; the parabola has its half 1.5 octaves off."""
    file = tmp_path / "own_eye.toml"
    command = ["naked-eye", "--size-mrad", "2", "--observer", "csf", "--json"]
    file.write_text(
        re.search(r"^```toml\n(# own_eye.*?)^```$", DOCS, re.MULTILINE | re.DOTALL)[1], encoding="utf-8"
    )
    own, plain = (
        succeed(todframes, capsys, *command, *more)["fits"][0]["threshold"]
        for more in (["--observer-settings", file], [])
    )
    assert plain < own < 2.0 * plain
    exec(re.search(r"^```python own_parabola\n(.*?)^```$", DOCS, re.MULTILINE | re.DOTALL)[1], {})
    table = dict(CsfSettings(**tomllib.loads(capsys.readouterr().out)).sensitivity)
    assert [table[frequency] for frequency in (0.25, 4.0, 11.314)] == [75.0, 150.0, 75.0]


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The example of one's own observer, installed as its package would be; the command that is shown with it."""
    code, entry_points, command = (
        re.search(rf"^```{language}\n(.*?)^```$", OWN, re.MULTILINE | re.DOTALL)[1]
        for language in ("python", "toml", "sh own")
    )
    (tmp_path / "retina_samples.py").write_text(code, encoding="utf-8")
    section, line = entry_points.strip().splitlines()
    assert section == '[project.entry-points."todframes.observers"]'
    name, target = line.split(" = ")
    distribution = tmp_path / "retina_samples-0.dist-info"
    distribution.mkdir()
    (distribution / "METADATA").write_text("Metadata-Version: 2.1\nName: retina-samples\nVersion: 0\n")
    (distribution / "entry_points.txt").write_text(f"[todframes.observers]\n{name} = {json.loads(target)}\n")
    monkeypatch.syspath_prepend(tmp_path)
    yield shlex.split(command)
    sys.modules.pop("retina_samples", None)


def test_ones_own_observer_can_be_plugged_in(example: list[str], make_dataset, capsys) -> None:
    """75 % right at contrast · √area / σ = 3.1445: four triangles in white noise, by their areas in common."""
    program, *line = example
    assert program == "todframes"
    (fit,) = succeed(todframes, capsys, *line, "--json")["fits"]
    size_samples = fit["group"]["size_mrad"] / 0.153
    # A sample of which an edge leaves the share c loses c (1 − c), a quarter at most, of the squared difference of
    # two triangles. Edges are 9.12 sizes long together, and the least square is 0.536 sizes²: 2.1 / size of d′.
    ideal = 3.1445 * 0.5 / size_samples
    assert ideal < fit["threshold"] < ideal * (1.0 + 2.2 / size_samples)
    # Where it has no setting of a name, that is an error as with any observer.
    assert run(todframes, [*line, "--internal-noise", "0.5"]) == 2
    assert (
        "internal_noise is a setting of informative, oriented, pyramid; retina_samples has none"
        in capsys.readouterr().err
    )
    dataset = make_dataset(contrasts=(0.03, 0.06, 0.12, 0.24, 0.48), repeats=5).path
    by_decisions = [
        succeed(todframes, capsys, "score", dataset, "--observer", "retina_samples", "--decisions", one, "--json")
        for one in ("expected", "sampled")
    ]
    expected, sampled = (np.array([p["p_correct"] for p in one["fits"][0]["points"]]) for one in by_decisions)
    # Four standard errors of twenty answers.
    assert (np.abs(sampled - expected) < 4 * np.sqrt(expected * (1 - expected) / 20) + 1e-6).all()
