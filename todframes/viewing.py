"""From a trial's files to the one retina image that the observer sees."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.dataset import Dataset, FrameReference, Skipped, Trial
from todframes.display import BackgroundRule, Display, border_values, weber_contrast
from todframes.errors import DataError, FrameError
from todframes.frames import BAND_VALUES, FrameFile, code_values, frame_sha256
from todframes.placing import centroid_position, check_on_frame, place_grid
from todframes.readout import Observer
from todframes.retina import RetinaGrid, add_resampled

FloatArray = NDArray[np.float64]

MOST_HELD_PX = 2**20
"""Of a patch that is held as contrast, eight bytes a pixel."""


class View(NamedTuple):
    """What an observer sees in a trial.

    `contrast` has shape (side, side) of the observer's grid; `n_negative` counts display pixels with a luminance
    below zero among those that were read.
    """

    contrast: FloatArray
    n_negative: int


class Patch(NamedTuple):
    """A rectangle of a frame, as contrast or as what contrast is made of.

    `row` and `column` are where its first pixel lies in the frame. A large rectangle is held as it is stored, one
    to four bytes a value instead of eight; `to_contrast` turns a part of it, whole rows, into contrast.
    """

    values: NDArray[Any]
    row: int
    column: int
    n_negative: int
    to_contrast: Callable[[NDArray[Any]], FloatArray] | None = None

    def bands(self) -> Iterator[Patch]:
        """The same in bands of rows, each as contrast."""
        if self.to_contrast is None:
            yield self
            return
        n_rows = max(BAND_VALUES // max(self.values[:1].size, 1), 1)
        for begin in range(0, len(self.values), n_rows):
            contrast = self.to_contrast(self.values[begin : begin + n_rows])
            yield Patch(contrast, self.row + begin, self.column, 0)


class Shown(NamedTuple):
    """A trial's frames as read, each with where the observer's grid has its middle if it is not displaced.

    `frame_rows` is how many rows the first frame has.
    """

    patches: tuple[Patch, ...]
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    pixel_pitch_mrad: float
    frame_rows: int

    @property
    def n_negative(self) -> int:
        """Display pixels with a luminance below zero among those that were read."""
        return sum(patch.n_negative for patch in self.patches)


Reader = Callable[..., Sequence[Shown]]
"""Reads a trial in one way or several; arguments and errors are those of `read_trial`, which does it in one."""


def read_trial(
    dataset: Dataset,
    trial: Trial,
    observer: Observer,
    grid_of: Callable[[], RetinaGrid],
    displacement_samples: Sequence[tuple[float, float]] | FloatArray = ((0.0, 0.0),),
    *,
    whole: bool = False,
) -> Shown:
    """Read as much of a trial's frames as a grid touches at each of its displacements, or whole frames.

    Parameters
    ----------
    grid_of : callable
        The grid; asked for once it is known that the triangle lies on the frame.
    displacement_samples : sequence of (float, float), or ndarray, shape (n, 2)
        By how much the retina grid is displaced along x and y, in retina samples.

    Raises
    ------
    FrameError
        If a frame cannot be used, or the triangle does not lie on it.
    """
    patches, places, n_rows = [], [], []
    for frame in trial.frames:
        check_sha256(dataset, frame)
        with FrameFile(dataset.frame_path(frame)) as file:
            place = place_grid(dataset, trial, file, observer, grid_of, displacement_samples)
            part = (None, None) if whole else (place.rows, place.columns)
            patches.append(read_contrast(file, dataset.display, frame, *part))
            places.append(place)
            n_rows.append(file.header.height)
    xs, ys = tuple(place.x_px for place in places), tuple(place.y_px for place in places)
    return Shown(tuple(patches), xs, ys, dataset.display.pitch_mrad, n_rows[0])


def read_as_it_is(
    dataset: Dataset,
    trial: Trial,
    observer: Observer,
    grid_of: Callable[[], RetinaGrid],
    displacement_samples: Sequence[tuple[float, float]] | FloatArray = ((0.0, 0.0),),
    *,
    whole: bool = False,
) -> tuple[Shown]:
    """`read_trial` as a `Reader`."""
    return (read_trial(dataset, trial, observer, grid_of, displacement_samples, whole=whole),)


def retina_image(
    shown: Shown, grid: RetinaGrid, displacement_samples: tuple[float, float] = (0.0, 0.0)
) -> FloatArray:
    """Mean contrast of a trial's frames on a retina grid, displaced along x and y: (side, side)."""
    dx, dy = (d * grid.pitch_mrad / shown.pixel_pitch_mrad for d in displacement_samples)
    image = np.zeros((grid.side, grid.side))
    for patch, x, y in zip(shown.patches, shown.x_px, shown.y_px, strict=True):
        for band in patch.bands():
            add_resampled(
                image,
                band.values,
                grid,
                x_px=x + dx,
                y_px=y + dy,
                pixel_pitch_mrad=shown.pixel_pitch_mrad,
                first_row=band.row,
                first_column=band.column,
            )
    if len(shown.patches) > 1:
        image /= len(shown.patches)
    return image


def view_trial(
    dataset: Dataset, trial: Trial, observer: Observer, displacement_samples: tuple[float, float] = (0.0, 0.0)
) -> View:
    """Read a trial's frames and average them in contrast on the retina.

    Parameters
    ----------
    displacement_samples : (float, float)
        By how much the retina grid is displaced along x and y, in retina samples.

    Raises
    ------
    FrameError
        If a frame cannot be used, or the triangle does not lie on it.
    """
    shown = read_trial(dataset, trial, observer, lambda: observer.grid(trial.stimulus), [displacement_samples])
    image = retina_image(shown, observer.grid(trial.stimulus), displacement_samples)
    return View(image, shown.n_negative)


