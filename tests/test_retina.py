"""Retina sampling: conservation, exact overlap, any pitch ratio."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from overlaps import shares_of_samples

from todframes.base.errors import SettingsError
from todframes.observers.retina import RetinaGrid, resample, triangle_on
from todframes.stimulus import Orientation, coverage


@settings(max_examples=60, deadline=None)
@given(
    log_ratio=st.floats(-2.0, 2.0),
    offset_x=st.floats(-2.0, 2.0),
    offset_y=st.floats(-2.0, 2.0),
    seed=st.integers(0, 2**32 - 1),
)
def test_mean_luminance_is_conserved(log_ratio: float, offset_x: float, offset_y: float, seed: int) -> None:
    """Display pixels from 100 times finer to 100 times coarser, any centre, the grid larger than the frame."""
    pitch_mrad, retina_pitch_mrad = 0.153 * 10.0**log_ratio, 0.153
    image = np.random.default_rng(seed).normal(size=(5, 8))
    half_mrad = (8 + 4) * pitch_mrad
    side = 2 * int(np.ceil(half_mrad / retina_pitch_mrad / 2) + 2) + 1
    grid = RetinaGrid(side, retina_pitch_mrad)
    seen = resample(image, grid, x_px=3.5 + offset_x, y_px=2.0 + offset_y, pixel_pitch_mrad=pitch_mrad)
    # Each of the 40 pixels' weights sums to its area within a few ulp.
    assert seen.sum() * retina_pitch_mrad**2 == pytest.approx(
        image.sum() * pitch_mrad**2, abs=1e-12 * np.abs(image).sum() * pitch_mrad**2
    )


@settings(max_examples=60, deadline=None)
@given(log_ratio=st.floats(-2.0, 2.0), centre=st.floats(20.0, 30.0))
def test_uniform_display_is_uniform_on_the_retina(log_ratio: float, centre: float) -> None:
    grid = RetinaGrid(9, 0.153)
    pitch_mrad = 0.153 * 10.0**log_ratio
    n_pixels = 60 + int(grid.width_mrad / pitch_mrad)
    middle = centre + grid.width_mrad / pitch_mrad / 2
    seen = resample(np.ones((n_pixels, n_pixels)), grid, x_px=middle, y_px=middle, pixel_pitch_mrad=pitch_mrad)
    assert np.allclose(seen, 1.0, rtol=0.0, atol=1e-12)


@settings(max_examples=60, deadline=None)
@given(
    ratio=st.one_of(st.just(1.0), st.floats(1.0, 30.0)),
    x=st.floats(-15.0, 20.0),
    y=st.one_of(st.just(2.0), st.floats(-15.0, 20.0)),
    side=st.sampled_from([1, 3, 17, 65]),
)
def test_coarse_pixels_are_seen_as_their_overlaps_say(ratio: float, x: float, y: float, side: int) -> None:
    """Samples that lie on one or two pixels, against the overlaps of all intervals, on and off the frame."""
    image, grid, pitch_mrad = np.random.default_rng(7).normal(size=(5, 8)), RetinaGrid(side, 0.153), 0.153 * ratio
    rows, columns = (
        shares_of_samples(side, 0.153, middle_mrad=at * pitch_mrad, pitch_mrad=pitch_mrad, n_pixels=n)
        for at, n in ((y, 5), (x, 8))
    )
    seen = resample(image, grid, x_px=x, y_px=y, pixel_pitch_mrad=pitch_mrad)
    # An edge may be rounded by 1e-16 of its distance, up to 65 samples, and two pixels differ by up to 6.
    assert np.allclose(seen, rows @ (columns @ image.T).T, rtol=0.0, atol=1e-12)


def test_display_finer_by_a_whole_number_equals_coverage_on_the_retina() -> None:
    """Exact coverage of fine pixels, averaged exactly, is exact coverage of coarse ones."""
    grid = RetinaGrid(17, 0.3)
    fine = coverage((17 * 7, 17 * 7), size_px=5.1 * 7, x_px=59.0, y_px=59.0, orientation=Orientation.LEFT)
    seen = resample(fine, grid, x_px=59.0, y_px=59.0, pixel_pitch_mrad=0.3 / 7)
    coarse = coverage((17, 17), size_px=5.1, x_px=8.0, y_px=8.0, orientation=Orientation.LEFT)
    assert np.allclose(seen, coarse, atol=1e-13)


def test_part_of_a_frame_is_enough() -> None:
    image = np.random.default_rng(5).normal(size=(40, 50))
    grid = RetinaGrid(9, 0.153)
    place = {"x_px": 21.3, "y_px": 17.8, "pixel_pitch_mrad": 0.11}
    rows = grid.pixel_range(centre_px=17.8, pixel_pitch_mrad=0.11, n_pixels=40)
    columns = grid.pixel_range(centre_px=21.3, pixel_pitch_mrad=0.11, n_pixels=50)
    part = image[slice(*rows), slice(*columns)]
    assert part.size < image.size / 4
    seen = resample(part, grid, first_row=rows[0], first_column=columns[0], **place)
    assert np.allclose(seen, resample(image, grid, **place), rtol=0.0, atol=1e-14)


@pytest.mark.parametrize(
    ("centre", "expected"), [(-50.0, (0, 0)), (50.0, (10, 10)), (0.0, (0, 2)), (9.0, (8, 10))]
)
def test_pixel_range_stays_on_the_frame(centre: float, expected: tuple[int, int]) -> None:
    assert RetinaGrid(3, 1.0).pixel_range(centre_px=centre, pixel_pitch_mrad=1.0, n_pixels=10) == expected


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
