"""What four templates have to do with each other, whatever the neurons that they are weights of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from todframes.readout import inner_product

FloatArray = NDArray[np.float64]
Bands = tuple[FloatArray, ...]
"""Activity, or weights, of all neurons: arrays of any shape, the finest band first."""


def overlaps(turned: Sequence[Bands]) -> FloatArray:
    """Inner products of the four template deviations, (4, 4): a circulant matrix by symmetry.

    Parameters
    ----------
    turned : sequence of Bands
        That of the upright triangle, turned by none, one and two quarters.
    """
    same, beside, opposite = (sum(map(inner_product, turned[0], turned[k])) for k in range(3))
    row = [same, beside, opposite, beside]
    return np.array([np.roll(row, k) for k in range(4)])


def participation(turned: Sequence[Bands]) -> float:
    """Σw⁴ / (Σw²)² of the weights of a score difference, the larger of the two kinds.

    `turned` is that of `overlaps`.
    """
    largest = 0.0
    for other in turned[1:3]:
        squares = [np.square(a - b) for a, b in zip(turned[0], other, strict=True)]
        total = sum(float(one.sum()) for one in squares)
        if total > 0.0:
            largest = max(largest, sum(map(inner_product, squares, squares)) / total**2)
    return largest
