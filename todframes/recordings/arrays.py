"""Reading of NumPy arrays: .npy frame by frame, .npz with one array whole, and arrays in memory; no pickles."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import FrameError
from todframes.frames.files import check_decoded_size, format_of
from todframes.recordings.recording import RecordedFrame, Recording, check_rate, check_size

TYPES = ("uint8", "uint16", "int16", "float16", "float32", "float64")
"""Types of values that are read; all others have values that 32-bit floats cannot hold."""

MOST_NPZ_MB = 4096
"""Largest size of the array in a .npz, which is held whole, in units of 2**20 bytes: a small file may inflate."""


def recognises(path: Path, start: bytes) -> bool:  # noqa: ARG001 - other readers need the path
    """Return whether a file is .npy, or a zip file as .npz is, by its first bytes."""
    return format_of(start) in ("NumPy", "zip")


def open_recording(path: Path, *, frames_per_second: float | None, max_frame_mb: int) -> Recording:
    """Open an array, (frames, rows, columns[, 3]) or (rows, columns). Raises FrameError if the file has no such
    array or is truncated, or a frame is too large.
    """
    values = _loaded(path)
    recording = memory_recording(values, frames_per_second=frames_per_second, path=path)
    check_size(path, recording.shape, max_frame_mb)
    n_channels = 3 if recording.is_colour else 1
    check_decoded_size(path, math.prod(recording.shape) * n_channels * values.dtype.itemsize, max_frame_mb)
    return recording


def memory_recording(
    values: NDArray[Any], *, frames_per_second: float | None, path: Path = Path("array")
) -> Recording:
    """Return the recording of an array: integers without sign as they are, other numbers as 32-bit floats. Raises
    FrameError if its shape or type is another; its frames do where a value is NaN or infinite.
    """
    if values.dtype.name not in TYPES:
        raise FrameError(path, f"found values of type {values.dtype}, expected one of {', '.join(TYPES)}")
    frames = values if values.ndim > 2 else values[np.newaxis]
    if frames.ndim not in (3, 4) or frames.shape[3:] not in ((), (3,)) or not values.size:
        expected = "expected (frames, rows, columns) and 3 if in colour"
        raise FrameError(path, f"found an array of shape {values.shape}, {expected}")
    is_code = values.dtype.kind == "u"
    rate, white = check_rate(frames_per_second), float(np.iinfo(values.dtype).max) if is_code else None
    dtype = values.dtype.newbyteorder("=") if is_code else np.dtype(np.float32)

    def read() -> Iterator[RecordedFrame]:
        for number, stored in enumerate(frames):
            frame = np.array(stored, dtype)
            if not np.isfinite(frame).all():
                n_bad = np.count_nonzero(~np.isfinite(frame))
                raise FrameError(path, f"frame {number}: {n_bad} values are no numbers")
            yield RecordedFrame(frame, None if rate is None else number / rate, f"frame {number}")

    return Recording(
        path=path,
        shape=(frames.shape[1], frames.shape[2]),
        is_colour=frames.ndim == 4,
        n_frames=len(frames),
        frames_per_second=rate,
        full_scale=white,
        ends=None if white is None else (0.0, white),
        read=read,
    )


def _loaded(path: Path) -> NDArray[Any]:
    """Return the array of a file: of .npy it stays on the disk until it is used."""
    try:
        with path.open("rb") as file:
            if format_of(file.read(16)) == "NumPy":
                loaded = np.load(path, mmap_mode="r")
                if path.stat().st_size != loaded.offset + loaded.nbytes:
                    raise ValueError(f"the file is longer than an array of shape {loaded.shape}")
                return np.asarray(loaded)
            file.seek(0)
            with np.load(file) as archive:
                if len(archive.files) != 1:
                    names = ", ".join(archive.files)[:200] or "none"
                    raise FrameError(path, f"found arrays {names}, expected one")
                if archive.zip.infolist()[0].file_size > MOST_NPZ_MB * 2**20:
                    raise FrameError(path, f"its array has more than {MOST_NPZ_MB} MB; save it as .npy")
                return np.asarray(archive[archive.files[0]])
    except FrameError:
        raise
    except Exception as error:  # NumPy and zipfile raise a dozen kinds for damaged files
        reason = " ".join(str(error).split())[:200]
        raise FrameError(path, f"cannot be read as a NumPy array: {reason}; is it damaged or truncated?") from None
