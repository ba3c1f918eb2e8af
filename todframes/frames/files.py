"""Reading of picture files, and writing of EXR and PNG frames; no other module calls OpenImageIO."""

from __future__ import annotations

import errno
import hashlib
import math
import os
import re
import shutil
import stat
import zlib
from abc import ABC, abstractmethod
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple, Self, get_args

import numpy as np
import OpenImageIO as oiio
from numpy.typing import ArrayLike, NDArray

from todframes.base.errors import FrameError, OutputError, SettingsError, TodframesError, argument
from todframes.base.reading import checked
from todframes.parameters import MAX_FRAME_MB, PathLike

Range = tuple[int, int]

PixelType = Literal["half", "float", "uint8", "uint16"]

MAX_SIDE_PX, MAX_CHANNELS = 32768, 256
"""Largest number of rows or columns of a frame, and of channels of its file."""

BAND_VALUES = 2**19
"""Number of values, of all channels, that are decoded at a time, unless one chunk of the file holds more."""

# OpenImageIO checks these, and `limits:imagesize_MB`, before it allocates anything.
oiio.attribute("limits:resolution", MAX_SIDE_PX)
oiio.attribute("limits:channels", MAX_CHANNELS)
oiio.attribute("limits:imagesize_MB", MAX_FRAME_MB)

_OPEN_OPTIONS = oiio.ImageSpec()
_OPEN_OPTIONS.attribute("oiio:UnassociatedAlpha", 1)  # or OpenImageIO multiplies PNG colours by alpha

NUMPY_TYPES: dict[PixelType, Any] = {
    "half": np.float16, "float": np.float32, "uint8": np.uint8, "uint16": np.uint16
}  # fmt: skip

READ_AS: dict[str, PixelType] = {name: name for name in NUMPY_TYPES} | {"int16": "float", "double": "float"}
"""Types of values, by those in the file. 32-bit floats do not hold integers of 32 bits, which are refused."""

FULL_SCALE: dict[PixelType, int] = {"uint8": 255, "uint16": 65535}
"""Stored value of code value 1, by integer pixel type."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of every PNG file."""

FORMATS = {
    rb"\x76\x2f\x31\x01": "EXR",
    re.escape(PNG_SIGNATURE): "PNG",
    rb"II[*+]\0|MM\0[*+]": "TIFF",
    rb"SDPX|XPDS": "DPX",
    rb"P[1-6]\s": "PNM",
    rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51": "JPEG 2000",
    rb"\xff\xd8\xff": "JPEG",
    rb"BM": "BMP",
    rb"GIF8": "GIF",
    rb"RIFF....WEBP": "WebP",
    rb"#\?RADIANCE": "Radiance HDR",
    rb"SIMPLE  =": "FITS",
    rb"version https://": "Git LFS pointer",
    rb"[FA]FF\0": "FLIR",
    rb"CED\0": "Cedip film",
    rb"\x93NUMPY": "NumPy",
    rb"PK\x03\x04": "zip",
    rb"\x1a\x45\xdf\xa3": "matroska video",
    rb"....(ftyp|moov|mdat|wide|free|skip)": "mov video",
    rb"RIFF....AVI ": "avi video",
    rb"YUV4MPEG2 ": "yuv4mpegpipe video",
    rb"\x06\x0e\x2b\x34": "mxf video",
    rb"\x30\x26\xb2\x75\x8e\x66\xcf\x11": "asf video",
    rb"OggS": "ogg video",
    rb"FLV\x01": "flv video",
    rb"nut/multimedia": "nut video",
    rb"\x00\x00\x01\xba": "mpeg video",
    rb"\x47.{187}\x47": "mpegts video",
    rb"\x00\x00\x00\x01[\x67\x27\x09]": "h264 video",
    rb"\x00\x00\x00\x01[\x40\x46]\x01": "hevc video",
}
"""Patterns of the first bytes of files, and the names of their formats; of videos, FFmpeg's names.

FFmpeg is given the format: playlists and scripts, which name other files or addresses, are none of them.
"""

N_START = 189
"""Number of bytes that these patterns need."""

PICTURE_FORMATS = {
    "EXR": "openexr", "PNG": "png", "TIFF": "tiff", "DPX": "dpx", "PNM": "pnm", "JPEG 2000": "jpeg2000",
    "JPEG": "jpeg",
}  # fmt: skip
"""Formats that are read, and OpenImageIO's names of them."""

FRAME_FORMATS = ("EXR", "PNG")
"""Formats of the frames of a dataset."""

PNM_NUMBER = rb"(?:\s|#[^\n]*\n)+(\d+)"
"""Pattern of a number in the header of a PNM, with what separates it from the one before."""

END_AND_START = b"\xff\xd9\xff\xd8\xff"
"""Bytes where one JPEG ends and another begins."""

INDEXED = b"\3"
"""Colour type of a PNG whose pixels are numbers of colours in a palette."""

ONE_EACH = "write each of them to a file of its own"

OTHER_ADVICE = {
    "JPEG": "its compression has changed the pixels; record frames without loss",
    "video": "write each of its frames to a file of its own",
    "pointer": "the frame itself is not here; fetch it with git lfs pull",
}
"""Advice for formats that need more than a conversion, by the last word of their names."""

