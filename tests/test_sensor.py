"""SENSOR.toml: what it gives, and every way in which it can be wrong."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from sensor_sim.chain.sensor import Detector, Electronics, Noise, Optics, Sensor, SensorDisplay, load_sensor
from todframes.base.errors import SettingsError

STAR = (Path(__file__).parent.parent / "sample_frames" / "star_like.toml").read_text(encoding="utf-8")
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


POSITIVE = ["0.0", "-1.0", "nan", "inf"], "number from 1e-12 to 1e\\+12"
NOT_NEGATIVE = ["-0.1", "nan", "inf"], "number from 0 to 1e\\+12"
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
    match = rf"^.*SENSOR\.toml: \[{table}\]: {key}: found {value}, expected a {expected}$"
    with pytest.raises(SettingsError, match=match):
        load(tmp_path, STAR.replace(line, f"{key} = {value}"))
    with pytest.raises(SettingsError, match=f"^{key}: found {value}, expected a {expected}$"):
        replace(getattr(SENSOR, table), **tomllib.loads(f"{key} = {value}"))


@pytest.mark.parametrize(
    ("table", "line"),
    [key for key in RANGES if key[1].split(" = ")[0] in
     ("aperture_mm", "wavelength_um", "pitch_mrad", "width_mrad", "pixels_per_detector", "pixel_pitch_mm",
      "viewing_distance_mm", "background_luminance_cd_m2")],
)  # fmt: skip
def test_a_missing_key_is_named(tmp_path, table, line):
    key = line.split(" = ")[0]
    with pytest.raises(SettingsError, match=rf"SENSOR\.toml: \[{table}\]: {key} is missing$"):
        load(tmp_path, STAR.replace(f"\n{line}\n", "\n"))


@pytest.mark.parametrize(("table", "line"), [*RANGES, ("noise", 'distribution = "uniform"')])
def test_an_unknown_key_names_the_nearest(tmp_path, table, line):
    key, value = line.split(" = ")
    match = rf"^.*SENSOR\.toml: \[{table}\]: unknown key '{key[:-1]}_'; the nearest valid one is '{key}'$"
    with pytest.raises(SettingsError, match=match):
        load(tmp_path, STAR.replace(line, f"{key[:-1]}_ = {value}"))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("[electronics]", "[electronic]", r"unknown key 'electronic'; the nearest valid one is 'electronics'$"),
        ("schema = 1", "schema = 2", r"schema: found 2, expected 1$"),
        ("schema = 1", "schema = true", r"schema: found True, expected 1$"),
        ("schema = 1", "", r"schema: found None, expected 1$"),
        ('name = "star-like"', "name = 3", r"name: found 3, expected text$"),
        ('"uniform"', '"triangular"', r"\[noise\]: distribution: found 'triangular'"),
        (
            "width_mrad = 0.0681",
            "width_mrad = 0.0682",
            r"\[detector\]: width_mrad: found 0.0682, expected at most pitch_mrad",
        ),
        (
            "pitch_mrad = 0.0681\nwidth_mrad = 0.0681",
            "width_um = 9.0",
            r"\[detector\]: pitch_um is missing: width_um is a width on",
        ),
        (
            "pitch_mrad = 0.0681\nwidth_mrad = 0.0681",
            "pitch_um = 9.0",
            "optics.focal_length_mm is missing: detector",
        ),
        ("netd_mk = 16.0", "couple_netd = true", r"\[noise\]: couple_netd: needs netd_mk, which is missing$"),
        ("aperture_mm", "measured_units = 1.0\naperture_mm", r"\[optics\]: unknown key 'measured_units'$"),
        ("frames_integrated = 6", "frames_integrated = 6.5", r"\[noise\]: frames_integrated: found 6.5"),
        ("star", "st\udce4r", r"not UTF-8 \(byte \d+\)$"),
    ],
)
def test_other_mistakes_are_named(tmp_path, old, new, match):
    with pytest.raises(SettingsError, match=rf"^[^\n]*SENSOR\.toml: {match}"):
        load(tmp_path, STAR.replace(old, new, 1))


@pytest.mark.parametrize("table", ["optics", "detector", "display"])
def test_a_missing_table_is_named(tmp_path, table):
    kept = [part for part in STAR.split("\n[") if not part.startswith(table)]
    with pytest.raises(SettingsError, match=rf"SENSOR\.toml: table \[{table}\] is missing$"):
        load(tmp_path, "\n[".join(kept))


def test_a_key_in_place_of_a_table_is_named(tmp_path):
    text = STAR.replace("[electronics]\nblur_sigma_px = 0.0\n", "")
    with pytest.raises(SettingsError, match=r"electronics: found 2, expected a table$"):
        load(tmp_path, "electronics = 2\n" + text)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SettingsError, match=r"none\.toml: no such file$"):
        load_sensor(tmp_path / "none.toml")


def test_cut_off_is_the_diameter_in_wavelengths():
    # 0.22 m of 4e-6 m waves: 55,000 cycles per radian.
    assert OPTICS.cut_off_cyc_per_mrad == pytest.approx(0.22 / 4e-6 / 1000)
    assert pytest.approx(1.0) == DETECTOR.nyquist_cyc_per_mrad * 2 * 0.0681


def test_display_pixel_is_seen_under_its_angle_and_magnification_carries_a_detector_into_its_pixels():
    assert math.tan(DISPLAY.pixel_pitch_mrad / 2000) * 2 * 350 == pytest.approx(0.25, rel=1e-14)
    assert pytest.approx(6 * DISPLAY.pixel_pitch_mrad) == DISPLAY.detector_pitch_mrad
    assert SENSOR.magnification * 0.0681 == pytest.approx(DISPLAY.detector_pitch_mrad)
