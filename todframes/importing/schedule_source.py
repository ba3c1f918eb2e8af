"""Recordings with a schedule: its rows state what each frame shows, so the frames are not searched."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, argument
from todframes.importing.clips import Clip, ClipFrame, FramePart, Placed, frames_with_those_before
from todframes.importing.filmed_trials import OBJECT_SIZE, Correction, TriangleDescription
from todframes.importing.schedule import ScheduledTrial, assign_recordings, read_schedule
from todframes.importing.windows import clipped, field_reach_px, part_of, window_about
from todframes.parameters import Progress, counted
from todframes.recordings.recording import Recording, RecordingWarning

NO_MODULES = np.zeros((0, 0, 0))


class ScheduleSource:
    """Source of clips from recordings with a schedule; each row is a clip.

    `pitch_mrad` is the visual angle of a pixel of the display, and `ifov_mrad` the angle of a recorded pixel at
    the camera; None: sizes in mrad are those on the display. Each frame of a clip brings along `warm_up_frames`
    recorded frames from before it. Raises DataError if the schedule cannot be used, or does not fit the
    recordings.
    """

    def __init__(
        self,
        path: Path,
        recordings: Sequence[Recording],
        *,
        pitch_mrad: float,
        ifov_mrad: float | None,
        level: str,
        progress: Progress | None,
        warm_up_frames: int = 0,
    ) -> None:
        self.path = path
        self.level = level
        self.clips: list[Clip] = []
        self.corrections: dict[int, Correction] = {}
        self._rows = read_schedule(path, level=level)
        self._recording_of = assign_recordings(self._rows, [one.path for one in recordings], schedule=path)
        self._pitch_mrad = pitch_mrad
        self._ifov_mrad = ifov_mrad
        self._progress = progress
        self._warm_up_frames = warm_up_frames
        self._n_cut = 0
        with_angle = [row for row in self._rows if self._object_mrad(row) is not None]
        if with_angle and len(with_angle) < len(self._rows):
            row = next(row for row in self._rows if self._object_mrad(row) is None)
            raise DataError(f"{row.where}: size_mrad: is missing, expected it in all rows or in none")
        self.group_by = OBJECT_SIZE if with_angle else "size_mrad"

    def _object_mrad(self, row: ScheduledTrial) -> float | None:
        """Return the size at the camera; None if the schedule does not state it."""
        if row.size_mrad is not None and (self._ifov_mrad is not None or row.size_px is not None):
            return row.size_mrad
        return row.size_px * self._ifov_mrad if row.size_px is not None and self._ifov_mrad is not None else None

    def _size_px(self, row: ScheduledTrial) -> float:
        if row.size_px is not None:
            return row.size_px
        assert row.size_mrad is not None  # a schedule has one of them
        return row.size_mrad / (self._pitch_mrad if self._ifov_mrad is None else self._ifov_mrad)

    def described(self, page: int, index: int) -> TriangleDescription:  # noqa: ARG002
        """Return the description of the triangle in a row of the schedule."""
        row = self._rows[page]
        size = self._object_mrad(row)
        columns: dict[str, object] = {} if size is None else {OBJECT_SIZE: repr(size)}
        return TriangleDescription(row.level, row.polarity, columns | dict(row.other))

    def frames(self, recording: Recording, number: int) -> Iterator[tuple[Clip, ClipFrame]]:
        """Yield the frames of a recording that the schedule names, each with its clip.

        Raises DataError if the schedule gives times and the frames have none, or FrameError for a damaged frame.
        """
        rows = [k for k, of_recording in enumerate(self._recording_of) if of_recording == number]
        rows.sort(key=lambda k: self._rows[k].start_s or 0.0)
        clips = {k: Clip(k + 1, k) for k in rows}
        self.clips += clips.values()
        frames = frames_with_those_before(recording, self._warm_up_frames)
        for frame, before in counted(frames, recording.n_frames, self._progress):
            while rows and self._is_over(rows[0], frame.time_s):
                rows.pop(0)
            if not rows or not self._has_begun(rows[0], frame.time_s):
                continue
            placed = self._placed(self._rows[rows[0]], frame.values)
            shown = ClipFrame(rows[0], frame.time_s, frame.source, (placed,), NO_MODULES, before)
            clips[rows[0]].count(shown)
            yield clips[rows[0]], shown

    def _is_over(self, row: int, time_s: float | None) -> bool:
        end_s = self._rows[row].end_s
        if end_s is None:
            return False
        if time_s is None:
            raise DataError(
                f"{self._rows[row].where}: found start_s and end_s, but the frames have no times; give "
                f"{argument.frames_per_second}"
            )
        return time_s >= end_s

    def _has_begun(self, row: int, time_s: float | None) -> bool:
        start_s = self._rows[row].start_s
        return start_s is None or (time_s is not None and time_s >= start_s)

    def _placed(self, row: ScheduledTrial, values: NDArray[np.generic]) -> Placed:
        height, width = values.shape[:2]
        size_px = self._size_px(row)
        if row.x_px is None or row.y_px is None:
            window = (0, height, 0, width)
            return Placed(None, None, size_px, row.orientation, window, FramePart(values, 0, 0))
        if not (0 <= row.x_px < width and 0 <= row.y_px < height):
            raise DataError(
                f"{row.where}: found x_px {row.x_px:g} and y_px {row.y_px:g}, expected a place on the frame of "
                f"{width} x {height} pixels"
            )
        whole = window_about(row.x_px, row.y_px, field_reach_px(math.ceil(size_px), self._pitch_mrad))
        window = clipped(whole, values.shape)
        self._n_cut += window != whole
        return Placed(row.x_px, row.y_px, size_px, row.orientation, window, part_of(values, window))

    def field_places(self) -> dict[int, dict[str, str]]:
        """Return no places: a schedule does not say where its targets are in the camera's field."""
        return {}

    def why_nothing(self) -> str | None:
        """Return why there is no frame in any clip; None if there are some."""
        if any(clip.n_frames for clip in self.clips):
            return None
        return f"{self.path}: no frame lies in the times of any row; times count from the start of a recording"

    def warnings(self) -> Iterator[RecordingWarning]:
        """Yield warnings about parts that were left out, or are smaller than they should be."""
        empty = [clip for clip in self.clips if not clip.n_frames]
        if empty:
            yield RecordingWarning(
                "no_frames",
                f"{self._rows[empty[0].page].where}: no frame lies in the times of this row"
                + (f" and {len(empty) - 1} more" if len(empty) > 1 else ""),
            )
        if self._n_cut:
            yield RecordingWarning(
                "cut_window",
                f"{self.path}: {self._n_cut} windows are cut by the frame's border, so the observer sees less "
                "than its field",
            )

    def notes(self) -> Iterator[str]:
        """Yield remarks that need no action."""
        n_frames = sum(clip.n_frames for clip in self.clips)
        yield f"{self.path}: {n_frames} frames in {sum(clip.n_frames > 0 for clip in self.clips)} rows"
        if any(row.x_px is None for row in self._rows):
            yield "frames without x_px and y_px are whole; todframes score --locate finds the triangles"

    def report(self) -> list[dict[str, object]]:
        """Return the findings in each clip."""
        return [asdict(clip) for clip in self.clips]
