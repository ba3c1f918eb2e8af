"""Recordings are read value for value: image sequences, camera raw, radiometric files and arrays."""

from __future__ import annotations

import hashlib
import io
import os
import re
import shutil
import struct
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from unittest.mock import Mock

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from PIL import Image
from test_frames import png_bytes, png_chunk, write_exr

import todframes as tod
from todframes.base.errors import DataError, SettingsError, in_command
from todframes.recordings import arrays, cedip, radiometric, raw
from todframes.recordings.arrays import memory_recording
from todframes.recordings.opening import ENTRY_POINT_GROUP, one_recording, open_recordings
from todframes.recordings.recording import check_rate, check_size, code_range, files_in, natural_order

RNG = np.random.default_rng(13)


def values_of(path, **settings):
    """The values of all frames, which are as any recording has them: the caller's own, and the same once more."""
    (recording,) = open_recordings(path, **settings)
    frames = list(recording.frames())
    assert len({frame.source for frame in frames}) == len(frames) == recording.n_frames
    for frame, again in zip(frames, recording.frames(), strict=True):
        assert frame.values.dtype in (np.uint8, np.uint16, np.float32) and frame.values.flags.writeable
        assert frame.values.shape == recording.shape + (3,) * recording.is_colour
        np.testing.assert_array_equal(frame.values, again.values)
    return np.array([frame.values for frame in frames])


def write_image(path, values, *, bits=0, attributes=()):
    """Write (rows, columns, channels) by OpenImageIO, n-bit values stretched to the 8 or 16 bits that it takes."""
    stored = {"float16": "half", "float32": "float"}.get(str(values.dtype), str(values.dtype))
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], stored)
    if bits:
        spec.attribute("oiio:BitsPerSample", bits)
        values = np.rint(values * (65535 / (2**bits - 1))).astype(np.uint16)
    for attribute in attributes:
        spec.attribute(*attribute)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(values), output.geterror()
    assert output.close()


@pytest.mark.parametrize("n_channels", [1, 3])
@pytest.mark.parametrize(
    ("name", "bits"),
    [
        *(("a.png", 8), ("a.png", 16), ("a.tif", 8), ("a.tif", 10), ("a.tif", 12), ("a.tif", 16)),
        *(("a.dpx", 10), ("a.dpx", 12), ("a.dpx", 16), ("a.ppm", 8), ("a.ppm", 16)),
        *(("a.jp2", 8), ("a.jp2", 12), ("a.jp2", 16)),
    ],
)
def test_integers_come_back_as_written(tmp_path, name, bits, n_channels):
    # 160 × 128 pixels: JPEG 2000 and packed DPX have rows of whole words.
    values = RNG.integers(0, 2**bits, (128, 160, n_channels)).astype(np.uint8 if bits == 8 else np.uint16)
    if name.endswith("ppm") and n_channels == 1:
        name = "a.pgm"
    write_image(tmp_path / name, values, bits=bits if bits not in (8, 16) else 0)
    (recording,) = open_recordings(tmp_path / name)
    (frame,) = recording.frames()
    assert recording.full_scale == 2**bits - 1
    assert recording.zero == 0
    assert recording.is_colour == (n_channels == 3)
    assert frame.values.dtype == values.dtype
    np.testing.assert_array_equal(frame.values, values if n_channels == 3 else values[..., 0])


@pytest.mark.parametrize("maximum", [1, 100, 200, 254, 255, 1000, 1023, 40000, 65534, 65535])
def test_a_pnm_keeps_the_scale_that_it_declares(tmp_path, maximum):
    values = np.arange(maximum + 1).reshape(1, -1).astype(">u2" if maximum > 255 else "u1")[:, -32768:]
    (tmp_path / "a.pgm").write_bytes(b"P5 # by hand\n%d 1\n%d\n" % (values.size, maximum) + values.tobytes())
    (recording,) = open_recordings(tmp_path / "a.pgm")
    assert recording.full_scale == maximum
    np.testing.assert_array_equal(next(recording.frames()).values, values)


def test_the_pages_of_a_file_are_frames(tmp_path):
    path, pages = tmp_path / "a.tif", RNG.integers(0, 65536, (3, 4, 6)).astype(np.uint16)
    tifffile.imwrite(path, pages, photometric="minisblack")
    (recording,) = open_recordings(path, frames_per_second=50)
    frames = list(recording.frames())
    np.testing.assert_array_equal([one.values for one in frames], pages)
    assert [one.time_s for one in frames] == [0, 0.02, 0.04]
    assert frames[2].source == "a.tif, page 2"
    assert recording.n_frames == 3


GREY = np.arange(24, dtype=np.uint8).reshape(4, 6)


