"""Reading of radiometric thermal files of FLIR: detector counts, and temperatures by the file's own constants.

A FFF is one container; a SEQ is one container behind the other, one a frame. Places of the constants and of
the time: ExifTool's module FLIR.pm, table CameraInfo. The frame rate beside the time is the camera's, also where
the file has fewer frames, and is not used.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import FrameError
from todframes.frames.files import PNG_SIGNATURE, FrameFile, file_errors, format_of
from todframes.recordings.recording import Recording, StillHeader, check_size, files_in

CONTAINER_START = re.compile(rb"[FA]FF\0")
"""First bytes of FLIR's containers."""

JOINS_FILES = True

MOST_RECORDS = 1000
"""Number of records of a container that are looked at."""

BYTE_ORDERS: dict[bytes, Literal["<", ">"]] = {b"\2\0": "<", b"\0\2": ">"}
"""Byte orders of a record by its first two bytes, which are the number 2."""

RAW_DATA, CAMERA_INFO = 1, 32
"""Types of the records with the counts, and with the constants of the camera."""

TIME_AT = 0x384
"""Place of the time in the record of the camera: seconds since 1970, and milliseconds."""

ABSOLUTE_ZERO_CELSIUS = -273.15


class Radiometry(NamedTuple):
    """Constants that turn counts into temperatures: of the camera (Planck), and of the scene. counts = r1 / (r2
    (exp(b / T) − f)) − o for a black body of T kelvin. `emissivity` is that of the object, which reflects
    surroundings of `reflected_celsius`. The air between is taken as transparent.
    """

    r1: float
    r2: float
    b: float
    f: float
    o: float
    emissivity: float
    reflected_celsius: float

    def celsius(self, counts: ArrayLike) -> FloatArray:
        """Return the temperatures of objects with these counts, any shape; NaN where no temperature has them."""
        reflected = (1 - self.emissivity) * self.counts_of(self.reflected_celsius)
        radiance = np.subtract(counts, reflected) / self.emissivity + self.o
        with np.errstate(divide="ignore", invalid="ignore"):
            kelvin = self.b / np.log(self.r1 / (self.r2 * radiance) + self.f)
        return np.where(radiance > 0, kelvin + ABSOLUTE_ZERO_CELSIUS, np.nan)

    def counts_of(self, celsius: ArrayLike) -> FloatArray:
        """Return the counts of black bodies of these temperatures, any shape."""
        kelvin = np.asarray(celsius, np.float64) - ABSOLUTE_ZERO_CELSIUS
        return np.asarray(self.r1 / (self.r2 * (np.exp(self.b / kelvin) - self.f)) - self.o)


def recognises(path: Path, start: bytes) -> bool:
    """Return whether a file is FLIR's container, or a JPEG that has one in it."""
    if format_of(start) == "JPEG":
        with path.open("rb") as file:
            return bool(_container_parts(file.read(2**18)))
    return format_of(start) == "FLIR"


def read_header(path: Path, max_frame_mb: int) -> StillHeader:
    """Return the size of the counts of a file, its number of frames and their times. Raises FrameError if a
    container is damaged or too large, or two of a file differ in size.
    """
    with _opened(path) as data:
        containers = list(_containers(path, data))
        shapes = [_counts(path, data, container, max_frame_mb).shape for container in containers]
        times_s = [_time_s(data, container) for container in containers]
    for number, shape in enumerate(shapes):
        if shape != shapes[0]:
            found, expected = (f"{columns} x {rows} pixels" for rows, columns in (shape, shapes[0]))
            raise FrameError(path, f"frame {number}: found {found}, expected {expected} as in frame 0")
    known_s = tuple(time_s for time_s in times_s if time_s is not None)
    all_s = known_s if len(known_s) == len(shapes) else None
    return StillHeader(shapes[0], False, len(shapes), None, unit="counts", times_s=all_s)


def read_frames(path: Path, max_frame_mb: int) -> Iterator[NDArray[np.uint16]]:
    """Yield the counts of each frame of a file as the detector gave them. FrameError as for `read_header`, and if
    the counts are compressed in an unknown way.
    """
    with _opened(path) as data:
        for container in _containers(path, data):
            yield _values(path, data, container, max_frame_mb)


