"""Frames in memory are scored as files are, and refused as files are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import todframes as tod
from todframes.frames.memory import memory_dataset
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.score import score_dataset

SAMPLES = Path(__file__).parents[2] / "sample_frames"
SIDE = 48
LINEAR = {"eotf": "linear", "pixel_pitch_mrad": 0.3, "background_luminance_cd_m2": 50.0}
DISPLAY = tod.Display(white_luminance_cd_m2=1.0, **LINEAR)
ADAPTED = tod.find_observer("csf")(luminance_cd_m2="background")
GLARE = {"display": replace(DISPLAY, background_luminance_cd_m2=1e7), "observer": ADAPTED}
UNSEEN = GLARE | {"display": replace(DISPLAY, background_luminance_cd_m2="border")}


def frame(orientation="up", contrast=0.2):
    turn = tod.Orientation(orientation)
    triangle = tod.coverage((SIDE, SIDE), size_px=6.0, x_px=23.5, y_px=23.5, orientation=turn)
    return 50.0 * (1.0 + contrast * triangle)


def scored(frames, **changes):
    shown = {"orientation": "up", "level": 0.2, "size_mrad": 1.8, "display": DISPLAY, "examples": False}
    return tod.score_frames(frames, **(shown | changes))


def test_integers_are_divided_by_their_full_scale():
    """A code of 8 bits is the same share of full scale as 257 times it in 16 bits, and as the quotient itself."""
    codes = np.round(frame(contrast=0.5) * 2.0).astype(np.uint8)
    shown = {"display": tod.Display(white_luminance_cd_m2=127.5, **LINEAR), "decisions": "sampled", "level": 0.5}
    of_type = [
        scored([one] * 8, **shown).trials.records
        for one in (codes, codes.astype(np.uint16) * 257, (codes / 255.0).astype(np.float32))
    ]
    assert of_type[0] == of_type[1] == of_type[2]


def test_texts_that_look_like_numbers_are_no_numbers():
    """Cameras named 1 and 01 are two, as are 1e5 and 100000; numbers are equal as numbers."""
    shown = {"orientation": "up", "level": 1.0, "size_mrad": 1.0, "display": DISPLAY}
    images = [np.zeros((2, 6))] * 4
    data = memory_dataset(images, group={"camera": ["1", "01", "1e5", "100000"]}, **shown)
    assert [group for group, _ in data.trials.by_group()] == [("1",), ("01",), ("1e5",), ("100000",)]
    data = memory_dataset(images, group={"iso": [100, 1e5, 100.0, 100000]}, **shown)
    assert [group for group, _ in data.trials.by_group()] == [(100.0,), (1e5,)]


def test_the_gaze_of_a_dataset_is_its_default():
    data = memory_dataset([frame()] * 4, orientation="up", level=0.2, size_mrad=1.8, display=DISPLAY)
    fixed = replace(data, gaze="fixed")
    how = {"examples": False, "fit": tod.FitSettings(resamples=40)}
    asked = [tod.score(fixed, **how), tod.score(fixed, gaze="tracked", **how), tod.score(data, **how)]
    assert [result.settings["gaze"] for result in asked] == ["fixed", "tracked", "tracked"]
    assert tod.compare(fixed, enhance="none", **how).settings["gaze"] == "fixed"


def test_frames_of_a_trial_are_averaged():
    """A frame and its mirror image in contrast have the mean of no contrast: all answers are alike."""
    pair = [frame(contrast=0.3), frame(contrast=-0.3)]
    steady = tod.PyramidObserver(position_jitter_samples=0.0)
    (record,) = scored(pair, trial=["a", "a"], observer=steady).trials.records
    assert record["n_frames"] == 2
    assert record["p_correct"] == pytest.approx(0.25, abs=1e-6)  # 32-bit code values


@pytest.mark.parametrize(
    ("frames", "changes", "message"),
    [
        ([], {}, r"frames: found none, expected at least one"),
        ([frame()], {"orientation": ["up", "left"]}, r"orientation: found 2 values, expected 1, one a frame"),
        ([frame()], {"orientation": "upwards"}, r"frame 0: orientation: found 'upwards', expected up"),
        ([frame()], {"level": 0.0}, r"frame 0: contrast: found '0', expected a finite number > 0"),
        ([frame()], {"size_mrad": [np.nan]}, r"size_mrad\[0\]: found nan, expected a finite number"),
        ([frame()], {"polarity": 2}, r"frame 0: polarity: found '2', expected 1 or -1"),
        ([frame()], {"position": (np.inf, 1.0)}, r"frame 0: x_px: found 'inf', expected a finite number"),
        ([frame()] * 2, {"trial": ["a", "a"], "level": [0.1, 0.2]}, r"frame 1: contrast: found 0.2, expected"),
        (
            [frame()],
            {"clip": "a", "time_s": 0, "judged": False},
            "judged: found no frame that is judged",
        ),
        ([frame()], {"observer": 3}, "observer: found 3, expected text or Observer"),
        (
            [frame()],
            {"observer": tod.PyramidObserver},
            r"<class '.*PyramidObserver'>, expected text or Observer",
        ),
        ([frame()], {"on_error": "ignore"}, "on_error: found 'ignore', expected one of stop, skip"),
        ([frame() * np.nan], UNSEEN, "luminance_cd_m2: found background, which no frame shows; expected a number"),
        ([frame()], GLARE, r"the background of the display: luminance_cd_m2: found 10000000\.0, expected a"),
    ],
)
def test_arguments_that_cannot_be(frames, changes, message):
    with pytest.raises((tod.DataError, tod.SettingsError), match=message):
        scored(frames, **changes)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((SIDE, SIDE, 2)), r"frame 0: found an array of float32 and shape \(48, 48, 2\), expected"),
        (np.zeros((SIDE, SIDE), dtype=np.int64), r"frame 0: found an array of int64"),
        (np.zeros((0, SIDE)), r"frame 0: found an array of float32 and shape \(0, 48, 1\)"),
        (np.full((SIDE, SIDE), np.nan), r"^in memory/frame 0: \d+ pixels are NaN or infinite"),
        (np.full((4, 4), 50.0), r"frame 0: the frame has 4 × 4 pixels, smaller than the triangle of 1\.8 mrad"),
    ],
)
def test_frames_that_cannot_be_used(image, message):
    with pytest.raises(tod.FrameError, match=message):
        scored([image])


@pytest.mark.parametrize("background", [1e-6, "border", "frame_mean"])
def test_the_brightest_pixels_of_float32_are_seen(background):
    """In the apex of the upright triangle a single pixel decides; all pixels alike are chance."""
    largest = float(np.finfo(np.float32).max)
    apex = np.full((65, 65), 1e-6)
    apex[29, 32] = largest
    display = tod.Display(
        white_luminance_cd_m2=1.0, **LINEAR | {"pixel_pitch_mrad": 1.0, "background_luminance_cd_m2": background}
    )
    frames = memory_dataset(
        [apex, np.full((65, 65), largest)], orientation="up", level=0.25, size_mrad=5.0, display=display
    )
    assert score_dataset(frames, PyramidObserver()).p_correct == pytest.approx([1.0, 0.25], abs=1e-9)
