"""Contrast gain of an enhancement: the triangle's displayed contrast after it, divided by that before it. A person
can turn up a display. An algorithm that only amplifies is no better than that, even if it lowers the threshold a
lot. So each algorithm is also compared with a plain gain of the same amount, which nothing clips.

In front of scenes, four contrasts are measured in each trial: in the area of the triangle shown, and in the areas
of triangles of the three other orientations. A scene that is brighter behind a triangle than around it adds the
same four numbers to all trials of a view, whatever their triangle. Least squares takes them out and finds, at each
level, the contrast a in the area of the triangle, and the smaller ones s and q to its side and opposite to it. A
constant that all three share stays unknown; the difference a − q is known. By the shape of the triangle, as
display and algorithm blur it, s and q are fixed shares of a − q at all levels, and follow from how s and q rise
with it. If the contrast hardly differs between levels, the shares are those of a sharp triangle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, lru_cache
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.frames.trials import Group, Trial, Trials
from todframes.observers.retina import RetinaGrid
from todframes.results.data import Positive
from todframes.scoring.trial_scores import TrialPatches, retina_image
from todframes.stimulus import ORIENTATIONS, Centre, Orientation, coverage

MOST_LEVELS = 40
"""Largest number of levels whose contrasts are found together."""

FEW_SCENES, MOST_BLOCKS = 4, 50
"""Number of scenes from which errors are those of scenes, not of views; largest number of parts that are left out
in turn."""

NOTHING = 1e-9
"""Share of the largest eigenvalue up to which one is rounding."""

KINDS = np.array([0, 1, 2, 1])
"""Kind of orientation, from that of the triangle clockwise: its own, to the side, opposite, to the side."""


class OnScenes(NamedTuple):
    """Displayed contrasts of the triangle at each level, ascending, without backgrounds.

    `contrast` and `gain_error` have shape (level, algorithm). The latter is the standard error of a contrast over
    that of the first algorithm, by leaving out scenes in turn, or views if there are few scenes; NaN if there is
    only one view.
    """

    level: FloatArray
    contrast: FloatArray
    gain_error: FloatArray
    n_trials: NDArray[np.intp]


def views_to_measure(trials: Trials) -> NDArray[np.intp] | None:
    """Choose trials of one group whose backgrounds are known from others, all of a view or none.

    None if the trials have no scenes, or too few of them share a background.
    """
    if not trials.has_scenes:
        return None
    turns = trials.quarter_turns
    found = [("" if view is None else view.scene, rows) for view, rows in trials.by_view()]
    views = [rows for _, rows in sorted(found, key=itemgetter(0)) if len(np.unique(turns[rows])) > 1]
    if not views:
        return None
    trials_a_view = np.mean([len(rows) for rows in views])
    most = max(round(48 * len(np.unique(trials.levels)) / trials_a_view), 2)
    chosen = np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(np.intp)
    return np.concatenate([views[k] for k in chosen])


def contrasts_on_scenes(trials: Trials, contrasts: FloatArray, *, sharp_share: float) -> OnScenes | None:
    """Separate the displayed contrast of triangles of one group from that of the scenes behind them.

    `contrasts`, (trial, algorithm, 4), are those of `triangle_contrasts`; `sharp_share` is that of the opposite
    orientation for a sharp triangle of contrast 1. None if the trials do not determine the contrasts: too few
    share their background, or have other levels.
    """
    level, of_level = np.unique(trials.levels, return_inverse=True)
    views = trials.by_view()
    if not trials.has_scenes or len(level) > MOST_LEVELS:
        return None
    n_params, turns = len(KINDS[:3]) * len(level), trials.quarter_turns
    squares = np.zeros((len(views), n_params, n_params))
    products = np.zeros((len(views), n_params, contrasts.shape[1]))
    for number, (_, rows) in enumerate(views):
        design = np.zeros((len(rows), 4, n_params))
        seen = np.empty((len(rows), 4, contrasts.shape[1]))
        for row, trial in enumerate(rows):
            absolute = (turns[trial] + np.arange(4)) % 4
            design[row, absolute, 3 * of_level[trial] + KINDS] = 1.0
            seen[row, absolute] = contrasts[trial].T
        design -= design.mean(axis=0)
        seen -= seen.mean(axis=0)
        squares[number] = np.tensordot(design, design, ([0, 1], [0, 1]))
        products[number] = np.tensordot(design, seen, ([0, 1], [0, 1]))
    n_trials = np.bincount(of_level)
    contrast = _contrasts(squares.sum(axis=0), products.sum(axis=0), n_trials, sharp_share)
    if not np.isfinite(contrast).all():
        return None
    names = ["" if view is None else view.scene for view, _ in views]
    block = np.unique(names, return_inverse=True)[1] if len(set(names)) >= FEW_SCENES else np.arange(len(views))
    block %= MOST_BLOCKS
    gain_error = np.full(contrast.shape, np.nan)
    if (n_blocks := int(block.max()) + 1) > 1:
        with np.errstate(divide="ignore", invalid="ignore"):
            left = []
            for one in range(n_blocks):
                kept = block != one
                found = _contrasts(squares[kept].sum(axis=0), products[kept].sum(axis=0), n_trials, sharp_share)
                left.append(found / found[:, :1])
            gain_error = np.sqrt((n_blocks - 1) * np.var(left, axis=0))
    return OnScenes(level, contrast, gain_error, n_trials)


def _contrasts(
    squares: FloatArray, products: FloatArray, n_trials: NDArray[np.intp], sharp_share: float
) -> FloatArray:
    """Solve the normal equations; return the contrast at each level for each algorithm, NaN if it is not known."""
    values, vectors = np.linalg.eigh(squares)
    is_known = values > NOTHING * values[-1]
    known = vectors[:, is_known]
    found = (known @ ((known.T @ products) / values[is_known, None])).reshape(len(n_trials), 3, -1)
    still_open = vectors[:, ~is_known].reshape(len(n_trials), 3, -1)
    if not np.abs(still_open[:, 0] - still_open[:, 2]).max(initial=0.0) < 1e-6:
        return np.full((len(n_trials), found.shape[2]), np.nan)
    apart = found[:, 0] - found[:, 2]
    weight = np.sqrt(n_trials / n_trials.sum())[:, None]
    free = np.concatenate([weight * still_open[:, 1], weight * still_open[:, 2]])
    contrast = np.empty(apart.shape)
    for k in range(apart.shape[1]):
        one = weight[:, 0] * apart[:, k]
        seen = np.concatenate([weight[:, 0] * found[:, 1, k], weight[:, 0] * found[:, 2, k]])
        of_sides, of_opposite = np.concatenate([one, 0.0 * one]), np.concatenate([0.0 * one, one])
        others = np.column_stack([of_sides, free])
        left = of_opposite - others @ np.linalg.lstsq(others, of_opposite)[0]
        # The shape is known if what stays open cannot explain a tenth of a − q.
        is_shape_known = left @ left > 0.1**2 * (one @ one)
        share = left @ seen / (left @ left) if is_shape_known else sharp_share / (1.0 - sharp_share)
        contrast[:, k] = (1.0 + float(share)) * apart[:, k]
    return contrast


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
