"""The threshold SNR of a computed psychometric function, in few evaluations."""

from __future__ import annotations

import math
from collections.abc import Callable

from todframes.crossing import Crossing, find_crossing

LEVEL_RANGE = (1e-6, 1e9)


def crossing(
    proportion: Callable[[float], float], p_correct: float, *, near: float | None, slope: float
) -> Crossing:
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
    return find_crossing(proportion, p_correct, bounds=LEVEL_RANGE, start=1.0, factor=2.0)


def _link(p_correct: float) -> float:
    share = min(max((p_correct - 0.25) / 0.75, 1e-6), 1.0 - 1e-6)
    return math.log(-math.log1p(-share))
