"""Ratios of thresholds from the same trials: scale, identity, honest intervals, groups without a threshold."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from todframes.comparison.ratios import holm
from todframes.observers.decision import answer_probability
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import triangle_on
from todframes.psychometrics.bootstrap import draw_backgrounds
from todframes.psychometrics.curves import CurveParameters, FitPoint, weibull
from todframes.psychometrics.fit import FitSettings, PsychometricFit, fit_trials
from todframes.psychometrics.paired_bootstrap import (
    RatioDraws,
    _fitted,
    ratio_draws,
    threshold_draws,
    threshold_ratio,
)
from todframes.scoring.naked_eye import contrast_threshold
from todframes.stimulus import Stimulus

SETTINGS = FitSettings(resamples=400)
LEVELS = np.geomspace(0.5, 2.0, 7)


def p_of(level, threshold: float, lapse_rate: float = 0.0):
    """A Weibull curve with β = 2 that is right in 75 % at the threshold."""
    span = 0.75 - lapse_rate
    alpha = threshold / math.sqrt(math.log2(span / (0.25 - lapse_rate)))
    return weibull(level, alpha=alpha, beta=2.0, guess_rate=0.25, lapse_rate=lapse_rate)


def curves(level, series, rng):
    return [fit_trials(level, p, settings=FitSettings(resamples=0), rng=rng) for p in series]


def width(found) -> float:
    return math.log(found.ratio_ci95[1] / found.ratio_ci95[0])


def compared(level, *series, seed: int = 1):
    """Ratio of each series but the first to the first."""
    p_correct, rng = np.array(series, dtype=np.float64), np.random.default_rng(seed)
    fits = curves(level, p_correct, rng)
    reference, *others = threshold_draws(np.asarray(level), p_correct, fits, settings=SETTINGS, rng=rng)
    return [threshold_ratio([ratio_draws(draws, reference)]) for draws in others]


@pytest.mark.parametrize(("n_trials", "sampled"), [(1, False), (2, True), (12, False), (12, True)])
def test_the_same_answers_have_ratio_one_and_nothing_else(sampled: bool, n_trials: int) -> None:
    rng, level = np.random.default_rng(0), np.repeat(LEVELS, n_trials)
    p = np.clip(p_of(level, 1.0) + rng.normal(0.0, 0.05, level.size), 0.0, 1.0)
    answers = (rng.random(level.size) < p).astype(np.float64) if sampled else p
    same, again = compared(level, answers, answers, answers)
    assert same == again
    assert (same.ratio, same.p_value, same.ratio_ci95) == (1.0, 1.0, (1.0, 1.0))


def test_a_ratio_known_from_the_curves() -> None:
    """Noise is the same in both; the second threshold is 0.8 of the first."""
    rng, level = np.random.default_rng(1), np.repeat(LEVELS, 20)
    noise = rng.normal(0.0, 0.3, level.size)  # of ln level
    (found,) = compared(level, p_of(level * np.exp(noise), 1.0), p_of(level * np.exp(noise), 0.8))
    low, high = found.ratio_ci95
    assert low <= 0.8 <= high
    # Noise moves a threshold by 0.3/√(trials near it), some 4 % or 16 % from end to end, but both alike.
    assert width(found) < 0.08
    assert (found.p_value, found.is_lower) == (2 / 401, True)


@pytest.mark.parametrize("sampled", [False, True])
def test_units_and_order_do_not_matter(sampled: bool) -> None:
    rng, level = np.random.default_rng(3), np.repeat(LEVELS, 10)
    noise = rng.normal(0.0, 0.2, level.size)
    series = np.array([p_of(level * np.exp(noise), threshold) for threshold in (1.0, 1.2)])
    if sampled:
        series = (rng.random(level.size) < series).astype(np.float64)
    (found,) = compared(level, *series)
    (scaled,) = compared(1e-3 * level, *series)
    assert scaled.ratio == pytest.approx(found.ratio, rel=1e-9)
    assert scaled.ratio_ci95 == pytest.approx(found.ratio_ci95, rel=1e-6)
    order = np.argsort(np.tile(np.arange(10), 7), kind="stable")  # levels mixed, trials of a level in their order
    assert compared(level[order], *series[:, order])[0] == found


def answers_of_two_alike(*, common: float, own: float, sampled: bool) -> tuple[np.ndarray, np.ndarray]:
    """Levels, and answers of the real observer to two algorithms that are alike: (level, 400, 2).

    External noise, in units of the internal noise, is common to both or each one's own. Every pair is there the
    other way round as well: nothing tells the two apart.
    """
    observer, size_mrad, rng = PyramidObserver(), 1.0, np.random.default_rng(1)
    readout = observer.readout(Stimulus(size_mrad))
    triangles = (triangle_on(readout.grid, size_mrad, x=dx, y=dy) for dx, dy in rng.uniform(-0.5, 0.5, (200, 2)))
    signal = np.array([readout.score_deviations(triangle) for triangle in triangles])[:, None]
    weights = readout.deviations.reshape(4, -1)
    external = weights @ weights.T
    external *= np.trace(readout.noise_covariance) / np.trace(external)

    def noise(covariance, *shape):
        values, vectors = np.linalg.eigh(covariance)
        return rng.normal(size=(*shape, 4)) @ (vectors * np.sqrt(np.clip(values, 0.0, None))).T

    middle = contrast_threshold(observer, size_mrad=size_mrad).threshold * math.sqrt(1 + common**2 + own**2)
    answers = []
    for level in middle * LEVELS:
        scores = level * signal + common * noise(external, 200, 1) + own * noise(external, 200, 2)
        if sampled:
            right = (scores + noise(readout.noise_covariance, 200, 1)).argmax(axis=2) == 0
        else:
            right = answer_probability(scores, readout.noise_covariance, 0, tolerance=1e-9)
        answers.append(np.concatenate([right, right[:, ::-1]]))
    return middle * LEVELS, np.array(answers, dtype=np.float64)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("experiments", "common", "own", "sampled", "curve"),
    [(200, 1.0, 0.5, False, "observer"), (200, 1.0, 0.5, False, "weibull"), (100, 0.0, 0.5, True, "weibull")],
)
@pytest.mark.weekly
def test_algorithms_that_are_alike_are_hardly_ever_called_different(
    experiments: int, common: float, own: float, sampled: bool, curve: str
) -> None:
    """At most 5 % of simulated experiments of 12 trials a level."""
    levels, answers = answers_of_two_alike(common=common, own=own, sampled=sampled)
    rng, level, different = np.random.default_rng(8), np.repeat(levels, 12), 0
    for _ in range(experiments):
        chosen = rng.integers(answers.shape[1], size=(7, 12))
        p_correct = answers[np.arange(7)[:, None], chosen].reshape(-1, 2).T
        fits = [fit_trials(level, p, curve=curve, settings=FitSettings(resamples=0), rng=rng) for p in p_correct]
        settings = FitSettings(resamples=119)
        reference, draws = threshold_draws(level, p_correct, fits, settings=settings, rng=rng)
        different += threshold_ratio([ratio_draws(draws, reference)]).p_value < 0.05
    assert different <= 0.05 * experiments


@pytest.mark.parametrize(
    ("reference", "other", "is_lower", "sampled"),
    [
        (1.0, 9.0, False, True),
        (1.0, 0.05, True, False),
        (9.0, 0.05, True, False),
    ],
)
def test_a_threshold_that_one_of_the_two_lacks(
    reference: float, other: float, is_lower: bool, sampled: bool
) -> None:
    rng, level = np.random.default_rng(4), np.repeat(LEVELS, 20)
    series = [p_of(level * np.exp(rng.normal(0.0, 0.1, level.size)), at) for at in (reference, other)]
    if sampled:
        series = [(rng.random(level.size) < p).astype(np.float64) for p in series]
    (found,) = compared(level, *series)
    assert (found.ratio, found.ratio_ci95, found.is_lower) == (None, None, is_lower)
    assert found.p_value == 2 / 401


@pytest.mark.parametrize("threshold", [9.0, 0.05])
def test_a_threshold_that_both_lack(threshold: float) -> None:
    level = np.repeat(LEVELS, 20)
    spread = np.random.default_rng(5).normal(0.0, 0.02, (2, level.size))
    (found,) = compared(level, *np.clip(p_of(level, threshold) + spread, 0.0, 1.0))
    assert (found.ratio, found.p_value, found.is_lower) == (None, 1.0, False)


def test_one_level_tells_nothing() -> None:
    (found,) = compared(np.ones(30), np.full(30, 0.4), np.full(30, 0.9))
    assert (found.ratio, found.p_value) == (None, 1.0)


def draws(ratio: float | None, spread: float, points_ratio: float | None = None, seed: int = 0) -> RatioDraws:
    middle = math.log(ratio) if ratio is not None else -math.inf
    return RatioDraws(ratio, points_ratio, middle + np.random.default_rng(seed).normal(0.0, spread, 1999))


def test_draws_on_either_side_of_one_per_cent_are_counted() -> None:
    """Of 40: three at most 1 % above, and 38 at most 1 % below; two-sided."""
    ln_ratios = np.array([-0.02, -0.02, 0.01, *[0.02] * 36, -0.01])
    low, high = (pytest.approx(math.exp(end)) for end in (-0.02, 0.02))
    assert threshold_ratio([RatioDraws(math.exp(0.02), None, ln_ratios)]) == (high, (low, high), 10 / 41, False)
    mirrored = threshold_ratio([RatioDraws(math.exp(-0.02), None, -ln_ratios)])
    assert (mirrored.p_value, mirrored.is_lower) == (10 / 41, True)
    unknown = threshold_ratio([RatioDraws(1.0, None, np.array([-math.inf, *[0.0] * 38, math.inf]))])
    assert unknown == (1.0, (None, None), 1.0, False)
    none = threshold_ratio([draws(0.9, 0.01), RatioDraws(None, None, np.full(1999, -math.inf))])
    assert none == (None, None, 2 / 2000, True)
    both = [RatioDraws(0.5, None, np.array([math.inf])), RatioDraws(2.0, None, np.array([-math.inf]))]
    assert threshold_ratio(both) == (1.0, (1.0, 1.0), 1.0, False)


def test_the_curve_of_a_fit_is_its_own_or_its_mean() -> None:
    level, points = np.array([1e-9, 1.0, 2.0]), (FitPoint(1.0, 3, 0.4), FitPoint(2.0, 1, 0.8))
    flat = PsychometricFit(curve="weibull", p_correct=0.75, guess_rate=0.25, n_trials=4, points=points)
    steep = replace(flat, alpha=1.0, beta=40.0, lapse_rate=0.0)
    own = replace(steep, curve="observer", observer_curve=CurveParameters(1.0, 1.0))
    assert _fitted(flat, level) == pytest.approx(0.5)
    assert _fitted(steep, level) == pytest.approx([0.25, 0.625, 1.0 - 1e-6], rel=1e-12)
    orthants = answer_probability(np.outer(level, [1.0, 0.0, 0.0, 0.0]), np.eye(4), 0)
    assert _fitted(own, level) == pytest.approx(orthants, abs=2e-8)
    assert _fitted(replace(steep, curve="observer"), level) == pytest.approx(0.5)


def test_a_difference_that_the_points_do_not_share_is_not_shown() -> None:
    """A curve that fits one series worse than the other moves its threshold; the points say what is so."""
    sure = threshold_ratio([draws(0.97, 0.002, points_ratio=0.975)])
    unsure = threshold_ratio([draws(0.97, 0.002, points_ratio=1.01)])
    assert sure.p_value == 2 / 2000
    assert sure.ratio_ci95[1] == 0.975
    assert (unsure.p_value, unsure.ratio_ci95[1]) == (1.0, 1.01)


def test_holm() -> None:
    """The example of Holm's own rule: of three, the smallest is tripled, the next doubled."""
    assert holm([0.01, 0.04, 0.03]).tolist() == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.6, 0.7]).tolist() == [1.0, 1.0]
    assert holm([]).size == 0


