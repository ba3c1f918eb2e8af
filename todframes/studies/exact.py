"""Images with exact answers, for any program that measures an MTF or a TOD: `todframes sample --exact`."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.safe_text import csv_text
from todframes.display.display import Display, table_of_display
from todframes.frames.dataset import Experiment
from todframes.frames.dataset_files import write_dataset_files
from todframes.frames.files import write_frame
from todframes.observers.decision import answer_probabilities
from todframes.stimulus import ORIENTATIONS, Centre, coverage

EDGE_SIDE_PX, DARK, BRIGHT = 160, 0.2, 0.8
"""Side of the pictures of edges, and their two values; full scale is 1."""

ANGLES_DEG, SIGMAS_PX = (4.0, 7.0, 11.0, 97.0), (0.0, 0.4, 0.8)
"""Angles of the edge's normal to the x axis, and standard deviations of the Gaussian blur."""

FREQUENCIES = np.arange(1, 11) / 20.0
"""Frequencies of the table of MTFs, cycles per pixel."""

SIDE_PX, NOISE_SD, REPETITIONS = 64, 0.1, 12
"""Side of a frame with a triangle, standard deviation of a pixel's contrast, and trials of each orientation."""

RATIOS = (0.5, 0.7, 1.0, 1.4, 2.0)
"""Contrasts of the triangles, in thresholds."""


SETS: tuple[tuple[float, Centre], ...] = tuple(product((6.0, 16.0), ("centroid", "bounding_box")))
"""√(area) of the triangles in pixels, and the point of a triangle that lies at the middle."""


def edges(folder: Path) -> int:
    """Make pictures of slanted edges, 16-bit PNG, and `truths.csv` with their MTF; return the number of pictures.
    Values are proportional to light. Pixels are squares that average light; light is a step that a Gaussian blurs.
    """
    folder.mkdir()
    rows: list[list[object]] = [["file", "angle_deg", "sigma_px", "mtf50", *(f"mtf_{f:g}" for f in FREQUENCIES)]]
    for angle_deg, sigma_px in product(ANGLES_DEG, SIGMAS_PX):
        name = f"edge_{angle_deg:g}deg_{sigma_px:g}px.png"
        picture = DARK + (BRIGHT - DARK) * edge_picture(angle_deg, sigma_px)
        write_frame(folder / name, picture, pixel_type="uint16")
        grid = np.linspace(0.0, 1.0, 100_001)
        mtf50 = np.interp(-0.5, -edge_mtf(grid, angle_deg, sigma_px), grid)
        values = [f"{value:.6f}" for value in (mtf50, *edge_mtf(FREQUENCIES, angle_deg, sigma_px))]
        rows.append([name, angle_deg, sigma_px, *values])
    (folder / "truths.csv").write_text(csv_text(rows), encoding="utf-8")
    return len(rows) - 1


def edge_mtf(frequency: FloatArray, angle_deg: float, sigma_px: float) -> FloatArray:
    """Return the MTF across an edge, at frequencies in cycles per pixel: square pixels and a Gaussian blur."""
    across, along = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    gaussian = np.exp(-2.0 * (np.pi * sigma_px * frequency) ** 2)
    return np.asarray(np.abs(np.sinc(frequency * across) * np.sinc(frequency * along)) * gaussian)


def edge_picture(angle_deg: float, sigma_px: float) -> FloatArray:
    """Return the mean of a blurred step from 0 to 1 over each pixel, (EDGE_SIDE_PX, EDGE_SIDE_PX). The step's
    integral over a square is the second difference of its second antiderivative Q: with distances d from the edge
    to the middles of pixels, and half steps a, b of d along a pixel's sides, it is [Q(d+a+b) − Q(d+a−b) − Q(d−a+b)
    + Q(d−a−b)] / (4ab).
    """
    from scipy.special import ndtr

    def second_antiderivative(distance: FloatArray) -> FloatArray:
        if sigma_px == 0.0:
            return np.asarray(np.maximum(distance, 0.0) ** 2 / 2.0)
        u = distance / sigma_px
        density = np.exp(-(u**2) / 2.0) / np.sqrt(2.0 * np.pi)
        return np.asarray(sigma_px**2 * ((u**2 + 1.0) * ndtr(u) + u * density) / 2.0)

    cosine, sine = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    y, x = np.mgrid[:EDGE_SIDE_PX, :EDGE_SIDE_PX] - (EDGE_SIDE_PX - 1) / 2.0
    distance, a, b = cosine * x + sine * y, cosine / 2.0, sine / 2.0
    total = sum(s * t * second_antiderivative(distance + s * a + t * b) for s, t in product((1, -1), repeat=2))
    return np.asarray(total / (4.0 * a * b))