THUMBNAIL, MASK = 1, 4
"""Bits of the tag NewSubfileType of a TIFF: a page of less resolution, and one that is a mask."""

LOSSY_TIFF = (6, 7, 34712, 34887, 34892, 50001, 50002, 52546)
"""Compressions of TIFF that can change pixels: JPEG, JPEG 2000, LERC, WebP and JPEG XL, by their numbers."""

REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities of Rec. 709: red, green, blue, white, as in an EXR. `Display` weighs channels by them."""

MAIN_LAYERS = frozenset(("rgb", "rgba", "beauty", "combined", "color", "colour", "main", "final"))
"""Words in the names of layers and parts of an EXR that have the picture; others have normals, depth, masks."""

MAX_EXR_HEADER = 2**24
"""Largest number of bytes of the headers of an EXR: OpenEXR holds an attribute in memory several times."""

MAX_DPX_USER_DATA = 2**20
"""Largest number of bytes of user data in a DPX. SMPTE 268M, section 5.3."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """A decoded rectangle of a frame.

    Attributes
    ----------
    stored : ndarray, shape (rows, columns, channels)
        Values in the file's pixel type, with one channel (grey or luminance) or three (R, G, B); floating-point
        values are finite.
    first_row, first_column : int
        Position of `stored[0, 0]` in the frame, whose top left pixel is (0, 0).
    height, width : int
        Size of the whole frame in pixels; for an EXR, of its display window.
    """

    stored: NDArray[Any]
    first_row: int
    first_column: int
    height: int
    width: int

    @property
    def values(self) -> NDArray[np.floating]:
        """Code values, of the shape of `stored`; see `code_values`."""
        return code_values(self.stored)


def code_values(stored: NDArray[Any]) -> NDArray[np.floating]:
    """Convert stored pixels to code values: 32-bit floats, integers divided by full scale; 64 bits stay."""
    values: NDArray[np.floating] = np.array(
        stored, np.float64 if stored.dtype == np.float64 else np.float32, order="C"
    )
    if stored.dtype.kind == "u":
        values /= 2 ** (8 * stored.itemsize) - 1
    return values


class HeaderWarning(NamedTuple):
    """A property of a file that makes its pixels doubtful: a code, and a sentence about the effect."""

    code: Literal["lossy_compression", "channels_chosen", "metadata_ignored"]
    message: str


@dataclass(frozen=True, slots=True)
class FrameHeader:
    """The size, pixel type, channels and text attributes of a frame file. `height` and `width` are the size of the
    whole frame in pixels. `first_row`, `first_column`, `n_rows` and `n_columns` are the rectangle of it that the
    file has pixels for: the part of an EXR's data window within its display window. `channels` names the one or
    three channels that are read, `pixel_type` is the widest of their types. `attributes` are the file's text
    attributes, without those about the layout of pixels. `full_scale` is the largest value that the file can hold,
    None for floating-point values.
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
    full_scale: int | None = None
    warnings: tuple[HeaderWarning, ...] = ()


class FrameSource(ABC):
    """An open frame, for a `with` statement: the header is read at once, pixels are read on request.

    A subclass has `path`, which names the frame in messages, `header` and `bands`. Rows and columns of rectangles
    are half-open ranges in frame coordinates, None for all, and are clipped to the pixels that the frame has.
    """

    path: Path
    header: FrameHeader

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:  # noqa: B027 - a frame in memory has nothing to close
        pass

    @property
    def stored_type(self) -> np.dtype[Any]:
        """Type of the values of `Frame.stored`."""
        stored_type: np.dtype[Any] = np.dtype(NUMPY_TYPES[self.header.pixel_type])
        return stored_type

    @abstractmethod
    def bands(self, *, rows: Range | None = None, columns: Range | None = None) -> Iterator[Frame]:
        """Yield a rectangle in bands of rows; FrameError if pixels are damaged, NaN or infinite."""

    def read(self, *, rows: Range | None = None, columns: Range | None = None) -> Frame:
        """Return a rectangle, without pixels if all of it is outside; errors are those of `bands`."""
        (top, bottom), (left, right) = self.clip(rows, columns)
        stored = np.empty((bottom - top, right - left, len(self.header.channels)), self.stored_type)
        for band in self.bands(rows=rows, columns=columns):
            stored[band.first_row - top :][: len(band.stored)] = band.stored
        return Frame(stored, top, left, self.header.height, self.header.width)

    def clip(self, rows: Range | None, columns: Range | None) -> tuple[Range, Range]:
        """Return the rows and columns of a rectangle that the frame has pixels for."""
        header = self.header
        return _clip(rows, header.first_row, header.n_rows), _clip(columns, header.first_column, header.n_columns)


