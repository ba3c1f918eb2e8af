"""The common form of the frames of all kinds of recordings."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from itertools import chain, pairwise
from pathlib import Path
from statistics import fmean, median
from typing import Any, Literal, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, FrameError, SettingsError, argument
from todframes.display.display import INTEGRATION_TIME_S

P = TypeVar("P", str, Path)

BYTES_PER_PIXEL = 8
"""Least number of bytes that a pixel of a recording counts as, whatever its type: its decoding takes as much, and
the pixel format of a video is known from a decoded frame only."""

GAP = 1.5
"""Interval between frames, in frames, from which frames are missing."""

TIME_TOLERANCE = 0.05
"""Part of a frame's interval by which its time may be off: containers round times to 1 ms. Without it, the number
of frames in 0.1 s would depend on that rounding at 25 frames/s, where 2 and 3 are as near."""

LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 1e-9, 1e9
TIMES_FILE = "times.csv"
"""File in a folder of stills that has their times."""

Unit = Literal["code", "counts", "celsius"]
"""Code values of a picture, counts of a detector, or temperatures."""


class RecordedFrame(NamedTuple):
    """One frame: the values as recorded, their time and origin. `values` has shape (rows, columns), or (rows,
    columns, 3) for R, G, B, and is uint8, uint16 or float32. `time_s` is the presentation time in seconds, None if
    it is not known. `source` names the frame in messages.
    """

    values: NDArray[Any]
    time_s: float | None
    source: str


class RecordingWarning(NamedTuple):
    """A property of a recording that reduces precision: a code, and a sentence about the effect."""

    code: str
    message: str


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Recording:
    """A sequence of frames of one size, which are read one at a time and as often as asked for.

    `path` is the file or folder, `shape` has the rows and columns of each frame; in colour, frames have the
    channels R, G, B. `n_frames` is None if it is known only after reading, `frames_per_second` if no nominal rate
    is known. `full_scale` and `zero` are the recorded values of white and black: 255 and 0 for a picture of 8
    bits, 235 and 16 in the limited range of a grey video; `full_scale` is None for values without a white:
    temperatures, counts, floating-point values. `ends` are the least and the largest value that can be recorded,
    None if they are not known. `warnings` say what the recording has lost. `read` returns a new iterator over the
    frames.
    """

    path: Path
    shape: tuple[int, int]
    is_colour: bool
    n_frames: int | None
    frames_per_second: float | None
    full_scale: float | None
    zero: float = 0.0
    ends: tuple[float, float] | None = None
    unit: Unit = "code"
    warnings: tuple[RecordingWarning, ...] = ()
    read: Callable[[], Iterator[RecordedFrame]]

    def frames(self) -> Iterator[RecordedFrame]:
        """Return a new iterator over the frames, from the first; memory does not grow with their number. Raises
        FrameError or DataError if a frame is damaged or has another size; those before it are good. Also if there
        is no frame at all.
        """
        is_empty = True
        for frame in self.read():
            is_empty = False
            yield frame
        if is_empty:
            raise DataError(f"{self.path}: found no frame, expected at least one")


def with_bits(recording: Recording, bits: int | None) -> Recording:
    """Return a recording whose values have so many bits, whatever its files could hold; the same with None. Its
    frames raise DataError where a value is beyond. Raises SettingsError unless there are 1 to 32 bits.
    """
    if bits is None:
        return recording
    if not 1 <= bits <= 32:
        raise SettingsError(f"{argument.bits}: found {bits}, expected 1 to 32")
    white = 2.0**bits - 1.0

    def read() -> Iterator[RecordedFrame]:
        for frame in recording.frames():
            if (largest := frame.values.max()) > white:
                raise DataError(
                    f"{recording.path}: {frame.source}: found the value {largest:g}, expected at most {white:.0f} "
                    f"({argument.bits} {bits}); are the values shifted up? Leave it out, or give more"
                )
            yield frame

    return replace(recording, full_scale=white, zero=0.0, ends=(0.0, white), read=read)


def with_plane(recording: Recording, plane: tuple[int, int] | None) -> Recording:
    """Return a colour plane of a mosaic: of each cell of 2 × 2 values that in this row and column, 0 or 1; the
    recording itself with None. Raises SettingsError for another place, or colours at each pixel.
    """
    if plane is None:
        return recording
    row, column = plane
    if not {row, column} <= {0, 1}:
        raise SettingsError(f"{argument.plane}: found {row},{column}, expected a row and a column of 0 or 1")
    if recording.is_colour:
        raise SettingsError(
            f"{argument.plane}: {recording.path} has three colours at each pixel, expected a mosaic"
        )
    rows, columns = (side // 2 for side in recording.shape)
    plane_of = np.s_[row : 2 * rows : 2, column : 2 * columns : 2]

    def read() -> Iterator[RecordedFrame]:
        return (frame._replace(values=frame.values[plane_of]) for frame in recording.frames())

    return replace(recording, shape=(rows, columns), read=read)


class CodeRange(NamedTuple):
    """Recorded values that become code values 0 and 1 of the display."""

    low: float
    high: float


def code_range(recording: Recording, asked: tuple[float, float] | None, name: str = "value_range") -> CodeRange:
    """Return the range of a recording: the one asked for, or black and white of the recording. `name` is that of
    the argument that asks for it. Raises SettingsError if the recording has no white and none is asked for, or two
    numbers that do not ascend.
    """
    name = getattr(argument, name)
    if asked is not None:
        if not -math.inf < asked[0] < asked[1] < math.inf:
            raise SettingsError(f"{name}: found {asked[0]:g}:{asked[1]:g}, expected LOW:HIGH, the lower one first")
        return CodeRange(*asked)
    if recording.full_scale is None:
        what = {"celsius": "temperatures", "counts": "counts"}.get(recording.unit, "values")
        raise SettingsError(
            f"{recording.path}: has {what} without a black and a white, expected {name} LOW:HIGH, the "
            "values that the display shows black and white"
        )
    return CodeRange(recording.zero, recording.full_scale)


class StillHeader(NamedTuple):
    """The header of a file of frames, which a reader of recordings returns.

    Attributes
    ----------
    shape : (int, int)
        Rows and columns of each frame.
    is_colour : bool
        Frames have the channels R, G, B; else one.
    n_frames : int
    full_scale, zero : float
        Recorded values of white and black; None for values without a white: temperatures, counts, floats.
    unit : {"code", "counts", "celsius"}
        Code values of a picture, counts of a detector, or temperatures.
    frames_per_second : float or None
    times_s : tuple of float or None
        Moments of the frames, in seconds of the camera's clock; None if the file does not have them.
    warnings : tuple of (str, str)
        What the recording has lost: a code, and a sentence about the effect.
    """

    shape: tuple[int, int]
    is_colour: bool
    n_frames: int
    full_scale: float | None
    zero: float = 0.0
    unit: Unit = "code"
    frames_per_second: float | None = None
    times_s: tuple[float, ...] | None = None
    warnings: tuple[RecordingWarning, ...] = ()


class RecordingReader(Protocol):
    """Protocol of a module, or object, registered under the entry-point group `todframes.readers`. With the
    attribute `JOINS_FILES`, if it is true, files given together are one recording. A reader whose frames have
    times that only decoding gives has `open_recording(path, *, frames_per_second, max_frame_mb)`, which returns a
    `Recording`, in place of `read_header` and `read_frames`.
    """

    def recognises(self, path: Path, start: bytes) -> bool:
        """Return whether a file that starts with these bytes, 189 or all of them, is read here."""

    def read_header(self, path: Path, max_frame_mb: int) -> StillHeader:
        """Return the header of a file; FrameError if it is damaged, or a frame larger, decoded, than a limit."""

    def read_frames(self, path: Path, max_frame_mb: int) -> Iterator[NDArray[Any]]:
        """Yield the values of each frame of a file, as of `RecordedFrame`; FrameError if they are bad."""


def check_rate(frames_per_second: float | None) -> float | None:
    """Return a frame rate. Raises SettingsError if no recording can have it."""
    if frames_per_second is not None and not LOWEST_RATE_HZ <= frames_per_second <= HIGHEST_RATE_HZ:
        raise SettingsError(
            f"{argument.frames_per_second}: found {frames_per_second!r}, expected a number from "
            f"{LOWEST_RATE_HZ:g} to {HIGHEST_RATE_HZ:g}"
        )
    return frames_per_second


def frames_integrated(frames_per_second: float | None, time_s: float = INTEGRATION_TIME_S) -> int:
    """Return the number of frames that the eye averages, as `import` does; 1 if the rate is not known."""
    return max(1, math.ceil(time_s * (frames_per_second or 0.0) - 0.5 - TIME_TOLERANCE))


def natural_order(paths: Iterable[P]) -> list[P]:
    """Sort paths by name with numbers in order of size: frame_9 before frame_10, and t_0.05 before t_0.1 where the
    digits behind the point are decimals.
    """
    paths = list(paths)
    number = re.compile(r"\d+(?:\.\d+)?" if _have_decimals([*map(str, paths)]) else r"\d+")

    def key(path: P) -> tuple[list[Decimal | str], str]:
        parts = re.split(f"({number.pattern})", str(path))  # texts and numbers by turns
        return [Decimal(part) if k % 2 else part for k, part in enumerate(parts)], str(path)

    return sorted(paths, key=key)


def _have_decimals(names: Sequence[str]) -> bool:
    """Return whether digits behind a point are decimals, as in 0.05 and 0.1, and not counted, as in 1.9 and 1.10.

    They differ in number, and the names are evenly spaced by them; or some begin and none end with 0.
    """
    fractions = [re.search(r"\d\.(\d+)(?!.*\d\.\d)", name) for name in names]
    digits = ["" if fraction is None else fraction[1] for fraction in fractions]
    if len({len(text) for text in digits}) < 2:
        return False
    if any(text[:1] == "0" < text for text in digits) and not any(text[1:].endswith("0") for text in digits):
        return True
    numbers = [[Decimal(text) for text in re.findall(r"\d+(?:\.\d+)?", name)] for name in names]
    varied = [sorted(column) for column in zip(*numbers, strict=False) if len(set(column)) > 1]
    steps = [after - before for before, after in pairwise(varied[0])] if len(varied) == 1 else []
    return len(steps) > 1 and 2 * max(steps) < 3 * min(steps)


def files_in(folder: Path) -> list[Path]:
    """Return the files of a folder in natural order, without hidden ones and `TIMES_FILE`."""
    try:
        files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    except OSError as error:
        raise DataError(f"{folder}: cannot be read: {error.strerror}") from None
    return natural_order(path for path in files if path.name != TIMES_FILE)


def still_recording(
    paths: Sequence[Path],
    reader: RecordingReader,
    *,
    folder: Path | None,
    frames_per_second: float | None,
    max_frame_mb: int,
    times_s: Mapping[str, float] | None = None,
) -> Recording:
    """Return one recording of still frames, of one file or more, in the order of their names. It has the name of
    the folder, or else of the first file. `times_s` has the time of each file by its name, in place of those in
    the files. Raises FrameError if a header cannot be read, a frame is too large, or two files differ in size,
    channels or scale.
    """
    paths = natural_order(paths)
    headers = [reader.read_header(path, max_frame_mb) for path in paths]
    first = headers[0]
    kinds = [
        {
            "size": _size(header.shape),
            "channels": "R, G, B" if header.is_colour else "grey",
            "value of white": header.full_scale,
            "unit": header.unit,
        }
        for header in headers
    ]
    for path, kind in zip(paths, kinds, strict=True):
        for what, expected in kinds[0].items():
            if kind[what] != expected:
                problem = f"{what}: found {kind[what]}, expected {expected} as in {paths[0].name}"
                raise FrameError(path, f"{problem}; a recording has frames of one kind")
    if times_s is not None:
        headers = [
            header._replace(times_s=(times_s[path.name],), frames_per_second=None)
            for path, header in zip(paths, headers, strict=True)
        ]
    rate, time_s_of, warning = _clock(paths, headers, check_rate(frames_per_second))
    warnings = dict.fromkeys((*chain.from_iterable(header.warnings for header in headers), *warning))

    def read() -> Iterator[RecordedFrame]:
        number = 0
        for path, header in zip(paths, headers, strict=True):
            for page, values in enumerate(reader.read_frames(path, max_frame_mb)):
                source = path.name if header.n_frames == 1 else f"{path.name}, page {page}"
                yield RecordedFrame(values, time_s_of(number), source)
                number += 1

    return Recording(
        path=folder or paths[0],
        shape=first.shape,
        is_colour=first.is_colour,
        n_frames=sum(header.n_frames for header in headers),
        frames_per_second=rate,
        full_scale=first.full_scale,
        zero=first.zero,
        ends=None if first.full_scale is None else (0.0, first.full_scale),
        unit=first.unit,
        warnings=tuple(warnings),
        read=read,
    )


def _clock(
    paths: Sequence[Path], headers: Sequence[StillHeader], asked: float | None
) -> tuple[float | None, Callable[[int], float | None], Sequence[RecordingWarning]]:
    """Return the rate of a sequence, a function that returns a frame's time, and warnings. Times begin at 0. They
    are by the rate asked for or in the first header, else those of the files; None if nothing gives them.
    """
    rate = asked or headers[0].frames_per_second
    if rate is not None:
        return rate, lambda number: number / rate, ()
    if any(header.times_s is None for header in headers) or sum(header.n_frames for header in headers) < 2:
        return None, lambda _: None, ()
    moments_s = list(chain.from_iterable(header.times_s or () for header in headers))
    times_s = tuple(round(moment_s - moments_s[0], 6) for moment_s in moments_s)  # seconds since 1970 have no more
    steps_s = [after - before for before, after in pairwise(times_s)]
    if min(steps_s) > 0:
        usual_s = median(steps_s)
        return 1.0 / fmean(step_s for step_s in steps_s if step_s <= GAP * usual_s), times_s.__getitem__, ()
    number = next(k for k, step_s in enumerate(steps_s) if step_s <= 0)
    names = [path.name for path, header in zip(paths, headers, strict=True) for _ in range(header.n_frames)]
    found = "the time of" if steps_s[number] == 0 else f"a time {-steps_s[number]:.6g} s before"
    warning = RecordingWarning(
        "times_not_used",
        f"frame {number + 1} ({names[number + 1]}) has {found} frame {number} ({names[number]}), expected a later "
        f"one, so these times are not used; {argument.frames_per_second} or times.csv give others",
    )
    return None, lambda _: None, (warning,)


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[1]} x {shape[0]} pixels"


def check_size(path: Path, shape: tuple[int, int], max_frame_mb: int) -> None:
    """Raise FrameError unless a frame has pixels, and not more than a limit allows at `BYTES_PER_PIXEL` each."""
    from todframes.frames.files import MAX_SIDE_PX, check_decoded_size  # they load OpenImageIO

    if min(shape) < 1 or max(shape) > MAX_SIDE_PX:
        raise FrameError(path, f"found {_size(shape)}, expected sides of 1 to {MAX_SIDE_PX}")
    check_decoded_size(path, BYTES_PER_PIXEL * shape[0] * shape[1], max_frame_mb)


def missing_extra(path: Path, extra: str, package: str) -> DataError:
    """Return the error for a file that needs a package which is not installed."""
    return DataError(
        f"{path}: needs the package {package}, which is not installed: pip install 'todframes[{extra}]'"
    )
