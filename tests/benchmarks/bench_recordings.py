"""Reading of a video of ten minutes against decoding alone, and the memory of it and of its noise."""

from __future__ import annotations

import tempfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from timing import Row, process

N_FRAMES, ROWS, COLUMNS, RATE = 18_000, 512, 640, 30
DISTINCT = 50
"""Number of different noise fields, which are shifted by columns from frame to frame."""

DECODE = """
import sys, av
with av.open(sys.argv[1]) as container:
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    print(sum(1 for _ in container.decode(stream)))
"""
READ = """
import sys
from todframes.recordings.opening import open_recordings
print(sum(int(frame.values[0, 0]) for one in open_recordings(sys.argv[1]) for frame in one.frames()))
"""
NOISE = """
import sys
import todframes as tod
tod.noise(sys.argv[1])
"""


def write_video(path: Path) -> None:
    """Write a static scene with noise of a few counts in 16-bit grey, FFV1."""
    rng = np.random.default_rng(1)
    row, column = np.mgrid[:ROWS, :COLUMNS]
    scene = 7000 + 200 * np.sin(row / 37) * np.cos(column / 53)
    noise = rng.normal(0, 4, (DISTINCT, ROWS, COLUMNS))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=RATE, options={"slices": "4"})
        stream.height, stream.width, stream.pix_fmt = ROWS, COLUMNS, "gray16le"
        stream.codec_context.time_base = Fraction(1, RATE)
        for number in range(N_FRAMES):
            values = np.rint(scene + np.roll(noise[number % DISTINCT], number, 1)).astype(np.uint16)
            frame = av.VideoFrame.from_ndarray(values, format="gray16le")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def rows() -> list[Row]:
    """Wall times of whole processes, run in turn."""
    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder) / "ten_minutes.mkv")
        write_video(Path(path))
        alone, read, noise = (process("-c", code, path) for code in (DECODE, READ, NOISE))
    speed = f"{N_FRAMES / read.wall_s:.0f} frames/s of 640 x 512, 16 bits, FFV1"
    return [
        Row(f"speed of reading ({speed}) ÷ decoding alone", alone.wall_s / read.wall_s, ">= 0.5"),
        Row("speed of measuring the noise ÷ decoding alone", alone.wall_s / noise.wall_s, ">= 0.5"),
        Row("memory of reading, MB", read.peak_mb, "<= 400"),
        Row("memory of measuring the noise, MB", noise.peak_mb, "<= 400"),
    ]
