"""New files of sensors: every key is explained, and the file is the camera that was asked for."""

from __future__ import annotations

import inspect
import json
import re
import tomllib
from dataclasses import fields, replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.camera import fried_length_mm
from sensor_sim.chain.new_sensor import DISPLAY, PRESETS
from sensor_sim.chain.sensor import EXPLAINED, NOISE_MODELS, TABLES, preset_files
from todframes.base.errors import DataError, SettingsError
from todframes.display.display import find_display
from todframes.parameters import Preset


def test_every_key_is_explained():
    kinds = [*TABLES.items(), *(("noise", kind) for kind in NOISE_MODELS.values())]
    keys = {f"{table}.{one.name}" for table, kind in kinds for one in fields(kind)}
    assert keys == EXPLAINED.keys()


def test_a_thermal_camera(tmp_path, sensor_sim):
    options = ["--thermal", "--netd-mk", "50", "--pitch-um", "12", "--f-number", "1.0", "--focal-length-mm", "35"]
    status, text, _ = sensor_sim("new", *options)
    assert status == 0
    (tmp_path / "new.toml").write_text(text, encoding="utf-8")
    sensor = ss.load_sensor(tmp_path / "new.toml")
    assert sensor == ss.Sensor(
        name="thermal camera, 12 µm, 35 mm",
        optics=ss.Optics(f_number=1.0, focal_length_mm=35.0, wavelength_um=10.0),
        detector=ss.Detector(pitch_um=12.0),
        noise=ss.Noise(distribution="gaussian", netd_mk=50.0, couple_netd=True, frames_integrated=6),
        display=replace(DISPLAY, pixels_per_detector=1, background_luminance_cd_m2=50.0),
    )
    lines = [line for line in text.splitlines()[2:] if line and not line.startswith("[")]
    assert all(re.fullmatch(r"(# )?[a-z0-9_]+ =.*  # .+", line) for line in lines)
    own = ss.sweep(sensor, size_detectors=[8], vary={"noise.netd_mk": [40.0, 60.0]}, tolerance=0.1)
    assert own.settings["couple_netd"] is False


def test_a_detector_is_shown_at_the_angle_of_a_pixel_that_import_writes():
    text = ss.new_sensor(preset="boson", focal_length_mm=14)
    display = ss.SensorDisplay(**tomllib.loads(text)["display"])
    of_import = inspect.signature(tod.import_recordings).parameters["display"].default
    assert display.detector_pitch_mrad == pytest.approx(find_display(of_import).display.pitch_mrad, rel=1e-6)


def test_results_of_emva_1288(tmp_path):
    rng, common = np.random.default_rng(1), {"f_number": 2.8, "focal_length_mm": 25.0}
    dark, bright = (
        np.rint(20 + 0.4 * (rng.poisson(mean, (4, 64, 64)) + rng.normal(0, 2.5, (4, 64, 64)))).astype(np.uint16)
        for mean in (0, 3_000)
    )
    stacks = {"bright": [bright], "dark": [dark], "exposure_ms": [20.0], "bits": 12}
    measured = tod.emva_noise(**stacks, photons=[5_000.0])
    measured.save(tmp_path / "camera")
    text = ss.new_sensor(emva=tmp_path / "camera", pitch_um=3.45, luminance=5.0, **common)
    (tmp_path / "new.toml").write_text(text, encoding="utf-8")
    sensor = ss.load_sensor(tmp_path / "new.toml")
    table = measured.noise.emva1288.noise_table()
    assert table.pop("model") == "photon" and sensor.photons == ss.PhotonNoise(**table)
    assert sensor.photons.quantum_efficiency == pytest.approx(0.6, rel=0.05)
    assert sensor.scene == ss.Scene(luminance_cd_m2=5.0) and "# Source: results of EMVA 1288 in camera\n" in text
    tod.emva_noise(**stacks).save(tmp_path / "dark")
    with pytest.raises(SettingsError, match="quantum_efficiency is missing: the results do not have it"):
        ss.new_sensor(emva=tmp_path / "dark", pitch_um=3.45, **common)
    tod.noise(dark).save(tmp_path / "other")
    with pytest.raises(
        DataError, match="other: is no result of EMVA 1288, expected that of todframes noise --dark"
    ):
        ss.new_sensor(emva=tmp_path / "other", pitch_um=3.45, **common)


