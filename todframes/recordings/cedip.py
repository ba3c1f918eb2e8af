"""Reading of films of Cedip's and FLIR's thermal cameras (.ptw): detector counts, and the time of each frame.

Places in the headers: pyradi (BSD), after the Altair Reference Guide. The header's period of acquisition is not
used: cameras that keep every third frame write the period of all.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import FrameError
from todframes.frames.files import file_errors, format_of
from todframes.recordings.recording import StillHeader, check_size

N_HEADER, N_CLOCK = 2106, 161
"""Number of bytes of the main header that are read, and of a frame's header that the clock is in."""

DAY_S = 86400.0


class _FilmLayout(NamedTuple):
    """Layout of a film: bytes of the main header, a frame's header and both it and its frame; frames; shape."""

    n_header: int
    n_frame_header: int
    n_step: int
    n_frames: int
    shape: tuple[int, int]


def recognises(path: Path, start: bytes) -> bool:  # noqa: ARG001 - other readers need the path
    """Return whether a file is a film of this kind by its first bytes."""
    return format_of(start) == "Cedip film"


def read_header(path: Path, max_frame_mb: int) -> StillHeader:
    """Return the size of the frames of a film, their number and their times. Raises FrameError if the film is
    truncated, its frames are too large, its headers contradict each other, or its values are other than counts of
    16 bits.
    """
    with file_errors(path, "read"), path.open("rb") as file:
        layout = _layout(path, file, max_frame_mb)
        times_s = _times_s(file, layout)
    return StillHeader(layout.shape, False, layout.n_frames, None, unit="counts", times_s=times_s)


def read_frames(path: Path, max_frame_mb: int) -> Iterator[NDArray[np.uint16]]:
    """Yield the counts of each frame as the detector gave them. FrameError as for `read_header`."""
    with file_errors(path, "read"), path.open("rb") as file:
        layout = _layout(path, file, max_frame_mb)
        rows, columns = layout.shape
        for number in range(layout.n_frames):
            file.seek(layout.n_header + number * layout.n_step + layout.n_frame_header)
            data = file.read(2 * rows * columns)
            yield np.frombuffer(data, "<u2").reshape(rows, columns).astype(np.uint16)


def _layout(path: Path, file: BinaryIO, max_frame_mb: int) -> _FilmLayout:
    """Return the layout that the main header gives, if all of it lies in the file."""
    header = file.read(N_HEADER)
    if len(header) < N_HEADER:
        raise FrameError(path, f"the main header has {len(header)} bytes, expected {N_HEADER} or more: truncated")
    n_header, n_frame_header, n_words = struct.unpack_from("<3I", header, 11)
    (n_frames,) = struct.unpack_from("<I", header, 27)
    columns, rows = struct.unpack_from("<2H", header, 377)
    check_size(path, (rows, columns), max_frame_mb)
    (scale,) = struct.unpack_from("<H", header, 277)
    if scale or header[2105]:
        raise FrameError(path, "its values are scaled or in double precision, expected counts of 16 bits")
    if n_header < N_HEADER or n_frames < 1 or 2 * n_words != n_frame_header + 2 * rows * columns:
        found = f"a main header of {n_header} bytes, and {n_frames} frames of {2 * n_words}"
        expected = f"{N_HEADER} or more, and 1 or more of {n_frame_header + 2 * rows * columns}"
        raise FrameError(path, f"found {found}, expected {expected}")
    n_bytes = file.seek(0, 2)
    n_there = max(n_bytes - n_header, 0) // (2 * n_words)
    if n_there != n_frames:
        ended = "truncated" if n_there < n_frames else "was its recording interrupted?"
        raise FrameError(path, f"found {n_there} whole frames, expected the {n_frames} of its header: {ended}")
    return _FilmLayout(n_header, n_frame_header, 2 * n_words, n_frames, (rows, columns))


def _times_s(file: BinaryIO, layout: _FilmLayout) -> tuple[float, ...] | None:
    """Return the times of day of the frames, across midnight; None if they have none."""
    if layout.n_frame_header < N_CLOCK:
        return None
    times_s: list[float] = []
    n_days, before_s = 0, 0.0
    for number in range(layout.n_frames):
        file.seek(layout.n_header + number * layout.n_step)
        header = file.read(N_CLOCK)
        minute, hour, hundredths, second = header[80:84]
        if hour > 23 or minute > 59 or second > 59 or hundredths > 99 or header[160] > 9:
            return None
        time_s = 3600.0 * hour + 60.0 * minute + second + hundredths / 100 + header[160] / 1000
        n_days += time_s < before_s - DAY_S / 2
        before_s = time_s
        times_s.append(n_days * DAY_S + time_s)
    return tuple(times_s) if any(times_s) else None
