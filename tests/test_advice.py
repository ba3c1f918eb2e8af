"""Warnings that follow from thresholds alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

import todframes as tod
from todframes.psychometrics.weibull import weibull
from todframes.report.advice import levels_to_add

TRUE = {"alpha": 0.1, "beta": 2.0, "guess_rate": 0.25, "lapse_rate": 0.0}
N_TRIALS = 400
SAMPLES = Path(__file__).parent.parent / "sample_frames"
# A Weibull curve of slope 2 without lapses is at 75 % correct at α·√log₂ 3.
THRESHOLD = 0.1 * np.log2(3.0) ** 0.5


def fitted(*levels):
    """The fit of counts at these levels, as expected of the true curve."""
    right = np.rint(N_TRIALS * weibull(np.array(levels), **TRUE))
    return tod.fit_counts(levels, right, [N_TRIALS] * len(levels), fit=tod.FitSettings(resamples=200))


@pytest.mark.parametrize(
    ("levels", "said"),
    [
        ((0.25, 0.3, 0.35), "all levels are above the threshold of 75 % correct, the weakest is 0.25"),
        ((0.15, 0.2, 0.3), "the threshold lies below all levels shown, 0.15 to 0.3"),
        ((0.03, 0.05, 0.08), "the threshold lies above all levels shown, 0.03 to 0.08"),
        ((0.1,), "found 1 level, too few to see how the curve rises"),
        ((0.08, 0.2), "found 2 levels, too few to see how the curve rises"),
        ((0.01, 0.05, 0.9), "no level lies between 0.05 and 0.9, where the threshold is"),
    ],
)
def test_levels_that_leave_the_threshold_open(levels, said) -> None:
    result = fitted(*levels)
    (warning,) = result.warnings
    assert warning.code == "levels_to_add"
    assert said in warning.message
    assert warning.found == list(levels)
    # With the levels asked for, the threshold is known.
    again = fitted(*sorted({*levels, *warning.expected}))
    assert (again.warnings, again.fits[0].status) == ((), "ok")
    low, high = again.fits[0].threshold_ci95
    assert low < THRESHOLD < high


def test_levels_about_the_threshold_have_no_warning() -> None:
    assert fitted(0.07, 0.1, 0.14, 0.2).warnings == ()


def test_stronger_levels_where_a_curve_stays_below() -> None:
    (warning,) = tod.fit_counts([0.1, 0.2, 0.4], [200, 205, 210], [400] * 3).warnings
    assert "below the threshold of 75 % correct: at most 52 % correct is reached, at 0.4;" in warning.message
    assert min(warning.expected) > 0.4


def test_a_curve_at_chance_is_not_known_to_rise_with_level() -> None:
    """A wrong place or a mirrored camera needs no stronger levels."""
    result = tod.fit_counts([0.1, 0.2, 0.4], [10, 9, 11], [40, 40, 40])
    assert (result.fits[0].status, result.warnings) == ("never_reached", ())


@pytest.mark.slow
def test_levels_of_a_comparison_name_the_algorithm() -> None:
    result = tod.compare(
        SAMPLES / "naked_eye", [brighter], fit=tod.FitSettings(resamples=40), white=100.0, examples=False
    )
    assert {warning.group["algorithm"] for warning in result.warnings} == {result.algorithms[1].name}


def brighter(image, gain=40.0):
    return 0.22 + gain * (image - 0.22)


def test_scenes_that_leave_the_interval_open_need_more_scenes() -> None:
    (fit,) = fitted(0.07, 0.1, 0.14, 0.2).fits
    over_scenes = replace(fit, threshold_ci95=(0.06, None), threshold_ci95_same_scenes=fit.threshold_ci95)
    (warning,) = levels_to_add([over_scenes])
    assert warning.message.endswith("scenes differ and are few; take more scenes")
    assert warning.expected == []
    # Where trials leave it open too, these come first.
    (warning,) = levels_to_add([replace(over_scenes, threshold_ci95_same_scenes=(None, 0.2))])
    assert warning.message.endswith("show more trials")


def test_fits_without_points_have_no_levels() -> None:
    assert levels_to_add(tod.naked_eye(size_mrad=1.0).fits) == ()