def test_the_interval_of_a_threshold_over_backgrounds_is_students() -> None:
    """Eight backgrounds without trial noise: t(7) · s / √8, whatever the number of trials on each."""
    apart, rng = np.array([-0.05, -0.03, -0.02, 0.0, 0.0, 0.02, 0.03, 0.05]), np.random.default_rng(5)
    for n_trials in (2, 6):
        scene = np.tile(np.repeat(np.arange(8), n_trials), len(LEVELS))
        level = np.repeat(LEVELS, 8 * n_trials)
        p = p_of(level * np.exp(apart[scene]), 1.0)
        fit = fit_trials(level, p, settings=SETTINGS, rng=np.random.default_rng(n_trials))
        of_scenes = fit_trials(
            level, p, settings=SETTINGS, rng=np.random.default_rng(n_trials), backgrounds=7 * scene
        )
        assert of_scenes.threshold_ci95_same_scenes == fit.threshold_ci95
        trials_alone = replace(of_scenes, threshold_ci95=fit.threshold_ci95, threshold_ci95_same_scenes=None)
        assert trials_alone == fit
        low, high = of_scenes.threshold_ci95
        # 400 resamples place an end of an interval to 8 % of its half width.
        assert math.log(high / low) == pytest.approx(2.0 * 2.365 * apart.std(ddof=1) / math.sqrt(8.0), rel=0.2)
    without = fit_trials(level, p, settings=FitSettings(resamples=0), rng=rng, backgrounds=scene)
    assert without.threshold_ci95 is without.threshold_ci95_same_scenes is None
    one = fit_trials(level, p, settings=SETTINGS, rng=np.random.default_rng(6), backgrounds=np.zeros_like(scene))
    assert one == fit


def test_the_same_backgrounds_are_drawn_for_all_groups_with_students_factor() -> None:
    effects, rng = np.random.default_rng(3).normal(-0.1, 0.1, 8), np.random.default_rng(11)
    scene, level = np.tile(np.arange(8), len(LEVELS)), np.repeat(LEVELS, 8)
    series = np.array([p_of(level * np.exp(-k * effects[scene]), 1.0) for k in (0, 1)])
    plain = draw_backgrounds(8, SETTINGS.resamples, rng)._replace(widening=np.ones(SETTINGS.resamples))
    fits, common = curves(level, series, rng), {"settings": SETTINGS, "rng": rng, "backgrounds": scene}
    once, again, wide = (
        ratio_draws(*threshold_draws(level, series, fits, **common, drawn_backgrounds=drawn)[::-1])
        for drawn in (plain, plain, plain._replace(widening=3.0 * plain.widening))
    )
    assert threshold_ratio([once, again]).ratio_ci95 == pytest.approx(threshold_ratio([once]).ratio_ci95, rel=1e-9)
    deviation, widened = (draw.ln_ratios - math.log(draw.ratio) for draw in (once, wide))
    assert deviation.std() > 0.01 and widened == pytest.approx(3.0 * deviation)
