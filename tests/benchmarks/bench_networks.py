"""Comparing a neural network of some 10 ms a frame, trials of 5 frames of 512²: time beyond it, and memory."""

from __future__ import annotations

import csv
import shutil
import sys
import tempfile
import time
from pathlib import Path

from bench_scoring import make_dataset
from timing import Row, process

sys.path.insert(0, str(Path(__file__).parents[1]))

from networks import denoiser

from todframes.enhancement.compare import compare_observers
from todframes.enhancement.finding import find_enhancement
from todframes.frames.dataset import load_dataset
from todframes.frames.files import read_frame
from todframes.observers.pyramid import PyramidObserver

N_TRIALS, FRAMES_PER_TRIAL = 500, 5
COMPARE = """
import sys
from todframes.cli.main import main
main(["compare", sys.argv[1], "--enhance", "onnx:" + sys.argv[2], "--json", "--quiet", "--set", "resamples=200"])
"""


def make_trials(folder: Path, n_trials: int) -> None:
    """Write a dataset whose trials have several frames each, copies of one."""
    make_dataset(folder, n_trials, "png")
    manifest = folder / "manifest.csv"
    header, *rows = csv.reader(manifest.read_text(encoding="utf-8").splitlines())
    with manifest.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*header, "trial"])
        for number, (frame, *row) in enumerate(rows):
            for k in range(FRAMES_PER_TRIAL):
                copy = f"frames/{number}_{k}.png"
                shutil.copyfile(folder / frame, folder / copy)
                writer.writerow([copy, *row, number])


def rows() -> list[Row]:
    """Share of processor time beyond network and decoding, and memory against that of few trials."""
    with tempfile.TemporaryDirectory() as name:
        folder, few = Path(name) / "many", Path(name) / "few"
        make_trials(folder, N_TRIALS)
        make_trials(few, N_TRIALS // 5)
        path = denoiser(Path(name) / "denoiser.onnx", features=4)
        dataset = load_dataset(folder)
        paths = [dataset.frame_path(frame) for trial in dataset.trials for frame in trial.frames]
        network = find_enhancement(f"onnx:{path}")
        started = time.process_time()
        for one in paths:
            read_frame(one)
        decoded = time.process_time()
        ((_, after),) = compare_observers(dataset, [PyramidObserver()], [network])
        compared = time.process_time()
        share = (compared - decoded) / (decoded - started + after.record.cpu_s) - 1.0
        each_ms = 1e3 * after.record.cpu_s / len(paths)
        peaks = [process("-c", COMPARE, str(one), str(path)).peak_mb for one in (few, folder)]
    about = f"compare {N_TRIALS} × {FRAMES_PER_TRIAL} frames, a network of {each_ms:.0f} ms"
    return [
        Row(f"{about}: time beyond it and decoding, as a share", share, "<= 0.3"),
        Row(f"the same: peak of memory over that of {N_TRIALS // 5} trials", peaks[1] / peaks[0], "flat"),
    ]
