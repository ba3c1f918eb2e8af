"""Reading of radiometric thermal files of FLIR: detector counts, and temperatures by the file's own constants.

A FFF is one container; a SEQ is one container behind the other, one a frame. Places of the constants: ExifTool's
module FLIR.pm, table CameraInfo.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import FrameError
from todframes.recordings.recording import Recording, StillHeader, check_size, natural_order

FFF_START, JPEG_START = (b"FFF\0", b"AFF\0"), b"\xff\xd8\xff"
"""First bytes of FLIR's containers, and of JPEG files, which may contain one."""


MAX_JPEG_MB = 256
"""Largest size of a radiometric JPEG, in 2**20 bytes."""


MOST_RECORDS = 1000
"""Number of records of a container that are looked at."""


COMPRESSED = {b"\x89PNG\r\n\x1a\n": "PNG", b"\xff\xd8\xff\xf7": "JPEG-LS (CSQ)"}
"""First bytes of counts that are compressed, and the names of the compressions."""


RAW_DATA, CAMERA_INFO = 1, 32
"""Types of the records with the counts, and with the constants of the camera."""


ABSOLUTE_ZERO_CELSIUS = -273.15


@dataclass(frozen=True, slots=True)
class Radiometry:
    """Constants that turn counts into temperatures: of the camera (Planck), and of the scene.

    counts = r1 / (r2 (exp(b / T) − f)) − o for a black body of T kelvin. `emissivity` is that of the object, which
    reflects surroundings of `reflected_celsius`. The air between is taken as transparent.
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
        counts = np.asarray(counts, np.float64)
        reflected = (1 - self.emissivity) * self.counts_of(self.reflected_celsius)
        radiance = (counts - reflected) / self.emissivity + self.o
        with np.errstate(divide="ignore", invalid="ignore"):
            kelvin = self.b / np.log(self.r1 / (self.r2 * radiance) + self.f)
        return np.where(radiance > 0, kelvin + ABSOLUTE_ZERO_CELSIUS, np.nan)

    def counts_of(self, celsius: ArrayLike) -> FloatArray:
        """Return the counts of black bodies of these temperatures, any shape."""
        kelvin = np.asarray(celsius, np.float64) - ABSOLUTE_ZERO_CELSIUS
        return np.asarray(self.r1 / (self.r2 * (np.exp(self.b / kelvin) - self.f)) - self.o)


def is_radiometric(path: Path, start: bytes) -> bool:
    """Tell whether a file is FLIR's container, or a JPEG that has one in it."""
    if start.startswith(JPEG_START):
        with path.open("rb") as file:
            return bool(_container_parts(file.read(2**18)))
    return start.startswith(FFF_START)


def read_header(path: Path, max_frame_mb: int) -> StillHeader:
    """Return the size of the counts of a file, and its number of frames.

    Raises
    ------
    FrameError
        If a container is damaged or too large, its counts are compressed, or two of a file differ in size.
    """
    with _opened(path) as file:
        shapes = [_shape(path, file, one, max_frame_mb)[1] for one in _containers(path, file)]
    for number, shape in enumerate(shapes):
        if shape != shapes[0]:
            found, expected = (f"{columns} x {rows} pixels" for rows, columns in (shape, shapes[0]))
            raise FrameError(path, f"frame {number}: found {found}, expected {expected} as in frame 0")
    return StillHeader(shapes[0], False, len(shapes), None, unit="counts")


def read_frames(path: Path, max_frame_mb: int) -> Iterator[NDArray[np.uint16]]:
    """Yield the counts of each frame of a file as the detector gave them. FrameError as for `read_header`."""
    with _opened(path) as file:
        for container in _containers(path, file):
            begin, (rows, columns), order = _shape(path, file, container, max_frame_mb)
            data = _bytes_at(file, begin, 2 * rows * columns)
            if len(data) < 2 * rows * columns:
                raise FrameError(path, f"{_frame(container.number)}the counts are truncated")
            yield np.frombuffer(data, f"{order}u2").reshape(rows, columns).astype(np.uint16)


def read_radiometry(path: Path) -> Radiometry:
    """Return the constants that a file has for its temperatures; of a SEQ, those of its first frame.

    Raises
    ------
    FrameError
        If the file has none, or they are no constants of a camera.
    """
    with _opened(path) as file:
        begin, length = _record(path, next(_containers(path, file)), CAMERA_INFO, 0x310)
        record = _bytes_at(file, begin, length)
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
        path = natural_order(one for one in path.iterdir() if one.is_file() and not one.name.startswith("."))[0]
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
def _opened(path: Path) -> Iterator[BinaryIO]:
    """Open a file of containers, or the container in a JPEG."""
    try:
        with path.open("rb") as file:
            if file.read(len(JPEG_START)) != JPEG_START:
                yield file
            elif path.stat().st_size > MAX_JPEG_MB * 2**20:
                raise FrameError(path, f"has more than {MAX_JPEG_MB} MB, expected one JPEG")
            else:
                file.seek(0)
                yield io.BytesIO(b"".join(_container_parts(file.read())))
    except OSError as error:
        raise FrameError(path, f"cannot be read: {error.strerror}") from None