def test_masks_and_thumbnails_of_a_tiff_are_no_frames(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as file:
        for page in (GREY, GREY + 1):
            file.write(page[::2, ::2].copy(), subfiletype=1)
            file.write(page, subfiletype=0)
            file.write(page > 5, subfiletype=4, photometric="mask")
    np.testing.assert_array_equal(values_of(tmp_path / "a.tif"), [GREY, GREY + 1])


def picture_bytes(pictures, **settings):
    content = io.BytesIO()
    first, *others = map(Image.fromarray, pictures)
    first.save(content, **settings, **({"append_images": others, "save_all": True} if others else {}))
    return content.getvalue()


def stack(description):
    content = io.BytesIO()
    tifffile.imwrite(content, np.tile(GREY, (40, 1, 1)), truncate=True, description=description, metadata=None)
    return content.getvalue()


PNG, PGM = picture_bytes([GREY], format="PNG"), b"P5\n6 4\n255\n" + GREY.tobytes()
IN_STACK, ANOTHER = (
    "found 1 page, expected 40 images by its description",
    "another image follows the first, expected",
)
FIRST_OF_2 = "the JPEG has several pictures: the first of 2 is read; write the right one alone"
SEVERAL = {
    "imagej.tif": (stack("ImageJ=1.54f\nimages=40\nslices=40\n"), IN_STACK),
    "tifffile.tif": (stack('{"shape": [40, 4, 6]}'), IN_STACK),
    "two.pgm": (PGM + PGM, ANOTHER),
    "two.pbm": (2 * b"P4\n9 2\n\xff\x80\0\0", ANOTHER),
    "plain.pgm": (2 * b"P2\n2 1\n9\n1 2\n", ANOTHER),
    "two.png": (PNG + PNG, "another PNG follows the first, expected one; write each of them"),
    "moves.png": (picture_bytes([GREY, GREY + 1, GREY + 2], format="PNG"), "an animation of 3 frames, expected"),
    "stereo.mpo": (picture_bytes([GREY, GREY + 1], format="MPO"), FIRST_OF_2),
    "two.jpg": (2 * picture_bytes([GREY], format="JPEG"), FIRST_OF_2),
    "one.jpg": (picture_bytes([GREY], format="JPEG"), ""),
    "one.pgm": (PGM + b"\n", ""),
    "text.pgm": (b"P2\n# P2 of 2\n2 1\n9\n1 2\n", ""),
    "one.png": (PNG + b"of my camera", ""),
}


@pytest.mark.parametrize("name", SEVERAL)
def test_what_lies_behind_the_first_image_is_refused_or_named(tmp_path, name):
    content, message = SEVERAL[name]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(tod.FrameError, match=message) if "exp" in message else nullcontext():
        warnings = dict(open_recordings(tmp_path / name)[0].warnings)
        assert warnings.get("channels_chosen", "") == message


@pytest.mark.parametrize(
    ("depth", "rows"), [(8, [b"\0\1\2", b"\1\1\1"]), (4, [b"\x01\x20"]), (2, [b"\x18"]), (8, [b"\2\2\2"])]
)
def test_colours_beyond_the_palette_are_refused(tmp_path, depth, rows):
    for n_colours in (3, 2):
        palette = png_chunk(b"PLTE", bytes(3 * n_colours))
        (tmp_path / "a.png").write_bytes(png_bytes(3, len(rows), depth, 3, rows, palette))
        message = "the PNG is damaged: a pixel has colour 2 of a palette of 2"
        with pytest.raises(tod.FrameError, match=message) if n_colours == 2 else nullcontext():
            open_recordings(tmp_path / "a.png")


def test_transparent_pixels_are_named(tmp_path):
    glass = np.full((4, 5, 4), 255, np.uint8)
    for n_glass in (0, 5):
        glass.reshape(-1, 4)[:n_glass, 3] = 9
        (tmp_path / "a.png").write_bytes(picture_bytes([glass], format="PNG"))
        told = [message[:33] for _, message in open_recordings(tmp_path / "a.png")[0].warnings]
        assert told == ["25 % of the pixels are transparent"[:33]] * (n_glass > 0)


def test_pictures_are_one_sequence_where_the_first_of_them_stands(tmp_path):
    for number, name in enumerate(("b.npy", "d.npy", "e.npy")):
        np.save(tmp_path / name, np.full((number + 1, 4, 5), number, np.uint8))
    two_pngs(tmp_path, names=("9.png", "10.png"))
    given = [tmp_path / name for name in ("b.npy", "10.png", "d.npy", "9.png", "e.npy")]
    shown = [(one.path.name, [frame.source for frame in one.frames()]) for one in open_recordings(given)]
    assert [name for name, _ in shown] == ["b.npy", "9.png", "d.npy", "e.npy"]
    assert shown[1][1] == ["9.png", "10.png"] and [len(sources) for _, sources in shown] == [1, 2, 2, 3]
    assert one_recording(given[2], "here").n_frames == 2
    folder = with_times(tmp_path / "folder", [], names=("f10.png", "f9.png"))
    (folder / "times.csv").rename(folder / ".hidden")
    recording = one_recording(folder, "here")
    assert [(one.source, one.time_s) for one in recording.frames()] == [("f9.png", None), ("f10.png", None)]
    assert (recording.path, recording.frames_per_second) == (folder, None)
    names = ", ".join(str(tmp_path / name) for name in ("b.npy", "9.png", "d.npy"))
    with pytest.raises(DataError, match=re.escape(f"here: found 4 recordings ({names} …), expected one")):
        one_recording(given, "here")


@pytest.mark.parametrize(
    "ordered",
    [
        "0.05 0.1 0.15 0.2",
        "t_0.5 t_0.55 t_0.6 t_0.65",
        "0.95 1 1.05 1.1",
        "0.1s 0.133s 0.167s 0.2s",
        "0.05 0.1 0.7 12.35",
        "1.8 1.9 1.10 1.11",
        "1.9 1.10",
        "cam1.98 cam1.99 cam1.100 cam1.101",
        "2.3 2.6 2.9 2.12",
        "f.0008 f.0009 f.0010",
        "10.png 20.png 100.png",
        "1 a09 a9 a9x a10 b1",
    ],
)
def test_numbers_of_names_are_decimals_where_they_are_times(ordered):
    names = ordered.split()
    assert natural_order(reversed(names)) == natural_order(names) == names
    assert natural_order(f"{name}.png" for name in reversed(names)) == [f"{name}.png" for name in names]


def test_another_package_may_register_a_reader(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "reference" / "recordings.md").read_text(encoding="utf-8")
    mine, registered = ModuleType("my_camera"), [*entry_points(group=ENTRY_POINT_GROUP)]
    exec(re.search(r"```python\n(.*?)```", page, re.DOTALL)[1], vars(mine))
    monkeypatch.setitem(sys.modules, "my_camera", mine)
    registered.append(EntryPoint("my_camera", "my_camera", ENTRY_POINT_GROUP))
    monkeypatch.setattr("importlib.metadata.entry_points", lambda **_: registered)
    values = np.arange(24, dtype="<u2").reshape(2, 3, 4)
    for number, frame in zip((10, 9), values, strict=True):
        (tmp_path / f"{number}.tif").write_bytes(b"MYCAM" + struct.pack("<2H", 4, 3) + frame.tobytes())
    (recording,) = open_recordings(tmp_path)
    assert (recording.shape, recording.full_scale, recording.n_frames) == ((3, 4), 4095.0, 2)
    np.testing.assert_array_equal([frame.values for frame in recording.frames()], values[::-1])
    (tmp_path / "9.tif").write_bytes(b"MYCAM" + struct.pack("<2H", 4, 3))
    with pytest.raises(tod.FrameError, match=r"9\.tif: has no 4 x 3 pixels"):
        open_recordings(tmp_path)
    registered.append(EntryPoint("b", "no_such_module", ENTRY_POINT_GROUP))
    without_arrays = [entry for entry in registered if entry.name != "array"]
    for entries, message in (
        ([*registered], r"reader b: cannot be imported \(ModuleNotFoundError"),
        (without_arrays[:-2], "reader array: is not registered; install todframes again"),
    ):
        monkeypatch.setattr("importlib.metadata.entry_points", lambda _entries=entries, **_: _entries)
        with pytest.raises(tod.SettingsError, match=message):
            open_recordings(tmp_path)


def test_a_picture_needs_no_reader_of_films(tmp_path):
    tod.write_frame(tmp_path / "a.png", np.zeros((4, 4)))
    code = (
        "import sys; from todframes.recordings.opening import open_recordings; open_recordings(sys.argv[1]); "
        "print([name for name in ('images', 'arrays', 'cedip', 'video') if f'todframes.recordings.{name}' in "
        "sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, tmp_path / "a.png"], capture_output=True, text=True, check=True
    )
    assert done.stdout == "['images']\n"


@pytest.mark.parametrize(
    ("name", "attribute", "rate"),
    [
        ("a.dpx", ("dpx:FrameRate", 25.0), 25.0),
        ("a.dpx", ("dpx:TemporalFrameRate", 0.5), 0.5),
        ("a.exr", ("FramesPerSecond", "rational", (30000, 1001)), 30000 / 1001),
        ("a.exr", ("FramesPerSecond", "rational", (0, 1)), None),
        ("a.exr", ("FramesPerSecond", "rational", (25, 0)), None),
    ],
)
def test_the_frame_rate_comes_from_the_file(tmp_path, name, attribute, rate):
    values = np.zeros((4, 160, 1), np.float32 if name.endswith("exr") else np.uint16)
    write_image(tmp_path / name, values, attributes=[attribute])
    assert open_recordings(tmp_path / name)[0].frames_per_second == rate
    assert open_recordings(tmp_path / name, frames_per_second=60)[0].frames_per_second == 60


def dpx(path, values, bits, *, packing, order=">", orientation=0, aspect=(1, 1), n_user=0):
    """Write one channel by hand, from the tables of SMPTE 268M; 12 bits fill words of 16 from either end."""
    rows, columns = values.shape
    words = values << (4 if bits == 12 and packing == 1 else 0)
    data = words.astype(order + ("u1" if bits == 8 else "u2")).tobytes()
    head = bytearray(b"\xff" * 2048)
    image = (orientation, 1, columns, rows, 0, 0, 0.0, 2**bits - 1, 1.0, 6, 2, 2, bits, packing, 0, 2048, 0, 0)
    struct.pack_into(f"{order}4sI8s5I", head, 0, b"SDPX", 2048, b"V1.0", 2048 + len(data), 1, 1664, 384, n_user)
    head[:4] = b"SDPX" if order == ">" else b"XPDS"
    struct.pack_into(f"{order}HHII IIfIf4BHHIII", head, 768, *image)
    struct.pack_into(f"{order}2I", head, 1628, *aspect)
    path.write_bytes(bytes(head) + data)


EIGHT, RGBA = np.arange(256, dtype=np.uint8).reshape(16, 16), RNG.integers(0, 256, (16, 16, 4)).astype(np.uint8)
TWELVE, SIXTEEN = np.arange(4096).reshape(64, 64), (16 * np.arange(4096) + 5).astype(np.uint16).reshape(64, 64)
RGB = RGBA[..., :3]
SIGNED, LONG = (SIXTEEN - 2**15).astype(np.int16), RNG.normal(size=(4, 5))


def tiff(values, **given):
    return lambda path: tifffile.imwrite(path, values, **given)


def picture(values, form, **given):
    return lambda path: Image.fromarray(values).save(path, form, **given)


OTHERS = {
    "8 bits, 0 is white": (tiff(EIGHT, photometric="miniswhite"), 255 - EIGHT),
    "big-endian": (tiff(SIXTEEN, byteorder=">"), SIXTEEN),
    "in planes": (tiff(np.moveaxis(RGB, 2, 0), photometric="rgb", planarconfig="separate"), RGB),
    "in tiles": (tiff(SIXTEEN, tile=(16, 16)), SIXTEEN),
    "alpha beside colours": (tiff(RGBA, photometric="rgb", extrasamples=["unassalpha"]), RGB),
    "signed": (tiff(SIGNED), SIGNED.astype(np.float32)),
    "64 bits": (tiff(LONG), LONG.astype(np.float32)),
    "JPEG 2000 with alpha": (picture(RGBA, "JPEG2000"), RGB),
    "DPX of 8 bits": (lambda p: dpx(p, EIGHT, 8, packing=0), EIGHT),
    "DPX of 16 bits": (lambda p: dpx(p, SIXTEEN, 16, packing=0, order="<"), SIXTEEN),
} | {
    f"DPX of 12 bits, filled {n} {order}": (partial(dpx, values=TWELVE, bits=12, packing=n, order=order), TWELVE)
    for n in (1, 2)
    for order in "<>"
}


@pytest.mark.parametrize("case", OTHERS)
def test_files_by_other_writers_have_the_values_that_were_written(tmp_path, case):
    write, expected = OTHERS[case]
    write(tmp_path / "a")
    (found,) = values_of(tmp_path / "a")
    np.testing.assert_array_equal(found, expected)
    (recording,) = open_recordings(tmp_path / "a")
    assert [code for code, _ in recording.warnings] == ["metadata_ignored"] * ("alpha" in case)
    assert (recording.full_scale is None) == (expected.dtype == np.float32)


STATED = {
    "JPEG": (picture(EIGHT, "JPEG"), "^JPEG changes pixels"),
    "JPEG in TIFF": (picture(EIGHT, "TIFF", compression="jpeg"), "^TIFF by jpeg changes pixels"),
    "irreversible": (picture(EIGHT, "JPEG2000", irreversible=True), "^JPEG 2000 changes pixels"),
    "turned": (tiff(EIGHT, extratags=[(274, "H", 1, 6, True)]), r"orientation 6 \(turned or mirrored\), which "),
    "oblong": (tiff(EIGHT, resolution=(300, 150)), "a pixel aspect ratio of (2|0.5), which is not used"),
    "DPX": (partial(dpx, values=EIGHT, bits=8, packing=0, orientation=1, aspect=(3, 2)),
            r"orientation \d \(turned or mirrored\), a pixel aspect ratio of 1.5, which"),
}  # fmt: skip


@pytest.mark.parametrize("case", STATED)
def test_what_a_still_has_lost_or_states_in_vain_is_in_a_warning(tmp_path, case):
    write, message = STATED[case]
    write(tmp_path / "a")
    (warning,) = open_recordings(tmp_path / "a")[0].warnings
    assert warning.code == ("lossy_compression" if "changes pixels" in message else "metadata_ignored")
    assert re.search(message, warning.message)


def photograph(path, second, fraction=""):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(
        {0x9003: f"2026:03:01 12:00:{second:02}"} | ({0x9291: fraction} if fraction else {})
    )
    Image.fromarray(np.full((16, 16, 3), 77, np.uint8)).save(path, exif=exif)


def test_photographs_have_the_times_of_their_exif(tmp_path):
    for number, (second, fraction) in enumerate(
        [(1, "50"), (2, ""), (2, "75"), (3, "250"), (3, "75"), (4, "501")]
    ):
        photograph(tmp_path / f"{number}.jpg", second, fraction)
    (recording,) = open_recordings(tmp_path)
    assert [one.time_s for one in recording.frames()] == [0.0, 0.5, 1.25, 1.75, 2.25, 3.001]
    # Usual is 0.5 s: a frame is missing after more than 1.5 times as much.
    assert recording.frames_per_second == pytest.approx(4 / 2.25)
    (faster,) = open_recordings(tmp_path, frames_per_second=10)
    assert [one.time_s for one in faster.frames()] == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]


