"""SENSOR.toml: what it gives, and every way in which it can be wrong."""

from __future__ import annotations

import math
import re
import tomllib
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.measured import MeasuredMtf
from sensor_sim.chain.sensor import (
    Detector,
    Electronics,
    Noise,
    Optics,
    PhotonNoise,
    Scene,
    Sensor,
    SensorDisplay,
    load_sensor,
    sensor_settings,
    used_keys,
)
from todframes.base.errors import SettingsError

STAR = (Path(__file__).parents[2] / "sample_frames" / "star_like.toml").read_text(encoding="utf-8")
OPTICS = Optics(aperture_mm=220.0, wavelength_um=4.0, blur_sigma_mrad=0.01)
DETECTOR = Detector(pitch_mrad=0.0681, width_mrad=0.0681)
DISPLAY = SensorDisplay(
    pixels_per_detector=6,
    pixel_pitch_mm=0.25,
    viewing_distance_mm=350.0,
    background_luminance_cd_m2=50.0,
    blur_sigma_px=2.0,
)
SENSOR = Sensor(
    name="star-like",
    optics=OPTICS,
    detector=DETECTOR,
    noise=Noise(netd_mk=16.0, fixed_pattern_ratio=0.4, frames_integrated=6),
    display=DISPLAY,
)


def load(tmp_path, text) -> Sensor:
    path = tmp_path / "SENSOR.toml"
    path.write_text(text, encoding="utf-8", errors="surrogateescape")
    return load_sensor(path)


def test_every_key_arrives(tmp_path):
    text = STAR.replace("blur_sigma_px = 0.0", "blur_sigma_px = 0.5").replace("gain = 1.0", "gain = 0.25")
    expected = replace(SENSOR, electronics=Electronics(blur_sigma_px=0.5), display=replace(DISPLAY, gain=0.25))
    assert load(tmp_path, text) == expected


def test_what_may_be_left_out_has_the_documented_default(tmp_path):
    lines = STAR.splitlines()
    optional = ("name", "blur_sigma", "[noise]", "dist", "netd", "fixed", "frames", "[electronics]", "gain")
    text = "\n".join(line for line in lines if not line.startswith(optional))
    expected = Sensor(
        optics=replace(OPTICS, blur_sigma_mrad=0.0), detector=DETECTOR, display=replace(DISPLAY, blur_sigma_px=0.0)
    )
    assert load(tmp_path, text) == expected


POSITIVE = ["0.0", "-1.0", "nan", "inf", "1e-13", "2e+12"], "number from 1e-12 to 1e\\+12"
NOT_NEGATIVE = ["-0.1", "nan", "inf", "2e+12"], "number from 0 to 1e\\+12"
PIXELS = ["-0.1", "nan", "inf", "1000.5"], "number from 0 to 1000"
RANGES = {
    ("optics", "aperture_mm = 220.0"): POSITIVE,
    ("optics", "wavelength_um = 4.0"): POSITIVE,
    ("optics", "blur_sigma_mrad = 0.01"): NOT_NEGATIVE,
    ("detector", "pitch_mrad = 0.0681"): POSITIVE,
    ("detector", "width_mrad = 0.0681"): POSITIVE,
    ("noise", "netd_mk = 16.0"): POSITIVE,
    ("noise", "fixed_pattern_ratio = 0.4"): NOT_NEGATIVE,
    ("noise", "frames_integrated = 6"): (["0", "-3"], "whole number from 1 to 10000"),
    ("electronics", "blur_sigma_px = 0.0"): PIXELS,
    ("display", "pixels_per_detector = 6"): (["0", "-3", "1001"], "whole number from 1 to 1000"),
    ("display", "pixel_pitch_mm = 0.25"): POSITIVE,
    ("display", "viewing_distance_mm = 350.0"): POSITIVE,
    ("display", "blur_sigma_px = 2.0"): PIXELS,
    ("display", "background_luminance_cd_m2 = 50.0"): POSITIVE,
    ("display", "gain = 1.0"): POSITIVE,
}
OUT_OF_RANGE = [(*key, value, expected) for key, (values, expected) in RANGES.items() for value in values]


