"""Schedules: CSV files that say what each part of recordings shows when no chart with markers states it.

`size_mrad` is √(area) of the triangle at the camera, as in `chart.toml`; `size_px`, in its place or beside it, is
the size in pixels of the camera. Columns that this module does not know are kept as text.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, argument
from todframes.base.reading import check_columns, number, read_table, spelling_hint
from todframes.frames.dataset import orientation_in, pair_in, polarity_in
from todframes.importing.trials import (
    OBJECT_SIZE,
    Clip,
    ClipFrame,
    Correction,
    Placed,
    TriangleDescription,
    clipped,
    field_reach_px,
    frames_with_those_before,
    window_about,
)
from todframes.parameters import Progress, counted
from todframes.recordings.recording import Recording, RecordingWarning
from todframes.stimulus import Orientation

SIZE_COLUMNS = ("size_mrad", "size_px")
"""Columns with the size of the triangle; a schedule has one of them, or both."""

SCHEDULE_COLUMNS = ("file", "start_s", "end_s", "orientation", *SIZE_COLUMNS, "x_px", "y_px", "polarity")
"""Columns of a schedule with a meaning of their own, beside the level."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduledTrial:
    """One row of a schedule: a part of a recording, all of it without times, and the triangle that it shows.

    `where` is the schedule's path and the line. `file` is the recording as written, None: the only one. Sizes are
    √(area), in mrad at the camera or in its pixels; one of them is given. `other` are the remaining columns.
    """

    where: str
    file: str | None
    start_s: float | None
    end_s: float | None
    orientation: Orientation
    size_mrad: float | None
    size_px: float | None
    level: float
    polarity: int
    x_px: float | None
    y_px: float | None
    other: Mapping[str, str]


def read_schedule(path: Path, *, level: str = "contrast") -> tuple[ScheduledTrial, ...]:
    """Read a schedule, whose stimulus strength has the column `level`; return its rows, at least one.

    The columns `orientation`, a size and the level are needed. DataError if the file cannot be read, a column is
    missing, a value is wrong, or two rows use the same part of a file.
    """
    header, rows = read_table(path)
    _check_header(header, level, path)
    trials = [_trial(row.texts, row.where, level) for row in rows]
    if not trials:
        raise DataError(f"{path}: no trials; expected a row a trial below the header")
    _check_parts(trials)
    return tuple(trials)


def assign_recordings(
    trials: Sequence[ScheduledTrial], paths: Sequence[Path], *, schedule: Path
) -> tuple[int, ...]:
    """Find the recording of each scheduled trial, as an index in `paths`, the files that were recorded.

    It is that of the same file, also relative to the folder of the schedule, or else of the only one whose path
    ends as written. Raises DataError if a name fits no recording or several, or is missing and there are several.
    """
    real_paths = {os.path.realpath(path): number for number, path in enumerate(paths)}
    first_rows = {trial.file: trial for trial in reversed(trials)}
    by_name = {file: _recording(row, paths, real_paths, schedule.parent) for file, row in first_rows.items()}
    return tuple(by_name[trial.file] for trial in trials)


def _recording(trial: ScheduledTrial, paths: Sequence[Path], real_paths: Mapping[str, int], folder: Path) -> int:
    if trial.file is None:
        if len(paths) == 1:
            return 0
        raise DataError(f"{trial.where}: file: is missing, expected the name of one of {len(paths)} recordings")
    for place in (folder / trial.file, Path(trial.file)):
        if (same := real_paths.get(os.path.realpath(place))) is not None:
            return same
    parts = Path(trial.file).parts
    alike = [number for number, path in enumerate(paths) if path.parts[-len(parts) :] == parts]
    if len(alike) == 1:
        return alike[0]
    if alike:
        raise DataError(
            f"{trial.where}: file: found {trial.file}, which {len(alike)} recordings are called; "
            "write more of its path"
        )
    names = ", ".join(path.name for path in paths[:5]) + (", …" if len(paths) > 5 else "")
    raise DataError(f"{trial.where}: file: found {trial.file}, expected one of the recordings: {names}")


