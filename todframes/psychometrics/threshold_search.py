"""Search for the level where a rising curve passes a criterion."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Literal

Crossing = tuple[Literal["ok", "never_reached", "always_exceeded"], float | None]
LEVEL_RANGE = (1e-6, 1e9)
SATURATED = 1e-3
"""Largest distance of P from its value at the upper bound at which a curve counts as having reached it."""


def crossing(
    proportion: Callable[[float], float], p_correct: float, *, near: float | None, slope: float
) -> Crossing:
    """Find where a rising curve passes `p_correct`: along its slope from nearby, else by a search from 1 on."""
    if near is not None:
        for _ in range(8):
            step = (p_correct - proportion(near)) / slope
            near *= math.exp(min(max(step, -1.0), 1.0))
            if abs(step) < 1e-5:
                return "ok", near
    if proportion(math.inf) <= p_correct:  # without detector noise
        return "never_reached", None
    # On this scale P is nearly a straight line of slope 1.5 against ln SNR.
    target = _link(p_correct)
    x, slope = 0.0, 1.5
    excess = _link(proportion(1.0)) - target
    for _ in range(10):
        step = min(max(-excess / slope, -2.0), 2.0)
        before, x = excess, x + step
        excess = _link(proportion(math.exp(x))) - target
        if abs(excess) < 1e-6:
            return "ok", math.exp(x)
        slope = (excess - before) / step
        if not 0.1 < slope < 20.0:
            break
    return find_crossing(proportion, p_correct, bounds=LEVEL_RANGE, start=1.0, factor=2.0)


def _link(p_correct: float) -> float:
    share = min(max((p_correct - 0.25) / 0.75, 1e-6), 1.0 - 1e-6)
    return math.log(-math.log1p(-share))


def find_crossing(
    proportion: Callable[[float], float],
    p_correct: float,
    *,
    bounds: tuple[float, float],
    start: float,
    factor: float,
    saturates: bool = False,
) -> Crossing:
    """Find where a rising curve passes `p_correct`, on a logarithmic scale outwards from `start`.

    Parameters
    ----------
    proportion : callable
        Proportion correct at a level > 0.
    bounds : (float, float)
        Levels beyond which the search ends.
    factor : float
        > 1; from one level tried to the next.
    saturates : bool
        Whether P is known to stay, from some level on, where it is at the upper bound. If that is below the
        criterion, the search ends after two levels with P within `SATURATED` of it, instead of at the bound.

    Returns
    -------
    (status, level)
        The level to 1e-7 of itself; None if the curve stays below (`never_reached`) or above (`always_exceeded`).
    """
    from scipy.optimize import brentq

    excess = lru_cache(maxsize=None)(lambda log_x: proportion(math.exp(log_x)) - p_correct)
    low = high = math.log(start)
    while excess(low) > 0:
        high, low = low, low - math.log(factor)
        if low < math.log(bounds[0]):
            return "always_exceeded", None

    def is_saturated() -> bool:
        end = excess(math.log(bounds[1]))
        return low < high and end <= 0 and max(abs(excess(low) - end), abs(excess(high) - end)) <= SATURATED

    while excess(high) <= 0:
        if saturates and is_saturated():
            return "never_reached", None
        low, high = high, high + math.log(factor)
        if high > math.log(bounds[1]):
            return "never_reached", None
    return "ok", math.exp(brentq(excess, low, high, xtol=1e-7, rtol=1e-7))
