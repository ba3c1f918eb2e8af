"""Landolt rings, and the acuity of people for rings of any contrast."""

from __future__ import annotations

import numpy as np

from todframes.base._typing import FloatArray

POINTS_PER_PX = 8
"""Points along each side of a pixel by which a ring is drawn; their mean is within 1 % of the area."""


def landolt_ring(shape_px: int, *, gap_px: float, quarter_turns: int = 0) -> FloatArray:
    """Draw a Landolt ring: outer diameter 5 gaps, width of the ring 1 gap.

    Parameters
    ----------
    shape_px : int
        Side of the square image, whose middle is the ring's.
    gap_px : float
        Width of the gap, > 0.
    quarter_turns : int
        Clockwise turns from a gap on the right.

    Returns
    -------
    ndarray, shape (shape_px, shape_px)
        Share of each pixel that the ring covers.
    """
    place = (np.arange(shape_px * POINTS_PER_PX) + 0.5) / POINTS_PER_PX - shape_px / 2.0
    radius = np.hypot(place, place[:, None]) / gap_px
    is_gap = (np.abs(place[:, None]) < gap_px / 2.0) & (place > 0.0)
    inside = (radius < 2.5) & (radius > 1.5) & ~is_gap
    pixels = inside.reshape(shape_px, POINTS_PER_PX, shape_px, POINTS_PER_PX).mean(axis=(1, 3))
    return np.rot90(pixels, -quarter_turns)


def people_acuity(*, contrast: float, luminance_cd_m2: float) -> float:
    """Compute the decimal acuity of young people for a Landolt ring: 1 / gap in arcmin.

    Parameters
    ----------
    contrast : float
        0.03 to 1.
    luminance_cd_m2 : float
        Of the background, > 0.

    Ikeda, Noda & Yamaguchi, as quoted; not checked against their paper.
    """
    per_cent = 100.0 * contrast
    return float(
        luminance_cd_m2 / (1.6293 * per_cent**-0.3234 * (0.8034 * per_cent**-0.1876 + luminance_cd_m2**0.25) ** 4)
    )
