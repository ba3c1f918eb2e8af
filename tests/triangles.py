"""Random triangles in blur, noise, patterns, tilts and cut windows, and how well they are measured.

Frames are drawn with four times the pixels and blurred there, so that only the exact coverage is shared with the
package.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import todframes as tod
from todframes.diagnosis.inspection import inspect
from todframes.frames.dataset import Dataset
from todframes.frames.memory import memory_dataset
from todframes.stimulus import ORIENTATIONS, coverage, moving_coverage, vertices

FINER, WIDER = 4, 10
DISPLAY = tod.Display(
    eotf="linear", white_luminance_cd_m2=1.0, pixel_pitch_mrad=0.25, background_luminance_cd_m2=50.0
)


def recording(
    rng: np.random.Generator,
    middle: tuple[float, float],
    *,
    side_px: int = 64,
    size_px: float | Callable[[int], float] = 8.0,
    stated_px: float = 8.0,
    levels: Sequence[float] = (0.1, 0.2),
    repeats: int = 2,
    noise_sd: float = 0.02,
    blur_px: float = 0.5,
    is_noise_blurred: bool = False,
    clutter: float = 0.0,
    shake_px: float = 0.0,
    steps: NDArray[np.float64] | None = None,
    shown: Sequence[int] = (0, 1, 2, 3),
    sign: float = 1.0,
    spoil: Callable[[NDArray[np.float64], int], NDArray[Any]] = lambda luminance, _number: luminance,
    **stated: Any,
) -> tuple[Dataset, NDArray[np.float64]]:
    """A camera's recording in memory, and the position in each frame; `shown` are the orientations on the frames.

    The dataset states bright triangles of `stated_px` in the middle of frames wider than high. `steps` are
    from the middle in each frame. All frames share the clutter.
    """
    shape = (side_px, side_px + WIDER)
    shared = clutter * rng.normal(size=shape) if clutter else 0.0
    frames, orientation, contrasts, positions = [], [], [], []
    for level in levels:
        for turn in (0, 1, 2, 3) * repeats:
            x, y = middle + (shake_px * rng.normal(size=2) if steps is None else steps[len(frames)])
            size = size_px(len(frames)) if callable(size_px) else size_px
            at = {"size_px": size, "x_px": x, "y_px": y, "orientation": ORIENTATIONS[shown[turn]]}
            noise = noise_sd * rng.normal(size=shape)
            scene = sign * level * coverage(shape, **at) + is_noise_blurred * noise
            scene = gaussian_filter(scene, blur_px) + (not is_noise_blurred) * noise
            frames.append(spoil(50.0 * (1.0 + scene + shared), len(frames)))
            orientation.append(ORIENTATIONS[turn])
            contrasts.append(level)
            positions.append((x, y))
    stated = {"orientation": orientation, "level": contrasts, "display": DISPLAY} | stated
    stated = {"size_mrad": stated["display"].pitch_mrad * stated_px} | stated
    return memory_dataset(frames, **stated), np.array(positions)


def turning(degrees: float) -> NDArray[np.float64]:
    """Return a clockwise rotation, y down."""
    angle = np.deg2rad(degrees)
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def drawn(
    side: int, *, turn: int, size_px: float, x: float, y: float, change: NDArray[np.float64], blur_px: float
) -> NDArray[np.float64]:
    """Draw a triangle under an affine map about its centroid, and blur it."""
    corners = vertices(size=size_px, orientation=ORIENTATIONS[turn]) @ change.T + (x, y)
    image = moving_coverage(FINER * (corners + 0.5) - 0.5, (FINER * side, FINER * side))[0]
    if blur_px > 0.0:
        image = gaussian_filter(image, FINER * blur_px, mode="constant")
    return image.reshape(side, FINER, side, FINER).mean(axis=(1, 3))


def seen_from(rng: np.random.Generator, *, tilt_deg: float, turn_deg: float) -> NDArray[np.float64]:
    """Return the map, of unit area, of a chart that is turned, and tilted about an axis at random."""
    axis = turning(rng.uniform(0.0, 180.0))
    flattened = axis @ np.diag([np.cos(np.deg2rad(tilt_deg)), 1.0]) @ axis.T
    change = turning(turn_deg) @ flattened
    return change / np.sqrt(np.linalg.det(change))


class Drawn(NamedTuple):
    """A random dataset, and the truth about its triangles.

    `truth` is their contrast per level, x and y from where the dataset says, size as a ratio, and turn in radians.
    """

    dataset: Dataset
    truth: NDArray[np.float64]
    blur_px: float
    noise: float
    tilt_deg: float
    is_cut: bool


def draw(rng: np.random.Generator, *, off: float, tilt_deg: float, turn_deg: float, cut: float) -> Drawn:
    """Draw a dataset in noise and blur: places and sizes differ by less than stated errors, or are wrong by `off`.
    That is the largest error of the stated places, in sizes, and of the stated sizes, as a share. The angles are
    the largest ones, and `cut` is the share of the datasets in which the edge of the frames is near.
    """
    size, blur, side = rng.uniform(5.0, 15.0), rng.uniform(0.0, 2.0), 97
    noise = 10.0 ** rng.uniform(-2.5, -0.7) if off else float(rng.choice([0.0, 10.0 ** rng.uniform(-3.0, -0.7)]))
    tilt, turn = rng.uniform(0.0, tilt_deg), rng.uniform(-turn_deg, turn_deg)
    change, is_cut = seen_from(rng, tilt_deg=tilt, turn_deg=turn), bool(rng.random() < cut)
    middle = np.array([side - rng.uniform(1.4, 2.0) * size if is_cut else (side - 1) / 2, (side - 1) / 2])
    wrong, ratio = rng.uniform(-off, off, 2) * size, 1.0 + rng.uniform(-off, off)
    in_perspective, correlated = rng.choice([0.0, 0.04]), rng.random() < 1 / 3
    pattern = rng.choice([0.0, 1.0]) * noise * rng.normal(size=(side, side))
    levels = np.geomspace(0.05, 0.4, 5) * rng.uniform(0.5, 1.5)
    frames, orientation, level, places, sizes = [], [], [], [], []
    for contrast in levels:
        for turns in (0, 1, 2, 3) * 3:
            x, y = middle + rng.uniform(-0.5, 0.5, 2)
            ours = size * np.exp(in_perspective * rng.uniform(-1.0, 1.0))
            grain = rng.normal(size=(side, side))
            if correlated:
                grain = gaussian_filter(grain, 1.0)
            image = drawn(side, turn=turns, size_px=ours, x=x, y=y, change=change, blur_px=blur)
            frames.append(50.0 * (1.0 + contrast * image + noise * grain + pattern))
            orientation.append(ORIENTATIONS[turns])
            level.append(contrast)
            places.append((x, y) - wrong)
            sizes.append(0.25 * ours / ratio)
    display = replace(DISPLAY, background_luminance_cd_m2=50.0 if rng.random() < 0.5 else "surround")
    dataset = memory_dataset(
        frames,
        orientation=orientation,
        level=level,
        size_mrad=sizes,
        display=display,
        position=np.array(places),
        group={"chart": ["one"] * len(frames)},
    )
    # The turn of a map is that of the rotation nearest to it.
    true_turn = np.arctan2(change[1, 0] - change[0, 1], change[0, 0] + change[1, 1])
    return Drawn(dataset, np.array([1.0, *wrong, ratio, true_turn]), blur, noise, tilt, is_cut)


def clean(rng: np.random.Generator) -> Dataset:
    """Return a random dataset that is what it says: charts may be seen from the side, and are hardly turned."""
    return draw(rng, off=0.0, tilt_deg=25.0, turn_deg=1.0, cut=0.3).dataset


def estimate(rng: np.random.Generator) -> tuple[Drawn, NDArray[np.float64]]:
    """Measure a random group: differences from the truth in standard errors, (5,), NaN if not measured.

    A turn by 15° one way is one by 105°, a quarter turn and 15° more, the other way.
    """
    made = draw(rng, off=0.12, tilt_deg=25.0, turn_deg=14.0, cut=0.5)
    (one,) = inspect(made.dataset, made.dataset.trials)
    nowhere = (None, None)
    values = [one.contrast_slope, *(one.offset_px or nowhere), one.size_ratio, one.turned_rad]
    errors = [one.contrast_slope_error, *(one.offset_error_px or nowhere), one.size_ratio_error]
    found, error = (np.array(of, np.float64) for of in (values, [*errors, one.turned_error_rad]))
    return made, (found - made.truth) / error


def columns_of(data: Dataset) -> dict[str, Any]:
    """Return what calls with arrays in place of files take beside them, from a dataset of single frames."""
    places = [(one.x_px, one.y_px) for one in data.trials]
    stimuli = [one.stimulus for one in data.trials]
    of_trials = {
        "orientation": [one.orientation for one in data.trials],
        "level": [one.level for one in data.trials],
    }
    of_stimuli = {"size_mrad": [one.size_mrad for one in stimuli], "polarity": [one.polarity for one in stimuli]}
    position = None if places[0][0] is None else places
    return {"display": data.display, "position": position, **of_trials, **of_stimuli}
