"""Two processes of this machine against one."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from bench_scoring import linked
from timing import Row

from todframes.frames.dataset import load_dataset
from todframes.jobs.run import Run, open_engine
from todframes.jobs.work import Engine, LocalEngine
from todframes.observers.pyramid import PyramidObserver
from todframes.scoring.score import score_dataset

N_TRIALS = 4000
PAIRS = 3


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
    with tempfile.TemporaryDirectory() as name, open_engine(None, 2) as cluster:
        dataset = load_dataset(linked(Path(name), N_TRIALS))

        def score(engine: Engine) -> None:
            score_dataset(dataset, PyramidObserver(), run=Run(engine))

        ratio, local_s = speed_up(score, cluster)
        about = f"score {N_TRIALS} PNG frames of {local_s / N_TRIALS * 1e3:.1f} ms"
    return [Row(f"{about}, two workers ÷ twice one process", ratio / 2, ">= 0.9")]