@pytest.mark.parametrize("preset", ["emva_basler", "boson"])
def test_a_preset_names_its_source(tmp_path, preset):
    text = ss.new_sensor(preset=preset, pitch_um=6.45, f_number=1.4, focal_length_mm=20.0, netd_mk=50.0)
    assert text.splitlines()[:2] == ["schema = 1", f'name = "{preset}, 6.45 µm, 20 mm"']
    assert text.splitlines()[2].startswith("# Source: ") and not text.partition("\n[optics]")[0].endswith("\n\n")
    assert "\n# obscuration_ratio = 0.0  # diameter of a central obscuration over that of the aperture" in text
    (tmp_path / "new.toml").write_text(text, encoding="utf-8")
    sensor = ss.load_sensor(tmp_path / "new.toml")
    assert sensor.optics.f_number == 1.4
    source = text.partition("# Source: ")[2].partition("\n\n")[0].replace(",", "").replace("\n# ", " ")
    figures = {float(number) for number in re.findall(r"\d+(?:\.\d+)?", source)}
    if preset == "boson":
        own = tomllib.loads(ss.new_sensor(preset=preset, focal_length_mm=14.0))
        assert {own["noise"]["netd_mk"], own["detector"]["pitch_um"], own["optics"]["f_number"]} <= figures
        return
    photons, saturation_photons = sensor.photons, 30957
    assert '\nmodel = "photon"  # in the words' in text
    assert (photons.exposure_ms, sensor.optics.wavelength_um, sensor.scene.luminance_cd_m2) == (10.0, 0.55, 100.0)
    assert {100 * photons.quantum_efficiency, photons.system_gain_dn_per_electron, photons.bits} <= figures
    assert {photons.dark_noise_electrons, photons.dsnu_electrons, photons.prnu_percent} <= figures
    assert photons.full_well_electrons == pytest.approx(saturation_photons * 0.4525, rel=1e-4)


@pytest.mark.parametrize(
    ("asked", "netd_mk"),
    [
        ({}, 40.0),
        ({"f_number": 1.4}, 78.4),  # 40 · 1.4²
        ({"pitch_um": 17.0, "f_number": 1.4}, 39.0644),  # a detector of (17 / 12)² the area
        ({"netd_mk": 50.0, "f_number": 1.4}, 50.0),
        ({"netd_mk": 50.0}, 50.0),
    ],
)
def test_the_netd_of_a_preset_follows_lens_and_detector_unless_it_is_given(asked, netd_mk):
    text = ss.new_sensor(preset="boson", focal_length_mm=14.0, **asked)
    assert tomllib.loads(text)["noise"]["netd_mk"] == netd_mk
    is_scaled = netd_mk not in (40.0, 50.0)
    assert (f"NETD {netd_mk:g} mK here, by f-number² / area" in text.replace("\n# ", " ")) is is_scaled


@pytest.mark.parametrize(
    ("rate", "thermal", "other"), [(None, 6, 1), (60, 6, 6), (9, 1, 1), (25, 2, 2), (100, 10, 10)]
)
def test_the_eye_averages_the_frames_of_a_tenth_of_a_second(rate, thermal, other):
    asked = {"focal_length_mm": 14.0, "frames_per_second": rate}
    for camera, frames in (("boson", thermal), ("emva_basler", other)):
        more = {} if camera == "boson" else {"pitch_um": 6.45, "f_number": 2.8}
        text = ss.new_sensor(preset=camera, **asked, **more)
        assert tomllib.loads(text)["noise"]["frames_integrated"] == frames
    with pytest.raises(SettingsError, match=r"^frames_per_second: found 0.0, expected a number from"):
        ss.new_sensor(preset="boson", focal_length_mm=14.0, frames_per_second=0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wavelength_um": 0.0}, r"wavelength_um: found 0\.0"),
        ({"f_number": None}, "f_number is missing: give f_number"),
        ({"thermal": False}, "new: expected one of emva, thermal, preset and pybsm"),
        ({"thermal": False, "preset": "lepton"}, "preset: found 'lepton', expected one of emva_basler, boson"),
    ],
)
def test_what_is_missing_is_named(changes, message):
    common = {"thermal": True, "netd_mk": 50, "pitch_um": 12, "f_number": 1, "focal_length_mm": 35}
    with pytest.raises(SettingsError, match=message):
        ss.new_sensor(**common | changes)


def test_a_preset_that_is_whole_is_written_as_curve_reads_it_by_name(tmp_path: Path) -> None:
    names = [name for name in get_args(Preset) if name not in PRESETS]
    assert set(names) == set(preset_files())
    for name in names:
        file = tmp_path / f"{name}.toml"
        file.write_text(ss.new_sensor(preset=name), encoding="utf-8")
        assert ss.load_sensor(file) == ss.load_sensor(name)
    with pytest.raises(SettingsError, match="visible is a whole sensor, expected no values beside it"):
        ss.new_sensor(preset="visible", f_number=2.0)
    with pytest.raises(SettingsError, match=r"visble: no such file, and not one of the presets .* visible"):
        ss.load_sensor("visble")
    with pytest.raises(SettingsError, match="focal_length_mm is missing"):
        ss.new_sensor(preset="boson")


