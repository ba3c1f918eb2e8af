"""Reading of NumPy arrays: .npy, and .npz with one array, frame by frame and without pickles."""

from __future__ import annotations

import io
import math
import struct
import tokenize
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, FrameError
from todframes.frames.files import check_decoded_size, format_of
from todframes.recordings.recording import RecordedFrame, Recording, StillHeader, check_rate, check_size

TYPES = ("uint8", "uint16", "int16", "float16", "float32", "float64")
"""Types of values that are read; all others have values that 32-bit floats cannot hold."""

LONGEST_HEADER = 2**16 - 1
"""Largest number of bytes in the header of an array; versions 2 and 3 of the format could claim 4 GB."""

DAMAGE = (OSError, EOFError, ValueError, OverflowError, RuntimeError, struct.error, zlib.error, zipfile.BadZipFile)
"""Errors of `zipfile` for damaged files, and for those that it cannot read."""


class _Layout(NamedTuple):
    n_frames: int
    frame_shape: tuple[int, ...]
    dtype: np.dtype[Any]


def recognises(path: Path, start: bytes) -> bool:  # noqa: ARG001 - other readers need the path
    """Return whether a file is .npy, or a zip file as .npz is, by its first bytes."""
    return format_of(start) in ("NumPy", "zip")


def read_header(path: Path, max_frame_mb: int) -> StillHeader:
    """Return the shape, number of frames and scale of an array, (frames, rows, columns[, 3]) or (rows, columns).
    Raises FrameError if the file has no such array, is shorter than its header says, or a frame is too large.
    """
    with _opened(path, max_frame_mb) as (_, layout):
        pass
    rows, columns = layout.frame_shape[:2]
    full_scale = float(np.iinfo(layout.dtype).max) if layout.dtype.kind == "u" else None
    return StillHeader((rows, columns), len(layout.frame_shape) == 3, layout.n_frames, full_scale)


def read_frames(path: Path, max_frame_mb: int) -> Iterator[NDArray[Any]]:
    """Yield the frames of an array: integers without sign as they are, other numbers as 32-bit floats. Raises
    FrameError if the file ends early, or a value is NaN or infinite.
    """
    with _opened(path, max_frame_mb) as (file, layout):
        size = math.prod(layout.frame_shape) * layout.dtype.itemsize
        for number in range(layout.n_frames):
            try:
                data = file.read(size)
            except DAMAGE as error:
                raise FrameError(path, f"frame {number} cannot be read: {error}; is the file damaged?") from None
            if len(data) != size:
                raise FrameError(path, f"is truncated: {number} frames are good, expected {layout.n_frames}")
            stored = np.frombuffer(data, layout.dtype).reshape(layout.frame_shape)
            values = stored.astype(layout.dtype.newbyteorder("=") if layout.dtype.kind == "u" else np.float32)
            if not np.isfinite(values).all():
                raise FrameError(
                    path, f"frame {number}: {np.count_nonzero(~np.isfinite(values))} values are no numbers"
                )
            yield values


def memory_recording(values: NDArray[Any], *, frames_per_second: float | None) -> Recording:
    """Return the recording of an array in memory; shapes and types are those of files. Raises DataError if the
    shape or type is another, or a value is NaN or infinite.
    """
    where = "recording: an array"
    frame_shape = _frame_shape(values.shape, values.dtype, lambda problem: DataError(f"{where}: {problem}"))
    frames = values.reshape(-1, *frame_shape)
    is_code = values.dtype.kind == "u"
    frames = frames if is_code else frames.astype(np.float32)
    if not is_code and not np.isfinite(frames).all():
        raise DataError(f"{where}: {np.count_nonzero(~np.isfinite(frames))} values are no numbers")
    rate, white = check_rate(frames_per_second), float(np.iinfo(values.dtype).max) if is_code else None

    def read() -> Iterator[RecordedFrame]:
        for number, frame in enumerate(frames):
            yield RecordedFrame(frame, None if rate is None else number / rate, f"frame {number}")

    return Recording(
        path=Path("array"),
        shape=(frames.shape[1], frames.shape[2]),
        is_colour=frames.ndim == 4,
        n_frames=len(frames),
        frames_per_second=rate,
        full_scale=white,
        ends=None if white is None else (0.0, white),
        read=read,
    )


