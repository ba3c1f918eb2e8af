"""Detector samples against integration in space, conservation of area, symmetries and exact limits."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from repetition import wrap_around_bound
from scipy.special import j0, j1

from sensor_sim.chain import sampling
from sensor_sim.chain.camera import Camera, resolve
from sensor_sim.chain.new_sensor import DISPLAY
from sensor_sim.chain.sampling import TriangleSampler, sample_image
from sensor_sim.chain.sensor import Detector, Optics, Sensor
from todframes.base.errors import SettingsError
from todframes.stimulus import ORIENTATIONS, Orientation, coverage, vertices

PITCH_MRAD = 0.25


def optics_of(cut_off: float, sigma: float = 0.0) -> Optics:
    """Cut-off in cycles per detector, blur in detectors."""
    return Optics(aperture_mm=cut_off / PITCH_MRAD, wavelength_um=1.0, blur_sigma_mrad=sigma * PITCH_MRAD)


def camera_of(cut_off: float, sigma: float = 0.0, width: float = 1.0) -> Camera:
    detector = Detector(pitch_mrad=PITCH_MRAD, width_mrad=width * PITCH_MRAD)
    return resolve(Sensor(optics=optics_of(cut_off, sigma), detector=detector, display=DISPLAY))


def sampler_of(cut_off, sigma=0.0, width=1.0, *, size=2.0, field=8, period=None) -> TriangleSampler:
    return TriangleSampler(camera_of(cut_off, sigma, width), size, field, period)


def image_samples(image, cut_off, width=1.0, *, pitch=PITCH_MRAD, field=8, x=0.0, y=0.0) -> np.ndarray:
    return sample_image(
        image,
        pixel_pitch_mrad=pitch,
        camera=camera_of(cut_off, width=width),
        field_detectors=field,
        x_detectors=x,
        y_detectors=y,
    )


def point_spread(radius, cut_off, sigma):
    """Volume 1; by the Hankel transform of the transfer function, which is the Airy pattern without blur."""
    if sigma == 0.0:
        v = np.pi * cut_off * np.maximum(radius, 1e-9)
        return np.pi * cut_off**2 * np.square(j1(v) / v)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    # Beyond 1.4/σ the Gaussian is below 2e-17; sin θ takes the root out of the cut-off.
    theta = (nodes + 1.0) / 2.0 * np.arcsin(min(1.0, 1.4 / sigma / cut_off))
    x = np.sin(theta)
    mtf = (
        2.0 / np.pi * (np.arccos(x) - x * np.sqrt(1.0 - x**2)) * np.exp(-2.0 * (np.pi * sigma * cut_off * x) ** 2)
    )
    measure = weights / 2.0 * theta[-1] / (nodes[-1] + 1.0) * 2.0 * np.cos(theta) * cut_off**2 * x
    # The pattern is smooth on the scale of 1/cut-off: 150 Chebyshev terms over the range reach rounding.
    largest = float(radius.max()) * 1.01
    knots = largest / 2.0 * (1.0 + np.cos(np.pi * (np.arange(150) + 0.5) / 150))
    values = 2.0 * np.pi * j0(2.0 * np.pi * cut_off * np.outer(knots, x)) @ (mtf * measure)
    fit = np.polynomial.Chebyshev.fit(knots, values, 149, domain=[0.0, largest])
    return fit(radius)


def integrated_sample(detector_xy, *, cut_off, sigma, width, size, orientation, x, y, n=28, m=14) -> float:
    """One detector's mean of a **single** triangle behind the optics: Gauss rules over triangle and detector."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    s, w = (nodes + 1.0) / 2.0, weights / 2.0
    a, b, c = vertices(size=size, orientation=orientation, x=x, y=y)
    inside = a + s[:, None, None] * ((b - a) + s[None, :, None] * (c - b))
    area = (w * s)[:, None] * w * 2.0 * size**2
    nodes, weights = np.polynomial.legendre.leggauss(m)
    offset, share = nodes * width / 2.0, weights / 2.0
    dx = inside[..., 0, None] - (detector_xy[0] + offset)
    dy = inside[..., 1, None] - (detector_xy[1] + offset)
    psf = point_spread(np.hypot(dx[..., :, None], dy[..., None, :]), cut_off, sigma)
    return float(np.einsum("ij,ijab,a,b->", area, psf, share, share))


