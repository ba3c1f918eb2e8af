"""Frames → EXR and PNG, whole or not at all, the same bytes for the same values."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import OpenImageIO as oiio
from numpy.typing import ArrayLike, NDArray

from todframes.errors import FrameError, OutputError, SettingsError
from todframes.frames import FULL_SCALE, NUMPY_TYPES, FrameFile, PathLike, PixelType, openimageio_reason

Compression = Literal["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab"]

_WRITABLE: dict[str, tuple[PixelType, ...]] = {".exr": ("half", "float"), ".png": ("uint16", "uint8")}


def write_frame(
    path: PathLike,
    values: ArrayLike,
    *,
    pixel_type: PixelType | None = None,
    compression: Compression = "zip",
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write code values to an EXR or PNG file, whole or not at all; the same input gives the same bytes.

    Parameters
    ----------
    path : path
        Ends in .exr or .png. An existing file is replaced.
    values : array_like, (rows, columns) or (rows, columns, 1 or 3)
        Code values; one channel is written as Y, three as R, G, B. For PNG within [0, 1], rounded to nearest.
    pixel_type : {"half", "float", "uint16", "uint8"}, optional
        The first two are for EXR, the last two for PNG. Default: half, uint16.
    compression : str
        Of an EXR; a PNG has "zip" only.
    attributes : mapping of str to str, optional
        Texts that `read_header` gives back under the same names. A name should have a prefix of its own, such as
        "todframes:seed"; the formats rename or drop some of the others.

    Raises
    ------
    SettingsError
        If the extension, pixel type or compression is none of these, or an attribute would not be kept as it is.
    FrameError, a ValueError
        If values have another shape, are not finite or beyond the pixel type's range.
    OutputError, an OSError
        If the file cannot be written.
    """
    path, attributes = Path(path), attributes or {}
    suffix = path.suffix.lower()
    pixel_types = _WRITABLE.get(suffix, _WRITABLE[".exr"])
    pixel_type = pixel_type or pixel_types[0]
    compressions = get_args(Compression) if suffix == ".exr" else ("zip",)
    checks: tuple[tuple[str, str, tuple[str, ...]], ...] = (
        ("extension", suffix, tuple(_WRITABLE)),
        ("pixel type", pixel_type, pixel_types),
        ("compression", compression, compressions),
    )
    for what, found, expected in checks:
        if found not in expected:
            raise SettingsError(f"{path}: {what} {found!r}, expected {' or '.join(expected)}")
    stored = _to_stored(path, values, pixel_type)
    temporary = path.with_name(f".{os.urandom(8).hex()}{suffix}")
    try:
        temporary.touch(exist_ok=False)
        _write(temporary, stored, pixel_type, compression, attributes)
        with FrameFile(temporary) as file:
            kept = file.header.attributes
            file.read()  # a disk that fills up with the last bytes of an EXR is not reported
        lost = [name for name, text in attributes.items() if kept.get(name) != text]
        if lost:
            like = "a name such as 'todframes:seed' and a text that is not empty and without NUL"
            raise SettingsError(f"{path}: {suffix} does not keep attribute {lost[0]!r} as it is, expected {like}")
        temporary.replace(path)
    except FrameError as error:
        raise OutputError(f"{path}: cannot be written: {error.problem}") from None
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
    finally:
        if path.parent.is_dir():
            temporary.unlink(missing_ok=True)


def _write(
    path: Path, stored: NDArray[Any], pixel_type: PixelType, compression: str, attributes: Mapping[str, str]
) -> None:
    height, width, n_channels = stored.shape
    spec = oiio.ImageSpec(width, height, n_channels, pixel_type)
    spec.channelnames = ("Y",) if n_channels == 1 else ("R", "G", "B")
    for name, text in attributes.items():
        spec.attribute(name, text)
    if path.suffix == ".exr":
        spec.attribute("compression", compression)
        if "DateTime" not in attributes:
            spec.attribute("DateTime", "")  # or OpenImageIO writes the present time
    output = oiio.ImageOutput.create(str(path))
    written = output is not None and output.open(str(path), spec) and output.write_image(stored)
    if output is None or not output.close() or not written or output.has_error:
        raise FrameError(path, openimageio_reason(output))


def _to_stored(path: Path, values: ArrayLike, pixel_type: PixelType) -> NDArray[Any]:
    """Code values in the file's pixel type, (rows, columns, channels); FrameError if they do not fit it."""
    pixels, dtype = np.asarray(values), NUMPY_TYPES[pixel_type]
    pixels = pixels[..., np.newaxis] if pixels.ndim == 2 else pixels
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3) or pixels.size == 0 or pixels.dtype.kind not in "fiu":
        found = f"values of {pixels.dtype} and shape {np.shape(values)}"
        raise FrameError(path, f"found {found}, expected numbers and (rows, columns) or (rows, columns, 1 or 3)")
    if pixel_type in FULL_SCALE:
        bad = ~((pixels >= 0) & (pixels <= 1))
        stored = np.rint(np.where(bad, 0, pixels) * np.float64(FULL_SCALE[pixel_type])).astype(dtype)
        limits = "[0, 1]"
    else:
        with np.errstate(over="ignore", invalid="ignore"):
            stored = pixels.astype(dtype, order="C")
        bad = ~np.isfinite(stored)
        limits = f"±{np.finfo(dtype).max:g}"
    if bad.any():
        raise FrameError(path, f"{np.count_nonzero(bad)} values are NaN or beyond {limits}, expected none")
    return stored
