"""Spatial dither: pixels of two neighbouring code values whose mean is a luminance between them."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray

TILE = 64
"""Side of the pattern of thresholds in pixels; it repeats beyond."""

SAME_LUMINANCE = 1e-9
"""Relative difference to a code's luminance below which the two count as equal."""

TILE_SIGMA = 1.5
"""Standard deviation of the repulsion between pixels of the pattern, in pixels (Ulichney 1993)."""


@cache
def blue_noise() -> FloatArray:
    """Return thresholds in (0, 1), each once, shape (64, 64), whose lowest ones are spread evenly for any number.
    Each next threshold goes where the repulsion of all lower ones is least (void and cluster, Ulichney 1993), so
    the pattern has no coarse grain and no lines that could give moiré with a camera's pixels. Opposite edges fit
    together.
    """
    distance = np.minimum(np.arange(TILE), TILE - np.arange(TILE))
    bell = np.exp(-(distance**2) / (2.0 * TILE_SIGMA**2))
    repulsion = np.outer(bell, bell)
    # The first pixels have many equally good places; the noise decides among these alone.
    energy = 1e-6 * np.random.default_rng(0).random((TILE, TILE))
    thresholds = np.empty((TILE, TILE))
    for rank in range(TILE**2):
        row, column = divmod(int(np.argmin(energy)), TILE)
        thresholds[row, column] = (rank + 0.5) / TILE**2
        energy += np.roll(repulsion, (row, column), (0, 1))
        energy[row, column] = np.inf
    thresholds.flags.writeable = False
    return thresholds


def dithered(luminance: FloatArray, luminance_of_code: FloatArray) -> NDArray[np.uint16]:
    """Return code values whose luminances have the required sum, as exactly as code values allow: (rows, columns).
    `luminance_of_code` rises strictly, and `luminance` is within its range. Each pixel has one of the two code
    values on either side of its luminance, and that of its luminance if there is one. The sum over all pixels is
    off by at most half of a code step of one pixel.
    """
    index = np.searchsorted(luminance_of_code, luminance * (1.0 + SAME_LUMINANCE), side="right") - 1
    below = np.clip(index, 0, luminance_of_code.size - 2)
    step = luminance_of_code[below + 1] - luminance_of_code[below]
    share = (luminance - luminance_of_code[below]) / step
    rows, columns = luminance.shape
    tiles = np.tile(blue_noise(), (-(-rows // TILE), -(-columns // TILE)))[:rows, :columns]
    # A plain comparison, share > threshold, has the sum only on average; the first pixels by this order have it.
    between = np.flatnonzero(share > SAME_LUMINANCE)
    order = between[np.argsort((tiles - share).ravel()[between], kind="stable")]
    added = np.concatenate([[0.0], np.cumsum(step.ravel()[order])])
    n_raised = int(np.argmin(np.abs(added - np.sum(share * step))))
    code = below.astype(np.uint16)
    code.ravel()[order[:n_raised]] += 1
    return code