def test_photographs_of_the_same_second_have_no_times(tmp_path):
    for number, second in enumerate([1, 2, 2]):
        photograph(tmp_path / f"{number}.jpg", second)
    (recording,) = open_recordings(tmp_path)
    assert recording.frames_per_second is None
    assert [one.time_s for one in recording.frames()] == [None] * 3
    (message,) = (one.message for one in recording.warnings if one.code == "times_not_used")
    assert "frame 2 (2.jpg) has the time of frame 1 (1.jpg), expected a later one" in message
    (tmp_path / "2.jpg").unlink()
    assert [one.time_s for one in open_recordings(tmp_path)[0].frames()] == [0.0, 1.0]


def with_times(folder, rows, names=("a1.png", "a2.png", "a10.png")):
    """A folder of stills with a times.csv of these rows below its header."""
    folder.mkdir(exist_ok=True)
    for name in names:
        tod.write_frame(folder / name, np.zeros((4, 5)))
    (folder / "times.csv").write_text("\n".join(["file,time_s", *rows]), encoding="utf-8")
    return folder


def test_a_times_csv_gives_the_times_of_stills(tmp_path):
    folder = with_times(tmp_path, ["a10.png,7.5", "a1.png,7.02", "a2.png,7.06"])
    (recording,) = open_recordings(folder)
    assert [(one.time_s, one.source) for one in recording.frames()] == [
        *((0.0, "a1.png"), (0.04, "a2.png"), (0.48, "a10.png"))
    ]


