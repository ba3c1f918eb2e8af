"""Memory and time of loading and scoring up to a million small frames, links to a few files: half an hour."""

from __future__ import annotations

import tempfile
from pathlib import Path

from bench_scoring import linked
from timing import Cost, Row, process

SCORED = (10**4, 10**5, 10**6)
SIDE, SIZE_MRAD = 40, 3.0
LOAD = "import sys; from todframes.frames.dataset import load_dataset; load_dataset(sys.argv[1])"


def rows() -> list[Row]:
    """Peak memory of whole processes, and what a million trials cost."""
    with tempfile.TemporaryDirectory() as folder:
        datasets = [linked(Path(folder, str(n)), n, side=SIDE, size_mrad=SIZE_MRAD) for n in SCORED]
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
