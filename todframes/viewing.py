"""From a trial's files to the one retina image that the observer sees."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.dataset import Dataset, FrameReference, Skipped, Trial
from todframes.display import BackgroundRule, Display, border_mean, weber_contrast
from todframes.errors import DataError, FrameError, SettingsError
from todframes.frames import FrameFile, FrameHeader, frame_sha256, read_frame
from todframes.readout import Observer
from todframes.retina import RetinaGrid, resample
from todframes.stimulus import Centre, bounding_box_offset, vertices

FloatArray = NDArray[np.float64]


class View(NamedTuple):
    """What an observer sees in a trial.

    `contrast` has shape (side, side) of the observer's grid; `n_negative` counts display pixels with a luminance
    below zero among those that were read.
    """

    contrast: FloatArray
    n_negative: int


class Placement(NamedTuple):
    """A retina grid on a frame: where its middle lies, in pixels, and the rows and columns that it touches."""

    grid: RetinaGrid
    x_px: float
    y_px: float
    rows: tuple[int, int]
    columns: tuple[int, int]


class Patch(NamedTuple):
    """Contrast of a rectangle of a frame; `row` and `column` are where its first pixel lies in the frame."""

    contrast: FloatArray
    row: int
    column: int
    n_negative: int


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
    total: FloatArray | None = None
    n_negative = 0
    for frame in trial.frames:
        contrast, negative = _view_frame(dataset, trial, frame, observer, displacement_samples)
        total = contrast if total is None else total + contrast
        n_negative += negative
    assert total is not None
    return View(total / len(trial.frames), n_negative)


def _view_frame(
    dataset: Dataset,
    trial: Trial,
    frame: FrameReference,
    observer: Observer,
    displacement_samples: tuple[float, float],
) -> tuple[FloatArray, int]:
    check_sha256(dataset, frame)
    with FrameFile(dataset.frame_path(frame)) as file:
        place = place_grid(dataset, trial, file, observer, displacement_samples)
        patch = read_contrast(file, dataset.display, frame, place.rows, place.columns)
    contrast = resample(
        patch.contrast,
        place.grid,
        x_px=place.x_px,
        y_px=place.y_px,
        pixel_pitch_mrad=dataset.display.pitch_mrad,
        first_row=patch.row,
        first_column=patch.column,
    )
    return contrast, patch.n_negative


def place_grid(
    dataset: Dataset,
    trial: Trial,
    file: FrameFile,
    observer: Observer,
    displacement_samples: tuple[float, float] = (0.0, 0.0),
) -> Placement:
    """Where the observer's grid lies on a frame of a trial.

    Raises
    ------
    FrameError
        If the triangle does not lie on the frame, or the observer cannot look at one of its size.
    """
    pixel_pitch, header = dataset.display.pitch_mrad, file.header
    x, y = centroid_position(trial, header, observer.centre, pixel_pitch)
    _check_on_frame(file.path, trial, header, x, y, pixel_pitch)
    try:
        grid = observer.grid(trial.stimulus)
    except SettingsError as error:  # of this row's size alone
        raise FrameError(file.path, str(error)) from None
    to_centre_x, to_centre_y = _from_centroid(trial, observer.centre, pixel_pitch)
    x += to_centre_x + displacement_samples[0] * grid.pitch_mrad / pixel_pitch
    y += to_centre_y + displacement_samples[1] * grid.pitch_mrad / pixel_pitch
    rows = grid.pixel_range(centre_px=y, pixel_pitch_mrad=pixel_pitch, n_pixels=header.height)
    columns = grid.pixel_range(centre_px=x, pixel_pitch_mrad=pixel_pitch, n_pixels=header.width)
    return Placement(grid, x, y, rows, columns)


def check_sha256(dataset: Dataset, frame: FrameReference) -> None:
    """Raise FrameError if the manifest gives a checksum and the file has another."""
    if frame.sha256 is not None:
        path = dataset.frame_path(frame)
        found = frame_sha256(path)
        if found != frame.sha256:
            raise FrameError(path, f"sha256 is {found}, the manifest says {frame.sha256}")


def centroid_position(
    trial: Trial, header: FrameHeader, centre: Centre, pixel_pitch_mrad: float
) -> tuple[float, float]:
    """(x, y) of the triangle's centroid in pixels.

    The manifest's; without one, the triangle's `centre` lies at the frame's.
    """
    if trial.x_px is not None and trial.y_px is not None:
        return trial.x_px, trial.y_px
    return to_centroid(trial, (header.width - 1) / 2.0, (header.height - 1) / 2.0, centre, pixel_pitch_mrad)


def to_centroid(
    trial: Trial, x_px: float, y_px: float, centre: Centre, pixel_pitch_mrad: float
) -> tuple[float, float]:
    """(x, y) of the centroid of a trial's triangle whose `centre` lies at (x_px, y_px)."""
    dx, dy = _from_centroid(trial, centre, pixel_pitch_mrad)
    return x_px - dx, y_px - dy


