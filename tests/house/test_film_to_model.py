"""From a camera's film to a model of it: figures of the film, and the model's curve beside the film's own."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from closing_circle import BITS, EXPOSURE_MS, closed, make_film

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.camera import resolve
from todframes.base.errors import SettingsError
from todframes.cli.console import run
from todframes.cli.main import cli

SENSOR = """
schema = 1
[optics]
aperture_mm = 10.0
wavelength_um = 0.55
[detector]
pitch_mrad = 0.14
width_mrad = 0.14
[noise]
model = "photon"
dark_noise_electrons = 8.0
exposure_ms = 10.0
[scene]
background_electrons = 900.0
[display]
pixels_per_detector = 1
pixel_pitch_mm = 0.5
viewing_distance_mm = 500.0
background_luminance_cd_m2 = 20.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Chart, film.npy and dark.npy with hardly any page but the camera's."""
    made = tmp_path_factory.mktemp("film")
    make_film(made, sizes_mrad=[4.0], contrasts=[0.5], repeats=1, seed=5, frames_per_page=1, camera_frames=12)
    return made


def test_a_film_of_the_wedge_and_a_dark_one_give_the_figures_of_the_camera(folder) -> None:
    stacks = {"bright": [folder / "film.npy"], "dark": [folder / "dark.npy"]}
    result = tod.emva_noise(**stacks, chart=folder / "chart", exposure_ms=[40], bits=BITS)
    found = result.noise.emva1288
    # The camera of `closing_circle`, four standard errors of each; a patch at the side has 2 % less light.
    for name, true in (
        ("system_gain", 0.8),
        ("dark_noise", math.hypot(12.0, 5.0)),
        ("dsnu", 4.0),
        ("prnu", 0.8),
        ("background_electrons", 4000 * 0.25098),
    ):
        low, high = getattr(found, f"{name}_ci95")
        assert abs(getattr(found, name) - true) < 2.0 * (high - low) + 0.02 * true
    tables = tomllib.loads(result.sensor_toml())
    assert tables["noise"]["row_noise_electrons"] == pytest.approx(5.0, rel=0.15)
    assert tables["noise"]["dark_noise_electrons"] == pytest.approx(12.0, rel=0.05)
    assert tables["scene"]["luminance_cd_m2"] == pytest.approx(25.098)
    assert "quantum_efficiency" not in result.sensor_toml()


@pytest.mark.slow
def test_light_that_falls_off_evenly_is_no_nonuniformity(folder) -> None:
    frames = np.load(folder / "film.npy").astype(np.float64)
    fall_off = 1.0 + 0.2 * np.linspace(-1.0, 1.0, frames.shape[2])
    how = {"dark": [np.load(folder / "dark.npy")], "chart": folder / "chart", "bits": BITS}
    films = [np.rint(60 + (frames - 60) * factor).astype(np.uint16) for factor in (np.ones(1), fall_off)]
    even, uneven = (tod.emva_noise(bright=[one], **how).noise.emva1288.prnu for one in films)
    assert uneven == pytest.approx(even, rel=0.2)


def test_what_does_not_go_together_is_one_line(folder, tmp_path, capsys) -> None:
    film, dark, chart = folder / "film.npy", folder / "dark.npy", folder / "chart"
    np.save(tmp_path / "small.npy", np.load(dark)[:, :40])
    np.save(tmp_path / "lens_cap.npy", np.load(dark)[:2])
    for bright, darks, more, problem, status in (
        ([film], [dark], ["--region", "0,0,50,50"], "--region: is given with --chart", 2),
        ([film], [dark, dark], [], "found 2 dark recordings with --chart", 2),
        ([film], [tmp_path / "small.npy"], [], "has 480 x 40 pixels, expected 480 x 288 as the film", 1),
        ([tmp_path / "lens_cap.npy"], [dark], [], "found no frame of the page of", 1),
    ):
        options = [one for path in darks for one in ("--dark", str(path))]
        arguments = ["noise", *map(str, bright), *options, "--chart", str(chart), "--quiet", *more]
        assert run(cli, arguments) == status
        error = capsys.readouterr().err
        assert problem in error and error.count("\n") == 1, error


def test_the_command_prints_noise_and_scene(folder, capsys) -> None:
    asked = f"noise {folder / 'film.npy'} --dark {folder / 'dark.npy'} --chart {folder / 'chart'} --sensor --quiet"
    assert run(cli, [*asked.split(), "--bits", str(BITS), "--exposure-ms", str(EXPOSURE_MS)]) == 0
    tables = tomllib.loads(capsys.readouterr().out)
    assert set(tables) == {"noise", "scene"} and tables["noise"]["exposure_ms"] == EXPOSURE_MS


def test_measured_electrons_take_the_place_of_lens_and_light(tmp_path) -> None:
    (tmp_path / "sensor.toml").write_text(SENSOR, encoding="utf-8")
    sensor = ss.load_sensor(tmp_path / "sensor.toml")
    assert resolve(sensor).background_electrons == 900.0
    other = replace(sensor, scene=ss.Scene(luminance_cd_m2=20.0, background_electrons=900.0))
    assert resolve(replace(other, scene=other.scene.at(5.0))).background_electrons == pytest.approx(225.0)
    (fit,) = ss.curve(sensor, size_detectors=[6], tolerance=0.02, examples=False).fits
    # The same electrons by light: a threshold is the same.
    (by_light,) = ss.curve(other, size_detectors=[6], luminance_cd_m2=[20.0], tolerance=0.02, examples=False).fits
    assert by_light.threshold == fit.threshold
    with pytest.raises(SettingsError, match=r"scene\.luminance_cd_m2 is missing: background_electrons alone"):
        ss.curve(sensor, size_detectors=[6], luminance_cd_m2=[20.0])
    without = SENSOR.replace("background_electrons = 900.0", "luminance_cd_m2 = 20.0")
    (tmp_path / "light.toml").write_text(without, encoding="utf-8")
    with pytest.raises(SettingsError, match=r"optics\.focal_length_mm is missing"):
        ss.load_sensor(tmp_path / "light.toml")
    with_lens = without.replace("aperture_mm = 10.0", "f_number = 2.8\nfocal_length_mm = 25.0")
    (tmp_path / "light.toml").write_text(with_lens, encoding="utf-8")
    with pytest.raises(SettingsError, match=r"noise\.quantum_efficiency is missing"):
        ss.load_sensor(tmp_path / "light.toml")
    (tmp_path / "bright.toml").write_text(
        SENSOR.replace("exposure_ms = 10.0", "exposure_ms = 10.0\nfull_well_electrons = 800.0"), encoding="utf-8"
    )
    with pytest.raises(SettingsError, match=r"saturates at 800 electrons, and the background gives 900 with"):
        ss.curve(tmp_path / "bright.toml", size_detectors=[6])


@pytest.mark.weekly
def test_the_curve_of_the_model_is_that_of_the_film(tmp_path) -> None:
    make_film(tmp_path, sizes_mrad=[1.0, 2.0], contrasts=[0.06, 0.1, 0.16, 0.25, 0.4], repeats=5, seed=31)
    found = closed(tmp_path)
    for film, model in zip(found.film.fits, found.model.fits, strict=True):
        assert film.status == model.status == "ok"
        low, high = film.threshold_ci95
        # Each page has one trial at a place of its own. 1.5 times a 95 % interval is left once in 300.
        error = 1.5 * math.log(high / low) / 2.0 + model.threshold_numerical_error / model.threshold
        assert abs(math.log(model.threshold / film.threshold)) < error < 0.3
