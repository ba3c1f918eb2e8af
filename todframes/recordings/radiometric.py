"""Reading of radiometric thermal files of FLIR: detector counts, and temperatures by the file's own constants."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes._typing import FloatArray
from todframes.errors import FrameError
from todframes.recordings.recording import Recording, StillHeader, check_size, natural_order

FFF_START, JPEG_START = (b"FFF\0", b"AFF\0"), b"\xff\xd8\xff"
"""First bytes of FLIR's containers, and of JPEG files, which may contain one."""


MAX_FILE_MB = 256
"""Largest size of a file, in 2**20 bytes."""


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


def read_header(path: Path) -> StillHeader:
    """Return the size of the counts of a file.

    Raises
    ------
    FrameError
        If the container is damaged, or its counts are compressed.
    """
    counts = _counts(path)
    return StillHeader((counts.shape[0], counts.shape[1]), False, 1, None, unit="counts")


def read_frames(path: Path) -> Iterator[NDArray[np.uint16]]:
    """Yield the counts of a file as the detector gave them. FrameError as for `read_header`."""
    yield _counts(path)


def read_radiometry(path: Path) -> Radiometry:
    """Return the constants that a file has for its temperatures.

    Raises
    ------
    FrameError
        If the file has none, or they are no constants of a camera.
    """
    record = _record(path, CAMERA_INFO, 0x310)
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


def _counts(path: Path) -> NDArray[np.uint16]:
    record = _record(path, RAW_DATA, 32)
    order = _byte_order(path, record)
    columns, rows = struct.unpack_from(f"{order}2H", record, 2)
    check_size(path, (rows, columns))
    if record[32:40] == b"\x89PNG\r\n\x1a\n":
        raise FrameError(path, "its counts are compressed as PNG, expected plain ones; export 16-bit TIFF")
    if len(record) < 32 + 2 * rows * columns:
        raise FrameError(
            path, f"found {len(record) - 32} bytes of counts, expected {2 * rows * columns}: truncated"
        )
    counts = np.frombuffer(record, f"{order}u2", rows * columns, 32)
    return counts.reshape(rows, columns).astype(np.uint16)


def _record(path: Path, kind: int, smallest: int) -> bytes:
    """Return a record of the container. FrameError if there is none with at least the smallest size."""
    data = _container(path)
    if len(data) < 64:
        raise FrameError(path, "the header of the container is truncated")
    order = next((one for one in "><" if 100 <= struct.unpack_from(f"{one}I", data, 20)[0] < 200), None)
    if order is None:
        raise FrameError(path, "the version of the container is none of ours, expected 100 to 199")
    first, n_records = struct.unpack_from(f"{order}2I", data, 24)
    for number in range(min(n_records, 1000)):
        place = first + 32 * number
        if place + 32 > len(data):
            break
        (found,) = struct.unpack_from(f"{order}H", data, place)
        begin, length = struct.unpack_from(f"{order}2I", data, place + 12)
        if found == kind:
            if begin + length > len(data) or length < smallest:
                raise FrameError(path, f"record {number} of type {kind} reaches beyond the file: truncated")
            return data[begin : begin + length]
    raise FrameError(path, f"the container has no record of type {kind}, expected one")


def _byte_order(path: Path, record: bytes) -> str:
    order = {b"\2\0": "<", b"\0\2": ">"}.get(record[:2])
    if order is None:
        raise FrameError(path, f"a record starts with {record[:2]!r}, expected 2 as a number of two bytes")
    return order


def _container(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_FILE_MB * 2**20:
            raise FrameError(path, f"has more than {MAX_FILE_MB} MB, expected one frame")
        data = path.read_bytes()
    except OSError as error:
        raise FrameError(path, f"cannot be read: {error.strerror}") from None
    return b"".join(_container_parts(data)) if data.startswith(JPEG_START) else data


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
