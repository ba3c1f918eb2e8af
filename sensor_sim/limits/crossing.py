"""Find the value of one number at which the threshold of a sensor meets what is asked for, with its error."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from operator import attrgetter
from typing import NamedTuple

from todframes.psychometrics.threshold_search import bracket

STEP = 2.0
"""Factor between the values that are tried until one is judged and its neighbour is not."""

PRECISION = 5e-4
"""Relative precision of the root, below the error of the thresholds."""

UNREACHED = 50.0
"""Logarithm of threshold over target that stands for a threshold that is never reached."""


class Try(NamedTuple):
    """One value of the parameter: ln(threshold / target), its error, and the threshold, if there is one."""

    value: float
    excess: float
    error: float
    threshold: float | None

    @classmethod
    def of(cls, value: float, threshold: float | None, error: float, target: float) -> Try:
        """Return the record of a threshold, None if it is never reached, and its relative error."""
        excess = math.inf if threshold is None else math.log(threshold / target)
        return cls(value, excess, error, threshold)


class Crossing(NamedTuple):
    """The value at which the threshold is the target, and half of its 95 % interval; all values that were tried.
    The error of a whole number is 0 if no other one is in that interval.
    `value` is None if none was found between the ends of the range. `is_least` states that larger values are
    judged, `is_judged` that the first value was.
    """

    value: float | None
    error: float | None
    is_least: bool
    is_judged: bool
    tries: tuple[Try, ...]


def find_crossing(
    attempt: Callable[[float], Try],
    start: float,
    *,
    low: float,
    high: float,
    larger_is_better: bool | None = None,
    is_whole: bool = False,
) -> Crossing:
    """Find the value nearest to `start` at which the excess changes its sign, by steps of a factor and by Brent.
    The range is from `low` to `high`, both > 0. Of whole numbers it is the outermost one that is judged. Both
    directions are tried unless it is known whether larger values are better.
    """
    tries: dict[float, Try] = {}

    def excess(log_value: float) -> float:
        value = start if log_value == first else math.exp(log_value)  # exp(ln(start)) may be its neighbour
        value = float(round(value)) if is_whole else value
        if value not in tries:
            tries[value] = attempt(value)
        return min(tries[value].excess, UNREACHED)

    first = math.log(start)
    is_judged = excess(first) <= 0.0
    ends = math.log(low), math.log(high)
    if larger_is_better is not None:
        ends = (ends[0], first) if larger_is_better is is_judged else (first, ends[1])
    found = bracket(excess, first, ends=ends, step=math.log(STEP))
    if found is None:
        return Crossing(None, None, True, is_judged, tuple(sorted(tries.values())))
    below, above = found
    is_least = excess(below) > 0.0
    if is_whole:
        a, b = round(math.exp(below)), round(math.exp(above))
        while b - a > 1:
            middle = (a + b) // 2
            a, b = (middle, b) if (excess(math.log(middle)) > 0.0) is is_least else (a, middle)
        value = float(b if is_least else a)
        error = _whole_error(tries[float(a)], tries[float(b)], value)
    else:
        from scipy.optimize import brentq

        value = math.exp(brentq(excess, below, above, xtol=PRECISION))
        error = _error(sorted(tries.values()), value)
    return Crossing(value, error, is_least, is_judged, tuple(sorted(tries.values())))


def _error(tries: list[Try], value: float) -> float:
    """Return the error of a root: that of the threshold nearby, over the slope between its two neighbours."""
    number = bisect_right(tries, value, 1, len(tries) - 1, key=attrgetter("value"))
    below, above = tries[number - 1], tries[number]
    slope = (above.excess - below.excess) / math.log(above.value / below.value)
    near = max(below.error, above.error)
    return value * (math.hypot(near / abs(slope), PRECISION) if slope else math.inf)


def _whole_error(below: Try, above: Try, value: float) -> float:
    """Return the error of a whole number, one of two neighbours between which the threshold is the target: the
    distance to the farthest whole number that is the limit if the thresholds are off by their errors.
    """
    excess = [min(attempt.excess, UNREACHED) for attempt in (below, above)]
    root = below.value * (above.value / below.value) ** (excess[0] / (excess[0] - excess[1]))
    error, to_whole = _error([below, above], root), math.ceil if excess[0] > 0.0 else math.floor
    return max(abs(float(to_whole(max(end, 1.0))) - value) for end in (root - error, root + error))
