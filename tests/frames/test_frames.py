"""Frames: what is written comes back, parts equal wholes, and bad files give one line, never a crash."""

import hashlib
import os
import re
import struct
import subprocess
import sys
import textwrap
import time
import tracemalloc
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import OpenImageIO as oiio
import pytest

from todframes.base.errors import FrameError, OutputError, SettingsError
from todframes.base.safe_text import in_utf8
from todframes.frames import files
from todframes.frames.files import FrameFile, frame_sha256, read_frame, write_frame

HEIGHT, WIDTH = 40, 24
EXR_HEADER_END = b"screenWindowWidth\0float\0\4\0\0\0" + struct.pack("<f", 1.0) + b"\0"


def noise(*shape, seed=0):
    return np.random.default_rng(seed).random(shape)


def in_half(values):
    return np.float16(values).astype(np.float32)


def write_exr(path, *parts, compression="zip"):
    """EXR by OpenImageIO; a part is (array (H, W, C), channel names) and a dict: its name, fields of its spec."""
    specs = []
    for number, (array, names, fields) in enumerate(parts):
        spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], str(fields.get("format", "half")))
        spec.channelnames = names
        for field, value in fields.items():
            if field not in ("format", "name"):
                setattr(spec, field, value)
        spec.attribute("compression", compression)
        spec.attribute("oiio:subimagename", fields.get("name", f"part{number}"))
        specs.append(spec)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), tuple(specs) if len(specs) > 1 else specs[0]), output.geterror()
    for number, (array, _, _) in enumerate(parts):
        assert number == 0 or output.open(str(path), specs[number], "AppendSubimage"), output.geterror()
        assert output.write_image(array), output.geterror()
    assert output.close(), output.geterror()


def png_chunk(kind, content):
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png_bytes(width, height, depth, colour_type, scan_lines, *extra, interlaced=False):
    """A PNG of `scan_lines`, each without its filter byte; `extra` chunks come before the pixels."""
    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, interlaced)
    content = zlib.compress(b"".join(b"\0" + line for line in scan_lines), 9)
    chunks = [png_chunk(b"IHDR", header), *extra, png_chunk(b"IDAT", content), png_chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def interlaced_png(grey):
    """Adam7: seven passes, each (first column, first row, column step, row step)."""
    passes = [(0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2)]
    lines = [line.tobytes() for x, y, dx, dy in passes for line in grey[y::dy, x::dx] if line.size]
    return png_bytes(grey.shape[1], grey.shape[0], 8, 0, lines, interlaced=True)


def exr_attribute(name, kind, content):
    return f"{name}\0{kind}\0".encode() + struct.pack("<i", len(content)) + content


def flip(path, position, mask=0x10):
    content = bytearray(path.read_bytes())
    content[position] ^= mask
    path.write_bytes(content)


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (HEIGHT, WIDTH, 1), (HEIGHT, WIDTH, 3)])
@pytest.mark.parametrize(
    ("pixel_type", "compression"),
    [
        *(("half", name) for name in ("none", "rle", "zips", "zip", "piz", "pxr24")),
        *(("float", name) for name in ("none", "rle", "zips", "zip", "piz")),
    ],
)
def test_lossless_exr_comes_back_exactly(tmp_path, pixel_type, compression, shape):
    values = 100 * noise(*shape) - 20
    write_frame(tmp_path / "a.exr", values, pixel_type=pixel_type, compression=compression)
    frame = read_frame(tmp_path / "a.exr")
    expected = in_half(values) if pixel_type == "half" else np.float32(values)
    assert np.array_equal(frame.values, expected.reshape(HEIGHT, WIDTH, -1))
    assert frame.values.dtype == np.float32
    assert (frame.first_row, frame.first_column, frame.height, frame.width) == (0, 0, HEIGHT, WIDTH)
    header = FrameFile(tmp_path / "a.exr").header
    assert header.pixel_type == pixel_type
    assert header.channels == (("R", "G", "B") if shape[2:] == (3,) else ("Y",))
    assert (header.height, header.width, header.n_rows, header.n_columns) == (HEIGHT, WIDTH) * 2


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (HEIGHT, WIDTH, 3)])
@pytest.mark.parametrize(("pixel_type", "full_scale"), [("uint8", 255), ("uint16", 65535)])
def test_png_rounds_to_nearest(tmp_path, pixel_type, full_scale, shape):
    values = noise(*shape)
    write_frame(tmp_path / "a.PNG", values, pixel_type=pixel_type)
    frame = read_frame(tmp_path / "a.PNG")
    steps = frame.values.astype(np.float64) * full_scale
    # Half a step of rounding, and float32 of a value up to full_scale: full_scale * 2^-25.
    assert np.abs(steps.reshape(shape) - values * full_scale).max() <= 0.5 + full_scale * 2**-25
    # What has been rounded is not changed by a second passage.
    write_frame(tmp_path / "b.png", frame.values, pixel_type=pixel_type)
    assert np.array_equal(read_frame(tmp_path / "b.png").values, frame.values)
    assert FrameFile(tmp_path / "a.PNG").header.pixel_type == pixel_type


