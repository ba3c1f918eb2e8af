"""Overlaps of the intervals of two axes, by comparing every pair of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def shares_of_samples(
    side: int, sample_mrad: float, *, middle_mrad: float, pitch_mrad: float, n_pixels: int
) -> NDArray[np.float64]:
    """Return the share of each retina sample's width on each display pixel, shape (side, n_pixels).

    `side` samples of `sample_mrad` lie about `middle_mrad`; the middle of pixel k lies at k * `pitch_mrad`.
    """
    samples = middle_mrad + (np.arange(side)[:, None] - side / 2) * sample_mrad
    pixels = (np.arange(n_pixels)[None, :] - 0.5) * pitch_mrad
    common = np.minimum(samples + sample_mrad, pixels + pitch_mrad) - np.maximum(samples, pixels)
    return np.asarray(np.clip(common, 0.0, None) / sample_mrad)
