"""Windows of frames about their triangles: contrast in blocks of pixels, noise, background and code values."""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, FrameError
from todframes.display.display import Display
from todframes.frames.contrast import LuminanceFound, centroid_position, declared_background
from todframes.frames.dataset import Dataset
from todframes.frames.ends import CutShares, ValueEnds
from todframes.frames.files import FULL_SCALE, FrameSource, code_values
from todframes.frames.surround import (
    Range,
    Surface,
    SurroundSums,
    TrianglePlace,
    Window,
    block_sums,
    hole_radius_px,
    surround_window,
)
from todframes.frames.trials import FrameReference, Trial
from todframes.stimulus import Centre

LEAST_NOISE = 5e-4
"""Least noise relative to the background that is more than the rounding of half-precision values."""


class TrialSample(NamedTuple):
    """Measurements of a trial: contrast is the mean over its frames, all else is that of its first. `known` marks
    the blocks, (n, n), of which the frame has at least half of the pixels. `seen` and `even` are their contrasts
    against the background that the dataset declares, and against the surface fitted around the triangle (level
    with `reach_px`); 0 beyond the frame. `stated_px` is the stated centroid (x, y), `offset` its distance from the
    middle of the blocks, in blocks. `ring_cd_m2` is the luminance around the triangle, and `noise` the standard
    deviation of a pixel's contrast, from neighbouring blocks of the surround.
    """

    trial: Trial
    known: NDArray[np.bool_]
    seen: FloatArray
    even: FloatArray
    stated_px: tuple[float, float]
    offset: tuple[float, float]
    block_px: int
    frame_px: tuple[int, int]
    background_cd_m2: float
    ring_cd_m2: float
    noise: float
    codes: Codes | None
    cut: CutShares


class Codes(NamedTuple):
    """Integer code values about the triangle. `peak` is the largest code read, `step` the smallest difference of
    codes that occur (0 if there is but one code), and `step_contrast` its contrast; `bit_contrast` is that of
    neighbouring codes. `is_flat` states whether the background has a single code.
    """

    full_scale: int
    peak: int
    step: int
    step_contrast: float
    bit_contrast: float
    is_flat: bool


def measure_trial(
    dataset: Dataset,
    trial: Trial,
    centre: Centre,
    *,
    size_px: float,
    reach_px: float = 0.0,
    middle_px: tuple[float, float] | None = None,
) -> TrialSample:
    """Measure the frames of a trial about its stated place. The window and its blocks are made for `size_px`, that
    of the trial or one for several alike; it reaches as far as `reach_px` at least. It is cut about `middle_px`,
    so that windows of several trials show the same pixels; by default about the stated place. Raises FrameError or
    DataError if a frame cannot be read, or has no background.
    """
    # Frames of a triangle that moves cannot be averaged: its place on the pixels differs.
    n_alike = 1 if any(frame.motion_px is not None for frame in trial.frames) else len(trial.frames)
    frames = [
        _measured(dataset, trial, frame, centre, size_px, reach_px, middle_px) for frame in trial.frames[:n_alike]
    ]
    if n_alike == 1:
        return frames[0]
    return frames[0]._replace(
        known=np.logical_and.reduce([sample.known for sample in frames]),
        seen=np.mean([sample.seen for sample in frames], axis=0),
        even=np.mean([sample.even for sample in frames], axis=0),
    )


def _measured(
    dataset: Dataset,
    trial: Trial,
    frame: FrameReference,
    centre: Centre,
    size_px: float,
    reach_px: float,
    middle_px: tuple[float, float] | None,
) -> TrialSample:
    rule = dataset.display.background_luminance_cd_m2
    with dataset.open(frame) as file:
        header = file.header
        x, y = centroid_position(trial, header, centre, dataset.display.pitch_mrad, frame)
        sums = _WindowSums(file, dataset.display, TrianglePlace(x, y, size_px), reach_px, middle_px)
    means, known = sums.blocks.means()
    rows_columns = sums.blocks.middles()
    surface: Surface | None = None
    with suppress(DataError):
        surface = sums.surround.surface()
    even_cd_m2: float | FloatArray
    if surface is None:
        even_cd_m2 = ring = float(np.median(means[known]))
        noise = 0.0
    else:
        ring = surface.middle_cd_m2
        even_cd_m2 = ring if reach_px else surface.luminance_at(*rows_columns)
        noise = surface.noise_cd_m2 * sums.surround.block_px / ring
    background = ring if rule == "surround" else declared_background(rule, sums.luminance, frame)
    if not (background > 0.0 and ring > 0.0):
        found = f"background luminance around the triangle is {min(background, ring):g} cd/m²"
        raise FrameError(file.path, f"{found}, expected > 0")
    with np.errstate(divide="ignore", invalid="ignore"):
        even = np.where(known & (np.asarray(even_cd_m2) > 0.0), means / even_cd_m2 - 1.0, 0.0)
    seen = np.where(known, means / background - 1.0, 0.0)
    if surface is not None and not reach_px:
        even[~surface.has(*rows_columns)] = 0.0
        if rule == "surround":
            seen = even
    return TrialSample(
        trial=trial,
        known=known,
        seen=seen,
        even=even,
        stated_px=(x, y),
        offset=sums.blocks.offset,
        block_px=sums.blocks.block_px,
        frame_px=(header.height, header.width),
        background_cd_m2=background,
        ring_cd_m2=ring,
        noise=noise,
        codes=sums.codes.found(dataset, ring) if header.pixel_type in FULL_SCALE else None,
        cut=_cut(dataset.display, sums, noise * ring),
    )