ATTRIBUTES = {
    "todframes:seed": "12",
    "sensor_sim:snr": "1.5",
    "todframes:note": "two\nlines, γ and 漢字 ",
    "todframes:a_rather_long_name_for_an_attribute": "x" * 10_000,
}


@pytest.mark.parametrize("suffix", [".exr", ".png"])
@pytest.mark.parametrize("attributes", [ATTRIBUTES, {}], ids=["some", "none"])
def test_attributes_come_back_under_their_names(tmp_path, attributes, suffix):
    write_frame(tmp_path / f"a{suffix}", noise(4, 4), attributes=attributes)
    assert FrameFile(tmp_path / f"a{suffix}").header.attributes == attributes


def test_same_values_give_the_same_bytes(tmp_path, monkeypatch):
    """Under another name and at another time of day, which OpenImageIO writes if no text is in its place."""
    (tmp_path / "other").mkdir()
    for suffix in (".exr", ".png"):
        for path, zone in ((tmp_path / f"a{suffix}", "UTC"), (tmp_path / "other" / f"b{suffix}", "Asia/Tokyo")):
            monkeypatch.setenv("TZ", zone)
            time.tzset()
            write_frame(path, noise(8, 8), attributes={"todframes:seed": "1"})
        content = path.read_bytes()
        assert content == (tmp_path / f"a{suffix}").read_bytes()
        assert frame_sha256(path) == hashlib.sha256(content).hexdigest()
    monkeypatch.undo()
    time.tzset()


TILES = {"tile_width": 16, "tile_height": 8}
OFFSET = {"x": 7, "y": 2, "full_x": 2, "full_y": -3, "full_width": 30, "full_height": 50}
OVERHANGING = {"x": -5, "y": -6, "full_width": 10, "full_height": 20}
LAYOUTS = {
    "scanline": [("Y", {})],
    "tiled": [("RGB", TILES)],
    "multipart": [("Z", {}), ("RGB", {})],
    "offset": [("Y", OFFSET)],
    "offset tiled": [("Y", OFFSET | TILES)],
    "overhanging": [("Y", OVERHANGING)],
    "overhanging tiled": [("Y", OVERHANGING | TILES)],
}


def make_layout(path, layout):
    if layout == "png":
        write_frame(path, noise(HEIGHT, WIDTH, 3))
    elif layout == "interlaced png":
        path.write_bytes(interlaced_png((255 * noise(HEIGHT, WIDTH)).astype(np.uint8)))
    else:
        parts = [(noise(HEIGHT, WIDTH, len(names)), tuple(names), fields) for names, fields in LAYOUTS[layout]]
        write_exr(path, *((values.astype(np.float16), names, fields) for values, names, fields in parts))


@pytest.mark.parametrize("layout", [*LAYOUTS, "png", "interlaced png"])
def test_part_equals_slice_of_whole(tmp_path, layout):
    path = tmp_path / ("a.png" if "png" in layout else "a.exr")
    make_layout(path, layout)
    whole = read_frame(path)
    top, left = whole.first_row, whole.first_column
    bottom, right = top + whole.values.shape[0], left + whole.values.shape[1]
    rng = np.random.default_rng(2)
    with FrameFile(path) as file:
        for _ in range(30):
            rows = tuple(sorted(rng.integers(-5, 60, 2).tolist()))
            columns = tuple(sorted(rng.integers(-5, 40, 2).tolist()))
            part = file.read(rows=rows, columns=columns)
            row, stop_row = np.clip(rows, top, bottom)
            column, stop_column = np.clip(columns, left, right)
            expected = whole.values[row - top : stop_row - top, column - left : stop_column - left]
            assert np.array_equal(part.values, expected)
            assert (part.first_row, part.first_column) == (row, column)
            assert (part.height, part.width) == (whole.height, whole.width)
    assert np.array_equal(read_frame(path, rows=(top, bottom)).values, whole.values)


