"""Displayed contrast of triangles in front of scenes, without the contrast of the scenes themselves.

In each trial four contrasts are measured: in the area of the triangle shown, and in the areas of triangles of the
three other orientations. A scene that is brighter behind a triangle than around it adds the same four numbers to
all trials of a view, whatever their triangle.

Least squares takes them out and finds, at each level, the contrast a in the area of the triangle, and the smaller
ones s and q in the areas to its side and opposite to it. A constant that all three share stays unknown; the
difference a − q is known. By the shape of the triangle, as display and algorithm blur it, s and q are fixed shares
of a − q at all levels, and follow from how s and q rise with it. If the contrast hardly differs between levels,
the shares are those of a sharp triangle.
"""

from __future__ import annotations

from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.frames.trials import Trials

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
