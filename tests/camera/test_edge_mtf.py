"""MTF of slanted edges: against closed forms, another program's figures, and what is refused."""

from __future__ import annotations

import re
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from edges import diffraction, edge_image, gaussian, true_mtf
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter
from scipy.special import ndtr

import todframes as tod
from todframes.camera.edge_mtf import FREQUENCY_CYC_PER_PIXEL, NYQUIST, SYSTEMATIC, measure_edge
from todframes.camera.measure_mtf import HOW_MEASURED
from todframes.camera.mtf_table import read_mtf_table
from todframes.camera.slanted_edges import _mean, find_edges
from todframes.cli.console import run
from todframes.cli.main import cli

REAL = Path(__file__).parents[1] / "recordings" / "slanted_edges"
TO_NYQUIST = FREQUENCY_CYC_PER_PIXEL[: NYQUIST + 1]


def whole(image):
    return (0, 0, image.shape[1], image.shape[0])


@pytest.mark.parametrize(
    ("optics", "angle_deg", "largest"),
    [
        # Distances in a bin of 0.1 pixels take (π f · 0.1)² / 6 = 0.4 % at f = 0.5, if they are even.
        (gaussian(0.5), 5.0, 3e-4),
        (gaussian(1.0), -95.0, 3e-4),
        (gaussian(2.0), 9.0, 4e-3),
        # An MTF of 1 − c |f| has a profile that nears its level by c / (2 π² d), so that c / (π² d) of the
        # contrast lies beyond d, here about 32 pixels: c = 4 / (π f_c).
        (diffraction(1.0), 175.0, 0.005),
        (diffraction(0.6), 25.0, 0.008),
    ],
)
def test_closed_forms(optics, angle_deg, largest):
    image = edge_image((72, 76), angle_deg, optics)
    found = measure_edge(image, whole(image))
    assert np.abs(found.mtf[: NYQUIST + 1] - true_mtf(TO_NYQUIST, optics, angle_deg)).max() < largest
    # The direction is that from dark to bright; a turn of 0.01° moves the ends by 0.006 pixels.
    assert abs((found.record.normal_deg - angle_deg + 180) % 360 - 180) < 0.01
    assert found.record.overshoot < 0.004
    assert (found.record.dark, found.record.bright) == (pytest.approx(0.2, abs=2e-3), pytest.approx(0.8, abs=2e-3))


@pytest.mark.parametrize("angle_deg", [np.degrees(np.arctan(ratio)) for ratio in (1 / 2, 2 / 3, 3 / 4, 4 / 5)])
def test_an_edge_whose_slope_is_a_ratio_of_small_numbers_has_its_mtf(angle_deg):
    """The distances of its pixels lie on a lattice, and some bins are empty."""
    image = edge_image((72, 76), angle_deg, gaussian(0.25))
    found = measure_edge(image, whole(image))
    assert found.mtf[: NYQUIST + 1] == pytest.approx(true_mtf(TO_NYQUIST, gaussian(0.25), angle_deg), abs=4e-3)


def test_a_plane_of_a_mosaic_has_the_mtf_of_its_detectors():
    """In cycles a pixel of the plane, which has twice the pitch. A mean of both greens has cos(0.5 π f)."""
    optics, angle_deg = gaussian(1.0), 95.0
    mosaic = edge_image((160, 160), angle_deg, optics) * np.tile([[0.6, 1.0], [1.0, 0.4]], (80, 80))
    found = tod.mtf(mosaic, boxes=[(0, 0, 80, 80)], plane=(0, 1)).mtf
    truth = true_mtf(FREQUENCY_CYC_PER_PIXEL / 2, optics, angle_deg)
    assert found.mtf[: NYQUIST + 1] == pytest.approx(truth[: NYQUIST + 1], abs=0.01)
    with pytest.raises(tod.SettingsError, match="plane: array has three colours at each pixel, expected a mosaic"):
        tod.mtf(np.dstack([mosaic] * 3)[np.newaxis], plane=(0, 1))


