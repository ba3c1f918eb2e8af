"""Opening of recordings: which reader a file needs, and which files make one recording."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, FrameError, SettingsError
from todframes.base.reading import check_time, path_inside, read_table
from todframes.base.user_code import in_words, registered
from todframes.frames.files import N_START, check_max_frame_mb, file_errors
from todframes.parameters import MAX_FRAME_MB, PathLike
from todframes.recordings.recording import (
    TIMES_FILE,
    Recording,
    RecordingReader,
    check_rate,
    files_in,
    natural_order,
    still_recording,
    with_bits,
    with_plane,
)

ENTRY_POINT_GROUP = "todframes.readers"
"""Entry-point group in which packages register readers of recordings."""

OWN_READERS = ("camera_raw", "radiometric", "image", "cedip", "array", "video")
"""Readers of this package in the order in which they are asked, after those of other packages: camera raw files
can be TIFF or MP4 by content, and a radiometric JPEG is a picture as well."""


class NoReaderError(FrameError):
    """Error for a file that no reader recognises."""


def _reader(name: str) -> RecordingReader:
    """Return a registered reader; SettingsError if it cannot be imported."""
    try:
        reader: RecordingReader = registered(ENTRY_POINT_GROUP)[name].load()
    except KeyError:
        raise SettingsError(f"reader {name}: is not registered; install todframes again") from None
    except Exception as error:  # whatever a package does when it is imported
        raise SettingsError(f"reader {name}: cannot be imported ({in_words(error)})") from None
    return reader


def paths_of(paths: PathLike | Sequence[PathLike]) -> list[Path]:
    """Return the paths of one or several."""
    is_one = isinstance(paths, str) or not isinstance(paths, Sequence)
    return [Path(paths)] if is_one else [Path(path) for path in paths]  # type: ignore[arg-type, union-attr]


def open_recordings(
    paths: PathLike | Sequence[PathLike],
    *,
    frames_per_second: float | None = None,
    max_frame_mb: int = MAX_FRAME_MB,
    is_whole: bool = False,
) -> tuple[Recording, ...]:
    """Open recordings: each video or array is one, all image files together are one, as are those of a folder. A
    sequence of images stands where its first image stands, its frames in the natural order of their names: frame_9
    before frame_10. A file `times.csv` in a folder of images has their times, in the columns `file` and `time_s`.
    A frame rate that is given replaces what the files say. `max_frame_mb` limits a frame in 2**20 bytes: all
    channels in their own pixel types, at least 8 bytes a pixel. With `is_whole`, camera raw files give their whole
    mosaic. Raises DataError or FrameError if there are no files, or one cannot be read or does not belong to the
    others.
    """
    check_rate(frames_per_second)
    check_max_frame_mb(max_frame_mb)
    given = paths_of(paths)
    if not given:
        raise DataError("recordings: found no path, expected at least one")
    opened = partial(_opened, is_whole=is_whole, frames_per_second=frames_per_second, max_frame_mb=max_frame_mb)
    recordings: list[Recording] = []
    kinds = {path: "folder" if path.is_dir() else _kind(path) for path in given}
    alike: dict[str, list[Path]] = defaultdict(list)
    for path, kind in kinds.items():
        alike[kind].append(path)
    for path, kind in kinds.items():
        if kind == "folder":
            recordings += _folder(path, opened)
        elif not _joins(kind):
            recordings.append(opened(kind, [path]))
        elif path == alike[kind][0]:
            recordings.append(opened(kind, alike[kind]))
    return tuple(recordings)


def one_recording(
    source: PathLike | Sequence[PathLike] | NDArray[np.generic],
    where: str,
    *,
    frames_per_second: float | None = None,
    bits: int | None = None,
    plane: tuple[int, int] | None = None,
    max_frame_mb: int = MAX_FRAME_MB,
) -> Recording:
    """Return the one recording of files, as `open_recordings` opens them, or that of an array in memory, with
    values of so many bits, or a colour plane of its mosaic. Raises DataError if there are several, with a message
    that begins with `where`, or the array is no recording.
    """
    if isinstance(source, np.ndarray):
        from todframes.recordings.arrays import memory_recording

        return with_plane(with_bits(memory_recording(source, frames_per_second=frames_per_second), bits), plane)
    recordings = open_recordings(
        source, frames_per_second=frames_per_second, max_frame_mb=max_frame_mb, is_whole=plane is not None
    )
    if len(recordings) != 1:
        names = ", ".join(str(recording.path) for recording in recordings[:3])
        raise DataError(f"{where}: found {len(recordings)} recordings ({names} …), expected one")
    return with_plane(with_bits(recordings[0], bits), plane)


def _folder(folder: Path, opened: Callable[..., Recording]) -> list[Recording]:
    """Return the one sequence of a folder, or each of its videos or arrays."""
    files = files_in(folder)
    if not files:
        raise DataError(f"{folder}: the folder is empty, expected recordings")
    kinds = {path: _kind(path) for path in files}
    first, times_file = kinds[files[0]], folder / TIMES_FILE
    for path, kind in kinds.items():
        if kind != first:
            raise DataError(
                f"{path}: found {kind}, expected {first} as {files[0].name}: a folder has files of one kind"
            )
    has_times = times_file.is_file()
    if _joins(first):
        times_s = _times_s(times_file, files) if has_times else None
        return [opened(first, files, folder, times_s)]
    if has_times:
        raise DataError(f"{times_file}: found times beside {files[0].name}, expected them beside stills")
    return [opened(first, [path]) for path in files]


def _times_s(path: Path, files: Sequence[Path]) -> dict[str, float]:
    """Return the times of the stills beside a times.csv, by file name. Raises DataError if the file cannot be read
    or leads out of its folder; if it has not each still once; or if a time is not later than that of the still
    before, in the natural order of names.
    """
    path_inside(os.path.realpath(path.parent), path.name, f"{path.parent}:")
    rows = list(read_table(path, ["file", "time_s"])[1])
    names, listed = [file.name for file in natural_order(files)], [row.texts["file"].strip() for row in rows]
    if wrong := (Counter(names) - Counter(listed)) + (Counter(listed) - Counter(names)):
        raise DataError(
            f"{path}: file: found {listed.count(min(wrong))} lines of {min(wrong)}, expected each still of "
            f"{path.parent} once, and no other"
        )
    times_s = {
        name: check_time(f"{row.where}: time_s", row.numbers(["time_s"])[0])
        for name, row in zip(listed, rows, strict=True)
    }
    for before, after in pairwise(names):
        if times_s[after] <= times_s[before]:
            raise DataError(
                f"{path}: found {times_s[before]:g} s for {before} and {times_s[after]:g} s for {after}, expected "
                "later times in the order of the names"
            )
    return times_s


def _kind(path: Path) -> str:
    """Return the name of the first reader that recognises a file."""
    with file_errors(path, "read"):
        if not path.is_file():
            raise FrameError(path, "found no file" if not path.exists() else "found a device, expected a file")
        with path.open("rb") as file:
            start = file.read(N_START)
        for name in (*sorted(registered(ENTRY_POINT_GROUP).keys() - OWN_READERS), *OWN_READERS):
            if _reader(name).recognises(path, start):
                return name
    what = f"a file that starts with {start[:8]!r}" if start else "an empty file"
    expected = "expected an image, video, camera raw, radiometric (FLIR, Cedip) or NumPy file"
    raise NoReaderError(path, f"found {what}, {expected}")


def _joins(kind: str) -> bool:
    """Return whether files of a kind are one recording together; otherwise each is one by itself."""
    return getattr(_reader(kind), "JOINS_FILES", False)


def _opened(
    kind: str,
    paths: Sequence[Path],
    folder: Path | None = None,
    times_s: Mapping[str, float] | None = None,
    *,
    is_whole: bool,
    **how: Any,
) -> Recording:
    """Return the recording of files of a kind; `how` has the frame rate and the limit of a frame."""
    reader = _reader(kind)
    if is_whole and kind == "camera_raw":
        from todframes.recordings.raw import Mosaic

        reader = Mosaic
    open_recording: Callable[..., Recording] | None = getattr(reader, "open_recording", None)
    if open_recording is not None:
        return open_recording(paths[0], **how)
    return still_recording(paths, reader, folder=folder, times_s=times_s, **how)
