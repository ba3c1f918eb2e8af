"""Time of a psychometric fit and its interval against psignifit, 30 trials at each of 7 levels, in one process."""

from __future__ import annotations

import warnings

import numpy as np
from timing import Row, best_s

from todframes.psychometrics.fit import FitSettings, fit_counts

LEVEL = np.geomspace(0.5, 2.0, 7)
N_CORRECT = np.array([8, 11, 14, 19, 24, 28, 30])
N_TRIALS = np.full(7, 30)


def rows() -> list[Row]:
    """The point fit and the fit with its interval, each against psignifit's one call that gives both."""
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
        Row(f"point fit ({point_s * 1e3:.2f} ms), times faster than psignifit", reference_s / point_s, ">= 50"),
        Row(
            f"fit with 2000 resamples ({interval_s * 1e3:.0f} ms), times faster than psignifit",
            reference_s / interval_s,
            ">= 4",
        ),
    ]