@contextmanager
def _opened(path: Path, max_frame_mb: int) -> Iterator[tuple[IO[bytes], _Layout]]:
    try:
        with path.open("rb") as file:
            if format_of(file.read(16)) == "NumPy":
                file.seek(0)
                yield file, _layout(path, file, path.stat().st_size, max_frame_mb)
                return
        with zipfile.ZipFile(path) as archive:
            members = [member for member in archive.infolist() if member.filename.endswith(".npy")]
            if len(members) != 1:
                names = ", ".join(member.filename.removesuffix(".npy") for member in members)[:200] or "none"
                raise FrameError(path, f"found arrays {names}, expected one")
            (array,) = members
            if array.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                found = f"the array is compressed by method {array.compress_type} of zip files"
                raise FrameError(path, f"{found}, expected that of numpy.savez_compressed or none")
            with archive.open(array) as member:
                yield member, _layout(path, member, array.file_size, max_frame_mb)
    except FrameError:
        raise
    except DAMAGE as error:
        raise FrameError(path, f"cannot be read as a NumPy array: {error}") from None


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Read the header of an array: its shape, whether it is in Fortran order, and its type."""
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0), (3, 0)):
        raise ValueError(f"found version {version} of the format, expected 1.0, 2.0 or 3.0")
    start = file.read(2 if version == (1, 0) else 4)
    length = int.from_bytes(start, "little")
    if length > LONGEST_HEADER:
        raise ValueError(f"found a header of {length} bytes, expected at most {LONGEST_HEADER}")
    # Version 3 is version 2 with names of fields in UTF-8, and arrays with fields are not read.
    is_1 = version == (1, 0)
    read = np.lib.format.read_array_header_1_0 if is_1 else np.lib.format.read_array_header_2_0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return read(io.BytesIO(start + file.read(length)))


def _frame_shape(
    shape: tuple[int, ...], dtype: np.dtype[Any], error: Callable[[str], DataError]
) -> tuple[int, ...]:
    """Return the shape of a frame of an array; raise an error if it is no recording."""
    if dtype.name not in TYPES:
        raise error(f"found values of type {dtype}, expected one of {', '.join(TYPES)}")
    frame_shape = shape[1:] if len(shape) > 2 else shape
    if len(frame_shape) not in (2, 3) or frame_shape[2:] not in ((), (3,)) or math.prod(shape) < 1:
        raise error(f"found an array of shape {shape}, expected (frames, rows, columns) and 3 if in colour")
    return frame_shape


def _layout(path: Path, file: IO[bytes], n_bytes: int, max_frame_mb: int) -> _Layout:
    """Read the header of an array, which decides how much is read, and check it against the size of the file."""
    try:
        shape, is_fortran, dtype = _header(file)
    except (*DAMAGE, SyntaxError, TypeError, MemoryError, tokenize.TokenError, Warning) as error:
        raise FrameError(
            path, f"the header of the array is damaged: {' '.join(str(error).split())[:200]}"
        ) from None
    frame_shape = _frame_shape(shape, dtype, partial(FrameError, path))
    if is_fortran and sum(side > 1 for side in shape) > 1:
        raise FrameError(path, "the array is in Fortran order; save numpy.ascontiguousarray(array)")
    check_size(path, (frame_shape[0], frame_shape[1]), max_frame_mb)
    check_decoded_size(path, math.prod(frame_shape) * dtype.itemsize, max_frame_mb)
    n_frames = shape[0] if len(shape) > 2 else 1
    expected = n_frames * math.prod(frame_shape) * dtype.itemsize + file.tell()
    if n_bytes != expected:
        raise FrameError(
            path, f"found {n_bytes} bytes, expected {expected} for an array of shape {shape}: is it truncated?"
        )
    return _Layout(n_frames, frame_shape, dtype)
