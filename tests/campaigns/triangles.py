"""How well the triangle of frames is estimated, and how often good frames are warned about; minutes.

python tests/campaigns/triangles.py estimates 300    # bias, and coverage of 95 % intervals
python tests/campaigns/triangles.py clean 100        # false alarms of good datasets

Frames are drawn with four times the pixels and blurred there, so that only the exact coverage is shared with the
package. The exit status is 1 if an interval holds less than 93 or more than 98 % of the true values, or if a good
dataset has a warning.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import todframes as tod
from todframes.diagnosis.findings import frame_warnings
from todframes.diagnosis.inspection import inspect
from todframes.diagnosis.triangle import Images, Shape, X, Y, fit
from todframes.frames.dataset import Dataset
from todframes.frames.memory import memory_dataset
from todframes.stimulus import ORIENTATIONS, moving_coverage, vertices

FINER = 4
NAMES = ("contrast", "x", "y", "size", "turn")


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


def distorted(rng: np.random.Generator, *, turn_deg: float, stretch: float) -> NDArray[np.float64]:
    """Return a random map of unit area: turned, stretched and sheared."""
    along, shear = rng.uniform(-stretch, stretch, 2)
    change = turning(rng.uniform(-turn_deg, turn_deg)) @ np.array(
        [[np.exp(along), shear], [shear, np.exp(-along)]]
    )
    return change / np.sqrt(np.linalg.det(change))


def estimate(rng: np.random.Generator) -> NDArray[np.float64]:
    """Fit the mean frames of a random group: differences from the truth, in standard errors."""
    size, blur = rng.uniform(5.0, 15.0), rng.uniform(0.0, 2.0)
    noise, true_size = 10.0 ** rng.uniform(-2.5, -0.7), size * rng.uniform(0.9, 1.1)
    change = distorted(rng, turn_deg=25.0, stretch=0.1)
    x, y = rng.uniform(-0.15, 0.15, 2) * size
    side = 2 * int(np.ceil(3 * size)) + 1
    known = np.ones((side, side), bool)
    if rng.random() < 0.6:  # the frame's edge cuts the window
        known[:, int((side - 1) / 2 + rng.uniform(1.0, 1.5) * size) :] = False
    level, turns = np.tile([0.05, 0.1, 0.2], 8), np.repeat(np.arange(4), 6)
    middle = (side - 1) / 2
    of_turn = [
        drawn(side, turn=k, size_px=true_size, x=middle + x, y=middle + y, change=change, blur_px=blur)
        for k in range(4)
    ]
    grain = rng.normal(size=(len(level), side, side))
    if rng.random() < 1 / 3:
        grain = gaussian_filter(grain, (0.0, 1.0, 1.0))
    pattern = rng.choice([0.0, 1.0]) * noise * rng.normal(size=(side, side))
    frames = level[:, None, None] * np.array(of_turn)[turns] + noise * grain + pattern
    images = Images.of(
        frames * known,
        level=level,
        noise=np.full(len(level), noise),
        turns=turns,
        known=known,
        hole=1.1 * size,
    )
    found = fit(images, Shape.upright(1.0, 0.0, 0.0, size))
    shape = found.shape
    true_turn = np.arctan2(change[1, 0] - change[0, 1], change[0, 0] + change[1, 1])
    away = np.array(
        [shape.amplitude - 1.0, shape.x - x, shape.y - y, shape.size / true_size - 1.0, shape.turn_rad - true_turn]
    )
    errors = [found.error((0, 1.0)), found.error((X, 1.0)), found.error((Y, 1.0))]
    return away / np.array([*errors, found.size_error, found.turn_error_rad])


def clean(rng: np.random.Generator) -> Dataset:
    """Return a random dataset that is what it says."""
    size, blur, side = rng.uniform(4.0, 16.0), rng.uniform(0.0, 2.0), 97
    noise = rng.choice([0.0, 10.0 ** rng.uniform(-3.0, -0.7)])
    change = distorted(rng, turn_deg=1.0, stretch=0.03)
    levels = np.geomspace(0.05, 0.4, 5) * rng.uniform(0.5, 1.5)
    in_perspective = rng.choice([0.0, 0.04])
    pattern = rng.choice([0.0, 1.0]) * noise * rng.normal(size=(side, side))
    correlated = rng.choice([0.0, 1.0])
    frames, orientation, level, places, sizes = [], [], [], [], []
    for contrast in levels:
        for turn in (0, 1, 2, 3) * 3:
            x, y = (side - 1) / 2 + rng.uniform(-0.5, 0.5, 2)
            ours = size * np.exp(in_perspective * rng.uniform(-1.0, 1.0))
            grain = rng.normal(size=(side, side))
            if correlated:
                grain = gaussian_filter(grain, 1.0)
            image = drawn(side, turn=turn, size_px=ours, x=x, y=y, change=change, blur_px=blur)
            frames.append(50.0 * (1.0 + contrast * image + noise * grain + pattern))
            orientation.append(ORIENTATIONS[turn])
            level.append(contrast)
            places.append((x, y))
            sizes.append(0.25 * ours)
    display = tod.Display(
        eotf="linear",
        white_luminance_cd_m2=1.0,
        pixel_pitch_mrad=0.25,
        background_luminance_cd_m2=50.0 if rng.random() < 0.5 else "surround",
    )
    return memory_dataset(
        frames,
        orientation=orientation,
        level=level,
        size_mrad=sizes,
        display=display,
        position=np.array(places),
        group={"chart": ["one"] * len(frames)},
    )


def estimates(n: int, seed: int) -> bool:
    """Print coverage and bias; return whether they are as asked."""
    deviates = np.array([estimate(np.random.default_rng([seed, k])) for k in range(n)])
    held = (np.abs(deviates) < 1.96).mean(axis=0)
    for name, share, of_name in zip(NAMES, held, deviates.T, strict=True):
        print(
            f"{name:9} 95 % intervals hold {100 * share:.1f} %; median {np.median(of_name):+.2f} standard errors"
        )
    print(f"all       95 % intervals hold {100 * held.mean():.1f} %")
    return 0.93 <= held.mean() <= 0.98


def clean_sets(n: int, seed: int) -> bool:
    """Print the warnings of good datasets; return whether there is none."""
    n_warned = 0
    for k in range(n):
        dataset = clean(np.random.default_rng([seed, k]))
        found = frame_warnings(dataset, inspect(dataset, dataset.trials))
        n_warned += bool(found)
        for one in found:
            print(f"{k}: {one.code}: {one.found}: {one.message}")
    print(f"{n_warned} of {n} good datasets have a warning")
    return n_warned == 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a part of the campaign. Returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=["estimates", "clean"])
    parser.add_argument("n", type=int)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args(arguments)
    run = estimates if asked.part == "estimates" else clean_sets
    return int(not run(asked.n, asked.seed))


if __name__ == "__main__":
    sys.exit(main())
