"""Windows of frames about their triangles: contrast in blocks of pixels, noise, background and code values."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, FrameError
from todframes.display.display import border_values
from todframes.frames.contrast import LuminanceFound
from todframes.frames.dataset import Dataset
from todframes.frames.files import FULL_SCALE
from todframes.frames.position import centroid_position
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

PICTURE_BLOCKS_PER_SIZE = 8
"""Number of square blocks along a triangle's size that its picture is reduced to; fewer if these are pixels."""

REACH_IN_SIZES = 3.0
"""Distance from the stated place that a window has, in sizes."""


class TrialSample(NamedTuple):
    """Measurements of a trial: contrast is the mean over its frames, all else is that of its first.

    Attributes
    ----------
    trial : Trial
    known : ndarray of bool, shape (n, n)
        Blocks of which the frame has at least half of the pixels.
    seen, even : ndarray, shape (n, n)
        Contrast of the blocks against the background that the dataset declares, and against the surface fitted
        around the triangle; 0 beyond the frame. With `reach_px`, that surface is level.
    stated_px : (float, float)
        Stated centroid (x, y) on the frame, in pixels.
    offset : (float, float)
        Stated centroid (x, y) from the middle of the blocks, in blocks.
    block_px : int
    frame_px : (int, int)
        Rows and columns of the frame.
    background_cd_m2, ring_cd_m2 : float
        Luminance that contrast refers to, and that around the triangle.
    noise : float
        Standard deviation of a pixel's contrast, from neighbouring blocks of the surround.
    codes : Codes or None
        None for floating-point frames.
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


class Codes(NamedTuple):
    """Integer code values about the triangle.

    `top_share` and `bottom_share` are the shares of the triangle's pixels at full scale and at 0; `peak` is the
    largest code read, `step` the smallest difference of codes that occur (0 if there is but one code), and
    `step_contrast` its contrast; `bit_contrast` is that of neighbouring codes. `is_flat` states whether the
    background has a single code.
    """

    full_scale: int
    top_share: float
    bottom_share: float
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
    """Measure the frames of a trial about its stated place.

    Parameters
    ----------
    dataset : Dataset
    trial : Trial
    centre : {"centroid", "bounding_box"}
    size_px : float
        The size that the window and its blocks are made for: that of the trial, or one for several alike.
    reach_px : float
        Least distance from the stated place that the window has.
    middle_px : (float, float), optional
        Place (x, y) about which the window is cut, so that windows of several trials show the same pixels.
        Default: the stated one.

    Raises
    ------
    FrameError, DataError
        If a frame cannot be read, or has no background.
    """
    # Frames of a triangle that moves cannot be averaged: its place on the pixels differs.
    n_alike = 1 if any(frame.motion_px is not None for frame in trial.frames) else len(trial.frames)
    first, *others = (
        _measured(dataset, trial, frame, centre, size_px, reach_px, middle_px) for frame in trial.frames[:n_alike]
    )
    if not others:
        return first
    frames = (first, *others)
    return first._replace(
        known=np.logical_and.reduce([one.known for one in frames]),
        seen=np.mean([one.seen for one in frames], axis=0),
        even=np.mean([one.even for one in frames], axis=0),
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
    display = dataset.display
    rule = display.background_luminance_cd_m2
    with dataset.open(frame) as file:
        header = file.header
        x, y = centroid_position(trial, header, centre, display.pitch_mrad, frame)
        triangle = TrianglePlace(x, y, size_px)
        all_rows, all_columns = file.clip(None, None)
        window = surround_window(triangle, rows=all_rows, columns=all_columns)
        read = Window(*(
            (max(min(first, round(at - reach_px)), low), min(max(stop, round(at + reach_px) + 1), high))
            for (first, stop), at, (low, high) in zip(window, (y, x), (all_rows, all_columns), strict=True)
        ))  # fmt: skip
        if triangle.size_px > 2 * max(header.height, header.width) or min(b - a for a, b in window) < 1:
            raise FrameError(file.path, "the triangle does not lie on the frame")
        whole = rule in ("border", "frame_mean")
        blocks = _BlockMeans.about(triangle, reach_px, middle_px or (x, y))
        surround, found, codes = SurroundSums(triangle, window), LuminanceFound(), _CodeCounts(triangle)
        stop_row = all_rows[1]
        for band in file.bands() if whole else file.bands(rows=read.rows, columns=read.columns):
            luminance = display.luminance(band.values)
            begin, end = band.first_row, band.first_row + len(luminance)
            if rule == "border":
                found.average(border_values(luminance, top=begin == all_rows[0], bottom=end == stop_row))
            elif rule == "frame_mean":
                found.average(luminance)
            surround.add(luminance, begin, band.first_column)
            blocks.add(luminance, begin, band.first_column, read)
            if header.pixel_type in FULL_SCALE:
                codes.add(band.stored, begin, band.first_column)
        surface: Surface | None
        try:
            surface = surround.surface()
        except DataError:
            surface = None
    means, known = blocks.means()
    at = blocks.places()
    even_cd_m2: float | FloatArray
    if surface is None:
        ring = float(np.median(means[known]))
        even_cd_m2, noise = ring, 0.0
    else:
        ring = surface.middle_cd_m2
        even_cd_m2 = ring if reach_px else surface.luminance_at(*at)
        noise = surface.noise_cd_m2 * surround.block_px / ring
    background = (
        frame.background_luminance_cd_m2
        if rule == "column"
        else ring if rule == "surround" else found.sum / found.n_averaged if isinstance(rule, str) else rule
    )  # fmt: skip
    assert background is not None
    if not (background > 0.0 and ring > 0.0):
        raise FrameError(file.path, "there is no background")
    with np.errstate(divide="ignore", invalid="ignore"):
        even = np.where(known & (np.asarray(even_cd_m2) > 0.0), means / even_cd_m2 - 1.0, 0.0)
    seen = np.where(known, means / background - 1.0, 0.0)
    if surface is not None and not reach_px:
        outside = ~surface.has(*at)
        even[outside] = 0.0
        if rule == "surround":
            seen = even
    return TrialSample(
        trial=trial,
        known=known,
        seen=seen,
        even=even,
        stated_px=(x, y),
        offset=blocks.offset,
        block_px=blocks.block_px,
        frame_px=(header.height, header.width),
        background_cd_m2=background,
        ring_cd_m2=ring,
        noise=noise,
        codes=codes.found(dataset, ring) if header.pixel_type in FULL_SCALE else None,
    )


class _BlockMeans:
    """The means of square blocks about a triangle, by bands; their number depends on its size alone."""

    def __init__(
        self, triangle: TrianglePlace, middle_px: tuple[float, float], block_px: int, n_blocks: int
    ) -> None:
        self.block_px, self.n = block_px, n_blocks
        length = n_blocks * block_px
        self.first = tuple(round(at) - length // 2 for at in reversed(middle_px))
        middle_y, middle_x = (first + (length - 1) / 2.0 for first in self.first)
        self.offset = (triangle.x_px - middle_x) / block_px, (triangle.y_px - middle_y) / block_px
        self.sums, self.counts = np.zeros((n_blocks, n_blocks)), np.zeros((n_blocks, n_blocks))

    @classmethod
    def about(cls, triangle: TrianglePlace, reach_px: float, middle_px: tuple[float, float]) -> _BlockMeans:
        block_px = max(int(triangle.size_px / PICTURE_BLOCKS_PER_SIZE), 1)
        reach = max(REACH_IN_SIZES * triangle.size_px, hole_radius_px(triangle.size_px) + 8.0, reach_px)
        return cls(triangle, middle_px, block_px, 2 * math.ceil(reach / block_px) + 1)

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

    def places(self) -> tuple[FloatArray, FloatArray]:
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
        (top, bottom), (left, right) = self.square
        part = stored[max(top - row, 0) : max(bottom - row, 0), max(left - column, 0) : max(right - column, 0)]
        self.inner += np.bincount(part.ravel(), minlength=n_codes)

    def found(self, dataset: Dataset, ring_cd_m2: float) -> Codes:
        used = np.flatnonzero(self.counts)
        full_scale = len(self.counts) - 1
        step = int(np.diff(used).min()) if len(used) > 1 else 0
        middle = int(np.searchsorted(np.cumsum(self.counts), self.counts.sum() / 2.0))
        three = np.clip(np.array([middle, middle + step, middle + 1]), 0, full_scale) / full_scale
        low, *highs = dataset.display.luminance(three.astype(np.float32).reshape(3, 1, 1)).ravel().tolist()
        bottom, *_, top = (self.inner / max(int(self.inner.sum()), 1)).tolist()
        step_contrast, bit_contrast = ((high - low) / ring_cd_m2 for high in highs)
        is_flat = bool(np.count_nonzero(self.counts > self.inner) < 2)
        return Codes(full_scale, top, bottom, int(used[-1]), step, step_contrast, bit_contrast, is_flat)
