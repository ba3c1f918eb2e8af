"""The fit of a triangle: exact derivatives, exact recovery, honest errors, and what makes a warning."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import triangles

from todframes.diagnosis.findings import frame_warnings
from todframes.diagnosis.inspection import inspect
from todframes.diagnosis.triangle import Given, Images, Shape, blur_matrices, errors_of, first_guess, fit, fitted
from todframes.frames.memory import memory_dataset
from todframes.stimulus import ORIENTATIONS, coverage, moving_coverage, vertices

SIDE = 49
# By x and y, and by the entries xx, xy, yx and yy of a map: the motion of a point is offset + map @ point.
MOTIONS = (
    *((np.array(offset), np.zeros((2, 2))) for offset in np.eye(2)),
    *((np.zeros(2), one.reshape(2, 2)) for one in np.eye(4)),
)


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_changes_of_coverage_are_differences_of_moved_triangles(orientation) -> None:
    """Coverage is quadratic in the corners between pixel boundaries, so central differences are exact there."""
    corners = vertices(size=8.3, orientation=orientation, x=20.3, y=17.8)
    found = moving_coverage(corners, (41, 41))
    exact = coverage((41, 41), size_px=8.3, x_px=20.3, y_px=17.8, orientation=orientation)
    assert found[0] == pytest.approx(exact, abs=1e-12)
    step = 1e-6
    for (offset, by_map), change in zip(MOTIONS, found[1:], strict=True):
        moved = step * (offset + corners @ by_map.T)
        ahead, behind = (moving_coverage(corners + sign * moved, (41, 41))[0] for sign in (1.0, -1.0))
        # Rounding of the coverage is 1e-14 of the area left of a pixel, some 1e-13; divided by 2e-6.
        assert change == pytest.approx((ahead - behind) / (2.0 * step), abs=1e-5)


def test_a_triangle_beyond_the_grid_covers_nothing() -> None:
    assert not moving_coverage(vertices(size=5.0, orientation=ORIENTATIONS[0], x=-20.0, y=4.0), (9, 9)).any()


def test_blur_has_its_variance_and_keeps_the_light() -> None:
    kernel, change = (one[:, 30] for one in blur_matrices(2.5, 61))
    away = np.arange(61) - 30.0
    assert kernel.sum() == pytest.approx(1.0, abs=1e-6)
    assert kernel @ np.square(away) == pytest.approx(2.5, abs=1e-3)
    # The variance of a Gaussian grows by 1 with its own parameter; 61 blocks hold all of it to 1e-3.
    assert change @ np.square(away) == pytest.approx(1.0, abs=1e-2)


def images_of(change, *, x=0.4, y=-0.7, size=9.0, blur=1.0, shown=(0, 1, 2, 3), noise=0.0, sign=1.0):
    """Mean frames of a triangle under a map, drawn with four times the pixels."""
    middle = (SIDE - 1) / 2
    of_turn = [
        triangles.drawn(SIDE, turn=k, size_px=size, x=middle + x, y=middle + y, change=change, blur_px=blur)
        for k in shown
    ]
    frames = sign * np.array(of_turn) + noise * np.random.default_rng(0).normal(size=(4, SIDE, SIDE))
    return Images.of(
        np.concatenate([0.1 * frames, 0.2 * frames]),
        Given(np.repeat([0.1, 0.2], 4), np.full(8, 0.01), np.tile(np.arange(4), 2)),
        known=np.ones((SIDE, SIDE), bool),
        hole=10.0,
    )


@pytest.mark.parametrize("degrees", [0.0, 0.7, 10.0, -25.0])
def test_a_turn_is_what_it_is(degrees: float) -> None:
    found = fit(images_of(triangles.turning(degrees)), Shape.upright(1.0, 0.0, 0.0, 8.0))
    # The blur of coverage on single pixels leaves 0.1 % of the contrast at the edges, and the turn 0.05°.
    assert np.rad2deg(found.shape.turn_rad) == pytest.approx(degrees, abs=0.05)
    assert (found.shape.x, found.shape.y) == pytest.approx((0.4, -0.7), abs=0.01)
    assert found.shape.size == pytest.approx(9.0, rel=3e-3)
    assert found.shape.amplitude == pytest.approx(1.0, rel=3e-3)


def test_a_chart_from_the_side_is_stretched_and_neither_turned_nor_fainter() -> None:
    """A yaw of 25°: narrower by its cosine."""
    found = fit(images_of(np.diag([np.cos(np.deg2rad(25.0)), 1.0])), Shape.upright(1.0, 0.0, 0.0, 9.0))
    assert found.shape.map[0, 0] / found.shape.map[1, 1] == pytest.approx(np.cos(np.deg2rad(25.0)), abs=5e-3)
    assert np.rad2deg(found.shape.turn_rad) == pytest.approx(0.0, abs=0.05)
    assert found.shape.amplitude == pytest.approx(1.0, rel=3e-3)


@pytest.mark.parametrize("shown", [(0, 1, 2, 3), (0, 3, 2, 1), (2, 3, 0, 1), (1, 2, 3, 0), (1, 0, 3, 2)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_arrangement_and_polarity_are_found(shown, sign) -> None:
    images = images_of(triangles.turning(3.0), shown=shown, noise=0.02, sign=sign)
    found = fitted(images, first_guess(images, 8.0))
    assert found.shown == shown
    assert np.sign(found.shape.amplitude) == sign
    assert np.rad2deg(found.shape.turn_rad) == pytest.approx(
        3.0, abs=5.0 * np.rad2deg(errors_of(found, images)[0][4])
    )


@pytest.mark.weekly
def test_intervals_are_honest() -> None:
    """150 groups in blur, noise, patterns, tilts and cut windows, five intervals each."""
    deviates = np.array([triangles.estimate(np.random.default_rng([7, k]))[1] for k in range(150)])
    measured = np.abs(deviates[np.isfinite(deviates)])
    # The share of 750 intervals has a standard deviation of 0.8 %; those of a group are not independent.
    assert 0.92 <= (measured < 1.96).mean() <= 0.985


@pytest.mark.weekly
def test_good_frames_at_random_have_no_warning() -> None:
    for k in range(12):
        dataset = triangles.clean(np.random.default_rng([8, k]))
        assert frame_warnings(dataset, inspect(dataset, dataset.trials)) == []


def filmed(
    sizes, *, change=None, side=73, levels=(0.05, 0.1, 0.2), noise=0.01, blur_px=0.7, places=None, **stated
):
    """A recorded chart: triangles turned, and of a size and place of their own each, as stated."""
    rng, n = np.random.default_rng(12), len(levels)
    places = np.tile((36.2, 35.9), (len(sizes), 1)) if places is None else places
    change = np.eye(2) if change is None else change
    frames = []
    for k, (size, (x, y)) in enumerate(zip(sizes, places, strict=True)):
        image = triangles.drawn(side, turn=k // n % 4, size_px=size, x=x, y=y, change=change, blur_px=blur_px)
        frames.append(50.0 * (1.0 + levels[k % n] * image + noise * rng.normal(size=image.shape)))
    stated = {"display": triangles.DISPLAY, "group": {"chart": ["one"] * len(frames)}, **stated}
    stated |= {"orientation": [ORIENTATIONS[k // n % 4] for k in range(len(frames))], "position": places}
    level = [levels[k % n] for k in range(len(frames))]
    return memory_dataset(frames, level=level, size_mrad=[0.25 * size for size in sizes], **stated)


def test_sizes_in_perspective_are_measured_together() -> None:
    """Each of 36 triangles has a size of its own, within 10 %; each alone would say nothing."""
    dataset = filmed(9.0 * np.linspace(0.95, 1.05, 36))
    (found,) = inspect(dataset, dataset.trials)
    assert found.n_trials == 24
    assert found.size_ratio == pytest.approx(1.0, abs=5.0 * found.size_ratio_error)
    assert found.size_ratio_error < 0.01
    assert frame_warnings(dataset, [found]) == []


def test_places_between_pixels_cost_no_precision() -> None:
    """Windows begin at whole pixels, so places on either side of a half are half a window's pixel apart, twice."""
    places = np.array([(48.5 + 1e-3 * (-1) ** k, 48.5 + 1e-3 * (-1) ** (k // 2)) for k in range(24)])
    change = triangles.seen_from(np.random.default_rng(1), tilt_deg=25.0, turn_deg=1.0)
    display = replace(triangles.DISPLAY, background_luminance_cd_m2="surround")
    how = {"side": 97, "levels": (0.1, 0.3), "noise": 0.005, "blur_px": 0.8, "display": display}
    dataset = filmed(np.full(24, 18.0), change=change, places=places, **how)
    (found,) = inspect(dataset, dataset.trials)
    assert np.hypot(*found.offset_error_px) < 0.02
    assert np.hypot(*found.offset_px) < 5.0 * np.hypot(*found.offset_error_px)
    assert found.contrast_slope == pytest.approx(1.0, abs=5.0 * found.contrast_slope_error)
    assert found.blur_px == pytest.approx(0.8, abs=0.1)
    assert found.scatter_px == 0.0
    assert frame_warnings(dataset, [found]) == []


@pytest.mark.parametrize(("roll_deg", "is_reported"), [(0.7, False), (1.5, False), (4.0, True), (10.0, True)])
def test_a_roll_is_reported_beyond_its_tolerance(roll_deg: float, is_reported: bool) -> None:
    dataset = filmed(np.full(36, 9.0), change=triangles.turning(roll_deg))
    found = frame_warnings(dataset, inspect(dataset, dataset.trials))
    assert [one.code for one in found] == (["turned"] if is_reported else [])
    if is_reported:
        assert found[0].found == pytest.approx(roll_deg, abs=1.0)
