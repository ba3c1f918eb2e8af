"""One limit of the size of frames for every reader, checked before anything of that size is taken."""

from __future__ import annotations

import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from test_memory import PEAK, linux
from test_recordings import dng, fff, png, ptw, video, write_image

import todframes as tod
from todframes.recordings.opening import open_recordings

SIDE_PX = 512
"""Frames of this side count as 2 MB in a recording."""

COUNTS = np.random.default_rng(1).integers(1, 1000, (SIDE_PX, SIDE_PX)).astype(np.uint16)

LARGEST_MB = 200
"""What a refusal may take, libraries included; that of a file of 64 × 64 pixels takes 90 to 180 MB."""


def image(path):
    write_image(path, COUNTS[..., np.newaxis].astype(np.float16 if path.suffix == ".exr" else np.uint16))


FILES = {
    "a.png": image,
    "a.exr": image,
    "a.tif": image,
    "a.dpx": image,
    "a.pgm": image,
    "a.jp2": image,
    "a.npy": lambda path: np.save(path, COUNTS),
    "colour.npy": lambda path: np.save(path, np.ones((1, 250, 300, 3))),
    "a.npz": lambda path: np.savez_compressed(path, COUNTS),
    "a.dng": lambda path: dng(path, COUNTS, black=0, white=1000, mosaic=False),
    "a.fff": lambda path: path.write_bytes(fff(COUNTS)),
    "png.fff": lambda path: path.write_bytes(fff(COUNTS, image=png(COUNTS))),
    "a.ptw": lambda path: path.write_bytes(ptw(COUNTS[np.newaxis], [1.0])),
    "a.mkv": lambda path: video(path, "ffv1", "gray16le", COUNTS[np.newaxis]),
    "a.mov": lambda path: video(path, "png", "rgb24", COUNTS[np.newaxis]),
    "a.mp4": lambda path: video(path, "libx264", "yuv420p", COUNTS[np.newaxis]),
    "a.ts": lambda path: video(path, "libx264", "yuv420p", COUNTS[np.newaxis]),
}


@pytest.mark.parametrize("name", FILES)
def test_every_reader_keeps_the_limit(tmp_path, name) -> None:
    FILES[name](tmp_path / name)
    with pytest.raises(tod.FrameError, match=f"{name}.*decodes to 2 MB a frame, .*max_frame_mb 2$"):
        open_recordings(tmp_path / name, max_frame_mb=1)
    (recording,) = open_recordings(tmp_path / name, max_frame_mb=2)
    (frame,) = recording.frames()
    assert frame.values.shape[:2] == recording.shape


@pytest.mark.parametrize("limit", [0, 0.5, 2**20 + 1])
def test_a_limit_is_a_whole_number(tmp_path, limit) -> None:
    for read in (open_recordings, tod.load_dataset):
        with pytest.raises(tod.SettingsError, match=r"max_frame_mb: found .*, expected a whole number from 1"):
            read(tmp_path, max_frame_mb=limit)


def enlarged_mkv(path):
    """A FFV1 of 300 × 300 pixels whose container says 16,000 × 16,000."""
    video(path, "ffv1", "gray16le", COUNTS[np.newaxis, :300, :300])
    content = path.read_bytes()
    for element in (b"\xb0\x82", b"\xba\x82"):  # Matroska's PixelWidth and PixelHeight, of two bytes
        assert content.count(element + struct.pack(">H", 300)) == 1
        content = content.replace(element + struct.pack(">H", 300), element + struct.pack(">H", 16000))
    path.write_bytes(content)


def enlarged_png_in_mov(path):
    """A PNG of 16,000 × 16,000 behind a container that says 512 × 512."""
    video(path, "png", "rgb24", COUNTS[np.newaxis])
    content = path.read_bytes()
    place = content.index(b"IHDR")
    header = struct.pack(">II", 16000, 16000) + content[place + 12 : place + 17]
    crc = struct.pack(">I", zlib.crc32(b"IHDR" + header))
    path.write_bytes(content[: place + 4] + header + crc + content[place + 21 :])


@linux
@pytest.mark.parametrize(("name", "make"), [("a.mkv", enlarged_mkv), ("a.mov", enlarged_png_in_mov)])
@pytest.mark.slow
def test_a_bomb_is_refused_before_it_takes_memory(tmp_path, name, make) -> None:
    path = tmp_path / name
    make(path)
    arguments = [sys.executable, "-c", PEAK, "noise", str(path)]
    found = subprocess.run(arguments, capture_output=True, text=True, check=False)
    *lines, peak = found.stderr.splitlines()
    assert found.returncode == 1, found.stderr
    assert len(lines) == 1 and lines[0].startswith("error: ")
    assert float(peak.split()[-1]) <= LARGEST_MB
