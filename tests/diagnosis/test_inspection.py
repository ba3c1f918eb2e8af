"""Frames are measured against what their dataset says: what is found, and which warnings follow."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import triangles
from scipy.ndimage import gaussian_filter, rotate
from triangles import DISPLAY, WIDER

import todframes as tod
from todframes.diagnosis.findings import frame_warnings
from todframes.diagnosis.inspection import (
    Inspection,
    _of_codes,
    _scatter,
    inspect,
)
from todframes.diagnosis.scene_backgrounds import (
    SceneParts,
    numbered_views,
    that_share,
    view_middles,
    whole_views,
    without_scenes,
)
from todframes.diagnosis.triangle import Given, Images, Shape, Square, fit, render, subtract
from todframes.diagnosis.windows import Codes, measure_trial
from todframes.frames.memory import memory_dataset
from todframes.frames.trials import SceneView, Trial, Trials
from todframes.stimulus import Stimulus

SAMPLES = Path(__file__).parents[2] / "sample_frames"
SIDE, SIZE_PX, PITCH_MRAD = 72, 9.0, 0.25
MIDDLE, CENTRE = (SIDE - 1) / 2, (SIDE + WIDER - 1) / 2  # of rows and of columns


def recorded(*, x=0.0, y=0.0, size=1.0, slope=1.0, noise=0.01, scatter=0.0, **changes):
    """A dataset of 24 frames whose triangles are not as stated: in place, size, contrast or orientation."""
    settings = {"side_px": SIDE, "stated_px": SIZE_PX, "levels": (0.05, 0.1, 0.2), "blur_px": 0.7} | changes
    settings |= {"size_px": lambda k: SIZE_PX * (size(k) if callable(size) else size)}
    rng, middle = np.random.default_rng(0), (CENTRE + x, MIDDLE + y)
    return triangles.recording(rng, middle, sign=slope, noise_sd=noise, shake_px=scatter, **settings)[0]


def codes(dataset):
    return {one.code for one in frame_warnings(dataset, inspect(dataset, dataset.trials))}


def measured(**changes):
    dataset = recorded(**changes)
    (found,) = inspect(dataset, dataset.trials)
    return found


def test_what_the_triangles_show_is_measured() -> None:
    """Place, size and contrast at once, within five of the stated errors, which are small."""
    found = measured(x=1.3, y=-0.7, size=1.2, slope=0.8)
    assert found.size_ratio == pytest.approx(1.2, abs=5.0 * found.size_ratio_error)
    assert found.contrast_slope == pytest.approx(0.8, abs=5.0 * found.contrast_slope_error)
    assert found.offset_px == pytest.approx((1.3, -0.7), abs=5.0 * max(found.offset_error_px))
    assert max(found.size_ratio_error, found.contrast_slope_error, *found.offset_error_px) < 0.05
    assert (found.shown_as, found.wrong_orientation, found.wrong_level) == ("as stated", 0, 0)
    # A Gaussian blur and that of a pixel's width, whose variance is 1/12.
    assert found.blur_px == pytest.approx(np.sqrt(0.7**2), abs=0.1)


def test_scatter_is_measured_in_frames_of_different_noise() -> None:
    """A scatter of 0.3 pixels along each axis; a third of the frames is loud, and these do not decide."""

    def louder(luminance, number):
        noise = np.random.default_rng(number).normal(size=luminance.shape)
        return luminance + 15.0 * noise if number % 3 == 0 else luminance

    # The standard deviation of 32 normal deviates is known to 1/√64.
    assert measured(scatter=0.3, spoil=louder).scatter_px == pytest.approx(0.3, rel=3.0 / np.sqrt(64.0))
    assert measured(spoil=louder).scatter_px == 0.0


def test_the_mean_of_a_blurred_pattern_is_no_wrong_background() -> None:
    """All frames share a pattern of 4 %, as strong as their noise, and both are blurred over half of the frame."""
    rng = np.random.default_rng(3)

    def blurred():
        white = rng.normal(size=(SIDE, SIDE + WIDER))
        return 0.04 * 2.0 * 20.0 * np.sqrt(np.pi) * gaussian_filter(white, 20.0, mode="wrap")

    pattern = blurred()
    dataset = recorded(noise=0.001, spoil=lambda luminance, _number: luminance * (1.0 + pattern + blurred()))
    assert codes(dataset) == set()


SRGB = tod.Display(
    eotf="srgb", white_luminance_cd_m2=200.0, pixel_pitch_mrad=PITCH_MRAD, background_luminance_cd_m2="surround"
)


def as_codes(luminance, _number):
    return coded(1.055 * (luminance / 200.0) ** (1 / 2.4) - 0.055, np.uint8)


def coded(share, dtype, step=1):
    return (step * np.rint(share * np.iinfo(dtype).max / step)).astype(dtype)


def with_counter(luminance, number):
    """White digits below the triangle that change from frame to frame, ten times as strong as the triangles."""
    digits = np.kron(np.random.default_rng(number).integers(0, 2, (2, 8)), np.ones((3, 3)))
    luminance[50:56, 12:36] *= 1.0 + 2.0 * digits
    return luminance


BRIGHT = replace(DISPLAY, white_luminance_cd_m2=200.0)


def of_two_codes(luminance, _number):
    """16 bits of 200 cd/m²: the background of 50 cd/m², and the triangle with hard edges."""
    top = luminance.max()
    return coded(np.where(luminance > (50.0 + top) / 2.0, top, 50.0) / 200.0, np.uint16)


CLEAN = {
    "even": {},
    "without noise": {"noise": 0.0},
    "loud": {"noise": 0.3},
    "blurred": {"blur_px": 3.0},
    "dark": {"slope": -1.0, "polarity": -1},
    "placed": {"x": 6.0, "y": -4.0, "position": (CENTRE + 6.0, MIDDLE - 4.0)},
    "sRGB": {"spoil": as_codes, "display": SRGB},
    "surround": {"display": replace(DISPLAY, background_luminance_cd_m2="surround")},
    "border": {"display": replace(DISPLAY, background_luminance_cd_m2="border")},
    "blurred without noise": {"noise": 0.0, "blur_px": 2.5, "scatter": 0.2},
    "counter": {"spoil": with_counter},
    "no contrast": {"slope": 3.0, "level_name": "temperature"},
    "12 bits in floating point": {"spoil": lambda light, _: np.rint(light * 20.0) / np.float32(20.0)},
    "impulses": {
        "spoil": lambda light, k: np.where(np.random.default_rng(k).random(light.shape) < 0.05, 80.0, light)
    },
    "half precision": {"noise": 0.001, "spoil": lambda light, _: light.astype(np.float16)},
    "half precision without noise": {"noise": 0.0, "spoil": lambda light, _: light.astype(np.float16)},
    "two codes": {"noise": 0.0, "blur_px": 0.0, "spoil": of_two_codes, "display": BRIGHT},
}


@pytest.mark.parametrize("changes", CLEAN.values(), ids=CLEAN.keys())
def test_good_frames_have_no_warning(changes) -> None:
    assert codes(recorded(**changes)) == set()


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_frames_without_a_triangle_have_no_place(noise: float) -> None:
    assert codes(recorded(slope=0.0, noise=noise)) == {"contrast_mismatch"}


BOWL = 1.0 - 0.25 * np.square(np.mgrid[:SIDE, -5 : SIDE + 5] / MIDDLE - 1.0).sum(axis=0)
HALVES = np.where(np.arange(SIDE + WIDER) < CENTRE, 1.0, 0.8)
TOP_55 = replace(DISPLAY, white_luminance_cd_m2=55.0)


SPOILT = {
    "background_mismatch with vignetting": {
        "spoil": lambda luminance, _: luminance * BOWL,
        "display": replace(DISPLAY, background_luminance_cd_m2="border"),
    },
    "background_uneven": {"spoil": lambda luminance, _: luminance * HALVES},
    "contrast_mismatch": {"slope": 0.85},
    "contrast_mismatch in some frames": {
        "spoil": lambda light, k: np.full_like(light, 50.0) if k % 4 == 1 else light
    },
    "polarity_mismatch": {"slope": -1.0},
    "mirrored": {"shown": (0, 3, 2, 1)},
    "flipped": {"shown": (2, 1, 0, 3)},
    "turned": {"shown": (1, 2, 3, 0)},
    "turned by eight degrees": {
        "spoil": lambda luminance, _: rotate(luminance, 8.0, reshape=False, mode="nearest", order=1)
    },
    "position_offset": {"x": 1.0, "y": 0.5},
    "position_scatter": {"scatter": 1.0},
    "size_mismatch": {"size": 1.3},
    "size_unit": {"size_mrad": 0.1},
    "saturated": {"spoil": lambda light, _: coded(np.minimum(light / 55.0, 1.0), np.uint8), "display": TOP_55},
    "saturated at 4095 of 16 bits": {
        "spoil": lambda light, _: np.minimum(np.rint(light / 55.0 * 4095.0), 4095).astype(np.uint16),
        "display": replace(DISPLAY, white_luminance_cd_m2=55.0 * 65535 / 4095),
    },
    "saturated in floating point": {"spoil": lambda light, _: np.minimum(light, 55.0)},
    "saturated at 1 after an import": {
        "spoil": lambda light, _: np.minimum(np.rint(light / 55.0 * 4095.0) / np.float32(4095.0), 1.0),
        "display": TOP_55,
    },
    "crushed at an offset": {"spoil": lambda light, _: np.maximum(light, 49.8)},
    "crushed": {"spoil": lambda light, _: coded(np.maximum(light - 50.0, 0.0) / 109.0, np.uint16), "noise": 0.002},
    "coarse_codes": {"spoil": lambda light, _: coded(light / 200.0, np.uint8, 16), "display": BRIGHT},
    "bit_depth": {"spoil": lambda light, _: coded(light / 200.0 * 4095.0 / 65535.0, np.uint16), "display": BRIGHT},
}


@pytest.mark.parametrize(("name", "changes"), SPOILT.items(), ids=SPOILT.keys())
def test_each_mishap_has_its_warning(name, changes) -> None:
    assert name.split()[0] in codes(recorded(**changes))


SOUND = Inspection(
    group=(2.25,), stimulus=Stimulus(2.25), size_px=9.0, stated_px=(35.5, 35.5), are_windows=False, n_trials=24,
    frame_sizes_px=((72, 72),), background_luminance_cd_m2=50.0, ring_luminance_cd_m2=50.0, ring_ratio=1.0,
    ring_ratio_error=0.001, ring_scatter=0.01, level=0.1, noise_contrast=0.01, contrast_slope=1.0,
    contrast_slope_error=0.005, offset_px=(0.0, 0.0), offset_error_px=(0.003, 0.004), scatter_px=0.0,
    size_ratio=1.0, size_ratio_error=0.002, size_scatter=0.0, turned_rad=0.0, turned_error_rad=0.001, blur_px=0.5,
    shown_as="as stated", n_orientation=100, n_level=100, level_scatter=0.1, signal=100.0, saturated_share=0.0,
    crushed_share=0.0, peak_code=65535, full_scale=65535, code_step_contrast=0.001,
)  # fmt: skip
COARSE = 4.0 / PITCH_MRAD  # times the pixels of 0.25 mrad, which are 4 mrad wide then

# Code of a warning, what else is measured, and a value that is passed over and the next one that is not.
LIMITS = [
    ("background_mismatch", {}, "ring_ratio", 1.0299, 1.0301),
    ("background_mismatch", {}, "ring_ratio", 0.9701, 0.9699),
    ("background_mismatch", {"noise_contrast": 0.08}, "ring_ratio", 1.0399, 1.0401),
    ("background_mismatch", {"ring_ratio": 1.08}, "noise_contrast", 0.1601, 0.1),
    ("background_mismatch", {"noise_contrast": 0.3}, "ring_ratio", 1.0999, 1.1001),
    ("background_mismatch", {"ring_ratio_error": 0.02, "ring_scatter": 0.04}, "ring_ratio", 1.0999, 1.1001),
    ("background_mismatch", {"noise_contrast": 0.015, "ring_ratio_error": 0.1, "ring_scatter": 0.02}, "ring_ratio",
     1.0749, 1.0751),
    ("bit_depth", {"ring_ratio": 0.3}, "peak_code", 16384, 16383),
    ("bit_depth", {"peak_code": 4095}, "ring_ratio", 0.5, 0.4999),
    ("bit_depth", {"peak_code": 1023, "ring_ratio": 0.3}, "full_scale", 255, 65535),
    ("background_uneven", {}, "uneven", 0.0149, 0.0151),
    ("background_uneven", {"contrast_slope": -2.0}, "uneven", 0.0299, 0.0301),
    ("background_uneven", {"uneven_error": 0.004}, "uneven", 0.0199, 0.0201),
    ("background_uneven", {"uneven_texture": 0.01}, "uneven", 0.0399, 0.0401),
    ("saturated", {}, "saturated_share", 0.002, 0.0021),
    ("saturated", {"noise_contrast": 0.1}, "saturated_share", 0.01, 0.0101),
    ("crushed", {}, "crushed_share", 0.002, 0.0021),
    ("coarse_codes", {}, "code_step_contrast", 0.05, 0.0501),
    ("coarse_codes", {"code_step_contrast": 0.06}, "noise_contrast", 0.0361, 0.0359),
    ("contrast_mismatch", {}, "contrast_slope", 1.0499, 1.0501),
    ("contrast_mismatch", {}, "contrast_slope", 0.9501, 0.9499),
    ("contrast_mismatch", {"contrast_slope_error": 0.02}, "contrast_slope", 1.0999, 1.1001),
    ("contrast_mismatch", {"contrast_slope": 1.08}, "size_ratio", 0.985, 0.99),  # their light is 1.048 and 1.0585
    ("contrast_mismatch", {}, "signal", 0.1, 0.0),
    ("contrast_mismatch", {}, "wrong_level", 3, 4),
    ("contrast_mismatch", {"n_level": 20}, "wrong_level", 1, 2),
    ("contrast_mismatch", {}, "level_scatter", 0.4, 0.4001),
    ("polarity_mismatch", {}, "contrast_slope", -0.0249, -0.0251),
    ("mirrored", {}, "shown_as", "as stated", "mirrored"),
    ("turned", {}, "turned_rad", np.radians(2.0) + 0.0049, np.radians(2.0) + 0.0051),
    ("turned", {}, "turned_rad", -np.radians(2.0) - 0.0049, -np.radians(2.0) - 0.0051),
    ("orientation_mismatch", {}, "wrong_orientation", 3, 4),
    ("orientation_mismatch", {"n_orientation": 20}, "wrong_orientation", 1, 2),
    ("position_offset", {}, "offset_px", (0.1919, 0.2559), (-0.1921, 0.2561)),
    ("position_offset", {"blur_px": 2.0}, "offset_px", (0.0, 0.599), (0.0, 0.601)),
    ("position_offset", {"offset_error_px": (0.06, 0.08)}, "offset_px", (0.499, 0.0), (0.501, 0.0)),
    ("position_offset", {"size_px": 9.0 / COARSE, "blur_px": 0.0}, "offset_px", (0.0, 0.0499), (0.0, 0.0501)),
    ("position_scatter", {}, "scatter_px", 0.3999, 0.4001),
    ("position_scatter", {"blur_px": 2.0}, "scatter_px", 0.799, 0.801),
    ("position_scatter", {"size_px": 9.0 / COARSE, "blur_px": 0.0}, "scatter_px", 0.0499, 0.0501),
    ("size_mismatch", {}, "size_ratio", 1.0355, 1.0356),
    ("size_mismatch", {"blur_px": 2.0}, "size_ratio", 1.0693, 1.0695),
    ("size_mismatch", {"size_ratio_error": 0.02}, "size_ratio", 0.9001, 0.8999),
    ("mixed_sizes", {}, "size_scatter", 0.2, 0.2001),
    ("mixed_sizes", {"blur_px": 2.0}, "size_scatter", 0.3333, 0.3334),
    ("size_unit", {}, "size_px", 2.0, 1.999),
    ("mixed_frame_sizes", {}, "frame_sizes_px", ((72, 72),), ((72, 72), (80, 72))),
    ("mixed_frame_sizes", {"frame_sizes_px": ((72, 72), (80, 72))}, "are_windows", True, False),
]  # fmt: skip


# What a warning finds and expects.
FOUND = {
    "position_offset": lambda one: (tuple(np.add(35.5, one.offset_px)), (35.5, 35.5)),
    "orientation_mismatch": lambda one: (one.wrong_orientation, 0.0), "size_unit": lambda one: (one.size_px, 2.0),
    "size_mismatch": lambda one: (2.25 * one.size_ratio, 2.25), "mixed_sizes": lambda one: (one.size_scatter, 0.0),
    "coarse_codes": lambda one: (one.code_step_contrast, 0.05), "background_uneven": lambda one: (one.uneven, 0.0),
    "background_mismatch": lambda one: (one.ring_ratio, 1.0), "saturated": lambda one: (one.saturated_share, 0.0),
    "turned": lambda one: (np.degrees(one.turned_rad), 0.0), "position_scatter": lambda one: (one.scatter_px, 0.0),
    "crushed": lambda one: (one.crushed_share, 0.0), "bit_depth": lambda one: (one.ring_ratio, 1.0),
    "polarity_mismatch": lambda _: (-1.0, 1.0), "mixed_frame_sizes": lambda _: (2.0, 1.0),
    "mirrored": lambda _: (1.0, 0.0),
}  # fmt: skip
FOUND_BY_NAME = {"contrast_slope": 1.0, "wrong_level": 0.0, "level_scatter": 0.0}  # of contrast_mismatch


@pytest.mark.parametrize(("code", "measured", "name", "passed", "reported"), LIMITS)
def test_a_warning_begins_at_its_limit(code, measured, name, passed, reported) -> None:
    display = replace(DISPLAY, pixel_pitch_mrad=4.0 if "size_px" in measured else PITCH_MRAD)
    grey = [np.full((8, 8), 50.0)] * 4
    data = memory_dataset(grey, orientation=tod.ORIENTATIONS, level=0.1, size_mrad=2.25, display=display)
    shown = replace(SOUND, **measured)
    assert frame_warnings(data, [SOUND]) == []
    assert code not in {one.code for one in frame_warnings(data, [replace(shown, **{name: passed})])}
    shown = replace(shown, **{name: reported})
    (warning,) = [one for one in frame_warnings(data, [shown]) if one.code == code]
    found = (warning.found, warning.expected)
    if code != "contrast_mismatch":
        np.testing.assert_allclose(found, FOUND[code](shown))
    elif name != "size_ratio":
        assert found == ((0.0, 1.0) if name == "signal" else (reported, FOUND_BY_NAME[name]))
    if code == "bit_depth":
        assert f"values of {max(int(np.log2(shown.peak_code + 1)), 10)} bits" in warning.message


@pytest.mark.parametrize(
    ("each", "expected"),
    [
        # A size too faint to show a sign of its own, and one to show its place, are dark as the others are.
        (
            [{"contrast_slope": -1.0}, {"contrast_slope": 0.3, "contrast_slope_error": 0.2}],
            [("polarity_mismatch", {})],
        ),
        (
            [{"contrast_slope": -1.0}, {"contrast_slope": -1.06, "contrast_slope_error": 0.2, "shown_as": None}],
            [("polarity_mismatch", {})],
        ),
        ([{"contrast_slope": -1.0}, {}], [("polarity_mismatch", {"size_mrad": 1.0})]),
        ([{"shown_as": "mirrored"}, {"shown_as": "mirrored"}], [("mirrored", {})]),
        ([{"shown_as": "mirrored"}, {"shown_as": None}], [("mirrored", {})]),
        (
            [{"shown_as": "mirrored"}, {"shown_as": "flipped", "signal": 9.0}],
            [("mirrored", {"size_mrad": 1.0}), ("orientation_mismatch", {"size_mrad": 2.0})],
        ),
        ([{}, {"shown_as": "flipped", "signal": 9.0}], [("orientation_mismatch", {"size_mrad": 2.0})]),
    ],
)
def test_one_camera_has_one_polarity_and_one_arrangement(each, expected) -> None:
    grey = [np.full((8, 8), 50.0)] * 8
    sizes = {"size_mrad": [1.0] * 4 + [2.0] * 4}
    data = memory_dataset(grey, orientation=[*tod.ORIENTATIONS] * 2, level=0.1, display=DISPLAY, **sizes)
    shown = [
        replace(SOUND, group=(size,), stimulus=Stimulus(size), **changes)
        for size, changes in zip((1.0, 2.0), each, strict=True)
    ]
    found = frame_warnings(data, shown)
    wanted = {"polarity_mismatch", "contrast_mismatch", "mirrored", "flipped", "orientation_mismatch"}
    assert [(one.code, one.group) for one in found if one.code in wanted] == expected


@pytest.mark.parametrize("column", ["size_mrad", "object_size_mrad"])
def test_another_camera_is_judged_on_its_own(column) -> None:
    """A mirrored camera and one that is not, with two sizes each: a warning for the camera, and not for a size."""
    grey = [np.full((8, 8), 50.0)] * 4
    group = {column: [1.0, 2.0] * 2, "camera": ["a", "a", "b", "b"]}
    data = memory_dataset(
        grey, orientation="up", level=0.1, size_mrad=[1.0, 2.0] * 2, display=DISPLAY, group=group
    )
    shown = [
        replace(SOUND, group=(size, camera), stimulus=Stimulus(size), shown_as=arrangement)
        for camera, arrangement in (("a", "mirrored"), ("b", "as stated"))
        for size in (1.0, 2.0)
    ]
    (mirrored,) = [one for one in frame_warnings(data, shown) if one.code in ("mirrored", "orientation_mismatch")]
    assert (mirrored.code, mirrored.group) == ("mirrored", {"camera": "a"})


@pytest.mark.parametrize(("other_mrad", "level", "is_reported"), [(2.6, "snr", True), (2.58, "snr", False),
                                                                  (2.6, "size_mrad", False)])  # fmt: skip
def test_several_sizes_on_one_curve_are_reported(other_mrad: float, level: str, is_reported: bool) -> None:
    """Sizes that differ by more than 15 %, unless they are levels."""
    data = recorded(levels=(0.2,), level_name=level, group={"chart": ["one"] * 8})
    found = frame_warnings(data, [SOUND, replace(SOUND, stimulus=Stimulus(other_mrad))])
    assert [(one.code, one.found, one.expected) for one in found] == [
        ("mixed_sizes", pytest.approx(other_mrad / 2.25 - 1.0), 0.0)
    ] * is_reported


def test_windows_cut_at_a_border_are_no_mishap_and_frames_of_two_scales_are() -> None:
    """Windows as `import` cuts them: of several sizes, each with the place of its triangle."""
    positions = [(CENTRE - 3 * (number % 2), MIDDLE) for number in range(24)]
    assert codes(recorded(spoil=lambda light, k: light[:, 3 * (k % 2) :], position=positions)) == set()
    positions = [(k * CENTRE + k / 2 - 0.5, k * MIDDLE + k / 2 - 0.5) for k in (1, 2) * 12]
    doubled = recorded(
        spoil=lambda light, k: np.kron(light, np.ones((2, 2))) if k % 2 else light, position=positions
    )
    assert "mixed_frame_sizes" in codes(doubled)


def test_another_orientation_in_some_frames_is_told() -> None:
    dataset = recorded(noise=0.002)
    wrong = [
        trial._replace(orientation=tod.ORIENTATIONS[(trial.orientation.quarter_turns + k % 2) % 4])
        for k, trial in enumerate(dataset.trials[::3])
    ]
    trials = [wrong[k // 3] if k % 3 == 0 else trial for k, trial in enumerate(dataset.trials)]
    (found,) = inspect(dataset, trials)
    assert found.wrong_orientation == 4
    assert "orientation_mismatch" in {one.code for one in frame_warnings(dataset, [found])}


@pytest.fixture
def mistaken(make_dataset):
    return make_dataset(suffix=".png", contrasts=(0.1, 0.3), display={"background_luminance_cd_m2": 40.0})


def test_strict_ends_with_status_1_after_the_output(mistaken, todframes) -> None:
    status, out, err = todframes("score", mistaken.path, "--strict")
    assert status == 1
    assert "warning: 2 mrad: the luminance around the triangle is 50 cd/m²" in out
    assert err.splitlines()[-1].startswith("error: --strict: found ")
    assert "background_mismatch" in err


@pytest.mark.slow
def test_what_an_algorithm_does_is_not_judged(make_dataset, todframes) -> None:
    made = make_dataset(suffix=".png", contrasts=(0.1, 0.3), display={"background_luminance_cd_m2": "surround"})
    quick = ("--set=resamples=40", "--json", "--quiet")
    _, out, _ = todframes("compare", made.path, "--enhance", "gamma:gamma=2", *quick)
    assert not {one["code"] for one in json.loads(out)["warnings"]} & {"contrast_mismatch", "background_mismatch"}


def test_validate_prints_one_json_object(mistaken, todframes) -> None:
    status, out, err = todframes("validate", mistaken.path, "--json")
    found = json.loads(out)
    assert (status, found["command"], found["skipped"]) == (0, "validate", [])
    assert [one["code"] for one in found["warnings"]] == ["background_mismatch"]
    assert found["dataset"]["measured"]["stimuli"][0]["ring_ratio"] == pytest.approx(1.25, rel=1e-3)
    assert err.startswith("warning: 2 mrad: ")
    assert todframes("validate", mistaken.path, "--strict")[0] == 1
    mistaken.frame(0).write_bytes(b"")
    status, out, err = todframes("validate", mistaken.path, "--json")
    assert (status, len(json.loads(out)["skipped"])) == (1, 1)
    assert err.splitlines()[-1].endswith("1 problem found")


DECLARED = replace(DISPLAY, background_luminance_cd_m2=40.0)


@pytest.mark.parametrize(("reach_px", "middle_px"), [(0.0, (97.0, 64.2)), (70.0, None)])
def test_blocks_of_a_window_are_means_of_the_frame(reach_px: float, middle_px: tuple[float, float] | None) -> None:
    """A plane whose luminance is known everywhere, in blocks of 2 × 2 pixels; the frame ends near the triangle."""

    def plane(x, y):
        return 50.0 * (1.0 + 1e-3 * (x - 100.3) - 2e-3 * (y - 60.9))

    light = plane(np.arange(160), np.arange(120)[:, None])
    stated = {"orientation": "up", "level": 0.1, "size_mrad": 4.0, "position": (100.3, 60.9), "display": DECLARED}
    data = memory_dataset([light, 3.0 * light], trial=[0, 0], **stated)
    (trial,) = data.trials
    moving = trial._replace(frames=(trial.frames[0]._replace(motion_px=(0.0, 0.0)), trial.frames[1]))
    how = {"size_px": 16.0, "reach_px": reach_px, "middle_px": middle_px}
    both, first = (measure_trial(data, one, "centroid", **how) for one in (trial, moving))
    middle = np.round(middle_px or (100.3, 60.9)) - 0.5  # of an even number of pixels
    assert first.offset == pytest.approx((np.array([100.3, 60.9]) - middle) / 2.0)
    assert (first.stated_px, first.block_px, first.frame_px) == (pytest.approx((100.3, 60.9)), 2, (120, 160))
    assert first[8:12] == (40.0, pytest.approx(50.0, rel=1e-3), pytest.approx(0.0, abs=1e-6), None)
    reach = max(48.0, reach_px)  # of three sizes
    steps = 2.0 * np.arange(-np.ceil(reach / 2.0), np.ceil(reach / 2.0) + 1.0)
    (x, has_x), (y, has_y) = (
        (to, [sum(max(0, low) <= k < min(end, high) for k in (block - 0.5, block + 0.5)) for block in to])
        for end, at, to in ((160, 100.3, middle[0] + steps), (120, 60.9, middle[1] + steps))
        for low, high in [(round(at - reach), round(at + reach) + 1)]
    )
    n_read = np.multiply.outer(has_y, has_x)
    expected, whole, none = plane(x, y[:, None]), n_read == 4, n_read < 2
    assert np.array_equal(first.known, ~none) and not whole.all()
    # Frames have single precision, 6e-8.
    assert first.seen[whole] == pytest.approx(expected[whole] / 40.0 - 1.0, abs=1e-5)
    assert both.seen[whole] == pytest.approx(2.0 * expected[whole] / 40.0 - 1.0, abs=1e-5)
    assert first.even[whole] == pytest.approx(expected[whole] / 50.0 - 1.0 if reach_px else 0.0, abs=1e-3)
    assert not first.seen[none].any() and not first.even[none].any()


@pytest.mark.parametrize(("beside", "is_flat"), [(100, True), (106, False)])
def test_codes_of_a_window_are_counted(beside: int, is_flat: bool) -> None:
    """The square of 0.9 sizes about the triangle has 30 × 30 of its pixels: rows 46 to 75, columns 85 to 114."""
    frame = np.full((120, 160), 100, np.uint8)
    frame[46:76, 85:87], frame[46, 87:115], frame[75, 90:115], frame[60, 114] = 255, 0, 106, 110
    frame[45, 84:116], frame[76, 90], frame[60, 115] = 100, beside, 100
    stated = {"level": 0.1, "size_mrad": 4.0, "position": (99.5, 60.5), "display": BRIGHT}
    data = memory_dataset([frame], orientation="up", **stated)
    sample = measure_trial(data, data.trials[0], "centroid", size_px=16.0)
    code_cd_m2 = 200.0 / 255.0
    assert sample.ring_cd_m2 == pytest.approx(100 * code_cd_m2, rel=1e-4)
    contrast = code_cd_m2 / sample.ring_cd_m2
    assert sample.codes == Codes(255, 255, 4, pytest.approx(4 * contrast), pytest.approx(contrast), is_flat)
    assert sample.cut == (28 / 900, 60 / 900, "0 and 255")


def trials_of(*columns: dict[str, Any]) -> Trials:
    """Trials with these columns; all else is alike."""
    plain = Trial(0, "0", (), tod.ORIENTATIONS[0], Stimulus(2.0), 0.1, (2.0,), 10.0, 20.0)
    return Trials.of(plain._replace(number=k, **one) for k, one in enumerate(columns))


def test_views_are_chosen_that_show_their_backgrounds() -> None:
    """Of two equal trials nothing can be separated; of 40 trials of a view eight are enough."""
    view = [SceneView(name) for name in "abcd"]
    changes = [{"view": view[0]}] * 2 + [{"view": view[1], "orientation": turn} for turn in tod.ORIENTATIONS]
    changes += [{"view": view[2], "level": level} for level in np.linspace(0.4, 0.01, 40)]
    trials = trials_of(*changes)
    assert whole_views(trials, trials.levels, 4).tolist() == [
        *(2 + k for k in (0, 1, 2, 3)), *(45 - round(k * 39 / 7) for k in range(8)),
    ]  # fmt: skip
    assert whole_views(trials, trials.levels, 1).tolist() == [2, 3, 4, 5]
    assert len(whole_views(trials, trials.levels, 10)) == 4 + 15
    assert not len(whole_views(trials.select([0, 1]), trials.levels[:2], 4))
    moved = trials_of(
        {"view": view[0]}, {"view": view[1], "x_px": None, "y_px": None}, {"view": view[0], "y_px": 30.0}
    )
    assert view_middles(moved) == [(10.0, 25.0), None, (10.0, 25.0)]
    data = recorded(levels=(0.2,))
    sample = measure_trial(data, data.trials[0], "centroid", size_px=SIZE_PX)
    shown = [sample._replace(trial=trials[k]) for k in (0, 2, 1, 3, 7, 6, 8, 9, 10)]
    assert numbered_views(shown).tolist() == [0, 1, 0, 1, 2, 2, 2, 2, 2]
    assert that_share(shown[:8]) == shown[:8]  # eight of three views: as many unknowns, and four, would be seven
    assert that_share(shown[1:]) == [shown[1], *shown[3:]]
    assert that_share(shown[:7]) == that_share(shown[1:8]) == []


@pytest.mark.parametrize(("levels", "n_unknown"), [((0.1, 0.2), 4), ((0.2, 0.2), 3)])
def test_windows_on_scenes_are_background_triangle_and_noise(levels: tuple[float, float], n_unknown: int) -> None:
    """Two scenes of eight trials leave triangles and noise; of one level, differences alone are known."""
    rng, side, n = np.random.default_rng(5), 41, 16
    level, turns, view = np.repeat(levels, 8), np.tile(np.arange(4), 4), np.tile(np.repeat([1, 0], 4), 2)
    scenes, noise = rng.normal(size=(2, side, side)), 0.01 * rng.normal(size=(n, side, side))
    shape = Shape.upright(1.0, 0.0, 0.0, 9.0)
    square = Square.about(shape, side)
    triangle = np.zeros((4, side, side))
    subtract(triangle, -render(shape, square, side).images, square)
    windows = scenes[view] + level[:, None, None] * triangle[turns] + noise
    given, known = Given(level, np.full(n, 0.01), turns), np.ones((side, side), bool)
    # What two means of eight take of the variance is scaled back, what the triangles take is not: the standard
    # deviation is known to 1 / √(2 · 16 · 41²) = 0.4 %.
    left = without_scenes(windows, given, known, view)
    assert left.std() == pytest.approx(0.01 * np.sqrt(1 - n_unknown / 14), rel=0.02)
    images = Images.of(windows, given, known=known, hole=10.0, view=view)
    parts = SceneParts.of(windows, fit(images, shape), images, given, view)
    assert np.abs(parts.backgrounds - scenes).max() < 0.05
    # Triangles of contrast 1 are known to 0.04 in each block, those of a fit much better; seven of these.
    most = 0.3 if n_unknown == 4 else 0.05
    assert np.abs(parts.even - parts.noise - level[:, None, None] * triangle[turns]).max() < most * level.max()
    assert parts.noise == pytest.approx(left, abs=0.02)
    assert parts.of_scenes(["a", "b"] * 8) is None


@pytest.mark.parametrize("n", [4, 200])
def test_scatter_is_the_variance_beyond_the_noise(n: int) -> None:
    """Deviations by 1 to either side with noise of 0.1 leave n / (n - 1) - 0.01, and noise alone leaves none."""
    apart, noise = np.tile([[1.0, -1.0], [-1.0, 1.0]], (n // 2, 1)), np.full((n, 2), 0.1)
    assert _scatter(apart, noise) == pytest.approx(np.sqrt(n / (n - 1) - 0.01))
    assert _scatter(apart[:3], noise[:3]) is None
    # Five errors of a mean square of 398 degrees of freedom are 41 %.
    limit = 0.1 * (1.0 + 5.0 * np.sqrt(2.0 / 9.0 / (2 * n - 2))) ** 1.5 * np.sqrt((n - 1) / n)
    assert _scatter(0.999 * limit * apart, noise) == 0.0 < _scatter(1.001 * limit * apart, noise)


CODE = Codes(255, 200, 2, 0.02, 0.01, False)


@pytest.mark.parametrize(("of_trials", "step", "contrast"), [
    ([(0.1, CODE), (0.2, CODE._replace(step=3, step_contrast=0.04))], 2, 0.03),
    ([(0.1, CODE._replace(is_flat=True))], 1, 0.01),  # its own contrast, no step of the codes
    ([(0.2, CODE._replace(step=0)), (0.2, CODE._replace(is_flat=True))], 2, 0.02),  # fainter ones are rounded
    ([(0.3, CODE._replace(step=0)), (0.2, CODE._replace(is_flat=True))], 1, 0.01),
    ([(0.1, CODE._replace(step=0)), (0.2, CODE._replace(step=0))], 1, 0.01),
])  # fmt: skip
def test_codes_of_a_group_are_those_of_its_trials(of_trials, step: int, contrast: float) -> None:
    peaked = [(level, codes._replace(peak=200 + k)) for k, (level, codes) in enumerate(of_trials)]
    assert _of_codes(peaked) == {
        "peak_code": 199 + len(peaked), "full_scale": 255, "code_step": step,
        "code_step_contrast": pytest.approx(contrast),
    }  # fmt: skip
