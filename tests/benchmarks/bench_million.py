"""Memory and time of loading and scoring up to a million small frames, links to a few files: half an hour."""

from __future__ import annotations

import tempfile
from pathlib import Path

from bench_scoring import DISTINCT, make_dataset
from timing import Cost, Row, process

from todframes.frames.files import frame_sha256

SCORED = (10**4, 10**5, 10**6)
SIDE, SIZE_MRAD = 40, 3.0
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
    kinds = Path(path, "kinds")
    make_dataset(kinds, DISTINCT, "png", side=SIDE, size_mrad=SIZE_MRAD)
    header, *rows = (kinds / "manifest.csv").read_text(encoding="utf-8").splitlines()
    (kinds / "dataset.toml").rename(path / "dataset.toml")
    checksums = [frame_sha256(kinds / row.partition(",")[0]) for row in rows]
    with (path / "manifest.csv").open("w") as manifest:
        manifest.write(f"{header},sha256\n")
        for number in range(n_trials):
            frame, _, row = rows[number % DISTINCT].partition(",")
            name = f"frames/{number // FRAMES_A_FOLDER:04d}/trial_{number:07d}.png"
            if not number % FRAMES_A_FOLDER:
                (path / name).parent.mkdir(parents=True)
            (path / name).hardlink_to(kinds / frame)
            manifest.write(f"{name},{row},{checksums[number % DISTINCT]}\n")
    return path
