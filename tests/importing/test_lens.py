"""Lenses: OpenCV's own function, and corners of markers made from known lenses."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from todframes.importing.geometry import Geometry, Lens, choose_lens, place_triangle
from todframes.stimulus import Orientation

SHAPE = (440, 640)
IDEAL = Lens.ideal(SHAPE)
VIEW = np.array([[0.85, 0.01, 66.0], [-0.012, 0.86, 65.0], [1e-5, 2e-5, 1.0]])
SQUARE_MM = 42.0 * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
CENTRES_MM = [(36, 36), (444, 36), (444, 234), (36, 234)]
CENTRES_MM += [(165, 36), (315, 36), (444, 110), (444, 160), (315, 234), (165, 234), (36, 160), (36, 110)]
CORNERS_MM = np.array(CENTRES_MM, float)[:, None] + SQUARE_MM


def ideal_places() -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.asarray(IDEAL.middle_px) + rng.uniform(-0.6, 0.6, (50, 2)) * IDEAL.half_diagonal_px


def test_the_coefficients_are_those_of_opencv() -> None:
    """The focal length of its camera matrix is half of the diagonal."""
    k1, k2, x, y, k3, p1, p2 = coefficients = (-0.21, 0.07, 0.02, -0.01, -0.02, 0.003, -0.002)
    lens, places, focal = IDEAL.changed(np.array(coefficients)), ideal_places(), IDEAL.half_diagonal_px
    middle = np.array(IDEAL.middle_px) + focal * np.array([x, y])
    rays = np.column_stack([(places - middle) / focal, np.ones(len(places))])
    matrix = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    bent = np.array([k1, k2, p1, p2, k3])
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, bent)
    np.testing.assert_allclose(lens.to_px(places), expected[:, 0], atol=1e-8)
    np.testing.assert_allclose(lens.to_ideal(lens.to_px(places)), places, atol=1e-5)
    np.testing.assert_allclose(IDEAL.to_px(places), places, atol=1e-10)
    assert IDEAL.changed(np.array([-0.3])).described() == {
        "model": "polynomial", "half_diagonal_px": 388.33, "k1": -0.3
    }  # fmt: skip


class Fisheye:
    """A lens that shows angles in place of their tangents; its picture has so many degrees along the diagonal."""

    def __init__(self, degrees: float) -> None:
        self.half_angle, self.middle_px = math.radians(degrees / 2.0), np.array(IDEAL.middle_px)

    def to_px(self, ideal_px: np.ndarray) -> np.ndarray:
        tangents = (ideal_px - self.middle_px) * (self.half_angle / IDEAL.half_diagonal_px)
        radii = np.linalg.norm(tangents, axis=-1, keepdims=True)
        return self.middle_px + (ideal_px - self.middle_px) * np.arctan(radii) / radii


def triangles(geometry: Geometry) -> np.ndarray:
    placed = [
        place_triangle(geometry, orientation=Orientation.UP, size_mm=30.0, x_mm=x, y_mm=y)
        for x, y in ((240.0, 135.1), (150.0, 100.0), (330.0, 170.0))
    ]
    return np.array([(one.x_px, one.y_px, one.size_px) for one in placed])


def bends(*coefficients: float) -> Lens:
    return IDEAL.changed(np.array(coefficients))


LENSES = {
    "none": bends(),
    "strong barrel": bends(-0.3, 0.1),
    "weak barrel, beside the middle": bends(-0.05, 0.0, 0.02, -0.02),
    "cushion": bends(0.15),
    "tangential": bends(0.0, 0.0, 0.0, 0.0, 0.0, 0.002, -0.002),
    "fisheye": Fisheye(120.0),
}


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("n_markers", [4, 12])
def test_the_stated_error_is_that_of_the_triangles(n_markers: int, name: str) -> None:
    geometry = Geometry(VIEW, 0.0, LENSES[name])
    true, corners_mm, rng = triangles(geometry), CORNERS_MM[:n_markers], np.random.default_rng(3)
    errors, stated = [], []
    for _ in range(6):
        corners_px = geometry.to_px(corners_mm) + 0.03 * rng.standard_normal(corners_mm.shape)
        choice = choose_lens(corners_mm, [corners_px], [triangles], SHAPE)
        assert choice is not None
        away = triangles(choice.geometries[0]) - true
        errors.append((away[:, :2] ** 2).sum(axis=1).mean())
        stated.append(choice.error_px**2)
    if n_markers == 12:
        assert max(errors) < 0.1**2
    # Six draws of two coordinates know a standard deviation to 1 / √24 = 20 %; a factor 1.5 is asked for.
    assert math.sqrt(np.mean(errors) / np.mean(stated)) < 1.5 * 1.4


def test_a_lens_without_noise_is_found_and_an_ideal_one_stays_one() -> None:
    rng = np.random.default_rng(1)
    corners_px = Geometry(VIEW, 0.0, bends(-0.02)).to_px(CORNERS_MM)
    hidden = corners_px.copy()
    hidden[5] = np.nan
    choice = choose_lens(CORNERS_MM, [corners_px, hidden], [triangles] * 2, SHAPE)
    # Homographies are fitted to 32-bit floats, of 2e-5 px.
    assert choice is not None and choice.lens is not None and choice.error_px < 0.02
    np.testing.assert_allclose(choice.lens.coefficients, (-0.02, *[0.0] * 6), atol=1e-4)
    ideal = []
    for _ in range(6):
        corners_px = Geometry(VIEW, 0.0).to_px(CORNERS_MM) + 0.05 * rng.standard_normal(CORNERS_MM.shape)
        ideal.append(choose_lens(CORNERS_MM, [corners_px], [triangles], SHAPE))
    # A criterion with ln 96 takes a coefficient that is none in one of thirty cases or fewer.
    assert sum(one is not None and one.lens is None for one in ideal) >= 5