@pytest.mark.parametrize("tiles", [{}, {"tile_width": 16, "tile_height": 16}])
@pytest.mark.parametrize(
    ("x", "y", "rectangle"),
    # Frame: (2, -3) to (32, 47); data 24 wide, 40 high from (x, y). (first row, first column, rows, columns)
    [(2, -3, (0, 0, 40, 24)), (7, 2, (5, 5, 40, 24)), (-10, -13, (0, 0, 30, 12)), (20, 30, (33, 18, 17, 12))],
)
def test_pixels_lie_where_the_windows_say(tmp_path, x, y, rectangle, tiles):
    # Values number the pixels of the data window, so they tell where each came from. Half holds integers to 2048.
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    counted = (rows * WIDTH + columns)[..., np.newaxis].astype(np.float16)
    window = {"x": x, "y": y, "full_x": 2, "full_y": -3, "full_width": 30, "full_height": 50}
    write_exr(tmp_path / "a.exr", (counted, ("Y",), {**window, **tiles}))
    frame, header = read_frame(tmp_path / "a.exr"), FrameFile(tmp_path / "a.exr").header
    assert (header.first_row, header.first_column, header.n_rows, header.n_columns) == rectangle
    assert (frame.first_row, frame.first_column, *frame.values.shape[:2]) == rectangle
    assert (frame.height, frame.width) == (50, 30)
    first_row, first_column = frame.first_row - 3 - y, frame.first_column + 2 - x
    assert frame.values[0, 0, 0] == first_row * WIDTH + first_column
    assert frame.values[-1, -1, 0] == (first_row + rectangle[2] - 1) * WIDTH + first_column + rectangle[3] - 1


@pytest.mark.parametrize("tiles", [{}, {"tile_width": 8, "tile_height": 16}])
def test_only_the_rows_asked_for_are_decoded(tmp_path, tiles):
    path = tmp_path / "a.exr"
    values = np.broadcast_to(np.arange(64, dtype=np.float16)[:, np.newaxis, np.newaxis], (64, 8, 1))
    write_exr(path, (np.ascontiguousarray(values), ("Y",), tiles))
    content = path.read_bytes()
    table = content.index(EXR_HEADER_END) + len(EXR_HEADER_END) if not tiles else None
    if tiles:
        path.write_bytes(content[:-3])
    else:
        flip(path, struct.unpack_from("<4Q", content, table)[3] + 12)
    assert np.array_equal(read_frame(path, rows=(0, 48)).values, values[:48].astype(np.float32))
    with pytest.raises(FrameError, match="rows 40 to 63 cannot be decoded"):
        read_frame(path, rows=(40, 64))


VALUES = {"R": 1.0, "G": 2.0, "B": 3.0, "Y": 4.0, "A": 0.5, "X": 8.0, "Z": 9.0}


def write_channels(path, *parts):
    arrays = [np.array([VALUES[name[-1].upper()] for name in names], np.float16) for names in parts]
    write_exr(
        path, *((np.tile(array, (4, 4, 1)), tuple(names), {}) for array, names in zip(arrays, parts, strict=True))
    )


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        *((("Y",), "Y"), (("Z",), "Z"), (("YA",), "Y"), (("ZA", ["left.Y"]), "Y")),
        *(((names,), "RGB") for names in ("RGBA", "BGR", "rgb")),
        ((["Z", "beauty.B", "beauty.G", "beauty.R", "beauty.A"],), "RGB"),
        (("Z", "RGB"), "RGB"),
    ],
)
def test_channels_are_chosen_by_name(tmp_path, parts, expected):
    write_channels(tmp_path / "a.exr", *parts)
    frame, header = read_frame(tmp_path / "a.exr"), FrameFile(tmp_path / "a.exr").header
    assert frame.values[2, 2].tolist() == [VALUES[name] for name in expected]
    assert [name[-1].upper() for name in header.channels] == list(expected)
    assert header.warnings == ()


