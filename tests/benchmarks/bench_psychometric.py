"""Time of a psychometric fit and its interval against psignifit, 30 trials at each of 7 levels, one process.

Run from the repository's root: python tests/benchmarks/bench_psychometric.py
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable

import numpy as np

from todframes.psychometric import FitSettings, fit_counts

LEVEL = np.geomspace(0.5, 2.0, 7)
N_CORRECT = np.array([8, 11, 14, 19, 24, 28, 30])
N_TRIALS = np.full(7, 30)


def best_s(run: Callable[[], object], repeats: int) -> float:
    """Shortest of some runs after one to warm up, in seconds."""
    run()
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return min(times)


def rows() -> list[tuple[str, float, float]]:
    """(name, how many times faster than psignifit, how many times is asked)."""
    import psignifit

    def ours(resamples: int) -> object:
        settings = FitSettings(resamples=resamples)
        return fit_counts(LEVEL, N_CORRECT, N_TRIALS, settings=settings, rng=np.random.default_rng(0))

    def theirs() -> object:
        data = np.column_stack([np.log(LEVEL), N_CORRECT, N_TRIALS])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return psignifit.psignifit(
                data, sigmoid="weibull", experiment_type="nAFC", experiment_choices=4, verbose=False
            )

    reference_s = best_s(theirs, 3)
    point_s, interval_s = best_s(lambda: ours(0), 30), best_s(lambda: ours(2000), 10)
    return [
        (f"fit without interval ({point_s * 1e3:.2f} ms)", reference_s / point_s, 50.0),
        (f"fit with interval, 2000 resamples ({interval_s * 1e3:.1f} ms)", reference_s / interval_s, 4.0),
    ]


if __name__ == "__main__":
    table = rows()
    width = max(len(name) for name, _, _ in table)
    print(f"{'times faster than psignifit':{width}}  {'measured':>9}  {'asked':>6}")
    for name, measured, asked in table:
        print(f"{name:{width}}  {measured:9.1f}  {asked:6.1f}")
