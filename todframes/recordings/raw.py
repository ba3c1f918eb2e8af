"""Reading of camera raw files: linear sensor values, without demosaicing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import FrameError
from todframes.frames.files import check_decoded_size, path_in_utf8
from todframes.recordings.recording import RecordingWarning, StillHeader, check_size, missing_extra

if TYPE_CHECKING:
    import rawpy

SUFFIXES = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".iiq", ".kdc", ".mef", ".mos", ".mrw"),
    *(".nef", ".nrw", ".orf", ".pef", ".raf", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f"),
)
"""Extensions of camera raw files; many of them are TIFF by content."""

JOINS_FILES = True

HALF = RecordingWarning(
    "half_resolution",
    "each cell of 2 x 2 of the mosaic gives its first green value: frames have half the rows and columns of the "
    "sensor, and a pixel has twice its pitch",
)


def recognises(path: Path, start: bytes) -> bool:  # noqa: ARG001 - other readers need the content
    """Return whether a file is camera raw by its extension."""
    return path.suffix.lower() in SUFFIXES


def read_header(path: Path, max_frame_mb: int, *, is_whole: bool = False) -> StillHeader:
    """Return the size, black level and white level of a raw file; the file is unpacked for it. Raises DataError if
    rawpy is not installed, and FrameError if the file is damaged or too large, its data are missing, or it has a
    mosaic other than Bayer's.
    """
    with _opened(path, max_frame_mb) as raw:
        values, colour = _values(path, raw, is_whole=is_whole)
        levels = raw.black_level_per_channel
        white, black = raw.white_level, np.mean(levels if colour is None else levels[colour])
        is_mosaic = raw.num_colors > 1
    rows, columns = values.shape
    check_size(path, (rows, columns), max_frame_mb)
    warnings = (HALF,) if is_mosaic and not is_whole else ()
    return StillHeader((rows, columns), False, 1, float(white), float(black), warnings=warnings)


def read_frames(path: Path, max_frame_mb: int, *, is_whole: bool = False) -> Iterator[NDArray[Any]]:
    """Yield one frame of linear sensor values, black level included. A sensor without a mosaic gives its values.
    Of a Bayer mosaic, each cell of 2 × 2 gives its first green value: half the rows and columns, each value of one
    detector, as a sensor is described. A mean of both greens has half the gain of a detector and another MTF.
    """
    with _opened(path, max_frame_mb) as raw:
        yield _values(path, raw, is_whole=is_whole)[0]


class Mosaic:
    """Reader of the whole mosaic, whose planes are cut out by their place in a cell."""

    recognises = staticmethod(recognises)
    read_header = staticmethod(partial(read_header, is_whole=True))
    read_frames = staticmethod(partial(read_frames, is_whole=True))


@contextmanager
def _opened(path: Path, max_frame_mb: int) -> Iterator[rawpy.RawPy]:
    try:
        import rawpy
    except ImportError:
        raise missing_extra(path, "raw", "rawpy") from None
    try:
        with ExitStack() as stack, rawpy.imread(str(path_in_utf8(path, stack))) as raw:
            check_decoded_size(path, 2 * raw.sizes.raw_width * raw.sizes.raw_height, max_frame_mb)
            yield raw
    except (rawpy.LibRawError, OSError) as error:
        reason = error.args[-1] if error.args else error  # of an OSError, its number comes first
        reason = reason.decode() if isinstance(reason, bytes) else reason
        raise FrameError(path, f"cannot be read as camera raw: {reason}") from None


def _values(path: Path, raw: rawpy.RawPy, *, is_whole: bool) -> tuple[NDArray[Any], int | None]:
    """Return the sensor's values and the number of their colour; None for a whole mosaic."""
    if raw.raw_type.name != "Flat":
        raise FrameError(path, "found values of several colours at each pixel, expected a Bayer mosaic or none")
    sensor, pattern = raw.raw_image_visible, raw.raw_pattern
    _check_all_there(path, sensor)
    if raw.num_colors == 1 or is_whole:
        return sensor.copy(), None if is_whole else 0
    names = raw.color_desc.decode()
    colours = raw.raw_colors_visible[:2, :2]
    greens = [(row, column) for row in (0, 1) for column in (0, 1) if names[colours[row, column]] == "G"]
    if pattern is None or pattern.shape != (2, 2) or len(greens) != 2:
        raise FrameError(path, f"found a mosaic of {names} that is not Bayer's, expected Bayer's with two greens")
    row, column = greens[0]
    rows, columns = sensor.shape[0] // 2 * 2, sensor.shape[1] // 2 * 2
    return sensor[row:rows:2, column:columns:2].copy(), int(colours[row, column])


def _check_all_there(path: Path, sensor: NDArray[Any]) -> None:
    """Raise FrameError if the last rows are 0 throughout: LibRaw says nothing of data that are missing."""
    n_rows = len(sensor)
    n_there = int(np.flatnonzero(sensor.any(axis=1)).max(initial=-1)) + 1
    if n_there < n_rows:
        what = "all values are 0" if n_there == 0 else f"rows {n_there} to {n_rows - 1} are 0"
        raise FrameError(path, f"{what}, as if the sensor's data were missing; copy the file again")
