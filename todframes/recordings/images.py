"""Reading of image sequences and files of several pages: TIFF, DPX, PNG, EXR, PNM, JPEG 2000 and JPEG."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from todframes.base.errors import FrameError
from todframes.frames.files import (
    FULL_SCALE,
    FrameFile,
    allow_frames,
    check_decoded_size,
    openimageio_reason,
    path_in_utf8,
)
from todframes.recordings.recording import RecordingWarning, StillHeader, check_size

IMAGE_FORMATS = {
    rb"\x76\x2f\x31\x01": "openexr",
    rb"\x89PNG\r\n\x1a\n": "png",
    rb"II[*+]\0|MM\0[*+]": "tiff",
    rb"SDPX|XPDS": "dpx",
    rb"P[1-6]\s": "pnm",
    rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51": "jpeg2000",
    rb"\xff\xd8\xff": "jpeg",
}
"""Patterns of the first bytes of the files that this module reads, and OpenImageIO's names of their formats."""

PIXEL_TYPES = ("uint8", "uint16", "int16", "half", "float", "double")
"""Stored types that are read; all others have values that 32-bit floats cannot hold."""

RATE_ATTRIBUTES = ("FramesPerSecond", "dpx:FrameRate", "dpx:TemporalFrameRate")
"""Attributes with the frame rate."""

LOSSY = RecordingWarning(
    "lossy_compression",
    "JPEG changes pixels and has 256 levels: faint triangles and noise are not what the camera saw; "
    "record TIFF, PNG or EXR",
)


def format_of(start: bytes) -> str | None:
    """Return OpenImageIO's name of the format of a file that starts with these bytes; None if it has none."""
    return next((name for pattern, name in IMAGE_FORMATS.items() if re.match(pattern, start)), None)


def read_header(path: Path, max_frame_mb: int) -> StillHeader:
    """Return the size, scale, number of pages and frame rate of an image file.

    Raises
    ------
    FrameError
        If the file is damaged or too large, its pages differ, or its pixel type or channels are none of ours.
    """
    with _opened(path, max_frame_mb) as image:
        name = image.format_name()
        if name == "openexr":
            return _exr_header(path, image.spec(), max_frame_mb)
        spec, n_pages = image.spec(), 1
        header = _layout(path, spec, max_frame_mb)
        while image.seek_subimage(n_pages, 0):
            if _layout(path, image.spec(), max_frame_mb) != header:
                raise FrameError(
                    path, f"page {n_pages} differs in size or pixel type from page 0, expected equal ones"
                )
            n_pages += 1
    shape, n_channels, pixel_type = header
    time_s = _time_s(spec) if n_pages == 1 else None
    return StillHeader(
        shape,
        n_channels > 1,
        n_pages,
        float(_full_scale(path, spec)) if pixel_type in FULL_SCALE else None,
        frames_per_second=_rate(spec),
        times_s=None if time_s is None else (time_s,),
        warnings=(LOSSY,) if name == "jpeg" else (),
    )


def read_frames(path: Path, max_frame_mb: int) -> Iterator[NDArray[Any]]:
    """Yield the values of each page of an image file, as stored: 10 bits give values up to 1023.

    Raises
    ------
    FrameError
        If pixels are damaged, NaN or infinite.
    """
    with path.open("rb") as file:
        name = format_of(file.read(16))
    if name in ("openexr", "png"):
        with FrameFile(path, max_frame_mb=max_frame_mb) as frame:
            yield _as_recorded(path, frame.read().stored)
        return
    with _opened(path, max_frame_mb) as image:
        page = 0
        while image.seek_subimage(page, 0):
            spec = image.spec()
            _, n_channels, pixel_type = _layout(path, spec, max_frame_mb)
            stored = image.read_image(page, 0, 0, n_channels, pixel_type)
            if stored is None or image.has_error:
                raise FrameError(path, f"page {page} cannot be decoded: {openimageio_reason(image, max_frame_mb)}")
            if pixel_type in FULL_SCALE:
                stored = _unscaled(stored, _full_scale(path, spec))
            yield _as_recorded(path, stored)
            page += 1


@contextmanager
def _opened(path: Path, max_frame_mb: int) -> Iterator[Any]:
    allow_frames(max_frame_mb)
    with ExitStack() as stack:
        try:
            image = oiio.ImageInput.open(str(path_in_utf8(path, stack)))
        except (OSError, ValueError) as error:
            raise FrameError(path, f"cannot be opened: {error}") from None
        if image is None:
            raise FrameError(path, f"cannot be opened: {openimageio_reason(None, max_frame_mb)}")
        stack.callback(image.close)
        yield image


