"""Comparing five algorithms against their own running time and one decoding of the frames."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from bench_scoring import make_dataset
from timing import Row

from todframes.enhancement.compare import compare_observers
from todframes.enhancement.finding import find_enhancement
from todframes.frames.dataset import load_dataset
from todframes.frames.files import read_frame
from todframes.observers.pyramid import PyramidObserver

N_FRAMES = 500
USUAL = ("clahe", "unsharp", "gaussian", "median", "bilateral")
QUICK = ("clahe", "gaussian", "median", "gamma", "guided")
REPEATS = 3


def cpu_s(run: Callable[[], object]) -> float:
    """Processor time of a run, which other processes on the machine do not lengthen much."""
    started = time.process_time()
    run()
    return time.process_time() - started


def rows() -> list[Row]:
    """Share of time beyond algorithms and decoding: the usual algorithms, and some that take next to no time."""
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "png"
        make_dataset(folder, N_FRAMES, "png")
        dataset = load_dataset(folder)
        paths = [dataset.frame_path(frame) for trial in dataset.trials for frame in trial.frames]
        for specs, asked in ((USUAL, "<= 0.3"), (QUICK, "–")):
            algorithms = [find_enhancement(spec) for spec in specs]
            shares = []
            for _ in range(REPEATS):
                decoding_s = cpu_s(lambda: [read_frame(path) for path in paths])
                started = time.process_time()
                (results,) = compare_observers(dataset, [PyramidObserver()], algorithms)
                whole_s = time.process_time() - started
                needed_s = decoding_s + sum(result.record.cpu_s for result in results)
                shares.append(whole_s / needed_s - 1.0)
            per_frame_ms = 1e3 * (needed_s - decoding_s) / N_FRAMES
            about = f"compare {N_FRAMES} frames, 5 algorithms of {per_frame_ms:.0f} ms a frame in all"
            found.append(
                Row(f"{about}: time beyond them and decoding, as a share", sorted(shares)[REPEATS // 2], asked)
            )
    return found