@pytest.mark.parametrize(
    ("parts", "read", "left"),
    [
        ({"": "R G B Y"}, "RGB", "Y"),
        ({"": "diffuse.Y R G B"}, "RGB", "Y of diffuse"),
        ({"": "N.R N.G N.B Combined.R Combined.G Combined.B"}, "RGB of Combined", "RGB of N"),
        ({"": "N.R N.G N.B albedo.Y"}, "RGB of N", "Y of albedo"),
        ({"normals": "R G B", "beauty": "R G B"}, "RGB of beauty", "RGB of normals"),
        ({"grey": "Y", "hue": "R G B"}, "RGB of hue", "Y of grey"),
    ],
)
def test_of_several_pictures_one_is_read_with_a_warning(tmp_path, parts, read, left):
    """Every channel of the picture that is to be read is 1, every other one 0."""
    wanted = read.partition(" of ")[2]
    images = []
    for part, text in parts.items():
        names = text.split()
        layers = [name.rpartition(".")[0] or part for name in names]
        is_read = [layer == wanted and name[-1] in read[:3] for layer, name in zip(layers, names, strict=True)]
        images.append((np.tile(np.float16(is_read), (4, 4, 1)), tuple(names), {"name": part} if part else {}))
    write_exr(tmp_path / "a.exr", *images)
    (warning,) = FrameFile(tmp_path / "a.exr").header.warnings
    assert warning.code == "channels_chosen"
    assert f": {read} is read, not {left}; write the right one alone" in warning.message
    values = read_frame(tmp_path / "a.exr").values
    assert values.shape[2] == 3 and (values == 1.0).all()


BT_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
BT_2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)


@pytest.mark.parametrize(
    ("name", "kind", "numbers", "expected"),
    [
        ("chromaticities", "chromaticities", BT_2020, "chromaticities other than those of Rec. 709"),
        ("chromaticities", "chromaticities", BT_709, None),
        ("whiteLuminance", "float", (100.0,), "whiteLuminance 100 cd/m²"),
        ("Orientation", "int", (6,), r"orientation 6 \(turned or mirrored\)"),
        ("Orientation", "int", (1,), None),
    ],
)
def test_what_a_file_states_and_nothing_uses_is_in_a_warning(tmp_path, name, kind, numbers, expected):
    """An attribute put into an EXR by hand; the offset of its only chunk grows by as much."""
    content = struct.pack(f"<{len(numbers)}{'i' if kind == 'int' else 'f'}", *numbers)
    attribute = exr_attribute(name, kind, content)
    write_frame(tmp_path / "a.exr", np.zeros((2, 2, 3)))
    content = (tmp_path / "a.exr").read_bytes()
    end = content.index(EXR_HEADER_END) + len(EXR_HEADER_END)
    (offset,) = struct.unpack_from("<Q", content, end)
    changed = content[:8] + attribute + content[8:end] + struct.pack("<Q", offset + len(attribute))
    (tmp_path / "a.exr").write_bytes(changed + content[end + 8 :])
    warnings = FrameFile(tmp_path / "a.exr").header.warnings
    assert [one.code for one in warnings] == ["metadata_ignored"] * (expected is not None)
    assert all(re.search(f"the file states {expected}.*, which is not used", one.message) for one in warnings)


@pytest.mark.parametrize(
    ("compression", "pixel_type", "is_lossy"),
    [
        *(("zip", "half", False), ("piz", "float", False), ("pxr24", "half", False), ("pxr24", "float", True)),
        *(("b44", "half", True), ("b44a", "half", True), ("dwaa", "half", True), ("dwab", "float", True)),
    ],
)
def test_an_exr_that_has_lost_something_is_named(tmp_path, compression, pixel_type, is_lossy):
    values = np.add.outer(np.linspace(0, 1, 96), 0.1 * noise(96)) + 0.01 * noise(96, 96, seed=3)
    write_frame(tmp_path / "a.exr", values, pixel_type=pixel_type, compression=compression)
    written = values.astype(np.float16 if pixel_type == "half" else np.float32)
    assert (read_frame(tmp_path / "a.exr").stored[..., 0] != written).any() == is_lossy
    assert [one.code for one in FrameFile(tmp_path / "a.exr").header.warnings] == ["lossy_compression"] * is_lossy