class FrameFile(FrameSource):
    """An open picture file, for use in one thread; each thread opens the file itself. The format is recognised by
    the content and must be one of `formats`, which are among `PICTURE_FORMATS`. Given `content`, `path` only names
    it. With `sha256` the file must have this checksum. `max_frame_mb` limits, in 2**20 bytes, all channels of a
    part, decoded. Raises FrameError if the file cannot be used.
    """

    def __init__(
        self,
        path: PathLike,
        *,
        formats: Collection[str] = FRAME_FORMATS,
        content: bytes | None = None,
        sha256: str | None = None,
        max_frame_mb: int = MAX_FRAME_MB,
    ) -> None:
        self.path = Path(path)
        self._max_frame_mb = max_frame_mb
        with file_errors(self.path, "opened"), ExitStack() as stack:
            self._opened = local = _local(self.path, content, stack)
            self._format = _recognise(local, formats, sha256)
            # Options make an EXR three times as slow to open and have no effect on it.
            options = () if self._format == "EXR" else (_OPEN_OPTIONS,)
            # OpenImageIO's limit is that of the process, the largest one asked for.
            if max_frame_mb > oiio.get_int_attribute("limits:imagesize_MB"):
                oiio.attribute("limits:imagesize_MB", max_frame_mb)
            self._image: Any = oiio.ImageInput.open(str(local), *options)
            if self._image is None or self._image.format_name() != PICTURE_FORMATS[self._format]:
                raise FrameError(self.path, f"cannot be opened: {self._reason()}")
            stack.callback(self._image.close)
            self.header = self._read_header(0 if self._format == "EXR" else self._picture(0) or 0)
            self._resources = stack.pop_all()

    def __exit__(self, *_: object) -> None:
        self._resources.close()

    @property
    def metadata(self) -> dict[str, Any]:
        """All attributes of the page, by OpenImageIO's names."""
        return {attribute.name: attribute.value for attribute in self._spec.extra_attribs}

    def pages(self) -> Iterator[FrameHeader]:
        """Yield the header of each page, once; after it, `header` and `read` are those of that page. An EXR has
        one page: its parts are not pages. Masks and thumbnails in a TIFF are none.
        """
        yield self.header
        while self._format != "EXR" and (page := self._picture(self._part + 1)) is not None:
            self.header = self._read_header(page)
            yield self.header

    def _picture(self, page: int) -> int | None:
        """Return the number of the first page from one on that is no mask or thumbnail; None if there is none."""
        while self._image.seek_subimage(page, 0):
            if not self._image.spec().get_int_attribute("tiff:subfiletype") & (THUMBNAIL | MASK):
                return page
            page += 1
        return None

    def bands(self, *, rows: Range | None = None, columns: Range | None = None) -> Iterator[Frame]:
        """Yield a rectangle of the frame in bands of rows from top to bottom, each of about `BAND_VALUES` values.
        No more of the file is decoded than the chunks or tiles that the rectangle touches, and no chunk of scan
        lines twice.
        """
        (top, bottom), (left, right) = self.clip(rows, columns)
        for begin, end in self._band_rows(top, bottom) if left < right else ():
            stored = self._decode(begin, end, left, right)
            check_finite(self.path, stored, begin, left)
            yield Frame(stored, begin, left, self.header.height, self.header.width)

    def _band_rows(self, top: int, bottom: int) -> Iterator[Range]:
        """Yield ranges of rows that end where chunks or tiles end."""
        spec = self._spec
        # An EXR has at most 256 rows in a chunk, for any compression, and smaller numbers divide it.
        per_chunk = spec.tile_height or (1 if self._format == "PNG" else 256)
        per_chunk = spec.get_int_attribute("oiio:RowsPerChunk", per_chunk) or per_chunk
        n_chunks = BAND_VALUES // (spec.width * spec.nchannels * per_chunk)
        step, origin = max(n_chunks, 1) * per_chunk, spec.y - self._top
        while top < bottom:
            end = min(origin + ((top - origin) // step + 1) * step, bottom)
            yield top, end
            top = end

    def _read_header(self, page: int) -> FrameHeader:
        others = ""
        if self._format == "EXR":
            self._part, self._channels, others = self._choose_channels()
        else:
            n_channels = self._image.spec().nchannels
            if n_channels > 4:
                expected = "grey or R, G, B, with or without alpha"
                raise FrameError(self.path, f"found {n_channels} channels, expected {expected}")
            self._part, self._channels = page, [0, 1, 2] if n_channels > 2 else [0]
        self._spec = spec = self._image.spec()
        self._left, self._top, width, height = spec.full_x, spec.full_y, spec.full_width, spec.full_height
        if self._format != "EXR":  # the offset of a PNG or TIFF is its position on a printed page
            self._left, self._top, width, height = spec.x, spec.y, spec.width, spec.height
        sides = spec.width, spec.height, width, height
        if min(sides) < 1 or max(sides) > MAX_SIDE_PX or spec.depth > 1:
            found = f"{spec.width} x {spec.height} x {spec.depth} pixels in a frame of {width} x {height}"
            raise FrameError(self.path, f"found {found}, expected sides of 1 to {MAX_SIDE_PX} and depth 1")
        check_decoded_size(self.path, max(spec.image_bytes(True), spec.tile_bytes(True)), self._max_frame_mb)
        types = sorted({str(spec.channelformat(channel)) for channel in self._channels})
        self._file_type = "float" if types == ["float", "half"] else " ".join(types)
        if self._file_type not in READ_AS:
            raise FrameError(self.path, f"pixel type {types}, expected one of {', '.join(READ_AS)}")
        pixel_type = READ_AS[self._file_type]
        if spec.get_int_attribute("tiff:PhotometricInterpretation", 1) == 0 and pixel_type != "uint8":
            # OpenImageIO inverts values of up to 8 bits and no others; no standard says which float is white.
            bits = spec.get_int_attribute("oiio:BitsPerSample")
            raise FrameError(
                self.path,
                f"0 is white in this TIFF of {bits} bits (MINISWHITE), expected black; invert its values and "
                "write it as MINISBLACK",
            )
        first_row, first_column = max(0, spec.y - self._top), max(0, spec.x - self._left)
        n_rows = min(height, spec.y - self._top + spec.height) - first_row
        n_columns = min(width, spec.x - self._left + spec.width) - first_column
        if n_rows < 1 or n_columns < 1:
            raise FrameError(self.path, "the data window lies outside of the display window")
        channels = tuple(spec.channelnames[channel] for channel in self._channels)
        attributes = {
            name: text
            for name, text in self.metadata.items()
            if isinstance(text, str) and not name.startswith(("oiio:", "openexr:", "compression"))
        }
        warnings = [*self._loss(), *_ignored(spec, len(channels))]
        if self._format == "JPEG" and (n_pictures := _n_pictures(self._opened)) > 1:
            others = f"the first of {n_pictures} is read"
        if others:
            message = f"the {self._format} has several pictures: {others}; write the right one alone"
            warnings.append(HeaderWarning("channels_chosen", message))
        if self._format != "EXR" and spec.nchannels in (2, 4):
            warnings += self._transparency()
        return FrameHeader(
            height, width, first_row, first_column, n_rows, n_columns, channels, pixel_type, attributes,
            self._full_scale(), tuple(warnings),
        )  # fmt: skip

    def _choose_channels(self) -> tuple[int, list[int], str]:
        """Return the part of an EXR with the picture, its channels there, and which of several pictures it is. R,
        G, B come before Y; channels without a layer come first, then layers and parts that `MAIN_LAYERS` names.
        """
        pictures: list[tuple[int, bool, int, str, list[int]]] = []
        names: list[str] = []
        while self._image.seek_subimage(len(names), 0):
            part, spec = len(names), self._image.spec()
            of_part = spec.get_string_attribute("oiio:subimagename")
            for layer, kind, channels in () if spec.deep else _pictures(spec.channelnames):
                is_one = spec.get_int_attribute("oiio:subimages", 1) == 1
                name = layer if is_one else f"{of_part} {layer}".strip()
                words = re.findall(r"[a-z]+", name.lower())
                rank = 0 if not name else 1 if MAIN_LAYERS.intersection(words) else 2
                pictures.append((rank, kind == "Y", part, f"{kind} of {name}" if name else kind, channels))
            names.append(("deep " if spec.deep else "") + " ".join(spec.channelnames))
        if not pictures and len(names) == 1 and " " not in names[0] and self._image.seek_subimage(0, 0):
            return 0, [0], ""
        if not pictures:
            raise FrameError(
                self.path, f"found channels {'; '.join(names)[:200]}; expected Y, or R, G and B, or only one"
            )
        pictures.sort()
        _, _, part, chosen, channels = pictures[0]
        self._image.seek_subimage(part, 0)
        others = ", ".join(name for *_, name, _ in pictures[1:])[:200]
        return part, channels, f"{chosen} is read, not {others}" if others else ""

    def _full_scale(self) -> int | None:
        """Return the largest value that the page can hold: of its bits, or the one that a PNM declares."""
        if READ_AS[self._file_type] not in FULL_SCALE:
            return None
        if self._format == "PNM":
            return _pnm_maximum(self._opened)
        bits = self._spec.get_int_attribute("oiio:BitsPerSample", 0)
        return int(2**bits - 1) if 8 < bits < 16 else FULL_SCALE[READ_AS[self._file_type]]

    def _transparency(self) -> Iterator[HeaderWarning]:
        """Yield a warning if pixels of the page are not opaque. Damage is reported where they are read."""
        last = self._spec.nchannels - 1
        alpha = self._image.read_image(self._part, 0, last, last + 1, "float")
        self._image.geterror()
        if alpha is not None and (share := float((alpha < 1.0).mean())):
            yield HeaderWarning(
                "metadata_ignored",
                f"{100.0 * share:.3g} % of the pixels are transparent (alpha), which is not used: their colours "
                "are read as stored; convert the file if it means another picture",
            )

    def _loss(self) -> Iterator[HeaderWarning]:
        """Yield a warning if the compression of the page can change pixels."""
        what, name = self._format, self._spec.get_string_attribute("compression")
        if what == "EXR":
            is_lossy = name.startswith(("b44", "dwa")) or (name[:5] == "pxr24" and self._file_type == "float")
        elif what == "TIFF":
            is_lossy = self._spec.get_int_attribute("tiff:Compression", 1) in LOSSY_TIFF
        else:
            is_lossy = what == "JPEG" or (what == "JPEG 2000" and _is_irreversible(self._opened))
        if is_lossy:
            what = f"{what} by {name}" if what in ("EXR", "TIFF") else what
            yield HeaderWarning(
                "lossy_compression",
                f"{what} changes pixels: faint triangles and noise are not what the camera saw; record TIFF, PNG "
                "or EXR without loss",
            )

    def _decode(self, top: int, bottom: int, left: int, right: int) -> NDArray[Any]:
        """Decode the pixels of a rectangle of the frame, as stored."""
        spec, first_channel = self._spec, min(self._channels)
        what = first_channel, max(self._channels) + 1, self._file_type
        y_begin, y_end = top + self._top - spec.y, bottom + self._top - spec.y
        x_begin, x_end = left + self._left - spec.x, right + self._left - spec.x
        try:
            if spec.tile_width:
                y, y_stop = _whole_tiles(y_begin, y_end, spec.tile_height, spec.height)
                x, x_stop = _whole_tiles(x_begin, x_end, spec.tile_width, spec.width)
                box = x + spec.x, x_stop + spec.x, y + spec.y, y_stop + spec.y, spec.z, spec.z + 1
                stored = self._image.read_tiles(self._part, 0, *box, *what)
            else:
                x, y = 0, y_begin
                stored = self._image.read_scanlines(self._part, 0, y_begin + spec.y, y_end + spec.y, spec.z, *what)
        except RuntimeError as error:  # the system has no more threads for it, or no memory
            raise FrameError(self.path, f"cannot be decoded ({error})") from None
        if stored is None or self._image.has_error:
            raise FrameError(self.path, f"rows {top} to {bottom - 1} cannot be decoded: {self._reason()}")
        stored = stored[y_begin - y : y_end - y, x_begin - x : x_end - x]
        picks = [channel - first_channel for channel in self._channels]
        stored = np.asarray(stored if picks == list(range(stored.shape[2])) else stored[..., picks])
        full_scale, largest = self.header.full_scale, FULL_SCALE.get(self.header.pixel_type)
        if full_scale is None or largest is None or full_scale == largest:
            return stored.astype(self.stored_type, copy=False)
        # OpenImageIO stretches values to 8 or 16 bits: those of a PNM by a factor, rounded down, others by bits
        # below them.
        if self._format == "PNM":
            return (-(-stored.astype(np.int64) * full_scale // largest)).astype(stored.dtype)
        return np.asarray(stored >> (16 - full_scale.bit_length()))

    def _reason(self) -> str:
        """Return OpenImageIO's error message; it names a file in memory by a path of this process."""
        return _openimageio_reason(self._image, self._max_frame_mb).replace(str(self._opened), str(self.path))


def check_max_frame_mb(max_frame_mb: int) -> int:
    """Return a limit of the size of frames. Raises SettingsError if it is no whole number from 1 to 2**20."""
    from todframes.base.reading import check_whole  # it loads msgspec, which decoding does not need

    check_whole(argument.max_frame_mb, max_frame_mb, 1, 2**20)
    return max_frame_mb


def check_decoded_size(path: Path, n_bytes: int, max_frame_mb: int) -> None:
    """Raise FrameError if a frame has more bytes, decoded, than a limit in 2**20 bytes."""
    if n_bytes > max_frame_mb * 2**20:
        raise FrameError(path, _too_large(n_bytes / 2**20, max_frame_mb))


def _too_large(found_mb: float, max_frame_mb: int) -> str:
    found = math.ceil(found_mb)
    return (
        f"decodes to {found} MB a frame, expected at most {max_frame_mb} MB; if you trust the file, give "
        f"{argument.max_frame_mb} {found}"
    )


@checked
def read_frame(
    path: PathLike,
    *,
    rows: Range | None = None,
    columns: Range | None = None,
    max_frame_mb: int = MAX_FRAME_MB,
) -> Frame:
    """Read a frame file, or a rectangle of it.

    Parameters
    ----------
    path : path
        An EXR or PNG file.
    rows, columns : (int, int), optional
        Half-open ranges in frame coordinates, clipped to the pixels that the file has. Default: all.
    max_frame_mb : int
        Largest decoded size of the whole frame in 2**20 bytes: all channels, in their own pixel types.

    Returns
    -------
    Frame

    Raises
    ------
    FrameError
        If the file cannot be read or is too large, or one of these pixels is damaged, NaN or infinite.

    Examples
    --------
    >>> import todframes as tod
    >>> tod.read_frame("sample_frames/naked_eye/frames/s0.6_c0.155_up_0.exr", rows=(70, 90)).values.shape
    (20, 160, 1)
    """
    with FrameFile(path, max_frame_mb=max_frame_mb) as file:
        return file.read(rows=rows, columns=columns)


def frame_sha256(path: PathLike) -> str:
    """Compute the SHA-256 of a file, as 64 hexadecimal digits. Raises FrameError if it cannot be read."""
    path = Path(path)
    with file_errors(path, "read"):
        _check_is_file(path)
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()


def has_own_checksums(path: Path) -> bool:
    """Return whether a frame file contains checksums of all of its content: a PNG does, an EXR does not. Raises
    FrameError if the file cannot be read.
    """
    with file_errors(path, "read"):
        _check_is_file(path)
        with path.open("rb") as file:
            return format_of(file.read(N_START)) == "PNG"


@contextmanager
def file_errors(path: Path, what: str) -> Iterator[None]:
    """Raise a FrameError about a file in place of errors of Python; `what` is "opened" or "read"."""
    try:
        yield
    except FrameError as error:
        raise FrameError(path, error.problem) from None
    except TodframesError:
        raise
    except (OSError, ValueError) as error:
        raise FrameError(path, f"cannot be {what}: {getattr(error, 'strerror', None) or error}") from None


def _local(path: Path, content: bytes | None, stack: ExitStack) -> Path:
    """Return a local path of a file until `stack` is closed; given content is written to a temporary file."""
    if content is None:
        return path_in_utf8(path, stack)
    import tempfile

    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="todframes-"))
    local = Path(folder) / "content"
    local.write_bytes(content)
    return local


def path_in_utf8(path: Path, stack: ExitStack) -> Path:
    """Return a path that UTF-8 can encode, as libraries need it: of the open file if that of the file cannot be.
    The file is closed with `stack`. Raises FrameError or OSError if it cannot be opened.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        _check_is_file(path)
        return Path(f"/proc/self/fd/{stack.enter_context(path.open('rb')).fileno()}")
    return path


def _check_is_file(path: Path) -> None:
    """Raise FrameError if a file is a folder, or a pipe, which could block its reader for ever."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise FrameError(path, "found a folder or device, expected an EXR or PNG file")


def format_of(start: bytes) -> str | None:
    """Return the name of the format of a file that starts with these bytes, best `N_START`; None if unknown."""
    return next((name for pattern, name in FORMATS.items() if re.match(pattern, start, re.DOTALL)), None)


def _recognise(path: Path, formats: Collection[str], sha256: str | None) -> str:
    """Return the format of a file, one of `formats`, from its content, which must have the checksum."""
    _check_is_file(path)
    with path.open("rb") as file:
        if sha256 is not None:
            if (found := hashlib.file_digest(file, "sha256").hexdigest()) != sha256:
                raise FrameError(path, f"sha256 is {found}, the manifest says {sha256}")
            file.seek(0)
        start = file.read(N_START)
        name, expected = format_of(start), " or ".join(formats)
        if name is None:
            found = f"a file that starts with {start[:8]!r}" if start else "an empty file"
            raise FrameError(path, f"found {found}, expected {expected}")
        if name not in formats:
            convert = "convert it without loss, integers to PNG, floating-point values to EXR"
            advice = OTHER_ADVICE.get(name.rpartition(" ")[2], convert)
            raise FrameError(path, f"is a {name} file, expected {expected}: {advice}")
        if name in _CHECKS:
            _CHECKS[name](path, file)
    return name


def _check_png(path: Path, file: BinaryIO) -> None:
    """Raise FrameError if a chunk is damaged, as libpng would also print on standard error; if there are several
    pictures, or a pixel has no colour in the palette.
    """
    kind, end, size = b"", file.seek(len(PNG_SIGNATURE)), os.fstat(file.fileno()).st_size
    header, pixels, n_colours = b"", [], None
    while kind != b"IEND":
        length = int.from_bytes(file.read(4), "big")
        end += length + 12
        if end > size:
            raise FrameError(path, "the PNG is truncated or damaged: a chunk reaches beyond the end of the file")
        kind = file.read(4)
        checksum, n_colours = zlib.crc32(kind), length // 3 if kind == b"PLTE" else n_colours
        while length:  # a chunk can claim 2 GB
            checksum = zlib.crc32(block := file.read(min(length, 2**20)), checksum)
            length -= len(block)
            header = block if kind == b"IHDR" else header
            pixels += [block] if kind == b"IDAT" and header[9:10] == INDEXED else []
            if kind == b"acTL" and (n_frames := int.from_bytes(block[:4], "big")) > 1:
                raise FrameError(path, f"is an animation of {n_frames} frames, expected one; {ONE_EACH}")
        if checksum != int.from_bytes(file.read(4), "big"):
            raise FrameError(path, f"the PNG is damaged: chunk {kind!r} does not match its checksum")
    if file.read(len(PNG_SIGNATURE)) == PNG_SIGNATURE:
        raise FrameError(path, f"another PNG follows the first, expected one; {ONE_EACH}")
    if n_colours is not None and pixels and n_colours < 2 ** header[8]:
        _check_palette(path, header, b"".join(pixels), n_colours)


def _check_palette(path: Path, header: bytes, pixels: bytes, n_colours: int) -> None:
    """Raise FrameError if a pixel has no colour in the palette: libpng makes it black. As a grey picture, which is
    stored in the same way, the PNG shows the numbers of the colours.
    """
    import cv2

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4, "big") + kind + data + zlib.crc32(kind + data).to_bytes(4, "big")

    grey = chunk(b"IHDR", header[:9] + b"\0" + header[10:]) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    try:
        shown = cv2.imdecode(np.frombuffer(PNG_SIGNATURE + grey, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return  # too large: another check refuses it
    most = 0 if shown is None else int(shown.max()) * (2 ** header[8] - 1) // 255
    if most >= n_colours:
        raise FrameError(path, f"the PNG is damaged: a pixel has colour {most} of a palette of {n_colours}")


def _check_exr(path: Path, file: BinaryIO) -> None:
    """Raise FrameError if the headers of an EXR are too large, which a small sparse file can claim."""
    file.seek(4)
    is_multipart = int.from_bytes(file.read(4), "little") & 0x1000
    n_bytes = 8
    while True:
        file.seek(n_bytes)
        name, _, rest = file.read(2 * 256 + 4).partition(b"\0")
        if not name:
            if not is_multipart or rest[:1] in (b"", b"\0"):
                return
            n_bytes += 1
            continue
        kind, _, rest = rest.partition(b"\0")
        n_bytes += len(name) + len(kind) + 6 + int.from_bytes(rest[:4], "little")
        if n_bytes > MAX_EXR_HEADER:
            raise FrameError(path, f"its header claims {n_bytes} bytes, expected at most {MAX_EXR_HEADER}")


def _check_dpx(path: Path, file: BinaryIO) -> None:
    """Raise FrameError if a DPX claims more user data than its standard allows."""
    file.seek(0)
    start = file.read(36)
    n_bytes = int.from_bytes(start[32:36], "big" if start[:1] == b"S" else "little")
    if MAX_DPX_USER_DATA < n_bytes < 2**32 - 1:  # all bits are set in a number that is not known
        raise FrameError(path, f"claims {n_bytes} bytes of user data, expected at most {MAX_DPX_USER_DATA}")


def _check_pnm(path: Path, file: BinaryIO) -> None:
    """Raise FrameError if the header of a PNM has anything but digits, or another image follows the first."""
    file.seek(0)
    content = file.read(4096)
    header = re.match(rb"P(?:([14])|[2356])" + 2 * PNM_NUMBER + rb"(?(1)|%b)\s" % PNM_NUMBER, content)
    if header is None:
        raise FrameError(path, f"found the PNM header {content[:32]!r}, expected digits alone in its numbers")
    kind, columns, rows, maximum = content[1] - ord("0"), int(header[2]), int(header[3]), int(header[4] or 1)
    if kind > 3:
        n_row = -(-columns // 8) if kind == 4 else columns * (3 if kind == 6 else 1) * (1 + (maximum > 255))
        file.seek(header.end() + rows * n_row)
        has_another = re.match(rb"\s*P[1-6]\s", file.read(64))
    else:
        has_another = re.search(rb"\nP[1-6]\s", content + file.read())
    if has_another:
        raise FrameError(path, f"another image follows the first, expected one; {ONE_EACH}")


_CHECKS = {"PNG": _check_png, "EXR": _check_exr, "DPX": _check_dpx, "PNM": _check_pnm}
"""Checks of a file before OpenImageIO opens it."""


def _pnm_maximum(path: Path) -> int:
    with path.open("rb") as file:
        start = file.read(4096)
    numbers = re.match(rb"P[2356]" + 3 * PNM_NUMBER, start)
    return 255 if numbers is None else int(numbers[3])  # OpenImageIO makes 0 and 255 of the two values of a bitmap


def _n_pictures(path: Path) -> int:
    """Return the number of pictures in a JPEG: by its index (CIPA DC-007, MPF), or one behind the other."""
    content = path.read_bytes()
    number = re.search(
        rb"MPF\0.{8,64}?(?:\xb0\x01\0\x04\0{3}\x01(.{4})|\x01\xb0\x04\0\x01\0{3}(.{4}))", content, re.DOTALL
    )
    by_index = 0 if number is None else int.from_bytes(number[1] or number[2][::-1], "big")
    return max(by_index, 1 + content.count(END_AND_START))


def _is_irreversible(path: Path) -> bool:
    """Return whether a JPEG 2000 has the wavelet 9-7, whose numbers are rounded. ITU-T T.800, annex A.6.1."""
    with path.open("rb") as file:
        content = file.read(2**20)
    at = content.find(b"\xff\x4f\xff\x51") + 2
    while content[at : at + 1] == b"\xff" and content[at + 1] != 0x52:
        at += 2 + int.from_bytes(content[at + 2 : at + 4], "big")
    return content[at + 13 : at + 14] == b"\0"


def _ignored(spec: Any, n_channels: int) -> Iterator[HeaderWarning]:
    """Yield a warning if a file states something about its pixels that is not used."""
    stated = []
    if (orientation := spec.get_int_attribute("Orientation", 1)) not in (0, 1):
        stated.append(f"orientation {orientation} (turned or mirrored)")
    aspect = spec.get_float_attribute("PixelAspectRatio", 1.0)
    if aspect > 0.0 and abs(aspect - 1.0) > 0.005:  # files have resolutions as whole numbers
        stated.append(f"a pixel aspect ratio of {aspect:.4g}")
    if (white := spec.get_float_attribute("whiteLuminance", 0.0)) > 0.0:
        stated.append(f"whiteLuminance {white:.4g} cd/m²")
    primaries = spec.getattribute("chromaticities")
    # By the author, the white point is 0.3127 or 0.31271.
    is_known = primaries is None or np.allclose(primaries, REC_709, rtol=0.0, atol=0.002)
    if n_channels > 1 and not is_known:
        stated.append("chromaticities other than those of Rec. 709")
    if stated:
        yield HeaderWarning(
            "metadata_ignored",
            f"the file states {', '.join(stated)}, which is not used: pixels are read as stored, and shown as "
            "squares in the light of a display; convert the file if it means another picture",
        )


def check_finite(path: Path, stored: NDArray[Any], row: int, column: int) -> None:
    """Raise FrameError if pixels of a rectangle, the first at (row, column), are NaN or infinite."""
    if stored.dtype.kind == "u":
        return
    is_half = stored.dtype == np.float16  # numpy's isfinite takes five times as long for it
    bad = (stored.view(np.uint16) & 0x7C00) == 0x7C00 if is_half else ~np.isfinite(stored)
    if bad.any():
        places = np.argwhere(bad.any(axis=2))
        where = f"row {places[0, 0] + row}, column {places[0, 1] + column}"
        raise FrameError(path, f"{len(places)} pixels are NaN or infinite, the first at {where}")


def _clip(wanted: Range | None, first: int, count: int) -> Range:
    if wanted is None:
        return first, first + count
    begin, end = wanted
    begin = min(max(begin, first), first + count)
    return begin, max(begin, min(end, first + count))


def _whole_tiles(begin: int, end: int, tile: int, size: int) -> Range:
    return begin - begin % tile, min(-(-end // tile) * tile, size)


@lru_cache
def _pictures(names: tuple[str, ...]) -> list[tuple[str, str, list[int]]]:
    """Return the layers with a picture, RGB or Y, and its channels. A Y beside an X is part of a vector."""
    layers: dict[str, dict[str, int]] = {"": {}}
    for channel, name in enumerate(names):
        layer, _, kind = name.rpartition(".")
        layers.setdefault(layer, {}).setdefault(kind.upper(), channel)
    return [
        (layer, wanted, [kinds[kind] for kind in wanted])
        for layer, kinds in layers.items()
        for wanted in ("RGB", "Y")
        if all(kind in kinds for kind in wanted) and (wanted == "RGB" or "X" not in kinds)
    ]


def _openimageio_reason(source: Any, max_frame_mb: int = MAX_FRAME_MB) -> str:
    """Return OpenImageIO's error message in one line; `source` is None if no input or output was created. Its own
    limit of a frame is the largest that this process has been given, so the message names `max_frame_mb`.
    """
    try:
        message = oiio.geterror() if source is None else source.geterror()
    except UnicodeDecodeError:
        message = ""
    if (beyond := re.search(r"image size ([\d.]+) MB exceeds the \d+ MB limit", message)) is not None:
        return _too_large(float(beyond[1]), max_frame_mb)
    # The rest of the message asks users to raise limits of OpenImageIO.
    message = message.partition("Possible corrupt input?")[0]
    return " ".join(message.split()) or "OpenImageIO gives no reason"


Compression = Literal["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab"]

_WRITABLE: dict[str, tuple[PixelType, ...]] = {".exr": ("half", "float"), ".png": ("uint16", "uint8")}


@checked
def write_frame(
    path: PathLike,
    values: ArrayLike,
    *,
    pixel_type: PixelType | None = None,
    compression: Compression = "zip",
    attributes: Mapping[str, str] | None = None,
) -> None:
    """Write code values to an EXR or PNG file.

    The file is written whole or not at all; the same input gives the same bytes.

    Parameters
    ----------
    path : path
        A name that ends in .exr or .png. An existing file is replaced.
    values : array_like, (rows, columns) or (rows, columns, 1 or 3)
        Code values; one channel is written as Y, three as R, G, B. PNG takes values in [0, 1], rounded to nearest.
    pixel_type : {"half", "float", "uint16", "uint8"}, optional
        The first two are for EXR, the last two for PNG. Default: half for EXR, uint16 for PNG.
    compression : str
        Compression of an EXR; a PNG has "zip" only.
    attributes : mapping of str to str, optional
        Texts that `read_header` returns under the same names. A name should have a prefix, as in "todframes:seed";
        the formats rename or drop some names without one.

    Raises
    ------
    SettingsError
        If the extension, pixel type or compression is none of these, or the format cannot keep an attribute.
    FrameError, a ValueError
        If values have another shape, are not finite or lie beyond the pixel type's range.
    OutputError, an OSError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import todframes as tod
    >>> path = Path(tempfile.mkdtemp()) / "grey.png"
    >>> tod.write_frame(path, np.full((4, 6), 0.5))
    >>> frame = tod.read_frame(path)
    >>> frame.values.shape, round(float(frame.values[0, 0, 0]), 4)
    ((4, 6, 1), 0.5)
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
        with FrameFile(temporary, max_frame_mb=MAX_FRAME_MB + stored.nbytes // 2**20) as file:
            kept = file.header.attributes
            file.read()  # OpenImageIO does not report a disk that fills up with the last bytes of an EXR
        lost = [name for name, text in attributes.items() if kept.get(name) != text]
        if lost:
            like = "a name such as 'todframes:seed' and a text that is not empty and without NUL"
            raise SettingsError(f"{path}: {suffix} does not keep attribute {lost[0]!r} as it is, expected {like}")
        temporary.replace(path)
    except FrameError as error:  # libraries describe a full disk as a file that they cannot read again
        is_full = path.parent.is_dir() and shutil.disk_usage(path.parent).free < stored.nbytes
        problem = os.strerror(errno.ENOSPC) if is_full else error.problem
        raise OutputError(f"{path}: cannot be written: {problem}") from None
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
        raise FrameError(path, _openimageio_reason(output))


def _to_stored(path: Path, values: ArrayLike, pixel_type: PixelType) -> NDArray[Any]:
    """Convert code values to the file's pixel type, (rows, columns, channels); FrameError if they do not fit."""
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
