"""The observer with people's contrast sensitivity, against brute force in space, its definition and its limits."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from todframes.base.errors import SettingsError
from todframes.frames.dataset import load_dataset
from todframes.observers.csf import CsfObserver, contrast_sensitivity, oblique_effect
from todframes.observers.eye import sensitivity_ratio
from todframes.observers.pyramid import PyramidObserver
from todframes.observers.retina import RetinaGrid, triangle_on
from todframes.psychometrics.threshold_search import ComputedThreshold
from todframes.scoring import naked_eye
from todframes.scoring.naked_eye import contrast_threshold
from todframes.scoring.plan import explain
from todframes.scoring.trial_scores import Scoring
from todframes.stimulus import Stimulus


def brute_force_products(size_mrad: float, *, px_per_deg: int, side_deg: float) -> np.ndarray:
    """Inner products, in degrees², of the four triangles as seen less their mean, by code that shares nothing.

    A triangle is drawn as 16 by 16 points a pixel, filtered, and seen through the aperture.
    """
    side = int(side_deg * px_per_deg) // 2 * 2 + 1
    step = 1.0 / px_per_deg
    place = (np.arange(side) - side // 2) * step
    size = size_mrad / 17.453293
    height = 1.3160740 * size
    reach = int(height / step) + 1
    near = slice(side // 2 - reach, side // 2 + reach + 1)
    fine = (place[near, None] + (np.arange(16) - 7.5) / 16.0 * step).ravel()
    down, across = fine[:, None] + 2.0 / 3.0 * height, np.abs(fine)
    inside = (down > 0.0) & (down < height) & (across < down / np.sqrt(3.0))
    image = np.zeros((side, side))
    image[near, near] = inside.reshape(2 * reach + 1, 16, 2 * reach + 1, 16).mean(axis=(1, 3))
    images = [np.rot90(image, -k) for k in range(4)]
    fx = np.fft.fftfreq(side, step)
    f, angle = np.hypot(fx, fx[:, None]), np.arctan2(fx[:, None], fx)
    sensitivity = 1.0 / np.cosh((f / 4.1726) ** 0.7786) - 0.8493 / np.cosh(f / 1.3625)
    oblique = np.where(f > 3.48, 1.0 - (1.0 - np.exp(-(f - 3.48) / 13.57)) * np.sin(2.0 * angle) ** 2, 1.0)
    aperture = np.exp(-np.add.outer(place**2, place**2) / (2.0 * 0.35**2))
    with np.errstate(over="ignore"):
        seen = [
            aperture * np.fft.fftshift(np.fft.ifft2(np.fft.fft2(np.fft.ifftshift(i)) * sensitivity * oblique).real)
            for i in images
        ]
    seen = np.array(seen).reshape(4, -1) - np.mean(seen, axis=0).ravel()
    return seen @ seen.T * step**2


def brute_force_threshold(size_mrad: float, *, px_per_deg: int, side_deg: float) -> float:
    """The 75 % contrast of a triangle, with drawn scores."""
    products = brute_force_products(size_mrad, px_per_deg=px_per_deg, side_deg=side_deg)
    values, vectors = np.linalg.eigh(products)
    root = vectors * np.sqrt(np.maximum(values, 0.0)) / (1.406 * 509.37)
    noise = np.random.default_rng(7).normal(size=(400_000, 4)) @ root.T
    noise = np.concatenate([noise, -noise])
    low, high = 1e-3, 1e2
    for _ in range(40):
        contrast = np.sqrt(low * high)
        right = ((contrast * products[0] + noise).argmax(axis=1) == 0).mean()
        low, high = (contrast, high) if right < 0.75 else (low, contrast)
    return float(contrast)


def test_scores_and_their_noise_are_those_of_brute_force() -> None:
    """The retina's step leaves 0.7 % of a threshold, and twice that of its square; pixels of 1/240 degree less."""
    expected, deg = brute_force_products(4.0, px_per_deg=120, side_deg=2.5), 0.1 / 17.453293
    readout = CsfObserver(efficiency=4.0).readout(Stimulus(4.0))
    shown = readout.score_deviations(triangle_on(readout.grid, 4.0))
    largest = expected.max()
    np.testing.assert_allclose(shown * deg**2, expected[0], rtol=0.0, atol=0.015 * largest)
    noise = expected / (1.406 * 509.37) ** 2 / 4.0
    np.testing.assert_allclose(readout.noise_covariance * deg**4, noise, rtol=0.0, atol=0.015 * noise.max())


