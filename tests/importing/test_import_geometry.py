"""Where a chart's triangles lie in recorded frames: closed forms, and frames filmed through known homographies."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import filmed_chart as film
import numpy as np
import pytest

from todframes.base.errors import DataError
from todframes.charts.layout import Point, marker_ids
from todframes.importing.geometry import Geometry, Lens, fit_geometry, place_triangle
from todframes.importing.markers import MarkerFinder, search_parameters
from todframes.stimulus import ORIENTATIONS, Orientation

CHART = film.make_chart()
BORDERS = (Point(x_mm=240.0, y_mm=60.0), Point(x_mm=240.0, y_mm=324.0))
RIGHT_ANGLES = {0: "up", 90: "right", 180: "down", 270: "left"}


def mapped(homography: np.ndarray, places: np.ndarray) -> np.ndarray:
    x, y, w = homography @ np.vstack([np.asarray(places, float).T, np.ones(len(places))])
    return np.column_stack([x / w, y / w])


def test_homography_of_exact_places_is_found() -> None:
    homography = film.camera(degrees=20.0, tilt=3e-4)
    places = film.CENTRES_MM
    geometry = fit_geometry(places, mapped(homography, places))
    elsewhere = np.array([[0.0, 0.0], [200.0, 150.0], [480.0, 384.0]])
    # OpenCV takes places as 32-bit floats: 300 px are known to 2e-5, and corners extrapolate by less than 10.
    np.testing.assert_allclose(geometry.to_px(elsewhere), mapped(homography, elsewhere), atol=2e-4)
    assert geometry.residual_px == 0.0


def test_residual_is_the_distance_of_the_places() -> None:
    rng = np.random.default_rng(1)
    places = rng.uniform(0, 400, (400, 2))
    geometry = fit_geometry(places, mapped(film.camera(), places) + 0.2 * rng.standard_normal(places.shape))
    # 792 degrees of freedom: the standard error is 1 / √(2 · 792) = 2.5 %; four of them.
    assert geometry.residual_px == pytest.approx(0.2 * math.sqrt(2.0), rel=0.1)


@pytest.mark.parametrize("places", [np.zeros((4, 2)), np.array([[0, 0], [1, 0], [2, 0], [3, 0.0]])])
def test_places_without_a_homography(places: np.ndarray) -> None:
    with pytest.raises(DataError, match="determine no homography"):
        fit_geometry(film.CENTRES_MM, places)


@pytest.mark.parametrize("degrees", RIGHT_ANGLES)
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_orientation_as_the_frame_shows_it(degrees: int, mirror: bool, orientation: Orientation) -> None:
    geometry = Geometry(film.camera(degrees=degrees, mirror=mirror), 0.0)
    placed = place_triangle(geometry, orientation=orientation, size_mm=20.0, x_mm=200.0, y_mm=120.0)
    seen = orientation.quarter_turns if not mirror else -orientation.quarter_turns
    assert placed.orientation is ORIENTATIONS[(seen + degrees // 90) % 4]
    assert placed.roll_degrees == pytest.approx(0.0, abs=1e-9)
    assert placed.size_px == pytest.approx(0.62 * 20.0)
    expected = mapped(geometry.homography, np.array([[200.0, 120.0]]))[0]
    assert [placed.x_px, placed.y_px] == pytest.approx(expected.tolist())


@pytest.mark.parametrize("k1", [None, -0.2])
def test_derivatives_are_those_of_differences(k1: float | None) -> None:
    lens = None if k1 is None else Lens((159.5, 127.5), 205.0, (k1, *[0.0] * 6))
    geometry = Geometry(film.camera(degrees=20.0, tilt=1e-3), 0.0, lens)
    places, steps = np.array([[100.0, 90.0], [380.0, 300.0]]), 1e-3 * np.eye(2)
    found = np.stack([geometry.to_px(places + one) - geometry.to_px(places - one) for one in steps], axis=-1)
    np.testing.assert_allclose(geometry.jacobians(places), found / 2e-3, rtol=1e-5)  # steps of 1e-3 mm, squared


def test_centroid_and_area_in_perspective_are_those_of_the_mapped_triangle() -> None:
    geometry = Geometry(film.camera(tilt=1e-3), 0.0)
    placed = place_triangle(geometry, orientation=Orientation.UP, size_mm=60.0, x_mm=240.0, y_mm=192.0)
    # By counting the points of a fine grid in the frame that come from the triangle on the chart.
    step = 0.05
    x, y = np.meshgrid(np.arange(130, 190, step), np.arange(95, 160, step))
    chart = mapped(np.linalg.inv(geometry.homography), np.column_stack([x.ravel(), y.ravel()]))
    height = 3**0.25 * 60.0
    below_apex = chart[:, 1] - (192.0 - height * 2 / 3)
    inside = (below_apex > 0) & (below_apex < height) & (np.abs(chart[:, 0] - 240.0) < below_apex / math.sqrt(3.0))
    # A border of 150 px in steps of 0.05: the count is good to 1e-3.
    assert placed.size_px == pytest.approx(math.sqrt(inside.sum()) * step, rel=1e-3)
    assert placed.x_px == pytest.approx(x.ravel()[inside].mean(), abs=0.01)
    assert placed.y_px == pytest.approx(y.ravel()[inside].mean(), abs=0.01)
    # The mapped centroid is no substitute at this tilt.
    assert abs(geometry.to_px((240.0, 192.0))[0] - placed.x_px) > 0.1


VIEWS = {
    "straight": {},
    "turned by 181°": {"degrees": 181.0},
    "turned by 91°": {"degrees": 91.0, "scale": 0.5},
    "turned by 20°": {"degrees": 20.0, "scale": 0.5},
    "mirrored": {"mirror": True},
    "a tilt of 10°": {"tilt": 2.5e-4},
    "off the middle": {"shift": (7.3, -4.6)},
}


@pytest.mark.parametrize(("view", "blur_px", "noise"), [
    *((view, 0.8, 0.0) for view in VIEWS),
    ("straight", 1.5, 0.0),
    ("straight", 0.8, 0.05),
])  # fmt: skip
def test_triangles_are_placed_to_parts_of_a_pixel(view: str, blur_px: float, noise: float) -> None:
    homography = film.camera(**VIEWS[view])
    image = film.filmed(CHART, 5, homography, blur_px=blur_px)
    finder = MarkerFinder(film.CENTRES_MM, film.SIDE_MM)
    seen = finder.look(film.recorded(image, noise, np.random.default_rng(1)))
    assert seen is not None
    assert seen.ids == marker_ids(5, CHART.key)
    stated = {"orientation": Orientation.UP, "size_mm": 32.0, "x_mm": 150.0, "y_mm": 280.0}
    found, true = (place_triangle(one, **stated) for one in (seen.geometry, Geometry(homography, 0.0)))
    # Markers are aligned to about 0.01 px without noise. Blur moves corners inwards, all alike.
    assert math.hypot(found.x_px - true.x_px, found.y_px - true.y_px) < (0.05 if noise else 0.02)
    assert found.size_px == pytest.approx(true.size_px, rel=1e-3 if noise else 1e-4)
    assert seen.geometry.residual_px < 0.1


def test_a_jump_is_searched_for() -> None:
    finder = MarkerFinder(film.CENTRES_MM, film.SIDE_MM)
    for shift in ((0.0, 0.0), (9.0, -8.0)):
        homography = film.camera(shift=shift)
        seen = finder.look(film.recorded(film.filmed(CHART, 0, homography)))
        assert seen is not None
        np.testing.assert_allclose(
            seen.geometry.to_px(film.MIDDLE_MM), mapped(homography, [film.MIDDLE_MM])[0], atol=0.1
        )


def test_a_covered_marker_is_no_sighting() -> None:
    image = film.filmed(CHART, 0, film.camera())
    image[:90, :90] = 0.5
    finder = MarkerFinder(film.CENTRES_MM, film.SIDE_MM)
    assert finder.look(film.recorded(image)) is None
    assert finder.most_found == 3


def test_a_covered_marker_along_the_borders_is_left_out() -> None:
    """One is covered by grey, another by a white sheet with a black stripe, which has edges and is no marker."""
    homography = film.camera(tilt=2.5e-4)
    chart = film.make_chart(borders=BORDERS)
    image = film.filmed(chart, 3, homography)
    whole = MarkerFinder(chart.markers.all_centres_mm, film.SIDE_MM).look(film.recorded(image))
    assert whole is not None and np.isfinite(whole.corners_px).all()
    for covered, stripe in ((0, None), (1, 0.05)):
        x, y = mapped(homography, chart.markers.all_centres_mm[4 + covered : 5 + covered])[0].round().astype(int)
        hidden = image.copy()
        hidden[y - 30 : y + 30, x - 30 : x + 30] = 0.5 if stripe is None else 1.0
        if stripe is not None:
            hidden[y - 22 : y + 22, x - 22 : x + 22] = stripe
        finder = MarkerFinder(chart.markers.all_centres_mm, film.SIDE_MM)
        seen = finder.look(film.recorded(hidden))
        assert seen is not None and seen.ids == marker_ids(3, chart.key)
        shown = np.isfinite(seen.corners_px).reshape(6, -1)
        assert shown.all(axis=1).tolist() == [k != 4 + covered for k in range(6)]
        assert shown.any(axis=1).tolist() == shown.all(axis=1).tolist()
        np.testing.assert_allclose(
            seen.geometry.to_px(film.MIDDLE_MM), mapped(homography, [film.MIDDLE_MM])[0], atol=0.05
        )


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_other_number_types_and_colour(dtype: type) -> None:
    image = film.filmed(CHART, 3, film.camera())
    scaled = np.rint(image * 200).astype(dtype) if dtype is np.uint8 else (image * 37.0 - 5.0).astype(dtype)
    seen = MarkerFinder(film.CENTRES_MM, film.SIDE_MM).look(np.repeat(scaled[..., None], 3, axis=2))
    assert seen is not None
    assert seen.ids == marker_ids(3, CHART.key)


def test_a_search_finds_all_markers_of_a_photograph() -> None:
    """A board of OpenCV's own, with markers of 6 × 6 modules."""
    photograph = Path(__file__).parents[1] / "recordings" / "markers" / "choriginal.jpg"
    grey = cv2.imread(str(photograph), cv2.IMREAD_GRAYSCALE)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_6X6_250)
    _, ids, _ = cv2.aruco.ArucoDetector(dictionary, search_parameters()).detectMarkers(grey)
    board = cv2.aruco.CharucoBoard((5, 7), 40.0, 20.0, dictionary)
    assert sorted(ids.ravel().tolist()) == sorted(board.getIds().ravel().tolist())
