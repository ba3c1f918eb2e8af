"""The observer's view of a trial: frames are placed under the retina grid and resampled."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from todframes.base._typing import FloatArray
from todframes.frames.contrast import ContrastPatch, read_contrast
from todframes.frames.dataset import Dataset
from todframes.frames.files import FrameSource
from todframes.frames.position import (
    centroid_position,
    check_on_frame,
    from_centroid,
    size_in_px,
)
from todframes.frames.surround import TrianglePlace
from todframes.frames.trials import FrameReference, Trial
from todframes.observers.interface import Observer
from todframes.observers.retina import RetinaGrid, resample
from todframes.stimulus import Centre


class Placement(NamedTuple):
    """The middle of an undisplaced grid on a frame, in pixels, the rows and columns that the grid touches, and the
    triangle."""

    x_px: float
    y_px: float
    rows: tuple[int, int]
    columns: tuple[int, int]
    triangle: TrianglePlace


def place_grid(
    dataset: Dataset,
    trial: Trial,
    frame: FrameReference,
    file: FrameSource,
    observer: Observer,
    grid: RetinaGrid,
    displacement_samples: Sequence[tuple[float, float]] | FloatArray,
) -> Placement:
    """Find the position of a retina grid on an open frame, and the pixels it touches at all of its displacements.
    The grid follows a triangle that moves, or stays at its mean place in the trial, as the dataset's `gaze` says.
    Raises FrameError if the triangle does not lie on the frame.
    """
    pitch, header, centre = dataset.display.pitch_mrad, file.header, observer.centre
    x, y = centroid_position(trial, header, centre, pitch, frame)
    check_on_frame(file.path, trial, header, x, y, pitch)
    triangle = TrianglePlace(x, y, size_in_px(trial, pitch))
    if dataset.gaze == "fixed":
        x, y = centroid_position(trial, header, centre, pitch)
    to_centre_x, to_centre_y = from_centroid(trial, centre, pitch)
    x, y = x + to_centre_x, y + to_centre_y
    offsets = np.asarray(displacement_samples) * grid.pitch_mrad / pitch
    along_x, along_y = zip(*offsets.tolist(), strict=True)
    touched = []
    for at, along, n_pixels in ((y, along_y, header.height), (x, along_x, header.width)):
        ends = dict.fromkeys((min(along), max(along)))
        parts = [grid.pixel_range(centre_px=at + end, pixel_pitch_mrad=pitch, n_pixels=n_pixels) for end in ends]
        touched.append((parts[0][0], parts[-1][1]))
    return Placement(x, y, touched[0], touched[1], triangle)


class TrialPatches(NamedTuple):
    """A trial's frames as read, each with the position of the middle of the undisplaced retina grid. `x_px` and
    `y_px` are these positions in pixels; `frame_rows` is the number of rows of the last frame.
    """

    patches: tuple[ContrastPatch, ...]
    x_px: tuple[float, ...]
    y_px: tuple[float, ...]
    pixel_pitch_mrad: float
    frame_rows: int

    @property
    def n_negative(self) -> int:
        """Number of display pixels with a luminance below zero among those that were read."""
        return sum(patch.n_negative for patch in self.patches)

    @property
    def background_luminance_cd_m2(self) -> float:
        """Mean over the frames of the luminance that contrast refers to; NaN if a patch was made from contrast."""
        each = [patch.background_luminance_cd_m2 for patch in self.patches]
        return sum(math.nan if frame is None else frame for frame in each) / len(each)

    def on_pixels(self, grid: RetinaGrid, offset_samples: tuple[float, float]) -> TrialPatches:
        """Return the frames with the grid moved by an offset, then by half a pixel at most, so that samples begin
        where pixels do.
        """
        sample_px = grid.pitch_mrad / self.pixel_pitch_mrad
        to_middle = (sample_px - 1.0) / 2.0  # from the middle of a sample's first pixel
        xs, ys = (
            tuple(math.ceil(at + offset * sample_px - to_middle - 0.5) + to_middle for at in along)
            for along, offset in zip((self.x_px, self.y_px), offset_samples, strict=True)
        )
        return self._replace(x_px=xs, y_px=ys)

    def with_gaze_fixed(self, trial: Trial, frame_pitch_mrad: float) -> TrialPatches:
        """Return frames that were read with a tracked gaze as seen with a fixed one. `frame_pitch_mrad` is the
        pixel pitch of the dataset's frames, which an algorithm may have changed since.
        """
        motion_px = to_mean_place_px(trial) * (frame_pitch_mrad / self.pixel_pitch_mrad)
        xs, ys = (np.array([self.x_px, self.y_px]) + motion_px.T).tolist()
        return self._replace(x_px=tuple(xs), y_px=tuple(ys))


Reader = Callable[..., Sequence[TrialPatches]]
"""Function that reads a trial in one or several ways; its arguments are those of `read_trial`."""


def to_mean_place_px(trial: Trial) -> FloatArray:
    """Return the distances in pixels from the triangle in each frame of a trial to its mean place: (n, 2)."""
    return -np.array([frame.motion_px or (0.0, 0.0) for frame in trial.frames])


def read_trial(
    dataset: Dataset,
    trial: Trial,
    observer: Observer,
    grid: RetinaGrid,
    displacement_samples: Sequence[tuple[float, float]] | FloatArray = ((0.0, 0.0),),
    *,
    whole: bool = False,
) -> TrialPatches:
    """Read the part of a trial's frames that a retina grid touches at all of its displacements, or whole frames.
    `displacement_samples`, (n, 2), are displacements along x and y in retina samples. Raises FrameError if a frame
    cannot be used, or the triangle does not lie on it.
    """
    patches, places = [], []
    for frame in trial.frames:
        with dataset.open(frame, verify=True) as file:
            place = place_grid(dataset, trial, frame, file, observer, grid, displacement_samples)
            part = (None, None) if whole else (place.rows, place.columns)
            patches.append(read_contrast(file, dataset.display, frame, *part, triangle=place.triangle))
            places.append((place.x_px, place.y_px))
            n_rows = file.header.height
    xs, ys = zip(*places, strict=True)
    return TrialPatches(tuple(patches), xs, ys, dataset.display.pitch_mrad, n_rows)


def patches_about(
    dataset: Dataset, trial: Trial, centre: Centre, reach_px: tuple[int, int]
) -> Iterator[tuple[ContrastPatch, float, float]]:
    """Yield the part of each frame of a trial about the triangle, so many pixels before and after its middle one,
    and the triangle's position (x, y)."""
    pitch_mrad, (before, after) = dataset.display.pitch_mrad, reach_px
    for frame in trial.frames:
        with dataset.open(frame, verify=True) as file:
            x, y = centroid_position(trial, file.header, centre, pitch_mrad, frame)
            rows, columns = ((round(at) - before, round(at) + after) for at in (y, x))
            triangle = TrianglePlace(x, y, size_in_px(trial, pitch_mrad))
            yield read_contrast(file, dataset.display, frame, rows, columns, triangle=triangle), x, y


def retina_image(
    shown: TrialPatches, grid: RetinaGrid, displacement_samples: tuple[float, float] = (0.0, 0.0)
) -> FloatArray:
    """Compute the mean contrast of a trial's frames on a retina grid, displaced along x and y: (side, side)."""
    pitch_mrad, image = shown.pixel_pitch_mrad, np.zeros((grid.side, grid.side))
    dx, dy = (d * grid.pitch_mrad / pitch_mrad for d in displacement_samples)
    for patch, x, y in zip(shown.patches, shown.x_px, shown.y_px, strict=True):
        at = {"x_px": x + dx, "y_px": y + dy, "pixel_pitch_mrad": pitch_mrad}
        for band in patch.bands():
            resample(band.values, grid, first_row=band.row, first_column=band.column, onto=image, **at)
    return image / len(shown.patches)