@pytest.mark.parametrize(("table", "line", "value", "expected"), OUT_OF_RANGE)
def test_a_value_out_of_range_is_named(tmp_path, table, line, value, expected):
    key = line.split(" = ")[0]
    found = f"found {re.escape(str(tomllib.loads(f'x = {value}')['x']))}, expected a {expected}$"
    match = rf"^.*SENSOR\.toml: \[{table}\]: {key}: {found}"
    with pytest.raises(SettingsError, match=match):
        load(tmp_path, STAR.replace(line, f"{key} = {value}"))
    with pytest.raises(SettingsError, match=f"^{key}: {found}"):
        replace(getattr(SENSOR, table), **tomllib.loads(f"{key} = {value}"))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("[electronics]", "[electronic]", r"unknown key 'electronic'; the nearest valid one is 'electronics'$"),
        ("schema = 1", "schema = 2", r"schema: found 2, expected 1$"),
        ("aperture_mm = 220.0\n", "", r"\[optics\]: aperture_mm is missing$"),
        ("pixel_pitch_mm = 0.25\n", "", r"\[display\]: pixel_pitch_mm is missing$"),
        ('name = "star-like"', "name = 3", r"name: found 3, expected text$"),
        ('"uniform"', '"triangular"', r"\[noise\]: distribution: found 'triangular'"),
        ("width_mrad = 0.0681", "width_mrad = 0.0682",
         r"\[detector\]: width_mrad: found 0.0682, expected at most pitch_mrad"),
        ("pitch_mrad = 0.0681\nwidth_mrad = 0.0681", "width_um = 9.0",
         r"\[detector\]: pitch_um is missing: width_um is a width on"),
        ("pitch_mrad = 0.0681\nwidth_mrad = 0.0681", "pitch_um = 9.0", "optics.focal_length_mm is missing: det"),
        *(
            (
                "pitch_mrad = 0.0681\nwidth_mrad = 0.0681",
                f"{key} = 0.05\n{other} = 9.0",
                rf"\[detector\]: found {key} and {other}, expected one of them$",
            )
            for key, other in (("pitch_mrad", "pitch_um"), ("pitch_mrad", "width_um"), ("width_mrad", "pitch_um"))
        ),
        ("netd_mk = 16.0", "couple_netd = true", r"\[noise\]: couple_netd: needs netd_mk, which is missing$"),
        ("frames_integrated = 6", "frames_integrated = 6.5", r"\[noise\]: frames_integrated: found 6.5"),
        ("star", "st\udce4r", r"not UTF-8 \(byte \d+\)$"),
    ],
)  # fmt: skip
def test_other_mistakes_are_named(tmp_path, old, new, match):
    with pytest.raises(SettingsError, match=rf"^[^\n]*SENSOR\.toml: {match}"):
        load(tmp_path, STAR.replace(old, new, 1))


@pytest.mark.parametrize("table", ["optics", "detector", "display"])
def test_a_missing_table_is_named(tmp_path, table):
    kept = [part for part in STAR.split("\n[") if not part.startswith(table)]
    with pytest.raises(SettingsError, match=rf"SENSOR\.toml: table \[{table}\] is missing$"):
        load(tmp_path, "\n[".join(kept))


@pytest.mark.parametrize(
    ("f_number", "match"),
    [(0.0, "^f_number: found 0.0, expected a num"), (1e7, "^aperture_mm: found 9.9.*e-14, exp")],
)
def test_lengths_are_checked_before_they_become_others(f_number, match):
    with pytest.raises(SettingsError, match=match):
        Optics(f_number=f_number, focal_length_mm=1e-6, wavelength_um=1.0)
    with pytest.raises(SettingsError, match=r"^pitch_um: found -1\.0, expected a number from 1e-12"):
        Detector(pitch_um=-1.0)


def test_keys_that_change_nothing_are_left_out():
    assert sensor_settings(SENSOR) == {
        "optics": {"aperture_mm": 220.0, "wavelength_um": 4.0, "blur_sigma_mrad": 0.01},
        "detector": {"pitch_mrad": 0.0681, "width_mrad": 0.0681},
        "display": asdict(DISPLAY),
        "noise": {"distribution": "uniform", "netd_mk": 16.0, "fixed_pattern_ratio": 0.4, "frames_integrated": 6},
        "electronics": {"blur_sigma_px": 0.0},
        "name": "star-like",
    }
    assert list(sensor_settings(SENSOR)) == ["optics", "detector", "display", "noise", "electronics", "name"]
    assert sensor_settings(replace(SENSOR, noise=Noise()))["noise"]["netd_mk"] is None
    assert sensor_settings(replace(SENSOR, optics=MEASURED))["optics"] == {"mtf": "mtf.csv"}