def _exr_header(path: Path, spec: Any, max_frame_mb: int) -> StillHeader:
    with FrameFile(path, max_frame_mb=max_frame_mb) as frame:
        header = frame.header
    check_size(path, (header.height, header.width), max_frame_mb)
    if (header.n_rows, header.n_columns) != (header.height, header.width):
        raise FrameError(path, "the data window covers only a part of the display window, expected all of it")
    return StillHeader(
        (header.height, header.width),
        len(header.channels) > 1,
        1,
        None,
        frames_per_second=_rate(spec),
    )


def _layout(path: Path, spec: Any, max_frame_mb: int) -> tuple[tuple[int, int], int, str]:
    """Return the shape, the number of channels to read, and the pixel type of a page."""
    shape, pixel_type = (spec.height, spec.width), str(spec.format)
    check_size(path, shape, max_frame_mb)
    check_decoded_size(path, max(spec.image_bytes(True), spec.tile_bytes(True)), max_frame_mb)
    if spec.depth > 1:
        raise FrameError(path, f"found a volume {spec.depth} pixels deep, expected a frame")
    if pixel_type not in PIXEL_TYPES:
        raise FrameError(path, f"pixel type {pixel_type}, expected one of {', '.join(PIXEL_TYPES)}")
    if not 1 <= spec.nchannels <= 4:
        raise FrameError(path, f"found {spec.nchannels} channels, expected grey or R, G, B, with or without alpha")
    return shape, 1 if spec.nchannels < 3 else 3, pixel_type


def _full_scale(path: Path, spec: Any) -> int:
    """Return the largest value that the file can hold: of its bits, or the one that a PNM declares."""
    if spec.get_string_attribute("oiio:ColorSpace") and "pnm:binary" in [one.name for one in spec.extra_attribs]:
        return _pnm_maximum(path)
    stored: Any = str(spec.format)
    bits = spec.get_int_attribute("oiio:BitsPerSample", 0)
    return int(2**bits - 1) if 8 < bits < 16 else FULL_SCALE[stored]


def _pnm_maximum(path: Path) -> int:
    with path.open("rb") as file:
        start = file.read(4096)
    if start[:2] in (b"P1", b"P4"):
        return 255  # OpenImageIO makes 0 and 255 of the two values of a bitmap
    numbers = re.match(rb"P[2356](?:\s|#[^\n]*\n)+\d+(?:\s|#[^\n]*\n)+\d+(?:\s|#[^\n]*\n)+(\d+)\s", start)
    if numbers is None:
        raise FrameError(path, "the header of the PNM has no largest value in its first 4096 bytes")
    return int(numbers[1])


def _unscaled(stored: NDArray[Any], full_scale: int) -> NDArray[Any]:
    """Undo OpenImageIO's stretching of n-bit values to 8 or 16 bits: its rounding is far below one step."""
    stretched = np.iinfo(stored.dtype).max
    if full_scale == stretched:
        return stored
    return np.rint(stored * (full_scale / stretched)).astype(stored.dtype)


def _as_recorded(path: Path, stored: NDArray[Any]) -> NDArray[Any]:
    """Return (rows, columns) or (rows, columns, 3) as uint8, uint16 or float32."""
    values = stored if stored.dtype.kind == "u" else stored.astype(np.float32)
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        raise FrameError(path, f"{np.count_nonzero(~np.isfinite(values))} values are NaN or infinite")
    return values[..., 0] if values.shape[2] == 1 else values


def _time_s(spec: Any) -> float | None:
    """Return the moment of exposure that EXIF gives, in seconds of the camera's clock; None if it gives none."""
    text = spec.get_string_attribute("Exif:DateTimeOriginal")
    fraction = spec.get_string_attribute("Exif:SubsecTimeOriginal").strip()
    try:
        moment = datetime.strptime(text.strip(), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    return moment.timestamp() + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)


def _rate(spec: Any) -> float | None:
    """Return the frame rate that the metadata give, None if they give none."""
    values = {one.name: one.value for one in spec.extra_attribs if one.name in RATE_ATTRIBUTES}
    for name in RATE_ATTRIBUTES:
        value: Any = values.get(name)
        if isinstance(value, tuple):
            value = value[0] / value[1] if len(value) == 2 and value[1] else None
        if isinstance(value, int | float) and np.isfinite(value) and value > 0:
            return float(value)
    return None
