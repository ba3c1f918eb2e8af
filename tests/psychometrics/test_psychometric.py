"""The psychometric fit against closed forms, symmetries, brute force and simulated experiments."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import optimize
from scipy.special import xlogy
from scipy.stats import binom

from todframes.base.errors import DataError, SettingsError
from todframes.psychometrics.curves import weibull, weibull_level
from todframes.psychometrics.fit import HAVE_THRESHOLD, FitSettings, PsychometricFit, fit_counts, fit_trials
from todframes.psychometrics.threshold_search import ComputedThreshold, crossing, find_crossing, if_known

POINT = FitSettings(resamples=0)
LEVELS = np.geomspace(0.5, 2.0, 7)
SLOPES = np.geomspace(0.5, 500.0, 100)


def generator(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def counts(n_correct, n_trials=30, level=LEVELS, fit_settings=POINT) -> PsychometricFit:
    n = np.broadcast_to(n_trials, np.shape(level))
    return fit_counts(level, n_correct, n, settings=fit_settings, rng=generator())


def alpha_of(threshold: float, *, beta: float, lapse_rate: float) -> float:
    """The α that puts the raw 75 % point of a 4AFC curve at `threshold` (reference: x75, paper eq. 3)."""
    return threshold / math.log2((1 - lapse_rate - 0.25) / (0.25 - lapse_rate)) ** (1 / beta)


@pytest.mark.parametrize(("lapse_rate", "expected"), [(0.0, 0.625), (0.01, 0.62), (0.02, 0.615)])
def test_half_of_the_span_is_reached_at_alpha(lapse_rate, expected):
    assert weibull(0.7, alpha=0.7, beta=3.1, guess_rate=0.25, lapse_rate=lapse_rate) == pytest.approx(expected)


def test_curve_runs_from_guess_rate_to_one_minus_lapse_rate():
    ends = weibull([0.0, 1e300], alpha=1.0, beta=5.0, guess_rate=0.25, lapse_rate=0.02)
    np.testing.assert_allclose(ends, [0.25, 0.98], rtol=1e-15)
    inverse = weibull_level([0.1, 0.25, 0.98, 1.0], alpha=1.0, beta=5.0, guess_rate=0.25, lapse_rate=0.02)
    np.testing.assert_array_equal(inverse, [0.0, 0.0, math.inf, math.inf])


@given(
    st.floats(1e-6, 1e6), st.floats(0.05, 50.0), st.floats(0.0, 0.5), st.floats(0.0, 0.05), st.floats(0.05, 0.95)
)
def test_level_is_the_inverse_of_the_curve(alpha, beta, guess_rate, lapse_rate, share):
    curve = {"alpha": alpha, "beta": beta, "guess_rate": guess_rate, "lapse_rate": lapse_rate}
    p_correct = guess_rate + share * (1 - lapse_rate - guess_rate)
    # p is well conditioned in the level's exponent, so the round trip costs some ten roundings of 1.
    assert weibull(weibull_level(p_correct, **curve), **curve) == pytest.approx(p_correct, abs=1e-12)


@settings(max_examples=25, deadline=None)
@given(st.floats(0.6, 1.4), st.floats(0.8, 6.0), st.floats(0.0, 0.05), st.floats(0.31, 0.9), st.floats(1e-5, 1e5))
def test_exact_probabilities_give_back_their_curve(threshold, beta, lapse_rate, p_correct, unit):
    alpha = alpha_of(threshold, beta=beta, lapse_rate=lapse_rate)
    level = weibull_level([0.3, 0.4, 0.5, 0.6, 0.75, 0.85, 0.94, 0.9499], alpha=alpha, beta=beta,
                          guess_rate=0.25, lapse_rate=lapse_rate)  # fmt: skip
    p = weibull(level, alpha=alpha, beta=beta, guess_rate=0.25, lapse_rate=lapse_rate)
    fit = fit_trials(level * unit, p, settings=replace(POINT, p_correct=p_correct), rng=generator())
    expected = weibull_level(p_correct, alpha=alpha, beta=beta, guess_rate=0.25, lapse_rate=lapse_rate)
    assert fit.status == "ok"
    assert fit.threshold == pytest.approx(unit * expected, rel=1e-6)
    assert fit.alpha == pytest.approx(unit * alpha, rel=1e-6)
    assert fit.beta == pytest.approx(beta, rel=1e-6)
    assert fit.lapse_rate == pytest.approx(lapse_rate, abs=1e-6)


def test_order_and_split_of_the_trials_do_not_matter():
    fit = counts([8, 12, 13, 18, 24, 28, 30], fit_settings=FitSettings(resamples=200))
    level, right = np.repeat(LEVELS, 2)[::-1], [20, 10, 19, 9, 18, 6, 12, 6, 10, 3, 6, 6, 8, 0]
    split = fit_counts(level, right, np.tile([20, 10], 7), settings=FitSettings(resamples=200), rng=generator())
    assert split == fit
    answers = np.concatenate([np.arange(30) < k for k in (8, 12, 13, 18, 24, 28, 30)])
    shuffle = generator(3).permutation(answers.size)
    trials = fit_trials(
        np.repeat(LEVELS, 30)[shuffle], answers[shuffle], settings=FitSettings(resamples=200), rng=generator()
    )
    assert trials == fit


def loglik(parameters, level, n_correct, n_trials) -> float:
    ln_alpha, ln_beta, lapse_rate = parameters
    p = weibull(level, alpha=math.exp(ln_alpha), beta=math.exp(ln_beta), guess_rate=0.25, lapse_rate=lapse_rate)
    return float(np.sum(xlogy(n_correct, p) + xlogy(n_trials - n_correct, 1 - np.minimum(p, 1 - 1e-16))))


@pytest.mark.parametrize("seed", range(12))
def test_no_curve_of_a_brute_force_search_is_more_likely(seed):
    rng = generator(seed)
    level = np.sort(rng.uniform(0.2, 3.0, rng.integers(3, 9)))
    n_trials = rng.integers(1, 40, level.size)
    p = weibull(level, alpha=1.0, beta=rng.uniform(0.7, 8.0), guess_rate=0.25, lapse_rate=rng.choice([0, 0.05]))
    n_correct = rng.binomial(n_trials, p)
    fit = counts(n_correct, n_trials, level)
    if fit.alpha is None:
        pytest.skip("flat: no curve to compare")
    bounds = [(math.log(0.05), math.log(12.0)), (math.log(0.01), math.log(1000.0)), (0.0, 0.05)]
    grid = [np.linspace(low, high, k) for (low, high), k in zip(bounds, (40, 25, 4), strict=True)]
    starts = np.stack(np.meshgrid(*grid), axis=-1).reshape(-1, 3)
    scores = [loglik(start, level, n_correct, n_trials) for start in starts]
    searches = [
        optimize.minimize(lambda q: -loglik(q, level, n_correct, n_trials), starts[k], method="Nelder-Mead",
                          bounds=bounds, options={"xatol": 1e-7, "fatol": 1e-9})
        for k in np.argsort(scores)[-3:]
    ]  # fmt: skip
    reached = loglik((math.log(fit.alpha), math.log(fit.beta), fit.lapse_rate), level, n_correct, n_trials)
    # fatol is 1e-9; a likelihood that rises for ever with the slope is followed to within 1e-6 of its limit.
    assert reached >= max(-search.fun for search in searches) - 1e-6


@pytest.mark.parametrize(
    ("n_correct", "status"),
    [
        ([29, 30, 30, 30, 30, 30, 30], "always_exceeded"),
        ([8, 7, 8, 7, 8, 7, 8], "never_reached"),
        ([8, 7, 8, 7, 8, 7, 9], "never_reached"),
        ([20] * 7, "never_reached"),
        ([24] * 7, "always_exceeded"),
        ([20, 18, 16, 14, 12, 10, 8], "never_reached"),
        ([30, 29, 28, 27, 26, 25, 24], "always_exceeded"),
        ([7, 8, 9, 10, 13, 16, 20], "extrapolated"),
        ([25, 27, 28, 29, 30, 30, 30], "extrapolated"),
        ([8, 9, 12, 20, 25, 29, 30], "ok"),
        ([8, 14, 9, 20, 18, 29, 27], "ok"),
        ([7, 7, 6, 24, 30, 30, 30], "between_levels"),
        ([30, 30, 28, 24, 18, 12, 7], "falling"),
    ],
)
def test_status(n_correct, status):
    fit = counts(n_correct, fit_settings=FitSettings(resamples=100))
    assert fit.status == status
    assert (fit.threshold is None) == (fit.threshold_ci95 is None) == (status not in HAVE_THRESHOLD)
    if status == "extrapolated":
        assert not LEVELS[0] <= fit.threshold <= LEVELS[-1]
        assert LEVELS[0] / 2 <= fit.threshold <= LEVELS[-1] * 2


def test_criterion_above_the_lapse_ceiling_is_never_reached():
    p = weibull(LEVELS, alpha=0.8, beta=4.0, guess_rate=0.25, lapse_rate=0.04)
    fit = fit_trials(LEVELS, p, settings=replace(POINT, p_correct=0.97), rng=generator())
    assert (fit.status, fit.threshold) == ("never_reached", None)
    assert fit.lapse_rate == pytest.approx(0.04, abs=1e-6)


def test_one_level_is_too_few():
    fit = counts([10, 20], level=[1.0, 1.0])
    assert fit.status == "too_few_levels"
    assert (fit.threshold, fit.threshold_ci95, fit.alpha, fit.beta, fit.lapse_rate) == (None,) * 5
    assert [(point.level, point.n_trials, point.p_correct) for point in fit.points] == [(1.0, 60, 0.5)]


def test_a_step_that_determines_nothing_has_an_interval():
    """The curve is a step between two levels, and its slope there leaves the range of numbers."""
    chosen = FitSettings(resamples=40, lapse_rate=0.02)
    fit = fit_counts([1.0, 3.0], [0, 1], [2, 1], settings=chosen, rng=generator())
    low, high = fit.threshold_ci95
    assert 1.0 < fit.threshold < 3.0
    assert (low is None or low <= fit.threshold) and (high is None or high >= fit.threshold)


@pytest.mark.parametrize(
    ("n_correct", "low", "high"),
    [
        ([9, 33, 40], 0.5, 1.1),
        ([10, 20, 40], 1.1, 2.2),  # 50 % at 1.1: the threshold lies above it
        ([10, 40, 40], 0.5, 1.1),
    ],
)
def test_a_step_bounds_the_threshold_by_what_the_likelihood_ratio_does_not_reject(n_correct, low, high) -> None:
    """The likelihood ratio is that of Weibull curves of any slope."""
    level, n = np.array([0.5, 1.1, 2.2]), np.array([40, 40, 40])
    fit = fit_counts(level, n_correct, n, settings=FitSettings(resamples=200), rng=generator())
    assert fit.status == "between_levels"
    best = loglik((math.log(fit.alpha), math.log(fit.beta), fit.lapse_rate), level, n_correct, n)
    for threshold in np.linspace(low, high, 52)[1:-1]:
        ln_alpha = [math.log(alpha_of(threshold, beta=beta, lapse_rate=0.0)) for beta in SLOPES]
        curves = [
            loglik((ln, math.log(beta), 0.0), level, n_correct, n)
            for ln, beta in zip(ln_alpha, SLOPES, strict=True)
        ]
        # 3.84 is the 95 % point of χ²; slopes are 7 % apart.
        if 2.0 * (best - max(curves)) < 3.75:
            assert covered(fit, threshold), threshold


@pytest.mark.weekly
@pytest.mark.parametrize("truth", [1.0, 0.85])
def test_few_levels_hold_the_threshold_as_often_as_stated(truth: float) -> None:
    """Exact: every outcome of 12 answers to a steep curve at three levels, by its probability."""
    level, n = np.array([0.5, 1.1, 2.2]), 12
    p = weibull(level, alpha=alpha_of(truth, beta=6.0, lapse_rate=0.0), beta=6.0, guess_rate=0.25, lapse_rate=0.0)
    held = known = 0.0
    for n_correct in product(range(n + 1), repeat=3):
        probability = float(binom.pmf(n_correct, n, p).prod())
        if probability < 1e-4:
            continue
        fit = fit_counts(level, n_correct, [n] * 3, settings=FitSettings(resamples=100), rng=generator())
        if fit.threshold_ci95 is not None:
            known += probability
            held += probability * covered(fit, truth)
    assert known > 0.95 and held / known >= 0.95


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_any_answers_give_a_threshold_or_a_reason(data):
    level = data.draw(st.lists(st.floats(1e-6, 1e6), min_size=1, max_size=8))
    n_trials = [data.draw(st.sampled_from([1, 2, 30, 10**6])) for _ in level]
    n_correct = [data.draw(st.integers(0, n)) for n in n_trials]
    lapse_rate = data.draw(st.sampled_from([None, 0.0, 0.02]))
    chosen = FitSettings(resamples=40, lapse_rate=lapse_rate, guess_rate=data.draw(st.sampled_from([0.0, 0.25])))
    for fit in (
        fit_counts(level, n_correct, n_trials, settings=chosen, rng=generator()),
        fit_trials(level, np.array(n_correct) / n_trials, settings=chosen, rng=generator()),
    ):
        numbers = [fit.threshold, fit.alpha, fit.beta, fit.lapse_rate, *(fit.threshold_ci95 or ())]
        assert all(math.isfinite(number) for number in numbers if number is not None)
        assert (fit.threshold is not None) == (fit.status in HAVE_THRESHOLD)
        if fit.threshold is not None:
            low, high = fit.threshold_ci95
            assert (low is None or low <= fit.threshold * (1 + 1e-12)) and (
                high is None or high >= fit.threshold * (1 - 1e-12)
            )


@pytest.mark.parametrize(
    ("level", "n_correct", "n_trials", "rates"),
    [
        # The sum of the trials is no floating-point number: rounding once left a probability above 1.
        ([0.84, 1.29, 1.55], [7, 2**51, 2**53], [30, 2**53, 2**53], (0.5, 0.005, 0.05, 0.9949999995)),
        # A step far from all levels but one: the information is 1e-310, its inverse was infinite.
        ([1.1634277626790947e260, 1.2113719304401822e261, 2.6683305693385645e260, 3.345629407248644e261,
          2.518506483314855e260, 9.783007098562351e261], [2**51, 10**6, 0, 1, 250_000, 2**53],
         [2**53, 10**6, 1, 1, 10**6, 2**53], (0.99, 0.0099, 0.0, 0.9900999999999)),
    ],
)  # fmt: skip
def test_numbers_of_trials_up_to_2_53_have_intervals(level, n_correct, n_trials, rates):
    names = ("guess_rate", "lapse_rate", "lapse_rate_max", "p_correct")
    chosen = FitSettings(**dict(zip(names, rates, strict=True)), resamples=40)
    assert fit_counts(level, n_correct, n_trials, settings=chosen, rng=generator()).status in (
        "ok",
        "between_levels",
    )


def covered(fit: PsychometricFit, truth: float) -> bool:
    low, high = fit.threshold_ci95
    return (low is None or low <= truth) and (high is None or truth <= high)


# Of 300 intervals that each hold the truth with probability 0.95, the share that does has an SD of
# √(.95·.05/300) = 1.26 %: 92 to 98 % is 2.4 SD either way. The seeds are fixed, so the tests do not flicker.


@pytest.mark.weekly
@pytest.mark.parametrize(
    ("beta", "lapse_rate", "level", "n_trials"),
    [
        (1.5, 0.0, np.geomspace(0.4, 2.0, 7), None),
        (2.0, 0.02, np.linspace(0.4, 1.6, 7), None),
        (4.0, 0.0, np.geomspace(0.6, 1.6, 7), None),
        (2.0, 0.0, np.geomspace(0.5, 2.0, 12), 1),
        (2.0, 0.0, np.geomspace(0.5, 2.0, 7), 30),
    ],
)
def test_interval_holds_the_threshold_as_often_as_stated(beta, lapse_rate, level, n_trials) -> None:
    """Of 30 answers a level, or of one or 30 probabilities."""
    alpha = alpha_of(1.0, beta=beta, lapse_rate=lapse_rate)
    level = np.repeat(level, n_trials or 1)
    p = weibull(level, alpha=alpha, beta=beta, guess_rate=0.25, lapse_rate=lapse_rate)
    rng, chosen = generator(17 if n_trials is None else 5), FitSettings(resamples=200)
    fits = [
        fit_trials(level, rng.beta(20 * p, 20 * (1 - p)), settings=chosen, rng=rng)
        if n_trials
        else fit_counts(level, rng.binomial(30, p), [30] * 7, settings=chosen, rng=rng)
        for _ in range(300)
    ]
    assert all(fit.status == "ok" for fit in fits)
    assert 0.92 <= np.mean([covered(fit, 1.0) for fit in fits]) <= 0.98


def test_interval_is_random_through_its_generator_only():
    data, chosen = (LEVELS, [8, 12, 13, 18, 24, 28, 30], [30] * 7), FitSettings(resamples=99)
    fits = [fit_counts(*data, settings=chosen, rng=generator(seed)) for seed in (1, 1, 2)]
    # A sum may differ by a rounding where NumPy 2.0 finds its arrays elsewhere in memory.
    assert fits[0].threshold_ci95 == pytest.approx(fits[1].threshold_ci95, rel=1e-12)
    assert fits[0].threshold == pytest.approx(fits[2].threshold, rel=1e-12)
    assert fits[0].threshold_ci95 != fits[2].threshold_ci95
    assert counts([8, 12, 13, 18, 24, 28, 30]).threshold_ci95 is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"guess_rate": 1.0}, r"guess_rate: found 1.0, expected a number >= 0 and < 1"),
        ({"guess_rate": "a"}, r"guess_rate: found 'a', expected a number >= 0 and < 1"),
        ({"lapse_rate": 0.75}, r"lapse_rate: found 0.75, expected 0 to below 1 - guess_rate = 0.75"),
        ({"p_correct": 0.25}, r"p_correct: found 0.25, expected strictly between guess_rate = 0.25"),
        ({"p_correct": 0.98, "lapse_rate": 0.02}, r"p_correct: found 0.98, expected .* 1 - lapse_rate = 0.98"),
        ({"slope_spread": 0.0}, r"slope_spread: found 0.0, expected a finite number >= 0.001"),
        ({"resamples": 10}, r"resamples: found 10, expected 0 \(no interval\) or at least 40"),
    ],
)
def test_settings_are_checked_when_made(changes, message):
    with pytest.raises(SettingsError, match=message):
        FitSettings(**changes)


@pytest.mark.parametrize(
    ("level", "n_correct", "n_trials", "message"),
    [
        ([0.0, 1.0], [1, 1], [2, 2], r"level, element 0: found 0, expected a finite number > 0"),
        ([1.0, math.inf], [1, 1], [2, 2], r"level, element 1: found inf"),
        ([1.0, 2.0], [1.5, 1], [2, 2], r"n_correct, element 0: found 1.5, expected a whole number >= 0"),
        ([1.0, 2.0], [1, -1], [2, 2], r"n_correct, element 1: found -1, expected a whole number >= 0"),
        ([1.0, 2.0], [1, 3], [2, 2], r"n_correct, element 1: found 3, expected at most n_trials"),
        ([1.0, 2.0], [0, 0], [2, 0], r"n_trials, element 1: found 0, expected a whole number >= 1"),
        ([1.0, 2.0], [0, 0], [2, math.nan], r"n_trials, element 1: found nan"),
        ([1.0, 2.0], [0], [2, 2], r"found shapes level \(2,\) and n_correct \(1,\)"),
        ([], [], [], r"expected one element each per row, and at least one row"),
    ],
)
def test_counts_are_checked(level, n_correct, n_trials, message):
    with pytest.raises(DataError, match=message):
        fit_counts(level, n_correct, n_trials, rng=generator())


@pytest.mark.parametrize(("p", "message"), [(1.1, r"element 1: found 1.1, expected a number in \[0, 1\]"),
                                            (math.nan, r"p_correct, element 1: found nan")])  # fmt: skip
def test_trials_are_checked(p, message):
    with pytest.raises(DataError, match=message):
        fit_trials([1.0, 2.0], [0.5, p], rng=generator())


def test_search_goes_on_past_a_level_that_happens_to_be_as_high_as_the_end():
    """P is 0.7 at 1 and beyond 1e4, with a hill above 0.75 between them."""

    def proportion(level):
        return 0.7 + 0.1 * max(0.0, 1.0 - abs(math.log10(level) - 2.0) / 1.9)

    search = {"bounds": (1e-12, 1e12), "start": 1.0, "factor": 4.0, "saturates": True}
    # Half of the hill's height, 0.95 decades before its top.
    assert find_crossing(proportion, 0.75, **search) == ("ok", pytest.approx(10**1.05, rel=1e-6))


@pytest.mark.parametrize("near", [None, 0.3, 1.0, 40.0])
@pytest.mark.parametrize("ceiling", [0.74, 0.7501, 0.76, 0.95])
def test_crossing_of_a_curve_that_levels_off(near: float | None, ceiling: float) -> None:
    """P = ceiling − (ceiling − 1/4) / (1 + x²) has the threshold √((p − 1/4) / (ceiling − p))."""

    def proportion(level: float) -> float:
        return ceiling - (ceiling - 0.25) / (1.0 + level * level)

    status, level = crossing(proportion, 0.75, near=near, slope=0.4)
    if ceiling < 0.75:
        assert (status, level) == ("never_reached", None)
    else:
        assert status == "ok"
        # P is within 1e-6 of the criterion where the curve is flat, and 1e-6 of the level elsewhere.
        assert level == pytest.approx(math.sqrt(0.5 / (ceiling - 0.75)), rel=1e-6 if ceiling > 0.751 else 1e-2)
        assert abs(proportion(level) - 0.75) < 1e-6


@pytest.mark.parametrize(
    ("near", "slope", "steepness", "threshold", "levels"),
    [
        (None, math.nan, 1.5, 3.0, [math.inf, 1.0, 3.0]),
        (None, math.nan, 1.5, math.exp(5.0), [math.inf, 1.0, *np.exp([2.0, 4.0, 5.0])]),
        (3.0 * math.e, math.log(3.0) / 8.0, 1.5, 3.0, [3.0 * math.e, 3.0 / math.e, 3.0]),  # too flat: a step of 2
        (2.0, 2.0 * math.log(3.0) / 4.0, 2.0, 3.0, [2.0, 3.0]),  # dP/d ln level at the threshold
        (2.0, 1e3, 1.5, 3.0, [2.0, 3.0]),
        (2.0, 1e-3, 1.5, 3.0, [2.0, 3.0]),
        (2.0, math.nan, 3.0, 3.0, [2.0, 4.5, 3.0]),  # half as steep as the curve: twice the step, then a secant
    ],
)
def test_crossing_goes_along_secants(near, slope, steepness, threshold, levels) -> None:
    """The link of a Weibull curve is a line: the usual slope, 1.5, or the right one ends at once."""
    asked = []

    def proportion(level: float) -> float:
        asked.append(level)
        return 1.0 - 0.75 * 3.0 ** -((level / threshold) ** steepness) if level < math.inf else 1.0

    assert crossing(proportion, 0.75, near=near, slope=slope) == ("ok", pytest.approx(threshold, rel=1e-9))
    assert asked == pytest.approx(levels, rel=1e-9)


@pytest.mark.parametrize(
    ("curve", "saturates", "bounds", "status", "levels"),
    [
        (lambda _: 0.9, False, (0.2, 4.5), "always_exceeded", [1.0, 0.5, 0.25, 0.2]),
        (lambda _: 0.75, False, (0.2, 4.5), "never_reached", [1.0, 2.0, 4.0, 4.5]),
        # P is within 1e-3 of that at the bound from 449 on: at two levels in turn.
        (
            lambda x: 0.7 - 0.45 / (1.0 + x),
            True,
            (0.1, 1e9),
            "never_reached",
            [1.0, 2.0, 1e9, *2.0 ** np.arange(2, 11)],
        ),
    ],
)
def test_search_ends_at_its_bounds(curve, saturates, bounds, status, levels) -> None:
    asked, search = [], {"bounds": bounds, "start": 1.0, "factor": 2.0, "saturates": saturates}
    assert find_crossing(lambda level: asked.append(level) or curve(level), 0.75, **search) == (status, None)
    assert asked == pytest.approx(levels, rel=1e-12)


def test_a_threshold_is_known_to_three_tenths() -> None:
    known, missing = ComputedThreshold("ok", 2.0, 0.6), ComputedThreshold("never_reached")
    assert (if_known(known), if_known(missing)) == (known, missing)
    assert if_known(replace(known, numerical_error=None)).threshold == 2.0
    assert if_known(replace(known, numerical_error=0.61)) == ComputedThreshold("too_uncertain")
