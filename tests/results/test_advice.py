"""Warnings that follow from thresholds alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

import todframes as tod
from todframes.psychometrics.curves import FitPoint, weibull
from todframes.results.advice import SMALL, above_contrast_1, levels_to_add, numerical_errors
from todframes.results.data import Fit
from todframes.results.wording import percent_below

TRUE = {"alpha": 0.1, "beta": 2.0, "guess_rate": 0.25, "lapse_rate": 0.0}
N_TRIALS = 400
SAMPLES = Path(__file__).parents[2] / "sample_frames"
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
        ((0.07, 0.15), "found 2 levels, too few to see how the curve rises"),
        ((0.08, 0.2), "answers rise from 52 % at 0.08 to 95 % at 0.2, and how they rise in between is not known"),
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


def test_contrasts_above_1_have_a_warning() -> None:
    of = {"status": "ok", "p_correct": 0.75}
    fits = [Fit(group={}, level="contrast", threshold=k, **of) for k in (1.0, 1.25, 3.0, None)]
    fits.append(Fit(group={}, level="snr", threshold=2.0, **of))
    small, large = above_contrast_1(fits, lambda fit: fit.threshold > 2.0, 0.35)
    assert [(one.found, one.expected) for one in (small, large)] == [(1.25, 1.0), (3.0, 1.0)]
    known = "is above 1: no dark triangle has such a contrast, and a bright one has"
    assert small.message.startswith(f"the threshold contrast of 1.25 {known} 2.25 times the luminance around it. ")
    assert small.message.endswith(SMALL) and f"3.00 {known} 4.00 times" in large.message
    assert "looks at (aperture_sd_deg = 0.35); take smaller sizes" in large.message


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


@pytest.mark.parametrize(
    ("levels", "n_correct", "status", "code", "said"),
    [
        ((0.5, 1.1, 2.2), (9, 33, 40), "between_levels", "levels_to_add", "22 % at 0.5 to 82 % at 1.1"),
        ((100.0, 300.0, 800.0, 2000.0), (40, 35, 18, 10), "falling", "falling_answers", "give its inverse"),
        (
            (0.1, 0.2, 0.4),
            (4, 4, 5),
            "never_reached",
            "below_chance",
            "11 % of the answers are correct, fewer than",
        ),
    ],
)
def test_answers_that_are_no_curve_are_named(levels, n_correct, status, code, said) -> None:
    result = tod.fit_counts(levels, n_correct, [40] * len(levels), fit=tod.FitSettings(resamples=100))
    (fit,), (warning,) = result.fits, result.warnings
    assert (fit.status, warning.code) == (status, code)
    assert said in warning.message and "2200" not in warning.message
    # With the inverse of the levels, the answers have a threshold.
    if status == "falling":
        (again,) = tod.fit_counts(1.0 / np.array(levels), n_correct, [40] * 4).fits
        assert again.status == "ok" and 300.0 < 1.0 / again.threshold < 800.0


@pytest.mark.slow
def test_levels_of_a_comparison_name_the_algorithm() -> None:
    how = {"fit": tod.FitSettings(resamples=40), "white": 100.0, "examples": False}
    result = tod.compare(SAMPLES / "naked_eye", enhance=[brighter], **how)
    assert {warning.group["condition"] for warning in result.warnings} == {result.conditions[1].name}


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


def open_fit(status, levels, p_correct, **changes) -> Fit:
    points = tuple(FitPoint(level, 10, p) for level, p in zip(levels, p_correct, strict=True))
    return Fit(group={}, level="contrast", p_correct=0.75, status=status, points=points, **changes)


FAR = open_fit("extrapolated", (5e4, 1e5), (0.5, 0.7), threshold=1.4e5)


@pytest.mark.parametrize(
    ("status", "levels", "p_correct"),
    [
        # Histogram equalization: any contrast fills the range, and noise comes with it.
        ("always_exceeded", (0.05, 0.1, 0.2), (1.0, 0.95, 0.93)),
        ("always_exceeded", (0.05, 0.1, 0.2), (0.74, 0.78, 0.76)),
        ("never_reached", (0.05, 0.1, 0.2), (0.3, 0.6, 0.55)),
    ],
)
def test_levels_lie_on_the_side_of_the_threshold(status, levels, p_correct) -> None:
    (warning,) = levels_to_add([open_fit(status, levels, p_correct)])
    assert warning.expected
    assert all(one < 0.05 if status == "always_exceeded" else one > 0.2 for one in warning.expected)


@pytest.mark.parametrize(
    ("size_mrad", "fit", "message"),
    [
        # 0.35° are 6.1 mrad. The edges of a triangle of 60 mrad are 26 mrad from its middle, those of 20 mrad 9.
        (60.0, open_fit("never_reached", (0.2, 0.8), (0.25, 0.26)), "aperture_sd_deg = 0.35); take smaller sizes"),
        (20.0, open_fit("never_reached", (0.2, 0.8), (0.25, 0.26)), None),
        (20.0, open_fit("never_reached", (0.2, 0.8), (0.5, 0.7)), "add levels near"),
        (60.0, FAR, "(aperture_sd_deg = 0.35); take smaller sizes"),
        (1.0, FAR, "no display shows the contrasts"),
    ],
)
def test_levels_that_no_display_shows_are_not_advised(size_mrad, fit, message) -> None:
    warnings = levels_to_add([replace(fit, group={"size_mrad": size_mrad})], 0.35)
    assert [message in one.message for one in warnings] == [True] * (message is not None)
    assert message == "add levels near" or not any(one.expected for one in warnings)


@pytest.mark.parametrize(
    ("error", "status", "tolerance", "message"),
    [
        (0.1, "ok", 2e-3, "error of 0.1 is 11 % of the threshold, and the tolerance 0.2 %: the last digits are"),
        (0.003, "ok", 2e-3, None),
        (0.1, "ok", None, None),
        (None, "too_uncertain", None, "more than 30 % of the threshold, so there is none; larger sizes"),
    ],
)
def test_an_error_that_misses_the_tolerance(error, status, tolerance, message) -> None:
    threshold = 0.9223 if error else None
    fit = Fit(group={}, level="contrast", p_correct=0.75, status=status, threshold=threshold)
    warnings = numerical_errors([replace(fit, threshold_numerical_error=error)], tolerance)
    assert [message in one.message for one in warnings] == [True] * (message is not None)


def test_fits_without_points_have_no_levels() -> None:
    assert levels_to_add([Fit(group={}, level="contrast", p_correct=0.75, status="ok", threshold=0.1)]) == ()


@pytest.mark.parametrize(
    ("share", "criterion", "text"),
    [
        (0.52, 0.75, "52"),
        (0.81, 0.9999, "81"),
        (0.9998, 0.9999, "99.98"),
        (0.7496, 0.75, "74.96"),
        (1.0, 0.75, "100"),
    ],
)
def test_a_share_below_a_criterion_is_not_rounded_up_to_it(share, criterion, text) -> None:
    assert percent_below(share, criterion) == text
