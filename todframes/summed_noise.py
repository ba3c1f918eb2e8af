"""What independent noise on neurons makes of four scores that sum it, whatever the neurons are."""

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
LEAST_KURTOSIS = 2e-3
"""Of summed noise that is not taken as Gaussian. What is below comes from so many neurons that their fourth
cumulants cost more than all else, and changes P(correct) by less than 1.4e-4."""


class SummedNoise(NamedTuple):
    """Of uniform noise in four score deviations: what `Readout` calls by these names."""

    noise_covariance: FloatArray
    excess_kurtosis: float
    find_fourth_cumulants: Callable[[], FloatArray] | None


def summed_noise(turned: Sequence[Bands], noise_sd: float) -> SummedNoise:
    """Noise of standard deviation `noise_sd`, uniform and independent, summed with these weights.

    Parameters
    ----------
    turned : sequence of four Bands
        Template deviations: that of the upright triangle, turned by none to three quarters.
    """
    kurtosis = UNIFORM_EXCESS_KURTOSIS * _participation(turned)

    def find_fourth_cumulants() -> FloatArray:
        rows = [np.concatenate([band.ravel() for band in bands]) for bands in turned]
        return fourth_cumulants(noise_sd * np.array(rows), excess_kurtosis=UNIFORM_EXCESS_KURTOSIS)

    is_gaussian = abs(kurtosis) <= LEAST_KURTOSIS
    return SummedNoise(noise_sd**2 * _overlaps(turned), kurtosis, None if is_gaussian else find_fourth_cumulants)


def _overlaps(turned: Sequence[Bands]) -> FloatArray:
    """Inner products of the four template deviations, (4, 4): a circulant matrix by symmetry."""
    same, beside, opposite = (sum(map(inner_product, turned[0], turned[k])) for k in range(3))
    row = [same, beside, opposite, beside]
    return np.array([np.roll(row, k) for k in range(4)])


def _participation(turned: Sequence[Bands]) -> float:
    """Σw⁴ / (Σw²)² of the weights of a score difference, the larger of the two kinds."""
    largest = 0.0
    for other in turned[1:3]:
        squares = [a - b for a, b in zip(turned[0], other, strict=True)]
        total = 0.0
        for one in squares:
            np.square(one, out=one)
            total += float(one.sum())
        if total > 0.0:
            for one in squares:
                one /= total
            largest = max(largest, sum(map(inner_product, squares, squares)))
    return largest
