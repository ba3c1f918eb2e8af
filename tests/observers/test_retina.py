"""Retina sampling: conservation, exact overlap, any pitch ratio."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from overlaps import shares_of_samples

from todframes.base.errors import SettingsError
from todframes.observers.retina import RetinaGrid, resample, triangle_on
from todframes.stimulus import Orientation


@settings(max_examples=60, deadline=None)
@given(
    ratio=st.one_of(st.just(1.0), st.floats(0.02, 30.0)),
    x=st.floats(-15.0, 20.0),
    y=st.one_of(st.just(2.0), st.floats(-15.0, 20.0)),
    side=st.sampled_from([1, 3, 17, 65]),
)
def test_pixels_are_seen_as_their_overlaps_say(ratio: float, x: float, y: float, side: int) -> None:
    """Against the overlaps of all intervals, from fine pixels to coarse ones, on and off the frame."""
    image, grid, pitch_mrad = np.random.default_rng(7).normal(size=(5, 8)), RetinaGrid(side, 0.153), 0.153 * ratio
    rows, columns = (
        shares_of_samples(side, 0.153, middle_mrad=at * pitch_mrad, pitch_mrad=pitch_mrad, n_pixels=n)
        for at, n in ((y, 5), (x, 8))
    )
    seen = resample(image, grid, x_px=x, y_px=y, pixel_pitch_mrad=pitch_mrad)
    # An edge may be rounded by 1e-16 of its distance, up to 65 samples, and two pixels differ by up to 6.
    assert np.allclose(seen, rows @ (columns @ image.T).T, rtol=0.0, atol=1e-12)


def test_part_of_a_frame_is_enough() -> None:
    image = np.random.default_rng(5).normal(size=(40, 50))
    grid = RetinaGrid(9, 0.153)
    place = {"x_px": 21.3, "y_px": 17.8, "pixel_pitch_mrad": 0.11}
    rows, columns = grid.touched([17.8], [21.3], pixel_pitch_mrad=0.11, shape=(40, 50))
    part = image[slice(*rows), slice(*columns)]
    assert part.size < image.size / 4
    seen = resample(part, grid, first_row=rows[0], first_column=columns[0], **place)
    assert np.allclose(seen, resample(image, grid, **place), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize(
    ("centre", "expected"), [(-50.0, (0, 0)), (50.0, (10, 10)), (0.0, (0, 2)), (9.0, (8, 10))]
)
def test_pixel_range_stays_on_the_frame(centre: float, expected: tuple[int, int]) -> None:
    rows, columns = RetinaGrid(3, 1.0).touched([centre], [4.0], pixel_pitch_mrad=1.0, shape=(10, 10))
    assert (rows, columns) == (expected, (3, 6))


def test_a_triangle_lies_to_the_right_of_the_middle_and_below_it() -> None:
    grid = RetinaGrid(33, 0.3)
    middle = triangle_on(grid, 2.0, Orientation.LEFT, centre="bounding_box")
    rows, columns = np.nonzero(middle)
    assert (rows.min() + rows.max(), columns.min() + columns.max()) == (32, 32)
    moved = triangle_on(grid, 2.0, Orientation.LEFT, x=3.0, y=5.0, centre="bounding_box")
    assert np.allclose(moved, np.roll(middle, (5, 3), axis=(0, 1)), rtol=0.0, atol=1e-13)


@pytest.mark.parametrize(("side", "pitch"), [(4, 0.1), (0, 0.1), (3, 0.0), (3, np.nan)])
def test_bad_grid(side: int, pitch: float) -> None:
    with pytest.raises(SettingsError, match=r"(side|pitch_mrad): found"):
        RetinaGrid(side, pitch)