def read_radiometry(path: Path) -> Radiometry:
    """Return the constants that a file has for its temperatures; of a SEQ, those of its first frame. Raises
    FrameError if the file has none, or they are no constants of a camera.
    """
    with _opened(path) as data:
        begin, length = _record(path, next(_containers(path, data)), CAMERA_INFO, 0x310)
        record = data[begin : begin + length]
    order = _byte_order(path, record)
    emissivity, _, reflected_kelvin = struct.unpack_from(f"{order}3f", record, 0x20)
    r1, b, f = struct.unpack_from(f"{order}3f", record, 0x58)
    o, r2 = struct.unpack_from(f"{order}if", record, 0x308)
    if not (r1 > 0 and b > 0 and r2 > 0 and 0 < emissivity <= 1):
        raise FrameError(
            path, f"found R1 {r1}, B {b}, R2 {r2}, emissivity {emissivity}, expected positive numbers"
        )
    return Radiometry(r1, r2, b, f, o, emissivity, reflected_kelvin + ABSOLUTE_ZERO_CELSIUS)


def mk_per_count_of(recording: Recording, mean: float) -> float | None:
    """Return the mK of one count at the mean of a recording; None if it has no constants."""
    if recording.unit != "counts":
        return None
    path = recording.path
    if path.is_dir():
        path = files_in(path)[0]
    try:
        below, above = read_radiometry(path).celsius([mean - 0.5, mean + 0.5])
    except FrameError:
        return None
    return float(1000 * (above - below))


class _Container(NamedTuple):
    """One of FLIR's containers in a file: its number, and its records by type as (first byte, length)."""

    number: int
    records: dict[int, tuple[int, int]]


@contextmanager
def _opened(path: Path) -> Iterator[bytes | mmap]:
    """Yield the bytes of a file of containers, which stay on the disk, or of the container in a JPEG."""
    with file_errors(path, "read"), path.open("rb") as file:
        if format_of(file.read(16)) == "JPEG":
            file.seek(0)
            yield b"".join(_container_parts(file.read()))
        else:
            with mmap(file.fileno(), 0, access=ACCESS_READ) as data:
                yield data


def _containers(path: Path, data: bytes | mmap) -> Iterator[_Container]:
    """Yield the containers of a file, one behind the other: a FFF has one, a SEQ one a frame."""
    number, begin = 0, 0
    while True:
        header = data[begin : begin + 64]
        if len(header) < 64:
            raise FrameError(path, f"{_frame(number)}the header of the container is truncated")
        order = next(
            (order for order in "><" if 100 <= struct.unpack_from(f"{order}I", header, 20)[0] < 200), None
        )
        if order is None:
            raise FrameError(
                path, f"{_frame(number)}the version of the container is none of ours, expected 100 to 199"
            )
        first, n_records = struct.unpack_from(f"{order}2I", header, 24)
        table = data[begin + first : begin + first + 32 * min(n_records, MOST_RECORDS)]
        records: dict[int, tuple[int, int]] = {}
        for entry_at in range(0, len(table) - 31, 32):
            (kind,) = struct.unpack_from(f"{order}H", table, entry_at)
            at, length = struct.unpack_from(f"{order}2I", table, entry_at + 12)
            if kind in (RAW_DATA, CAMERA_INFO) and begin + at + length > len(data):
                record = f"record {entry_at // 32} of type {kind}"
                raise FrameError(path, f"{_frame(number)}{record} reaches beyond the file: truncated")
            if kind:
                records.setdefault(kind, (begin + at, length))
        yield _Container(number, records)
        end = max([begin + 64, *(at + length for at, length in records.values())])
        following = CONTAINER_START.search(data, end)
        if following is None:
            return
        number, begin = number + 1, following.start()


def _frame(number: int) -> str:
    """Return the start of a message about a container that is not the first; those before it are good."""
    return f"frame {number} (those before are good): " if number else ""


def _record(path: Path, container: _Container, kind: int, smallest: int) -> tuple[int, int]:
    """Return where a record begins, and its length. FrameError if there is none of at least the smallest size."""
    record = container.records.get(kind)
    if record is None or record[1] < smallest:
        found = f"has {record[1]} bytes, expected {smallest} or more" if record else "is missing, expected one"
        raise FrameError(path, f"{_frame(container.number)}the record of type {kind} {found}")
    return record


