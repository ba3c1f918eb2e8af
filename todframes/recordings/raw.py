"""Reading of camera raw files: linear sensor values, without demosaicing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
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
    "each cell of 2 x 2 of the mosaic gives the mean of its two green values: frames have half the rows and "
    "columns of the sensor, and a pixel has twice its pitch",
)


def recognises(path: Path, start: bytes) -> bool:  # noqa: ARG001 - other readers need the content
    """Return whether a file is camera raw by its extension."""
    return path.suffix.lower() in SUFFIXES


def read_header(path: Path, max_frame_mb: int) -> StillHeader:
    """Return the size, black level and white level of a raw file; the file is unpacked for it. Raises DataError if
    rawpy is not installed, and FrameError if the file is damaged or too large, its data are missing, or it has a
    mosaic other than Bayer's.
    """
    with _opened(path, max_frame_mb) as raw:
        values, used = _values(path, raw)
        white, black = raw.white_level, [raw.black_level_per_channel[colour] for colour in used]
    rows, columns = values.shape
    check_size(path, (rows, columns), max_frame_mb)
    warnings = () if values.dtype.kind == "u" else (HALF,)
    return StillHeader((rows, columns), False, 1, float(white), float(np.mean(black)), warnings=warnings)


def read_frames(path: Path, max_frame_mb: int) -> Iterator[NDArray[Any]]:
    """Yield one frame of linear sensor values, black level included. A sensor without a mosaic gives its values.
    Of a Bayer mosaic, each cell of 2 × 2 gives the mean of its two green values: half the rows and columns, but
    nothing is interpolated between cells.
    """
    with _opened(path, max_frame_mb) as raw:
        yield _values(path, raw)[0]


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


def _values(path: Path, raw: rawpy.RawPy) -> tuple[NDArray[Any], list[int]]:
    """Return the sensor's values and the numbers of the colours in them."""
    if raw.raw_type.name != "Flat":
        raise FrameError(path, "found values of several colours at each pixel, expected a Bayer mosaic or none")
    sensor, pattern = raw.raw_image_visible, raw.raw_pattern
    _check_all_there(path, sensor)
    if raw.num_colors == 1:
        return sensor.copy(), [0]
    names = raw.color_desc.decode()
    colours = raw.raw_colors_visible[:2, :2]
    greens = [(row, column) for row in (0, 1) for column in (0, 1) if names[colours[row, column]] == "G"]
    if pattern is None or pattern.shape != (2, 2) or len(greens) != 2:
        raise FrameError(path, f"found a mosaic of {names} that is not Bayer's, expected Bayer's with two greens")
    rows, columns = sensor.shape[0] // 2 * 2, sensor.shape[1] // 2 * 2
    first, second = (sensor[row:rows:2, column:columns:2].astype(np.float32) for row, column in greens)
    return (first + second) / np.float32(2), [int(colours[green]) for green in greens]


def _check_all_there(path: Path, sensor: NDArray[Any]) -> None:
    """Raise FrameError if the last rows are 0 throughout: LibRaw says nothing of data that are missing."""
    n_rows = len(sensor)
    n_there = int(np.flatnonzero(sensor.any(axis=1)).max(initial=-1)) + 1
    if n_there < n_rows:
        what = "all values are 0" if n_there == 0 else f"rows {n_there} to {n_rows - 1} are 0"
        raise FrameError(path, f"{what}, as if the sensor's data were missing; copy the file again")
