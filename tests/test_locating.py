"""Finding the triangle when the manifest does not tell where it is."""

from __future__ import annotations

import numpy as np
import pytest

from todframes.errors import DataError
from todframes.frames.dataset import load_dataset
from todframes.frames.files import write_frame
from todframes.frames.locate import locate_triangles
from todframes.stimulus import Orientation, coverage


def redraw(made, x_px: float, y_px: float, *, side_px: int, noise_sd: float, clutter: float = 0.0) -> None:
    """Triangles at a place of their own, on noise, and with the same clutter in every frame."""
    rng = np.random.default_rng(7)
    scene = clutter * rng.normal(size=(side_px, side_px))
    for number, row in enumerate(made.rows):
        triangle = coverage(
            (side_px, side_px),
            size_px=float(row["size_mrad"]) / 0.25,
            x_px=x_px,
            y_px=y_px,
            orientation=Orientation(row["orientation"]),
        )
        contrast = float(row["contrast"]) * triangle + noise_sd * rng.normal(size=triangle.shape) + scene
        write_frame(made.frame(number), 50.0 * (1.0 + contrast), pixel_type="float")


@pytest.mark.parametrize(("x_px", "y_px"), [(31.5, 31.5), (20.3, 40.8), (12.0, 13.1)])
def test_position_is_found_in_noise_and_clutter(make_dataset, x_px: float, y_px: float) -> None:
    made = make_dataset(repeats=4, side_px=64)
    redraw(made, x_px, y_px, side_px=64, noise_sd=0.1, clutter=0.3)
    data, (found,) = locate_triangles(load_dataset(made.path))
    assert found.group == (2.0,)
    assert found.standard_error_px < 0.05
    # Five standard errors along each axis: missed once in a million.
    assert abs(found.x_px - x_px) < 5 * found.standard_error_px
    assert abs(found.y_px - y_px) < 5 * found.standard_error_px
    assert {(trial.x_px, trial.y_px) for trial in data.trials} == {(found.x_px, found.y_px)}


@pytest.mark.slow
def test_standard_error_is_honest(make_dataset) -> None:
    """Scatter over repeated experiments against the error that each states."""
    made = make_dataset(contrasts=(0.2,), repeats=2, side_px=40)
    rng = np.random.default_rng(1)
    misses = []
    for _ in range(40):
        for number, row in enumerate(made.rows):
            triangle = coverage(
                (40, 40), size_px=8.0, x_px=18.7, y_px=20.2, orientation=Orientation(row["orientation"])
            )
            contrast = 0.2 * triangle + 0.1 * rng.normal(size=triangle.shape)
            write_frame(made.frame(number), 50.0 * (1.0 + contrast), pixel_type="float")
        _, (found,) = locate_triangles(load_dataset(made.path))
        misses += [(found.x_px - 18.7) / found.standard_error_px, (found.y_px - 20.2) / found.standard_error_px]
    # 80 standardised misses: their mean square is 1 with a standard deviation of √(2/80) = 0.16.
    assert 0.4 < np.square(misses).mean() < 1.7
    assert abs(np.mean(misses)) < 0.5


def test_sizes_of_one_group_are_found_together(make_dataset) -> None:
    made = make_dataset(
        sizes_mrad=(1.5, 2.5), repeats=2, side_px=64, experiment={"level": "size_mrad", "group_by": []}
    )
    redraw(made, 25.4, 33.3, side_px=64, noise_sd=0.05)
    _, (found,) = locate_triangles(load_dataset(made.path))
    assert (found.x_px, found.y_px) == pytest.approx((25.4, 33.3), abs=5 * found.standard_error_px)


def test_a_single_orientation_is_enough(make_dataset) -> None:
    made = make_dataset(repeats=4, side_px=64)
    redraw(made, 25.4, 33.3, side_px=64, noise_sd=0.05)
    made.rows = [row for row in made.rows if row["orientation"] == "left"]
    made.save()
    _, (found,) = locate_triangles(load_dataset(made.path))
    assert (found.x_px, found.y_px) == pytest.approx((25.4, 33.3), abs=0.1)


def test_positions_in_the_manifest_stay(make_dataset) -> None:
    made = make_dataset()
    for row in made.rows:
        row |= {"x_px": "23.5", "y_px": "23.5"}
    made.save()
    data = load_dataset(made.path)
    assert locate_triangles(data) == (data, ())


def test_nothing_there(make_dataset) -> None:
    made = make_dataset(side_px=64)
    rng = np.random.default_rng(0)
    for number in range(len(made.rows)):
        write_frame(made.frame(number), 50.0 + rng.normal(size=(64, 64)), pixel_type="float")
    with pytest.raises(DataError, match="no triangle stands out in the frames of size_mrad 2"):
        locate_triangles(load_dataset(made.path))


def test_frames_of_different_sizes(make_dataset) -> None:
    made = make_dataset(side_px=64)
    write_frame(made.frame(3), np.full((60, 64), 50.0))
    with pytest.raises(DataError, match=r"found 64 × 60 pixels, expected 64 × 64"):
        locate_triangles(load_dataset(made.path))


@pytest.mark.parametrize(("size_mrad", "wanted"), [(0.1, "no triangle stands out"), (0.5, "smaller than the")])
def test_frames_of_one_pixel_are_refused(make_dataset, size_mrad: float, wanted: str) -> None:
    """All orientations are alike on one pixel; warnings are errors here."""
    made = make_dataset(contrasts=(0.5,))
    for number, row in enumerate(made.rows):
        row["size_mrad"] = str(size_mrad)
        write_frame(made.frame(number), np.full((1, 1), 50.0 + number))
    made.save()
    with pytest.raises(DataError, match=wanted):
        locate_triangles(load_dataset(made.path))