def _containers(path: Path, file: BinaryIO) -> Iterator[_Container]:
    """Yield the containers of a file, one behind the other: a FFF has one, a SEQ one a frame."""
    n_bytes = file.seek(0, io.SEEK_END)
    begin: int | None = 0
    number = 0
    while begin is not None:
        header = _bytes_at(file, begin, 64)
        if len(header) < 64:
            raise FrameError(path, f"{_frame(number)}the header of the container is truncated")
        order = next((one for one in "><" if 100 <= struct.unpack_from(f"{one}I", header, 20)[0] < 200), None)
        if order is None:
            raise FrameError(
                path, f"{_frame(number)}the version of the container is none of ours, expected 100 to 199"
            )
        first, n_records = struct.unpack_from(f"{order}2I", header, 24)
        table = _bytes_at(file, begin + first, 32 * min(n_records, MOST_RECORDS))
        records: dict[int, tuple[int, int]] = {}
        for place in range(0, len(table) - 31, 32):
            (kind,) = struct.unpack_from(f"{order}H", table, place)
            at, length = struct.unpack_from(f"{order}2I", table, place + 12)
            if kind in (RAW_DATA, CAMERA_INFO) and begin + at + length > n_bytes:
                record = f"record {place // 32} of type {kind}"
                raise FrameError(path, f"{_frame(number)}{record} reaches beyond the file: truncated")
            if kind:
                records.setdefault(kind, (begin + at, length))
        yield _Container(number, records)
        begin = _next_container(file, max([begin + 64, *(at + length for at, length in records.values())]))
        number += 1


def _next_container(file: BinaryIO, place: int) -> int | None:
    """Return where the next container begins, from a place on; None if there is none."""
    overlap = len(FFF_START[0]) - 1
    while chunk := _bytes_at(file, place, 2**16):
        found = [at for start in FFF_START if (at := chunk.find(start)) >= 0]
        if found:
            return place + min(found)
        if len(chunk) <= overlap:
            break
        place += len(chunk) - overlap
    return None


def _bytes_at(file: BinaryIO, place: int, length: int) -> bytes:
    file.seek(place)
    return file.read(length)


def _frame(number: int) -> str:
    """Return the start of a message about a container that is not the first; those before it are good."""
    return f"frame {number} (those before are good): " if number else ""


def _record(path: Path, container: _Container, kind: int, smallest: int) -> tuple[int, int]:
    """Return where a record begins, and its length. FrameError if there is none of at least the smallest size."""
    begin, length = container.records.get(kind, (0, -1))
    if length < 0:
        raise FrameError(
            path, f"{_frame(container.number)}the container has no record of type {kind}, expected one"
        )
    if length < smallest:
        raise FrameError(
            path,
            f"{_frame(container.number)}the record of type {kind} has {length} bytes, expected {smallest} or more",
        )
    return begin, length


def _shape(
    path: Path, file: BinaryIO, container: _Container, max_frame_mb: int
) -> tuple[int, tuple[int, int], str]:
    """Return where the counts of a container begin, their rows and columns, and their byte order."""
    begin, length = _record(path, container, RAW_DATA, 32)
    start = _bytes_at(file, begin, 40)
    order = _byte_order(path, start)
    columns, rows = struct.unpack_from(f"{order}2H", start, 2)
    check_size(path, (rows, columns), max_frame_mb)
    for pattern, name in COMPRESSED.items():
        if start[32:].startswith(pattern):
            raise FrameError(path, f"its counts are compressed as {name}, expected plain ones; export 16-bit TIFF")
    if length < 32 + 2 * rows * columns:
        found = f"found {length - 32} bytes of counts, expected {2 * rows * columns}"
        raise FrameError(path, f"{_frame(container.number)}{found}: truncated")
    return begin + 32, (rows, columns), order


def _byte_order(path: Path, record: bytes) -> str:
    order = {b"\2\0": "<", b"\0\2": ">"}.get(record[:2])
    if order is None:
        raise FrameError(path, f"a record starts with {record[:2]!r}, expected 2 as a number of two bytes")
    return order


def _container_parts(jpeg: bytes) -> list[bytes]:
    """Return the parts of the container in the APP1 segments of a JPEG, in their order."""
    parts: dict[int, bytes] = {}
    place = 2
    while (
        marker := re.compile(rb"\xff([\xe0-\xef\xc0\xc2\xc4\xdb\xdd\xfe])(..)", re.DOTALL).match(jpeg, place)
    ) is not None:
        length = int.from_bytes(marker[2], "big")
        segment = jpeg[place + 4 : place + 2 + length]
        if marker[1] == b"\xe1" and segment.startswith(b"FLIR\0") and len(segment) > 8:
            parts[segment[6]] = segment[8:]
        place += 2 + length
    return [parts[number] for number in sorted(parts)]