def triangles(folder: Path) -> int:
    """Make sets of triangles in white Gaussian noise, a dataset each, and `truths.csv` with their thresholds.
    Return the number of frames. The threshold is that of the ideal observer, which knows size and place: the
    contrast at which it is right in 75 % of many trials.
    """
    folder.mkdir()
    rng = np.random.default_rng(75)
    rows: list[list[object]] = [["dataset", "size_px", "centre", "noise_sd", "threshold_contrast"]]
    n_frames = 0
    middle_px = (SIDE_PX - 1) / 2.0
    for size_px, centre in SETS:
        shape: dict[str, Any] = {"size_px": size_px, "x_px": middle_px, "y_px": middle_px, "centre": centre}
        templates = np.array([coverage((SIDE_PX, SIDE_PX), orientation=one, **shape) for one in ORIENTATIONS])
        threshold = ideal_threshold(templates)
        name = f"{centre}_{size_px:g}px"
        rows.append([name, size_px, centre, NOISE_SD, f"{threshold:.6g}"])
        n_frames += _write_set(folder / name, size_px, centre, templates, threshold, rng)
    (folder / "truths.csv").write_text(csv_text(rows), encoding="utf-8")
    return n_frames


def ideal_threshold(templates: FloatArray) -> float:
    """Return the contrast at which the ideal observer is right in 75 % of trials in noise of `NOISE_SD`. The
    templates are (4, rows, columns). White noise has a covariance of their inner products; the likelihood of each
    is its score minus half its energy, which is the same for all four.
    """
    from scipy.optimize import brentq

    factor = templates.reshape(4, -1) / NOISE_SD
    factor = factor - factor.mean(axis=0)

    def excess(contrast: float) -> float:
        scores = contrast * factor @ factor.T
        return float(np.mean(np.diag(answer_probabilities(scores, factor=factor)))) - 0.75

    return float(brentq(excess, 1e-6, 100.0, xtol=1e-12))


def _write_set(
    folder: Path,
    size_px: float,
    centre: Centre,
    templates: FloatArray,
    threshold: float,
    rng: np.random.Generator,
) -> int:
    """Write a dataset of one set; return the number of frames. Code values are proportional to light."""
    (folder / "frames").mkdir(parents=True)
    display = Display(
        eotf="linear", white_luminance_cd_m2=100.0, pixel_pitch_mrad=0.5, background_luminance_cd_m2=50.0
    )
    rows = []
    contrasts = [float(f"{ratio * threshold:.4g}") for ratio in RATIOS]
    for contrast, which, repetition in product(contrasts, range(len(ORIENTATIONS)), range(REPETITIONS)):
        orientation = ORIENTATIONS[which].value
        name = f"frames/c{contrast}_{orientation}_{repetition}.png"
        seen = contrast * templates[which] + rng.normal(0.0, NOISE_SD, templates[which].shape)
        write_frame(folder / name, 0.5 * (1.0 + seen), pixel_type="uint16")
        size_mrad = size_px * display.pitch_mrad
        rows.append({"frame": name, "orientation": orientation, "size_mrad": size_mrad, "contrast": contrast})
    return write_dataset_files(
        folder,
        rows,
        display=table_of_display(display, folder),
        experiment=Experiment(level="contrast", group_by=("size_mrad",)),
        comment=f"Triangles by their {centre} in white noise; ideal threshold: ../truths.csv. CC0",
    )