def test_a_grating_is_seen_as_the_filter_says() -> None:
    """Samples hold its mean over their width, which the filter undoes; the field's border is five sigmas away."""
    observer, deg = CsfObserver(retina_pitch_mrad=0.2, luminance_cd_m2=3.0), 0.2 / 17.453293
    place = (np.arange(601) - 300) * deg
    for fx, fy in ((3.0, 0.0), (8.0, 5.0), (0.0, 20.0)):
        wave = np.cos(2.0 * np.pi * (fx * place + fy * place[:, None]))
        (seen,) = observer.activity(wave * np.sinc(fx * deg) * np.sinc(fy * deg))
        f = np.array([np.hypot(fx, fy)])
        gain = contrast_sensitivity(f) * oblique_effect(np.array([fx]), np.array([fy]))
        gain = gain * sensitivity_ratio(f, luminance_cd_m2=3.0)
        aperture = np.exp(-np.add.outer(place**2, place**2) / (2.0 * 0.35**2))
        assert np.abs(seen - gain * aperture * wave).max() < 1e-3


def test_a_sensitivity_of_ones_own_is_between_and_beyond_its_rows_as_stated() -> None:
    """By hand: a slope of 1 between rows on log axes, flat below, a quarter for each 16 cycles/degree beyond.

    A grating wider than the aperture has √(0.35² π / 2) degrees; light and oblique effect stay.
    """
    table = ((1.0, 40.0), (4.0, 160.0), (16.0, 40.0), (32.0, 10.0))
    observer = CsfObserver(retina_pitch_mrad=0.2, luminance_cd_m2=3.0, sensitivity=table)
    x, y = np.array([0.0, 0.5, 2.0, 8.0, 40.0]), np.zeros(1)
    expected = np.array([40.0, 40.0, 80.0, 80.0, 5.0]) * sensitivity_ratio(x, luminance_cd_m2=3.0)
    seen = observer._seen_transfer(x, y) * 509.37 * np.sqrt(0.35**2 * np.pi / 2.0)
    assert seen == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("size_mrad", [1.4, 4.0])
