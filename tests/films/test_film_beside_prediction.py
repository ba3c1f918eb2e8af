"""Films of cameras that share no code with the packages, beside the curves that were predicted for them."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from independent_camera import Camera, Chart, ThermalCamera, film, looking_at

import sensor_sim as ss
import todframes as tod
from todframes.base.errors import DataError, SettingsError
from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.display.display import find_display
from todframes.recordings.recording import frames_integrated

THERMAL = ThermalCamera()
LEVELS_K = {3.43: (0.016, 0.024, 0.032, 0.045, 0.064), 6.86: (0.0056, 0.008, 0.011, 0.016, 0.022)}
"""Sizes in mrad, and temperature differences from half to twice the threshold that the curve gives."""

VISIBLE = """schema = 1
name = "visible"

[optics]
mtf = "mtf.csv"

[detector]
pitch_mrad = {pitch:.8g}
width_mrad = {pitch:.8g}

[noise]
model = "photon"
dark_noise_electrons = 12.0
exposure_ms = 10.0
frames_integrated = 2

[scene]
background_electrons = {electrons:.8g}

[display]
pixels_per_detector = 1
pixel_pitch_mm = 0.25
viewing_distance_mm = 500.0
background_luminance_cd_m2 = 20.0
"""


def write_thermal(folder: Path) -> Path:
    """Write the SENSOR.toml of a datasheet."""
    text = ss.new_sensor(preset="boson", focal_length_mm=THERMAL.focal_length_mm)
    (folder / "sensor.toml").write_text(text, encoding="utf-8")
    return folder / "sensor.toml"


def of_schedule(folder: Path, out: str, **how: object) -> tod.Imported:
    source = {"schedule": folder / "schedule.csv", "level": "delta_t_k", "ifov_mrad": THERMAL.ifov_mrad}
    return tod.import_recordings(folder / "film.mkv", out=folder / out, **source | how)


def check_ratio_of_one(result: tod.Result) -> None:
    """Check that a film has the thresholds of its curve: 1.5 times a 95 % interval is left once in 300."""
    found = result.conditions[1]
    assert {fit.status for fit in found.fits} == {"ok"}
    low, high = np.log(found.overall.ratio_ci95)
    assert abs(math.log(found.overall.ratio)) < 1.5 * (high - low) / 2.0 < 0.25
    assert result.verdict[0].startswith(f"{found.name} needs ")  # nothing differs in the display


@pytest.mark.slow
def test_a_film_of_a_thermal_camera_has_the_predicted_thresholds(tmp_path: Path) -> None:
    sensor = write_thermal(tmp_path)
    THERMAL.film(tmp_path, LEVELS_K, repeats=10, seed=2)
    curve = ss.curve(sensor, size_mrad=list(LEVELS_K), tolerance=0.01, examples=False)
    done = of_schedule(tmp_path, "dataset", display=sensor)
    assert not done.warnings
    # 12 values of noise are 40 mK: the chance error of pairs of 64² differences is below 1 % of it.
    (note,) = (note for note in done.notes if note.startswith("display: "))
    numbers = re.search(r"the background is (\S+), the noise (\S+); 1 K is (\S+) by the NETD of 40 mK", note)
    assert numbers is not None
    assert [*map(float, numbers.groups())] == pytest.approx([7300.0, 12.0, 300.0], rel=0.01)
    check_ratio_of_one(tod.compare(curve, done.path, examples=False))
    # Black and white 25 times the noise away are another display, and the first line says so.
    of_schedule(tmp_path, "wide", display="reference_linear", value_range=(7000.0, 7600.0))
    wide = tod.compare(curve, tod.score(tmp_path / "wide", examples=False), examples=False)
    assert wide.conditions[1].verdict == "worse"
    first, second, *_ = wide.verdict
    assert "linear with black at 0 % of white against a gain of 1" in first and " needs " in second


@pytest.mark.slow
def test_a_film_of_a_visible_camera_has_the_predicted_thresholds(tmp_path: Path) -> None:
    distance_m, pitch_mm, scale, blur_px, at_white = 10.0, 0.5, 0.36, 0.7, 2_000.0
    monitor = {"width_px": 1280, "height_px": 720, "pixel_pitch_mm": pitch_mm, "eotf": "linear"}
    asked = {"distance_m": distance_m, "sizes_mrad": [1.0, 2.0], "contrasts": [0.04, 0.07, 0.12, 0.2, 0.34]}
    tod.chart("screen", out=tmp_path / "chart", repeats=4, rng=3, **asked, **monitor)
    chart, rng = Chart.read(tmp_path / "chart"), np.random.default_rng(4)
    side = {"width": 480, "height": 288}
    camera = Camera(blur_sigma_px=blur_px, electrons_at_white=at_white, read_noise_electrons=12.0, bits=14, **side)
    matrix = looking_at(chart, scale=scale, turn_deg=1.0, tilt_deg=1.5, **side)
    frames = []
    for page in range(len(chart)):
        shift = np.eye(3)
        shift[:2, 2] = rng.uniform(-6.0, 6.0, 2)
        frames += film(chart, camera, shift @ matrix, frames_per_page=2, seed=page, pages=[page])
    np.save(tmp_path / "film.npy", np.stack([frame for _, _, frame in frames]))
    frequency = np.linspace(0.0, 1.2, 121)
    # Edges of the chart are as soft as a monitor's pixel is wide, and the film is made of halves of these pixels.
    monitor_mtf = np.sinc(scale * frequency) * np.sinc(scale / 2.0 * frequency) ** 2
    lens = np.exp(-2.0 * (np.pi * frequency * blur_px) ** 2) * monitor_mtf
    rows = [f"{f:.6g},{mtf:.8g}" for f, mtf in zip(frequency, lens, strict=True)]
    (tmp_path / "mtf.csv").write_text("\n".join(["frequency_cyc_per_pixel,mtf", *rows, ""]), encoding="utf-8")
    screen, pitch_mrad = chart.content["screen"], pitch_mm / distance_m / scale
    electrons = at_white * screen["background_luminance_cd_m2"] / screen["white_luminance_cd_m2"]
    sensor = tmp_path / "sensor.toml"
    sensor.write_text(VISIBLE.format(pitch=pitch_mrad, electrons=electrons), encoding="utf-8")
    curve = ss.curve(sensor, size_mrad=[1.0, 2.0], tolerance=0.01, examples=False)
    done = tod.import_recordings(
        tmp_path / "film.npy",
        chart=tmp_path / "chart" / "chart.toml",
        out=tmp_path / "dataset",
        display=sensor,
        frames_per_second=20,
        bits=14,
    )
    assert not done.warnings
    check_ratio_of_one(tod.compare(curve, done.path, examples=False))


@pytest.fixture(scope="module")
def short_film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A thermal film of one size and level, and its SENSOR.toml."""
    folder = tmp_path_factory.mktemp("thermal")
    THERMAL.film(folder, {3.43: (0.2,)}, repeats=2)
    write_thermal(folder)
    return folder


