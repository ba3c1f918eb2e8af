"""`sensor-sim` as a user meets it: outputs, help, and bad input in one line, with a status and nothing written."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from test_bad_input import assert_says, tree

from sensor_sim import curve as compute_curve
from sensor_sim import mtf
from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sampling import field_sampler
from sensor_sim.chain.sensor import load_sensor
from sensor_sim.cli import cli
from sensor_sim.thresholds.curve import _never_reached
from sensor_sim.thresholds.predict import HIDDEN, SATURATING, TOO_FAINT, PredictedThreshold
from todframes.cli.console import run
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.error_budget import Step, plan_object

BAD_DATA, BAD_SETTINGS = 1, 2

SENSOR = """\
schema = 1
name = "bench"
[optics]
aperture_mm = 100.0
wavelength_um = 10.0
blur_sigma_mrad = 0.02
[detector]
pitch_mrad = 0.2
width_mrad = 0.18
[noise]
distribution = "uniform"
netd_mk = 25.0
fixed_pattern_ratio = 0.4
frames_integrated = 6
[electronics]
blur_sigma_px = 0.5
[display]
pixels_per_detector = 4
pixel_pitch_mm = 0.25
viewing_distance_mm = 1500.0
blur_sigma_px = 1.0
background_luminance_cd_m2 = 50.0
gain = 1.0
"""
STAGES = [
    *("diffraction", "optics_blur", "detector", "hold", "electronics", "display", "pre_sample", "post_sample")
]


@pytest.fixture
def sensor_file(tmp_path) -> Path:
    path = tmp_path / "SENSOR.toml"
    path.write_text(SENSOR, encoding="utf-8")
    return path


@pytest.fixture
def sensor_sim(capfd):
    """Runs a command line; status, standard output, lines of standard error. A warning would raise."""

    def call(*arguments):
        capfd.readouterr()
        status = run(cli, [str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        return status, out, err.splitlines()

    return call


@pytest.fixture
def fails(sensor_sim, tmp_path):
    """Runs a command line that must fail as the contract says, with a line that has all the patterns."""

    def call(*arguments, wanted, status=BAD_SETTINGS):
        before = tree(tmp_path)
        found, out, errors = sensor_sim(*arguments)
        assert len(errors) == 1, errors
        assert errors[0].startswith("error: ")
        assert_says(errors[0], wanted)
        assert (found, out) == (status, "")
        assert tree(tmp_path) == before

    return call


def simulate(sensor_file: Path, *more) -> tuple:
    out = sensor_file.parent / "dataset"
    return ("simulate", sensor_file, "--size-detectors", "3", "--snr", "4", "--trials", "4", "-o", out, *more)


def curve(sensor_file: Path, *more) -> tuple:
    return ("curve", sensor_file, "--size-detectors", "4", "--tolerance", "0.01", *more)


COMMANDS = {
    "simulate": simulate,
    "curve": lambda file, *more: curve(file, "-o", file.parent / "out", *more),
    "mtf": lambda file, *more: ("mtf", file, "-o", file.parent / "out", *more),
}
commands = pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS.keys())


def test_remark_on_clipping_can_be_silenced(sensor_sim, sensor_file):
    more = ("--snr", "0.3", "--format", "png", "--allow-clipping")
    status, _, (note,) = sensor_sim(*simulate(sensor_file, *more))
    assert status == 0
    assert re.fullmatch(r"note: \d+(\.\d+)? % of the pixels were clipped", note)
    assert sensor_sim(*simulate(sensor_file, *more, "--quiet", "-o", sensor_file.with_name("other")))[2] == []


def test_curve_as_json(sensor_sim, sensor_file):
    status, out, errors = sensor_sim(*curve(sensor_file, "--size-detectors", "1,4,8", "--json", "--seed", "3"))
    assert status == 0 and len(errors) == 1
    assert errors[0].startswith("warning: 75 % correct is never reached at 1 detectors: ")
    result = json.loads(out)
    assert (result["command"], result["seed"], result["settings"]["tolerance"]) == ("curve", 3, 0.01)
    assert result["settings"]["sensor"]["optics"]["aperture_mm"] == 100.0
    small, middle, large = result["fits"]
    assert (small["status"], small["threshold"], small["delta_t_mk"]) == ("never_reached", None, None)
    assert middle["threshold"] > large["threshold"]
    assert 0 < middle["threshold_numerical_error"] <= 0.01 * middle["threshold"]
    assert middle["plan"][-1] == plan_object([Step("phases", True, middle["plan"][-1]["why"])])[0]


def test_temperatures_are_shown(sensor_sim, sensor_file):
    (fit,) = json.loads(sensor_sim(*curve(sensor_file, "--json"))[1])["fits"]
    # Of six frames and a ratio of 0.4 the paper has k = 1.7496.
    assert fit["delta_t_mk"] / fit["threshold"] == pytest.approx(25.0 / 1.7496, rel=1e-4)


def test_curve_of_a_triangle_that_no_detector_sees(sensor_sim, sensor_file):
    """The detectors' noise has no part in any score then; a warning of Python would be an error here."""
    status, out, errors = sensor_sim("curve", sensor_file, "--size-detectors", "0.003", "--json")
    assert (status, len(errors)) == (0, 1)
    assert json.loads(out)["fits"][0]["status"] == "never_reached"