def test_a_bent_edge_has_the_mtf_of_a_straight_one():
    optics = gaussian(0.6)
    image = edge_image((72, 72), 8.0, optics, radius_px=400.0)
    found = measure_edge(image, whole(image))
    # The arc's sagitta: 72² / (8 · 400) / cos³ 8° = 1.66 pixels.
    assert found.record.bend_px == pytest.approx(1.66, rel=0.05)
    # Its normal turns by up to 5° from that in the middle: the pixel's MTF at Nyquist changes by less than 1e-3.
    assert np.abs(found.mtf[: NYQUIST + 1] - true_mtf(TO_NYQUIST, optics, 8.0)).max() < 2e-3


def test_overshoot_of_a_sharpened_edge():
    """The profile with a difference of Gaussians added, whose largest value is known."""
    y, x = np.indices((72, 72)) - 35.5
    d = x * np.cos(0.1) + y * np.sin(0.1)

    def sharpened(at):
        return ndtr(at / 0.8) + 0.5 * (ndtr(at / 0.8) - ndtr(at / 2.5))

    grid = np.linspace(-8, 8, 1601)
    means = np.convolve(sharpened(grid), np.full(100, 0.01), "valid")
    found = measure_edge(0.3 + 0.4 * sharpened(d), whole(d))
    assert found.record.overshoot == pytest.approx(means.max() - 1.0, abs=1e-3)  # places are 0.05 pixels apart
    assert found.record.undershoot == pytest.approx(-means.min(), abs=1e-3)
    assert found.mtf.max() > 1.1


def test_the_band_is_as_wide_as_its_noise_and_light_may_change_along_the_edge():
    optics, rng = gaussian(0.6), np.random.default_rng(3)
    y, x = np.indices((100, 72)) - 40.0
    along = y * np.cos(np.radians(4.0)) - x * np.sin(np.radians(4.0))
    image = edge_image((100, 72), 4.0, optics) * (1.0 + 1e-3 * along)
    noise = rng.normal(0.0, 0.012, (12, *image.shape))
    each = [measure_edge(image + one, whole(image)) for one in noise[:3]]
    of_mean = measure_edge(image + noise.mean(0), whole(image))
    truth = true_mtf(TO_NYQUIST, optics, 4.0)
    widths = [np.ptp(one.curves[1:], 0)[8 : NYQUIST + 1] for one in (*each, of_mean)]
    widths = [float(np.sqrt(width**2 - (2 * SYSTEMATIC) ** 2).mean()) for width in widths]
    # Twelve frames have √12 less noise; each width is known to about 10 %.
    assert np.mean(widths[:3]) / widths[3] == pytest.approx(np.sqrt(12), rel=0.25)
    # 2.5 half-widths, 4.9 standard errors.
    middle, half = of_mean.curves[1:].mean(0), np.ptp(of_mean.curves[1:], 0) / 2
    assert (np.abs(middle[1 : NYQUIST + 1] - truth[1:]) < 2.5 * half[1 : NYQUIST + 1] + 2e-4).all()


def torn(image):
    """Every other twelve rows are moved by a pixel."""
    shift = np.arange(72)[:, None] // 12 % 2
    return np.take_along_axis(image, np.clip(np.arange(72) + shift, 0, 71), 1)


AN_EDGE = edge_image((72, 72), 5.0, gaussian(0.6))
NOISE = np.random.default_rng(1).normal(0.0, 0.1, (72, 72))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (0.0 * AN_EDGE + 0.5, "box 0,0,72,72: found no edge: all values are the same"),
        (0.5 + NOISE, "found no edge: along a smooth curve the steepest step is .* against noise of .*, expected"),
        (edge_image((72, 72), 0.2, gaussian(0.5)), "0.20° from rows or columns, whose pixels leave a gap of 0.7"),
        # A square wave of ±0.5 pixels.
        (torn(AN_EDGE), r"departs from a smooth curve by 0\.(4[5-9]|5[0-5]) pixels, expected at most 0.15; is it"),
        (AN_EDGE + NOISE, "noise of 1.*% of the contrast leaves MTF50 at .*average frames"),
        (np.indices((72, 72)).sum(0) % 2 * 1.0, "found no edge that follows a smooth curve, expected one that is"),
        (AN_EDGE[:, 26:46], "found an edge with 9.[0-9] pixels beside it, expected at least 10 on both sides"),
    ],
)
def test_what_is_no_edge_is_one_line(image, message):
    with pytest.raises(tod.DataError, match=message):
        measure_edge(image, whole(image))


