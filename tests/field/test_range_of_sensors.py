"""The first tries of a new user with `todframes range`: each row has a number, or a limit that is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import error_line

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


@pytest.fixture(scope="module")
def few_sizes(tmp_path_factory) -> Path:
    """A curve that ends at 6 detectors, of a sensor that resolves 3."""
    out = tmp_path_factory.mktemp("few") / "curve"
    ss.curve(PRESET, size_detectors=[6, 10], tolerance=0.05, examples=False).save(out)
    return out


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
    (warning,) = of_preset.warnings
    assert warning.code == "tod_as_line_pairs"
    assert of_preset.sentences()[0].startswith("At 50 %, detection: limited by sampling: ")


def test_a_curve_with_few_sizes_has_the_same_ranges(of_preset, few_sizes) -> None:
    found = tod.acquisition_range(few_sizes, **THERMAL)
    ranges, others = ([one.range_km for one in each.numbers.ranges] for each in (found, of_preset))
    np.testing.assert_allclose(ranges, others, rtol=1e-12)  # the same sizes of the same sensor


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
    assert "tod_as_line_pairs" in [one.code for one in found.warnings]


def test_a_sensor_is_one_curve(todframes) -> None:
    error = error_line(
        todframes("range", PRESET, "--target", "nato", "--atmosphere", "lwir_23km", "--magnification", "2"), 2
    )
    assert "is one curve in the field, expected no group and no magnification" in error


def test_a_slip_in_a_preset_s_name_lists_the_presets(todframes) -> None:
    error = error_line(todframes("range", "uncooled_lwri", "--target", "nato", "--atmosphere", "lwir_23km"))
    assert "uncooled_lwri: no such file, and not one of the presets cooled_mwir, star_like" in error
