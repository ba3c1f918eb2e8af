"""The background measured around the triangle: uneven frames have the threshold of even ones."""

from __future__ import annotations

from functools import cache, partial
from pathlib import Path

import numpy as np
import pytest

import todframes as tod
from todframes.enhancement.brightening import background_factor
from todframes.frames import contrast as of_frames
from todframes.frames.memory import ArrayFrame, memory_dataset
from todframes.frames.surround import Surface, SurroundSums, TrianglePlace, block_sums, median, surround_window
from todframes.frames.trials import FrameReference
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


ROWS, COLUMNS = 61, 83
PLACE = TrianglePlace(47.3, 24.8, 4.0)
WINDOWED = {"rows": (5, 33), "columns": (20, 70)}


def read(luminance, rule, monkeypatch, *, band_values, held, **window):
    """Read a frame by bands of rows, as contrast and as stored; the rows of PLACE's window with "surround"."""
    monkeypatch.setattr(of_frames, "BAND_VALUES", band_values)
    monkeypatch.setattr(of_frames, "MOST_HELD_PX", held)
    display = tod.Display(
        eotf="linear", white_luminance_cd_m2=1.0, pixel_pitch_mrad=1.0, background_luminance_cd_m2=rule
    )
    frame = FrameReference("a", None, 40.0 if rule == "column" else None)
    triangle = PLACE if rule == "surround" else None
    with ArrayFrame(Path("a"), luminance) as file:
        of_frames.check_pixels(file, display, frame, PLACE)
        return of_frames.read_contrast(file, display, frame, triangle=triangle, **window)


