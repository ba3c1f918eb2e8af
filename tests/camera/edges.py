"""Slanted edges of known MTF, rendered without the packages: a closed-form MTF, integrated over square pixels."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.interpolate import CubicSpline


class Optics(NamedTuple):
    """An MTF, a function of the frequency in cycles/pixel, and the frequency from which it is 0 to 1e-9."""

    mtf: Callable[[np.ndarray], np.ndarray]
    end: float


def gaussian(sigma_px: float) -> Optics:
    return Optics(lambda f: np.exp(-2 * (np.pi * sigma_px * f) ** 2), 1.03 / sigma_px)


def diffraction(cut_off: float) -> Optics:
    def mtf(f):
        x = np.clip(f / cut_off, 0.0, 1.0)
        return 2 / np.pi * (np.arccos(x) - x * np.sqrt(1 - x * x))

    return Optics(mtf, cut_off)


def true_mtf(f: np.ndarray, optics: Optics, angle_deg: float) -> np.ndarray:
    """MTF along the edge's normal: that of the optics times that of a square pixel, seen at this angle."""
    angle = math.radians(angle_deg)
    return optics.mtf(f) * np.sinc(f * math.cos(angle)) * np.sinc(f * math.sin(angle))


def profile(distance_px: np.ndarray, optics: Optics, angle_deg: float) -> np.ndarray:
    """Value of a pixel at a distance from the edge: 1/2 + ∫ MTF(f) sin(2πfd) / (πf) df, by Gauss-Legendre.

    The integrand has at most `end` · 60 periods in 60 pixels; with 6 points for each the sum is exact to 1e-10.
    """
    points, weights = leggauss(int(6 * optics.end * np.abs(distance_px).max()) + 100)
    f, w = (points + 1) / 2 * optics.end, weights / 2 * optics.end
    return 0.5 + np.sin(2 * np.pi * np.outer(distance_px, f)) @ (w * true_mtf(f, optics, angle_deg) / f) / np.pi


def edge_image(
    shape: tuple[int, int],
    angle_deg: float,
    optics: Optics,
    *,
    low: float = 0.2,
    high: float = 0.8,
    radius_px: float = math.inf,
    displaced_px: Callable[[np.ndarray], np.ndarray] | None = None,
) -> np.ndarray:
    """An edge whose normal points `angle_deg` from the right, downwards; straight or an arc.

    It may be displaced along the normal by a function of the place along it, of which 0 is in the middle.
    """
    angle = math.radians(angle_deg)
    y, x = np.indices(shape) - (np.array(shape) - 1)[:, None, None] / 2.0
    x, y = x - 0.3, y - 0.1
    d, s = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
    if math.isfinite(radius_px):
        d = np.hypot(d + radius_px, s) - radius_px
    if displaced_px is not None:
        d = d - displaced_px(s)
    # Between points 0.05 apart a cubic spline is exact to 1e-6 for optics of 3 cycles/pixel.
    grid = np.arange(math.floor(d.min()) - 1.0, d.max() + 1.1, 0.05)
    return low + (high - low) * CubicSpline(grid, profile(grid, optics, angle_deg))(d)
