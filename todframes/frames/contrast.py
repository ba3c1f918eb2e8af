"""Frames as Weber contrast: where a triangle lies on a frame, its background, and the checks of pixels."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, FrameError, of_frame
from todframes.display.display import BackgroundRule, Display, border_values, check_background, weber_contrast
from todframes.frames.dataset import Dataset, Skipped
from todframes.frames.files import BAND_VALUES, Frame, FrameFile, FrameHeader, FrameSource, Range, code_values
from todframes.frames.surround import Surface, SurroundSums, TrianglePlace, Window, surround_window
from todframes.frames.trials import FrameReference, Trial, Trials
from todframes.stimulus import Centre, Orientation, bounding_box_offset, vertices


def centroid_position(
    trial: Trial, header: FrameHeader, centre: Centre, pixel_pitch_mrad: float, frame: FrameReference | None = None
) -> tuple[float, float]:
    """Return the position (x, y) of the triangle's centroid in pixels: in a frame, or its mean in the trial. It is
    the position in the manifest. If there is none, the triangle's `centre` lies at the frame's centre.
    """
    if trial.x_px is not None and trial.y_px is not None:
        right, down = frame.motion_px if frame is not None and frame.motion_px is not None else (0.0, 0.0)
        return trial.x_px + right, trial.y_px + down
    return to_centroid(trial, (header.width - 1) / 2.0, (header.height - 1) / 2.0, centre, pixel_pitch_mrad)


def to_centroid(
    trial: Trial, x_px: float, y_px: float, centre: Centre, pixel_pitch_mrad: float
) -> tuple[float, float]:
    """Return the centroid (x, y) in pixels of a trial's triangle whose `centre` lies at (x_px, y_px)."""
    dx, dy = from_centroid(trial, centre, pixel_pitch_mrad)
    return x_px - dx, y_px - dy


def triangle_place(
    trial: Trial, frame: FrameReference, file: FrameSource, centre: Centre, pixel_pitch_mrad: float
) -> TrianglePlace:
    """Return the place of the triangle on an open frame; raise FrameError if it does not lie on it."""
    x, y = centroid_position(trial, file.header, centre, pixel_pitch_mrad, frame)
    check_on_frame(file.path, trial, file.header, x, y, pixel_pitch_mrad)
    return TrianglePlace(x, y, size_in_px(trial, pixel_pitch_mrad))


def check_places(dataset: Dataset, trials: Trials, centre: Centre) -> None:
    """Raise FrameError if a file is missing or a triangle does not lie on its frame. Only one header is read for
    each stimulus, that of its first frame.
    """
    for frame in chain(trials.warm_up, trials.frames):
        if not dataset.has_frame(frame):
            raise FrameError(dataset.frame_path(frame), "cannot be opened: No such file or directory")
    for first in sorted(int(rows[0]) for _, rows in trials.by_stimulus()):
        check_place(dataset, trials[first], centre)


def check_place(dataset: Dataset, trial: Trial, centre: Centre) -> None:
    """Raise FrameError if a trial's triangle does not lie on its first frame; only the header is read."""
    with dataset.open(trial.frames[0]) as file:
        triangle_place(trial, trial.frames[0], file, centre, dataset.display.pitch_mrad)


def from_centroid(trial: Trial, centre: Centre, pixel_pitch_mrad: float) -> tuple[float, float]:
    """Return the displacement, (dx, dy) in pixels, from the centroid of a trial's triangle to its `centre`."""
    if centre == "centroid":
        return 0.0, 0.0
    dx, dy = bounding_box_offset(trial.orientation)
    size_px = trial.stimulus.size_mrad / pixel_pitch_mrad
    return dx * size_px, dy * size_px


def size_in_px(trial: Trial, pixel_pitch_mrad: float) -> float:
    """Return the size of a trial's triangle in pixels; at most 1e300, so that its corners are finite."""
    return min(trial.stimulus.size_mrad / pixel_pitch_mrad, 1e300)


def check_on_frame(
    path: Path,
    trial: Trial,
    header: FrameHeader,
    x: float,
    y: float,
    pixel_pitch_mrad: float,
    *,
    what: str = "the triangle",
) -> None:
    """Raise FrameError if any part of a trial's triangle at (x, y) lies outside the pixels that the file has."""
    size_px = size_in_px(trial, pixel_pitch_mrad)
    left, top, right, bottom = _reach(size_px, trial.orientation)
    left, top, right, bottom = x + left, y + top, x + right, y + bottom
    first_x, first_y = header.first_column - 0.5, header.first_row - 0.5
    last_x, last_y = first_x + header.n_columns, first_y + header.n_rows
    if right - left > header.n_columns or bottom - top > header.n_rows:
        raise FrameError(
            path,
            f"the frame has {header.n_columns} × {header.n_rows} pixels, smaller than the triangle of "
            f"{trial.stimulus.size_mrad:g} mrad ({right - left:.6g} × {bottom - top:.6g} pixels)",
        )
    if left < first_x or right > last_x or top < first_y or bottom > last_y:
        raise FrameError(
            path,
            f"{what} reaches from ({left:.6g}, {top:.6g}) to ({right:.6g}, {bottom:.6g}) px, off the frame "
            f"({first_x:.1f}, {first_y:.1f}) to ({last_x:.1f}, {last_y:.1f}) px",
        )