def linked_times(folder):
    """A folder of a stranger whose times.csv is a link to a file outside of it."""
    secret = write(folder / "secret.txt", b"password 1234\n")
    with_times(folder / "stills", []).joinpath("times.csv").unlink()
    (folder / "stills" / "times.csv").symlink_to(secret)
    return folder / "stills"


def dng(path, values, *, black, white, mosaic=True):
    """Write a DNG of one strip: an uncompressed TIFF with the tags that readers need."""
    tags = [
        *((271, "s", 0, "house"), (272, "s", 0, "camera"), (50706, "B", 4, (1, 4, 0, 0))),
        *((50708, "s", 0, "house camera"), (50714, "H", 1, black), (50717, "I", 1, white)),
        *([(33421, "H", 2, (2, 2)), (33422, "B", 4, (0, 1, 1, 2))] if mosaic else []),
        *([(50721, 10, 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1))] if mosaic else []),
    ]
    layout = {"photometric": 32803 if mosaic else "minisblack", "rowsperstrip": len(values)}
    tifffile.imwrite(path, values, metadata=None, extratags=tags, **layout)
    grey, linear_raw = (struct.pack("<HHIH", 262, 3, 1, photometric) for photometric in (1, 34892))
    path.write_bytes(path.read_bytes().replace(grey, linear_raw))  # tifffile takes it for three colours


def test_camera_raw_is_the_first_green_of_a_cell_or_a_plane_of_its_mosaic(tmp_path):
    values = RNG.integers(600, 16000, (64, 96)).astype(np.uint16)
    dng(tmp_path / "a.dng", values, black=512, white=16383)
    (recording,) = open_recordings(tmp_path / "a.dng")
    assert (recording.shape, recording.zero, recording.full_scale) == ((32, 48), 512, 16383)
    assert [one.code for one in recording.warnings] == ["half_resolution"]
    # Pattern R G / G B.
    np.testing.assert_array_equal(values_of(tmp_path / "a.dng"), values[np.newaxis, 0::2, 1::2])
    for row, column in np.ndindex(2, 2):
        plane = one_recording(tmp_path / "a.dng", "test", plane=(row, column))
        assert (plane.shape, plane.zero, plane.warnings) == ((32, 48), 512, ())
        np.testing.assert_array_equal(next(plane.frames()).values, values[row::2, column::2])
    dng(tmp_path / "b.dng", values, black=600, white=16383)
    (both,) = open_recordings([tmp_path / "b.dng", tmp_path / "a.dng"])
    assert (both.path.name, both.zero, both.n_frames) == ("a.dng", 512, 2)


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG", "one"])
def test_the_greens_of_each_pattern_are_found(pattern):
    """LibRaw numbers colours as R G B G. A last row or column that makes no whole cell is left out."""
    sensor = RNG.integers(1, 16000, (7, 5)).astype(np.uint16)
    numbers = [[0, 1], [3, 2]] if pattern == "one" else np.reshape(["R_BG".find(one) for one in pattern], (2, 2))
    film = Mock(**{"raw_type.name": "Flat"}, num_colors=1 if pattern == "one" else 3)
    film.raw_pattern, film.color_desc = np.array(numbers), b"RGBG"
    film.raw_image_visible, film.raw_colors_visible = sensor, np.tile(numbers, (4, 3))[:7, :5]
    values, colour = raw._values(Path("a.dng"), film, is_whole=False)
    first = divmod(pattern.find("G"), 2)
    np.testing.assert_array_equal(
        values, sensor if pattern == "one" else sensor[first[0] : 6 : 2, first[1] : 4 : 2]
    )
    assert colour == (0 if pattern == "one" else 3)
    assert values.flags.writeable and not np.shares_memory(values, sensor)


def test_camera_raw_that_is_no_mosaic_or_cannot_be_read_is_refused(monkeypatch):
    for raw_type, wanted in (
        ("Stack", "of several colours at each pixel"),
        ("Flat", "of RGBG that is not Bayer's"),
    ):
        film = Mock(**{"raw_type.name": raw_type}, num_colors=3, raw_pattern=np.zeros((6, 6)), color_desc=b"RGBG")
        film.raw_image_visible, film.raw_colors_visible = np.ones((6, 6)), np.ones((6, 6), int)
        with pytest.raises(tod.FrameError, match=wanted):
            raw._values(Path("a.dng"), film, is_whole=False)
    monkeypatch.setattr("rawpy.imread", Mock(side_effect=OSError(13, "Permission denied")))
    with pytest.raises(tod.FrameError, match=r"^a\.dng: cannot be read as camera raw: Permission denied$"):
        raw.read_header(Path("a.dng"), 256)


def fff(
    counts,
    *,
    order="<",
    planck=(364058.0, 1428.0, 1.0, -228, 1.0),
    emissivity=1.0,
    moment_ms=0,
    image=None,
    n_camera=0x400,
):
    """Build FLIR's container by hand: a header, a table of two records, the constants and the counts.

    `image` are the bytes of the counts as PNG, in place of plain ones.
    """
    r1, b, f, o, r2 = planck
    camera = bytearray(0x400)
    struct.pack_into(f"{order}H", camera, 0, 2)
    struct.pack_into(f"{order}3f", camera, 0x20, emissivity, 1.0, 293.15)
    struct.pack_into(f"{order}3f", camera, 0x58, r1, b, f)
    struct.pack_into(f"{order}if", camera, 0x308, o, r2)
    struct.pack_into(f"{order}2I", camera, 0x384, *divmod(moment_ms, 1000))
    data = struct.pack(f"{order}3H", 2, counts.shape[1], counts.shape[0]).ljust(32, b"\0")
    data += counts.astype(f"{order}u2").tobytes() if image is None else image
    version = 100 if order == "<" else 199  # the least and the largest one that is read
    header = b"FFF\0" + b"house".ljust(16, b"\0") + struct.pack(f"{order}4I", version, 64, 2, 0)
    table = b""
    place = 64 + 2 * 32
    for kind, record in ((32, camera[:n_camera]), (1, data)):
        table += struct.pack(f"{order}2HIIIIIII", kind, 0, 100, 0, place, len(record), 0, 0, 0)
        place += len(record)
    return header.ljust(64, b"\0") + table + bytes(camera[:n_camera]) + data


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("in_jpeg", [False, True])
def test_radiometric_counts_come_back(tmp_path, order, in_jpeg):
    counts = RNG.integers(0, 65536, (40, 50)).astype(np.uint16)
    data = fff(counts, order=order)
    if in_jpeg:  # in two segments, the second one first
        parts = [b"FLIR\0\1" + bytes([k, 1]) + part for k, part in enumerate((data[:900], data[900:]))]
        segments = [b"\xff\xe1" + struct.pack(">H", len(one) + 2) + one for one in reversed(parts)]
        data = b"\xff\xd8" + b"".join(segments) + b"\xff\xd9"
    (tmp_path / "a.fff").write_bytes(data)
    (recording,) = open_recordings(tmp_path / "a.fff")
    assert (recording.unit, recording.full_scale) == ("counts", None)
    np.testing.assert_array_equal(next(recording.frames()).values, counts)


