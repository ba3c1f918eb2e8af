"""The background measured around the triangle: uneven frames have the threshold of even ones."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import pytest

import todframes as tod
from todframes.enhancement.brightening import background_factor
from todframes.frames.memory import memory_dataset
from todframes.frames.surround import Surface, SurroundSums, TrianglePlace, surround_window
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.score import score_dataset

SIDE, SIZE_PX, PITCH_MRAD = 96, 10.0, 0.25
THRESHOLD = 0.077
"""About that of the naked eye for 2.5 mrad."""


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


def frames(spoil=lambda luminance: luminance, *, noise=0.0, blur_px=0.0):
    """Triangles of five contrasts in four orientations, to the right of the middle and above it."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(0)
    found, orientation, level, position = [], [], [], []
    for contrast in THRESHOLD * np.array([0.6, 0.8, 1.0, 1.4, 2.0]):
        for turn in tod.ORIENTATIONS:
            x, y = (SIDE - 1) / 2 + rng.uniform(-0.5, 0.5, 2) + (6.0, -7.0)
            triangle = tod.coverage((SIDE, SIDE), size_px=SIZE_PX, x_px=x, y_px=y, orientation=turn)
            shown = 1.0 + contrast * (gaussian_filter(triangle, blur_px) if blur_px else triangle)
            found.append(spoil(50.0 * (shown + noise * rng.normal(size=shown.shape))).astype(np.float32))
            orientation.append(turn)
            level.append(contrast)
            position.append((x, y))
    return found, {"orientation": orientation, "level": level, "position": position}


def threshold(made, background, **changes):
    images, shown = made
    display = tod.Display(
        eotf="linear",
        white_luminance_cd_m2=1.0,
        pixel_pitch_mrad=PITCH_MRAD,
        background_luminance_cd_m2=background,
    )
    shown = shown | {"size_mrad": SIZE_PX * PITCH_MRAD, "display": display} | changes
    scored = score_dataset(
        memory_dataset(images, **shown), PyramidObserver(), fit_settings=tod.FitSettings(resamples=0)
    )
    return scored.fits[0].fit.threshold


@cache
def threshold_of_even(noise):
    return threshold(frames(noise=noise), 50.0)


def vignetting(share):
    y, x = np.mgrid[:SIDE, :SIDE] * 2.0 / (SIDE - 1) - 1.0
    return lambda luminance: luminance * (1.0 - share * (x * x + y * y) / 2.0)


def bordered(luminance):
    spoilt = np.full_like(luminance, 1.0)
    spoilt[12:-12, 12:-12] = luminance[12:-12, 12:-12]
    return spoilt


def two_levels(luminance):
    return luminance * np.where(np.arange(SIDE) < 66, 1.0, 0.7)


def letterboxed(luminance):
    return luminance * np.where(np.abs(np.arange(SIDE) - 50) < 30, 1.0, 0.0)[:, None]


def spotted(luminance):
    spoilt = luminance.copy()
    spoilt[28:32, 40:60] = 200.0
    return spoilt


@pytest.mark.parametrize("noise", [0.0, pytest.param(0.5 * THRESHOLD, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "spoil",
    [vignetting(0.3), vignetting(0.5), vignetting(0.7), bordered, two_levels, letterboxed],
    ids=["30 %", "50 %", "70 %", "border", "two levels", "letterbox"],
)
def test_uneven_frames_have_the_threshold_of_even_ones(spoil, noise) -> None:
    even, made = threshold_of_even(noise), frames(spoil, noise=noise)
    assert threshold(made, "surround") == pytest.approx(even, rel=0.03)
    assert threshold(made, "border") != pytest.approx(even, rel=0.03)


@pytest.mark.parametrize(
    ("noise", "blur_px", "rel"),
    [(0.0, 0.0, 1e-6), pytest.param(0.0, 1.5, 3e-3, marks=pytest.mark.slow), (THRESHOLD, 1.0, 3e-3)],
)
def test_even_frames_have_the_threshold_of_the_number(noise, blur_px, rel) -> None:
    """Without noise the surface is the number. A blur puts light of the triangle into the surround."""
    made = frames(noise=noise, blur_px=blur_px)
    assert threshold(made, "surround") == pytest.approx(threshold(made, 50.0), rel=rel)


def test_a_bright_spot_near_the_triangle_does_not_change_the_background() -> None:
    triangle = TrianglePlace(47.5, 47.5, SIZE_PX)
    window = surround_window(triangle, rows=(0, SIDE), columns=(0, SIDE))
    surfaces = []
    for spoil in (np.copy, spotted):
        sums = SurroundSums(triangle, window)
        sums.add(spoil(vignetting(0.5)(np.full((SIDE, SIDE), 50.0))), 0, 0)
        surfaces.append(sums.surface().luminance((20, 76), (20, 76)))
    assert np.allclose(surfaces[0], vignetting(0.5)(np.full((SIDE, SIDE), 50.0))[20:76, 20:76], rtol=2e-3)
    assert np.allclose(surfaces[1], surfaces[0], rtol=1e-2)


@pytest.mark.parametrize("cuts", [(0, 96), (0, 31, 32, 60, 96)])
def test_bands_of_rows_add_up(cuts) -> None:
    """Block sums by bands of any height are those of the whole: sums of 2 x 2 pixels."""
    image = np.random.default_rng(0).uniform(1.0, 2.0, (SIDE, SIDE))
    triangle = TrianglePlace(40.2, 50.9, SIZE_PX)
    window = surround_window(triangle, rows=(0, SIDE), columns=(0, SIDE))
    sums = SurroundSums(triangle, window)
    for begin, end in pairwise(cuts):
        sums.add(image[begin:end, 5:], begin, 5)
    assert sums.block_px == 2
    part = image[slice(*window.rows), slice(*window.columns)]
    part = np.pad(part, [(0, length % 2) for length in part.shape])
    blocks = part.reshape(part.shape[0] // 2, 2, -1, 2).sum(axis=(1, 3))
    assert np.allclose(sums.sums, blocks, rtol=1e-14)


def test_a_frame_without_surround_is_refused() -> None:
    made = frames()
    with pytest.raises(tod.FrameError, match=r"no pixels around the triangle to take the background from"):
        threshold(([image[39:57, 39:57] for image in made[0]], made[1]), "surround", position=(8.5, 8.5))


def test_a_black_surround_is_refused() -> None:
    images, shown = frames()
    with pytest.raises(tod.FrameError, match=r"background luminance around the triangle is 0 cd/m², expected > 0"):
        threshold(([0.0 * image for image in images], shown), "surround")


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
