"""Thresholds of the psychometric fit against psignifit's, on the same counts."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from todframes.psychometrics.curves import weibull
from todframes.psychometrics.fit import FitSettings, fit_counts

psignifit = pytest.importorskip("psignifit")

pytestmark = pytest.mark.oracle

# psignifit's threshold is a proportion of the unscaled sigmoid; raw 75 % in 4AFC without lapses is .50/.75.
UNSCALED_75 = (0.75 - 0.25) / 0.75


def oracle(level, n_correct, n_trials, **experiment):
    data = np.column_stack([level, n_correct, n_trials])
    with warnings.catch_warnings():
        # Its notes on priors and bounds; none concerns the answer.
        warnings.simplefilter("ignore")
        return psignifit.psignifit(data, verbose=False, **experiment)


@pytest.mark.slow
@pytest.mark.every_case
@pytest.mark.parametrize(("seed", "beta"), [(0, 1.5), (1, 2.0), (2, 3.0), (3, 4.0)])
def test_four_alternative_weibull(seed, beta):
    level, n_trials = np.geomspace(0.5, 2.0, 7), np.full(7, 30)
    p = weibull(level, alpha=0.9, beta=beta, guess_rate=0.25, lapse_rate=0.0)
    rng = np.random.default_rng(seed)
    n_correct = rng.binomial(n_trials, p)
    fit = fit_counts(level, n_correct, n_trials, settings=FitSettings(lapse_rate=0.0), rng=rng)
    result = oracle(
        np.log(level), n_correct, n_trials, sigmoid="weibull", experiment_type="nAFC", experiment_choices=4,
        thresh_PC=UNSCALED_75, fixed_parameters={"lambda": 0.0, "gamma": 0.25},
    )  # fmt: skip
    ln_threshold = result.parameter_estimate["threshold"]
    low, high = np.exp(result.confidence_intervals["threshold"]["0.95"])
    # Maximum likelihood here, the posterior's mode there: half a standard error, an eighth of the interval.
    widths = np.log([high / low, fit.threshold_ci95[1] / fit.threshold_ci95[0]])
    assert abs(np.log(fit.threshold) - ln_threshold) < min(widths) / 8
    assert low < fit.threshold < high
    assert fit.threshold_ci95[0] < np.exp(ln_threshold) < fit.threshold_ci95[1]
    # Both hold 95 % of much the same likelihood; priors and calibration change the width by less than half.
    assert 1 / 1.5 < widths[1] / widths[0] < 1.5


def test_published_two_alternative_example():
    # psignifit's own test, a Gaussian there: MAP threshold 1.19233664 at the sigmoid's middle, raw 75 %. The
    # curves differ in shape, so the thresholds agree within the intervals only.
    level = 0.25 + np.arange(10) / 6
    n_correct = [4, 6, 3, 8, 7, 5, 8, 9, 9, 10]
    fit = fit_counts(
        level, n_correct, [10] * 10, settings=FitSettings(guess_rate=0.5), rng=np.random.default_rng(0)
    )
    low, high = fit.threshold_ci95
    assert low < 1.19233664 < high
