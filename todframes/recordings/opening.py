"""Opening of recordings: which reader a file needs, and which files make one recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from todframes.base.errors import DataError, FrameError
from todframes.frames.files import MAX_FRAME_MB, PathLike, check_max_frame_mb
from todframes.recordings import arrays, images, radiometric, raw, video
from todframes.recordings.recording import Recording, StillReader, check_rate, natural_order, still_recording

StillKind = Literal["image", "camera raw", "radiometric", "array"]


Kind = StillKind | Literal["video"]


READERS: dict[StillKind, StillReader] = {
    "image": images,
    "camera raw": raw,
    "radiometric": radiometric,
    "array": arrays,
}
"""Modules that read still frames, by kind of file."""


EXPECTED = "expected an image, video, camera raw, radiometric (FLIR) or NumPy file"


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
        in the natural order of their names: frame_9 before frame_10.

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
    is_one = isinstance(paths, str) or not isinstance(paths, Sequence)
    given = [Path(paths)] if is_one else [Path(one) for one in paths]  # type: ignore[arg-type, union-attr]
    if not given:
        raise DataError("recordings: found no path, expected at least one")
    found: list[Recording] = []
    sequences: dict[StillKind, list[Path]] = {}
    kinds = {path: None if path.is_dir() else _kind(path) for path in given}
    for path, kind in kinds.items():
        if kind in ("image", "camera raw", "radiometric"):
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


def _folder(folder: Path, frames_per_second: float | None, max_frame_mb: int) -> list[Recording]:
    """Return the one sequence of a folder, or each of its videos or arrays."""
    try:
        files = natural_order(one for one in folder.iterdir() if one.is_file() and not one.name.startswith("."))
    except OSError as error:
        raise DataError(f"{folder}: cannot be read: {error.strerror}") from None
    if not files:
        raise DataError(f"{folder}: the folder is empty, expected recordings")
    kinds = {path: _kind(path) for path in files}
    first = kinds[files[0]]
    for path, kind in kinds.items():
        if kind != first:
            raise DataError(
                f"{path}: found {kind}, expected {first} as {files[0].name}: a folder has files of one kind"
            )
    if first == "video" or first == "array":
        return [_single(path, first, frames_per_second, max_frame_mb) for path in files]
    return [_stills(first, files, folder, frames_per_second, max_frame_mb)]


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
    if images.format_of(start) is not None:
        return "image"
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
) -> Recording:
    return still_recording(
        paths, READERS[kind], folder=folder, frames_per_second=frames_per_second, max_frame_mb=max_frame_mb
    )
