"""What the detectors of a row or column have in common: parts, thresholds against brute force, and measurement."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.camera import resolve
from sensor_sim.chain.noise import (
    displayed_noise,
    unit_fixed_pattern,
)
from sensor_sim.chain.sensor import Noise, sensor_from, sensor_tables
from sensor_sim.thresholds.curve_plan import full_plan, line_covariance, plan_curve
from todframes.base.errors import SettingsError
from todframes.observers.pyramid import PyramidObserver

LINES = Noise(
    distribution="gaussian",
    netd_mk=20.0,
    fixed_pattern_ratio=0.5,
    frames_integrated=3,
    row_noise_ratio=0.4,
    row_pattern_ratio=0.3,
    column_pattern_ratio=0.35,
)
STAR = Path(__file__).parents[2] / "sample_frames" / "star_like.toml"


def test_drawn_lines_are_their_parts() -> None:
    # New in each frame: 1.2 of each of 400 rows and 1.6 of each of 300 columns, to 4 and 5 %, and nothing else.
    lines = Noise(distribution="gaussian", row_noise_ratio=0.6, column_noise_ratio=0.8)
    rng = np.random.default_rng(1)
    drawn = displayed_noise(
        unit_fixed_pattern((400, 300), noise=lines, seed=1), total_sd=2.0, noise=lines, rng=rng
    )
    np.testing.assert_allclose(drawn - drawn[:1] - drawn[:, :1] + drawn[0, 0], 0.0, atol=1e-7)
    assert (drawn[:, 0].std(), drawn[0].std()) == pytest.approx((1.2, 1.6), rel=0.15)
    # Without noise of its own, a frame is the sensor's pattern, in parts of 0.48, 0.6 and 0.64.
    still = Noise(fixed_pattern_ratio=1e9, row_pattern_ratio=0.6e9, column_pattern_ratio=0.64e9)
    pattern = unit_fixed_pattern((4, 6), noise=still, seed=1)
    image = displayed_noise(pattern, total_sd=2.0, noise=still, rng=rng)
    by_hand = 2.0 * (0.48 * pattern.own + 0.6 * pattern.rows + 0.64 * pattern.columns)
    np.testing.assert_allclose(image, by_hand, atol=1e-8)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"row_noise_ratio": 0.8, "column_noise_ratio": 0.7}, "row_noise_ratio, column_noise_ratio: found 1.063"),
        ({"row_noise_ratio": 1.2}, "row_noise_ratio: found 1.2, expected a number from 0 to 1"),
        ({"row_pattern_ratio": 0.6}, "column_pattern_ratio: found 0.694622 .*at most fixed_pattern_ratio"),
        ({"column_pattern_ratio": -0.1}, "column_pattern_ratio: found -0.1"),
    ],
)
def test_lines_that_are_more_than_the_noise_are_refused(change, problem) -> None:
    with pytest.raises(SettingsError, match=problem):
        replace(LINES, **change)


def thermal(noise: Noise) -> ss.Sensor:
    return replace(ss.load_sensor(STAR), noise=noise)


def dense_covariance(field: int, own: float, row: float, column: float) -> np.ndarray:
    """Covariance of all samples of a field with each other, (field², field²), by the places of each pair."""
    rows, columns = (one.ravel() for one in np.indices((field, field)))
    same_row, same_column = rows[:, None] == rows, columns[:, None] == columns
    return own * (same_row & same_column) + row * same_row + column * same_column


def test_noise_of_scores_is_that_of_all_pairs_of_detectors() -> None:
    weights = np.random.default_rng(2).normal(size=(3, 4, 81))
    noise = replace(LINES, row_noise_ratio=0.8, column_pattern_ratio=0.2)
    plan = full_plan(resolve(thermal(noise)), PyramidObserver(), 6.0)
    # The paper's formulas by hand: 3 frames, a fixed pattern of 0.5, and the ratios of rows and columns.
    total = 1.0 / 3.0 + 0.25
    row, column = (0.64 / 3.0 + 0.09) / total, 0.04 / total
    brute = weights @ dense_covariance(9, 1.0 - row - column, row, column) @ weights.swapaxes(1, 2)
    np.testing.assert_allclose(plan.noise(weights), brute, rtol=1e-12, atol=1e-12)
    for found, shares in zip(line_covariance(weights), ((0, 1, 0), (0, 0, 1)), strict=True):
        brute = weights @ dense_covariance(9, *shares) @ weights.swapaxes(1, 2)
        np.testing.assert_allclose(found, brute, rtol=1e-12, atol=1e-12)


def test_alike_rows_and_columns_need_one_orientation_and_others_all_four() -> None:
    for noise, n in (
        (Noise(), 1),
        (Noise(row_noise_ratio=0.6), 4),
        (Noise(row_noise_ratio=0.6, column_noise_ratio=0.6), 1),
    ):
        plan = plan_curve(resolve(thermal(noise)), PyramidObserver(), 6.0, tolerance=0.02)
        assert len(plan.orientations) == n


def test_measured_lines_come_back_from_the_file() -> None:
    rng = np.random.default_rng(5)
    frames = 1000.0 + rng.normal(0, 1.0, (1, 60, 1)) + rng.normal(0, 1.5, (60, 60))
    frames = frames + rng.normal(0, 0.8, (40, 60, 1)) + rng.normal(0, 2.0, (40, 60, 60))
    found = tod.noise(frames, mk_per_count=10.0)
    tables = sensor_tables(ss.load_sensor(STAR)) | {"schema": 1} | tomllib.loads(found.sensor_toml())
    noise = sensor_from(tables, "x")
    dynamic = math.hypot(0.8, 2.0)
    # 40 · 59 values give the rows of frames to 1.5 %, 60 rows their pattern to 9 %.
    assert noise.noise.row_noise_ratio == pytest.approx(0.8 / dynamic, rel=0.06)
    assert noise.noise.row_pattern_ratio == pytest.approx(1.0 / dynamic, rel=0.3)
    assert noise.noise.column_noise_ratio == noise.noise.column_pattern_ratio == 0.0
