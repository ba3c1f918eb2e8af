"""Contrast gain of an enhancement: the triangle's displayed contrast after it, divided by that before it.  A
person can turn up a display. An algorithm that only amplifies is no better than that, even if it lowers the
threshold a lot. So each algorithm is also compared with a plain gain of the same amount, which nothing clips.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.frames.trials import Trial, Trials, indices_by
from todframes.observers.retina import RetinaGrid
from todframes.scoring.retina_view import Shown, retina_image
from todframes.stimulus import Centre, Orientation, Stimulus, coverage

RING_SIZES = (1.3, 2.0)
"""Inner and outer end of the ring that the triangle's contrast is measured against, in sizes of the triangle."""

LEAST_GAIN = 1e-6
"""Smallest gain that counts as one: below it the contrast after the algorithm is rounding."""

MEASURED_TRIALS = 24
"""Largest number of trials of a level below the highest whose contrast is measured: evenly spread."""

GroupValues = tuple[float | str, ...]


class LevelContrast(NamedTuple):
    """Displayed contrast of the triangle at a level, before and after an algorithm: means over `n_trials` trials.

    `gain` is their quotient and `gain_error` its standard error; None where the contrast before is not positive,
    or with a single trial.
    """

    level: float
    before: float
    after: float
    gain: float | None
    gain_error: float | None
    n_trials: int


def strongest_levels(trials: Sequence[Trial]) -> dict[GroupValues, float]:
    """Return the highest level of each group: the trials that show a contrast gain best."""
    strongest: dict[GroupValues, float] = {}
    for trial in trials:
        strongest[trial.group] = max(trial.level, strongest.get(trial.group, 0.0))
    return strongest


def measured_trials(trials: Trials, strongest: Mapping[GroupValues, float]) -> frozenset[int]:
    """Return the numbers of the trials whose contrast is measured: all of the highest levels, some of others."""
    _, level_codes = np.unique(trials.levels, return_inverse=True)
    cells = trials.group_codes.astype(np.int64) * (level_codes.max(initial=0) + 1) + level_codes
    found: set[int] = set()
    for rows in indices_by(cells):
        first = trials[rows[0]]
        if first.level != strongest[first.group] and len(rows) > MEASURED_TRIALS:
            evenly = np.linspace(0, len(rows) - 1, MEASURED_TRIALS).astype(np.intp)
            found.update(trials.numbers[rows[evenly]].tolist())
        else:
            found.update(trials.numbers[rows].tolist())
    return frozenset(found)


def triangle_contrasts(shown: Sequence[Shown], trial: Trial, *, grid: RetinaGrid, centre: Centre) -> list[float]:
    """Measure the contrast of the triangle as displayed: its mean minus that of a ring around it.

    Parameters
    ----------
    shown : sequence of Shown
        The trial's frames as displayed after each algorithm.
    trial : Trial
        Size, orientation and polarity of the triangle; contrast counts as positive in its direction.
    grid : RetinaGrid
        Grid that the frames are averaged on, whose middle is the triangle's centre.
    centre : {"centroid", "bounding_box"}
        Point of the triangle that lies in the middle of the grid.
    """
    weights = _weights(trial.stimulus, trial.orientation, grid, centre)
    return [float((weights * retina_image(one, grid)).sum()) for one in shown]


@lru_cache(maxsize=4)
def _weights(stimulus: Stimulus, orientation: Orientation, grid: RetinaGrid, centre: Centre) -> FloatArray:
    """Return the weights of a triangle's mean minus that of the ring around it: (side, side)."""
    inside, hole, whole = (
        coverage(
            (grid.side, grid.side),
            size_px=factor * stimulus.size_mrad / grid.pitch_mrad,
            x_px=grid.side // 2,
            y_px=grid.side // 2,
            orientation=orientation,
            centre=centre,
        )
        for factor in (1.0, *RING_SIZES)
    )
    ring = whole - hole
    return np.asarray(stimulus.polarity * (inside / inside.sum() - ring / ring.sum()))


def contrast_gains(
    trials: Sequence[Trial], contrasts: FloatArray, strongest: Mapping[GroupValues, float]
) -> list[dict[GroupValues, float]]:
    """Return the contrast gain of each algorithm in each group, against the first algorithm.

    Parameters
    ----------
    trials : sequence of Trial
    contrasts : ndarray, shape (trial, algorithm)
        Displayed contrast of the triangle, as by `triangle_contrasts`; only trials of the highest levels count.
    strongest : mapping
        The highest level of each group.

    Returns
    -------
    list of dict
        Gains by group for each algorithm; without the groups where the contrast is not positive before or
        after.
    """
    gains: list[dict[GroupValues, float]] = [{} for _ in range(contrasts.shape[1])]
    for group, level in strongest.items():
        these = [trial.group == group and trial.level == level for trial in trials]
        before, *_ = total = contrasts[these].sum(axis=0)
        for own, after in zip(gains, total, strict=True):
            if before > 0.0 and after > LEAST_GAIN * before and math.isfinite(after / before):
                own[group] = float(after / before)
    return gains


def contrast_responses(
    trials: Trials, contrasts: FloatArray
) -> list[dict[GroupValues, tuple[LevelContrast, ...]]]:
    """Return the displayed contrast of each algorithm against that of the first, level by level.

    Parameters
    ----------
    trials : Trials
    contrasts : ndarray, shape (trial, algorithm)
        As for `contrast_gains`; NaN where nothing was measured.

    Returns
    -------
    list of dict
        The levels of each group, ascending, for each algorithm.
    """
    found: list[dict[GroupValues, tuple[LevelContrast, ...]]] = [{} for _ in range(contrasts.shape[1])]
    measured: NDArray[np.bool_] = np.all(np.isfinite(contrasts), axis=1)
    levels = trials.levels
    for of_group in indices_by(trials.group_codes):
        rows = of_group[measured[of_group]]
        if not len(rows):
            continue
        group = trials.groups[trials.group_codes[rows[0]]]
        of_levels = [rows[levels[rows] == level] for level in np.unique(levels[rows])]
        for own, after in zip(found, contrasts.T, strict=True):
            own[group] = tuple(
                _level_contrast(float(levels[these[0]]), contrasts[these, 0], after[these]) for these in of_levels
            )
    return found


def _level_contrast(level: float, before: FloatArray, after: FloatArray) -> LevelContrast:
    """Compute the means, and the standard error of their quotient from the trials' distances from it."""
    n, mean_before, mean_after = len(before), float(before.mean()), float(after.mean())
    if not mean_before > 0.0:
        return LevelContrast(level, mean_before, mean_after, None, None, n)
    gain = mean_after / mean_before
    distance = after - gain * before
    error = None if n < 2 else math.sqrt(float(distance @ distance) / (n * (n - 1))) / mean_before
    return LevelContrast(level, mean_before, mean_after, gain, error, n)