CASES = [
    # cut-off, blur and active width in detectors; period that makes repetition negligible
    (0.3, 0.0, 1.0, 240, Orientation.UP),
    (1.2, 0.15, 0.5, 160, Orientation.RIGHT),
    (2.0, 0.0, 1.0, 128, Orientation.DOWN),
    pytest.param(60.0, 0.3, 0.8, 48, Orientation.LEFT, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("cut_off", "sigma", "width", "period", "orientation"), CASES)
def test_samples_are_integrals_over_triangle_and_detector(cut_off, sigma, width, period, orientation):
    x, y, field = 0.31, -0.17, 8
    sampler = sampler_of(cut_off, sigma, width, field=field, period=period)
    samples = sampler.samples(x, y, orientation=orientation)[0]
    for row, column in [(3, 3), (3, 4), (4, 4), (2, 4), (5, 3), (0, 7)]:
        expected = integrated_sample(
            (column - 3.5, row - 3.5), cut_off=cut_off, sigma=sigma, width=width, size=2.0,
            orientation=orientation, x=x, y=y,
        )  # fmt: skip
        # 28 nodes over at most 6 periods of the pattern integrate to 1e-10; the rest is repetition, which its
        # bound covers.
        assert samples[row, column] == pytest.approx(expected, abs=wrap_around_bound(sampler) + 1e-9)
    assert wrap_around_bound(sampler) < 1e-6


def test_repetition_adds_no_more_than_its_bound():
    once = sampler_of(0.7, size=3.0, field=14, period=224)
    repeated = sampler_of(0.7, size=3.0, field=14, period=20)
    places = np.array([-0.5, -0.5, 0.2, 0.5]), np.array([-0.5, 0.5, 0.1, -0.3])
    added = repeated.samples(*places, orientation=Orientation.UP) - once.samples(
        *places, orientation=Orientation.UP
    )
    # Of the right size as well: cos² for 1 and the reach of all directions in each cost about ten times.
    assert wrap_around_bound(repeated) / 30 < np.abs(added).max() < wrap_around_bound(repeated)


# Rounding of some thousand terms of at most size² each.
AREA = {"rtol": 1e-12}


@settings(max_examples=30, deadline=None)
@given(
    st.floats(0.2, 6.0), st.sampled_from([0.0, 0.1, 0.4]), st.floats(0.5, 4.0),
    st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.sampled_from(ORIENTATIONS), st.integers(9, 14),
)  # fmt: skip
def test_contiguous_detectors_share_the_whole_area_at_any_place(cut_off, sigma, size, x, y, orientation, field):
    samples = sampler_of(cut_off, sigma, size=size, field=field).samples(x, y, orientation=orientation)
    np.testing.assert_allclose(samples.sum(), size**2, **AREA)


def test_what_falls_into_gaps_is_made_up_for_at_other_places():
    # Replicas at multiples of the sampling frequency 1 up to the cut-off 3.7: the mean of four by four places a
    # quarter apart contains those at multiples of 4 only, of which there are none but zero frequency.
    place = np.arange(4) / 4.0 + 0.03
    x, y = (axis.ravel() for axis in np.meshgrid(place, place))
    sums = sampler_of(3.7, width=0.4).samples(x, y, orientation=Orientation.RIGHT).sum(axis=(1, 2))
    np.testing.assert_allclose(sums.mean(), 4.0, **AREA)
    assert np.ptp(sums) > 0.01


# Different sums of the same terms, or other phases: a rounding of 2π · 100 cycles.
ROUNDING = {"rtol": 0.0, "atol": 2e-13}


@pytest.mark.parametrize("cut_off", [1.3, 1e9])
@pytest.mark.parametrize("field", [8, 9])
def test_a_turned_triangle_gives_turned_samples_bit_for_bit(cut_off, field):
    sampler = sampler_of(cut_off, width=0.7, field=field)
    upright = sampler.samples(0.2, -0.3, orientation=Orientation.UP)[0]
    # A clockwise quarter turn on the display carries (x, y), y down, into (−y, x).
    x, y = 0.2, -0.3
    for orientation in ORIENTATIONS:
        turned = sampler.samples(x, y, orientation=orientation)[0]
        np.testing.assert_array_equal(turned, np.rot90(upright, -orientation.quarter_turns))
        x, y = -y, x


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.integers(-4, 4), st.integers(-4, 4))
def test_moving_by_whole_detectors_moves_the_samples(x, y, columns, rows):
    here, there = SHARP.samples([x, x + columns], [y, y + rows], orientation=Orientation.DOWN)
    np.testing.assert_allclose(there, np.roll(here, (rows, columns), axis=(0, 1)), **ROUNDING)