@pytest.mark.parametrize(
    ("reason", "smallest", "light", "strong", "what"),
    [
        (HIDDEN, 4.0, None, "however strong the signal", "4 detectors (0.800 mrad at the camera) are enough"),
        (TOO_FAINT, 2.5, None, "however strong the signal", "2.5 detectors (0.500 mrad at the camera) are enough"),
        (SATURATING, None, 3.0, "at the contrast of 1.50", "No size up to 32 detectors is enough"),
    ],
)
def test_sizes_without_a_threshold_have_the_reason_and_a_size_that_is_enough(
    sensor_file, reason, smallest, light, strong, what
):
    """A detector is shown as four pixels of 0.25 mm at 1.5 m: 2/3 mrad or 2.29 minutes of arc."""
    camera, alike = resolve(load_sensor(sensor_file)), []
    for size, share, highest in ((1.0, 0.5, 0.31), (1.2, 0.75, 0.744)):
        chain = {"camera": camera, "size_detectors": size, "largest_sample": share, "largest_level": 1.5}
        found = PredictedThreshold("never_reached", reason=reason, highest=highest)
        alike.append(SimpleNamespace(chain=SimpleNamespace(**chain), found=found))
    warning = _never_reached(alike, PyramidObserver(), {camera: smallest}.get, light, 0.75)
    group = {} if light is None else {"luminance_cd_m2": light}
    assert (warning.group, warning.found, warning.expected) == (group, (0.31, 0.744), 0.75)
    nearer = "; fewer may be on a display that shows detectors at a smaller angle" * (reason == HIDDEN)
    assert warning.message == (
        f"75 % correct is never reached at 1 and 1.2 detectors: {strong}, about 31 and 74 % of the answers are "
        "correct at most. The largest sample has 50 and 75 % of the triangle's contrast, and a detector is 2.3′ "
        f"wide at the eye: {reason}. {what}{nearer}"
    )


def test_progress_grows_within_a_size_and_ends_with_the_whole(sensor_file):
    steps: list[tuple[int, int]] = []
    asked = {"size_detectors": [0.5, 4.0], "tolerance": 0.02, "examples": False}
    compute_curve(sensor_file, progress=lambda *step: steps.append(step), **asked)
    # The size that is never reached is done in one step; of the other one, no part that takes long is a step.
    done, totals = zip(*steps, strict=True)
    assert {*totals} == {200} and list(done) == sorted(done) and done[-1] == 200
    assert 100 in done and len(steps) > 10


