"""The store of finished trials against the scoring itself: what it adds to a run of 20,000 frames."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

from bench_scoring import make_dataset
from timing import Row

from todframes.frames.checksums import write_sha256
from todframes.frames.dataset import Dataset, load_dataset
from todframes.frames.files import frame_sha256
from todframes.jobs.store import Store
from todframes.jobs.work import LocalEngine
from todframes.observers.pyramid import PyramidObserver
from todframes.psychometrics.fit import FitSettings
from todframes.scoring.score import score_dataset
from todframes.scoring.work import Run

N_FRAMES = 1_000
REPEATS = 3


def rows() -> list[Row]:
    """Share of processor time that the store adds to a run of 1,000 frames; all of it grows with the trials."""
    found = []
    with tempfile.TemporaryDirectory() as name:
        for suffix in ("png", "exr"):
            folder = Path(name) / suffix
            make_dataset(folder, N_FRAMES, suffix)
            dataset = load_dataset(folder)
            size_kb = sum(path.stat().st_size for path in (folder / "frames").iterdir()) / N_FRAMES / 1e3
            for checked in (False, True):
                if checked:
                    frames = [frame for trial in dataset.trials for frame in trial.frames]
                    write_sha256(dataset, {one.path: frame_sha256(dataset.path / one.path) for one in frames})
                    dataset = load_dataset(folder)
                has = "with" if checked else "without"
                about = f"store ÷ scoring, {suffix} of {size_kb:.0f} kB {has} sha256 in the manifest"
                found.append(Row(about, added_share(dataset, Path(name) / "store"), "<= 0.03"))
    return found


def added_share(dataset: Dataset, folder: Path) -> float:
    """Median of the processor time that keeping all results adds, as a share of a run that keeps none."""
    shares = []
    for _ in range(REPEATS):
        without_s = scoring_s(dataset, None)
        store = Store(folder, "store")
        store.begin()
        shares.append(scoring_s(dataset, store) / without_s - 1.0)
        assert len(store) >= len(dataset.trials)
        store.close()
        shutil.rmtree(folder)
    return sorted(shares)[REPEATS // 2]


def scoring_s(dataset: Dataset, store: Store | None) -> float:
    """Processor time of a scoring, the system's included."""
    before = os.times()
    score_dataset(dataset, PyramidObserver(), fit_settings=FitSettings(resamples=0), run=Run(LocalEngine(), store))
    after = os.times()
    return after.user + after.system - before.user - before.system