@lru_cache(maxsize=64)
def _reach(size_px: float, orientation: Orientation) -> tuple[float, float, float, float]:
    """Return the extent of a triangle from its centroid in pixels: left, top, right and bottom."""
    corners = vertices(size=size_px, orientation=orientation)
    (left, top), (right, bottom) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
    return left, top, right, bottom


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

    def bands(self) -> Iterable[ContrastPatch]:
        """Return the patch in bands of rows, each as contrast."""
        return (self,) if self.to_contrast is None else self._converted(self.to_contrast)

    def _converted(self, to_contrast: Callable[[NDArray[Any], int, int], FloatArray]) -> Iterator[ContrastPatch]:
        begin = self.row
        for values in row_bands(self.values):
            yield ContrastPatch(to_contrast(values, begin, self.column), begin, self.column, 0)
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
    first_row, surround = file.header.first_row, None
    stop_row = first_row + file.header.n_rows
    if rule == "surround":
        if triangle is None:
            rule = "frame_mean"
        else:
            all_rows, all_columns = file.clip(None, None)
            window = surround_window(triangle, rows=all_rows, columns=all_columns)
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
    try:
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
    except FrameError:
        raise
    except DataError as error:
        raise FrameError(file.path, str(error)) from None
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
        try:
            with dataset.open(frame, verify=True) as file:
                triangle = triangle_place(trial, frame, file, "centroid", dataset.display.pitch_mrad)
                check_pixels(file, dataset.display, frame, triangle)
            if (reference := dataset.reference_path(frame)) is not None:
                with FrameFile(reference, max_frame_mb=dataset.max_frame_mb) as other:
                    deque(other.bands(), 0)
        except FrameError as error:
            yield error


MOST_HELD_MB = 64
"""Largest memory for the pixels of all frames of a dataset that are held, in 2**20 bytes."""


@dataclass(frozen=True, slots=True)
class HoldingDataset(Dataset):
    """A dataset that decodes some of its frames once, for use in one process. `held` has these frames by their
    paths: the trial until pixels are decoded, the frame with these from then on. `centre` is as in
    `centroid_position`.
    """

    held: dict[str, Trial | HeldFrame]
    centre: Centre

    @classmethod
    def of(cls, dataset: Dataset, trials: Iterable[Trial], centre: Centre) -> Dataset:
        """Return a dataset that holds the frames of some trials; the dataset itself if it is in memory."""
        if dataset.is_in_memory:
            return dataset
        values = {part.name: getattr(dataset, part.name) for part in fields(Dataset)}
        held: dict[str, Trial | HeldFrame] = {frame.path: trial for trial in trials for frame in trial.frames}
        return cls(**values, held=held, centre=centre)

    def open(self, frame: FrameReference, *, verify: bool = False) -> FrameSource:
        """Open a frame; raise FrameError if it cannot be used."""
        held = self.held.get(frame.path)
        if isinstance(held, HeldFrame):
            return held
        # Dataclasses with slots have no zero-argument super() in Python 3.11.
        file = Dataset.open(self, frame, verify=verify)
        if held is None:
            return file
        x, y = centroid_position(held, file.header, self.centre, self.display.pitch_mrad, frame)
        triangle = TrianglePlace(x, y, size_in_px(held, self.display.pitch_mrad))
        rows, columns = file.clip(None, None)
        window = surround_window(triangle, rows=rows, columns=columns)
        return HeldFrame(self, frame, file, window)


class HeldFrame(FrameSource):
    """An open frame of a dataset, which keeps the pixels of the first rectangle that is asked for, and of a
    `window`. For other pixels it opens the file again.
    """

    def __init__(self, dataset: HoldingDataset, frame: FrameReference, file: FrameSource, window: Window) -> None:
        self.path, self.header = file.path, file.header
        self._dataset, self._frame, self._window = dataset, frame, window
        self._file: FrameSource | None = file
        self._kept: Frame | None = None

    def __exit__(self, *error: object) -> None:
        if self._file is not None:
            self._file.__exit__(*error)
        self._file = None

    def bands(self, *, rows: Range | None = None, columns: Range | None = None) -> Iterator[Frame]:
        """Yield a rectangle in bands of rows; errors are those of the file."""
        asked = Window(*self.clip(rows, columns))
        if self._kept is None:
            self._keep(asked)
        if self._kept is None or (part := _part(self._kept, asked)) is None:
            with self._file or Dataset.open(self._dataset, self._frame) as self._file:
                yield from self._file.bands(rows=rows, columns=columns)
            return
        top = asked.rows[0]
        for stored in row_bands(part):
            yield Frame(stored, top, asked.columns[0], self.header.height, self.header.width)
            top += len(stored)

    def _keep(self, asked: Window) -> None:
        """Decode a rectangle and the window, unless they are too large, or damaged where nobody has asked."""
        (top, bottom), (left, right) = (
            (min(first, low), max(stop, high))
            for (first, stop), (low, high) in zip(asked, self._window, strict=True)
        )
        n_bytes = (bottom - top) * (right - left) * len(self.header.channels) * self.stored_type.itemsize
        if self._file is not None and n_bytes * len(self._dataset.held) <= MOST_HELD_MB * 2**20:
            with suppress(FrameError):
                self._kept = self._file.read(rows=(top, bottom), columns=(left, right))
                self._dataset.held[self._frame.path] = self


def _part(kept: Frame, asked: Window) -> NDArray[Any] | None:
    """Return the pixels of a rectangle among those that were kept; None if some were not."""
    (top, bottom), (left, right) = (
        (first - begin, stop - begin)
        for (first, stop), begin in zip(asked, (kept.first_row, kept.first_column), strict=True)
    )
    n_rows, n_columns, _ = kept.stored.shape
    if min(top, left) < 0 or bottom > n_rows or right > n_columns:
        return None
    return kept.stored[top:bottom, left:right]