TABLE = MeasuredMtf(
    file="mtf.csv", unit="cyc_per_mrad", frequency=(0.0, 9.0), tangential=(1.0, 0.0), sagittal=(1.0, 0.0)
)
MEASURED = replace(OPTICS, blur_sigma_mrad=0.0, mtf=TABLE)
BY_NUMBER = {"f_number": 2.0, "focal_length_mm": 20.0}
MODEL = "blur_sigma_mrad obscuration_ratio defocus_waves"
LUX = Scene(illuminance_lx=300.0, reflectance=0.5)
COUNTED = Scene(background_electrons=50.0)
IN_LUX = "illuminance_lx reflectance photons_per_lux_s_um2 background_electrons"


@pytest.mark.parametrize(
    ("optics", "scene", "of_optics", "of_scene"),
    [
        (OPTICS, None, f"aperture_mm wavelength_um {MODEL}", ""),
        (replace(OPTICS, **BY_NUMBER), LUX, f"f_number wavelength_um transmission {MODEL}", IN_LUX),
        (MEASURED, None, "", ""),
        (replace(MEASURED, **BY_NUMBER), LUX, "f_number wavelength_um transmission", IN_LUX),
        (
            replace(MEASURED, focal_length_mm=20.0),
            Scene(luminance_cd_m2=1.0, photons_per_lux_s_um2=4000.0),
            "aperture_mm transmission",
            "luminance_cd_m2 photons_per_lux_s_um2 background_electrons",
        ),
        (MEASURED, COUNTED, "", "background_electrons"),
        (MEASURED, replace(COUNTED, luminance_cd_m2=1.0), "", "luminance_cd_m2 background_electrons"),
    ],
)  # fmt: skip
def test_a_sensor_has_the_keys_that_mean_something_for_it(optics, scene, of_optics, of_scene):
    photons = PhotonNoise(dark_noise_electrons=5.0, exposure_ms=10.0, quantum_efficiency=0.5)
    sensor = replace(SENSOR, optics=optics, scene=scene, photons=photons if scene else None)
    keys = used_keys(sensor)
    always = {"focal_length_mm", "mtf", "mtf_includes_detector", "psf", "psf_pitch_um", "psf_pitch_mrad"}
    assert {*keys["optics"]} - always == {*of_optics.split()} and always <= {*keys["optics"]}
    assert {*keys.get("scene", [])} == {*of_scene.split()}
    assert keys["detector"] == ["pitch_mrad", "width_mrad"]
    coupled = used_keys(replace(sensor, noise=replace(SENSOR.noise, couple_netd=True)))["optics"]
    if not scene:
        assert "aperture_mm" in coupled and "f_number" not in coupled
    on_chip = Sensor(
        optics=replace(OPTICS, **BY_NUMBER), detector=Detector(pitch_um=5.0, width_um=4.0), display=DISPLAY
    )
    assert used_keys(on_chip)["detector"] == ["pitch_um", "width_um"]
    assert (on_chip.pitch_mrad, on_chip.width_mrad) == (0.25, 0.2)


def test_cut_off_is_the_diameter_in_wavelengths():
    # 0.22 m of 4e-6 m waves: 55,000 cycles per radian.
    assert resolve(SENSOR).optics.cut_off_cyc_per_mrad == pytest.approx(0.22 / 4e-6 / 1000)
    assert pytest.approx(1.0) == resolve(SENSOR).nyquist_cyc_per_mrad * 2 * 0.0681


def test_display_pixel_is_seen_under_its_angle_and_magnification_carries_a_detector_into_its_pixels():
    assert math.tan(DISPLAY.pixel_pitch_mrad / 2000) * 2 * 350 == pytest.approx(0.25, rel=1e-14)
    assert pytest.approx(6 * DISPLAY.pixel_pitch_mrad) == DISPLAY.detector_pitch_mrad
    assert SENSOR.magnification * 0.0681 == pytest.approx(DISPLAY.detector_pitch_mrad)