def check_sha256(dataset: Dataset, frame: FrameReference) -> None:
    """Raise FrameError if the manifest gives a checksum and the file has another."""
    if frame.sha256 is not None:
        path = dataset.frame_path(frame)
        found = frame_sha256(path)
        if found != frame.sha256:
            raise FrameError(path, f"sha256 is {found}, the manifest says {frame.sha256}")


def left_out(dataset: Dataset, trial: Trial, error: FrameError | str) -> list[Skipped]:
    """All frames of a trial that cannot be used: it is averaged over all of them or not at all."""
    others = f"another frame of trial {trial.name} cannot be used"
    return [
        Skipped(
            frame.path,
            others if isinstance(error, FrameError) and error.path != dataset.frame_path(frame) else str(error),
        )
        for frame in trial.frames
    ]


def read_contrast(
    file: FrameFile,
    display: Display,
    frame: FrameReference,
    rows: tuple[int, int] | None = None,
    columns: tuple[int, int] | None = None,
    *,
    every_pixel: bool = False,
) -> Patch:
    """Contrast of a range of rows and columns of an open frame, all of them by default.

    Only the rows asked for are decoded, unless the background is a mean over the frame or `every_pixel` is to be
    looked at. Pixels are decoded once, in bands of rows; only those asked for stay in memory.

    Raises
    ------
    FrameError
        If the pixels cannot be read or their luminance or the background is not usable.
    """
    rule = display.background_luminance_cd_m2
    whole = every_pixel or rule in ("border", "frame_mean")
    (top, bottom), (left, right) = file.clip(rows, columns)
    (first_row, stop_row), _ = file.clip(None, None)
    is_small = (bottom - top) * (right - left) <= MOST_HELD_PX
    kept: NDArray[Any] = (
        np.empty((bottom - top, right - left))
        if is_small
        else np.empty((bottom - top, right - left, len(file.header.channels)), file.stored_type)
    )
    found = _Luminance()
    try:
        for band in file.bands() if whole else file.bands(rows=rows, columns=columns):
            luminance = display.luminance(band.values)
            begin, end = band.first_row, band.first_row + len(luminance)
            found.add(luminance)
            if rule == "border":
                found.average(border_values(luminance, top=begin == first_row, bottom=end == stop_row))
            elif rule == "frame_mean":
                found.average(luminance)
            if begin < bottom and end > top:
                part = (luminance if is_small else band.stored)[max(top - begin, 0) : bottom - begin]
                kept[max(begin - top, 0) : end - top] = part[:, left - band.first_column :][:, : right - left]
        background = _background(rule, found, frame)
        check_contrast(found.largest, background)
    except DataError as error:
        raise FrameError(file.path, str(error)) from None
    if is_small:
        return Patch(weber_contrast(kept, background), top, left, found.n_negative)
    return Patch(kept, top, left, found.n_negative, partial(_contrast, display, background))


class _Luminance:
    """What is found out about the luminance of a frame, band by band."""

    def __init__(self) -> None:
        self.n_negative = 0
        self.largest = 0.0
        self.sum = 0.0
        self.n_averaged = 0

    def add(self, luminance: FloatArray) -> None:
        """Look at a band."""
        lowest = float(luminance.min())
        self.largest = max(self.largest, -lowest, float(luminance.max()))
        if lowest < 0.0:
            self.n_negative += int(np.count_nonzero(luminance < 0.0))

    def average(self, luminance: FloatArray) -> None:
        """Add pixels of a band to those whose mean is the background."""
        self.sum += float(luminance.sum())
        self.n_averaged += luminance.size


def _background(rule: float | BackgroundRule, found: _Luminance, frame: FrameReference) -> float:
    if rule == "column":
        assert frame.background_luminance_cd_m2 is not None  # the manifest was checked for it
        return frame.background_luminance_cd_m2
    return found.sum / found.n_averaged if isinstance(rule, str) else rule


def _contrast(display: Display, background_luminance_cd_m2: float, stored: NDArray[Any]) -> FloatArray:
    """Contrast of pixels as stored."""
    return weber_contrast(display.luminance(code_values(stored)), background_luminance_cd_m2)


def finite_contrast(luminance: FloatArray, background_luminance_cd_m2: float) -> FloatArray:
    """Weber contrast; DataError if it overflows, or the background is not a positive number."""
    check_contrast(max(-float(luminance.min()), float(luminance.max())), background_luminance_cd_m2)
    return weber_contrast(luminance, background_luminance_cd_m2)


def check_contrast(largest_luminance_cd_m2: float, background_luminance_cd_m2: float) -> None:
    """Raise DataError if Weber contrast overflows, or the background is not a positive number."""
    weber_contrast(np.zeros(0), background_luminance_cd_m2)  # for its check
    if largest_luminance_cd_m2 > sys.float_info.max * min(background_luminance_cd_m2, 1.0):
        raise DataError("the contrast is beyond all numbers; expected luminances nearer to the background's")


def frame_problems(dataset: Dataset, trial: Trial) -> Iterator[FrameError]:
    """What is wrong with the frames of a trial, every pixel of them looked at."""
    for frame in trial.frames:
        path = dataset.frame_path(frame)
        try:
            check_sha256(dataset, frame)
            with FrameFile(path) as file:
                pitch_mrad = dataset.display.pitch_mrad
                x, y = centroid_position(trial, file.header, "centroid", pitch_mrad)
                check_on_frame(path, trial, file.header, x, y, pitch_mrad)
                read_contrast(file, dataset.display, frame, (0, 0), every_pixel=True)
            if (reference := dataset.reference_path(frame)) is not None:
                with FrameFile(reference) as file:
                    for _ in file.bands():
                        pass
        except FrameError as error:
            yield error
