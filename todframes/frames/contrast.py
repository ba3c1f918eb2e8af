"""Conversion of frame files to Weber contrast, and the checks of their checksums and pixels."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, FrameError, of_frame
from todframes.display.display import BackgroundRule, Display, border_values, check_background, weber_contrast
from todframes.frames.dataset import Dataset, Skipped
from todframes.frames.files import BAND_VALUES, FrameFile, FrameSource, code_values
from todframes.frames.position import centroid_position, check_on_frame, size_in_px
from todframes.frames.surround import Surface, SurroundSums, TrianglePlace, surround_window
from todframes.frames.trials import FrameReference, Trial

MOST_HELD_PX = 2**20
"""Largest number of pixels of a patch that is held as contrast, which takes eight bytes a pixel."""


class ContrastPatch(NamedTuple):
    """A rectangle of a frame, held as contrast or as the stored values that contrast is computed from. `row` and
    `column` are the position of its first pixel in the frame. A large rectangle is held as stored, with one to
    four bytes a value instead of eight; `to_contrast` then converts a band of whole rows into contrast; its
    arguments are the values and the row and column of the first. `n_negative` counts the pixels read with a
    luminance below zero. `background_luminance_cd_m2` is the luminance that contrast refers to, at the triangle;
    None if the patch was made from contrast.
    """

    values: NDArray[Any]
    row: int
    column: int
    n_negative: int
    to_contrast: Callable[[NDArray[Any], int, int], FloatArray] | None = None
    background_luminance_cd_m2: float | None = None

    def bands(self) -> Iterator[ContrastPatch]:
        """Yield the patch in bands of rows, each as contrast."""
        if self.to_contrast is None:
            yield self
            return
        begin = self.row
        for values in row_bands(self.values):
            yield ContrastPatch(self.to_contrast(values, begin, self.column), begin, self.column, 0)
            begin += len(values)


def row_bands(values: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield an array in bands of rows, each of at most `BAND_VALUES` values or one row."""
    n_rows = max(BAND_VALUES // max(values[:1].size, 1), 1)
    for begin in range(0, len(values) if values.size else 0, n_rows):
        yield values[begin : begin + n_rows]


def skipped_frames(dataset: Dataset, trial: Trial, error: FrameError | str) -> list[Skipped]:
    """Return all frames of an unusable trial as skipped; a trial is averaged over all of its frames or none."""
    others = f"another frame of trial {trial.name} cannot be used"
    paths = [dataset.frame_path(frame) for frame in trial.frames]
    path_of_error = error.path if isinstance(error, FrameError) and error.path in paths else None
    return [
        Skipped(frame.path, str(error) if path_of_error in (None, path) else others)
        for frame, path in zip(trial.frames, paths, strict=True)
    ]


def read_contrast(
    file: FrameSource,
    display: Display,
    frame: FrameReference,
    rows: tuple[int, int] | None = None,
    columns: tuple[int, int] | None = None,
    *,
    triangle: TrianglePlace | None = None,
) -> ContrastPatch:
    """Read a rectangle of an open frame as contrast. Only the rows of the rectangle are decoded, unless the
    background is a mean over the frame. Pixels are decoded once, in bands of rows; only the pixels of the
    rectangle stay in memory. With the rule "surround" the rows about the triangle are decoded, and pixels beyond
    the background about it are left out; without a triangle that rule takes the mean over the frame. Raises
    FrameError if the pixels cannot be read, their contrast overflows, or the background is not a positive number.
    """
    rule = display.background_luminance_cd_m2
    (first_row, stop_row), all_columns = file.clip(None, None)
    surround = None
    if rule == "surround":
        if triangle is None:
            rule = "frame_mean"
        else:
            window = surround_window(triangle, rows=(first_row, stop_row), columns=all_columns)
            surround = SurroundSums(triangle, window)
            rows, columns = _shared(rows, window.rows), _shared(columns, window.columns)
    whole = rule in ("border", "frame_mean")
    (top, bottom), (left, right) = file.clip(rows, columns)
    decoded = (rows, columns) if surround is None else surround.window
    is_small = (bottom - top) * (right - left) <= MOST_HELD_PX
    kept: NDArray[Any] = (
        np.empty((bottom - top, right - left))
        if is_small
        else np.empty((bottom - top, right - left, len(file.header.channels)), file.stored_type)
    )
    seen = LuminanceFound()
    with of_frame(file.path):
        for band in file.bands() if whole else file.bands(rows=decoded[0], columns=decoded[1]):
            luminance = display.luminance(band.values)
            begin, end = band.first_row, band.first_row + len(luminance)
            seen.add(luminance)
            seen.average(luminance, rule, top=begin == first_row, bottom=end == stop_row)
            if surround is not None:
                surround.add(luminance, begin, band.first_column)
            if begin < bottom and end > top:
                part = (luminance if is_small else band.stored)[max(top - begin, 0) : bottom - begin]
                kept[max(begin - top, 0) : end - top] = part[:, left - band.first_column :][:, : right - left]
        background = surround.surface() if surround is not None else declared_background(rule, seen, frame)
        check_contrast(seen.largest, background)
    if is_small:
        contrast = displayed_contrast(kept, background, top, left)
        return ContrastPatch(contrast, top, left, seen.n_negative, None, luminance_at_triangle(background))
    to_contrast = partial(_contrast, display, background)
    return ContrastPatch(kept, top, left, seen.n_negative, to_contrast, luminance_at_triangle(background))


def check_pixels(file: FrameSource, display: Display, frame: FrameReference, triangle: TrianglePlace) -> None:
    """Decode and check every pixel of an open frame; errors are those of `read_contrast`. Luminance is computed
    only of the pixels that the background is taken from and of the extreme code values, which takes a fraction of
    the time of decoding.
    """
    rule = display.background_luminance_cd_m2
    (first_row, stop_row), all_columns = file.clip(None, None)
    window = surround_window(triangle, rows=(first_row, stop_row), columns=all_columns)
    surround, seen = SurroundSums(triangle, window), LuminanceFound()
    with of_frame(file.path):
        for band in file.bands():
            begin, end = band.first_row, band.first_row + len(band.stored)
            code = band.values
            seen.add(display.luminance(np.stack([code.min(axis=(0, 1)), code.max(axis=(0, 1))])[:, None]))
            if rule == "border":
                ring = border_values(code, top=begin == first_row, bottom=end == stop_row)
                seen.average(display.luminance(ring[None]), "frame_mean")  # of nothing but the ring
            elif rule == "frame_mean":
                seen.average(display.luminance(code), rule)
            elif rule == "surround":
                rows = _shared((begin, end), window.rows)
                left, right = (at - band.first_column for at in window.columns)
                part = code[rows[0] - begin : rows[1] - begin, left:right]
                surround.add(display.luminance(part), rows[0], window.columns[0])
        check_contrast(
            seen.largest, surround.surface() if rule == "surround" else declared_background(rule, seen, frame)
        )


class LuminanceFound:
    """Statistics of the luminance of a frame, collected band by band."""

    def __init__(self) -> None:
        self.n_negative = self.n_averaged = 0
        self.largest = self.sum = 0.0

    def add(self, luminance: FloatArray) -> None:
        """Update the largest luminance and the count of negative ones with a band."""
        lowest = float(luminance.min())
        self.largest = max(self.largest, -lowest, float(luminance.max()))
        self.n_negative += int(np.count_nonzero(luminance < 0.0)) if lowest < 0.0 else 0

    def average(
        self, luminance: FloatArray, rule: float | BackgroundRule, *, top: bool = True, bottom: bool = True
    ) -> None:
        """Add a band to the mean that is the background by the rules "border" and "frame_mean". `top` and `bottom`
        state whether it has the first and the last row of the frame.
        """
        if rule in ("border", "frame_mean"):
            averaged = border_values(luminance, top=top, bottom=bottom) if rule == "border" else luminance
            self.sum += float(averaged.sum())
            self.n_averaged += averaged.size


def declared_background(rule: float | BackgroundRule, seen: LuminanceFound, frame: FrameReference) -> float:
    """Return the luminance of the background by any rule but "surround"."""
    if rule == "column":
        assert frame.background_luminance_cd_m2 is not None  # the manifest was checked for it
        return frame.background_luminance_cd_m2
    return seen.sum / seen.n_averaged if isinstance(rule, str) else rule


Background = float | Surface
"""A background: its luminance in cd/m², or a surface fitted around the triangle."""


def _shared(wanted: tuple[int, int] | None, window: tuple[int, int]) -> tuple[int, int]:
    """Return the part of a half-open range, None for all, that lies in another."""
    if wanted is None:
        return window
    begin = max(wanted[0], window[0])
    return begin, max(min(wanted[1], window[1]), begin)


def _contrast(display: Display, background: Background, stored: NDArray[Any], row: int, column: int) -> FloatArray:
    """Compute the contrast of pixels as stored, the first of them at (row, column)."""
    return displayed_contrast(display.luminance(code_values(stored)), background, row, column)


def displayed_contrast(luminance: FloatArray, background: Background, row: int, column: int) -> FloatArray:
    """Compute the Weber contrast of a rectangle of luminance, its first pixel at (row, column)."""
    if isinstance(background, Surface):
        return background.contrast(luminance, row, column)
    return weber_contrast(luminance, background)


def luminance_at_triangle(background: Background) -> float:
    """Return the background's luminance in cd/m²; of a surface, that at the triangle's centroid."""
    return background.middle_cd_m2 if isinstance(background, Surface) else background


def check_contrast(largest_luminance_cd_m2: float, background: Background) -> None:
    """Raise DataError if Weber contrast overflows, or the background is not a positive number."""
    middle = luminance_at_triangle(background)
    check_background(middle)
    if largest_luminance_cd_m2 > sys.float_info.max * min(middle, 1.0):
        raise DataError("the contrast is beyond all numbers; expected luminances nearer to the background's")


def unjudged_problems(dataset: Dataset, frame: FrameReference) -> Iterator[FrameError]:
    """Yield an error if a frame that is in no trial cannot be read; every pixel of it is checked."""
    try:
        with dataset.open(frame, verify=True) as file:
            deque(file.bands(), 0)
    except FrameError as error:
        yield error


def frame_problems(dataset: Dataset, trial: Trial) -> Iterator[FrameError]:
    """Yield an error for each frame of a trial that cannot be used; every pixel of every frame is checked."""
    for frame in trial.frames:
        path = dataset.frame_path(frame)
        try:
            with dataset.open(frame, verify=True) as file:
                pitch_mrad = dataset.display.pitch_mrad
                x, y = centroid_position(trial, file.header, "centroid", pitch_mrad, frame)
                check_on_frame(path, trial, file.header, x, y, pitch_mrad)
                triangle = TrianglePlace(x, y, size_in_px(trial, pitch_mrad))
                check_pixels(file, dataset.display, frame, triangle)
            if (reference := dataset.reference_path(frame)) is not None:
                with FrameFile(reference, max_frame_mb=dataset.max_frame_mb) as other:
                    deque(other.bands(), 0)
        except FrameError as error:
            yield error