@pytest.mark.parametrize(
    "parts", [("RG",), ("AZ",), ("Z", "A"), (["a.R", "b.G", "b.B"],), (["N.X", "N.Y", "N.Z"],)]
)
def test_other_channels_are_named_in_the_error(tmp_path, parts):
    write_channels(tmp_path / "a.exr", *parts)
    with pytest.raises(FrameError, match=f"found channels .*{parts[-1][-1]}.*; expected Y, or R, G and B"):
        read_frame(tmp_path / "a.exr")


def test_a_y_beside_an_x_is_part_of_a_vector(tmp_path):
    normals = (np.zeros((4, 4, 3), np.float16), ("N.X", "N.Y", "N.Z"), {})
    write_exr(tmp_path / "a.exr", normals, (np.ones((4, 4, 1), np.float16), ("Y",), {}))
    assert (read_frame(tmp_path / "a.exr").values == 1.0).all()


def test_each_channel_has_its_own_type(tmp_path):
    types = {"format": "float", "channelformats": (oiio.TypeDesc("half"), oiio.TypeDesc("float"))}
    write_exr(tmp_path / "a.exr", (np.float32([[[0.1, 0.2]]]), ("Y", "Z"), types))
    assert FrameFile(tmp_path / "a.exr").header.pixel_type == "half"
    assert read_frame(tmp_path / "a.exr").values[0, 0, 0] == np.float16(0.1)


def deep_exr(path):
    spec = oiio.ImageSpec(2, 2, 1, "half")
    spec.channelnames, spec.deep = ("Z",), True
    pixels = oiio.DeepData()
    pixels.init(4, 1, oiio.TypeDesc("half"), ("Z",))
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_deep_image(pixels), output.geterror()
    assert output.close()


ONES = np.ones((4, 4, 1))


@pytest.mark.parametrize(
    ("write", "problem"),
    [
        (lambda path: write_exr(path, (np.float16(ONES), ("Y",), {"x": 100})), "outside of the display window"),
        (lambda path: write_exr(path, (np.uint32(ONES), ("Y",), {"format": "uint"})), r"pixel type .*uint.*, exp"),
        (deep_exr, "found channels deep Z"),
    ],
    ids=["windows apart", "integers", "deep"],
)
def test_an_exr_of_another_kind_is_refused(tmp_path, write, problem):
    write(tmp_path / "a.exr")
    with pytest.raises(FrameError, match=problem):
        read_frame(tmp_path / "a.exr")


PALETTE = png_chunk(b"PLTE", bytes([255, 0, 0, 0, 255, 0, 0, 0, 51]))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (png_bytes(4, 1, 1, 0, [b"\x50"]), [[0], [255], [0], [255]]),
        (png_bytes(4, 1, 2, 0, [b"\x1b"]), [[0], [85], [170], [255]]),
        (png_bytes(2, 1, 4, 0, [b"\x1f"]), [[17], [255]]),
        (png_bytes(2, 1, 8, 4, [bytes([10, 0, 20, 128])]), [[10], [20]]),
        (png_bytes(2, 1, 8, 6, [bytes([10, 20, 30, 0, 40, 50, 60, 128])]), [[10, 20, 30], [40, 50, 60]]),
        (png_bytes(3, 1, 8, 3, [bytes([0, 1, 2])], PALETTE), [[255, 0, 0], [0, 255, 0], [0, 0, 51]]),
        (png_bytes(2, 1, 1, 3, [b"\x40"], PALETTE), [[255, 0, 0], [0, 255, 0]]),
        (png_bytes(1, 1, 8, 3, [b"\1"], PALETTE, png_chunk(b"tRNS", b"\0\x80")), [[0, 255, 0]]),
        (png_bytes(2, 1, 8, 0, [b"\x0a\x14"], png_chunk(b"tRNS", b"\0\x0a")), [[10], [20]]),
        (png_bytes(1, 1, 8, 0, [b"\x80"], png_chunk(b"gAMA", struct.pack(">I", 100_000))), [[128]]),
        (png_bytes(1, 1, 8, 0, [b"\x80"], png_chunk(b"oFFs", struct.pack(">iiB", 5, -7, 0))), [[128]]),
    ],
    ids=[
        *("1 bit", "2 bit", "4 bit", "grey alpha", "RGBA", "palette", "1-bit palette", "palette alpha"),
        *("transparent grey", "gamma", "page offset"),
    ],
)
def test_png_code_values_are_expanded_and_nothing_else(tmp_path, content, expected):
    (tmp_path / "a.png").write_bytes(content)
    frame = read_frame(tmp_path / "a.png")
    assert np.array_equal(frame.values[0], np.float32(expected) / np.float32(255))
    assert (frame.first_row, frame.first_column, frame.height) == (0, 0, 1)


