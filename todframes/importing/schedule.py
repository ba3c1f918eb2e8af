"""Schedules: tables of what a recording shows when no chart with markers states it.

A schedule is a CSV file with a row for each trial:

    file,start_s,end_s,orientation,size_mrad,contrast
    clip_1.mkv,0.5,2.5,up,4.0,0.2
    clip_1.mkv,3.5,5.5,left,4.0,0.2

`size_mrad` is √(area) of the triangle at the camera, as in `chart.toml`; `size_px`, in its place or beside it, is
the size in pixels of the camera. Columns that this module does not know are kept as text.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from todframes.base.errors import DataError
from todframes.base.reading import check_columns, number, read_table, spelling_hint
from todframes.frames.dataset import orientation_in, pair_in, polarity_in
from todframes.stimulus import Orientation

SIZE_COLUMNS = ("size_mrad", "size_px")
"""Columns with the size of the triangle; a schedule has one of them, or both."""

SCHEDULE_COLUMNS = ("file", "start_s", "end_s", "orientation", *SIZE_COLUMNS, "x_px", "y_px", "polarity")
"""Columns of a schedule with a meaning of their own, beside the level."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduledTrial:
    """One row of a schedule: a part of a recording and the triangle that it shows.

    `where` is the schedule's path and the line, for messages. `file` is the recording as written, None: the only
    one there is. The part has 0 <= start_s < end_s, both None: all of the recording. `orientation` and the
    centroid, None if unknown, are those in the recorded frames. Sizes are √(area) > 0, in mrad at the camera or in
    its pixels; one of them is given. `level` is > 0. `polarity` is 1 for brighter and -1 for darker (thermal:
    warmer and colder) than the background. `other` are the remaining columns, as written.
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
    """Read and check a schedule, whose stimulus strength has the column `level`; return its rows, at least one.

    The columns `orientation`, a size and the level are needed. `file` is needed unless there is one recording.
    `start_s` and `end_s`, `x_px` and `y_px`, and `polarity` are optional, and may be empty in a row. Raises
    DataError if the file cannot be read, a column is missing, a value is wrong, or two rows use the same part of a
    file.
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
    by_name: dict[str | None, int] = {}
    for trial in trials:
        if trial.file not in by_name:
            by_name[trial.file] = _recording(trial, paths, real_paths, schedule.parent)
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
    if not set(SIZE_COLUMNS) & set(header):
        check_columns(header, ["size_mrad"], path)
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
            line = before.where.rpartition(", ")[2]
            if before.end_s is None or after.start_s is None:
                raise DataError(
                    f"{after.where}: the file is in {line}, too; expected start_s and end_s in both rows, "
                    "or one row"
                )
            if after.start_s < before.end_s:
                raise DataError(
                    f"{after.where}: begins at {after.start_s:g} s, but {line} ends at {before.end_s:g} s; "
                    "expected parts that do not overlap"
                )
