"""Error of a mean over independent replicates of a low-discrepancy sequence, each shifted at random."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

REPLICATES = 8
"""Number of independent replicates whose spread gives the error of their mean."""

_STUDENT_T = {5: (2.7764, 3.4954), 8: (2.3646, 2.8412)}
"""For each number of replicates, the 97.5 % and 98.75 % points of Student's t with one degree of freedom less."""


def half_width_95(replicates: ArrayLike, *, is_refined: bool = True) -> float:
    """Compute the half-width of the 95 % interval of the mean of replicates.

    Parameters
    ----------
    replicates : array_like, shape (n,)
        A value of each replicate, n being 5 or 8.
    is_refined : bool
        Whether trials were added until this half-width was small enough. Half of the 5 % is then reserved for
        error estimates that were small by chance.
    """
    values = np.asarray(replicates, dtype=np.float64)
    return _STUDENT_T[len(values)][is_refined] * float(values.std(ddof=1)) / math.sqrt(len(values))
