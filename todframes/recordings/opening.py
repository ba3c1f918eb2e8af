"""Opening of recordings: which reader a file needs, and which files make one recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, FrameError
from todframes.base.reading import check_time, path_inside, read_table, resolved
from todframes.frames.files import PICTURE_FORMATS, check_max_frame_mb, format_of
from todframes.parameters import MAX_FRAME_MB, PathLike
from todframes.recordings import arrays, cedip, images, radiometric, raw, video
from todframes.recordings.recording import (
    TIMES_FILE,
    Recording,
    StillReader,
    check_rate,
    files_in,
    natural_order,
    still_recording,
)

StillKind = Literal["image", "camera raw", "radiometric", "Cedip film", "array"]

Kind = StillKind | Literal["video"]

READERS: dict[StillKind, StillReader] = {
    "image": images,
    "camera raw": raw,
    "radiometric": radiometric,
    "Cedip film": cedip,
    "array": arrays,
}
"""Modules that read still frames, by kind of file."""

SEQUENCES: tuple[StillKind, ...] = ("image", "camera raw", "radiometric")
"""Kinds whose files are one recording together; each file of another kind is a recording by itself."""

EXPECTED = "expected an image, video, camera raw, radiometric (FLIR, Cedip) or NumPy file"


def paths_of(paths: PathLike | Sequence[PathLike]) -> list[Path]:
    """Return the paths of one or several."""
    is_one = isinstance(paths, str) or not isinstance(paths, Sequence)
    return [Path(paths)] if is_one else [Path(one) for one in paths]  # type: ignore[arg-type, union-attr]


def open_recordings(
    paths: PathLike | Sequence[PathLike],
    *,
    frames_per_second: float | None = None,
    max_frame_mb: int = MAX_FRAME_MB,
) -> tuple[Recording, ...]:
    """Open recordings: each video or array is one, all image files together are one, as are those of a folder.

    Parameters
    ----------
    paths : path or sequence of path
        Files and folders.
    frames_per_second : float, optional
        Frame rate in place of what the files say.
    max_frame_mb : int
        Largest size of a frame in 2**20 bytes: all channels in their own pixel types, at least 8 bytes a pixel.

    Returns
    -------
    tuple of Recording
        In the order of `paths`; a sequence of images stands where its first image stands. Frames of a sequence are
        in the natural order of their names: frame_9 before frame_10. A file `times.csv` in a folder of images has
        their times, in the columns `file` and `time_s`.

    Raises
    ------
    DataError, FrameError
        If there are no files, a folder is empty, files of several kinds are in a folder, files of one sequence
        differ in size, or a file cannot be read.
    SettingsError
        If the frame rate is not a positive number, or the limit no whole number > 0.
    """
    check_rate(frames_per_second)
    check_max_frame_mb(max_frame_mb)
    given = paths_of(paths)
    if not given:
        raise DataError("recordings: found no path, expected at least one")
    found: list[Recording] = []
    sequences: dict[StillKind, list[Path]] = {}
    kinds = {path: None if path.is_dir() else _kind(path) for path in given}
    for path, kind in kinds.items():
        if kind is not None and kind != "video" and kind in SEQUENCES:
            sequences.setdefault(kind, []).append(path)
    for path, kind in kinds.items():
        if kind is None:
            found += _folder(path, frames_per_second, max_frame_mb)
        elif kind in sequences:
            if path == sequences[kind][0]:
                found.append(_stills(kind, sequences[kind], None, frames_per_second, max_frame_mb))
        else:
            found.append(_single(path, kind, frames_per_second, max_frame_mb))
    return tuple(found)


def one_recording(
    source: PathLike | Sequence[PathLike] | NDArray[Any],
    where: str,
    *,
    frames_per_second: float | None = None,
    max_frame_mb: int = MAX_FRAME_MB,
) -> Recording:
    """Return the one recording of files, as `open_recordings` opens them, or that of an array in memory.

    Raises
    ------
    DataError
        If there are several, or the array is no recording; the message about several begins with `where`. Other
        errors are those of `open_recordings`.
    """
    if isinstance(source, np.ndarray):
        return arrays.memory_recording(source, frames_per_second=frames_per_second)
    found = open_recordings(source, frames_per_second=frames_per_second, max_frame_mb=max_frame_mb)
    if len(found) != 1:
        names = ", ".join(str(one.path) for one in found[:3])
        raise DataError(f"{where}: found {len(found)} recordings ({names} …), expected one")
    return found[0]


def _folder(folder: Path, frames_per_second: float | None, max_frame_mb: int) -> list[Recording]:
    """Return the one sequence of a folder, or each of its videos or arrays."""
    try:
        files = files_in(folder)
    except OSError as error:
        raise DataError(f"{folder}: cannot be read: {error.strerror}") from None
    if not files:
        raise DataError(f"{folder}: the folder is empty, expected recordings")
    kinds = {path: _kind(path) for path in files}
    first, times_file = kinds[files[0]], folder / TIMES_FILE
    for path, kind in kinds.items():
        if kind != first:
            raise DataError(
                f"{path}: found {kind}, expected {first} as {files[0].name}: a folder has files of one kind"
            )
    if first == "video" or first not in SEQUENCES:
        if times_file.is_file():
            raise DataError(f"{times_file}: found times beside {files[0].name}, expected them beside stills")
        return [_single(path, first, frames_per_second, max_frame_mb) for path in files]
    times_s = _times_s(times_file, files) if times_file.is_file() else None
    return [_stills(first, files, folder, frames_per_second, max_frame_mb, times_s)]


def _times_s(path: Path, files: Sequence[Path]) -> dict[str, float]:
    """Return the times of the stills beside a times.csv, by file name.

    Raises
    ------
    DataError
        If the file cannot be read, leads out of its folder, leaves a file out, names one twice or one that is not
        there, or a time is not later than that of the still before, in the natural order of names.
    """
    path_inside(resolved(path.parent), path.name, f"{path.parent}:")
    _, rows = read_table(path, ["file", "time_s"])
    times_s: dict[str, float] = {}
    names = {one.name for one in files}
    for row in rows:
        name = row.texts["file"].strip()
        if name not in names or name in times_s:
            what = "a second time" if name in times_s else f"but {path.parent} has no such file"
            raise DataError(f"{row.where}: file: found {name}, {what}, expected each of its files once")
        (time_s,) = row.numbers(["time_s"])
        times_s[name] = check_time(f"{row.where}: time_s", time_s)
    missing = next((one.name for one in files if one.name not in times_s), None)
    if missing is not None:
        raise DataError(f"{path}: found no time of {missing}, expected one of each file in the folder")
    for before, after in pairwise(one.name for one in natural_order(files)):
        if times_s[after] <= times_s[before]:
            raise DataError(
                f"{path}: found {times_s[before]:g} s for {before} and {times_s[after]:g} s for {after}, expected "
                "later times in the order of the names"
            )
    return times_s


def _kind(path: Path) -> Kind:
    """Return the kind of a file by its content, except for camera raw files, which can be TIFF by content."""
    try:
        if not path.is_file():
            raise FrameError(path, "found no file" if not path.exists() else "found a device, expected a file")
        with path.open("rb") as file:
            start = file.read(video.N_START)
    except OSError as error:
        raise FrameError(path, f"cannot be read: {error.strerror}") from None
    if path.suffix.lower() in raw.SUFFIXES:
        return "camera raw"
    if radiometric.is_radiometric(path, start):
        return "radiometric"
    if format_of(start) in PICTURE_FORMATS:
        return "image"
    if cedip.is_cedip(start):
        return "Cedip film"
    if arrays.is_array(start):
        return "array"
    if video.format_of(start) is not None:
        return "video"
    what = f"a file that starts with {start[:8]!r}" if start else "an empty file"
    raise FrameError(path, f"found {what}, {EXPECTED}")


def _single(path: Path, kind: Kind, frames_per_second: float | None, max_frame_mb: int) -> Recording:
    if kind == "video":
        return video.open_video(path, frames_per_second=frames_per_second, max_frame_mb=max_frame_mb)
    return _stills(kind, [path], None, frames_per_second, max_frame_mb)


def _stills(
    kind: StillKind,
    paths: Sequence[Path],
    folder: Path | None,
    frames_per_second: float | None,
    max_frame_mb: int,
    times_s: Mapping[str, float] | None = None,
) -> Recording:
    return still_recording(
        paths,
        READERS[kind],
        folder=folder,
        frames_per_second=frames_per_second,
        max_frame_mb=max_frame_mb,
        times_s=times_s,
    )