def wave(height_px, period_px):
    return lambda s: height_px * np.sin(2.0 * np.pi * s / period_px + 0.3)


@pytest.mark.parametrize(
    ("displaced_px", "rms_px", "noise"),
    [
        (wave(4.0, 38.0), 2.83, 0.0),
        (wave(1.0, 10.0), 0.71, 0.1),
        (wave(2.0, 6.0), 1.41, 0.1),
        (wave(9.0, 38.0), 6.36, 0.0),
        (lambda s: 3.0 * (np.abs(s - 20.0) < 8.0), 1.0, 0.0),
    ],
)
def test_an_edge_that_is_not_straight_is_refused_in_any_noise(displaced_px, rms_px, noise):
    image = edge_image((120, 80), 5.0, gaussian(0.6), low=0.0, high=1.0, displaced_px=displaced_px)
    with pytest.raises(tod.DataError, match="found an edge that departs from a smooth curve by") as raised:
        measure_edge(image + np.random.default_rng(4).normal(0.0, noise, image.shape), whole(image))
    # Displacements beyond the profile's width are found too large by a quarter, or too small by half; a cubic
    # takes part of a notch.
    assert 0.5 < float(re.search(r"by (\S+) pixels", str(raised.value))[1]) / rms_px < 1.35


@pytest.mark.parametrize("kind", ["pixels", "smoothed", "rows", "by light"])
def test_a_smooth_edge_is_not_refused_for_its_noise(kind):
    """Noise of 8 % of the contrast, which alone displaces each row by some 0.15 pixels, on a bent edge."""
    image = edge_image((120, 80), 5.0, gaussian(0.9), low=0.0, high=1.0, radius_px=500.0)
    rng = np.random.default_rng(7)
    noise = rng.normal(0.0, 0.08, image.shape)
    if kind == "smoothed":
        noise = 3.0 * uniform_filter(noise, 3)
    if kind == "rows":
        noise = noise / 2 + rng.normal(0.0, 0.08, (120, 1))
    if kind == "by light":
        noise = noise * np.sqrt(2.0 * np.clip(image, 0.0, 1.0))
    found = measure_edge(image + noise, whole(image))
    expected = np.sqrt(np.log(2) / 2) / np.pi / np.hypot(0.9, np.sqrt(1 / 12))  # a pixel has a variance of 1/12
    assert found.record.mtf50_cyc_per_pixel == pytest.approx(expected, rel=0.15)  # four standard errors


def test_dead_pixels_on_the_edge_change_nothing_that_noise_would_not():
    image = edge_image((120, 80), 5.0, gaussian(0.6), low=0.0, high=1.0)
    image += np.random.default_rng(5).normal(0.0, 0.01, image.shape)
    alive = measure_edge(image, whole(image))
    dead = image.copy()
    for k, row in enumerate(range(10, 110, 12)):
        dead[row, np.argmax(image[row] > 0.5) + k % 3 - 1] = (-0.4, 1.4)[k % 2]
    dead[30, 10] = dead[90, 70] = -0.5
    found = measure_edge(dead, whole(dead))
    # 10 of some 400 pixels of the profile are missing: a change of 1/6 of the standard error, by chance up to 1/2.
    to_nyquist = slice(1, NYQUIST + 1)
    changed = np.abs(found.mtf - alive.mtf)[to_nyquist]
    assert (changed < 0.125 * np.ptp(alive.curves[1:], 0)[to_nyquist]).all()
    assert found.record.noise_percent == pytest.approx(alive.record.noise_percent, rel=0.01)


