"""Makes the sample datasets in this folder again: python sample_frames/make_samples.py [FOLDER]."""

from __future__ import annotations

import csv
import shutil
import sys
from pathlib import Path

import numpy as np

from sensor_sim.frames.simulate import staring_camera
from todframes.display.display import Display
from todframes.frames.files import frame_sha256, write_frame
from todframes.frames.samples import naked_eye
from todframes.stimulus import ORIENTATIONS, coverage

REPETITIONS = 3

GRABBED_TOML = """\
schema = 1

[display]
eotf = "srgb"
white_luminance_cd_m2 = 120.0
black_luminance_cd_m2 = 0.3
pixel_pitch_mrad = 0.42
background_luminance_cd_m2 = "border"

[experiment]
level = "contrast"
group_by = ["size_mrad"]
"""

ENHANCEMENT_TOML = """\
schema = 1

[display]
eotf = "linear"
white_luminance_cd_m2 = 120.0
pixel_pitch_mrad = 0.2
background_luminance_cd_m2 = "border"

[experiment]
level = "sent_contrast"
group_by = ["size_mrad"]
"""


def grabbed_8bit(folder: Path) -> None:
    """Frames as a grabber takes them from an office display: 8-bit sRGB code values, noise, rounding."""
    side, grey, pitch_mrad = 64, 118, 0.42
    display = Display(
        eotf="srgb",
        white_luminance_cd_m2=120.0,
        black_luminance_cd_m2=0.3,
        pixel_pitch_mrad=pitch_mrad,
        background_luminance_cd_m2="border",
    )
    steps = np.array([1, 2, 3, 4, 6, 8, 12, 18])
    codes = np.concatenate([[grey], grey + steps])
    luminance = display.luminance(codes.reshape(-1, 1, 1) / 255.0).ravel()
    contrasts = luminance[1:] / luminance[0] - 1.0
    rows = []
    rng = np.random.default_rng(8)
    for size_mrad, first in ((1.5, 2), (2.5, 0), (4.0, 0), (7.0, 0)):
        for step, contrast in list(zip(steps, contrasts, strict=True))[first : first + 6]:
            for orientation in ORIENTATIONS:
                for repetition in range(REPETITIONS):
                    triangle = coverage(
                        (side, side),
                        size_px=size_mrad / pitch_mrad,
                        x_px=(side - 1) / 2,
                        y_px=(side - 1) / 2,
                        orientation=orientation,
                    )
                    code = np.rint(grey + step * triangle + rng.normal(0.0, 0.4, triangle.shape))
                    name = f"frames/s{size_mrad}_d{step}_{orientation}_{repetition}.png"
                    rows.append([name, orientation.value, size_mrad, f"{contrast:.6g}"])
                    _write(folder / name, np.repeat(code[..., None] / 255.0, 3, axis=2), "uint8")
    _write_manifest(folder, GRABBED_TOML, [], rows)


def enhancement(folder: Path) -> None:
    """Frames over a poor link, one pixel in six too dark or too bright, and the frames as they were sent."""
    side, grey, bad_step, bad_share, pitch_mrad = 72, 100, 80, 1 / 6, 0.2
    rows = []
    rng = np.random.default_rng(5)
    for size_mrad, steps in (
        (2.5, (5, 8, 12, 19, 30)),
        (4.0, (4, 6, 9, 14, 22)),
        (6.5, (3, 5, 7, 11, 17)),
    ):
        for step in steps:
            for orientation in ORIENTATIONS:
                triangle = coverage(
                    (side, side),
                    size_px=size_mrad / pitch_mrad,
                    x_px=(side - 1) / 2,
                    y_px=(side - 1) / 2,
                    orientation=orientation,
                )
                sent = grey + step * triangle
                reference = f"sent/s{size_mrad}_d{step}_{orientation}.png"
                _write(folder / reference, np.rint(sent) / 255.0, "uint8")
                for repetition in range(8):
                    received = sent + rng.normal(0.0, 1.5, sent.shape)
                    bad = rng.random(sent.shape) < bad_share
                    received[bad] = rng.choice([grey - bad_step, grey + bad_step], np.count_nonzero(bad))
                    name = f"frames/s{size_mrad}_d{step}_{orientation}_{repetition}.png"
                    rows.append([name, orientation.value, size_mrad, step / grey, reference])
                    _write(folder / name, np.rint(received) / 255.0, "uint8")
    _write_manifest(folder, ENHANCEMENT_TOML, ["reference_frame"], rows, level="sent_contrast")


def _write(path: Path, values: np.ndarray, pixel_type: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    origin = {"todframes:origin": "sample_frames/make_samples.py"}
    write_frame(path, values, pixel_type=pixel_type, attributes=origin)


def _write_manifest(
    folder: Path, settings: str, columns: list[str], rows: list[list], level: str = "contrast"
) -> None:
    (folder / "dataset.toml").write_text(settings, encoding="utf-8")
    with (folder / "manifest.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", "orientation", "size_mrad", level, *columns, "sha256"])
        writer.writerows([*row, frame_sha256(folder / row[0])] for row in rows)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for make in (naked_eye, staring_camera, grabbed_8bit, enhancement):
        shutil.rmtree(target / make.__name__, ignore_errors=True)
        make(target / make.__name__)