def _check_header(header: Sequence[str], level: str, path: Path) -> None:
    check_columns(header, ["orientation", level], path)
    known = [*SCHEDULE_COLUMNS, level]
    for name in header:
        hint = spelling_hint(name, known) or next(
            (f"; write {one}" for one in SCHEDULE_COLUMNS if one.startswith(f"{name.lower()}_")), ""
        )
        if name not in known and hint:
            raise DataError(f"{path}: found column {name!r}{hint}")
    for pair in (("start_s", "end_s"), ("x_px", "y_px")):
        if len(set(pair) & set(header)) == 1:
            raise DataError(f"{path}: found one of the columns {pair[0]} and {pair[1]}, expected both or none")


def _trial(row: Mapping[str, str], where: str, level: str) -> ScheduledTrial:
    def size(name: str) -> float | None:
        text = row.get(name, "").strip()
        return number(text, f"{where}: {name}", positive=True) if text else None

    orientation, polarity = orientation_in(row, where), polarity_in(row, where)
    size_mrad, size_px = map(size, SIZE_COLUMNS)
    if size_mrad is None and size_px is None:
        raise DataError(f"{where}: found no size, expected size_mrad or size_px")
    start_s, end_s = pair_in(row, where, "start_s", "end_s")
    if start_s is not None and end_s is not None and not 0.0 <= start_s < end_s:
        raise DataError(f"{where}: found start_s {start_s:g} and end_s {end_s:g}, expected 0 <= start_s < end_s")
    x_px, y_px = pair_in(row, where, "x_px", "y_px")
    return ScheduledTrial(
        where=where,
        file=row.get("file", "").strip() or None,
        start_s=start_s,
        end_s=end_s,
        orientation=orientation,
        size_mrad=size_mrad,
        size_px=size_px,
        level=number(row[level], f"{where}: {level}", positive=True),
        polarity=polarity,
        x_px=x_px,
        y_px=y_px,
        other={name: text.strip() for name, text in row.items() if name not in (*SCHEDULE_COLUMNS, level)},
    )


def _check_parts(trials: Sequence[ScheduledTrial]) -> None:
    """Raise DataError if two trials use the same part of a file."""
    of_file: dict[str | None, list[ScheduledTrial]] = {}
    for trial in trials:
        of_file.setdefault(trial.file, []).append(trial)
    for rows in of_file.values():
        rows.sort(key=lambda trial: trial.start_s or 0.0)
        for before, after in pairwise(rows):
            if before.end_s is None or after.start_s is None or after.start_s < before.end_s:
                line = before.where.rpartition(", ")[2]
                raise DataError(
                    f"{after.where}: found a part of the file that {line} has, too; expected start_s and end_s of "
                    "parts that do not overlap"
                )


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
            if not rows:
                continue
            start_s = self._rows[rows[0]].start_s
            if start_s is not None and (frame.time_s is None or frame.time_s < start_s):
                continue
            placed = self._placed(self._rows[rows[0]], frame.values)
            shown = ClipFrame(
                rows[0], frame.time_s, frame.source, frame.values, (placed,), np.zeros((0, 0, 0)), before
            )
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

    def _placed(self, row: ScheduledTrial, values: NDArray[np.generic]) -> Placed:
        height, width = values.shape[:2]
        size_px = row.size_px
        if size_px is None:
            assert row.size_mrad is not None  # a schedule has one of them
            size_px = row.size_mrad / (self._pitch_mrad if self._ifov_mrad is None else self._ifov_mrad)
        if row.x_px is None or row.y_px is None:
            window = (0, height, 0, width)
            return Placed(None, None, size_px, row.orientation, window, window)
        if not (0 <= row.x_px < width and 0 <= row.y_px < height):
            raise DataError(
                f"{row.where}: found x_px {row.x_px:g} and y_px {row.y_px:g}, expected a place on the frame of "
                f"{width} x {height} pixels"
            )
        whole = window_about(row.x_px, row.y_px, field_reach_px(math.ceil(size_px), self._pitch_mrad))
        window = clipped(whole, values.shape)
        self._n_cut += window != whole
        return Placed(row.x_px, row.y_px, size_px, row.orientation, window, window)

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