def test_a_saturated_edge_and_a_box_outside_are_one_line(tmp_path, capsys):
    for picture, display, message in (
        (np.tile(np.arange(72.0), (72, 1)), None, "found no straight edge of at least 40 pixels that stands"),
        (torn(AN_EDGE), None, "no edge can be measured: box .*: found an edge that departs from a smooth curve"),
        (AN_EDGE, "srgb_monitor", "display: array has values without a white, expected code values"),
    ):
        with pytest.raises(tod.TodframesError, match=message):
            tod.mtf(picture, display=display)
    image = edge_image((72, 72), 5.0, gaussian(0.6), low=40.0, high=300.0)
    np.save(tmp_path / "a.npy", np.clip(image, 0, 255).astype(np.uint8))
    assert run(cli, ["mtf", str(tmp_path / "a.npy"), "--box", "0,0,72,72"]) == 1
    assert "of the pixels are at an end of the scale: the edge is saturated" in capsys.readouterr().err
    for given, message in (
        ("10,0,72,72", "a.npy: box 10,0,72,72: expected x, y, width, height of at least 20 x 20 pixels within"),
        ("1,2,3", "error: --box: found '1,2,3', expected whole numbers as X,Y,W,H"),
        ("0,0,72,72 --chart x.toml", "error: --box: is given with --chart, expected one of them"),
    ):
        assert run(cli, ["mtf", str(tmp_path / "a.npy"), "--box", *given.split()]) == 2
        assert message in capsys.readouterr().err


def square(angle_deg, sigma_px, rng):
    """A dark square with Gaussian edges; corners are products of two edges."""
    angle = np.radians(angle_deg)
    y, x = np.indices((200, 240)) - np.array([95.0, 121.0])[:, None, None]
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    inside = [ndtr((one + 50.0) / sigma_px) * ndtr((50.0 - one) / sigma_px) for one in (u, v)]
    return 200.0 - 120.0 * inside[0] * inside[1] + rng.normal(0.0, 1.0, x.shape)


def test_the_four_edges_of_a_square_are_found_and_are_in_their_boxes():
    one = square(10.0, 0.8, np.random.default_rng(1))
    boxes = find_edges(one)
    assert len(boxes) == 4
    # A second square beside it, some of whose edges lie on the lines of the first's.
    assert len(find_edges(np.hstack([one, one[:, ::-1]]))) == 8
    assert len(find_edges(np.vstack([one, np.roll(one, -35, 1)]))) == 8
    angle = np.radians(10.0)
    middles = [(121 + s * 50 * c, 95 + s * 50 * d) for s in (1, -1) for c, d in ((np.cos(angle), np.sin(angle)),)]
    middles += [(121 - s * 50 * np.sin(angle), 95 + s * 50 * np.cos(angle)) for s in (1, -1)]
    for x, y in middles:
        assert sum(a + w / 3 < x < a + 2 * w / 3 and b + h / 3 < y < b + 2 * h / 3 for a, b, w, h in boxes) == 1