SHARP = sampler_of(3.3, width=0.7, field=9)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("parts", [1, 3, 5])
def test_without_optics_samples_are_covered_areas(orientation, parts):
    # The active area is the middle one of parts² equal squares of the detector.
    x, y, field = 0.37, -0.21, 8
    sampler = sampler_of(1e9, width=1.0 / parts, size=2.3, field=field)
    fine = coverage(
        (field * parts, field * parts), size_px=2.3 * parts, orientation=orientation,
        x_px=(x + field / 2) * parts - 0.5, y_px=(y + field / 2) * parts - 0.5,
    )  # fmt: skip
    middle = fine[parts // 2 :: parts, parts // 2 :: parts]
    # Differences of squares of at most 4 pitches over the active area 1/parts².
    np.testing.assert_allclose(sampler.samples(x, y, orientation=orientation)[0], middle, atol=1e-13)
    assert sampler.neglected_bound < 1e-7
    assert wrap_around_bound(sampler) == 0.0


def test_ever_sharper_optics_approach_the_areas_within_the_bound(monkeypatch):
    monkeypatch.setattr(sampling, "MAX_NEGLECTED", 1.0)
    x, y = np.random.default_rng(2).uniform(-0.5, 0.5, (2, 50))
    for cut_off, sigma in [(10.0, 0.0), (40.0, 0.0), (40.0, 0.02)]:
        blurred = sampler_of(cut_off, sigma, 0.6, period=20).samples(x, y, orientation=Orientation.UP)
        with monkeypatch.context() as few:
            few.setattr(sampling, "MAX_FREQUENCIES", 0)
            sharp = sampler_of(cut_off, sigma, 0.6)
        difference = np.abs(sharp.samples(x, y, orientation=Orientation.UP) - blurred).max()
        # The bound is the worst for each displacement on its own; not ten times what happens.
        assert sharp.neglected_bound / 10 < difference < sharp.neglected_bound


def test_a_pixel_is_integrated_like_any_scene():
    # One bright pixel of 1/4 detector in a repeated field of 64 detectors.
    cut_off, n, x, y = 1.6, 256, 0.2, 0.1
    image = np.zeros((n, n))
    image[n // 2 + 1, n // 2 - 2] = 1.0
    samples = image_samples(image, cut_off, 0.7, pitch=PITCH_MRAD / 4, field=4, x=x, y=y)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    pixel = nodes / 8.0
    active = nodes * 0.35
    along_x = (x - 1.5 / 4 + pixel)[:, None] - active
    along_y = (y + 1.5 / 4 + pixel)[:, None] - active
    share = np.outer(weights / 2.0, weights / 2.0)
    for row, column in itertools.product((1, 2), (1, 2)):
        radius = np.hypot((along_y - (row - 1.5))[..., None, None], along_x - (column - 1.5))
        expected = np.einsum("ab,abcd,cd->", share, point_spread(radius, cut_off, 0.0), share) / 16.0
        # Repetition: area 1/16 · 2/(π³ c) · lattice sum 9.1 / 64³ = 9e-8.
        assert samples[row, column] == pytest.approx(expected, abs=1e-7)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"size": 0.0}, r"^size_detectors: found 0\.0, expected a finite number > 0$"),
        ({"size": float("nan")}, r"^size_detectors: found nan"),
        ({"size": 4.1}, r"^field_detectors: found 8, expected at least 9 for a triangle of size 4\.1 detectors$"),
        ({"period": 7}, r"^period_detectors: found 7, expected at least 8"),
        ({"cut_off": 0.12}, r"^optics\.aperture_mm: found 0\.48, which passes nothing .* 0\.96 cycles across its"),
        ({"sigma": 12.0}, r"^optics\.blur_sigma_mrad: found 3, which passes nothing .* 0\.95 cycles across its"),
        # √(2²² / 2) cycles in a period of 200 detectors.
        (
            {"cut_off": 20.0, "period": 200},
            r"found 80, which passes 20 cycles per detector, .* at most 7\.241",
        ),
    ],
)
def test_a_field_that_cannot_serve_is_refused(change, match):
    with pytest.raises(SettingsError, match=match):
        sampler_of(**({"cut_off": 1.0, "field": 8} | change))


@pytest.mark.parametrize(
    ("pitch", "field", "cut_off", "match"),
    [
        (0.0, 4, 1.0, r"^pixel_pitch_mrad: found 0\.0, expected a finite number > 0$"),
        (PITCH_MRAD, 11, 1.0, r"^field_detectors: found 11, expected at most the image's smaller side, 10 det"),
        (PITCH_MRAD, 10, 1e4, r"^image: the optics pass 2\.4e\+10 spatial frequencies .* at most 4\.2e\+06"),
    ],
)
def test_an_image_that_cannot_serve_is_refused(pitch, field, cut_off, match):
    with pytest.raises(SettingsError, match=match):
        image_samples(np.zeros((10, 12)), cut_off, pitch=pitch, field=field)
