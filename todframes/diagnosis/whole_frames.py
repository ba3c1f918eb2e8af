"""The search of whole frames for triangles, by the differences between the orientations."""

from __future__ import annotations

import math
from collections import Counter
from typing import NamedTuple

import numpy as np

from todframes.base._typing import ComplexArray, FloatArray
from todframes.base.errors import FrameError
from todframes.diagnosis.triangle import TURNED
from todframes.frames.contrast import ContrastPatch, read_contrast
from todframes.frames.dataset import Dataset
from todframes.frames.surround import block_sums
from todframes.frames.trials import FrameReference, Trial
from todframes.stimulus import ORIENTATIONS, Centre, Orientation, Stimulus, coverage

MOST_BLOCKS = 2**24
"""Largest number of blocks of a frame; more would fill the memory."""

Spectra = dict[int, ComplexArray]
"""Spectra of images by orientation, an index into `ORIENTATIONS`."""


class MeanFrames:
    """Mean contrast of a group's frames by stimulus and orientation; all frames must have one size."""

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset
        self.shape: tuple[int, ...] | None = None
        self.block_px = 1
        self.totals: dict[tuple[Stimulus, Orientation], FloatArray] = {}
        self.counts: Counter[tuple[Stimulus, Orientation]] = Counter()

    def add(self, trial: Trial) -> None:
        """Add all frames of a trial; if one cannot be read, add none."""
        contrasts = [self._contrast(frame, trial.stimulus) for frame in trial.frames]
        key = (trial.stimulus, trial.orientation)
        total = self.totals.setdefault(key, np.zeros(contrasts[0].shape))
        for contrast in contrasts:
            total += contrast
        self.counts[key] += len(contrasts)

    def of_trial(self, trial: Trial) -> FloatArray:
        """Return the mean contrast of a trial's frames, in blocks."""
        return np.asarray(sum(self._contrast(frame, trial.stimulus) for frame in trial.frames) / len(trial.frames))

    def mean(self) -> FloatArray:
        """Return the mean of all frames."""
        return np.asarray(sum(self.totals.values()) / self.counts.total())

    def take_spectra(self) -> dict[Stimulus, Spectra]:
        """Return the spectra of the mean frames of each stimulus without what its orientations share. A single
        orientation only loses its mean level. The totals no longer exist.
        """
        means: dict[Stimulus, dict[int, FloatArray]] = {}
        for (stimulus, orientation), total in self.totals.items():
            total /= self.counts[stimulus, orientation]
            means.setdefault(stimulus, {})[orientation.quarter_turns] = total
        self.totals, spectra = {}, {}
        for stimulus, images in means.items():
            each = list(images.values())
            common = np.mean(each, axis=0) if len(each) > 1 else each[0].mean()
            spectra[stimulus] = {turn: np.fft.rfft2(image - common) for turn, image in images.items()}
        return spectra

    def in_pixels(self, place: tuple[float, float]) -> tuple[float, float]:
        """Return a position in pixels from one in blocks, which counts from the middle of the first block."""
        x_px, y_px = (float(self.block_px * at + (self.block_px - 1) / 2.0) for at in place)
        return x_px, y_px

    def _contrast(self, frame: FrameReference, stimulus: Stimulus) -> FloatArray:
        path = self.dataset.frame_path(frame)
        with self.dataset.open(frame, verify=True) as file:
            patch = read_contrast(file, self.dataset.display, frame)
            header = file.header
        shape = patch.values.shape[:2]
        if (patch.row, patch.column, *shape) != (0, 0, header.height, header.width):
            raise FrameError(path, "has no pixels in part of the frame; its triangle cannot be located")
        if self.shape is None:
            self.shape = shape
            size_px = stimulus.size_mrad / self.dataset.display.pitch_mrad
            self.block_px = _block_px(shape, size_px)
            if shape[0] * shape[1] / self.block_px**2 > MOST_BLOCKS:
                raise FrameError(
                    path,
                    f"{_size(shape)} pixels are too many to find a triangle of {size_px:.3g} pixels among them, "
                    f"expected at most {MOST_BLOCKS / 1e6:.1f} million; give x_px and y_px in the manifest",
                )
        if self.shape != shape:
            found, expected = _size(shape), _size(self.shape)
            raise FrameError(path, f"found {found} pixels, expected {expected} as in the group's other frames")
        return block_means(patch, self.block_px)


def _block_px(shape: tuple[int, ...], size_px: float) -> int:
    """Return the side of the blocks that a frame is searched in, in pixels: 1 up to 2²¹ pixels."""
    n_px = shape[0] * shape[1]
    wanted = 1 if n_px <= 2**21 else math.ceil(math.sqrt(n_px / 2**19))
    # Blocks of more than a sixteenth of the triangle's size would blur its edges.
    return max(min(wanted, int(min(size_px, 1e9) / 16)), 1)