def test_colours_and_files_have_the_same_numbers(tmp_path):
    """A colour picture with a blur for each colour: the CSV is read again."""
    colours = [edge_image((72, 72), 6.0, gaussian(one), low=40, high=200) for one in (0.9, 0.7, 0.5)]
    frames = np.stack([np.stack(colours, -1)] * 2) + np.random.default_rng(2).normal(0, 0.5, (2, 72, 72, 3))
    found = tod.mtf(frames.astype(np.float32), boxes=[(0, 0, 72, 72)])
    for name, sigma_px in zip(("red", "green", "blue"), (0.9, 0.7, 0.5), strict=True):
        expected = true_mtf(TO_NYQUIST, gaussian(sigma_px), 6.0)
        # The standard error at Nyquist is 0.25 % · π · √(32 pixels / 72 rows) = 0.5 %: four of them.
        assert np.abs(found.mtf.others[name][: NYQUIST + 1] - expected).max() < 0.02
    assert found.mtf.n_frames == 2 and list(found.mtf.others) == ["red", "green", "blue"]
    assert [(one.edge, one.colour) for one in found.mtf.edges] == [
        (1, c) for c in ("luma", "red", "green", "blue")
    ]
    for edge in found.mtf.edges:  # levels of 1,000 pixels with noise of 0.35
        assert (edge.dark, edge.bright) == (pytest.approx(40, abs=0.3), pytest.approx(200, abs=0.3))
    assert found.sentences()[-2:] == [
        "Mean of 1 edge in 2 frames.",
        "The values were taken as proportional to light.",
    ]
    assert found.remarks() == [HOW_MEASURED]
    curves, boxes, profiles = axes = [Figure().subplots() for _ in range(3)]
    for one, figure in zip(axes, found.figures(), strict=True):
        figure.draw(one)
    np.testing.assert_array_equal(curves.lines[0].get_ydata(), found.mtf.mtf)
    assert [text.get_text() for text in curves.texts] == ["Nyquist 0.5"]
    assert (boxes.patches[0].get_bbox().bounds, len(profiles.lines)) == ((-0.5, -0.5, 72, 72), 1)
    (tmp_path / "mtf.csv").write_bytes(found.data_files()["mtf.csv"])
    assert tod.mtf(tmp_path / "mtf.csv").mtf.mtf50 == pytest.approx(found.mtf.mtf50, rel=1e-4)
    table = read_mtf_table(tmp_path / "mtf.csv", may_exceed_1=True)
    np.testing.assert_array_equal(table.curves["mtf"], found.mtf.mtf)
    np.testing.assert_array_equal(table.band, [found.mtf.mtf_lower, found.mtf.mtf_upper])
    with pytest.raises(tod.SettingsError, match=r"boxes: .*mtf.csv is a table of an MTF, expected a recording"):
        tod.mtf(tmp_path / "mtf.csv", boxes=[(0, 0, 72, 72)])


def test_a_display_undoes_the_encoding():
    """Code values of a gamma of 2.2 give back the MTF of light; taken as they are, they do not."""
    light = edge_image((72, 72), 6.0, gaussian(0.7), low=0.05, high=0.9)
    code = (255 * 257 * light ** (1 / 2.2)).astype(np.uint16)
    settings = {"white_luminance_cd_m2": 100.0, "pixel_pitch_mrad": 0.5, "background_luminance_cd_m2": "surround"}
    display = tod.Display(eotf="gamma", gamma=2.2, **settings)
    expected = true_mtf(TO_NYQUIST, gaussian(0.7), 6.0)
    as_light = tod.mtf(code, boxes=[(0, 0, 72, 72)], display=display)
    assert np.abs(as_light.mtf.mtf[: NYQUIST + 1] - expected).max() < 1e-3  # 16 bits
    as_code = tod.mtf(code, boxes=[(0, 0, 72, 72)])
    assert np.abs(as_code.mtf.mtf[: NYQUIST + 1] - expected).max() > 0.02
    assert "proportional to light" in " ".join(as_code.sentences())


@pytest.mark.parametrize(("optics", "noise"), [(gaussian(0.7), 4.0), (gaussian(1.5), 20.0)])
def test_an_edge_that_is_cut_off_at_any_value_is_warned_of(optics, noise):
    """A step of 2,000; cutting 0.5 % of it raises MTF50 by 1 %, 12 % by 20 %."""
    step = edge_image((72, 72), 5.0, optics, low=300.37, high=2300.37)
    step += np.random.default_rng(1).normal(0.0, noise, step.shape)
    for cut, low, high, scale in (
        *((False, 0, 9999, 1), (False, 0, 9999, 4095), (True, 0, 2290, 1), (True, 0, 2250, 4095)),
        *((True, 0, 2060, -1), (True, 540, 9999, 1)),
    ):
        values = np.clip(np.rint(step), low, high) / scale
        values = values.astype({1: np.uint16, -1: np.int16}.get(scale, np.float32))
        codes = [warning.code for warning in tod.mtf(values, boxes=[(0, 0, 72, 72)]).warnings]
        assert codes == ["saturated"] * cut, (low, high, scale)