def test_sizes_in_mrad_are_angles_at_the_camera(sensor_sim, sensor_file, tmp_path):
    status, out, errors = sensor_sim("curve", sensor_file, "--size-mrad", "0.8", "--tolerance", "0.01", "--json")
    assert (status, errors) == (0, [])
    by_detectors = json.loads(sensor_sim(*curve(sensor_file, "--json"))[1])["fits"]  # 4 of 0.2 mrad
    for of_angle, of_detectors in zip(json.loads(out)["fits"], by_detectors, strict=True):
        measured = {"plan": of_angle["plan"]}
        assert of_angle == of_detectors | measured
    more = ("--size-mrad", "0.8", "--snr", "4", "--trials", "1", "-o", tmp_path / "set")
    assert sensor_sim("simulate", sensor_file, *more)[0] == 0
    with (tmp_path / "set" / "manifest.csv").open(encoding="utf-8") as file:
        assert {row["size_detectors"] for row in csv.DictReader(file)} == {"4.0"}


@pytest.mark.parametrize("more", [("curve",), ("simulate", "--snr", "4", "-o", "never")])
def test_an_angle_that_is_too_large_is_named_as_it_was_given(sensor_sim, sensor_file, more):
    command, *others = more
    status, _, (error,) = sensor_sim(command, sensor_file, "--size-mrad", "0.8,100", *others)
    assert status == 2
    assert error == "error: --size-mrad: found 100, 500 detectors, expected at most 255"


def test_curve_without_netd_has_no_temperatures(sensor_sim, sensor_file):
    sensor_file.write_text(SENSOR.replace("netd_mk = 25.0\n", ""), encoding="utf-8")
    assert "ΔT" not in sensor_sim(*curve(sensor_file))[1]
    (fit,) = json.loads(sensor_sim(*curve(sensor_file, "--json"))[1])["fits"]
    assert fit["delta_t_mk"] is None


def test_mtf_as_json(sensor_sim, sensor_file):
    status, out, errors = sensor_sim("mtf", sensor_file, "--json")
    assert (status, errors) == (0, [])
    result = json.loads(out)
    assert (result["schema"], result["command"], result["sensor"]) == (1, "sensor-mtf", "bench")
    # 100 mm / 10 µm; half of one in 0.2 mrad.
    assert result["cut_off_cyc_per_mrad"] == pytest.approx(10.0)
    assert result["nyquist_cyc_per_mrad"] == pytest.approx(2.5)
    assert list(result["mtf"]) == STAGES
    frequency = np.array(result["frequency_cyc_per_mrad"])
    stage = {name: np.array(values) for name, values in result["mtf"].items()}
    assert frequency[0] == 0.0 and frequency[-1] > 10.0
    assert all(len(values) == len(frequency) and values[0] == 1.0 for values in stage.values())
    assert np.all(stage["diffraction"][frequency >= 10.0] == 0.0)
    # Equations 1 and 2 and the boxes, by hand; the display's in cycles per pixel, 0.05 mrad in the scene.
    x = np.minimum(frequency / 10.0, 1.0)
    closed = {
        "diffraction": 2 / np.pi * (np.arccos(x) - x * np.sqrt(1 - x**2)),
        "optics_blur": np.exp(-2 * (np.pi * 0.02 * frequency) ** 2),
        "detector": np.sinc(0.18 * frequency),
        "hold": np.sinc(0.2 * frequency),
        "electronics": np.exp(-2 * (np.pi * 0.5 * 0.05 * frequency) ** 2),
        "display": np.exp(-2 * (np.pi * 1.0 * 0.05 * frequency) ** 2),
    }
    for name, values in closed.items():
        np.testing.assert_allclose(stage[name], values, atol=1e-12)
    pre_sample = closed["diffraction"] * closed["optics_blur"] * closed["detector"]
    np.testing.assert_allclose(stage["pre_sample"], pre_sample, atol=1e-12)
    post_sample = closed["hold"] * closed["electronics"] * closed["display"]
    np.testing.assert_allclose(stage["post_sample"], post_sample, atol=1e-12)


def changed(table: str, key: str, value: str) -> str:
    before, after = SENSOR.split(f"[{table}]\n")
    return f"{before}[{table}]\n" + re.sub(
        rf"^{key} = .*$", f"{key} = {value}", after, count=1, flags=re.MULTILINE
    )


def sensor_with(sensor_file: Path, text: str) -> Path:
    assert text != SENSOR
    sensor_file.write_text(text, encoding="utf-8")
    return sensor_file