def test_the_sensitivity_of_modelfest_as_a_table_gives_its_thresholds(size_mrad: float) -> None:
    """200 rows, ln f 0.038 apart, leave 0.038² / 8 times the curvature of ln S over ln f, at most 5: 1e-3."""
    frequency = np.geomspace(0.05, 100.0, 200)
    sensitivity = 509.37 * contrast_sensitivity(frequency) * np.sqrt(0.35**2 * np.pi / 2.0)
    own = CsfObserver(retina_pitch_mrad=0.2, sensitivity=tuple(zip(frequency, sensitivity, strict=True)))
    found, expected = (
        contrast_threshold(observer, size_mrad=size_mrad).threshold
        for observer in (own, CsfObserver(retina_pitch_mrad=0.2))
    )
    assert found == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (
            ((1, 20), (0.5, 30), (4, 20), (8, 10)),
            r"sensitivity: found 0\.5 after 1, expected pairs with asc",
        ),
        (((1, 20), (2, 30), (4, 10)), "sensitivity: found 3 rows, expected at least 4"),
        (((1, 20), (2, -30), (4, 20), (8, 10)), r"sensitivity\[1\]\[1\]: found -30, expected a finite number > 0"),
        (((0.1, 20), (0.2, 30), (0.5, 20), (1.7, 10)), r"found 1\.7 as the last frequency, .* 1 cycle/mrad is 17"),
        (((1, 1.2), (2, 2.3), (4, 2), (8, 1)), r"found at most 2\.3, expected a largest value above 3: 1 / contr"),
        (((1, 20), (2, 30), (4, 20), (8, 30)), "found 30 after 20 in the last row, expected that it falls"),
        ("own.csv", "sensitivity: found 'own.csv', expected a list"),
    ],
)
def test_a_bad_table_of_sensitivity_is_one_clear_line(table: object, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        CsfObserver(sensitivity=table)


def test_the_field_and_the_density_of_noise_by_hand() -> None:
    """6 mrad about the triangle, or about four sigmas of the aperture, 0.35°; between pairs along log axes."""
    sides = {3.0: 2 * 90 + 1, 24.0: 2 * 300 + 1, 100.0: 2 * 305 + 1}
    assert {size: CsfObserver().grid(Stimulus(size)).side for size in sides} == sides
    wide = CsfObserver(efficiency=2.0).with_extra_level()
    assert [wide.grid(Stimulus(3.0)).side, wide.with_extra_level().grid(Stimulus(3.0)).side] == [361, 721]
    coarse = wide.with_retina_step(1.5)
    assert coarse.grid(Stimulus(3.0)) == RetinaGrid(241, 1.5 * 0.1) and coarse.settings.efficiency == 2.0
    x, y = np.array([0.0, 0.05, 6.0]), np.array([[4.0], [0.0]])
    power = CsfObserver(external_noise_deg=0.5, external_noise_exponent=2.0).external_noise_density(x, y)
    assert power == pytest.approx(0.25 / np.array([[16.0, 16.0025, 52.0], [0.0025, 0.0025, 36.0]]))
    pairs = CsfObserver(external_noise_spectrum=((3.0, 8.0), (12.0, 2.0))).external_noise_density(x, y)
    assert pairs == pytest.approx(24.0 / np.array([[4.0, 16.0025**0.5, 52.0**0.5], [3.0, 3.0, 6.0]]))
    assert CsfObserver(external_noise_spectrum=((4.0, 8.0), (5.0, 1.0))).external_noise_density(x, y)[1, 2] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size_mrad", "px_per_deg", "side_deg"),
    [
        (4.0, 240, 2.5),
        (1.4, 240, 2.5),
        *(pytest.param(size, 480, 3.0, marks=pytest.mark.weekly) for size in (0.75, 1.1, 1.4, 2.4, 4.0)),
    ],
)
def test_threshold_of_the_naked_eye_is_that_of_brute_force(
    size_mrad: float, px_per_deg: int, side_deg: float
) -> None:
    """1 % is asked for. The retina's step leaves 0.7 %, and 8e5 draws 0.12 % (0.05 % of P, whose slope is 0.4).

    The weekly ones are the figures of the documentation.
    """
    expected = brute_force_threshold(size_mrad, px_per_deg=px_per_deg, side_deg=side_deg)
    found = contrast_threshold(CsfObserver(), size_mrad=size_mrad)
    assert found.threshold == pytest.approx(expected, rel=0.01)
    # The stated error, and three standard errors of the draws with pixels of 1/240 degree.
    assert abs(found.threshold - expected) < found.numerical_error + 0.005 * expected
    assert 0.0 < found.numerical_error < 0.01 * expected


def stepped(largest: float, step: float = 1.0) -> Any:
    """An observer of which only the step of its retina counts: a sample a mrad at a step of 1."""

    def grid(stimulus: Stimulus) -> Any:
        if stimulus.size_mrad / step > largest:
            raise SettingsError("size_mrad: found too much")
        return SimpleNamespace(side=stimulus.size_mrad / step)

    return SimpleNamespace(grid=grid, step=step, with_retina_step=lambda factor: stepped(largest, factor))