def _from_centroid(trial: Trial, centre: Centre, pixel_pitch_mrad: float) -> tuple[float, float]:
    if centre == "centroid":
        return 0.0, 0.0
    dx, dy = bounding_box_offset(trial.orientation)
    size_px = trial.stimulus.size_mrad / pixel_pitch_mrad
    return dx * size_px, dy * size_px


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
) -> Patch:
    """Contrast of a range of rows and columns of an open frame, all of them by default.

    Only the rows asked for are decoded, unless the background is a mean over the frame.

    Raises
    ------
    FrameError
        If the pixels cannot be read or their luminance or the background is not usable.
    """
    rule = display.background_luminance_cd_m2
    whole = rule in ("border", "frame_mean")
    part = file.read() if whole else file.read(rows=rows, columns=columns)
    try:
        luminance = display.luminance(part.values)
        contrast = finite_contrast(luminance, _background(rule, luminance, frame))
    except DataError as error:
        raise FrameError(file.path, str(error)) from None
    n_negative = int(np.count_nonzero(luminance < 0.0))
    return Patch(contrast, part.first_row, part.first_column, n_negative)


def finite_contrast(luminance: FloatArray, background_luminance_cd_m2: float) -> FloatArray:
    """Weber contrast; DataError if it overflows, or the background is not a positive number."""
    with np.errstate(over="ignore"):
        contrast = weber_contrast(luminance, background_luminance_cd_m2)
    if not np.isfinite(contrast).all():
        raise DataError("the contrast is beyond all numbers; expected luminances nearer to the background's")
    return contrast


def _background(rule: float | BackgroundRule, luminance: FloatArray, frame: FrameReference) -> float:
    if rule == "border":
        return border_mean(luminance)
    if rule == "frame_mean":
        return float(luminance.mean())
    if rule == "column":
        assert frame.background_luminance_cd_m2 is not None  # the manifest was checked for it
        return frame.background_luminance_cd_m2
    return rule


def _check_on_frame(
    path: Path, trial: Trial, header: FrameHeader, x: float, y: float, pixel_pitch_mrad: float
) -> None:
    """The whole triangle must lie on pixels that the file has."""
    size_px = min(trial.stimulus.size_mrad / pixel_pitch_mrad, 1e300)  # whose corners are numbers still
    corners = vertices(size=size_px, orientation=trial.orientation, x=x, y=y)
    (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
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
            f"the triangle reaches from ({left:.6g}, {top:.6g}) to ({right:.6g}, {bottom:.6g}) px, off the frame "
            f"({first_x:.1f}, {first_y:.1f}) to ({last_x:.1f}, {last_y:.1f}) px",
        )


def frame_problems(dataset: Dataset, trial: Trial) -> Iterator[FrameError]:
    """What is wrong with the frames of a trial, every pixel of them looked at."""
    for frame in trial.frames:
        path = dataset.frame_path(frame)
        try:
            check_sha256(dataset, frame)
            with FrameFile(path) as file:
                pitch_mrad = dataset.display.pitch_mrad
                x, y = centroid_position(trial, file.header, "centroid", pitch_mrad)
                _check_on_frame(path, trial, file.header, x, y, pitch_mrad)
                read_contrast(file, dataset.display, frame)
            if (reference := dataset.reference_path(frame)) is not None:
                read_frame(reference)
        except FrameError as error:
            yield error
