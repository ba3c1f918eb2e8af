"""Comparing algorithms and a network against their own running time and one decoding of the frames, and memory."""

from __future__ import annotations

import csv
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from bench_scoring import make_dataset
from timing import Row, process

sys.path.insert(0, str(Path(__file__).parents[1]))

from networks import denoiser

from todframes.enhancement.finding import find_enhancement
from todframes.enhancement.scored_algorithms import score_algorithms
from todframes.frames.dataset import load_dataset
from todframes.frames.files import read_frame
from todframes.observers.pyramid import PyramidObserver
from todframes.psychometrics.fit import FitSettings

N_TRIALS, FRAMES_PER_TRIAL = 500, 5
USUAL = ("clahe", "unsharp", "gaussian", "median", "bilateral")
QUICK = ("clahe", "gaussian", "median", "gamma", "guided")
REPEATS = 3
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


def share_beyond(folder: Path, specs: Sequence[str]) -> Row:
    """Processor time beyond the algorithms and decoding, as a share: the median of some comparisons."""
    dataset = load_dataset(folder)
    paths = [dataset.frame_path(frame) for trial in dataset.trials for frame in trial.frames]
    algorithms, shares = [find_enhancement(spec) for spec in specs], []
    for _ in range(REPEATS):
        started = time.process_time()
        for path in paths:
            read_frame(path)
        decoded = time.process_time()
        (results,) = score_algorithms(dataset, [PyramidObserver()], algorithms, fit_settings=FitSettings())
        algorithms_s = sum(result.record.cpu_s for result in results)
        shares.append((time.process_time() - decoded) / (decoded - started + algorithms_s) - 1.0)
    each_ms = 1e3 * algorithms_s / len(paths)
    about = f"compare {len(paths)} frames, {len(specs)} algorithms of {each_ms:.0f} ms a frame in all"
    asked = "–" if specs is QUICK else "<= 0.3"
    return Row(f"{about}: time beyond them and decoding, as a share", sorted(shares)[REPEATS // 2], asked)


def rows() -> list[Row]:
    """Shares of time for the usual algorithms, some that take next to no time, and a network, and its memory."""
    with tempfile.TemporaryDirectory() as name:
        single, many, few = (Path(name, part) for part in ("single", "many", "few"))
        make_dataset(single, N_TRIALS, "png")
        make_trials(many, N_TRIALS)
        make_trials(few, N_TRIALS // 5)
        network = denoiser(Path(name) / "denoiser.onnx", features=4)
        shares = [
            share_beyond(single, USUAL),
            share_beyond(single, QUICK),
            share_beyond(many, [f"onnx:{network}"]),
        ]
        peaks = [process("-c", COMPARE, str(one), str(network)).peak_mb for one in (few, many)]
    about = f"compare {N_TRIALS} × {FRAMES_PER_TRIAL} frames with a network"
    return [
        *shares,
        Row(f"{about}: peak of memory over that of {N_TRIALS // 5} trials", peaks[1] / peaks[0], "flat"),
    ]
