"""Triangles: exact coverage against rational arithmetic, closed-form spectrum against geometry."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from overlaps import clipped

from todframes.base.errors import SettingsError
from todframes.stimulus import (
    HEIGHT_PER_SIZE,
    ORIENTATIONS,
    SIDE_PER_SIZE,
    Orientation,
    bounding_box_offset,
    coverage,
    spectrum,
    vertices,
)

orientations = st.sampled_from(ORIENTATIONS)


def clipped_area(corners: list[tuple[Fraction, Fraction]], row: int, column: int) -> Fraction:
    """Area of a polygon within a pixel, in rational numbers."""
    for axis, middle in enumerate((column, row)):
        for sign in (1, -1):
            corners = clipped(corners, axis, middle - sign * Fraction(1, 2), sign)
    after = corners[1:] + corners[:1]
    return abs(sum((p[0] * q[1] - q[0] * p[1] for p, q in zip(corners, after, strict=True)), Fraction(0))) / 2


def test_published_proportions() -> None:
    assert pytest.approx(1.519671, abs=5e-7) == SIDE_PER_SIZE
    assert pytest.approx(1.316074, abs=5e-7) == HEIGHT_PER_SIZE


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_apex_points_where_the_name_says(orientation: Orientation) -> None:
    apex, *base = vertices(size=2.0, orientation=orientation)
    x, y = {"up": (0, -1), "right": (1, 0), "down": (0, 1), "left": (-1, 0)}[orientation]
    assert np.allclose(apex, np.array([x, y]) * np.linalg.norm(apex), atol=1e-15)
    assert np.allclose(apex + base[0] + base[1], 0.0, atol=1e-15)
    sides = [np.linalg.norm(a - b) for a, b in ((apex, base[0]), (apex, base[1]), (base[0], base[1]))]
    assert np.allclose(sides, 2.0 * SIDE_PER_SIZE, rtol=1e-15)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_bounding_box_centring(orientation: Orientation) -> None:
    corners = vertices(size=3.0, orientation=orientation, x=5.0, y=-2.0, centre="bounding_box")
    assert np.allclose((corners.min(axis=0) + corners.max(axis=0)) / 2.0, (5.0, -2.0), atol=1e-14)
    assert np.allclose(corners.mean(axis=0) + 3.0 * np.array(bounding_box_offset(orientation)), (5.0, -2.0))


@settings(max_examples=20, deadline=None)
@given(
    size=st.floats(0.01, 9.0),
    x=st.floats(-4.0, 12.0),
    y=st.floats(-4.0, 10.0),
    orientation=orientations,
    centre=st.sampled_from(["centroid", "bounding_box"]),
)
def test_coverage_is_exact(size: float, x: float, y: float, orientation: Orientation, centre: str) -> None:
    """Also for triangles partly or wholly off the grid."""
    shape = (7, 9)
    corners = vertices(size=size, orientation=orientation, x=x, y=y, centre=centre)
    exact_corners = [(Fraction(float(cx)), Fraction(float(cy))) for cx, cy in corners]
    exact = [[float(clipped_area(exact_corners, i, j)) for j in range(shape[1])] for i in range(shape[0])]
    found = coverage(shape, size_px=size, x_px=x, y_px=y, orientation=orientation.value, centre=centre)
    # Corners are rounded to about 2e-15 (8 ulp of numbers up to 16) and an edge within a pixel is at most √2
    # long; a few such edges and the sums along a row stay below 1e-13.
    assert np.allclose(found, exact, rtol=0.0, atol=1e-13)
    assert found.min() >= 0.0
    assert found.max() <= 1.0


@pytest.mark.parametrize("centre", ["centroid", "bounding_box"])
def test_orientations_are_exact_rotations(centre: str) -> None:
    side = 33
    images = [
        coverage((side, side), size_px=9.3, x_px=16.0, y_px=16.0, orientation=orientation, centre=centre)
        for orientation in ORIENTATIONS
    ]
    for turns, image in enumerate(images):
        assert np.array_equal(image, np.rot90(images[0], -turns))


@pytest.mark.parametrize(
    "orientation", [ORIENTATIONS[0], *(pytest.param(one, marks=pytest.mark.slow) for one in ORIENTATIONS[1:])]
)
def test_spectrum_to_a_millionth(orientation: Orientation) -> None:
    """Against the transform of a coverage 975 pixels high, the pixels' own sinc taken off.

    What is left is aliasing, of second order in the pixel: 4e-6 at a third of the pixels.
    """
    n = 3000
    pitch = 4.0 / n
    x, y = (0.3 + 2.0) / pitch - 0.5, (-0.2 + 2.0) / pitch - 0.5
    image = coverage((n, n), size_px=1.3 / pitch, x_px=x, y_px=y, orientation=orientation)
    middle = (np.arange(n) + 0.5) * pitch - 2.0
    fx, fy = np.random.default_rng(1).uniform(-1.5, 1.5, (2, 40))
    wave_x, wave_y = (np.exp(-2j * np.pi * np.outer(f, middle)) for f in (fx, fy))
    summed = np.einsum("fc,fc->f", wave_y @ image, wave_x) * pitch**2
    found = spectrum(fx, fy, size=1.3, orientation=orientation, x=0.3, y=-0.2)
    assert np.abs(found - summed / (np.sinc(fx * pitch) * np.sinc(fy * pitch))).max() < 1e-6


@settings(max_examples=60, deadline=None)
@given(a=st.floats(-40, 40), b=st.floats(-40, 40), size=st.floats(1e-3, 10), orientation=orientations)
def test_spectrum_is_smooth_where_the_closed_form_is_not(
    a: float, b: float, size: float, orientation: Orientation
) -> None:
    """Two corners in one phase, or all three, cancel in the textbook formula; neighbours must agree."""
    step = 1e-7 / size
    here = spectrum(a / size, b / size, size=size, orientation=orientation)
    beside = spectrum(a / size + step, b / size, size=size, orientation=orientation)
    # |∂F/∂f| <= 2π · farthest corner (0.88 size) · area.
    assert abs(here - beside) <= 2 * np.pi * 0.88 * size**3 * step + 1e-14 * size**2


def test_spectrum_at_zero_is_the_area_and_along_an_edge_a_known_integral() -> None:
    assert spectrum(0.0, 0.0, size=1.7, orientation=Orientation.LEFT) == pytest.approx(1.7**2, rel=1e-15)
    # Along x the upright unit triangle is a tent, side s, height h: F = s h / 2 · sinc²(f s / 2).
    f = np.linspace(-5, 5, 101)
    tent = np.sinc(f * SIDE_PER_SIZE / 2.0) ** 2
    assert np.allclose(spectrum(f, 0.0, size=1.0, orientation=Orientation.UP), tent, atol=3e-15)


@pytest.mark.parametrize("centre", ["centroid", "bounding_box"])
def test_spectrum_of_a_displaced_triangle(centre: str) -> None:
    fx, fy = 0.7, -0.4
    corners = vertices(size=1.2, orientation=Orientation.DOWN, x=3.0, y=4.0, centre=centre)
    x, y = corners.mean(axis=0)
    still = spectrum(fx, fy, size=1.2, orientation=Orientation.DOWN)
    moved = spectrum(fx, fy, size=1.2, orientation=Orientation.DOWN, x=3.0, y=4.0, centre=centre)
    assert moved == pytest.approx(still * np.exp(-2j * np.pi * (fx * x + fy * y)), rel=1e-13)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *(({"size_px": size}, r"size(_px)?: found") for size in (0.0, -1.0, np.nan, np.inf)),
        ({"orientation": "north"}, "orientation: found 'north', expected up, right, down, left"),
        ({"centre": "middle"}, "centre: found 'middle'"),
    ],
)
def test_a_triangle_that_cannot_be_is_refused(changes: dict, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        coverage((9, 9), **{"size_px": 4.0, "x_px": 4.0, "y_px": 4.0, "orientation": "up"} | changes)
