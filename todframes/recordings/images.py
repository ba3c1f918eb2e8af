"""Image sequences and files of several pages as recordings: TIFF, DPX, PNG, EXR, PNM, JPEG 2000 and JPEG."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import FrameError
from todframes.frames.files import PICTURE_FORMATS, FrameFile, format_of
from todframes.recordings.recording import RecordingWarning, StillHeader, check_size

JOINS_FILES = True


def recognises(path: Path, start: bytes) -> bool:  # noqa: ARG001 - other readers need the path
    """Return whether a file is a picture by its first bytes."""
    return format_of(start) in PICTURE_FORMATS


def read_header(path: Path, max_frame_mb: int) -> StillHeader:
    """Return the size, scale, number of pages and frame rate of an image file. Raises FrameError if the file is
    damaged or too large, its pages differ, or its pixel type or channels are none of ours.
    """
    with FrameFile(path, formats=PICTURE_FORMATS, max_frame_mb=max_frame_mb) as file:
        alike = attrgetter("height", "width", "channels", "pixel_type", "full_scale")
        first, metadata = file.header, file.metadata
        shape, n_pages = (first.height, first.width), 0
        check_size(path, shape, max_frame_mb)
        if (first.n_rows, first.n_columns) != shape:
            raise FrameError(path, "the data window covers only a part of the display window, expected all of it")
        for page in file.pages():
            if alike(page) != alike(first):
                raise FrameError(
                    path, f"page {n_pages} differs in size or pixel type from page 0, expected equal ones"
                )
            n_pages += 1
        n_images = _n_described(str(metadata.get("ImageDescription", "")), shape)
        if n_images > n_pages * len(first.channels):
            raise FrameError(
                path,
                f"found {n_pages} page, expected {n_images} images by its description: a stack behind one "
                "directory; write a page for each image, or a NumPy array (numpy.save)",
            )
    time_s = _time_s(first.attributes) if n_pages == 1 else None
    return StillHeader(
        shape,
        len(first.channels) > 1,
        n_pages,
        None if first.full_scale is None else float(first.full_scale),
        frames_per_second=_rate(metadata),
        times_s=None if time_s is None else (time_s,),
        warnings=tuple(RecordingWarning(*warning) for warning in first.warnings),
    )


def _n_described(description: str, shape: tuple[int, int]) -> int:
    """Return the number of images that the description of a TIFF by ImageJ or tifffile states; 0 of others."""
    if (counted := re.match(r"ImageJ=.*?^images=(\d+)", description, re.MULTILINE | re.DOTALL)) is not None:
        return int(counted[1])
    sides = re.search(rf'"shape": \[([\d, ]*), {shape[0]}, {shape[1]}\b', description)
    return 0 if sides is None else math.prod(map(int, sides[1].split(",")))


def read_frames(path: Path, max_frame_mb: int) -> Iterator[NDArray[Any]]:
    """Yield the values of each page of an image file, as stored: 10 bits give values up to 1023."""
    with FrameFile(path, formats=PICTURE_FORMATS, max_frame_mb=max_frame_mb) as file:
        for _ in file.pages():
            stored = file.read().stored
            values = stored if stored.dtype.kind == "u" else stored.astype(np.float32, copy=False)
            yield values.squeeze(2) if values.shape[2] == 1 else values


def _time_s(attributes: Mapping[str, str]) -> float | None:
    """Return the moment of exposure that EXIF gives, in seconds of the camera's clock; None if it gives none."""
    text = attributes.get("Exif:DateTimeOriginal", "")
    fraction = attributes.get("Exif:SubsecTimeOriginal", "").strip()
    try:
        moment = datetime.strptime(text.strip(), "%Y:%m:%d %H:%M:%S").replace(tzinfo=UTC)
    except ValueError:
        return None
    return moment.timestamp() + (float(f"0.{fraction}") if fraction.isdecimal() else 0.0)


def _rate(metadata: Mapping[str, Any]) -> float | None:
    """Return the frame rate that the metadata give, None if they give none."""
    for name in ("FramesPerSecond", "dpx:FrameRate", "dpx:TemporalFrameRate"):
        value = metadata.get(name)
        if isinstance(value, tuple):
            value = value[0] / value[1] if len(value) == 2 and value[1] else None
        if isinstance(value, int | float) and np.isfinite(value) and value > 0:
            return float(value)
    return None
