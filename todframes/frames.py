"""EXR and PNG <-> Frame; the only user of OpenImageIO."""

from __future__ import annotations

import hashlib
import os
import stat
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Literal, NoReturn, get_args

import numpy as np
import OpenImageIO as oiio
from numpy.typing import ArrayLike, NDArray

from todframes.errors import FrameError, SettingsError

PixelType = Literal["half", "float", "uint8", "uint16"]
Compression = Literal["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab"]
Range = tuple[int, int]

MAX_SIDE_PX = 32768
MAX_CHANNELS = 256
MAX_DECODED_MB = 256
"""Of all channels of a part, in its own pixel type. One MB is 2**20 bytes."""

_FORMATS = {b"\x76\x2f\x31\x01": "openexr", b"\x89PNG\r\n\x1a\n": "png"}
_NUMPY_TYPES = {"half": np.float16, "float": np.float32, "uint8": np.uint8, "uint16": np.uint16}
_FULL_SCALE = {"uint8": 255, "uint16": 65535}
_WRITABLE: dict[str, tuple[PixelType, ...]] = {".exr": ("half", "float"), ".png": ("uint16", "uint8")}
_LAYOUT_ATTRIBUTES = ("oiio:", "openexr:", "compression")

# OpenImageIO checks these before it allocates anything, so a small file cannot claim the machine's memory.
oiio.attribute("limits:resolution", MAX_SIDE_PX)
oiio.attribute("limits:channels", MAX_CHANNELS)
oiio.attribute("limits:imagesize_MB", MAX_DECODED_MB)

