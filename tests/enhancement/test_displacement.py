"""Algorithms that displace pictures: closed forms of where the triangle comes out, and thresholds there."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import todframes as tod
from todframes.enhancement.enhanced_frame import AlgorithmDisplay
from todframes.enhancement.finding import find_enhancement
from todframes.enhancement.scored_algorithms import find_displacements
from todframes.frames.memory import memory_dataset
from todframes.stimulus import ORIENTATIONS

PITCH, SIDE, NOISE = 0.5, 48, 0.05


def shown(
    contrasts=(0.02, 0.05, 0.12, 0.3), size_mrad=4.0, repeats=2, middle=23.0
) -> tuple[list[np.ndarray], dict]:
    """Frames of triangles in noise before a grey of 0.4 of white."""
    rng, each = np.random.default_rng(1), [(c, o) for c in contrasts for o in ORIENTATIONS for _ in range(repeats)]
    at = {"size_px": size_mrad / PITCH, "x_px": middle, "y_px": middle}
    frames = [
        0.4 * (1.0 + c * tod.coverage((SIDE, SIDE), orientation=o, **at) + rng.normal(0.0, NOISE, (SIDE, SIDE)))
        for c, o in each
    ]
    level, orientation = zip(*((c, o.value) for c, o in each), strict=True)
    light = {"white_luminance_cd_m2": 100.0, "background_luminance_cd_m2": 40.0}
    display = tod.Display(eotf="linear", pixel_pitch_mrad=PITCH, **light)
    more = {"orientation": orientation, "level": level, "size_mrad": size_mrad, "position": (middle, middle)}
    return frames, more | {"display": display}


def rolled(image, right: int = 1, down: int = 0):
    return np.roll(image, (down, right), (0, 1))


def mean_of_four(image):
    return cv2.blur(image, (2, 2), anchor=(0, 0))


def with_row_before(image):
    return 0.5 * (image + np.roll(image, 1, 0))


@tod.algorithm(magnification="factor")
def from_the_corner(image, factor: int = 2, kind: str = "cubic"):
    """Enlarge with the grid of ONNX's Resize that is called asymmetric: output k is at k / factor."""
    flags = {"cubic": cv2.INTER_CUBIC, "linear": cv2.INTER_LINEAR}[kind] | cv2.WARP_INVERSE_MAP
    sides = [factor * side for side in image.shape[::-1]]
    return cv2.warpAffine(
        image, np.diag([1.0 / factor] * 3)[:2], sides, flags=flags, borderMode=cv2.BORDER_REFLECT
    )


def trembling(image):
    """Shift by up to two pixels, as the noise of the first pixel has it."""
    return np.roll(image, int(1e5 * image[0, 0]) % 5 - 2, 1)


for one in (rolled, mean_of_four, with_row_before, from_the_corner, trembling):
    one.__module__ = __name__

KNOWN = {
    f"{__name__}:rolled": (1.0, 0.0),
    f"{__name__}:rolled:right=-3,down=2": (-3.0, 2.0),
    # The centroid of the kernel.
    f"{__name__}:mean_of_four": (-0.5, -0.5),
    f"{__name__}:with_row_before": (0.0, 0.5),
    # The middle of a pixel cut in n pieces is (n − 1) / 2 pieces before where this grid has it.
    f"{__name__}:from_the_corner": (-0.25, -0.25),
    f"{__name__}:from_the_corner:factor=4,kind=linear": (-0.375, -0.375),
    # Kernels that are alike on opposite sides.
    **dict.fromkeys(("gaussian:sigma=2", "unsharp", "bicubic", "lanczos:factor=3"), (0.0, 0.0)),
    # What chance does to noise is none on the whole.
    **dict.fromkeys(("median", "bilateral", "tv", "equalize", "clahe"), (0.0, 0.0)),
}


def test_displacements_are_those_of_the_kernels() -> None:
    frames, more = shown(middle=22.4)
    data, algorithms = memory_dataset(frames, **more), [find_enhancement(spec) for spec in ("none", *KNOWN)]
    found = find_displacements(algorithms, AlgorithmDisplay(data.display), data, data.trials)
    for algorithm, displacement in zip(algorithms[1:], found[1:], strict=True):
        expected = KNOWN[algorithm.spec]
        # Of the frame's pixels; 0 is 0.
        found_px = displacement.px or (0.0, 0.0)
        assert found_px == (pytest.approx(expected, abs=0.0051) if any(expected) else expected), algorithm.spec


def test_what_is_displaced_is_judged_where_it_is() -> None:
    """A shift alone changes no threshold, and a grid from the corner is as good as that of the pixels."""
    frames, more = shown(repeats=4)
    asked = [f"{__name__}:rolled:right=3,down=-2", f"{__name__}:from_the_corner", "bicubic:factor=2"]
    result = tod.compare_frames(frames, asked, **more, fit=tod.FitSettings(resamples=40), examples=False)
    _, shifted, cornered, centred = result.conditions
    # The brightness around the triangle is that of other noise: 0.05 / √(48²), and a fifth of it for what differs.
    assert shifted.ratios[0].ratio == pytest.approx(1.0, abs=1e-3)
    assert cornered.ratios[0].ratio == pytest.approx(centred.ratios[0].ratio, rel=0.02)
    assert "Its pictures lie 3.00 px to the right and 2.00 px up; the observer looks there." in result.verdict[0]
    assert shifted.displacement_px == (3.0, -2.0) and centred.displacement_px == (0.0, 0.0)
    assert shifted.displacement_scatter_px == 0.0
    assert "displaced_right_px" in result.tables()[1].csv()
    assert not [one for one in result.warnings if one.code == "displacement_varies"]


def test_another_displacement_in_each_trial_is_reported() -> None:
    frames, more = shown()
    result = tod.compare_frames(frames, trembling, **more, fit=tod.FitSettings(resamples=40), examples=False)
    (found,) = [one for one in result.warnings if one.code == "displacement_varies"]
    # Whole pixels from −2 to 2, alike: √2, of which 8 trials show at least a third.
    assert 0.5 < found.found < 2.5
    assert "differs from trial to trial" in found.message
