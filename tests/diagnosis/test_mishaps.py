"""The recordings with mishaps are what they say, and none of them gets a confident wrong number."""

from __future__ import annotations

import math
import re
from pathlib import Path

import mishaps
import numpy as np
import pytest
import verdicts

CASE = {case.name: case for case in mishaps.CASES}
BACKGROUND_MATTERS = (*mishaps.CONTROLS, *mishaps.BACKGROUND_CASES)
GENERATOR = Path(mishaps.__file__)


@pytest.mark.parametrize("orientation", mishaps.ORIENTATIONS)
def test_triangle_has_its_area_its_place_and_its_apex(orientation: str) -> None:
    """Moments of an equilateral triangle."""
    shot = mishaps.Shot(number=0, orientation=orientation, contrast=1.0, x_px=40.3, y_px=50.8)
    covered = mishaps.triangle(shot)
    y, x = np.indices(covered.shape)
    area = covered.sum()
    # Chords are exact; of the 64 lines in a pixel, the one at the base may be half a line off.
    assert area == pytest.approx(shot.size_px**2, abs=mishaps.EDGE * shot.size_px / 128)
    assert [(covered * x).sum() / area, (covered * y).sum() / area] == pytest.approx([40.3, 50.8], abs=0.01)
    # The apex is two thirds of the height from the centroid, the base one third.
    height = math.sqrt(math.sqrt(3.0)) * shot.size_px
    reach = {
        "up": 50.8 - y[covered > 0].min(),
        "down": y[covered > 0].max() - 50.8,
        "left": 40.3 - x[covered > 0].min(),
        "right": x[covered > 0].max() - 40.3,
    }
    assert max(reach, key=reach.__getitem__) == orientation
    assert reach[orientation] == pytest.approx(2.0 * height / 3.0, abs=1.0)


def test_generator_shares_nothing_with_the_packages() -> None:
    names = set(re.findall(r"^\s*(?:from|import) (\w+)", GENERATOR.read_text(encoding="utf-8"), re.MULTILINE))
    assert "numpy" in names
    assert names.isdisjoint({"todframes", "sensor_sim"})


def test_there_are_enough_cases_each_with_its_own_name() -> None:
    assert len({case.name for case in mishaps.CASES}) == len(mishaps.CASES) >= 30 + len(mishaps.CONTROLS)


@pytest.mark.every_case
@pytest.mark.parametrize("name", ["vignetting_50", "dark_border", "two_levels_beside", "flicker"])
@pytest.mark.slow
def test_light_around_the_triangle_leaves_the_threshold(name: str, tmp_path: Path) -> None:
    """With the background taken from around the triangle, and 3 % as for every case."""
    CASE[name].recording.write(tmp_path / name)
    CASE[name].recording.declare(tmp_path / name, "surround")
    found = verdicts.score(tmp_path / name)
    assert found.threshold == pytest.approx(verdicts.right_threshold(), rel=verdicts.TOLERANCE)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASE)
def test_no_recording_gets_a_confident_wrong_number(name: str, tmp_path: Path) -> None:
    """Nor a warning or an error without need. The script verdicts.py tries all backgrounds of all cases."""
    case = CASE[name]
    found = verdicts.outcomes(case, tmp_path / name, None if case in BACKGROUND_MATTERS else case.rules[-1:])
    ends = {rule: verdicts.verdict(case, outcome) for rule, outcome in found.items()}
    assert not set(ends.values()).intersection(verdicts.BAD_ENDS), (ends, found)
