"""What the benchmarks share."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple


class Row(NamedTuple):
    """A line of the table: what was measured, the ratio, and what was asked of it."""

    name: str
    measured: float
    asked: str


class Cost(NamedTuple):
    """What a whole process took."""

    wall_s: float
    cpu_s: float
    peak_mb: float


def best_s(run: Callable[[], object], repeats: int) -> float:
    """Shortest of some runs after one to warm up, in seconds."""
    run()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return min(times)


def process(*arguments: str) -> Cost:
    """Run Python with these arguments in a process of its own, which may keep the bytecode that it compiles."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    started = time.perf_counter()
    child = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.DEVNULL, env=environment)
    _, status, used = os.wait4(child.pid, 0)
    wall_s = time.perf_counter() - started
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise RuntimeError(f"{arguments} ended with status {child.returncode}")
    return Cost(wall_s, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0)


def paired_ratio(ours: Sequence[str], theirs: Sequence[str], repeats: int, cost: str = "wall_s") -> float:
    """Median over pairs, run in turn, of a cost of two processes, after a pair that compiles bytecode."""
    process(*ours)
    process(*theirs)
    ratios = sorted(getattr(process(*ours), cost) / getattr(process(*theirs), cost) for _ in range(repeats))
    return float(ratios[repeats // 2])


def cpu_ratio(ours: Sequence[str], theirs: Sequence[str], repeats: int) -> float:
    """The same of the processors' time."""
    return paired_ratio(ours, theirs, repeats, "cpu_s")
