"""Search for the level where a rising curve passes a criterion."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal, TypeVar

from todframes.base.errors import SettingsError

Status = Literal["ok", "never_reached", "always_exceeded", "too_uncertain"]
IMPOSSIBLE: Literal["impossible"] = "impossible"
"""Status of a threshold that cannot be computed."""

TOO_UNCERTAIN: Literal["too_uncertain"] = "too_uncertain"
"""Status of a threshold whose numerical error is above `LARGEST_ERROR`."""

LARGEST_ERROR = 0.3
"""Largest numerical error of a threshold, as a share of it."""

Crossing = tuple[Status, float | None]
LEVEL_RANGE = (1e-6, 1e9)
SATURATED = 1e-3
"""Largest distance of P from its value at the upper bound at which a curve counts as having reached it."""

USUAL_SLOPE, LEAST_SLOPE, LARGEST_SLOPE = 1.5, 0.01, 20.0
"""Slope of the link of P against ln SNR: its usual value, and the limits within which secants are reliable."""

LAST_STEP = 1e-5
"""Step of a secant in ln level after which the search ends: the next step would be far smaller."""


@dataclass(frozen=True, slots=True)
class ComputedThreshold:
    """A threshold that was computed without trials, or the status of one that is missing. It and its numerical
    error are in the unit of the varied quantity.
    """

    status: Status | Literal["impossible"]
    threshold: float | None = None
    numerical_error: float | None = None


T = TypeVar("T", bound=ComputedThreshold)


def if_known(computed: T) -> T:
    """Return the threshold, or its absence if its numerical error is above `LARGEST_ERROR`."""
    if computed.threshold is None or (computed.numerical_error or 0.0) <= LARGEST_ERROR * computed.threshold:
        return computed
    return replace(computed, status=TOO_UNCERTAIN, threshold=None, numerical_error=None)


def crossing(
    proportion: Callable[[float], float], p_correct: float, *, near: float | None, slope: float
) -> Crossing:
    """Find where a rising curve passes `p_correct`, along secants from nearby or from 1 on. `proportion` is that
    correct at a level > 0; at infinity, that without detector noise. `near` and `slope` are a level that may be
    near, and dP / d ln level there; None and NaN if not known.
    """

    def is_never_reached() -> bool:
        return proportion(math.inf) <= p_correct

    if near is None and is_never_reached():
        return "never_reached", None
    # On the scale of the link P is nearly a straight line against ln level.
    target = _link(p_correct)
    x = 0.0 if near is None else math.log(near)
    slope *= _link_slope(p_correct)
    if near is None or not LEAST_SLOPE < slope < LARGEST_SLOPE:
        slope = USUAL_SLOPE
    excess = _link(proportion(math.exp(x))) - target
    is_secant = False
    for _ in range(10):
        step = min(max(-excess / slope, -2.0), 2.0)
        x += step
        if abs(step) < (LAST_STEP if is_secant else LAST_STEP / 100.0):
            return "ok", math.exp(x)
        before, excess = excess, _link(proportion(math.exp(x))) - target
        slope, is_secant = (excess - before) / step, True
        if not LEAST_SLOPE < slope < LARGEST_SLOPE:
            break
    if near is not None and is_never_reached():
        return "never_reached", None
    start = math.exp(min(max(x, math.log(LEVEL_RANGE[0])), math.log(LEVEL_RANGE[1])))
    return find_crossing(proportion, p_correct, bounds=LEVEL_RANGE, start=start, factor=2.0)


def _link(p_correct: float) -> float:
    share = min(max((p_correct - 0.25) / 0.75, 1e-6), 1.0 - 1e-6)
    return math.log(-math.log1p(-share))


def _link_slope(p_correct: float) -> float:
    """Return d link / dP."""
    rest = 1.0 - (p_correct - 0.25) / 0.75
    return -1.0 / (0.75 * rest * math.log(rest)) if 0.0 < rest < 1.0 else math.inf


def find_crossing(
    proportion: Callable[[float], float],
    p_correct: float,
    *,
    bounds: tuple[float, float],
    start: float,
    factor: float,
    saturates: bool = False,
) -> Crossing:
    """Find where a rising curve passes `p_correct`, to 1e-7 of the level, on a logarithmic scale outwards from
    `start` in steps of `factor`. The level is None if the curve stays below (`never_reached`) or above the
    criterion within the bounds. A curve that `saturates` stays, from some level on, where it is at the upper
    bound: if that is below the criterion, the search ends after two levels with P within `SATURATED` of it.
    """
    from scipy.optimize import brentq

    excess = lru_cache(maxsize=None)(lambda log_x: proportion(math.exp(log_x)) - p_correct)
    first, low, high = math.log(start), *map(math.log, bounds)
    is_above = excess(first) > 0.0

    def is_flat(*levels: float) -> bool:
        end = excess(high)
        return end <= 0.0 and all(abs(excess(level) - end) <= SATURATED for level in levels)

    ends = (low, first) if is_above else (first, high)
    stops = is_flat if saturates and not is_above else None
    found = bracket(excess, first, ends=ends, step=math.log(factor), stops=stops)
    if found is None:
        return "always_exceeded" if is_above else "never_reached", None
    return "ok", math.exp(brentq(excess, *found, xtol=1e-7, rtol=1e-7))


def bracket(
    excess: Callable[[float], float],
    first: float,
    *,
    ends: tuple[float, float],
    step: float,
    stops: Callable[[float, float], bool] | None = None,
) -> tuple[float, float] | None:
    """Return the two neighbours nearest to `first`, in steps to both ends, between which an excess changes its
    sign; None if there are none, or two neighbours are where the search `stops`. A SettingsError of the excess,
    where nothing has such a value, ends its side.
    """
    is_below, reached = excess(first) <= 0.0, [first, first]
    while reached[0] > ends[0] or reached[1] < ends[1]:
        for side, sign in ((1, 1.0), (0, -1.0)):
            if reached[side] == ends[side]:
                continue
            before = reached[side]
            reached[side] = max(ends[0], min(ends[1], before + sign * step))
            try:
                changes = (excess(reached[side]) <= 0.0) is not is_below
            except SettingsError:
                changes, reached[side] = False, ends[side]
            if changes:
                return (before, reached[side]) if side else (reached[side], before)
            if stops is not None and stops(before, reached[side]):
                return None
    return None