class _Counts(NamedTuple):
    """The place of the counts of a container, (first byte, bytes), their shape, and the order of their bytes."""

    begin: int
    length: int
    shape: tuple[int, int]
    order: Literal["<", ">"]


def _counts(path: Path, data: bytes | mmap, container: _Container, max_frame_mb: int) -> _Counts:
    """Return what the headers say of the counts of a container."""
    begin, length = _record(path, container, RAW_DATA, 32)
    order = _byte_order(path, data[begin : begin + 2])
    columns, rows = struct.unpack_from(f"{order}2H", data, begin + 2)
    check_size(path, (rows, columns), max_frame_mb)
    return _Counts(begin + 32, length - 32, (rows, columns), order)


def _values(path: Path, data: bytes | mmap, container: _Container, max_frame_mb: int) -> NDArray[np.uint16]:
    """Return the counts of a container, plain or compressed as PNG."""
    counts, frame = _counts(path, data, container, max_frame_mb), _frame(container.number)
    rows, columns = counts.shape
    stored = data[counts.begin : counts.begin + counts.length]
    if stored.startswith(PNG_SIGNATURE):
        try:
            with FrameFile(path, content=stored, max_frame_mb=max_frame_mb) as image:
                values = image.read().stored
        except FrameError as error:
            raise FrameError(path, f"{frame}{error.problem}") from None
        if values.shape != (rows, columns, 1) or values.dtype != np.uint16:
            found = f"{values.shape[1]} x {values.shape[0]} pixels, {values.dtype}"
            raise FrameError(path, f"{frame}its counts are a PNG of {found}, expected {columns} x {rows}, uint16")
        return _in_order(values[..., 0])
    if counts.length < 2 * rows * columns:
        raise FrameError(
            path,
            f"{frame}found {counts.length} bytes of counts, expected {2 * rows * columns}: truncated, or "
            "compressed in another way than PNG, as CSQ is; record SEQ or FFF",
        )
    plain = np.frombuffer(stored, f"{counts.order}u2", rows * columns)
    return plain.reshape(counts.shape).astype(np.uint16)


def _in_order(counts: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the counts of a PNG with their two bytes in the order in which the picture is smoother. Most of
    FLIR's cameras write the low byte first, against the PNG standard, and nothing in the file says so.
    """
    other = counts.byteswap()
    as_stored, swapped = (np.abs(np.diff(order.astype(np.int32))).sum() for order in (counts, other))
    return counts.copy() if as_stored < swapped else other


def _time_s(data: bytes | mmap, container: _Container) -> float | None:
    """Return the moment of a frame in seconds since 1970; None if the container does not have it."""
    begin, length = container.records.get(CAMERA_INFO, (0, 0))
    record = data[begin : begin + TIME_AT + 8]
    order = BYTE_ORDERS.get(record[:2])
    if length < TIME_AT + 8 or len(record) < TIME_AT + 8 or order is None:
        return None
    seconds, milliseconds = struct.unpack_from(f"{order}2I", record, TIME_AT)
    return float(seconds) + milliseconds / 1000 if seconds and milliseconds < 1000 else None


def _byte_order(path: Path, record: bytes) -> Literal["<", ">"]:
    order = BYTE_ORDERS.get(record[:2])
    if order is None:
        raise FrameError(path, f"a record starts with {record[:2]!r}, expected 2 as a number of two bytes")
    return order


def _container_parts(jpeg: bytes) -> list[bytes]:
    """Return the parts of the container in the APP1 segments of a JPEG, in their order."""
    parts: dict[int, bytes] = {}
    at = 2
    while (
        marker := re.compile(rb"\xff([\xe0-\xef\xc0\xc2\xc4\xdb\xdd\xfe])(..)", re.DOTALL).match(jpeg, at)
    ) is not None:
        length = int.from_bytes(marker[2], "big")
        segment = jpeg[at + 4 : at + 2 + length]
        if marker[1] == b"\xe1" and segment.startswith(b"FLIR\0") and len(segment) > 8:
            parts[segment[6]] = segment[8:]
        at += 2 + length
    return [parts[number] for number in sorted(parts)]