def assert_refused(path, problem, read=read_frame):
    with pytest.raises(FrameError, match=problem) as caught:
        read(path)
    assert str(caught.value).startswith(f"{in_utf8(str(path))}: ")
    assert "\n" not in str(caught.value)


def test_names_that_open_image_io_does_not_take():
    assert_refused(Path("a\udc80.exr"), "cannot be opened")
    assert_refused(Path("a\0.exr"), "null (byte|character)")  # its name depends on the version of Python


@pytest.mark.parametrize(("message", "expected"), [
    ("image size 287.6 MB exceeds the 256 MB limit", "decodes to 288 MB a frame, expected at most 7 MB; if you "
     "trust the file, give max_frame_mb 288"),
    ("no such\n chunk. Possible corrupt input? Raise the limits", "no such chunk."),
    ("", "OpenImageIO gives no reason"),
    (UnicodeDecodeError("utf-8", b"", 0, 1, ""), "OpenImageIO gives no reason"),
])  # fmt: skip
def test_reasons_of_open_image_io(message, expected):
    assert files._openimageio_reason(Mock(geterror=Mock(side_effect=[message])), 7) == expected


def test_content_tells_the_format(tmp_path):
    write_frame(tmp_path / "a.exr", noise(4, 4))
    (tmp_path / "a.exr").rename(tmp_path / "a.png")
    assert np.array_equal(read_frame(tmp_path / "a.png").values[..., 0], in_half(noise(4, 4)))