@pytest.mark.parametrize(
    ("size", "largest", "slope", "expected"),
    [
        (512.0, 1e9, 0.1, 0.001 + 0.02 * (1.0 - 0.25**2)),  # the error of a quarter of the step is left out
        *((size, most, 0.1, 0.001 + 0.02) for size, most in ((513, 1e9), (1025, 1e9), (1025, 1024), (5e3, 1e9))),
        (9.0, 1.0, 0.1, None),  # no other retina is possible
        (9.0, 1e9, -0.1, math.inf),  # a falling curve
    ],
)
def test_the_error_by_the_step_is_that_on_another_retina(
    size: float, largest: float, slope: float, expected: float | None
) -> None:
    """P = 0.75 + slope (level / 2 - 1) + 0.001 s² at a step of s: for a slope of 0.1 it is 0.75 at 2 - 0.02 s²."""
    found = naked_eye._with_step_error(
        ComputedThreshold("ok", 1.98, 0.001),
        stepped(largest),
        size,
        lambda judge, level: 0.75 + slope * (level / 2.0 - 1.0) + 0.001 * judge.step**2,
        0.75,
    )
    known = ComputedThreshold("ok", 1.98, None if expected is None else pytest.approx(expected, rel=1e-6))
    assert found == (ComputedThreshold("too_uncertain") if expected == math.inf else known)


@pytest.mark.parametrize(
    ("thresholds", "expected"),
    [
        ([1.0, 1.0002, 9.0], ("ok", 1.0002, 2e-4)),
        ([1.0, 1.0003, 1.0004, 9.0], ("ok", 1.0004, 1e-4)),
        ([1.0, 1.1, 1.3], ("ok", 1.3, 0.2)),
        ([None, 1.0, 1.0, 9.0], ("ok", 1.0, 0.0)),
    ],
)
def test_displacements_are_added_until_the_threshold_stays(thresholds: Any, expected: Any) -> None:
    def threshold(nodes: int) -> ComputedThreshold:
        return ComputedThreshold("never_reached" if thresholds[nodes] is None else "ok", thresholds[nodes])

    never = ComputedThreshold("never_reached")
    assert naked_eye._refined(lambda nodes: {0: never, 1: never}[nodes], range(3)) == never
    found = naked_eye._refined(threshold, range(len(thresholds)))
    assert found == ComputedThreshold(expected[0], expected[1], pytest.approx(expected[2], abs=1e-9))


def test_no_contrast_is_chance_and_a_huge_one_is_always_right() -> None:
    found = [
        naked_eye.proportion_correct(CsfObserver(), size_mrad=2.0, contrast=contrast, nodes=4)
        for contrast in (1e-9, 1e9)
    ]
    assert found == pytest.approx([0.25, 1.0], abs=1e-6)


def test_filter_has_its_limits() -> None:
    """Closed form: 1 − 0.8493 at 0; sech has its half at ln(2 + √3)."""
    half = 4.1726 * np.log(2.0 + np.sqrt(3.0)) ** (1.0 / 0.7786)
    low = 0.8493 / np.cosh(half / 1.3625)
    assert contrast_sensitivity(np.array([0.0, half])) == pytest.approx([0.1507, 0.5 - low], rel=1e-12)
    assert contrast_sensitivity(np.array([1e5]))[0] == 0.0
    f = np.array([2.0, 3.48, 17.05, 1e6])
    assert oblique_effect(f, np.zeros(4)).tolist() == [1.0] * 4
    # Along 45°, one constant beyond the beginning, 1/e is left; in the end nothing is.
    expected = [1.0, 1.0, np.exp(-1.0), 0.0]
    assert oblique_effect(f / np.sqrt(2.0), f / np.sqrt(2.0)) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("size_mrad", [0.5, 3.0, 20.0])
