"""The position of a trial's triangle on its frame, and the check that the triangle lies on the frame."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from todframes.base.errors import FrameError
from todframes.frames.dataset import Dataset
from todframes.frames.files import FrameHeader
from todframes.frames.trials import FrameReference, Trial
from todframes.stimulus import Centre, Orientation, Stimulus, bounding_box_offset, vertices


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


def check_places(dataset: Dataset, trials: Sequence[Trial], centre: Centre) -> None:
    """Raise FrameError if a file is missing or a triangle does not lie on its frame. Only one header is read for
    each stimulus, that of its first frame.
    """
    of_stimulus: dict[Stimulus, Trial] = {}
    for trial in trials:
        for frame in (*trial.warm_up, *trial.frames):
            if not dataset.has_frame(frame):
                raise FrameError(dataset.frame_path(frame), "cannot be opened: No such file or directory")
        of_stimulus.setdefault(trial.stimulus, trial)
    for trial in sorted(of_stimulus.values(), key=lambda trial: trial.number):
        check_place(dataset, trial, centre)


def check_place(dataset: Dataset, trial: Trial, centre: Centre) -> None:
    """Raise FrameError if a trial's triangle does not lie on its first frame; only the header is read."""
    with dataset.open(trial.frames[0]) as file:
        x, y = centroid_position(trial, file.header, centre, dataset.display.pitch_mrad, trial.frames[0])
        check_on_frame(file.path, trial, file.header, x, y, dataset.display.pitch_mrad)


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
