"""Spectrum of what lies behind the triangles of a dataset: scenes and noise, as displayed.

An observer that prewhitens weighs frequencies by it. It is a mean of periodograms about the triangles: contrast
times a Hann window, in which a hole with a smooth edge leaves the triangle out.
"""

from __future__ import annotations

import math

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, FrameError
from todframes.frames.dataset import Dataset
from todframes.frames.position import size_in_px
from todframes.frames.trials import Trial, Trials
from todframes.observers.eye import MRAD_PER_DEG
from todframes.scoring.retina_view import patches_about
from todframes.stimulus import Centre


def background_spectrum(dataset: Dataset, trials: Trials, centre: Centre) -> tuple[tuple[float, float], ...]:
    """Measure the spectral density behind the triangles. Returns frequencies in cycles/degree, ascending, and the
    mean density over all directions, in squared contrast × squared degrees, as displayed: pixels are held over
    their area. `centre` is the point of the triangle that lies at the frame's centre where the manifest has no
    position. Raises DataError if no frame can be read, or frames end too near to the triangle.
    """
    weak = trials.select(trials.levels <= np.median(trials.levels))
    chosen = weak.select(np.unique(np.linspace(0, len(weak) - 1, 64).astype(np.intp)))
    sums: dict[int, FloatArray] = {}
    problem: FrameError | DataError | None = None
    for trial in chosen:
        try:
            frequency, density = _periodogram(dataset, trial, centre)
        except (FrameError, DataError) as error:  # scoring reports frames that cannot be read
            problem = problem or error
            continue
        bands = np.round(3 * np.log2(frequency)).astype(np.intp)  # a third of an octave
        for band in np.unique(bands).tolist():
            within = bands == band
            total = sums.setdefault(band, np.zeros(3))
            total += density[within].sum(), np.log(frequency[within]).sum(), np.count_nonzero(within)
    if not sums:
        raise problem or DataError(f"{dataset.path}: found no trial, expected some to measure the background in")
    floor = 1e-12 * max(total / n for total, _, n in sums.values())
    return tuple(
        (math.exp(ln_frequency / n), max(float(total / n), floor, 1e-300))
        for _, (total, ln_frequency, n) in sorted(sums.items())
    )


def _periodogram(dataset: Dataset, trial: Trial, centre: Centre) -> tuple[FloatArray, FloatArray]:
    """Compute radial frequencies in cycles/degree and the density at each, of the mean of a trial's frames. Those
    that the window does not resolve, and those beyond the Nyquist frequency of the axes, are left out.
    """
    images: list[FloatArray] = []
    for patch, x_px, y_px in patches_about(dataset, trial, centre, (256, 256)):
        images.append(np.concatenate([band.values for band in patch.bands()]))
        x, y = x_px - patch.column, y_px - patch.row
    contrast = np.asarray(sum(images) / len(images))
    pitch_deg = dataset.display.pitch_mrad / MRAD_PER_DEG
    height, width = contrast.shape
    across, down = np.arange(width), np.arange(height)
    window = np.outer(np.hanning(height + 2)[1:-1], np.hanning(width + 2)[1:-1])
    whole = float(np.square(window).sum())
    distance = np.hypot(across - x, down[:, None] - y) / size_in_px(trial, dataset.display.pitch_mrad)
    # The triangle's corners lie at 0.88 sizes.
    inner, outer = 1.3, 2.0
    window *= (1.0 - np.cos(np.pi * np.clip((distance - inner) / (outer - inner), 0.0, 1.0))) / 2.0
    weight = float(np.square(window).sum())
    if weight < 0.05 * whole:
        raise DataError(
            f"{trial.frames[0].path}: found {width} × {height} pixels, in which the triangle of "
            f"{trial.stimulus.size_mrad:g} mrad leaves no background to measure; expected "
            f"{math.ceil(2.5 * outer * size_in_px(trial, dataset.display.pitch_mrad))} or more along each side"
        )
    windowed = window * (contrast - (window * contrast).sum() / window.sum())
    # All signs of both frequencies: half a plane holds those of one axis twice as often as those of the other.
    density = np.abs(np.fft.fft2(windowed)) ** 2 * (pitch_deg**2 / weight)
    fx, fy = np.fft.fftfreq(width, pitch_deg), np.fft.fftfreq(height, pitch_deg)[:, None]
    density *= (np.sinc(fx * pitch_deg) * np.sinc(fy * pitch_deg)) ** 2  # pixels are held over their area
    frequency = np.hypot(fx, fy)
    resolved = 1.5 / (min(height, width) * pitch_deg)
    kept = (frequency >= resolved) & (frequency <= 0.5 / pitch_deg)
    return frequency[kept], density[kept]
