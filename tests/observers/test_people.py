"""Thresholds for images: two intervals, and one of four, against closed forms; rings against their area."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from people_tasks import (
    activity_of,
    detection_d_prime,
    gabor,
    identification_threshold,
    intrinsic_blur,
    landolt_ring,
    people_acuity,
    resolution_limit,
    triangle_acuity,
)

from todframes.base.errors import SettingsError
from todframes.base.reading import read_numbers
from todframes.observers.csf import CsfObserver
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.naked_eye import contrast_threshold
from todframes.stimulus import ORIENTATIONS, coverage

MRAD_PER_DEG = 17.453293


def test_identified_triangles_have_the_threshold_of_the_naked_eye() -> None:
    """The triangles of `naked-eye` as images on the retina's own samples: only the field differs, by 1e-3."""
    observer, side = CsfObserver(), 161
    images = [
        coverage((side, side), size_px=30.0, x_px=side // 2, y_px=side // 2, orientation=apex)
        for apex in ORIENTATIONS
    ]
    seen = [activity_of(observer, np.ascontiguousarray(image), 0.1) for image in images]
    expected = contrast_threshold(observer, size_mrad=3.0).threshold
    assert identification_threshold(observer, seen) == pytest.approx(expected, rel=1e-3)


def test_detection_of_a_gaussian_has_a_closed_form() -> None:
    """A blob much wider than the filter's kernel is seen with the sensitivity at 0, 0.1507 of the gain.

    Through the aperture, its integrated square is π s², with 1/s² = 1/σ² + 1/0.35². At σ = 3° the sensitivity
    over its spectrum, exp(−2π²σ²f²), is that at 0 within 2 %: its frequencies are below 0.1 cycles/degree.
    """
    sigma, pitch_deg, side = 3.0, 0.2 / MRAD_PER_DEG, 513
    place = (np.arange(side) - side // 2) * pitch_deg
    blob = np.exp(-np.add.outer(place**2, place**2) / (2.0 * sigma**2))
    observer = CsfObserver(retina_pitch_mrad=0.2)
    found = detection_d_prime(observer, activity_of(observer, blob, 0.2))
    expected = 1.406 * 509.37 * 0.1507 * math.sqrt(math.pi / (1.0 / sigma**2 + 1.0 / 0.35**2))
    assert found == pytest.approx(expected, rel=0.02)


def test_noise_in_the_images_adds_its_variance() -> None:
    """White noise of the retina's own samples: its variance in the score is that of the folded weights."""
    observer, rng = PyramidObserver(), np.random.default_rng(0)
    signal = np.zeros((33, 33))
    signal[14:19, 14:19] = 1.0
    seen = activity_of(observer, signal, 0.153)
    quiet = detection_d_prime(observer, seen)
    noise = [activity_of(observer, 0.5 * rng.normal(size=(33, 33)), 0.153) for _ in range(400)]
    basis = np.eye(33 * 33).reshape(-1, 33, 33)
    weights = [
        sum(float(np.vdot(a, b)) for a, b in zip(seen, activity_of(observer, one, 0.153), strict=True))
        for one in basis[::4]
    ]
    energy = sum(float(np.vdot(band, band)) for band in seen)
    variance = observer.settings.noise_sd**2 * energy + 0.25 * 4.0 * float(np.square(weights).sum())
    assert quiet == pytest.approx(math.sqrt(energy) / observer.settings.noise_sd, rel=1e-12)
    # 400 draws: 3.5 % of the standard deviation; every fourth sample stands for all: 10 %.
    assert detection_d_prime(observer, seen, noise) == pytest.approx(energy / math.sqrt(variance), rel=0.2)


def test_images_that_are_the_same_are_never_identified() -> None:
    observer = PyramidObserver()
    seen = activity_of(observer, np.ones((9, 9)), 0.153)
    with pytest.raises(SettingsError, match="images: found none that is identified"):
        identification_threshold(observer, [seen] * 4)


def test_a_ring_covers_its_area() -> None:
    """π (2.5² − 1.5²) gaps less the gap, 1 × 1 and the arcs' caps, which are below 3 % of it."""
    gap = 12.0
    ring = landolt_ring(64, gap_px=gap)
    assert ring.sum() == pytest.approx(gap**2 * (4.0 * math.pi - 1.0), rel=0.01)
    assert ring[32, 32 + int(2.0 * gap)] == 0.0 and ring[32, 32 - int(2.0 * gap)] == 1.0
    assert np.array_equal(landolt_ring(64, gap_px=gap, quarter_turns=1), np.rot90(ring, -1))


def test_people_see_rings_as_the_table_of_the_formula() -> None:
    """Decimal acuity at 30 cd/m², by other code."""
    found = [people_acuity(contrast=c, luminance_cd_m2=30.0) for c in (1.0, 0.3, 0.1, 0.05, 0.03)]
    assert found == pytest.approx([1.585, 0.947, 0.578, 0.418, 0.327], abs=5e-4)


def test_csf_needs_one_factor_for_rings_of_any_contrast() -> None:
    """1 dB over 1.5 decades is asked for; it is 0.88 dB. The pyramid's ratios spread by 8 dB."""
    spread = []
    for observer in (CsfObserver(), PyramidObserver()):
        ratios = []
        for contrast in (1.0, 0.3, 0.1, 0.05, 0.03):
            gap_mrad = MRAD_PER_DEG / 60.0 / people_acuity(contrast=contrast, luminance_cd_m2=30.0)
            rings = [landolt_ring(56, gap_px=8.0, quarter_turns=k) for k in range(4)]
            seen = [activity_of(observer, ring, gap_mrad / 8.0) for ring in rings]
            ratios.append(identification_threshold(observer, seen) / contrast)
        spread.append(float(np.std(20.0 * np.log10(ratios), ddof=1)))
    assert spread[0] < 1.0 < 5.0 < spread[1]


def test_the_acuity_for_triangles_is_that_of_the_naked_eye_and_scales_with_the_retina() -> None:
    """A pyramid of twice the pitch sees triangles and blurs of twice the size alike, to the digits of the search.

    Triangles of 16 pixels are within 1 % of sharp ones.
    """
    csf = CsfObserver()
    assert contrast_threshold(csf, size_mrad=triangle_acuity(csf)).threshold == pytest.approx(1.0, rel=0.01)
    fine, coarse = PyramidObserver(), PyramidObserver(retina_pitch_mrad=0.306)
    seen = [triangle_acuity(fine, blur_mrad=0.5), triangle_acuity(coarse, blur_mrad=1.0) / 2.0]
    assert seen[0] == pytest.approx(seen[1], rel=0.01)
    assert seen[0] > triangle_acuity(fine)


def test_the_intrinsic_blur_of_its_own_formula() -> None:
    blurs = np.array([0.0, 0.4, 0.8, 1.6, 3.2])
    assert intrinsic_blur(blurs, 1.2 * np.hypot(1.0, blurs / 1.7)) == pytest.approx((1.2, 1.7), rel=1e-6)


def test_a_fine_grating_has_a_closed_form() -> None:
    """Envelope times aperture is a Gaussian, 1/s² = 1/σ² + 1/0.35²; its square times cos² integrates to π s²/2.

    The filter hardly changes over its spectrum, 0.5 cycles/degree wide. The sensitivity at 47 cycles/degree is the
    published formula's; `test_light` has the ratio in light. Beside the axis the oblique effect takes 0.01 %.
    """
    sensitivity = 1.0 / math.cosh((47.0 / 4.1726) ** 0.7786)
    for sd in (0.33, 1.0):
        squared = 1.0 / (1.0 / sd**2 + 1.0 / 0.35**2)
        expected = 1.406 * 509.37 * 4.0 / math.pi * 0.913 * sensitivity * math.sqrt(math.pi * squared / 2.0)
        observer = CsfObserver()
        assert detection_d_prime(observer, gabor(observer, 47.0, sd_deg=sd)) == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
def test_the_finest_grating_is_that_of_people() -> None:
    """Medians of 18, 16 and 16 people; the limit of `csf` lies within one of their SDs for any envelope and
    criterion, and falls with the light as people's acuity for rings does, to 1.5 %.
    """
    folder = Path(__file__).parents[2] / "docs" / "evidence" / "people"
    rows = np.array(read_numbers(folder / "resolution_limit.csv", ["eccentricity_deg", "pixels_per_deg"]))
    people = {degrees: rows[rows[:, 0] == degrees, 1] for degrees in (0.0, 10.0, 20.0)}
    assert [len(group) for group in people.values()] == [18, 16, 16]
    assert [np.median(group) for group in people.values()] == pytest.approx([94.0, 41.4, 20.9], abs=0.05)
    lit, dim = CsfObserver(luminance_cd_m2=100.0), CsfObserver(luminance_cd_m2=30.0)
    found = [2.0 * resolution_limit(lit, sd_deg=sd, d_prime=d) for sd in (0.33, 1.0) for d in (1.406, 1.092)]
    assert np.abs(np.array(found) - np.median(people[0.0])).max() < np.std(people[0.0], ddof=1)
    acuities = [people_acuity(contrast=1.0, luminance_cd_m2=light) for light in (100.0, 30.0)]
    limits = [resolution_limit(observer, sd_deg=0.5, d_prime=1.406) for observer in (lit, dim)]
    assert limits[1] / limits[0] == pytest.approx(acuities[1] / acuities[0], rel=0.015)
    # The paper's pyramid sees it 50 dB better; with few samples a degree the limit disappears for csf too.
    assert detection_d_prime(PyramidObserver(), gabor(PyramidObserver(), 47.0, sd_deg=0.5)) > 400.0
    aliased = [detection_d_prime(lit, gabor(lit, 80.0, sd_deg=0.5, samples_per_deg=n)) for n in (1200, 240)]
    assert aliased[0] < 0.1 < 1.4 < aliased[1]


@pytest.mark.slow
def test_documented_sharpening_is_what_the_observers_say(capsys) -> None:
    page = (Path(__file__).parents[2] / "docs" / "explanation" / "enhancement.md").read_text(encoding="utf-8")
    code, printed = (
        re.search(rf"^```{kind} sharpening\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)[1]
        for kind in ("python", "text")
    )
    exec(code, {})
    assert capsys.readouterr().out == printed