@commands
def test_bad_sensor_file(fails, sensor_file, command):
    sensor_with(sensor_file, changed("noise", "netd_mk", "-1.0"))
    fails(*command(sensor_file), wanted=(re.escape(f"{sensor_file}: [noise]: netd_mk: found -1.0, expected"),))


def test_a_size_too_large_for_the_optics_is_refused(fails, sensor_file):
    """The spectrum grows with the field."""
    camera = Path(__file__).parents[2] / "sample_frames" / "staring_camera.toml"
    fails("curve", camera, "--size-detectors", 48, wanted=("in a field of .* detectors; take a smaller triangle",))
    assert not field_sampler(resolve(load_sensor(camera)), 47.0).sharp
    sensor_with(sensor_file, changed("display", "pixels_per_detector", "1000"))
    fails(*OF_SIMULATE.format(sensor=sensor_file, out="x").split(), wanted=("frame of .* pixels, expected at",))


OF_SIMULATE = "simulate {sensor} --size-detectors 3 --snr 4 --trials 4 -o {out}"
USAGE = {
    "no sensor": ("mtf", ("SENSOR.toml",)),
    "simulate without snr": ("simulate {sensor} --size-detectors 3 -o x", ("--snr",)),
    "simulate without out": ("simulate {sensor} --size-detectors 3 --snr 1", ("--out",)),
    "sizes of two kinds": (
        "curve {sensor} --size-detectors 3 --size-mrad 1",
        ("^error: found --size-detectors and --size-mrad, expected one of them",),
    ),
    "unknown option of curve": ("curve {sensor} --snr 1 --size-detectors 3", ("--snr",)),
    "noise beyond all numbers": (f"{OF_SIMULATE} --snr=1e-320", ("snr|luminance|beyond",)),
    "noise beyond half floats": (f"{OF_SIMULATE} --snr=1e-5", ("snr|luminance|beyond",)),
    "triangle beyond all fields": (f"{OF_SIMULATE} --size-detectors=1e9", ("field|size", "at most|fewer")),
}


@pytest.mark.parametrize(("line", "wanted"), USAGE.values(), ids=USAGE.keys())
def test_bad_usage(fails, sensor_file, line, wanted, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = [one.format(sensor=sensor_file, out=tmp_path / "out") for one in line.split()]
    fails(*arguments, wanted=wanted, status=BAD_DATA if "--snr=1e-5" in line else BAD_SETTINGS)


def test_python_m_is_the_command() -> None:
    command = [sys.executable, "-m", "sensor_sim"]
    found = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True)
    assert found.stdout.startswith("sensor-sim, version ")
    missing = subprocess.run([*command, "mtf", "missing.toml"], capture_output=True, text=True, check=False)
    assert (missing.returncode, len(missing.stderr.splitlines())) == (BAD_SETTINGS, 1)


def test_figure_and_tables_of_an_mtf() -> None:
    """With detectors as wide as their pitch, detector and hold are the same sinc."""
    result, axes = mtf(Path(__file__).parents[2] / "sample_frames" / "star_like.toml"), Figure().subplots()
    result.figures()[0].draw(axes)
    assert [line.get_label() for line in axes.lines if line.get_label()[0] != "_"] == [
        "diffraction", "optics blur", "detector and hold", "electronics", "display", "pre sample", "post sample"
    ]  # fmt: skip
    assert [line.get_linewidth() for line in axes.lines[:7]] == [1.3] * 5 + [2.4] * 2
    shown, whole = result.tables()
    assert [(one.header, one.decimals, one.rank) for one in whole.columns] == [
        ("cycles/mrad", 2, 0), ("diffraction", 4, 1), ("optics_blur", 4, 3), ("detector", 4, 1), ("hold", 4, 2),
        ("electronics", 4, 3), ("display", 4, 2), ("pre_sample", 4, 0), ("post_sample", 4, 0),
    ]  # fmt: skip
    assert whole.records[7]["hold"] == result.mtf["hold"][7]
    assert len(whole.records) == 201 and list(shown.records) == list(whole.records[::20])
