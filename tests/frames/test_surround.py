"""The background measured around the triangle, and contrast to it: on frames of which both are known."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import todframes as tod
from todframes.enhancement.enhanced_frame import background_factor
from todframes.frames import contrast as of_frames
from todframes.frames.memory import ArrayFrame
from todframes.frames.surround import Surface, SurroundSums, TrianglePlace, block_sums, median, surround_window
from todframes.frames.trials import FrameReference

SIZE_PX = 10.0


def test_contrast_beyond_the_background_is_shown_as_background() -> None:
    plane = np.zeros((5, 5))
    plane[0, 0], plane[0, 1] = 50.0, 5.0  # 50 cd/m² at column 6, and 5 more every 2 pixels
    surface = Surface(plane, (4, 6), 2.0, ((2, 9), (3, 8)), ((0, 12), (0, 12)), 0.0)
    row, column = np.mgrid[1:11, 2:10]
    light = 1.2 * (50.0 + 2.5 * (column - 6))
    inside = (row >= 2) & (row < 9) & (column >= 3) & (column < 8)
    assert surface.contrast(light, 1, 2) == pytest.approx(np.where(inside, 0.2, 0.0), abs=1e-12)
    assert (surface.has(np.arange(1.0, 11.0), np.arange(2.0, 10.0)) == inside).all()
    within = surface.contrast(light[2:7, 2:5], 3, 4)
    assert within == pytest.approx(np.full((5, 3), 0.2))


ROWS, COLUMNS = 61, 83
PLACE = TrianglePlace(47.3, 24.8, 4.0)


def read(luminance, rule, call="read_contrast", **window):
    display = tod.Display(
        eotf="linear", white_luminance_cd_m2=1.0, pixel_pitch_mrad=1.0, background_luminance_cd_m2=rule
    )
    frame = FrameReference("a", None, 40.0 if rule == "column" else None)
    with ArrayFrame(Path("a"), luminance) as file:
        return getattr(of_frames, call)(file, display, frame, **{"triangle": PLACE} | window)


def test_a_black_corner_on_an_even_background_is_left_out() -> None:
    """All blocks but the first are exactly alike, so that their scatter is zero."""
    light = np.full((ROWS, COLUMNS), 40.0)
    light[:14, :37] = 0.0
    found = np.concatenate([band.values for band in read(light, "surround").bands()])
    assert found[10, -10:] == pytest.approx(np.zeros(10), abs=1e-9)


@pytest.mark.parametrize("held", [0, 10**6])
@pytest.mark.parametrize("band_values", [10**6, 3 * COLUMNS])
@pytest.mark.parametrize("window", [{}, {"rows": (5, 33), "columns": (20, 70)}], ids=["all", "part"])
@pytest.mark.parametrize("rule", [30.0, "column", "border", "frame_mean", "surround"])
def test_contrast_is_that_to_the_background_of_the_rule(rule, window, band_values, held, monkeypatch) -> None:
    """Whatever part is read, in however many bands: on a plane, with a triangle, and a few pixels below zero."""
    monkeypatch.setattr(of_frames, "BAND_VALUES", band_values)
    monkeypatch.setattr(of_frames, "MOST_HELD_PX", held)
    y, x = np.mgrid[:ROWS, :COLUMNS]
    plane = 40.0 + 0.25 * x - 0.5 * y
    light = plane * (
        1.0 + 0.3 * tod.coverage((ROWS, COLUMNS), orientation=tod.Orientation.LEFT, **PLACE._asdict())
    )
    rows, columns = window.get("rows", (0, ROWS)), window.get("columns", (0, COLUMNS))
    if rule == "surround":  # 1.1 sizes and 2 + 8 pixels about the triangle
        rows, columns = (max(rows[0], 10), min(rows[1], 40)), (33, 63)
    else:
        light[7, 21], light[8, 22], light[50, 60] = -1.0, -2.0, -3.0
    ring = np.concatenate([light[0], light[-1], light[1:-1, 0], light[1:-1, -1]])
    background = {"column": 40.0, "border": ring.mean(), "frame_mean": light.mean(), "surround": plane}.get(
        rule, rule
    )
    patch = read(light, rule, **window)
    read(light, rule, "check_pixels")
    bands = list(patch.bands())
    per_band = 10**6 if held or band_values == 10**6 else 3 * COLUMNS // (columns[1] - columns[0])
    assert [(one.row, one.column) for one in bands] == [(at, columns[0]) for at in range(*rows, per_band)]
    found, expected = np.concatenate([one.values for one in bands]), light / background - 1.0
    np.testing.assert_allclose(found, expected[slice(*rows), slice(*columns)], rtol=0, atol=1e-12)
    assert patch.background_luminance_cd_m2 == pytest.approx(plane[25, 47] if rule == "surround" else background)
    n_negative = {"surround": 0, "border": 3, "frame_mean": 3}.get(rule, 2 if window else 3)
    assert (patch.row, patch.column, patch.n_negative) == (rows[0], columns[0], n_negative)


@pytest.mark.parametrize(("rule", "found"), [("border", -1.5), ("frame_mean", -3.0), ("surround", -4.0)])
def test_a_background_below_zero_is_named_alike_wherever_it_is_found(rule, found, monkeypatch) -> None:
    light = np.full((ROWS, COLUMNS), -4.0)
    light[[0, -1]] = light[:, [0, -1]] = -1.5
    light[1:6, 1:3] += (-3.0 - light.mean()) * light.size / 10.0
    monkeypatch.setattr(of_frames, "BAND_VALUES", 3 * COLUMNS)
    for call in ("read_contrast", "check_pixels"):
        with pytest.raises(tod.FrameError, match=rf"^a: background luminance .*is {found:g} cd/m², expected > 0$"):
            read(light, rule, call)


def test_what_no_contrast_is_taken_from_is_refused() -> None:
    for largest, background in ((1e308, 2.0), (1e308, 0.6), (0.0, 1.0)):
        of_frames.check_contrast(largest, background)
    with pytest.raises(tod.DataError, match="the contrast is beyond all numbers; expected luminances nearer"):
        of_frames.check_contrast(1e308, 0.5)
    with pytest.raises(tod.FrameError, match=r"no pixels around the triangle to take the background from"):
        read(np.ones((9, 9)), "surround", triangle=TrianglePlace(4.0, 4.0, 4.0))


@pytest.mark.parametrize(
    ("size_px", "rows", "columns"),
    # Reach: three sizes, or 1.1 sizes and 2 + 8 pixels, on all sides of (20.2, 31.6).
    [(10.0, (4, 63), (0, 51)), (2.0, (19, 45), (8, 33)), (20.0, (4, 90), (0, 81)), (1e30, (4, 90), (0, 100))],
)
def test_the_window_about_a_triangle(size_px, rows, columns) -> None:
    assert surround_window(TrianglePlace(20.2, 31.6, size_px), rows=(4, 90), columns=(0, 100)) == (rows, columns)


Y, X = np.mgrid[:96, :116]
FALLOFF = ((X / 48.0 - 1.0) ** 2 + (Y / 48.0 - 1.0) ** 2) / 2.0
SPOT = np.where((X > 45) & (X < 65) & (Y > 20) & (Y < 25), 4.0, 1.0 - 0.5 * FALLOFF)


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize(
    ("share", "extent"),
    [
        (np.ones(X.shape), ((11, 72), (22, 83))),
        (1.0 + 0.002 * (X - 52) + 0.001 * (Y - 41), ((11, 72), (22, 83))),
        *((1.0 - share * FALLOFF, ((11, 72), (22, 83))) for share in (0.3, 0.5, 0.7)),
        (np.where((X >= 32) & (X < 80) & (Y >= 17) & (Y < 67), 1.0, 0.1), ((17, 67), (32, 80))),
        (np.where(X < 76, 1.0, 0.7), ((11, 72), (22, 76))),
        (np.where(np.abs(Y - 40.5) < 22, 1.0, 0.0), ((19, 63), (22, 83))),
        (SPOT, None),
    ],
    ids=["even", "plane", "30 %", "50 %", "70 %", "border", "two levels", "letterbox", "bright spot"],
)
def test_the_background_at_the_triangle_and_its_extent_are_found(share, extent, noise) -> None:
    """Whatever triangle is there; in bands of rows of any height. Blocks have 2 x 2 pixels."""
    triangle = TrianglePlace(52.0, 41.0, SIZE_PX)
    shown = 1.0 + 0.8 * tod.coverage(X.shape, orientation=tod.Orientation.UP, **triangle._asdict())
    light = 50.0 * share * shown + noise * np.random.default_rng(4).normal(size=X.shape)
    sums = SurroundSums(triangle, surround_window(triangle, rows=(0, 96), columns=(0, 116)))
    for begin, end in pairwise((0, 31, 32, 60, 96)):
        sums.add(light[begin:end, 5:], begin, 5)
    surface = sums.surface()
    assert (surface.window, surface.middle) == (((11, 72), (22, 83)), (41, 52))
    assert extent is None or surface.extent == extent
    # Some 500 blocks around it know the light at the triangle to some 0.05 cd/m², and its slopes and bends.
    error = np.abs(surface.luminance((33, 49), (44, 60)) / (50.0 * share[33:49, 44:60]) - 1.0).max()
    assert error < (0.01 if noise or extent is None else 0.002)
    if extent == surface.window:  # means of 4 pixels have half the standard deviation; 1500 triples know it to 4 %
        assert surface.noise_cd_m2 == pytest.approx(0.5 * noise, rel=0.12, abs=0.05)


def test_sums_of_blocks() -> None:
    values, expected = np.random.default_rng(1).random((7, 11)), np.zeros((4, 6))
    rows, columns = np.indices(values.shape)
    np.add.at(expected, ((rows + 5) // 3, (columns + 7) // 3), values)
    sums, first = block_sums(values, 5, 7, 3)
    np.testing.assert_allclose(sums, expected[1:, 2:], rtol=1e-12)
    assert (first, block_sums(values, 5, 7, 1)[1]) == ((1, 2), (5, 7))
    assert [median(np.array(one)) for one in ([3.0], [4.0, 1.0], [9.0, 2.0, 4.0])] == [3.0, 2.5, 4.0]


def factor_of(before, after, size_px, *, x=None, y=None, magnification=1.0):
    """The factor in a frame whose first pixel is at (row 40, column −7)."""
    rows, columns = (40, 40 + before.shape[0]), (-7, -7 + before.shape[1])
    x = (before.shape[1] - 1) / 2 if x is None else x
    y = (before.shape[0] - 1) / 2 if y is None else y
    return background_factor(
        lambda r, c: before[r, c],
        lambda r, c: after[r, c],
        TrianglePlace(x - 7, y + 40, size_px),
        rows=rows,
        columns=columns,
        magnification=magnification,
    )


@pytest.mark.parametrize("magnification", [0.5, 1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize(
    ("shape", "size_px", "where", "edge_px"),
    [
        ((96, 96), 10.0, {}, 3),
        ((96, 120), 10.0, {}, 5),
        ((48, 48), 8.0, {}, 1),
        ((96, 96), 10.0, {"x": 15.0, "y": 80.0}, 4),  # near a corner
        ((300, 300), 2.0, {}, 60),  # a small triangle, far from the edge
        ((96, 96), 10.0, {}, 0),
        ((24, 24), 12.0, {}, 0),  # as large as the frame: no band, but corners
        ((60, 16), 8.0, {}, 0),  # narrow
    ],
)
def test_the_background_s_factor_is_that_around_the_triangle(
    shape, size_px, where, edge_px, magnification
) -> None:
    """On texture, whatever an algorithm does to the edge of a frame, and to the triangle itself."""
    rng = np.random.default_rng(3)
    before = 50.0 * (1.0 + np.kron(rng.uniform(-0.5, 0.5, (shape[0] // 2, shape[1] // 2)), np.ones((2, 2))))
    x, y = where.get("x", (shape[1] - 1) / 2), where.get("y", (shape[0] - 1) / 2)
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    before += 30.0 * (np.hypot(rows - y, columns - x) < 0.8 * size_px)
    sides = [round(magnification * side) for side in shape]
    pixels = [((np.arange(side) + 0.5) / magnification - 0.5).round().astype(int) for side in sides]
    if magnification == 0.5:
        after = before.reshape(shape[0] // 2, 2, shape[1] // 2, 2).mean(axis=(1, 3))
    else:
        after = before[np.ix_(*pixels)]
    after = 0.7 * after
    n = round(edge_px * magnification)
    if n:
        after[:n], after[-n:], after[:, :n], after[:, -n:] = 500.0, 0.0, 500.0, 0.0
    # With 1.5, each second pixel counts twice, and with 0.5 edges of blocks may lie half a pixel off. Cells of
    # 2 × 2 pixels, which deviate by 29 %, then weigh a third more or less. The mean over 36 cells or more, as in
    # four corners, deviates by 1.6 %.
    tolerance = 1e-9 if magnification == int(magnification) else 3 * 0.016
    assert factor_of(before, after, size_px, magnification=magnification, **where) == pytest.approx(
        0.7, rel=tolerance
    )
