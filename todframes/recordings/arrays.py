"""Reading of NumPy arrays: .npy, and .npz with one array, frame by frame and without pickles."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.errors import FrameError
from todframes.frames.files import MAX_DECODED_MB
from todframes.recordings.recording import StillHeader, check_size

NPY_START, ZIP_START = b"\x93NUMPY", b"PK\x03\x04"
"""First bytes of .npy files and of zip files, .npz among them."""


TYPES = ("uint8", "uint16", "int16", "float16", "float32", "float64")
"""Types of values that are read; all others have values that 32-bit floats cannot hold."""


class _Layout(NamedTuple):
    n_frames: int
    frame_shape: tuple[int, ...]
    dtype: np.dtype[Any]


def is_array(start: bytes) -> bool:
    """Tell whether a file that starts with these bytes is read here."""
    return start.startswith((NPY_START, ZIP_START))


def read_header(path: Path) -> StillHeader:
    """Return the shape, number of frames and scale of an array, (frames, rows, columns[, 3]) or (rows, columns).

    Raises
    ------
    FrameError
        If the file has no such array, or is shorter than its header says.
    """
    with _opened(path) as (_, layout):
        pass
    rows, columns = layout.frame_shape[:2]
    full_scale = float(np.iinfo(layout.dtype).max) if layout.dtype.kind == "u" else None
    return StillHeader((rows, columns), len(layout.frame_shape) == 3, layout.n_frames, full_scale)


def read_frames(path: Path) -> Iterator[NDArray[Any]]:
    """Yield the frames of an array: integers without sign as they are, other numbers as 32-bit floats.

    Raises
    ------
    FrameError
        If the file ends early, or a value is NaN or infinite.
    """
    with _opened(path) as (file, layout):
        size = math.prod(layout.frame_shape) * layout.dtype.itemsize
        for number in range(layout.n_frames):
            try:
                data = file.read(size)
            except (OSError, EOFError, zipfile.BadZipFile, RuntimeError) as error:
                raise FrameError(path, f"frame {number} cannot be read: {error}") from None
            if len(data) != size:
                raise FrameError(path, f"is truncated: {number} frames are good, expected {layout.n_frames}")
            stored = np.frombuffer(data, layout.dtype).reshape(layout.frame_shape)
            values = stored.astype(layout.dtype.newbyteorder("=") if layout.dtype.kind == "u" else np.float32)
            if not np.isfinite(values).all():
                raise FrameError(
                    path, f"frame {number}: {np.count_nonzero(~np.isfinite(values))} values are no numbers"
                )
            yield values


@contextmanager
def _opened(path: Path) -> Iterator[tuple[IO[bytes], _Layout]]:
    try:
        with path.open("rb") as file:
            if file.read(len(NPY_START)) == NPY_START:
                file.seek(0)
                yield file, _layout(path, file, path.stat().st_size)
                return
        with zipfile.ZipFile(path) as archive:
            members = [one for one in archive.infolist() if one.filename.endswith(".npy")]
            if len(members) != 1:
                names = ", ".join(one.filename.removesuffix(".npy") for one in members)[:200] or "none"
                raise FrameError(path, f"found arrays {names}, expected one")
            with archive.open(members[0]) as member:
                yield member, _layout(path, member, members[0].file_size)
    except (OSError, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise FrameError(path, f"cannot be read as a NumPy array: {error}") from None


def _layout(path: Path, file: IO[bytes], n_bytes: int) -> _Layout:
    """Read the header of an array, which decides how much is read, and check it against the size of the file."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    try:
        version = np.lib.format.read_magic(file)
        shape, is_fortran, dtype = readers[version](file)
    except (ValueError, KeyError, SyntaxError) as error:
        raise FrameError(
            path, f"the header of the array is damaged: {' '.join(str(error).split())[:200]}"
        ) from None
    if dtype.name not in TYPES:
        raise FrameError(path, f"found values of type {dtype}, expected one of {', '.join(TYPES)}")
    frame_shape = shape[1:] if len(shape) > 2 else shape
    if len(frame_shape) not in (2, 3) or frame_shape[2:] not in ((), (3,)) or math.prod(shape) < 1:
        raise FrameError(
            path, f"found an array of shape {shape}, expected (frames, rows, columns) and 3 if in colour"
        )
    if is_fortran and sum(one > 1 for one in shape) > 1:
        raise FrameError(path, "the array is in Fortran order; save numpy.ascontiguousarray(array)")
    check_size(path, (frame_shape[0], frame_shape[1]))
    if math.prod(frame_shape) * dtype.itemsize > MAX_DECODED_MB * 2**20:
        raise FrameError(path, f"a frame has more than {MAX_DECODED_MB} MB")
    n_frames = shape[0] if len(shape) > 2 else 1
    expected = n_frames * math.prod(frame_shape) * dtype.itemsize + file.tell()
    if n_bytes != expected:
        raise FrameError(
            path, f"found {n_bytes} bytes, expected {expected} for an array of shape {shape}: is it truncated?"
        )
    return _Layout(n_frames, frame_shape, dtype)
