"""Thresholds of a sensor at an unknown place: against scored frames whose places hold noise of their own."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.sensor import load_sensor
from todframes.frames.files import read_frame, write_frame

CAMERA = Path("sample_frames/staring_camera.toml")
SIZE, PLACES = 6.0, 4


def camera() -> ss.Sensor:
    """The camera without a fixed pattern, of which all frames of a simulation show the same piece."""
    found = load_sensor(CAMERA)
    return replace(found, noise=replace(found.noise, fixed_pattern_ratio=0.0))


@pytest.fixture(scope="module")
def threshold() -> tod.Result:
    return ss.curve(camera(), size_detectors=[SIZE], places=PLACES, tolerance=0.02, examples=False)


def rows_of(path: Path) -> list[dict[str, str]]:
    with (path / "manifest.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_frames_with_four_places_have_75_per_cent_at_the_threshold(threshold: tod.Result, tmp_path: Path) -> None:
    """Each frame is four simulated ones side by side, three of them with a triangle a thousand times fainter."""
    (found,) = threshold.thresholds
    sensor = camera()
    faint = replace(sensor, display=replace(sensor.display, gain=sensor.display.gain / 1000.0))
    for name, seen, snr, trials, seed in (
        ("shown", sensor, found.threshold, 40, 1),
        ("empty", faint, found.threshold / 1000.0, 120, 2),
    ):
        ss.simulate(seen, size_detectors=[SIZE], snr=[snr], trials=trials, rng=seed, out=tmp_path / name)
    out = tmp_path / "tiled"
    (out / "frames").mkdir(parents=True)
    text = (tmp_path / "shown" / "dataset.toml").read_text(encoding="utf-8")
    (out / "dataset.toml").write_text(f"{text}places = {PLACES}\n", encoding="utf-8")
    empty = [read_frame(tmp_path / "empty" / row["frame"]).values[..., 0] for row in rows_of(tmp_path / "empty")]
    rows = []
    for number, row in enumerate(rows_of(tmp_path / "shown")):
        tiles = empty[3 * number : 3 * number + 3]
        tiles.insert(number % PLACES, read_frame(tmp_path / "shown" / row["frame"]).values[..., 0])
        write_frame(out / f"frames/{number}.exr", np.block([tiles[:2], tiles[2:]]))
        side, down, right = len(tiles[0]), *divmod(number % PLACES, 2)
        row = {key: value for key, value in row.items() if key != "sha256"} | {"frame": f"frames/{number}.exr"}
        row["x_px"], row["y_px"] = (
            str(float(row[key]) + k * side) for key, k in (("x_px", right), ("y_px", down))
        )
        rows.append(row | {"place": str(number % PLACES + 1), "place_step_px": str(side)})
    with (out / "manifest.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    scored = tod.score(out, fit=tod.FitSettings(resamples=0), examples=False)
    p = np.array([one["p_correct"] for one in scored.trials.records])
    # Trials differ by their noise: the error of their mean follows from their spread.
    assert p.mean() == pytest.approx(0.75, abs=3.0 * p.std(ddof=1) / np.sqrt(len(p)))
    assert p.std(ddof=1) / np.sqrt(len(p)) < 0.06


@pytest.mark.parametrize(
    ("places", "changes", "message"),
    [
        (0, {}, "places: found 0, expected a whole number from 1 to 4096"),
        (4, {"row_noise_ratio": 0.5}, "places: found 4 with noise that rows or columns have in common"),
    ],
)
def test_places_that_are_no_curve(places: int, changes: dict[str, float], message: str) -> None:
    sensor = replace(camera(), noise=replace(camera().noise, **changes))
    with pytest.raises(tod.SettingsError, match=message):
        ss.curve(sensor, size_detectors=[SIZE], places=places)
