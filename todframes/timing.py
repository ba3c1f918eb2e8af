"""What points of error against time tell: how fast the error falls, and the time that an error takes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Point(NamedTuple):
    """An estimator at one budget: trials, estimates that the errors are taken over, time of one, errors."""

    trials: int
    repeats: int
    cpu_s: float
    wall_s: float
    p_correct_error: float
    threshold_error: float


class TimeAt(NamedTuple):
    """CPU time that a threshold error takes; None if no budget tried has it.

    `extrapolated` along the measured 1/√N, to more trials than were drawn; `at_most` where even the smallest
    budget has it.
    """

    error: float
    cpu_s: float | None
    extrapolated: bool = False
    at_most: bool = False


class Ratio(NamedTuple):
    """How many times less CPU the fastest closed form takes than the literal Monte Carlo, at equal error.

    `closed_form` is its name; None if none of them has this error.
    """

    error: float
    ratio: float | None
    closed_form: str | None
    extrapolated: bool
    at_least: bool


def fitted_slope(
    x: FloatArray, y: FloatArray, *, blocks: NDArray[np.intp] | None
) -> tuple[float | None, float | None]:
    """Slope of a straight line and its standard error; None where there are too few points.

    Parameters
    ----------
    x, y : ndarray, shape (n,)
        Logarithms of time and error.
    blocks : ndarray of int, shape (n,), or None
        Each error is the root mean square of so many independent estimates, and all are blocks of the same trials:
        the variance of its logarithm is 1/(2·blocks), and a sum over few blocks holds no more chance than the one
        over many that it is part of, so the covariance of two is the smaller variance. None: the scatter about the
        line tells its error.
    """
    n = len(x)
    if n < 2:
        return None, None
    design = np.stack([np.ones(n), x], axis=1)
    covariance = np.eye(n) if blocks is None else 1.0 / (2.0 * np.maximum.outer(blocks, blocks))
    weighted = np.linalg.solve(covariance, design)
    inverse = np.linalg.inv(design.T @ weighted)
    line = inverse @ (weighted.T @ y)
    if blocks is None:
        if n < 3:
            return float(line[1]), None
        inverse *= float(np.sum((y - design @ line) ** 2)) / (n - 2)
    return float(line[1]), math.sqrt(inverse[1, 1])


def time_of_draws(points: Sequence[Point], set_up: float, drawn: int, error: float) -> TimeAt:
    """Along 1/√N through the smallest blocks: there are the most of them, and larger ones hold no more of it.

    It is extrapolated beyond the number of trials that were `drawn` in all.
    """
    if not points:
        return TimeAt(error, None)
    first = points[0]
    trials = first.trials * (first.threshold_error / error) ** 2
    each = (first.cpu_s - set_up) / first.trials
    return TimeAt(error, set_up + each * math.ceil(trials), extrapolated=trials > drawn)


def time_of_rule(points: Sequence[Point], error: float) -> TimeAt:
    """Between the last budget whose error is larger and the next one, along a straight line of logarithms."""
    larger = [number for number, point in enumerate(points) if point.threshold_error > error]
    if not larger:
        return TimeAt(error, points[0].cpu_s, at_most=True)
    if larger[-1] == len(points) - 1:
        return TimeAt(error, None)
    before, after = points[larger[-1]], points[larger[-1] + 1]
    height = math.log(before.threshold_error / max(after.threshold_error, 1e-300))
    share = math.log(before.threshold_error / error) / height
    return TimeAt(error, before.cpu_s * (after.cpu_s / before.cpu_s) ** share)


def speed_ratio(literal: TimeAt, closed_forms: Mapping[str, TimeAt]) -> Ratio:
    """CPU time of one over that of the fastest of the others by name, all at the same error."""
    times = {at.cpu_s: (name, at.at_most) for name, at in closed_forms.items() if at.cpu_s is not None}
    if literal.cpu_s is None or not times:
        return Ratio(literal.error, None, None, literal.extrapolated, at_least=False)
    name, at_most = times[min(times)]
    return Ratio(literal.error, literal.cpu_s / min(times), name, literal.extrapolated, at_most)