def test_temperatures_of_a_black_body_invert_its_counts(tmp_path):
    (tmp_path / "a.fff").write_bytes(fff(np.zeros((4, 4)), emissivity=0.9))
    radiometry = radiometric.read_radiometry(tmp_path / "a.fff")
    for wrong in ({"emissivity": 1.1}, {"emissivity": 0.0}, {"planck": (0.0, 1428.0, 1.0, -228, 1.0)}):
        (tmp_path / "b.fff").write_bytes(fff(COUNTS[0], **wrong))
        with pytest.raises(tod.FrameError, match=r"found R1 .*, emissivity .*, expected positive numbers"):
            radiometric.read_radiometry(tmp_path / "b.fff")
    celsius = np.linspace(-20, 100, 7)
    share = radiometry.emissivity
    assert (share, radiometry.reflected_celsius) == pytest.approx(
        (0.9, 20.0), rel=1e-6
    )  # 32-bit floats in the file
    seen = share * radiometry.counts_of(celsius) + (1 - share) * radiometry.counts_of(radiometry.reflected_celsius)
    # The relative rounding of a few operations, 1e-15, times counts / (counts per kelvin) < 1e3 K.
    np.testing.assert_allclose(radiometry.celsius(seen), celsius, rtol=0, atol=1e-11)
    assert np.isnan(radiometry.celsius(-1e6))


def test_a_count_is_worth_what_the_first_file_of_a_folder_says(tmp_path):
    assert radiometric.mk_per_count_of(memory_recording(COUNTS, frames_per_second=None), 13_000) is None
    for number in (10, 9):
        (tmp_path / f"{number}.fff").write_bytes(fff(ONE, planck=(number * 40_000.0, 1428.0, 1.0, -228, 0.5)))
    # Of a black body, counts = r1 / (r2 (exp(b / T) - f)) - o. One count at 13,000 of them.
    below, above = (1428 / np.log(9 * 40_000 / 0.5 / (counts - 228) + 1) for counts in (12_999.5, 13_000.5))
    found = radiometric.mk_per_count_of(*open_recordings(tmp_path), 13_000)
    assert found == pytest.approx(1000 * (above - below), rel=1e-6)
    (tmp_path / "9.fff").write_bytes(with_bytes(64, b"\0\0"))  # without constants and time
    (recording,) = open_recordings(tmp_path / "9.fff")
    assert (radiometric.mk_per_count_of(recording, 13_000), next(recording.frames()).time_s) == (None, None)


@pytest.mark.parametrize("n_bytes", [0x38C, 0x38B, 0x310, 0x30F])
def test_the_record_of_the_camera_may_be_short(tmp_path, n_bytes):
    path = write(tmp_path / "a.fff", fff(ONE, moment_ms=5_000, n_camera=n_bytes))
    assert radiometric.read_header(path, 256).times_s == ((5.0,) if n_bytes == 0x38C else None)
    message = "the record of type 32 has 783 bytes, expected 784 or more"
    with pytest.raises(tod.FrameError, match=message) if n_bytes == 0x30F else nullcontext():
        assert radiometric.read_radiometry(path).b == 1428


REAL = Path(__file__).parent


def test_a_real_radiometric_file_is_read_as_by_flirpy():
    (recording,) = open_recordings(REAL / "frame_000000.fff")
    counts = next(recording.frames()).values
    # SHA-256 of flirpy.io.fff.Fff(path).get_image() as little-endian bytes, by flirpy 0.6.2.
    digest = hashlib.sha256(counts.astype("<u2").tobytes()).hexdigest()
    assert digest == "0868740d7414ce78e11a56877bd9ee37e17a633f5111396b17be87122bdfcba4"
    # flirpy.util.raw.raw2temp(counts, meta) with the object at a distance of 0 m and surroundings of 20 °C; the
    # file says 6e-6 K less, of which 6 % are reflected.
    celsius = radiometric.read_radiometry(REAL / "frame_000000.fff").celsius(counts)
    np.testing.assert_allclose(celsius[0, :4], [10.54402449, 10.69360702, 10.8429458, 10.64377331], atol=5e-7)
    np.testing.assert_allclose([celsius.min(), celsius.max()], [10.09380317, 12.95733611], atol=5e-7)
    # "Date/Time Original: 2018:11:05 12:14:43.084+01:00" in flirpy's frame_000000.txt, by ExifTool 11.24.
    moment = datetime(2018, 11, 5, 12, 14, 43, 84_000, tzinfo=timezone(timedelta(hours=1)))
    assert radiometric.read_header(REAL / "frame_000000.fff", 256).times_s == (moment.timestamp(),)


def scene(n_frames=1, shape=(40, 50)):
    """A smooth scene with noise, as a detector sees it: 13,000 counts and some hundreds."""
    rows, columns = np.indices(shape)
    return (13_000 + 20 * rows + 10 * columns + RNG.normal(0, 5, (n_frames, *shape))).astype(np.uint16)


def png(values):
    return png_bytes(values.shape[1], values.shape[0], 16, 0, [row.astype(">u2").tobytes() for row in values])


@pytest.mark.parametrize("swapped", [True, False])
def test_counts_compressed_as_png_come_back_in_either_byte_order(tmp_path, swapped):
    (counts,) = scene()
    (tmp_path / "a.fff").write_bytes(fff(counts, image=png(counts.byteswap() if swapped else counts)))
    np.testing.assert_array_equal(values_of(tmp_path / "a.fff"), counts[np.newaxis])
    (tmp_path / "a.fff").write_bytes(fff(counts, image=png(np.full_like(counts, 0x3412))))
    assert (values_of(tmp_path / "a.fff") == 0x1234).all()  # either is as smooth: the low byte comes first


