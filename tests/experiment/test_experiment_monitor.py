"""Calibration of a person's monitor, and the code values that show a trial on it."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from people import MEASURES

from todframes.base.errors import FrameError, SettingsError
from todframes.experiment.monitor import (
    ContrastRange,
    Monitor,
    TrialImage,
    calibrated,
    check_shows,
    clipped,
    contrast_range,
    dithered_codes,
    png,
    shown_codes,
    shown_contrast,
    trial_image,
    viewing_distance_mm,
)
from todframes.frames.dataset import load_dataset
from todframes.frames.files import FrameFile, read_frame, write_frame
from todframes.frames.surround import TrianglePlace
from todframes.frames.trials import FrameReference, Trial
from todframes.stimulus import ORIENTATIONS, Orientation, Stimulus, coverage


def made(*, background: float = 0.5, dither: bool = True, **changes: object) -> Monitor:
    return calibrated(replace(MEASURES, **changes), background=background, dither=dither)


MONITOR = made()


def test_pitch_and_distance_give_the_angle():
    # 0.25 mm at 1 m is 0.25 mrad.
    assert math.isclose(MONITOR.pixel_pitch_mrad, 0.25, rel_tol=1e-8)
    distance = viewing_distance_mm(pixel_pitch_mm=0.25, pixel_pitch_mrad=MONITOR.pixel_pitch_mrad)
    assert math.isclose(distance, 1000.0, rel_tol=1e-12)


def test_background_is_the_code_at_or_below_what_was_asked():
    luminance = MONITOR.luminance_of_code()
    code = MONITOR.background_code
    assert luminance[code] <= 0.5 < luminance[code + 1]
    assert MONITOR.background_relative == luminance[code]
    assert MONITOR.contrast_of_code()[code] == 0.0
    # Gamma 1 has the luminance code / 255.
    assert made(gamma=1.0, background=51 / 255).background_code == 51


def test_readings_are_met_and_between_them_a_power_law_is():
    readings = tuple((code, 0.4 + 180.0 * (code / 255) ** 2.2) for code in (0.0, 32.0, 96.0, 160.0, 255.0))
    found = made(photometer=readings)
    assert found.gamma is None
    white = readings[-1][1]
    for code, cd_m2 in readings:
        assert math.isclose(found.luminance_of_code()[int(code)], cd_m2 / white, rel_tol=1e-12)
    assert math.isclose(found.black_relative, 0.4 / white, rel_tol=1e-12)
    assert found.background_luminance_cd_m2 == pytest.approx(found.background_relative * white, rel=1e-12)
    brightest = made(photometer=((255, 1e5), (0, 0.0), (128, 5e4), (64, 2e4)))  # in any order
    assert brightest.luminance_of_code()[[0, 64, 128, 255]] == pytest.approx([0.0, 0.2, 0.5, 1.0], rel=1e-12)
    without_black = tuple((code, 180.0 * (code / 255) ** 2.2) for code, _ in readings)
    assert made(photometer=without_black).luminance_of_code() == pytest.approx(
        MONITOR.luminance_of_code(), rel=1e-9
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"device_pixel_ratio": 1.25}, "resample the frames; set the zoom of the page to 100 %"),
        ({"pixel_pitch_mm": 25.0}, "pixel_pitch_mm: found 25 mm, expected 0.02 to 2 mm"),
        ({"viewing_distance_mm": 60_000.0}, "viewing_distance_mm: found 6e.04 mm"),
        ({"gamma": None}, "gamma, photometer: found none of them"),
        ({"gamma": 9.0}, "gamma: found 9.0, expected 1 to 4; match the half-tone again"),
        *(
            ({"photometer": readings}, message)
            for readings, message in (
                (((0, 1.0), (255, 90.0)), "readings 0: 1, 255: 90 cd/m², expected at least 4 codes"),
                (((1, 1.0), (9, 2.0), (20, 4.0), (255, 90.0)), "with 0 and 255"),
                (((0, 1.0), (9, 2.0), (8, 4.0), (255, 90.0)), "luminance to rise with the code"),
                (((0, -1.0), (9, 2.0), (99, 4.0), (255, 90.0)), "at most 100000 cd/m²"),
                (((0, 60.0), (9, 70.0), (99, 80.0), (255, 90.0)), "take another background"),
            )
        ),
    ],
)
def test_measures_that_are_no_monitor_are_refused(changes, message):
    with pytest.raises(SettingsError, match=message):
        made(**changes)


RANGE = ContrastRange("frames/a.exr", -0.1, 0.2, -0.05, 0.3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frame_px": (1901, 10)}, "has 1901 × 10 pixels, the page has room for 1900 × 1000"),
        ({"pixel_pitch_mrad": 0.1}, "2.5 times that of the dataset .0.1 mrad.* sit 2500 mm from"),
        ({"ranges": [RANGE, RANGE._replace(high=1.5)]}, "1.5 of frames/a.exr.*background of 0.39"),
        ({"ranges": [RANGE._replace(triangle_low=-1.2)]}, "contrast -1.2 .*less contrast or noise"),
    ],
)
def test_monitors_that_cannot_show_the_trials_are_refused(changes, message):
    asked = {"frame_px": (1900, 1000), "pixel_pitch_mrad": 0.25, "ranges": [RANGE]}
    check_shows(MONITOR, **asked)
    with pytest.raises(SettingsError, match=message):
        check_shows(MONITOR, **(asked | changes))


def test_without_dither_a_contrast_below_half_a_code_step_is_refused():
    faint = ContrastRange("frames/a.exr", 0.0, 0.001, 0.0, 0.001)
    asked = {"frame_px": (1, 1), "pixel_pitch_mrad": 0.25, "ranges": [faint]}
    check_shows(MONITOR, **asked)
    with pytest.raises(SettingsError, match=r"below half of a code step, 0\.0059: .*without dither"):
        check_shows(made(dither=False), **asked)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"bits": 10}, "bits: found 10, expected 8"),
        ({"gamma": None}, "gamma, lut: found both or none"),
    ],
)
def test_a_monitor_that_contradicts_itself_is_no_monitor(changes, message):
    with pytest.raises(SettingsError, match=message):
        replace(MONITOR, **changes)


def test_a_monitor_like_the_display_shows_the_codes_of_the_frame(make_dataset):
    # A display with the monitor's gamma, its background the luminance of one code: codes are those of the file.
    background = 100.0 * (186 / 255) ** 2.2
    display = {"eotf": "gamma", "gamma": 2.2, "background_luminance_cd_m2": background}
    dataset = make_dataset(suffix=".png", contrasts=(0.3,), display=display)
    codes = np.random.default_rng(2).integers(0, 256, (48, 48))
    write_frame(dataset.frame(0), codes / 255.0, pixel_type="uint8")
    data = load_dataset(dataset.path)
    image = trial_image(data, data.trials[0])
    for monitor in (MONITOR, made(dither=False)):
        assert monitor.background_code == 186
        np.testing.assert_array_equal(shown_codes(image.contrast, monitor, seed=5), codes)


@pytest.mark.parametrize("suffix", [".exr", ".png"])
@pytest.mark.parametrize("rule", [50.0, "surround", "border"])
def test_without_dither_each_pixel_is_the_frames_within_half_a_code_step(make_dataset, suffix, rule):
    dataset = make_dataset(suffix=suffix, contrasts=(0.3,), display={"background_luminance_cd_m2": rule})
    data = load_dataset(dataset.path)
    monitor = made(dither=False, background=0.6)
    for trial in data.trials:
        stored = np.array(read_frame(data.frame_path(trial.frames[0])).values[..., 0], np.float64)
        wanted = stored * data.display.white_luminance_cd_m2 / 50.0 - 1.0
        found = shown_contrast(shown_codes(trial_image(data, trial).contrast, monitor, 0), monitor)
        step = np.diff(monitor.contrast_of_code()).max()
        # 1e-3: half precision of an EXR, and rounding of a 16-bit PNG, of the background itself.
        assert np.abs(found - wanted).max() <= step / 2.0 + 1e-3


def test_frames_of_a_trial_are_averaged_in_contrast_each_with_its_own_background(make_dataset):
    background = "background_luminance_cd_m2"
    changes = {row: {"trial": f"t{row % 4}", "strength": "0.3", background: "50"} for row in range(8)}
    tables = {"display": {background: "column"}, "experiment": {"level": "strength"}}
    dataset = make_dataset(contrasts=(0.2, 0.4), row_changes=changes, **tables)
    data = load_dataset(dataset.path)
    assert [len(trial.frames) for trial in data.trials] == [2] * 4
    for trial in data.trials:
        triangle = coverage((48, 48), size_px=8, x_px=23.5, y_px=23.5, orientation=trial.orientation)
        # 2e-3: half precision of the EXR, 2^-11, of values up to 70 over a background of 50.
        np.testing.assert_allclose(trial_image(data, trial).contrast, 0.3 * triangle, atol=2e-3)


def test_frames_of_different_sizes_in_a_trial_are_refused(make_dataset):
    changes = {0: {"trial": "a"}, 1: {"trial": "a", "orientation": "up"}}
    dataset = make_dataset(contrasts=(0.2,), row_changes=changes)
    write_frame(dataset.frame(1), np.full((50, 48), 50.0))
    data = load_dataset(dataset.path)
    with pytest.raises(FrameError, match="has 48 × 50 pixels, expected 48 × 48 as in the first frame of trial a"):
        trial_image(data, data.trials[0])


def trial_of(size_px: float, orientation: Orientation) -> Trial:
    frame = FrameReference("frames/a.exr", None, None)
    return Trial(0, "a", (frame,), orientation, Stimulus(size_px), 0.1, (), None, None)


@pytest.mark.parametrize("size_px", [4, 5, 7, 10, 16, 40])
def test_with_dither_the_mean_over_a_triangle_is_right_down_to_a_contrast_of_a_thousandth(size_px):
    # Code steps are 1.2 % of the background. The mean over the area, each pixel weighted with the share of it that
    # the triangle covers, is right within 0.05 % contrast.
    rng = np.random.default_rng(4)
    for contrast in (0.001, -0.001, 0.003, 0.01, 0.1):
        for orientation in ORIENTATIONS:
            x, y = 31.5 + rng.uniform(-0.5, 0.5, 2)
            covered = coverage((64, 64), size_px=size_px, x_px=x, y_px=y, orientation=orientation)
            image = TrialImage(contrast * covered, TrianglePlace(x, y, size_px))
            codes, seed = dithered_codes(trial_of(size_px, orientation), image, MONITOR, int(rng.integers(4096)))
            np.testing.assert_array_equal(codes, shown_codes(image.contrast, MONITOR, seed))
            error = shown_contrast(codes, MONITOR) - image.contrast
            assert abs(np.sum(covered * error) / covered.sum()) <= 5e-4
            # The sum over the whole picture is off by half of a code step of one pixel at most.
            assert abs(np.sum(error)) < 0.0121 / 2


def test_triangles_of_a_few_pixels_get_the_best_of_the_dither_patterns():
    # 2 pixels of size are 4 pixels of area: one code step of one pixel is 0.3 % of contrast there.
    covered = coverage((32, 32), size_px=2, x_px=15.5, y_px=15.5, orientation=Orientation.UP)
    image = TrialImage(0.002 * covered, TrianglePlace(15.5, 15.5, 2))

    def error(codes: np.ndarray) -> float:
        return abs(float(np.sum(covered * (shown_contrast(codes, MONITOR) - image.contrast)) / covered.sum()))

    tried = [error(shown_codes(image.contrast, MONITOR, 9 + k)) for k in range(16)]
    assert min(tried) > 5e-4
    codes, seed = dithered_codes(trial_of(2, Orientation.UP), image, MONITOR, 9)
    assert (error(codes), seed) == (min(tried), 9 + int(np.argmin(tried)))


def test_what_the_monitor_cannot_show_is_counted_and_becomes_its_ends():
    contrast = np.array([[-1.5, -1.0, 0.0, 1.0, 2.0]])
    np.testing.assert_array_equal(clipped(contrast, MONITOR), [[True, False, False, False, True]])
    assert shown_codes(contrast, MONITOR, 0)[0, [0, -1]].tolist() == [0, 255]


def test_range_of_a_trial_has_its_triangle(make_dataset):
    data = load_dataset(make_dataset(contrasts=(0.5,)).path)
    trial = data.trials[0]
    found = contrast_range(trial, trial_image(data, trial))
    assert found.frame == trial.frames[0].path
    assert found.triangle_high == pytest.approx(0.5, abs=2e-3)
    assert found.low == pytest.approx(0.0, abs=2e-3)


def test_png_is_grey_of_8_bits_and_says_nothing_about_colour():
    codes = np.random.default_rng(6).integers(0, 256, (30, 41)).astype(np.uint8)
    content = png(codes)
    stream = BytesIO(content)
    assert stream.read(8) == b"\x89PNG\r\n\x1a\n"
    chunks = []
    while header := stream.read(8):
        length, name = struct.unpack(">I4s", header)
        chunks.append((name, stream.read(length + 4)))
    assert {name for name, _ in chunks} == {b"IHDR", b"IDAT", b"IEND"}
    assert struct.unpack(">IIBBBBB", chunks[0][1][:13]) == (41, 30, 8, 0, 0, 0, 0)
    with FrameFile("memory.png", content=content) as file:  # OpenImageIO; another library wrote it
        np.testing.assert_array_equal(file.read().stored[..., 0], codes)
