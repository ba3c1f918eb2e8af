"""What noise on the neurons does to four scores, whatever the neurons that the templates are weights of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.edgeworth import fourth_cumulants
from todframes.readout import inner_product

FloatArray = NDArray[np.float64]
Bands = tuple[FloatArray, ...]
"""Activity, or weights, of all neurons: arrays of any shape, the finest band first."""

UNIFORM_EXCESS_KURTOSIS = -1.2
LEAST_KURTOSIS = 1e-4
"""Of summed noise that is not taken as Gaussian; below, that changes P(correct) by less than 7e-6."""


class ScoreNoise(NamedTuple):
    """Noise on the four scores less the noise they share; the attributes are those of `Readout`."""

    covariance: FloatArray
    excess_kurtosis: float
    fourth_cumulants: FloatArray | None


def score_noise(upright: Bands, turned: Callable[[Bands, int], Bands], noise_sd: float) -> ScoreNoise:
    """What independent uniform noise of a standard deviation on every neuron comes to.

    Parameters
    ----------
    upright : Bands
        The upright triangle's template, less what all four have in common.
    turned : callable
        Gives the template of a triangle turned clockwise by so many quarters, from that of the triangle.
    """
    beside = turned(upright, 1)
    opposite = turned(beside, 1)
    kurtosis = UNIFORM_EXCESS_KURTOSIS * _participation(upright, (beside, opposite))
    cumulants = None
    if abs(kurtosis) > LEAST_KURTOSIS:
        four = (upright, beside, opposite, turned(opposite, 1))
        rows = np.array([np.concatenate([band.ravel() for band in bands]) for bands in four])
        cumulants = fourth_cumulants(noise_sd * rows, excess_kurtosis=UNIFORM_EXCESS_KURTOSIS)
    return ScoreNoise(noise_sd**2 * _overlaps(upright, beside, opposite), kurtosis, cumulants)


def _overlaps(upright: Bands, beside: Bands, opposite: Bands) -> FloatArray:
    """Inner products of the four template deviations, a circulant matrix by symmetry."""
    same, next_to, across = (sum(map(inner_product, upright, other)) for other in (upright, beside, opposite))
    row = [same, next_to, across, next_to]
    return np.array([np.roll(row, k) for k in range(4)])


def _participation(upright: Bands, others: Sequence[Bands]) -> float:
    """Σw⁴ / (Σw²)² of the weights of a score difference, the largest of these."""
    largest = 0.0
    for other in others:
        squares = [np.square(a - b) for a, b in zip(upright, other, strict=True)]
        total = sum(float(one.sum()) for one in squares)
        if total > 0.0:
            largest = max(largest, sum(map(inner_product, squares, squares)) / total**2)
    return largest
