"""The first tries of a new user with `todframes range`: each row has a number, or a limit that is named."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.camera import resolve
from sensor_sim.thresholds.predict import FoldedChain, predict_threshold

ROOT = Path(__file__).parents[2]
THERMAL = {"target": "nato", "atmosphere": "lwir_23km"}
PRESET = "uncooled_lwir"


@pytest.fixture(scope="module")
def of_preset() -> tod.Result:
    return tod.acquisition_range(PRESET, **THERMAL)


def acuity_detectors(found: tod.Result) -> float:
    """From the range of detection: one line pair of 2.3 m, as wide as a triangle."""
    (km,) = [one.range_km for one in found.numbers.ranges if (one.task, one.probability) == ("detection", 0.5)]
    return 2.3 / km / ss.load_sensor(PRESET).detector.pitch_mrad


def test_a_preset_sees_as_far_as_its_acuity(of_preset) -> None:
    """A triangle of the acuity has a threshold, and one that is 3 % smaller has none however strong the signal."""
    assert {one.status for one in of_preset.numbers.ranges} == {"limited_by_sampling"}
    assert all(one.range_km for one in of_preset.numbers.ranges)
    camera, acuity = resolve(ss.load_sensor(PRESET)), acuity_detectors(of_preset)
    statuses = [
        predict_threshold(FoldedChain(camera, tod.PyramidObserver(), size), tolerance=0.1).status
        for size in (acuity, 0.97 * acuity)
    ]
    assert statuses == ["ok", "never_reached"]
    assert of_preset.warnings == ()
    assert any(one.startswith("The TOD is taken for line pairs, 1 in √area") for one in of_preset.advice())
    assert of_preset.sentences()[0].endswith(" km, limited by sampling.")


def test_a_faint_target_has_a_number_for_each_k() -> None:
    """Where the contrast decides, ΔT · exp(−depth) is the threshold of a triangle of size / k."""
    faint = tod.Target(size_m=2.3, delta_t_k=0.1, k={"near": 12.0, "far": 2.0})
    found = tod.acquisition_range(PRESET, target=faint, atmosphere=tod.Atmosphere(extinction_per_km=1.0), p=0.6)
    sensor = ss.load_sensor(PRESET)
    for one in found.numbers.ranges:
        assert (one.probability, one.status) == (0.6, "ok")
        size = 2.3 / (one.kappa * one.range_km * sensor.detector.pitch_mrad)
        (fit,) = ss.curve(sensor, size_detectors=[size], p_correct=0.6, tolerance=5e-3, examples=False).fits
        # Thresholds of 1 % between knots that lie up to 1.6 apart in size.
        assert 1e3 * 0.1 * np.exp(-one.range_km) == pytest.approx(fit.delta_t_mk, rel=0.04)


def test_the_readme_s_sample_has_ranges(tmp_path) -> None:
    out = tmp_path / "result"
    tod.score(ROOT / "sample_frames" / "naked_eye").save(out)
    found = tod.acquisition_range(out, target="nato_daylight", atmosphere="visible_23km")
    assert {one.status for one in found.numbers.ranges} == {"ok"}
    assert [one.code for one in found.warnings] == ["size_at_the_eye"]


FACE = {"target": "face", "atmosphere": "visible_23km"}
IEC_PX_M = (1000, 250, 125, 62, 25)
PAGE = ROOT / "docs" / "how_to" / "face_at_30_m.md"


def test_the_page_on_a_face_has_the_model_s_numbers() -> None:
    """At the pixel densities of IEC 62676-4; between thresholds of 1 % the probability is known to 2 %."""
    pitch_mrad = ss.load_sensor("low_light").pitch_mrad
    found = tod.acquisition_range(
        "low_light", distance_m=[1e3 / density / pitch_mrad for density in IEC_PX_M], **FACE
    )
    known = {one.task: one.probability for one in found.numbers.at_distance}
    rows = [line.split("|")[1:-1] for line in PAGE.read_text(encoding="utf-8").splitlines() if "px |" in line]
    assert len(rows) == len(IEC_PX_M)
    for row, density, *expected in zip(rows, IEC_PX_M, known["recognition"], known["identification"], strict=True):
        assert float(row[0]) == density and float(row[3].removesuffix("px ")) == pytest.approx(
            0.16 * density, abs=0.5
        )
        assert [float(cell) for cell in row[4:]] == pytest.approx(expected, rel=0.05, abs=0.006)
    # A line pair takes as many detectors as the smallest triangle at that contrast, by the convention of Figure 7:
    # at P = 0.5, N = 10 pairs across 0.16 m.
    (km,) = [one.range_km for one in found.numbers.ranges if (one.task, one.probability) == ("recognition", 0.5)]
    size = 0.16 / 10.0 / km / pitch_mrad
    (fit,) = ss.curve("low_light", size_detectors=[size], tolerance=5e-3, examples=False).fits
    assert fit.threshold == pytest.approx(0.3 * np.exp(-0.176 * km), rel=0.03)  # thresholds of 1 %, interpolated


def test_several_sensors_are_one_table(todframes, tmp_path) -> None:
    asked = ("--target", "face", "--atmosphere", "visible_23km", "--distance-m", "30,100", "-o", tmp_path / "out")
    status, out, err = todframes("range", "low_light", "visible", *asked)
    assert status == 1 and err.splitlines()[-1] == "error: 1 of 2 results could not be used: visible"
    assert "a camera that counts photons (preset low_light) has contrasts" in " ".join(out.split())
    with (tmp_path / "out" / "summary.csv").open(encoding="utf-8") as file:
        first, second, failed = csv.DictReader(file)
    alone = tod.acquisition_range("low_light", distance_m=[100.0, 30.0, 30.0], **FACE)
    for row, one in zip((first, second), alone.numbers.at_distance, strict=True):
        assert (row["result"], row["task"], row["status"]) == ("low_light", one.task, "ok")
        assert [float(row[f"P at {metres} m"]) for metres in (30, 100)] == list(one.probability)
    assert failed["status"] == "failed" and failed["error"].startswith("visible: found thresholds in snr")
    assert [table.title for table in alone.tables()][1] == "Probability at distances"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"distance_m": [0.0]}, "distance_m: found 0.0, expected a finite number > 0"),
        ({"distance_m": [50_000.0]}, r"distance_m: found 50000, expected at most \d+, where the air ends"),
        ({"distance_m": [30.0], "k": 2.0}, "distance_m: low_light has no psychometric functions"),
    ],
)
def test_a_distance_without_a_probability_is_refused(changes, message) -> None:
    with pytest.raises(tod.SettingsError, match=message):
        tod.acquisition_range("low_light", **FACE | changes)


def test_turbulence_shortens_a_range_and_is_that_of_its_own_path(tmp_path) -> None:
    file = tmp_path / "hazy.toml"
    own = ss.load_sensor(PRESET)
    file.write_text(
        ss.new_sensor(preset=PRESET) + "\n[turbulence]\ncn2_m23 = 1e-12\npath_km = 2.0\n", encoding="utf-8"
    )
    assert ss.load_sensor(file).turbulence == ss.Turbulence(cn2_m23=1e-12, path_km=2.0)
    found = tod.acquisition_range(file, **THERMAL)
    assert [one.code for one in found.warnings] == ["turbulence_path"]
    # r₀ = 55.1 mm at 10 µm, so that the transfer at Nyquist is exp(−3.44 (1.46 / 5.51)^(5/3)) = 0.69.
    still = tod.acquisition_range(PRESET, **THERMAL)
    ratio = found.numbers.ranges[0].range_km / still.numbers.ranges[0].range_km
    assert 0.6 < ratio < 0.95 and own.turbulence is None