def ptw(counts, times_s, *, header=(3476, 1016), words=None, n_frames=None, scaled=0, double=0):
    """Build a film of Cedip by hand: a main header, and a header before each frame."""
    n_header, n_frame_header = header
    _, rows, columns = counts.shape
    n_frames = len(counts) if n_frames is None else n_frames
    main = bytearray(b"CED\0\0" + b"5.60\0\x1a".ljust(n_header - 5, b"\0"))
    words = n_frame_header // 2 + rows * columns if words is None else words
    struct.pack_into("<5i", main, 11, n_header, n_frame_header, words, rows * columns, n_frames)
    struct.pack_into("<H", main, 277, scaled)
    main[2105] = double
    struct.pack_into("<3H", main, 377, columns, rows, 14)
    struct.pack_into("<f", main, 403, 0.01)  # the camera's period: the film may have fewer frames
    film = bytes(main)
    for values, time_s in zip(counts, times_s, strict=True):
        own = bytearray(n_frame_header)
        milliseconds = round(1000 * time_s)
        second, minute, hour = milliseconds // 1000 % 60, milliseconds // 60_000 % 60, milliseconds // 3_600_000
        own[80:84] = bytes([minute, hour % 24, milliseconds % 1000 // 10, second])
        own[160:161] = bytes([milliseconds % 10])[: n_frame_header - 160]
        film += bytes(own) + values.astype("<u2").tobytes()
    return film


def test_a_film_of_cedip_comes_back_with_its_times_across_midnight(tmp_path):
    counts = RNG.integers(0, 2**14, (5, 24, 30)).astype(np.uint16)
    film = ptw(counts, 86_399.969 + 0.03 * np.arange(5), header=(2106, 162))
    (recording,) = open_recordings(write(tmp_path / "a.ptw", film))
    frames = list(recording.frames())
    assert (recording.unit, recording.full_scale, recording.n_frames) == ("counts", None, 5)
    np.testing.assert_array_equal(values_of(tmp_path / "a.ptw"), counts)
    assert [one.time_s for one in frames] == pytest.approx([0, 0.03, 0.06, 0.09, 0.12], abs=1e-9)
    assert recording.frames_per_second == pytest.approx(1 / 0.03)
    assert open_recordings(tmp_path / "a.ptw", frames_per_second=100)[0].frames_per_second == 100
    for at, value in ((80, 60), (81, 24), (82, 100), (83, 60), (160, 10)):  # no time of day
        write(tmp_path / "b.ptw", film[: 2106 + at] + bytes([value]) + film[2107 + at :])
        assert cedip.read_header(tmp_path / "b.ptw", 256).times_s is None
    for times_s, n_header in ((np.zeros(5), 162), (1.0 + np.arange(5), 160)):
        write(tmp_path / "b.ptw", ptw(counts, times_s, header=(2106, n_header)))
        assert next(open_recordings(tmp_path / "b.ptw")[0].frames()).time_s is None


def test_a_real_film_of_cedip_is_read_as_by_pyradi():
    (recording,) = open_recordings(REAL / "cedip_lwir_3_frames.ptw")
    frames = list(recording.frames())
    # SHA-256 of the three frames as pyradi's GetPTWFrameFromFile gives them, as little-endian uint16 by rows.
    digest = hashlib.sha256(np.array([one.values for one in frames]).astype("<u2").tobytes()).hexdigest()
    assert digest == "40a427603e2673f353accb123110efd77aeb3f24ab04370bda2ebc01e07f2ece"
    # pyradi's h_frameSecond: 51.848, 51.878 and 51.908. A counter of microseconds at byte 301 of each frame's
    # header, which is not read, agrees: 29,997 and 30,000 between them.
    assert [one.time_s for one in frames] == [0.0, 0.03, 0.06]


def test_a_real_thermal_tiff_is_read_as_by_opencv():
    import cv2

    (values,) = values_of(REAL / "example_radiometric.tiff")
    assert values.dtype == np.uint16
    np.testing.assert_array_equal(values, cv2.imread(str(REAL / "example_radiometric.tiff"), cv2.IMREAD_UNCHANGED))


def arrays_of(kind, dtype):
    shape = {"one": (4, 6), "line": (1, 6), "sequence": (3, 4, 6), "colour": (3, 4, 6, 3)}[kind]
    return (RNG.random(shape) * 200).astype(dtype)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
@pytest.mark.parametrize("kind", ["one", "line", "sequence", "colour"])
@pytest.mark.parametrize("dtype", ["u1", ">u2", "i2", "f2", "f4", "f8"])
def test_arrays_come_back(tmp_path, suffix, kind, dtype):
    values = arrays_of(kind, dtype)
    path = tmp_path / f"a{suffix}"
    if suffix == ".npy":
        np.save(path, values)
    else:
        np.savez_compressed(path, values)
    (recording,) = open_recordings(path)
    expected = values if values.dtype.kind == "u" else values.astype(np.float32)
    expected = expected if values.ndim > 2 else expected[np.newaxis]
    for found in (recording, memory_recording(values, frames_per_second=20)):
        np.testing.assert_array_equal([frame.values for frame in found.frames()], expected)
        assert {frame.values.dtype.name for frame in found.frames()} == {expected.dtype.name}
        assert found.full_scale == (np.iinfo(values.dtype).max if values.dtype.kind == "u" else None)
        assert (found.is_colour, found.shape) == (kind == "colour", expected.shape[1:3])
        assert (found.n_frames, found.unit) == (len(expected), "code")
    assert [frame.time_s for frame in found.frames()] == [0.0, 0.05, 0.1][: len(expected)]


def test_an_array_that_inflates_is_refused_before_it_is_held(tmp_path, monkeypatch):
    monkeypatch.setattr(arrays, "MOST_NPZ_MB", 8)
    np.savez_compressed(tmp_path / "a.npz", np.zeros((9, 1024, 1024), np.uint8))
    with pytest.raises(tod.FrameError, match=r"a\.npz: its array has more than 8 MB; save it as \.npy"):
        open_recordings(tmp_path / "a.npz")


def write(path, data):
    path.write_bytes(data)
    return path


def saved(folder, values):
    np.save(folder / "a.npy", values)
    return folder / "a.npy"


def written(folder, name, data):
    return write(folder / name, data())


def damaged_npz(folder, seed):
    np.savez_compressed(folder / "a.npz", RNG.integers(0, 255, (20, 40, 50)).astype(np.uint8))
    content = bytearray((folder / "a.npz").read_bytes())
    middle = len(content) // 2
    content[middle : middle + 40] = np.random.default_rng(seed).bytes(40)
    return write(folder / "a.npz", bytes(content))


@pytest.mark.parametrize("version", [(1, 0), (2, 0), (3, 0)])
@pytest.mark.parametrize("order", "CF")
def test_arrays_of_each_version_and_order_come_back(tmp_path, version, order):
    values = arrays_of("sequence", "u2")
    with (tmp_path / "a.npy").open("wb") as file:
        np.lib.format.write_array(file, np.asarray(values, order=order), version)
    np.testing.assert_array_equal(values_of(tmp_path / "a.npy"), values)


def seq(*frames, **settings):
    """Put containers one behind the other, as FLIR's cameras write films."""
    return b"".join(fff(counts, **settings) for counts in frames)


@pytest.mark.parametrize(("order", "gap"), [("<", b""), (">", b"\0" * 2**17)])
def test_all_frames_of_a_seq_come_back_with_their_times(tmp_path, order, gap):
    counts = scene(4)
    counts[1, 0, :2] = np.frombuffer(b"FFF\0", "<u2")  # the mark of a container within the counts of another
    counts[2, 0, :2] = np.frombuffer(b"FFF\0", ">u2")
    moments_ms = [1_495_223_133_999 + step for step in (0, 34, 67, 100)]  # steps of a real camera
    data = [fff(one, order=order, moment_ms=ms) for one, ms in zip(counts, moments_ms, strict=True)]
    (tmp_path / "a.seq").write_bytes(gap.join(data) + gap)
    (recording,) = open_recordings(tmp_path / "a.seq")
    np.testing.assert_array_equal(values_of(tmp_path / "a.seq"), counts)
    assert [one.time_s for one in recording.frames()] == [0.0, 0.034, 0.067, 0.1]
    assert recording.frames_per_second == pytest.approx(30)
    assert radiometric.read_radiometry(tmp_path / "a.seq").r1 == 364058


def damaged(image):
    middle = len(image) // 2
    return image[:middle] + bytes(byte ^ 0xA5 for byte in image[middle : middle + 8]) + image[middle + 8 :]


def two_pngs(folder, columns=60, names=("a.png", "b.png")):
    for name, n in zip(names, (60, columns), strict=True):
        tod.write_frame(folder / name, RNG.random((40, n)))
    return folder


def zero_dng(folder, n_rows):
    """A camera raw whose data end after some rows; copying programs fill what is missing with zeros."""
    values = RNG.integers(600, 16000, (64, 96)).astype(np.uint16)
    values[n_rows:] = 0
    dng(folder / "a.dng", values, black=512, white=16383)
    return folder / "a.dng"


def video(path, codec, pixel_format, frames):
    """Write grey frames of 16 bits, converted to a pixel format by FFmpeg."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:], pixel_format
        for values in frames:
            frame = av.VideoFrame.from_ndarray(values, format="gray16le").reformat(format=pixel_format)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def at(name, make):
    return lambda folder: (make(folder / name), folder / name)[1]


def cv2_pages(path):
    """Write a TIFF of pages of two sizes."""
    import cv2

    cv2.imwritemulti(str(path), [np.zeros(shape, np.uint8) for shape in ((4, 5), (4, 5), (4, 6))])


def npy_claiming(shape):
    text = repr({"descr": "<u2", "fortran_order": False, "shape": shape}).encode()
    text += b" " * (118 - len(text) - 1) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def damaged_tiff(folder):
    write_image(folder / "a.tif", RNG.integers(0, 65536, (64, 64, 1)).astype(np.uint16))
    return write(folder / "b.tif", (folder / "a.tif").read_bytes()[:2000])


COUNTS = scene(3)
ONE = COUNTS[0]
SMALL = np.ones((4, 4, 1), np.float16), "Y", {"full_width": 9}


def holding(image):
    return fff(ONE, image=image)


def with_bytes(at, data):
    return fff(ONE)[:at] + data + fff(ONE)[at + len(data) :]


BAD_FILES = {
    "empty file": ("a.png", lambda: b"", "found an empty file, expected an image"),
    "text": ("a.txt", lambda: b"hello", r"starts with b'hello', expected an image"),
    "short npy": ("a.npy", lambda: npy_claiming((3, 32, 40)) + b"\0" * 9, "as a NumPy array: mmap .* truncated"),
    "long npy": ("a.npy", lambda: npy_claiming((3, 4)) + bytes(25), r"longer than an array of shape \(3, 4\)"),
    "header of npy": ("a.npy", lambda: npy_claiming((3, 4)).replace(b"}", b"("), "cannot be read as a NumPy"),
    "deep header": ("a.npy", lambda: b"\x93NUMPY\1\0" + struct.pack("<H", 9000) + b"[" * 9000, "as a NumPy array"),
    "zip": ("a.npz", lambda: b"PK\x03\x04abc", "cannot be read as a NumPy array"),
    "no raw": ("a.dng", lambda: b"II*\0abcdefgh", "cannot be read as camera raw: Input/output error$"),
    "fff header": ("a.fff", lambda: b"FFF\0abc", "the header of the container is truncated"),
    "fff": ("a.fff", lambda: fff(np.zeros((40, 50)))[:-7], "reaches beyond the file: truncated"),
    "seq": ("a.seq", lambda: seq(*np.zeros((3, 40, 50)))[:-7], r"frame 2 \(those before are good\): record 1"),
    "seq of two sizes": ("a.seq", lambda: seq(ONE, ONE[1:]), "1: found 50 x 39 pixels, expected 50 x 40 pixels"),
    "damaged png in fff": ("a.fff", lambda: holding(damaged(png(ONE))), "the PNG is damaged: chunk b'IDAT'"),
    "cut table of fff": ("a.fff", lambda: with_bytes(64, b"\0\0")[:127], "the record of type 1 is missing, exp"),
    "version 99 of fff": ("a.fff", lambda: with_bytes(20, b"\x63"), "the version of the container is none of"),
    "version 200 of fff": ("a.fff", lambda: with_bytes(20, b"\xc8"), "of the container is none of ours, expected"),
    "header of png in fff": ("a.fff", lambda: holding(png(ONE)[:26]), "the PNG is truncated or damaged: a chunk"),
    "nothing in fff": ("a.fff", lambda: holding(b""), "found 0 bytes of counts, expected 4000: truncated, or com"),
    "flat fff": ("a.fff", lambda: fff(ONE[:0]), "found 50 x 0 pixels, expected sides of 1 to 32768"),
    "cut png in seq": ("a.seq", lambda: fff(ONE) + holding(png(ONE)[:-20]), r"frame 1 \(those before are"),
    "png of another size": ("a.fff", lambda: holding(png(ONE[:-1])), "its counts are a PNG of 50 x 39 pixels"),
    "jpeg in fff": ("a.fff", lambda: holding(b"\xff\xd8\xff\xe0" + bytes(99)), "found 103 bytes of .*, as CSQ is"),
    "ptw": ("a.ptw", lambda: ptw(COUNTS, [0, 1, 2])[:-1], "2 whole frames, expected the 3 of its header: trunc"),
    "long ptw": ("a.ptw", lambda: ptw(COUNTS, [0, 1, 2]) + bytes(9999), "frames, expected the 3 of its header"),
    "header of ptw": ("a.ptw", lambda: b"CED\0" + bytes(99), "the main header has 103 bytes, expected 2106 or"),
    "step of ptw": ("a.ptw", lambda: ptw(COUNTS, [0, 1, 2], words=2000), "3 frames of 4000, expected 2106 or"),
    "no frame of ptw": ("a.ptw", lambda: ptw(COUNTS, [0, 1, 2], n_frames=0), "3476 bytes, and 0 frames of 5016"),
    "double ptw": ("a.ptw", lambda: ptw(COUNTS, [0, 1, 2], double=1), "scaled or in double precision, expected"),
    "scaled ptw": ("a.ptw", lambda: ptw(COUNTS, [0, 1, 2], scaled=1), "its values are scaled or in double"),
    "frames of ptw": ("a.ptw", lambda: ptw(COUNTS, [0, 1, 2], n_frames=2**31 - 1), "found 3 whole frames"),
    "pnm": ("a.pgm", lambda: b"P5 +7 5 9 " + bytes(35), r"found the PNM header b'P5 \+7 .*, expected digits"),
    "no counts in fff": ("a.fff", lambda: with_bytes(28, b"\1"), "the record of type 1 is missing, expected one"),
    "order of fff": ("a.fff", lambda: with_bytes(1152, b"77"), "a record starts with b'77', expected 2 as a"),
    "start of mkv": ("a.mkv", lambda: b"\x1a\x45\xdf\xa3", "as video: Invalid data found when processing input;"),
}

BAD_TIMES = {
    "times of other files": (
        "a1.png,1 a2.png,2 a10.png,3 b.png,4",
        "times.csv: file: found 1 lines of b.png",
    ),
    "times twice": ("a1.png,1 a2.png,2 a1.png,3 a10.png,4", "times.csv: file: found 2 lines of a1.png, expected"),
    "times of some": ("a1.png,1 a2.png,2", "times.csv: file: found 0 lines of a10.png, expected each still of"),
    "times that stand": ("a1.png,1 a2.png,3 a10.png,3", "times.csv: found 3 s for a2.png and 3 s for a10.png"),
    "times without end": ("a1.png,-1e308 a2.png,1e308 a10.png,2", r"times.csv, line 2: time_s: found -1e\+308 s"),
    "times that are no numbers": ("a1.png,soon a2.png,1 a10.png,2", "times.csv, line 2: time_s: found 'soon'"),
}

USER_DATA = partial(dpx, values=EIGHT, bits=8, packing=0, n_user=2**31)
BAD = {
    "empty folder": (lambda d: d, "the folder is empty, expected recordings"),
    "no file": (lambda d: d / "missing.png", "found no file"),
    "two sizes": (partial(two_pngs, columns=50), "size: found 50 x 40 pixels, expected 60 x 40 pixels as in"),
    "no pages alike": (at("a.tif", cv2_pages), "page 2 differs in size or pixel type from page 0, expected equal"),
    "two kinds": (lambda d: (two_pngs(d), saved(d, ONE))[0], "a.png: found image, expected array as a.npy"),
    "truncated tiff": (damaged_tiff, r"b\.tif: .*(cannot be decoded|cannot be opened)"),
    "pickle": (lambda d: saved(d, np.array([{}, 1])), "cannot be read as a NumPy array: .*Python objects"),
    "vector": (lambda d: saved(d, ONE[0]), r"shape \(50,\), expected \(frames, rows"),
    "four channels": (lambda d: saved(d, np.zeros((2, 3, 5, 4))), r"\(2, 3, 5, 4\), expected .* and 3 if in"),
    "no frames": (lambda d: saved(d, COUNTS[:0]), r"shape \(0, 40, 50\), expected \(frames, rows, columns"),
    "wide npy": (lambda d: saved(d, np.zeros((1, 32769), "u1")), "found 32769 x 1 pixels, expected sides of"),
    "user data of dpx": (at("a.dpx", USER_DATA), "claims 2147483648 bytes of user data, expected at most 1048576"),
    "times elsewhere": (linked_times, r"stills: times.csv lies outside of the dataset: it is \S+secret.txt"),
    "times beside arrays": (lambda d: (saved(d, ONE), with_times(d, [], names=()))[1], "found times beside a.npy"),
    "no data of raw": (lambda d: zero_dng(d, 0), "all values are 0, as if the sensor's data were missing"),
    "last rows of raw": (lambda d: zero_dng(d, 40), "rows 40 to 63 are 0, as if the sensor's data were missing"),
    "nan": (lambda d: saved(d, np.full((2, 3, 4), np.nan)), "frame 0: 12 values are no numbers"),
    "two in npz": (at("a.npz", partial(np.savez, a=ONE, b=ONE)), "found arrays a, b, expected one"),
    "window": (at("a.exr", lambda p: write_exr(p, SMALL)), "the data window covers only a part of"),
}
DAMAGED = r"a\.npz: cannot be read as a NumPy array"
BAD |= {f"damaged npz {seed}": (partial(damaged_npz, seed=seed), DAMAGED) for seed in range(8)}
BAD |= {
    f"0 is white in {one.dtype}": (
        at("a.tif", tiff(one, photometric="miniswhite")),
        rf"0 is white in this TIFF of {8 * one.itemsize} bits \(MINISWHITE\), expected black",
    )
    for one in (SIXTEEN, SIGNED, LONG.astype(np.float32))
}
BAD |= {name: (partial(written, name=file, data=data), said) for name, (file, data, said) in BAD_FILES.items()}
BAD |= {name: (partial(with_times, rows=rows.split()), said) for name, (rows, said) in BAD_TIMES.items()}


@pytest.mark.parametrize("case", BAD)
def test_bad_recordings_are_told_in_one_line(tmp_path, case):
    make, message = BAD[case]
    path = make(tmp_path)
    with pytest.raises(tod.DataError, match=message) as caught:
        values_of(path)
    assert "\n" not in str(caught.value)


def test_no_paths_and_bad_rates_are_refused(tmp_path):
    with pytest.raises(tod.DataError, match="found no path"):
        open_recordings([])
    for values, message in (
        (np.full((3, 2, 2), np.nan), "frame 0: 4 values are no numbers"),
        (np.zeros((3, 4), int), "found values of type int64, expected one of uint8, uint16, int16, float16, fl"),
    ):
        with pytest.raises(tod.DataError, match=f"array: {message}"):
            tod.noise(values)
    assert [check_rate(rate) for rate in (1e-9, 1e9, None)] == [1e-9, 1e9, None]
    with pytest.raises(tod.DataError, match="gone: cannot be read: No such file or directory"):
        files_in(tmp_path / "gone")
    for rate in (0, 1e308):
        with pytest.raises(tod.SettingsError, match=r"frames_per_second: found .*, expected a number from 1e-09"):
            open_recordings(tmp_path, frames_per_second=rate)


def test_frames_have_at_least_eight_bytes_a_pixel(tmp_path):
    for shape in ((1, 32768), (32768, 1), (16, 8192)):
        check_size(tmp_path, shape, 1)
    for shape, message in (((1, 32769), "found 32769 x 1 pixels"), ((16, 8193), "decodes to 2 MB a frame, exp")):
        with pytest.raises(tod.FrameError, match=message):
            check_size(tmp_path, shape, 1)


def test_the_range_is_the_one_asked_for_or_that_of_the_recording():
    counts, grey = (memory_recording(COUNTS.astype(one), frames_per_second=None) for one in ("f4", "u2"))
    grey = replace(grey, zero=16.0)
    assert code_range(counts, (0.5, 2.5)) == (0.5, 2.5) and code_range(grey, None) == (16.0, 65535.0)
    for recording, asked, message in (
        *((counts, asked, "--range: found .*, expected LOW:HIGH, the lower") for asked in ((1, 1), (1, np.inf))),
        (grey, (-np.inf, 1), "--range: found -inf:1, expected LOW:HIGH, the lower one first"),
        (counts, None, "^array: has values without a black and a white, expected --range LOW:HIGH, the values"),
        (replace(counts, unit="counts"), None, "^array: has counts without a black"),
        (replace(counts, unit="celsius"), None, "^array: has temperatures without a black"),
    ):
        with pytest.raises(SettingsError, match=message), in_command():
            code_range(recording, asked)


@pytest.mark.parametrize(("name", "make", "module", "extra"), [
    ("a.dng", lambda: b"II*\0abcdefgh", "rawpy", "raw"),
    ("a.mkv", lambda: b"\x1a\x45\xdf\xa3abc", "av", "video"),
])  # fmt: skip
def test_a_package_that_is_not_installed_is_named(tmp_path, monkeypatch, name, make, module, extra):
    data = make()
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(tod.DataError, match=rf"not installed: pip install 'todframes\[{extra}\]'"):
        open_recordings(write(tmp_path / name, data))


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have names in Unicode")
def test_folders_whose_names_are_no_utf_8_are_read(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9"))
    folder.mkdir()
    counts = RNG.integers(600, 16000, (64, 96)).astype(np.uint16)
    for name in ("a.png", "a.tif"):
        write_image(tmp_path / name, counts[..., np.newaxis])
        shutil.move(tmp_path / name, folder / name)
    dng(folder / "a.dng", counts, black=0, white=16383, mosaic=False)
    (folder / "a.fff").write_bytes(fff(counts))
    np.save(folder / "a.npy", counts)
    for name in ("a.png", "a.tif", "a.dng", "a.fff", "a.npy"):
        np.testing.assert_array_equal(values_of(folder / name), counts[np.newaxis])


def test_a_recording_without_frames_is_refused_where_it_is_read():
    whole = memory_recording(RNG.random((3, 20, 20)), frames_per_second=None)
    assert [one.source for one in whole.frames()] == ["frame 0", "frame 1", "frame 2"]
    empty = replace(whole, path=Path("film.mp4"), n_frames=None, read=lambda: iter(()))
    with pytest.raises(DataError, match=r"^film\.mp4: found no frame, expected at least one$"):
        list(empty.frames())
