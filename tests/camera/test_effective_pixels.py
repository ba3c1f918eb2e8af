"""MTF10, the limit of resolution and effective pixels of films, tables and sensors, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from edges import diffraction, edge_image, gaussian, true_mtf
from scipy.optimize import brentq

import sensor_sim as ss
import todframes as tod
from todframes.observers.interface import resolve_observer

SINC_10 = brentq(lambda f: np.sinc(f) - 0.1, 0.5, 1.0)
"""Frequency in cycles/pixel at which a square pixel alone passes 10 %."""


STAR_LIKE = ss.load_sensor("sample_frames/star_like.toml")
OBSERVER = resolve_observer("pyramid", lambda: 50.0)[0]


@pytest.mark.parametrize("sigma_px", [0.7, 0.4])
def test_a_film_has_the_mtf10_of_its_closed_form_within_the_interval(sigma_px):
    optics, shape = gaussian(sigma_px), (96, 128)
    image = edge_image(shape, 6.0, optics) + np.random.default_rng(1).normal(0.0, 0.003, shape)
    found = tod.mtf(image, boxes=[(0, 0, 128, 96)]).mtf
    mtf10 = brentq(lambda f: float(true_mtf(f, optics, 6.0)) - 0.1, 0.2, 1.0)
    low, high = found.mtf10_ci95
    assert low < mtf10 < high < 1.1 * low
    ends = [min(end, 0.5) for end in (low, high)]
    assert found.resolution_limit_cyc_per_pixel_ci95 == pytest.approx(ends)
    assert 2.0 * ends[0] * 128 <= found.effective_width_px <= 2.0 * ends[1] * 128
    aliased = found.aliased_from_cyc_per_pixel
    assert aliased is None if mtf10 <= 0.5 else aliased == pytest.approx(1.0 - found.mtf10)


def test_a_pattern_at_mtf10_beyond_nyquist_appears_where_it_is_said():
    """Square pixels that see a sine of this frequency have a tenth of its amplitude, at the stated frequency."""
    n = 1000
    f = round(SINC_10 * n) / n  # whole periods
    edges = np.arange(n + 1)
    pixels = np.diff(-np.cos(2 * np.pi * f * edges)) / (2 * np.pi * f)
    spectrum = np.abs(np.fft.rfft(pixels)) * 2 / n
    camera = ideal(pitch_mrad=0.2)
    found = ss.mtf(camera)
    assert spectrum.argmax() / n == pytest.approx(found.aliased_from_cyc_per_mrad * 0.2, abs=1e-3)
    assert spectrum.max() == pytest.approx(0.1, abs=2e-3)  # f was rounded
    assert found.resolution_limit_cyc_per_mrad == pytest.approx(0.5 / 0.2)
    assert found.mtf10_cyc_per_mrad == pytest.approx(SINC_10 / 0.2, rel=1e-4)


def ideal(*, pitch_mrad: float, width_mrad: float | None = None, aperture_mm: float = 1e5) -> ss.Sensor:
    return ss.Sensor(
        optics=ss.Optics(aperture_mm=aperture_mm, wavelength_um=1.0),
        detector=ss.Detector(pitch_mrad=pitch_mrad, width_mrad=width_mrad or pitch_mrad),
        display=STAR_LIKE.display,
    )


def test_a_lens_that_limits_has_the_closed_form_of_its_aperture():
    found = ss.mtf(ideal(pitch_mrad=0.2, aperture_mm=2.0, width_mrad=1e-3))  # 2 cycles/mrad, Nyquist at 2.5
    limit = brentq(lambda f: float(diffraction(2.0).mtf(f)) - 0.1, 1.0, 2.0)
    assert found.resolution_limit_cyc_per_mrad == pytest.approx(limit, rel=1e-4)
    assert found.aliased_from_cyc_per_mrad is None
    assert any("100 pixels are 64.4 effective" in one for one in found.sentences())


@pytest.mark.parametrize(
    ("unit", "rows", "expected"),
    [
        # Of other units no pixel is known; of a table that ends before, nothing.
        ("cyc_per_mrad", ("0,1", "1,0.4", "2,0"), (1.75, None, None)),
        ("cyc_per_pixel", ("0,1", "0.2,0.4", "0.3,0.2"), (None, None, None)),
        ("cyc_per_pixel", ("0,1", "0.6,0.4"), (None, 0.5, None)),
        ("cyc_per_pixel", ("0,1", "0.5,0.3", "0.9,0"), (0.5 + 0.4 * 2 / 3, 0.5, 0.5 - 0.4 * 2 / 3)),
        ("cyc_per_pixel", ("0,1", "1,0.3", "2,0"), (1.0 + 2 / 3, 0.5, 0.0)),
    ],
)
def test_a_table_has_the_numbers_that_it_can(tmp_path, unit, rows, expected):
    path = tmp_path / "mtf.csv"
    path.write_text("\n".join([f"frequency_{unit},mtf", *rows]) + "\n")
    result = tod.mtf(path)
    found = result.mtf
    numbers = (found.mtf10, found.resolution_limit_cyc_per_pixel, found.aliased_from_cyc_per_pixel)
    assert numbers == tuple(one if one is None else pytest.approx(one) for one in expected)
    assert found.effective_width_px is None and found.mtf10_ci95 is None
    assert any("effective" in one for one in result.sentences()) is (expected[1] is not None)


def test_acuity_is_that_of_a_line_through_many_sizes():
    """The page on the paper has 3.11 ± 0.02 detectors, with finer lattices and nine sizes about the acuity."""
    found = ss.advise(STAR_LIKE, tolerance=0.1)
    # P(correct) rises with the size in waves, as edges of the triangle pass those of detectors: 1 % of the size.
    assert 1.0 < found.acuity_detectors / 3.11 < 1.02 + 0.01 + 0.02 / 3.11
    assert found.acuity_mrad == pytest.approx(found.acuity_detectors * STAR_LIKE.pitch_mrad)
    assert any(one.startswith("The acuity is 3.1") for one in found.findings())


def test_a_curve_ends_with_what_limits_it():
    noisy = ss.curve(STAR_LIKE, size_detectors=[6], tolerance=0.05, examples=False)
    assert noisy.limits[0].startswith("Detector noise limits")
    n_frames = STAR_LIKE.noise.frames_integrated
    shown = f"of 1 on 50.0 cd/m²; a detector is 4.29 mrad wide at the eye, which averages {n_frames} frames."
    assert shown in noisy.viewing
    assert noisy.advice() == [
        *noisy.limits,
        noisy.viewing,
        "`sensor-sim advise` states which number of the sensor buys most.",
    ]
