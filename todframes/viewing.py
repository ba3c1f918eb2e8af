"""From a trial's files to the one retina image that the observer sees."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.dataset import Dataset, FrameReference, Skipped, Trial
from todframes.display import BackgroundRule, Display, border_mean, weber_contrast
from todframes.errors import DataError, FrameError, SettingsError
from todframes.frames import FrameFile, FrameHeader, frame_sha256
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


class Patch(NamedTuple):
    """Contrast of a rectangle of a frame; `row` and `column` are where its first pixel lies in the frame."""

    contrast: FloatArray
    row: int
    column: int
    n_negative: int


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
    pitch = dataset.display.pitch_mrad
    patches, xs, ys, n_rows = [], [], [], []
    for frame in trial.frames:
        path = dataset.frame_path(frame)
        check_sha256(dataset, frame)
        with FrameFile(path) as file:
            x, y = centroid_position(trial, file.header, observer.centre, pitch)
            _check_on_frame(path, trial, file.header, x, y, pitch)
            try:
                grid = grid_of()
            except SettingsError as error:  # of this row's size alone
                raise FrameError(path, str(error)) from None
            offsets = np.array(displacement_samples) * grid.pitch_mrad / pitch
            to_centre_x, to_centre_y = _from_centroid(trial, observer.centre, pitch)
            x, y = x + to_centre_x, y + to_centre_y
            rows, columns = (
                _touched(grid, at + offsets[:, axis], pitch, n_pixels)
                for axis, at, n_pixels in ((1, y, file.header.height), (0, x, file.header.width))
            )
            part = (None, None) if whole else (rows, columns)
            patches.append(read_contrast(file, dataset.display, frame, *part))
            n_rows.append(file.header.height)
        xs.append(x)
        ys.append(y)
    return Shown(tuple(patches), tuple(xs), tuple(ys), pitch, n_rows[0])


def _touched(grid: RetinaGrid, middles: FloatArray, pitch: float, n_pixels: int) -> tuple[int, int]:
    ranges = [grid.pixel_range(centre_px=at, pixel_pitch_mrad=pitch, n_pixels=n_pixels)
              for at in (float(middles.min()), float(middles.max()))]  # fmt: skip
    return ranges[0][0], ranges[1][1]


def retina_image(
    shown: Shown, grid: RetinaGrid, displacement_samples: tuple[float, float] = (0.0, 0.0)
) -> FloatArray:
    """Mean contrast of a trial's frames on a retina grid, displaced along x and y: (side, side)."""
    dx, dy = (d * grid.pitch_mrad / shown.pixel_pitch_mrad for d in displacement_samples)
    images = [
        resample(
            patch.contrast,
            grid,
            x_px=x + dx,
            y_px=y + dy,
            pixel_pitch_mrad=shown.pixel_pitch_mrad,
            first_row=patch.row,
            first_column=patch.column,
        )
        for patch, x, y in zip(shown.patches, shown.x_px, shown.y_px, strict=True)
    ]
    return images[0] if len(images) == 1 else np.asarray(sum(images) / len(images))


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
        with np.errstate(over="ignore"):
            contrast = weber_contrast(luminance, _background(rule, luminance, frame))
        if not np.isfinite(contrast).all():
            raise DataError("the contrast is beyond all numbers; expected luminances nearer to the background's")
    except DataError as error:
        raise FrameError(file.path, str(error)) from None
    n_negative = int(np.count_nonzero(luminance < 0.0))
    return Patch(contrast, part.first_row, part.first_column, n_negative)


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
        except FrameError as error:
            yield error