def _cut(display: Display, sums: _WindowSums, noise_cd_m2: float) -> CutShares:
    """Return the shares of the triangle's pixels that are cut off, given the noise of a pixel. Floating-point
    values of 0 and less are no end: light may be 0.
    """
    ends, middle = sums.ends, sums.middle
    if not ends.n:
        return CutShares(0.0, 0.0, "")
    values = code_values(np.array([max(middle - ends.step, 0.0), middle]).astype(sums.stored_type))
    low, high = display.luminance(values.reshape(2, 1, 1)).ravel().tolist()
    is_noisy = high > low and noise_cd_m2 > LEAST_NOISE * high
    cut = ends.cut(noise_cd_m2 / (high - low) * ends.step if is_noisy else 0.0)
    return cut._replace(bottom=0.0) if ends.floor is None and ends.lowest <= 0.0 else cut


class _WindowSums:
    """Sums over the pixels about a triangle, by bands, and over the whole frame if the background rule asks."""

    def __init__(
        self,
        file: FrameSource,
        display: Display,
        triangle: TrianglePlace,
        reach_px: float,
        middle_px: tuple[float, float] | None,
    ) -> None:
        header, rule = file.header, display.background_luminance_cd_m2
        all_rows, all_columns = file.clip(None, None)
        window = surround_window(triangle, rows=all_rows, columns=all_columns)
        read = Window(*(
            (max(min(first, round(at - reach_px)), low), min(max(stop, round(at + reach_px) + 1), high))
            for (first, stop), at, (low, high) in zip(
                window, (triangle.y_px, triangle.x_px), (all_rows, all_columns), strict=True
            )
        ))  # fmt: skip
        if triangle.size_px > 2 * max(header.height, header.width) or min(b - a for a, b in window) < 1:
            at = f"found the triangle at x_px {triangle.x_px:.4g}, y_px {triangle.y_px:.4g}"
            raise FrameError(file.path, f"{at}, expected it on the {header.width} × {header.height} pixels")
        self.blocks = _BlockMeans(triangle, reach_px, middle_px or (triangle.x_px, triangle.y_px))
        self.surround, self.luminance = SurroundSums(triangle, window), LuminanceFound()
        self.codes, full_scale = _CodeCounts(triangle), FULL_SCALE.get(header.pixel_type)
        self.ends = ValueEnds(*(() if full_scale is None else (0.0, full_scale)))
        self.middle, self.stored_type = 0.0, file.stored_type
        is_whole = rule in ("border", "frame_mean")
        for band in file.bands() if is_whole else file.bands(rows=read.rows, columns=read.columns):
            luminance = display.luminance(band.values)
            begin, end = band.first_row, band.first_row + len(luminance)
            self.luminance.average(luminance, rule, top=begin == all_rows[0], bottom=end == all_rows[1])
            self.surround.add(luminance, begin, band.first_column)
            self.blocks.add(luminance, begin, band.first_column, read)
            if header.pixel_type in FULL_SCALE:
                self.codes.add(band.stored, begin, band.first_column)
            if (inner := self.codes.inner_part(band.stored, begin, band.first_column)).size:
                self.middle = self.middle if self.ends.n else float(np.median(inner))
                self.ends.add(inner)


