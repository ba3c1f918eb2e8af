"""Images with exact answers: their truths against sums, drawn answers and the measurement of the MTF."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import todframes as tod
from todframes.studies.exact import NOISE_SD, edge_picture


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("exact") / "made"
    assert tod.sample(out, exact=True) == {"edges": 12, "triangles": 960}
    return out


def truths(folder: Path) -> list[dict[str, str]]:
    with (folder / "truths.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize(("angle_deg", "sigma_px"), [(7.0, 0.0), (11.0, 0.8)])
def test_a_pixel_is_the_mean_of_a_blurred_step(angle_deg, sigma_px):
    """Sums of 40 × 40 samples of each pixel; the step between them makes errors of 1 / 40² of a crossed row."""
    fine, side = 40, 24
    y, x = (np.mgrid[: side * fine, : side * fine] + 0.5) / fine - side / 2
    distance = math.cos(math.radians(angle_deg)) * x + math.sin(math.radians(angle_deg)) * y
    step = np.clip(distance * fine + 0.5, 0.0, 1.0)
    blurred = gaussian_filter(step, sigma_px * fine) if sigma_px else step
    summed = blurred.reshape(side, fine, side, fine).mean(axis=(1, 3))
    middle = slice(80 - side // 2 + 4, 80 + side // 2 - 4)
    np.testing.assert_allclose(edge_picture(angle_deg, sigma_px)[middle, middle], summed[4:-4, 4:-4], atol=2e-4)


def test_the_mtf_is_measured_as_the_table_has_it(made):
    for row in truths(made / "edges"):
        measured = tod.mtf(made / "edges" / row["file"]).mtf
        at = np.array([float(name[4:]) for name in row if name.startswith("mtf_")])
        truth = np.array([float(row[f"mtf_{f:g}"]) for f in at])
        # The bias that the page on validation states is 0.3 % of full contrast.
        assert np.abs(np.interp(at, measured.frequency, measured.mtf) - truth).max() < 0.004, row["file"]


def test_a_matched_filter_is_right_at_the_threshold_in_three_of_four(made):
    """The ideal observer in four lines: the triangle whose inner product with the frame is the largest."""
    for row in truths(made / "triangles"):
        side, middle, size = 64, 31.5, float(row["size_px"])
        place = {"x_px": middle, "y_px": middle, "centre": row["centre"]}
        shapes = [tod.coverage((side, side), size_px=size, orientation=one, **place) for one in tod.ORIENTATIONS]
        templates = np.array(shapes)
        rng = np.random.default_rng(4)
        n = 2000
        noise = rng.normal(0.0, NOISE_SD, (n, side * side))
        shown = np.arange(n) % 4
        seen = float(row["threshold_contrast"]) * templates.reshape(4, -1)[shown] + noise
        right = np.mean((seen @ templates.reshape(4, -1).T).argmax(axis=1) == shown)
        assert right == pytest.approx(0.75, abs=3.5 * math.sqrt(0.75 * 0.25 / n)), row
        # With many pixels it is 3.1445 (centroid) or 2.5890 (bounding box) times the noise over √area.
        limit = {"centroid": 3.1445, "bounding_box": 2.5890}[row["centre"]] * NOISE_SD / size
        assert 1.0 < float(row["threshold_contrast"]) / limit < 1.0 + 2.5 / size