_OPEN_OPTIONS = oiio.ImageSpec()
_OPEN_OPTIONS.attribute("oiio:UnassociatedAlpha", 1)  # or OpenImageIO multiplies PNG colours by alpha


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A rectangle of code values of a frame as stored.

    Attributes
    ----------
    values : ndarray of float32, (rows, columns, channels)
        One channel (grey or luminance) or three (R, G, B). Integers are divided by full scale, 255 or 65535;
        floating-point values are as in the file. All are finite.
    first_row, first_column : int
        Where `values[0, 0]` lies in the frame; (0, 0) is the frame's top left pixel.
    height, width : int
        Of the whole frame, pixels. For EXR that is the display window.
    """

    values: NDArray[np.float32]
    first_row: int
    first_column: int
    height: int
    width: int


@dataclass(frozen=True, slots=True)
class FrameHeader:
    """What a file says of its frame.

    Attributes
    ----------
    height, width : int
        Of the whole frame, pixels.
    first_row, first_column, n_rows, n_columns : int
        The rectangle of the frame that the file has pixels for. It is smaller than the frame where an EXR's data
        window does not cover the display window.
    channels : tuple of str
        Names of the channels that are read, one or three.
    pixel_type : {"half", "float", "uint8", "uint16"}
        The widest among these channels.
    attributes : dict of str to str
        The file's text attributes, without those that tell how the pixels are laid out.
    """

    height: int
    width: int
    first_row: int
    first_column: int
    n_rows: int
    n_columns: int
    channels: tuple[str, ...]
    pixel_type: PixelType
    attributes: dict[str, str]


class FrameFile:
    """An open frame file: its header at once, its pixels when asked for.

    Use it in a `with` statement, and in one thread; each thread opens its own. `path` is the file and `header`
    its FrameHeader. The format is told by the content, not by the file's extension.

    Raises
    ------
    FrameError
        If the file is missing, unreadable, neither EXR nor PNG, damaged, beyond the limits of this module, deep,
        or has no channels to use.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        format_name = _recognise(self.path)
        try:
            self._image = oiio.ImageInput.open(str(self.path), _OPEN_OPTIONS)
            if self._image is None or self._image.format_name() != format_name:
                self._fail("cannot be opened")
            self.header = self._read_header()
        except UnicodeDecodeError:
            raise FrameError(self.path, "the header is damaged: found text that is not UTF-8") from None
        except TypeError:
            raise FrameError(self.path, "the file's name is not UTF-8, which OpenImageIO expects") from None

    def __enter__(self) -> FrameFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; the header stays."""
        self._image.close()

    def read(self, *, rows: Range | None = None, columns: Range | None = None) -> Frame:
        """Decode a rectangle; whole scan lines or tiles are decoded, no more of them than it touches.

        Parameters
        ----------
        rows, columns : (int, int), optional
            Half-open ranges in frame coordinates, clipped to the rectangle that the file has pixels for. What
            lies outside of it altogether gives a Frame without pixels. Default: all.

        Raises
        ------
        FrameError
            If these pixels are damaged or one of them is NaN or infinite.
        """
        header = self.header
        top, bottom = _clip(rows, header.first_row, header.n_rows)
        left, right = _clip(columns, header.first_column, header.n_columns)
        n_channels = len(header.channels)
        if top == bottom or left == right:
            values = np.empty((bottom - top, right - left, n_channels), np.float32)
        else:
            stored, first_row, first_column = self._decode(top, bottom, left, right)
            stored = stored[top - first_row : bottom - first_row, left - first_column : right - first_column]
            if self._picks != list(range(stored.shape[2])):
                stored = stored[..., self._picks]
            with np.errstate(invalid="ignore"):  # a signalling NaN; refused below with its position
                values = np.ascontiguousarray(stored, np.float32)
        if header.pixel_type in _FULL_SCALE:
            values /= _FULL_SCALE[header.pixel_type]
        elif not np.isfinite(values).all():
            bad = np.argwhere(~np.isfinite(values).all(axis=2))
            row, column = bad[0] + (top, left)
            raise FrameError(
                self.path, f"{len(bad)} pixels are NaN or infinite, the first at row {row}, column {column}"
            )
        return Frame(values, top, left, header.height, header.width)

    def _read_header(self) -> FrameHeader:
        self._subimage, spec, chosen = self._choose_channels()
        self._first_channel = min(chosen)
        self._picks = [channel - self._first_channel for channel in chosen]
        self._spec = spec
        # A PNG's offset chunk says where on a page it is printed; the frame is the PNG itself.
        page = spec.full_x, spec.full_y, spec.full_width, spec.full_height
        if self._image.format_name() == "png":
            page = spec.x, spec.y, spec.width, spec.height
        self._left, self._top, width, height = page
        sides = spec.width, spec.height, width, height
        if min(sides) < 1 or max(sides) > MAX_SIDE_PX or spec.depth > 1:
            raise FrameError(
                self.path,
                f"found {spec.width} x {spec.height} x {spec.depth} pixels in a frame of {width} x {height}, "
                f"expected sides from 1 to {MAX_SIDE_PX} and depth 1",
            )
        size_mb = max(spec.image_bytes(True), spec.tile_bytes(True)) / 2**20
        if size_mb > MAX_DECODED_MB:
            raise FrameError(self.path, f"decodes to {size_mb:.0f} MB, expected at most {MAX_DECODED_MB} MB")
        types = {str(spec.channelformat(channel)) for channel in chosen}
        if types - {"half", "float"} and types not in ({"uint8"}, {"uint16"}):
            raise FrameError(
                self.path, f"pixel type {', '.join(sorted(types))}, expected {', '.join(_NUMPY_TYPES)}"
            )
        first_row, first_column = max(0, spec.y - self._top), max(0, spec.x - self._left)
        n_rows = min(height, spec.y - self._top + spec.height) - first_row
        n_columns = min(width, spec.x - self._left + spec.width) - first_column
        if n_rows < 1 or n_columns < 1:
            raise FrameError(self.path, "the data window and the display window do not overlap")
        return FrameHeader(
            height=height,
            width=width,
            first_row=first_row,
            first_column=first_column,
            n_rows=n_rows,
            n_columns=n_columns,
            channels=tuple(spec.channelnames[channel] for channel in chosen),
            pixel_type=min(types),  # "float" sorts before "half"; the other sets have one member
            attributes={
                attribute.name: attribute.value
                for attribute in spec.extra_attribs
                if isinstance(attribute.value, str) and not attribute.name.startswith(_LAYOUT_ATTRIBUTES)
            },
        )

    def _choose_channels(self) -> tuple[int, Any, list[int]]:
        """Part number, its spec, and the channels to read: luminance before colour, the first part first."""
        found = []
        while self._image.seek_subimage(len(found), 0):
            spec = self._image.spec()
            chosen = None if spec.deep else _luminance_or_rgb(spec.channelnames)
            if chosen:
                return len(found), spec, chosen
            found.append(("deep " if spec.deep else "") + " ".join(spec.channelnames))
        if len(found) == 1 and spec.nchannels == 1 and not spec.deep:
            return 0, spec, [0]
        raise FrameError(
            self.path, f"found channels {'; '.join(found)[:200]}, expected Y, or R, G and B, or only one"
        )

    def _decode(self, top: int, bottom: int, left: int, right: int) -> tuple[NDArray[Any], int, int]:
        """Pixels as stored that cover a rectangle, and the row and column in the frame of the first."""
        spec = self._spec
        channels = self._first_channel, self._first_channel + max(self._picks) + 1, self.header.pixel_type
        y_begin, y_end = top + self._top, bottom + self._top
        x_begin, x_end = spec.x, spec.x + spec.width
        if spec.tile_width:
            y_begin -= (y_begin - spec.y) % spec.tile_height
            y_end = min(y_end + (spec.y - y_end) % spec.tile_height, spec.y + spec.height)
            x_begin = left + self._left - (left + self._left - spec.x) % spec.tile_width
            x_end = min(right + self._left + (spec.x - right - self._left) % spec.tile_width, x_end)
            stored = self._image.read_tiles(
                self._subimage, 0, x_begin, x_end, y_begin, y_end, spec.z, spec.z + 1, *channels
            )
        else:
            stored = self._image.read_scanlines(self._subimage, 0, y_begin, y_end, spec.z, *channels)
        if stored is None or self._image.has_error:
            self._fail(f"rows {top} to {bottom - 1} cannot be decoded")
        return stored, y_begin - self._top, x_begin - self._left

    def _fail(self, problem: str) -> NoReturn:
        raise FrameError(self.path, f"{problem}: {_reason(self._image)}")


def read_header(path: str | os.PathLike[str]) -> FrameHeader:
    """Header of a frame file; no pixels are decoded. Raises FrameError as FrameFile does."""
    with FrameFile(path) as file:
        return file.header


def read_frame(path: str | os.PathLike[str], *, rows: Range | None = None, columns: Range | None = None) -> Frame:
    """Code values of a frame file, or of a rectangle of it. See FrameFile and FrameFile.read."""
    with FrameFile(path) as file:
        return file.read(rows=rows, columns=columns)


def frame_sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file's bytes, 64 hexadecimal digits. Raises FrameError if it cannot be read."""
    try:
        with Path(path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise FrameError(Path(path), str(error.strerror)) from None


def write_frame(
    path: str | os.PathLike[str],
    values: ArrayLike,
    *,
    pixel_type: PixelType | None = None,
    compression: Compression = "zip",
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write code values to an EXR or PNG file, whole or not at all; the same values give the same bytes.

    Parameters
    ----------
    path : path
        Ends in .exr or .png. An existing file is replaced.
    values : array_like, (rows, columns) or (rows, columns, 1 or 3)
        Code values; one channel is written as Y, three as R, G, B. For PNG within [0, 1], rounded to nearest.
    pixel_type : {"half", "float", "uint16", "uint8"}, optional
        EXR has the first two, PNG the last two. Default: half, uint16.
    compression : str
        Of an EXR. PNG has but "zip".
    attributes : mapping of str to str, optional
        Text that `read_header` gives back under the same names. Use names such as "todframes:seed"; both formats
        keep some of the others for themselves.

    Raises
    ------
    SettingsError
        If the file's extension, pixel type or compression is not one of the above, or the format does not keep
        an attribute as it is.
    FrameError, a ValueError
        If values have another shape, are not finite, or beyond what the pixel type holds; or if writing fails.
    """
    path, attributes = Path(path), attributes or {}
    suffix = path.suffix.lower()
    if suffix not in _WRITABLE:
        raise SettingsError(f"{path}: found extension {path.suffix!r}, expected .exr or .png")
    pixel_type = pixel_type or _WRITABLE[suffix][0]
    if pixel_type not in _WRITABLE[suffix]:
        raise SettingsError(
            f"{path}: pixel type {pixel_type!r}, expected {' or '.join(_WRITABLE[suffix])} for {suffix}"
        )
    compressions = get_args(Compression) if suffix == ".exr" else ("zip",)
    if compression not in compressions:
        raise SettingsError(
            f"{path}: compression {compression!r}, expected {', '.join(compressions)} for {suffix}"
        )
    stored = _to_stored(path, values, pixel_type)
    temporary = path.with_name(f".{os.urandom(8).hex()}{suffix}")
    try:
        temporary.touch(exist_ok=False)
        _write(temporary, stored, pixel_type, compression, attributes)
        kept = read_header(temporary).attributes
        lost = [name for name, text in attributes.items() if kept.get(name) != text]
        if lost:
            raise SettingsError(
                f"{path}: {suffix} does not keep attribute {lost[0]!r} as it is; expected a name such as "
                "'todframes:seed' and a text, not empty, without NUL"
            )
        temporary.replace(path)
    except FrameError as error:
        raise FrameError(path, error.problem) from None
    except OSError as error:
        raise FrameError(path, f"cannot be written: {error.strerror}") from None
    finally:
        if path.parent.is_dir():
            temporary.unlink(missing_ok=True)


def _write(
    path: Path, stored: NDArray[Any], pixel_type: str, compression: str, attributes: Mapping[str, str]
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
    if output is None or not (output.close() and written) or output.has_error:
        raise FrameError(path, f"cannot be written: {_reason(output)}")


def _to_stored(path: Path, values: ArrayLike, pixel_type: PixelType) -> NDArray[Any]:
    """Code values in the pixel type of the file, (rows, columns, channels), checked."""
    pixels = np.asarray(values)
    if pixels.ndim == 2:
        pixels = pixels[..., np.newaxis]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3) or pixels.size == 0 or pixels.dtype.kind not in "fiu":
        raise FrameError(
            path,
            f"found values of {pixels.dtype}, shape {np.shape(values)}; expected numbers, (H, W) or (H, W, 1 or 3)",
        )
    if pixel_type in _FULL_SCALE:
        bad = ~((pixels >= 0) & (pixels <= 1))
        stored = np.rint(np.where(bad, 0.0, pixels) * np.float64(_FULL_SCALE[pixel_type]))
        kind = "NaN or outside [0, 1]"
    else:
        with np.errstate(over="ignore", invalid="ignore"):
            stored = pixels.astype(_NUMPY_TYPES[pixel_type])
        bad = ~np.isfinite(stored)
        kind = f"NaN, infinite or beyond ±{np.finfo(_NUMPY_TYPES[pixel_type]).max:.6g}, the range of {pixel_type}"
    if bad.any():
        raise FrameError(path, f"{np.count_nonzero(bad)} values are {kind}")
    return np.ascontiguousarray(stored, _NUMPY_TYPES[pixel_type])


def _recognise(path: Path) -> str:
    """OpenImageIO's name of the format, by the content; the chunks of a PNG are checked against their CRC."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise FrameError(path, "not a file; expected an EXR or PNG file")
        if status.st_size == 0:
            raise FrameError(path, "the file is empty; expected an EXR or PNG file")
        with path.open("rb") as file:
            start = file.read(8)
            for magic, format_name in _FORMATS.items():
                if start.startswith(magic):
                    if format_name == "png":
                        _check_png(path, file, status.st_size)
                    return format_name
    except (OSError, ValueError) as error:
        if isinstance(error, FrameError):
            raise
        raise FrameError(path, f"cannot be opened: {getattr(error, 'strerror', None) or error}") from None
    raise FrameError(path, f"starts with bytes {start.hex(' ')}; expected an EXR or PNG file")


def _check_png(path: Path, file: BinaryIO, size: int) -> None:
    """Refuse damaged chunks here: libpng, which checks them too, prints on standard error as well."""
    name = ""
    while name != "IEND":
        header = file.read(8)
        length = int.from_bytes(header[:4], "big")
        if len(header) < 8 or length + 4 > size - file.tell():
            raise FrameError(path, f"the PNG is damaged or truncated: it ends at byte {size}, within a chunk")
        name = header[4:].decode("latin-1")
        content = file.read(length)
        if zlib.crc32(content, zlib.crc32(header[4:])) != int.from_bytes(file.read(4), "big"):
            raise FrameError(path, f"the PNG is damaged: checksum of a chunk {name!r} does not match its content")


def _clip(wanted: Range | None, first: int, count: int) -> Range:
    if wanted is None:
        return first, first + count
    begin, end = (min(max(int(edge), first), first + count) for edge in wanted)
    return begin, max(begin, end)


def _luminance_or_rgb(names: tuple[str, ...]) -> list[int] | None:
    """Channels to read of a part: of each layer Y, or else R, G, B; the channels without a layer first."""
    layers: dict[str, dict[str, int]] = {"": {}}
    for channel, name in enumerate(names):
        layer, _, kind = name.upper().rpartition(".")
        layers.setdefault(layer, {}).setdefault(kind, channel)
    for kinds in layers.values():
        for wanted in (("Y",), ("R", "G", "B")):
            if all(kind in kinds for kind in wanted):
                return [kinds[kind] for kind in wanted]
    return None


def _reason(source: Any) -> str:
    """What OpenImageIO says of a failure, in one line; `source` is the input or output, None: it has none."""
    try:
        message = oiio.geterror() if source is None else source.geterror()
    except UnicodeDecodeError:
        message = "OpenImageIO's message is not UTF-8"
    return " ".join(message.split()) or "OpenImageIO gives no reason"
