"""Contrast gain of an enhancement: the triangle's displayed contrast after it, divided by that before it.  A
person can turn up a display. An algorithm that only amplifies is no better than that, even if it lowers the
threshold a lot. So each algorithm is also compared with a plain gain of the same amount, which nothing clips.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.enhancement.contrast_on_scenes import OnScenes, contrasts_on_scenes, views_to_measure
from todframes.frames.trials import Group, Trial, Trials
from todframes.observers.retina import RetinaGrid
from todframes.results.data import Positive
from todframes.scoring.trial_scores import TrialPatches, retina_image
from todframes.stimulus import ORIENTATIONS, Centre, Orientation, coverage

LEAST_GAIN = 1e-6
"""Smallest gain that counts as one: below it the contrast after the algorithm is rounding."""

MEASURED_TRIALS = 24
"""Largest number of trials of a level below the highest whose contrast is measured: evenly spread."""


class ContrastPoint(Struct, frozen=True):
    """Displayed contrast of the triangle at a level, before and after an algorithm: means over `n_trials` trials.

    `gain` is their quotient, and `gain_standard_error` its standard error over the trials.
    """

    level: Positive
    before: float
    after: float
    gain: float | None = None
    gain_standard_error: float | None = None
    n_trials: int = 0


Responses = dict[Group, tuple[ContrastPoint, ...]]
"""Displayed contrasts of an algorithm in each group, at ascending levels."""


def measured_trials(trials: Trials) -> frozenset[int]:
    """Return the numbers of the trials whose contrast is measured.

    They are all of the highest level of each group, which shows a contrast gain best, and some of others; on
    scenes that trials share, all trials of some views.
    """
    shared = [(members, views_to_measure(trials.select(members))) for _, members in trials.by_group()]
    chosen = [members[rows] for members, rows in shared if rows is not None]
    if chosen and len(chosen) == len(shared):
        return frozenset(trials.numbers[np.concatenate(chosen)].tolist())
    found: set[int] = set()
    for _, members in trials.by_group():
        levels = trials.levels[members]
        for level in np.unique(levels):
            rows = members[levels == level]
            if level != levels.max() and len(rows) > MEASURED_TRIALS:
                rows = rows[np.linspace(0, len(rows) - 1, MEASURED_TRIALS).astype(np.intp)]  # evenly
            found.update(trials.numbers[rows].tolist())
    return frozenset(found)


def triangle_contrasts(
    shown: Sequence[TrialPatches], trial: Trial, *, grid: RetinaGrid, centre: Centre
) -> FloatArray:
    """Measure the contrast of the triangle as displayed, its mean minus that of a ring around it.

    Comes back as (algorithm, 4): in the orientation of the trial, and a quarter, a half and three quarters of a
    turn from it, clockwise; NaN in the latter three without a scene. Contrast counts as positive in the direction
    of the trial's polarity. The triangle's `centre` lies in the middle of the grid.
    """
    found = np.full((len(shown), len(ORIENTATIONS)), np.nan)
    images = [retina_image(after, grid) for after in shown]
    size_px = trial.stimulus.size_mrad / grid.pitch_mrad
    for turn in range(1 if trial.view is None else len(ORIENTATIONS)):
        orientation = ORIENTATIONS[(trial.orientation.quarter_turns + turn) % len(ORIENTATIONS)]
        weights = trial.stimulus.polarity * _ring_weights(grid.side, size_px, orientation, centre)
        found[:, turn] = [float((weights * image).sum()) for image in images]
    return found


@lru_cache(maxsize=16)
def _ring_weights(side: int, size_px: float, orientation: Orientation, centre: Centre) -> FloatArray:
    """Return the weights of a triangle's mean minus that of the ring around it: (side, side)."""
    middle: dict[str, Any] = {"x_px": side // 2, "y_px": side // 2, "orientation": orientation, "centre": centre}
    inside, hole, whole = (
        coverage((side, side), size_px=factor * size_px, **middle) for factor in (1.0, 1.3, 2.0)
    )
    ring = whole - hole
    return np.asarray(inside / inside.sum() - ring / ring.sum())


@cache
def sharp_share() -> float:
    """Return the contrast that a sharp triangle has as one of the opposite orientation, over its own."""
    side, size_px = 181, 40.0
    middle = side // 2
    shown = coverage((side, side), size_px=size_px, x_px=middle, y_px=middle, orientation=ORIENTATIONS[0])
    own, opposite = (
        float((_ring_weights(side, size_px, turned, "centroid") * shown).sum()) for turned in ORIENTATIONS[::2]
    )
    return opposite / own


def contrast_gains(responses: Sequence[Responses]) -> list[dict[Group, float]]:
    """Return the contrast gain of each algorithm in each group, against the first algorithm: at the highest level.

    Groups are left out where the contrast is not positive before or after.
    """
    return [
        {
            group: levels[-1].gain
            for group, levels in own.items()
            if levels[-1].gain is not None and LEAST_GAIN < levels[-1].gain < math.inf
        }
        for own in responses
    ]


def contrast_responses(trials: Trials, contrasts: FloatArray) -> list[Responses]:
    """Return the displayed contrast of each algorithm against that of the first, level by level.

    `contrasts`, (trial, algorithm, 4), are those of `triangle_contrasts`; NaN where nothing was measured. On
    scenes that trials share, the contrast is that of the triangles alone.
    """
    found: list[Responses] = [{} for _ in range(contrasts.shape[1])]
    measured: NDArray[np.bool_] = np.all(np.isfinite(contrasts[..., 0]), axis=1)
    levels = trials.levels
    for group, of_group in trials.by_group():
        rows = of_group[measured[of_group]]
        if not len(rows):
            continue
        alone = contrasts_on_scenes(trials.select(rows), contrasts[rows], sharp_share=sharp_share())
        means = alone or _level_means(levels[rows], contrasts[rows, :, 0])
        for own, after, error in zip(found, means.contrast.T, means.gain_error.T, strict=True):
            columns = (means.level, means.contrast[:, 0], after, error, means.n_trials)
            own[group] = tuple(_point(*point) for point in zip(*map(np.ndarray.tolist, columns), strict=True))
    return found


def _point(level: float, before: float, after: float, error: float, n_trials: int) -> ContrastPoint:
    if not before > 0.0:
        return ContrastPoint(level, before, after, None, None, n_trials)
    return ContrastPoint(level, before, after, after / before, error if math.isfinite(error) else None, n_trials)


def _level_means(levels: FloatArray, contrasts: FloatArray) -> OnScenes:
    """Return mean contrasts, and standard errors of their quotients from the trials' distances from these."""
    level, of_level, n_trials = np.unique(levels, return_inverse=True, return_counts=True)
    parts = [contrasts[of_level == k] for k in range(len(level))]
    means = np.array([part.mean(axis=0) for part in parts])
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = means / means[:, :1]
        squares = [
            ((part - ratio * part[:, :1]) ** 2).sum(axis=0) for part, ratio in zip(parts, ratios, strict=True)
        ]
        errors = np.sqrt(squares / (n_trials * (n_trials - 1.0))[:, None]) / means[:, :1]
    return OnScenes(level, means, errors, n_trials)
