"""Memory and time of loading and scoring up to a million small frames, links to a few files: half an hour."""

from __future__ import annotations

import tempfile
from itertools import product
from pathlib import Path

import numpy as np
from timing import Cost, Row, process

from todframes.frames.files import frame_sha256, write_frame
from todframes.stimulus import ORIENTATIONS, coverage

SCORED = (10**4, 10**5, 10**6)
SIDE, PITCH_MRAD = 40, 0.5
SIZES_MRAD, CONTRASTS = (2.0, 2.5, 3.0), (0.02, 0.05, 0.1, 0.2, 0.4)
FRAMES_A_FOLDER = 1000
LOAD = "import sys; from todframes.frames.dataset import load_dataset; load_dataset(sys.argv[1])"


def rows() -> list[Row]:
    """Peak memory of whole processes, and what a million trials cost."""
    with tempfile.TemporaryDirectory() as folder:
        datasets = [_dataset(Path(folder, str(n)), n) for n in SCORED]
        loads = [process("-c", LOAD, str(path)) for path in datasets]
        alone, scores = (
            [
                process("-m", "todframes", "score", str(path), "-o", f"{path}.{n}", "--quiet", "--workers", n)
                for path in datasets
            ]
            for n in "12"
        )
    return [
        *_rows("load", loads, ""),
        *_rows("score -o, two workers", scores, "<= 1200"),
        Row("score -o, two workers: CPU ms a trial", 1e3 * scores[-1].cpu_s / SCORED[-1], "<= 0.7"),
        Row(
            "score -o: times as fast with two workers as with one", alone[-1].wall_s / scores[-1].wall_s, ">= 1.6"
        ),
    ]


def _rows(what: str, costs: list[Cost], asked: str) -> list[Row]:
    return [
        Row(f"{what} {n:,} trials ({cost.wall_s:.0f} s): MB", cost.peak_mb, asked if n == SCORED[-1] else "")
        for n, cost in zip(SCORED, costs, strict=True)
    ]


def _dataset(path: Path, n_trials: int) -> Path:
    """Write a dataset of links to a few files, with checksums."""
    kinds = []
    middle = (SIDE - 1) / 2
    for size_mrad, contrast, orientation in product(SIZES_MRAD, CONTRASTS, ORIENTATIONS):
        shape = coverage(
            (SIDE, SIDE), size_px=size_mrad / PITCH_MRAD, x_px=middle, y_px=middle, orientation=orientation
        )
        frame = path / f"kinds/{len(kinds)}.png"
        frame.parent.mkdir(parents=True, exist_ok=True)
        write_frame(frame, (0.5 + 0.5 * contrast * shape).astype(np.float32), pixel_type="uint16")
        kinds.append((frame, f"{orientation.value},{size_mrad},{contrast},{frame_sha256(frame)}"))
    (path / "dataset.toml").write_text(
        "schema = 1\n[display]\neotf = 'linear'\nwhite_luminance_cd_m2 = 100.0\n"
        f"pixel_pitch_mrad = {PITCH_MRAD}\nbackground_luminance_cd_m2 = 50.0\n"
        "[experiment]\nlevel = 'contrast'\ngroup_by = ['size_mrad']\n"
    )
    with (path / "manifest.csv").open("w") as manifest:
        manifest.write("frame,orientation,size_mrad,contrast,sha256\n")
        for number in range(n_trials):
            frame, row = kinds[number % len(kinds)]
            name = f"frames/{number // FRAMES_A_FOLDER:04d}/trial_{number:07d}.png"
            if not number % FRAMES_A_FOLDER:
                (path / name).parent.mkdir(parents=True)
            (path / name).hardlink_to(frame)
            manifest.write(f"{name},{row}\n")
    return path