def block_means(patch: ContrastPatch, block_px: int) -> FloatArray:
    """Average the contrast of a whole frame over square blocks; incomplete blocks are dropped."""
    if block_px == 1 and patch.to_contrast is None:
        return patch.values
    rows, columns = patch.values.shape[:2]
    sums = np.zeros((-(-rows // block_px), -(-columns // block_px)))
    for band in patch.bands():
        of_band, (first, _) = block_sums(band.values, band.row, 0, block_px)
        sums[first : first + len(of_band)] += of_band
    return np.asarray(sums[: rows // block_px, : columns // block_px] / block_px**2)


def _size(shape: tuple[int, ...]) -> str:
    """Return the text "columns × rows"."""
    return f"{shape[1]} × {shape[0]}"


class CorrelationPeak(NamedTuple):
    """The highest correlation on whole blocks: its position, and its height above the median of the correlation.
    `spread` is the standard deviation of the correlation over the frame. The
    height is -inf if the frames are smaller than the triangles.
    """

    x: int
    y: int
    height: float
    spread: float


def search(frames: MeanFrames, centre: Centre) -> CorrelationPeak:
    """Find the highest correlation of triangles with mean frames, over places, arrangements and polarities.
    The mean over the orientations is subtracted from frames and triangles alike. It contains everything that the
    orientations share: bezel, overlay, shading, fixed pattern.
    """
    assert frames.shape is not None
    rows, columns = (length // frames.block_px for length in frames.shape)
    spectra, pitch_mrad = frames.take_spectra(), frames.block_px * frames.dataset.display.pitch_mrad
    shape = (rows, columns)
    largest_px = max(stimulus.size_mrad for stimulus in spectra) / pitch_mrad
    # The centroid is at least a third of the height, 0.439 sizes, away from each edge of the triangle.
    edge = max(int(np.ceil(0.4386 * largest_px - 0.5)), 0)
    best = CorrelationPeak(0, 0, -math.inf, 0.0)
    if 2 * edge >= min(rows, columns):
        return best
    triangles = {
        stimulus: _triangles(stimulus, shape, 1.0 / pitch_mrad, centre, is_single=len(images) == 1)
        for stimulus, images in spectra.items()
    }
    for arrangement in TURNED:
        crossed = [_cross(spectra[key], *triangles[key], arrangement.shown) for key in spectra]
        total = np.asarray(sum(crossed))
        correlation = np.fft.fftshift(np.fft.irfft2(total, shape))[edge : rows - edge, edge : columns - edge]
        median = float(np.median(correlation))
        spread = best.spread or 1.4826 * float(np.median(np.abs(correlation - median)))
        row, column = np.unravel_index(np.abs(correlation).argmax(), correlation.shape)
        height = abs(float(correlation[row, column]) - median)
        if height > best.height:
            best = CorrelationPeak(int(column) + edge, int(row) + edge, height, spread)
    return best


def _triangles(
    stimulus: Stimulus, shape: tuple[int, int], px_per_mrad: float, centre: Centre, *, is_single: bool
) -> tuple[list[ComplexArray], FloatArray]:
    """Return conjugate spectra of triangles in the middle of the frame, and their inner products, (4, 4)."""
    at = {"size_px": px_per_mrad * stimulus.size_mrad, "x_px": shape[1] // 2, "y_px": shape[0] // 2}
    triangles = np.array(
        [
            stimulus.polarity * coverage(shape, **at, orientation=orientation, centre=centre)
            for orientation in ORIENTATIONS
        ]
    ).reshape(4, -1)
    products = triangles @ triangles.T
    if is_single:
        totals = triangles.sum(axis=1)
        products = products - np.outer(totals, totals) / triangles.shape[1]
    return [np.conj(np.fft.rfft2(triangle.reshape(shape))) for triangle in triangles], products


def _cross(
    images: Spectra, triangles: list[ComplexArray], products: FloatArray, shown: tuple[int, ...]
) -> ComplexArray:
    """Return the spectrum of the correlation with unit-energy triangle differences in an arrangement."""
    turns = [shown[turn] for turn in images]
    products = products[np.ix_(turns, turns)]
    energy = float(np.trace(products) - (products.sum() / len(turns) if len(turns) > 1 else 0.0))
    # The images add up to zero, so the mean of the triangles needs no subtraction.
    total = sum(image * triangles[k] for image, k in zip(images.values(), turns, strict=True))
    # Within one pixel all orientations are alike: only rounding is left of their differences.
    return np.asarray(total / math.sqrt(energy) if energy > 1e-9 * np.trace(products) else 0.0 * total)