def test_a_colour_that_is_cut_off_is_named():
    step = edge_image((72, 72), 5.0, gaussian(0.7), low=300.37, high=2300.37)
    step += np.random.default_rng(2).normal(0.0, 4.0, step.shape)
    coloured = np.minimum(np.rint(np.stack([0.8 * step, step, 0.6 * step], -1)[None]), 2200)
    found = tod.mtf(coloured.astype(np.uint16), boxes=[(0, 0, 72, 72)]).warnings
    assert [(one.code, one.message[:6]) for one in found] == [("saturated", "green:")]


def test_code_values_count_from_black_and_their_ends_are_saturated():
    """Of 16 to 236 half is 126; means are those of two frames, a pixel at an end in one of them is saturated."""
    frames = [np.array([[16.0, 126.0, 38.0]]), np.array([[126.0, 126.0, 236.0]])]
    film = Mock(full_scale=236.0, zero=16.0, ends=(16.0, 236.0), shape=(1, 3), n_frames=2)
    film.frames.return_value = [Mock(values=one) for one in frames]
    display = tod.Display(
        eotf="linear", white_luminance_cd_m2=80.0, pixel_pitch_mrad=1, background_luminance_cd_m2=1
    )
    n_frames, colours, saturated, _ = _mean(film, display, None)
    assert (n_frames, saturated.tolist()) == (2, [[True, False, True]])
    np.testing.assert_allclose(colours["luma"], [[20.0, 40.0, 44.0]])


OTHER_PROGRAM = {
    "f2": (0.854, 0.604, 0.353, 0.350),
    "f2.8": (0.960, 0.798, 0.473, 0.479),
    "f16": (0.767, 0.299, 0.180),
}
"""MTF at 0.1, 0.25 and 0.5 cycles/pixel, and MTF50, by SFR_calculation_code, from which the pictures are.

At F/16 the MTF at 0.5 cycles/pixel is noise: 0.002 there, here 0 with a band to 0.041.
"""


@pytest.mark.parametrize("name", OTHER_PROGRAM)
def test_real_edges_with_the_window_of_another_program(name):
    """It multiplies the line spread by a Hann window, which cuts the lens's halo; that is the difference.

    Half the window is 1.5 widths of the line spread, seen in means over 9 quarters of a pixel, at a tenth of its
    height, and 5 pixels at the least.
    """
    image = tod.read_frame(REAL / f"{name}.png").stored[..., 0].astype(float)
    found = measure_edge(image, whole(image))
    x, width, steps = found.distance_px[:-1], np.diff(found.distance_px), np.diff(found.profile)
    x = x + width / 2
    fine = np.arange(x[0], x[-1], 0.05)
    smooth = np.convolve(np.interp(fine, x, steps / width), np.ones(45), "same")
    centre = fine[np.argmax(smooth)]
    half = max(1.5 * np.ptp(fine[smooth > 0.1 * smooth.max()]), 5.0)
    windowed = steps * np.where(np.abs(x - centre) < half, 0.5 + 0.5 * np.cos(np.pi * (x - centre) / half), 0.0)
    f = np.arange(0.0, 0.6, 0.001)
    mtf = np.abs(np.exp(-2j * np.pi * np.outer(f, x)) @ windowed) / abs(windowed.sum())
    mtf /= np.sinc(f / 10) ** 2  # bins and differences of a tenth of a pixel
    *at, mtf50 = OTHER_PROGRAM[name]
    np.testing.assert_allclose(mtf[[100, 250, 500][: len(at)]], at, rtol=0.02)
    assert f[np.argmax(mtf < 0.5)] == pytest.approx(mtf50, rel=0.02)
    # Without the window the halo counts: the MTF is lower at low frequencies.
    assert np.interp(0.1, FREQUENCY_CYC_PER_PIXEL, found.mtf) < at[0]