# The values of a UAV's camera in pyBSM's documentation (docs/miscellaneous, Apache-2.0), with less jitter.
PYBSM = {
    "sensor": {
        "name": "Blackfly",
        "p_x": 3.45e-6,
        "p_y": 3.45e-6,
        "w_x": 3.45e-6,
        "f": 24e-3,
        "D": 8.75e-3,
        "int_time": 17e-3,
        "bit_depth": 12,
        "max_n": 11105,
        "s_x": 8e-5,
        "s_y": 8e-5,
        "da_y": 2.5e-3,
        "qewavelengths": [470e-9, 525e-9, 630e-9, 800e-9],
        "qe": [0.50, 0.60, 0.48, 0.25],
        "opt_trans_wavelengths": [470e-9, 800e-9],
    },
    "scenario": {"ihaze": 1, "altitude": 100, "ground_range": 0, "ha_wind_speed": 8, "cn2_at_1m": 1.7e-14},
}


def test_a_sensor_of_pybsm(tmp_path, sensor_sim):
    file, made = tmp_path / "uav.json", tmp_path / "uav.toml"
    file.write_text(json.dumps(PYBSM), encoding="utf-8")
    status, _, err = sensor_sim("new", "--from", file, "--luminance", "20", "-o", made)
    assert status == 0 and err.strip() == "note: no counterpart here: scenario.ihaze"
    sensor = ss.load_sensor(made)
    assert sensor.name == "Blackfly" and sensor.scene == ss.Scene(luminance_cd_m2=20.0)
    assert (sensor.optics.wavelength_um, sensor.pitch_mrad) == (0.635, pytest.approx(3.45 / 24.0, rel=1e-6))
    assert sensor.aperture_mm == pytest.approx(8.75, rel=1e-5)
    # The drift is along y, at 2.5 mrad/s for 17 ms: a triangle of four orientations does not mind.
    assert sensor.motion == ss.Motion(smear_mrad=0.0425, jitter_sigma_mrad=0.08)
    # The trapezoids of the table: (0.55 · 55 + 0.54 · 105 + 0.365 · 170) / 330.
    assert sensor.photons.quantum_efficiency == pytest.approx((30.25 + 56.7 + 62.05) / 330.0, rel=1e-4)
    assert (sensor.photons.bits, sensor.photons.full_well_electrons) == (12, 11105.0)
    assert sensor.photons.system_gain_dn_per_electron == pytest.approx(4096 / 11105, rel=1e-5)
    # By pyBSM 0.16.1, `polychromatic_turbulence_OTF` at 635 nm: r₀ = 210.3 mm over the same path.
    air = sensor.turbulence
    length = fried_length_mm(cn2_m23=air.cn2_m23, path_km=air.path_km, wavelength_um=0.635)
    assert length == pytest.approx(210.30129111699497, rel=1e-5)


def test_a_thermal_sensor_of_pybsm_needs_its_netd(tmp_path):
    file, made = tmp_path / "mwir.json", tmp_path / "mwir.toml"
    own = {"name": "M", "D": 0.1, "f": 0.4, "p_x": 2e-5, "opt_trans_wavelengths": [3.9e-6, 4.1e-6], "eta": 0.3}
    scenario = {"altitude": 1000.0, "ground_range": 24e6**0.5}
    file.write_text(json.dumps({"sensor": own, "scenario": scenario}), encoding="utf-8")
    with pytest.raises(SettingsError, match=r"^netd_mk is missing: give netd_mk$"):
        ss.new_sensor(pybsm=file)
    file.write_text(
        json.dumps({"sensor": own | {"max_n": 1e6, "pv": 0.1}, "scenario": scenario}), encoding="utf-8"
    )
    assert "\n# no counterpart here: sensor.pv, sensor.max_n\n" in ss.new_sensor(pybsm=file, netd_mk=25.0)
    made.write_text(ss.new_sensor(pybsm=file, netd_mk=25.0, focal_length_mm=200.0), encoding="utf-8")
    sensor = ss.load_sensor(made)
    assert sensor.noise.netd_mk == 25.0 and sensor.optics.focal_length_mm == 200.0 and sensor.motion is None
    assert sensor.optics.obscuration_ratio == 0.3
    # By pyBSM 0.16.1, a slant path of 5 km with its defaults: 1.3366 m, a mean over the band, which is 8e-5 more.
    air = sensor.turbulence
    length = fried_length_mm(cn2_m23=air.cn2_m23, path_km=air.path_km, wavelength_um=4.0)
    assert length == pytest.approx(1336.6246470342382, rel=2e-4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "is no JSON"),
        ('{"D": 1}', "found no object sensor, expected a JSON file of pyBSM"),
        (
            json.dumps({"sensor": PYBSM["sensor"] | {"qe": [0.5]}}),
            "qe: found 1 values, expected one for each of 4",
        ),
        (json.dumps({"sensor": {"D": 0.1}}), "sensor: .* is missing"),
    ],
)
def test_a_file_that_is_no_sensor_of_pybsm_is_one_line(tmp_path, sensor_sim, text, message):
    (tmp_path / "bad.json").write_text(text, encoding="utf-8")
    status, out, err = sensor_sim("new", "--from", tmp_path / "bad.json")
    assert status in (1, 2) and out == "" and len(err.splitlines()) == 1 and re.search(message, err), err
