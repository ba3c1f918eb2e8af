"""Where a rising curve passes a criterion."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Literal

Crossing = tuple[Literal["ok", "never_reached", "always_exceeded"], float | None]


def find_crossing(
    proportion: Callable[[float], float],
    p_correct: float,
    *,
    bounds: tuple[float, float],
    start: float,
    factor: float,
) -> Crossing:
    """Where a rising curve passes `p_correct`, searched on a logarithmic scale outwards from `start`.

    Parameters
    ----------
    proportion : callable
        Proportion correct at a level > 0.
    bounds : (float, float)
        Levels beyond which the search ends.
    factor : float
        > 1; from one level tried to the next.

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
    while excess(high) <= 0:
        low, high = high, high + math.log(factor)
        if high > math.log(bounds[1]):
            return "never_reached", None
    return "ok", math.exp(brentq(excess, low, high, xtol=1e-7, rtol=1e-7))
