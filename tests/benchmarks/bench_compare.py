"""Comparing five algorithms against their own running time and one decoding of the frames."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import cv2
from bench_scoring import make_dataset
from timing import Row, best_s

from todframes.comparing import compare_dataset
from todframes.dataset import load_dataset
from todframes.enhancement_specs import find_enhancement
from todframes.frames import read_frame
from todframes.observer import PyramidObserver

N_FRAMES = 500
USUAL = ("clahe", "unsharp", "gaussian", "median", "bilateral")
QUICK = ("clahe", "gaussian", "median", "gamma", "bicubic")


def rows() -> list[Row]:
    """Share of time beyond algorithms and decoding, for the usual ones and for five that take next to no time."""
    cv2.setNumThreads(1)
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "png"
        make_dataset(folder, N_FRAMES, "png")
        dataset = load_dataset(folder)
        paths = [dataset.frame_path(frame) for trial in dataset.trials for frame in trial.frames]
        decoding_s = best_s(lambda: [read_frame(path) for path in paths], 2)
        for specs, asked in ((USUAL, "<= 0.3"), (QUICK, "(0.3 of 2 ms)")):
            algorithms = [find_enhancement(spec) for spec in specs]
            started = time.perf_counter()
            results = compare_dataset(dataset, PyramidObserver(), algorithms)
            whole_s = time.perf_counter() - started
            needed_s = decoding_s + sum(result.cpu_s for result in results)
            found.append(
                Row(
                    f"compare {', '.join(specs)}, {N_FRAMES} frames: time beyond {needed_s:.1f} s, as a share",
                    whole_s / needed_s - 1.0,
                    asked,
                )
            )
    return found