def test_the_field_holds_the_noise_and_its_omission_is_what_is_missing(size_mrad: float) -> None:
    """Against the observer with a field of twice the width, on the same retina."""
    observer, stimulus = CsfObserver(retina_pitch_mrad=0.2), Stimulus(size_mrad)
    wide, omitted = observer.with_extra_level(), observer.omitted_bands(stimulus)
    small, large = observer.readout(stimulus), wide.readout(stimulus)
    assert large.grid.side == omitted.grid.side >= 2 * small.grid.side - 3
    largest = np.abs(large.deviations).max()
    np.testing.assert_allclose(omitted.kept + omitted.deviations, large.deviations, rtol=0.0, atol=1e-12 * largest)
    inner = slice((large.grid.side - small.grid.side) // 2, -((large.grid.side - small.grid.side) // 2))
    np.testing.assert_array_equal(omitted.kept[:, inner, inner], small.deviations)
    # The docstring of the field's width: 1e-3 of the root sum of squares.
    assert np.linalg.norm(omitted.deviations) < 1e-3 * large.norm


def test_a_triangle_wider_than_the_field_is_seen_as_its_middle() -> None:
    """All orientations look the same there."""
    readout = CsfObserver().readout(Stimulus(300.0))
    answers = readout.answer_probabilities(readout.score_deviations(triangle_on(readout.grid, 300.0)))
    assert answers == pytest.approx(0.25)


def test_a_field_of_too_many_samples_says_so() -> None:
    with pytest.raises(SettingsError, match=r"retina_pitch_mrad: found 0\.01, 5001 samples along a side of"):
        CsfObserver(retina_pitch_mrad=0.01).grid(Stimulus(19.0))


def test_an_ideal_template_that_is_not_found_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("todframes.observers.csf.MOST_STEPS", 50)
    with pytest.raises(SettingsError, match="template: the ideal one is not found in 50 steps; expected less"):
        CsfObserver(template="ideal", external_noise_deg=1e6).readout(Stimulus(0.3))


def test_an_ideal_template_is_the_best_for_its_noise() -> None:
    """Signal over noise of a frame with that noise, by brute force: K as a matrix, of small images.

    K is built column by column from the filter of single samples, and solved by LAPACK.
    """
    changes = {"retina_pitch_mrad": 0.2, "external_noise_deg": 0.01, "external_noise_exponent": 1.5}
    ideal = CsfObserver(template="ideal", **changes)
    side = 15
    samples = np.eye(side**2).reshape(-1, side, side)
    deg = 0.2 / 17.453293
    x = np.fft.fftfreq(2 * side, deg)
    f = np.hypot(x, x[:, None])
    density = 0.01**2 * np.maximum(f, x[1]) ** -1.5
    seen = contrast_sensitivity(f) * oblique_effect(x, x[:, None])
    power = density / deg**2 * seen**2
    place = (np.arange(side) - side // 2) * deg
    aperture = np.exp(-np.add.outer(place**2, place**2) / (2.0 * 0.35**2))
    spectra = np.fft.fft2(aperture * samples, (2 * side, 2 * side))
    columns = aperture * np.fft.ifft2(power * spectra).real[:, :side, :side]
    covariance = ideal.settings.noise_sd**2 * np.eye(side**2) + columns.reshape(side**2, side**2)
    expected = np.random.default_rng(0).normal(size=(side, side))
    (weights,) = ideal.template_of((expected,))
    best = np.linalg.solve(covariance, expected.ravel()) * ideal.settings.noise_sd**2
    # The solver's residual, 1e-10, times the condition of K, at most 1e3 here.
    np.testing.assert_allclose(weights.ravel(), best, rtol=0.0, atol=1e-7 * np.abs(best).max())


def test_an_ideal_template_without_external_noise_is_the_matched_one() -> None:
    matched, ideal = (CsfObserver(template=name).readout(Stimulus(2.0)) for name in ("matched", "ideal"))
    largest = np.abs(matched.deviations).max()
    np.testing.assert_allclose(ideal.deviations, matched.deviations, rtol=0.0, atol=1e-12 * largest)


def test_the_plan_names_what_this_observer_omits(make_dataset) -> None:
    dataset = load_dataset(make_dataset(contrasts=(0.1, 0.4)).path)
    for observer, part in ((CsfObserver(), "outer field"), (PyramidObserver(), "pyramid levels")):
        steps = {
            step["stage"]: step for step in explain(Scoring(dataset, observer, "expected", 1), dataset.trials)
        }
        assert part in steps and len({"outer field", "pyramid levels"} & set(steps)) == 1
        assert not steps[part]["kept"] and 0.0 < steps[part]["bound"] < 2e-2
