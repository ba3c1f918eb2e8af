"""Two processes of a local cluster against one process, and what a batch costs. Needs the extra `cluster`."""

from __future__ import annotations

import csv
import statistics
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from bench_scoring import make_dataset
from timing import Row

from todframes.frames.dataset import load_dataset
from todframes.jobs.run import Run, open_engine
from todframes.jobs.work import Engine, LocalEngine
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.score import score_dataset

ITEM_S = 0.005
N_ITEMS, N_DISTINCT, N_TRIALS = 4000, 40, 4000
PAIRS = 3


@dataclass
class Busy:
    """Work that uses a processor for some time for each item."""

    seconds: float

    def function(self) -> Callable[[int], int]:
        """Return the function of an item."""

        def work(item: int) -> int:
            started = time.thread_time()
            while time.thread_time() - started < self.seconds:
                pass
            return item

        return work

    def name(self, item: int) -> str:
        """Return what messages call an item."""
        return str(item)


def busy(engine: Engine) -> None:
    """Do some thousand items of 5 ms."""
    with closing(engine.run(Busy(ITEM_S), enumerate(range(N_ITEMS)))) as batches:
        assert sum(map(len, batches)) == N_ITEMS


def speed_up(run: Callable[[Engine], object], cluster: Engine) -> tuple[float, float]:
    """Median over pairs of the time of one process ÷ that of the cluster, and that of one process in seconds."""
    local, ratios, local_s = LocalEngine(), [], []
    for _ in range(PAIRS):
        times = []
        for engine in (local, cluster):
            started = time.perf_counter()
            run(engine)
            times.append(time.perf_counter() - started)
        ratios.append(times[0] / times[1])
        local_s.append(times[0])
    return statistics.median(ratios), min(local_s)


def rows() -> list[Row]:
    """All ratios of this file."""
    with tempfile.TemporaryDirectory() as name, open_engine("local:2", 1) as cluster:
        ratio, _ = speed_up(busy, cluster)
        found = [
            Row(f"{N_ITEMS} items of {ITEM_S * 1e3:g} ms, two workers ÷ twice one process", ratio / 2, ">= 0.9")
        ]

        folder = Path(name, "frames")
        make_dataset(folder, N_DISTINCT, "png")
        _repeat(folder, N_TRIALS // N_DISTINCT)
        dataset = load_dataset(folder)

        def score(engine: Engine) -> None:
            score_dataset(dataset, PyramidObserver(), run=Run(engine))

        ratio, local_s = speed_up(score, cluster)
        about = f"score {N_TRIALS} PNG frames of {local_s / N_TRIALS * 1e3:.1f} ms"
        found.append(Row(f"{about}, two workers ÷ twice one process", ratio / 2, ">= 0.9"))
    return found


def _repeat(folder: Path, times: int) -> None:
    """Show each frame of a dataset several times, by links to its file."""
    manifest = folder / "manifest.csv"
    header, *lines = list(csv.reader(manifest.read_text(encoding="utf-8").splitlines()))
    with manifest.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        for number in range(times):
            for frame, *others in lines:
                link = frame.replace("/", f"/{number}_")
                (folder / link).hardlink_to(folder / frame)
                writer.writerow([link, *others])