class _BlockMeans:
    """The means of square blocks about a triangle, by bands; their number depends on its size alone."""

    def __init__(self, triangle: TrianglePlace, reach_px: float, middle_px: tuple[float, float]) -> None:
        self.block_px = block_px = max(int(triangle.size_px / 8), 1)  # eight along the triangle's size, or fewer
        reach = max(3.0 * triangle.size_px, hole_radius_px(triangle.size_px) + 8.0, reach_px)
        self.n = 2 * math.ceil(reach / block_px) + 1
        length = self.n * block_px
        self.first = tuple(round(at) - length // 2 for at in reversed(middle_px))
        middle_y, middle_x = (first + (length - 1) / 2.0 for first in self.first)
        self.offset = (triangle.x_px - middle_x) / block_px, (triangle.y_px - middle_y) / block_px
        self.sums, self.counts = np.zeros((2, self.n, self.n))

    def add(self, luminance: FloatArray, row: int, column: int, window: Window) -> None:
        """Add the part of a rectangle of luminance, its first pixel at (row, column), that lies in the window."""
        stop = self.n * self.block_px
        rows, columns = (
            (max(first, start, low), min(first + stop, start + length, high))
            for first, start, length, (low, high) in zip(
                self.first, (row, column), luminance.shape, window, strict=True
            )
        )
        if rows[0] >= rows[1] or columns[0] >= columns[1]:
            return
        part = luminance[rows[0] - row : rows[1] - row, columns[0] - column : columns[1] - column]
        top, left = rows[0] - self.first[0], columns[0] - self.first[1]
        sums, at = block_sums(part, top, left, self.block_px)
        n_rows, n_columns = sums.shape
        here = slice(at[0], at[0] + n_rows), slice(at[1], at[1] + n_columns)
        self.sums[here] += sums
        lengths = (
            np.bincount((first + np.arange(length)) // self.block_px - start)
            for first, length, start in zip((top, left), part.shape, at, strict=True)
        )
        self.counts[here] += np.multiply.outer(*lengths)

    def means(self) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the means, and which blocks have at least half of their pixels."""
        return self.sums / np.maximum(self.counts, 1), self.counts >= self.block_px**2 / 2.0

    def middles(self) -> tuple[FloatArray, FloatArray]:
        """Return the rows and columns of the middles of the blocks."""
        middles = np.asarray((np.arange(self.n) + 0.5) * self.block_px - 0.5)
        return self.first[0] + middles, self.first[1] + middles


class _CodeCounts:
    """Counts of integer code values: of the whole window, and of the square about the triangle."""

    def __init__(self, triangle: TrianglePlace) -> None:
        self.square: tuple[Range, ...] = tuple(
            (round(at - 0.9 * triangle.size_px), round(at + 0.9 * triangle.size_px) + 1)
            for at in (triangle.y_px, triangle.x_px)
        )
        self.counts: NDArray[np.intp] = np.zeros(0, np.intp)
        self.inner: NDArray[np.intp] = np.zeros(0, np.intp)

    def add(self, stored: NDArray[np.unsignedinteger], row: int, column: int) -> None:
        n_codes = np.iinfo(stored.dtype).max + 1
        if not self.counts.size:
            self.counts, self.inner = np.zeros((2, n_codes), np.intp)
        self.counts += np.bincount(stored.ravel(), minlength=n_codes)
        self.inner += np.bincount(self.inner_part(stored, row, column).ravel(), minlength=n_codes)

    def inner_part(self, stored: NDArray[Any], row: int, column: int) -> NDArray[Any]:
        """Return the part of a rectangle, its first pixel at (row, column), that lies in the square."""
        (top, bottom), (left, right) = self.square
        return stored[max(top - row, 0) : max(bottom - row, 0), max(left - column, 0) : max(right - column, 0)]

    def found(self, dataset: Dataset, ring_cd_m2: float) -> Codes:
        used = np.flatnonzero(self.counts)
        full_scale = len(self.counts) - 1
        step = int(np.diff(used).min()) if len(used) > 1 else 0
        middle = int(np.searchsorted(np.cumsum(self.counts), self.counts.sum() / 2.0))
        three = np.clip(np.array([middle, middle + step, middle + 1]), 0, full_scale) / full_scale
        low, *highs = dataset.display.luminance(three.astype(np.float32).reshape(3, 1, 1)).ravel().tolist()
        step_contrast, bit_contrast = ((high - low) / ring_cd_m2 for high in highs)
        is_flat = bool(np.count_nonzero(self.counts > self.inner) < 2)
        return Codes(full_scale, int(used[-1]), step, step_contrast, bit_contrast, is_flat)
