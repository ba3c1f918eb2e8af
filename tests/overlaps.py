"""Overlaps: polygons clipped at lines, intervals of two axes by comparing every pair, and weights on detectors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import sensor_sim as ss
from sensor_sim.chain.reconstruction import display_position_px
from todframes.observers.interface import Readout


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


def weights_at(sensor: ss.Sensor, readout: Readout, field: int, x: float, y: float) -> np.ndarray:
    """Weights of the scores on the detectors, (4, field²), with the retina's middle at a place, by dense overlaps.
    SciPy's blur of the display is its own adjoint."""
    shown, grid, pixels = sensor.display, readout.grid, sensor.display.pixels_per_detector
    pixel = shown.pixel_pitch_mrad
    rows, columns = (
        shares_of_samples(
            grid.side,
            grid.pitch_mrad,
            middle_mrad=display_position_px(at, n_detectors=field, display=shown) * pixel,
            pitch_mrad=pixel,
            n_pixels=field * pixels,
        )
        for at in (y, x)
    )
    turned = [np.rot90(readout.deviations[0], -k) for k in range(len(readout.deviations), 4)]
    on_display = rows.T @ np.stack([*readout.deviations, *turned]) @ columns
    blur = math.hypot(sensor.electronics.blur_sigma_px, shown.blur_sigma_px)
    assert blur == 0.0 or blur >= 1.5, "a narrower kernel is not SciPy's"
    if blur:
        on_display = gaussian_filter(on_display, (0.0, blur, blur), mode="constant", truncate=9.0)
    return on_display.reshape(4, field, pixels, field, pixels).sum(axis=(2, 4)).reshape(4, -1)


def clipped(polygon: list, axis: int, edge: Any, sign: int) -> list:
    """Return the part of a polygon beyond an edge, or (sign −1) before it, in whatever numbers it has."""
    kept = []
    for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        a, b = sign * (p[axis] - edge), sign * (q[axis] - edge)
        if a >= 0:
            kept.append(p)
        if a * b < 0:
            kept.append(tuple(u + a / (a - b) * (v - u) for u, v in zip(p, q, strict=True)))
    return kept
