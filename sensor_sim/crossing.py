"""Where a rising curve passes a criterion."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

LEVEL_RANGE = (1e-6, 1e9)


def crossing(
    proportion: Callable[[float], float], p_correct: float, *, near: float | None, slope: float
) -> tuple[Literal["ok", "never_reached", "always_exceeded"], float | None]:
    """Where a rising curve passes `p_correct`: by steps along its slope from nearby, else a search from 1 on."""
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
    return _search(proportion, p_correct)


def _link(p_correct: float) -> float:
    share = min(max((p_correct - 0.25) / 0.75, 1e-6), 1.0 - 1e-6)
    return math.log(-math.log1p(-share))


def _search(
    proportion: Callable[[float], float], p_correct: float
) -> tuple[Literal["ok", "never_reached", "always_exceeded"], float | None]:
    """The same by doubling or halving from 1 until the criterion lies in between, then by false position."""
    low = high = 0.0
    at_low = at_high = proportion(1.0) - p_correct
    while at_low > 0:
        high, at_high, low = low, at_low, low - math.log(2.0)
        if low < math.log(LEVEL_RANGE[0]):
            return "always_exceeded", None
        at_low = proportion(math.exp(low)) - p_correct
    while at_high <= 0:
        low, at_low, high = high, at_high, high + math.log(2.0)
        if high > math.log(LEVEL_RANGE[1]):
            return "never_reached", None
        at_high = proportion(math.exp(high)) - p_correct
    return "ok", math.exp(_root(lambda x: proportion(math.exp(x)) - p_correct, low, high, at_low, at_high))


def _root(function: Callable[[float], float], low: float, high: float, at_low: float, at_high: float) -> float:
    """Root of a rising function between two places, to 1e-6, by the Illinois rule (Dowell & Jarratt 1971)."""
    for _ in range(60):
        middle = (low * at_high - high * at_low) / (at_high - at_low)
        at_middle = function(middle)
        if abs(at_middle) < 1e-7 or high - low < 1e-6:
            return middle
        if at_middle > 0:
            high, at_high, at_low = middle, at_middle, at_low / 2.0
        else:
            low, at_low, at_high = middle, at_middle, at_high / 2.0
    return middle