@pytest.mark.parametrize("compression", ["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "dwaa", "dwab"])
def test_truncated_exr(tmp_path, compression):
    path = tmp_path / "a.exr"
    write_frame(path, noise(HEIGHT, WIDTH), compression=compression)
    content = path.read_bytes()
    for length in (8, 100, 300, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        assert_refused(path, "cannot be")


def test_truncated_or_flipped_png(tmp_path):
    path = tmp_path / "a.png"
    write_frame(path, noise(HEIGHT, WIDTH))
    content = path.read_bytes()
    for length in (12, 40, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:length])
        assert_refused(path, "truncated")
    for position in range(8, len(content), 31):
        path.write_bytes(content)
        flip(path, position)
        assert_refused(path, "truncated|does not match its checksum")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("pixel_type", ["half", "float"])
def test_pixels_that_are_not_finite_are_counted_and_placed(tmp_path, bad, pixel_type):
    values = np.ones((HEIGHT, WIDTH, 3), np.float32)
    values[20, 5, 1] = values[21, 3, 0] = values[21, 3, 2] = bad
    window = {"x": 10, "y": 4, "full_x": 1, "full_y": 1, "full_width": 60, "full_height": 60}
    write_exr(tmp_path / "a.exr", (values, ("R", "G", "B"), {"format": pixel_type, **window}))
    # Row 20 of the data is row 20 + 4 - 1 of the frame; column 5 is column 5 + 10 - 1.
    assert_refused(tmp_path / "a.exr", "2 pixels are NaN or infinite, the first at row 23, column 14")
    assert read_frame(tmp_path / "a.exr", rows=(0, 23)).values.shape == (20, WIDTH, 3)
    assert read_frame(tmp_path / "a.exr", columns=(0, 12)).values.shape == (HEIGHT, 3, 3)


@pytest.mark.parametrize("corner", [2**31 - 1, -(2**31)])
@pytest.mark.parametrize("window", [b"dataWindow\0box2i\0", b"displayWindow\0box2i\0"])
def test_exr_with_absurd_windows(tmp_path, window, corner):
    path = tmp_path / "a.exr"
    write_frame(path, noise(8, 8))
    content = bytearray(path.read_bytes())
    struct.pack_into("<2i", content, content.index(window) + len(window) + 4 + 8, corner, corner)
    path.write_bytes(content)
    assert_refused(path, "cannot be opened|expected")


@pytest.mark.slow
def test_a_chunk_of_png_is_not_held_in_memory(tmp_path):
    """A sparse chunk of 200 MB takes no room on the disk; its checksum is that of as many zeros."""
    size = 200 * 2**20
    checksum = zlib.crc32(b"spAr")
    for _ in range(200):
        checksum = zlib.crc32(bytes(2**20), checksum)
    start, end = png_bytes(4, 4, 8, 0, [bytes(4)] * 4).split(png_chunk(b"IEND", b""))
    with (tmp_path / "a.png").open("wb") as file:
        file.write(start + struct.pack(">I", size) + b"spAr")
        file.seek(size, 1)
        file.write(struct.pack(">I", checksum) + png_chunk(b"IEND", b"") + end)
    tracemalloc.start()
    assert (read_frame(tmp_path / "a.png").stored == 0).all()
    assert tracemalloc.get_traced_memory()[1] < 8 * 2**20
    tracemalloc.stop()


@pytest.mark.parametrize("parts", [1, 2])
def test_an_exr_with_a_sparse_header_is_refused(tmp_path, parts):
    """OpenEXR takes 7 bytes for each byte of an attribute of a type that it does not know: 14 GB for 2 GB."""
    write_exr(tmp_path / "a.exr", *[(np.zeros((4, 4, 1), np.float16), ("Y",), {})] * parts)
    content = (tmp_path / "a.exr").read_bytes()
    assert FrameFile(tmp_path / "a.exr").header.height == 4
    with (tmp_path / "a.exr").open("wb") as file:
        file.write(content[:8] + b"note\0weird\0" + struct.pack("<I", 2**30))
        file.seek(2**30, 1)
        file.write(content[8:])
    assert_refused(tmp_path / "a.exr", "its header claims 1073741847 bytes, expected at most 16777216")


def test_exr_with_absurd_tiles(tmp_path):
    path = tmp_path / "a.exr"
    make_layout(path, "tiled")
    content = bytearray(path.read_bytes())
    start = content.index(b"tiledesc\0") + 9 + 4
    for size in (2**30, 2**32 - 1, 0, 30_000):
        struct.pack_into("<2I", content, start, size, size)
        path.write_bytes(content)
        assert_refused(path, "cannot be|expected")


@pytest.mark.parametrize(
    ("name", "values", "problem"),
    [
        *(
            (name, [[bad, 0.5], [1.0, bad]], "2 values are NaN or beyond")
            for name in ("a.exr", "a.png")
            for bad in (np.nan, np.inf, -np.inf, 1e6, -1e6)
        ),
        *(("a.png", [[bad]], r"1 values are NaN or beyond \[0, 1\]") for bad in (-1e-9, 1 + 1e-9)),
        *(("a.exr", np.ones(shape), "expected numbers") for shape in (4, (4, 4, 2), (0, 4))),
        *(("a.exr", values, "expected numbers") for values in ([["a"]], [[1j]])),
    ],
)
def test_values_that_a_file_does_not_hold(tmp_path, name, values, problem):
    with pytest.raises(FrameError, match=problem):
        write_frame(tmp_path / name, values)
    assert list(tmp_path.iterdir()) == []


def test_float_exr_holds_what_half_does_not(tmp_path):
    write_frame(tmp_path / "a.exr", [[1e6]], pixel_type="float")
    assert read_frame(tmp_path / "a.exr").values[0, 0, 0] == 1e6
    with pytest.raises(FrameError, match=r"1 values are NaN or beyond ±3\.4"):
        write_frame(tmp_path / "a.exr", [[1e39]], pixel_type="float")


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("a.tif", {}, "extension '.tif', expected .exr or .png"),
        ("a", {}, "extension '', expected .exr or .png"),
        ("a.png", {"pixel_type": "half"}, "pixel type 'half', expected uint16 or uint8"),
        ("a.exr", {"pixel_type": "uint8"}, "pixel type 'uint8', expected half or float"),
        ("a.exr", {"compression": "jpeg"}, "compression: found 'jpeg', expected one of none, rle"),
        ("a.png", {"compression": "none"}, "compression 'none', expected zip"),
        ("a.png", {"attributes": {"Title": "x"}}, "does not keep attribute 'Title'"),
        ("a.exr", {"attributes": {"compression": "piz"}}, "does not keep attribute 'compression'"),
        ("a.exr", {"attributes": {"dataWindow": "x"}}, "does not keep attribute 'dataWindow'"),
        ("a.exr", {"attributes": {"todframes:x": ""}}, "does not keep attribute 'todframes:x'"),
        ("a.png", {"attributes": {"todframes:x": "a\0b"}}, "does not keep attribute 'todframes:x'"),
    ],
)
def test_bad_options(tmp_path, name, options, problem):
    with pytest.raises(SettingsError, match=problem):
        write_frame(tmp_path / name, noise(4, 4), **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_a_file_that_cannot_be_written(tmp_path, name):
    with pytest.raises(OutputError, match="cannot be written: No such file"):
        write_frame(tmp_path / "none" / name, noise(4, 4))
    (tmp_path / name).mkdir()
    with pytest.raises(OutputError, match="cannot be written: Is a directory"):
        write_frame(tmp_path / name, noise(4, 4))
    assert [entry.name for entry in tmp_path.iterdir()] == [name]
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written: Not a directory"):
        write_frame(tmp_path / "file" / name, noise(4, 4))


@pytest.mark.parametrize("suffix", [".exr", pytest.param(".png", marks=pytest.mark.slow)])
def test_disk_full_leaves_the_old_file(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_frame(path, noise(4, 4))
    content = path.read_bytes()
    script = f"""
        import resource
        from pathlib import Path
        import numpy as np
        from todframes.base.errors import OutputError
        from todframes.frames.files import write_frame
        values = np.random.default_rng(0).random((100, 100))
        write_frame("whole{suffix}", values)
        size = Path("whole{suffix}").stat().st_size
        Path("whole{suffix}").unlink()
        for limit in (size - 1, size - 100, size // 2, 1000, 4):
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            try:
                write_frame({str(path)!r}, values)
            except OutputError as error:
                assert str(error).startswith("{path}: cannot be written: ") and "\\n" not in str(error), error
            else:
                raise AssertionError(f"{{size}} bytes are in a file of {{limit}}")
    """
    run_python(script, cwd=tmp_path)
    assert path.read_bytes() == content
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("free", [0, 10**9])
def test_a_disk_without_room_is_the_reason_that_is_stated(tmp_path, monkeypatch, free):
    """OpenImageIO calls a file that the disk cut short corrupted; on a disk with room that stays the reason."""
    monkeypatch.setattr(files.shutil, "disk_usage", Mock(return_value=Mock(free=free)))
    monkeypatch.setattr(files, "_write", lambda path, *_: path.write_bytes(b"v/1\x01"))
    with pytest.raises(OutputError, match=r"a\.exr: cannot be written: ") as caught:
        write_frame(tmp_path / "a.exr", noise(4, 4))
    assert caught.value.args[0].endswith("No space left on device") is (free == 0)


def run_python(script, cwd):
    """Run a script; a crash, an exception or anything on standard error fails the test."""
    how = {"cwd": cwd, "env": {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}, "timeout": 60}
    command = [sys.executable, "-W", "error", "-X", "faulthandler", "-c", textwrap.dedent(script)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, **how)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(("name", "pixel_type"), [("a.exr", "half"), ("a.exr", "float"), ("a.png", "uint16")])
def test_a_frame_in_memory_is_decoded_as_its_file(tmp_path, name, pixel_type) -> None:
    """In many threads at once, bands and rectangles too."""
    values = np.random.default_rng(1).random((300, 200, 3)).astype(np.float32)
    write_frame(tmp_path / name, values, pixel_type=pixel_type, attributes={"todframes:seed": "7"})
    content = (tmp_path / name).read_bytes()

    def decoded(**kwargs: object) -> tuple[object, ...]:
        with FrameFile(tmp_path / name, **kwargs) as file:
            part = file.read(rows=(20, 31), columns=(3, 9))
            return file.header, file.read().stored.tobytes(), part.stored.tobytes()

    expected = decoded()
    (tmp_path / name).unlink()
    with ThreadPoolExecutor(8) as pool:
        assert all(found == expected for found in pool.map(lambda _: decoded(content=content), range(24)))