@pytest.mark.parametrize("held", [0, 10**6])
@pytest.mark.parametrize("band_values", [10**6, 3 * COLUMNS])
@pytest.mark.parametrize("window", [{}, WINDOWED], ids=["all", "part"])
@pytest.mark.parametrize("rule", [30.0, "column", "border", "frame_mean", "surround"])
def test_contrast_is_that_to_the_background_of_the_rule(rule, window, band_values, held, monkeypatch) -> None:
    """Whatever part is read, in however many bands: on a plane, with a triangle, and a few pixels below zero."""
    y, x = np.mgrid[:ROWS, :COLUMNS]
    plane = 40.0 + 0.25 * x - 0.5 * y
    place = {"x_px": PLACE.x_px, "y_px": PLACE.y_px, "size_px": PLACE.size_px}
    triangle = plane * (1.0 + 0.3 * tod.coverage((ROWS, COLUMNS), orientation=tod.Orientation.LEFT, **place))
    light = triangle.copy()
    light[7, 21], light[8, 22], light[50, 60] = -1.0, -2.0, -3.0
    patch = read(
        light if rule != "surround" else triangle, rule, monkeypatch, band_values=band_values, held=held, **window
    )
    ring = np.ones((ROWS, COLUMNS), bool)
    ring[1:-1, 1:-1] = False
    reach = 14.4 + 0.5  # 1.1 sizes, and 2 and 8 pixels more; pixels reach half a pixel beyond their centres
    background = {"column": 40.0, "border": light[ring].mean(), "frame_mean": light.mean(), "surround": plane}.get(
        rule, rule
    )
    expected = (light if rule != "surround" else triangle) / background - 1.0
    rows, columns = window.get("rows", (0, ROWS)), window.get("columns", (0, COLUMNS))
    if rule == "surround":
        rows, columns = (
            (max(span[0], round(at - reach + 0.5)), min(span[1], round(at + reach - 0.5) + 1))
            for span, at in ((rows, PLACE.y_px), (columns, PLACE.x_px))
        )
    assert (patch.row, patch.column) == (rows[0], columns[0])
    found = [band.values for band in patch.bands()]
    assert len(found) == (
        1 if held or band_values > 10**5 else -(-(rows[1] - rows[0]) // (3 * COLUMNS // (columns[1] - columns[0])))
    )
    np.testing.assert_allclose(np.concatenate(found), expected[slice(*rows), slice(*columns)], rtol=0, atol=1e-12)
    starts = [(band.row, band.column) for band in patch.bands()]
    assert starts == [(rows[0] + sum(map(len, found[:k])), columns[0]) for k in range(len(found))]
    middle = plane[25, 47] if rule == "surround" else background
    assert patch.background_luminance_cd_m2 == pytest.approx(middle, rel=1e-12)
    n_negative = 0 if rule == "surround" else 3 if not window or rule in ("border", "frame_mean") else 2
    assert patch.n_negative == n_negative


@pytest.mark.parametrize(("rule", "found"), [("border", -1.5), ("frame_mean", -3.0), ("surround", -4.0)])
@pytest.mark.parametrize("band_values", [10**6, 3 * COLUMNS])
def test_a_background_below_zero_is_named_alike_wherever_it_is_found(
    rule, found, band_values, monkeypatch
) -> None:
    light = np.full((ROWS, COLUMNS), -4.0)
    light[[0, -1]] = light[:, [0, -1]] = -1.5
    light[1:6, 1:3] += (-3.0 - light.mean()) * light.size / 10.0
    monkeypatch.setattr(of_frames, "BAND_VALUES", band_values)
    display = tod.Display(
        eotf="linear", white_luminance_cd_m2=1.0, pixel_pitch_mrad=1.0, background_luminance_cd_m2=rule
    )
    with ArrayFrame(Path("a"), light) as file:
        for call in (
            partial(of_frames.read_contrast, triangle=PLACE),
            partial(of_frames.check_pixels, triangle=PLACE),
        ):
            with pytest.raises(
                tod.FrameError, match=rf"^a: background luminance .*is {found:g} cd/m², expected > 0$"
            ):
                call(file, display, FrameReference("a", None, None))


def test_contrast_beyond_all_numbers_is_refused() -> None:
    for largest, background in ((1e308, 2.0), (1e308, 0.6), (0.0, 1.0)):
        of_frames.check_contrast(largest, background)
    with pytest.raises(
        tod.DataError, match="the contrast is beyond all numbers; expected luminances nearer to the"
    ):
        of_frames.check_contrast(1e308, 0.5)


@pytest.mark.parametrize(
    ("size_px", "rows", "columns"),
    # Reach: three sizes, or 1.1 sizes and 2 + 8 pixels, on all sides of (20.2, 31.6).
    [(10.0, (4, 63), (0, 51)), (2.0, (19, 45), (8, 33)), (20.0, (4, 90), (0, 81)), (1e30, (4, 90), (0, 100))],
)
def test_the_window_about_a_triangle(size_px, rows, columns) -> None:
    assert surround_window(TrianglePlace(20.2, 31.6, size_px), rows=(4, 90), columns=(0, 100)) == (rows, columns)


def test_the_extent_and_the_noise_of_a_background() -> None:
    """A plane with noise of 2 % in each pixel, and the same in a dark frame; blocks have 2 x 2 pixels."""
    rng, triangle = np.random.default_rng(4), TrianglePlace(52.0, 41.0, SIZE_PX)
    y, x = np.mgrid[:SIDE, : SIDE + 20]
    plane = 50.0 + 0.1 * (x - 52) + 0.05 * (y - 41)
    light = plane + rng.normal(size=plane.shape)
    window = surround_window(triangle, rows=(0, SIDE), columns=(0, SIDE + 20))
    inside = (x >= 32) & (x < 80) & (y >= 17) & (y < 67)
    for shown, extent in ((light, window), (np.where(inside, light, 5.0), ((17, 67), (32, 80)))):
        sums = SurroundSums(triangle, window)
        sums.add(shown[11:72, 22:83], 11, 22)
        surface = sums.surface()
        assert (surface.extent, surface.window, surface.middle) == (extent, ((11, 72), (22, 83)), (41, 52))
        # Some 500 blocks around it know the light at the triangle to some 0.05 cd/m², and the slopes.
        assert np.abs(surface.luminance((30, 55), (40, 65)) - plane[30:55, 40:65]).max() < 0.25
        if shown is light:  # means of 4 pixels have half the standard deviation; 1500 triples know it to 4 %
            assert surface.noise_cd_m2 == pytest.approx(0.5, rel=0.12)


def test_sums_of_blocks() -> None:
    values = np.random.default_rng(1).random((7, 11))
    expected = np.zeros((4, 6))
    np.add.at(
        expected,
        tuple((at + first) // 3 for at, first in zip(np.indices(values.shape), (5, 7), strict=True)),
        values,
    )
    sums, first = block_sums(values, 5, 7, 3)
    assert first == (1, 2)
    np.testing.assert_allclose(sums, expected[1:, 2:], rtol=1e-12)
    assert block_sums(values, 5, 7, 1)[1] == (5, 7)
    assert [median(np.array(one)) for one in ([3.0], [4.0, 1.0], [9.0, 2.0, 4.0])] == [3.0, 2.5, 4.0]


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


def test_a_frame_without_surround_is_refused() -> None:
    made = frames()
    with pytest.raises(tod.FrameError, match=r"no pixels around the triangle to take the background from"):
        threshold(([image[39:57, 39:57] for image in made[0]], made[1]), "surround", position=(8.5, 8.5))


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
