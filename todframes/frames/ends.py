"""The smallest step of recorded values, and the ends at which they are cut off, whatever a file could hold."""

from __future__ import annotations

from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

N_SAMPLED = 2**16
"""Largest number of values of a frame that are looked at; of more, every second, third … row is."""

MOST_ODD = 0.005
"""Share of the values that may lie between the others: replaced defect pixels are no steps."""

N_OUTER, FARTHEST = 6, 10.0
"""Number of distinct values that are kept at each end, and the largest distance of the outermost from the next,
relative to the mean distance of the others."""

LEAST_AT_END = 10
"""Least number of values at an end that are more than chance."""


class CutShares(NamedTuple):
    """Shares of the values that are cut off at the smallest and at the largest value; 0 where none are.

    `where` names these values.
    """

    bottom: float
    top: float
    where: str


class ValueEnds:
    """Tally of values, for their step and their ends.

    `step` is the smallest difference of the values of the first frame, 0 if there is but one; without the rarest
    of them. `floor` and `ceiling` are ends that are known, such as those of a file format.
    """

    def __init__(self, floor: float | None = None, ceiling: float | None = None) -> None:
        self.floor, self.ceiling = floor, ceiling
        self.n, self.step = 0, 0.0
        self._outer: tuple[Counter[float], Counter[float]] = Counter(), Counter()

    def add(self, frame: NDArray[Any]) -> None:
        """Add the values of a frame, or of a part of it."""
        values, counts = np.unique(frame[:: -(-frame.size // N_SAMPLED)], return_counts=True)
        if not self.n:
            self.step = _step(values, counts)
        self.n += int(counts.sum())
        for outer, order in zip(self._outer, (1, -1), strict=True):
            outermost = values[::order][:N_OUTER].tolist(), counts[::order][:N_OUTER].tolist()
            outer.update(dict(zip(*outermost, strict=True)))
            for inner in sorted(outer, reverse=order < 0)[N_OUTER:]:
                del outer[inner]

    @property
    def lowest(self) -> float:
        """Return the smallest value."""
        return min(self._outer[0])

    def cut(self, sd: float) -> CutShares:
        """Return the shares that are cut off, where noise has this standard deviation.

        Values at a known end are cut off. Elsewhere they are if they pile up: noise of half a step and more never
        makes the outermost value more frequent than the next, nor the share of neighbours rise towards an end
        (rounded values of a log-concave density are log-concave). Less noise may show one value by rounding.
        """
        bottom, top = (dict(sorted(outer.items())) for outer in self._outer)
        n_low = sum(n for value, n in bottom.items() if self.floor is not None and value <= self.floor)
        n_high = sum(n for value, n in top.items() if self.ceiling is not None and value >= self.ceiling)
        has_noise = sd >= self.step / 2
        n_low = n_low or has_noise * _piled([*bottom.items()])
        n_high = n_high or has_noise * _piled([*top.items()][::-1])
        values = [f"{value:.6g}" for n, value in ((n_low, min(bottom)), (n_high, max(top))) if n]
        return CutShares(n_low / self.n, n_high / self.n, " and ".join(values))


def _step(values: NDArray[Any], counts: NDArray[np.intp]) -> float:
    """Return the smallest difference of ascending values, without the rarest of them."""
    order = np.argsort(-counts, kind="stable")
    n_used = int(np.searchsorted(np.cumsum(counts[order]), (1.0 - MOST_ODD) * counts.sum())) + 1
    used = values[np.sort(order[:n_used])] if n_used > 1 else values
    return float(np.diff(used.astype(np.float64)).min()) if len(used) > 1 else 0.0


def _piled(outer: list[tuple[float, int]]) -> int:
    """Return how many values pile up at an end, given the outermost values from there inwards and their numbers.

    Values far from all others are impulses, such as those of stuck pixels.
    """
    if len(outer) < 3:
        return 0
    values, (outermost, second, third, *_) = zip(*outer, strict=True)
    is_beside = abs(values[0] - values[1]) <= FARTHEST * abs(values[1] - values[-1]) / (len(values) - 2)
    is_more = outermost >= LEAST_AT_END and outermost - second > 5.0 * (outermost + second) ** 0.5
    return outermost if is_beside and is_more and outermost * third > second**2 else 0