def test_a_triangle_of_a_film_has_the_contrast_of_the_gain(short_film: Path, tmp_path: Path) -> None:
    """At any level, on display pixels that are part of a detector; noise falls with the square root of frames."""
    text = (short_film / "sensor.toml").read_text(encoding="utf-8")
    for old, new in (("pixels_per_detector = 1 ", "pixels_per_detector = 3 "), ("gain = 1.0", "gain = 0.5")):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "sensor.toml").write_text(text, encoding="utf-8")
    of_schedule(short_film, "fine", display=tmp_path / "sensor.toml")
    data = tod.load_dataset(short_film / "fine")
    assert data.display == find_display(tmp_path / "sensor.toml").display and data.display.gain == 0.5
    contrasts = []
    for trial in data.trials:
        frame = np.mean([tod.read_frame(data.path / one.path).stored[..., 0] for one in trial.frames], axis=0)
        x, y = round(trial.x_px), round(trial.y_px)
        contrasts.append(data.display.luminance(frame[y - 1 : y + 2, x - 1 : x + 2, None]).mean() / 50.0 - 1.0)
        sides = [frame.shape[k] / 3 for k in (0, 1)]
        assert sides == [round(side) for side in sides]  # each value is a square of pixels
    # The middle of a triangle of 4 detectors has 0.9 of its signal; noise is 0.2 / √6, and 0.5 of it by the gain.
    middle = np.mean([THERMAL.image(4.0, turn)[4::8, 4::8].max() for turn in tod.ORIENTATIONS])
    assert np.mean(contrasts) == pytest.approx(0.5 * middle, abs=3 * 0.5 * 0.2 / math.sqrt(6 * len(contrasts)))


def test_what_the_display_of_a_sensor_needs_is_said(short_film: Path, tmp_path: Path) -> None:
    text = (short_film / "sensor.toml").read_text(encoding="utf-8")
    sensor = tmp_path / "sensor.toml"
    for old, new, how, problem in (
        ("", "", {"level": "contrast"}, "contrast"),
        ("", "", {"value_range": (7000.0, 7600.0)}, "value_range: is given but not used with the display"),
        ("netd_mk = 40.0", "", {}, r"display: \[noise\]: netd_mk is missing"),
        ("[display]", "[dispaly]", {}, r"sensor\.toml: table \[display\] is missing"),
        ("gain = 1.0", "gian = 1.0", {}, r"\[display\]: unknown key 'gian'.*'gain'"),
        ("pixel_pitch_mm = 0.2909", "", {}, r"\[display\]: pixel_pitch_mm is missing"),
    ):
        changed = text.replace(old, new).replace("couple_netd = true", "couple_netd = false")
        sensor.write_text(changed, encoding="utf-8")
        with pytest.raises((SettingsError, DataError), match=problem):
            of_schedule(short_film, "refused", **{"display": sensor} | how)
    with pytest.raises(SettingsError, match=r"display: found .*SENSOR\.tml', expected the name of a file that"):
        of_schedule(short_film, "refused", display=tmp_path / "SENSOR.tml")
    assert not (short_film / "refused").exists()


def test_a_film_and_a_sensor_average_the_same_frames() -> None:
    """Also where two numbers of frames are as near to 0.1 s, as at 15, 25 and 35 frames a second."""
    for rate in (9.0, 15.0, 25.0, 30.0, 35.0, 50.0, 60.0):
        text = ss.new_sensor(preset="boson", focal_length_mm=14, frames_per_second=rate)
        assert f"frames_integrated = {frames_integrated(rate)} " in text
        # `import` ends a trial with the frame that lies nearest to 0.1 s, the earlier of two.
        off = [abs(n / rate - 0.1) for n in range(1, 8)]
        assert off[frames_integrated(rate) - 1] <= min(off) + 1e-12


def test_a_chart_is_shown_by_a_monitor(
    short_film: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = "chart --for screen --distance-m 4 --sizes-mrad 2 --contrasts 0.2 --pixel-pitch-mm 0.5"
    arguments = [*asked.split(), "--display", str(short_film / "sensor.toml"), "-o", str(tmp_path / "chart")]
    assert run(cli, arguments) == 2
    assert "--display: found the display of a sensor's signals, expected a monitor" in capsys.readouterr().err
