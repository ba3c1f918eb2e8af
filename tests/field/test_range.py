"""How far a person with a sensor sees: closed forms, published values, air, targets, and lines for bad input."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conftest import error_line
from matplotlib.figure import Figure
from scipy.special import ndtri

import todframes as tod
from sensor_sim.sweeps.goals import Aim
from todframes.base.reading import shipped_names
from todframes.field.acquisition import TaskRange, acquire, cycles_ratio, transfer_probability, with_search
from todframes.field.acquisition_range import range_words
from todframes.field.atmosphere import FOLDER as AIRS
from todframes.field.atmosphere import find_atmosphere
from todframes.field.target import FOLDER as TARGETS
from todframes.field.target import find_target
from todframes.field.threshold_curve import Psychometric, ThresholdCurve, _ln_sd, _psychometric, _slope_error
from todframes.psychometrics.curves import FitPoint

A_K, B_MRAD, SIGMA_PER_KM = 0.02, 1.0, 0.2
NATO = tod.Target(size_m=2.3, delta_t_k=2.0)
BEER = tod.Atmosphere(extinction_per_km=SIGMA_PER_KM)
FREQUENCIES = np.array([0.2, 1.0, 2.0, 4.0, 8.0, 12.0])


def exponential(frequency=FREQUENCIES, **changes) -> ThresholdCurve:
    """MRTD = a exp(b f), whose logarithm is linear in frequency, as between the points of every curve."""
    fields = {"pattern": "bars", "quantity": "delta_t_k", "name": "mrtd", "per_mrad": np.asarray(frequency)}
    fields |= {"threshold": A_K * np.exp(B_MRAD * np.asarray(frequency))}
    return ThresholdCurve(**fields | changes)


def acquired(curve=None, target=NATO, air=BEER, seed=1):
    return acquire(curve or exponential(), target, air, rng=np.random.default_rng(seed))


def at(found, probability=0.5) -> dict[str, float | None]:
    return {one.task: one.range_km for one in found.ranges if one.probability == probability}


def test_range_of_an_exponential_mrtd_in_beer_s_air() -> None:
    """R = ln(ΔT/a) / (σ + b n / size): 7.2547, 3.0612 and 1.6396 km for 1, 3 and 6 line pairs."""
    found = at(acquired())
    assert list(found) == ["detection", "recognition", "identification"]
    for value, n, printed in zip(found.values(), (1, 3, 6), (7.2547, 3.0612, 1.6396), strict=True):
        # Both sides are linear in range between the points: only rounding is left.
        assert value == pytest.approx(math.log(2.0 / A_K) / (SIGMA_PER_KM + B_MRAD * n / 2.3), rel=1e-12)
        assert value == pytest.approx(printed, abs=1e-4)


def test_line_pairs_for_a_probability() -> None:
    """N / N50 of the target transfer probability function, as published."""
    for probability, printed in ((0.5, 1.0), (0.75, 1.352), (0.8, 1.452), (0.9, 1.750), (0.95, 2.041)):
        assert cycles_ratio(probability) == pytest.approx(printed, abs=5e-4)
        # Bisection to the last digit; d ln P / d ln a is below 4.
        assert transfer_probability(cycles_ratio(probability)) == pytest.approx(probability, rel=1e-14)
    np.testing.assert_allclose(transfer_probability([0.0, 1e9]), [0.0, 1.0], atol=1e-300)


def words(one: TaskRange) -> str:
    return range_words(one, size_m=NATO.size_m, is_tod=False)


def test_search_takes_time() -> None:
    """P(t) = P (1 − exp(−P t / 3.4)); at 3.4 s a sure detection is found with 1 − 1/e."""
    assert float(with_search(1.0, 3.4)) == pytest.approx(1.0 - math.exp(-1.0), rel=1e-15)
    assert at(acquired(target=replace(NATO, search_time_s=1e5))) == pytest.approx(at(acquired()), rel=1e-9)
    hasty = acquired(target=replace(NATO, search_time_s=1.0))  # at most 1 − exp(−1/3.4) = 0.25
    assert {one.status for one in hasty.ranges} == {"never_reached"}
    # 3.4 ln 2 = 2.36 s
    assert words(hasty.ranges[0]).endswith("it takes a search of more than 2.4 s, however near; allow more time")
    half = acquired(target=replace(NATO, search_time_s=5.0)).ranges[0]
    line_pairs = (math.log(2.0 / A_K) / half.range_km - SIGMA_PER_KM) * 2.3  # the closed form, backwards
    assert with_search(transfer_probability(line_pairs), 5.0) == pytest.approx(0.5, rel=1e-9)


def test_r46_worked_example() -> None:
    """60° and 480 lines: 3.75 arcmin, 0.8 m / tan(0.5°) = 91.7 m."""
    system = replace(find_target("r46"), view_deg=60.0, lines=480.0)
    assert system.r46_distance_m == pytest.approx(91.7, abs=0.05)
    found = tod.acquisition_range(of_fits(), target=system, atmosphere=BEER)
    assert "By its pixels alone (UN R46), the system shows the target up to 91.7 m." in found.sentences()


def test_tod_needs_a_triangle_of_size_over_k() -> None:
    """TOD = a exp(b / S): R = ln(ΔT/a) / (σ + b k / size), at the curve's own criterion."""
    curve = exponential(pattern="triangle", p_correct=0.75)
    found = acquired(curve, replace(NATO, k={"seen": 3.0}))
    assert at(found, 0.75) == {"seen": pytest.approx(3.0612, abs=1e-4)}
    k, value = found.against_k()[0].k, found.against_k()[0].range_km
    assert value == pytest.approx(math.log(100.0) / (SIGMA_PER_KM + B_MRAD * k / 2.3), rel=1e-9)
    bars = acquired(curve, replace(NATO, cycles_per_size=1.0))  # f = 1/S: the same equation with line pairs
    assert at(bars) == pytest.approx(at(acquired()), rel=1e-12)


def test_proportion_correct_of_a_tod() -> None:
    """ΔT at 50 % and 90 % correct is that of eq. 3, with one β for all sizes; ranges are closed forms."""
    beta = 2.0
    shape = Psychometric(np.full(6, beta), *np.zeros((3, 6)), 0.25, 0.75)
    curve = exponential(pattern="triangle", p_correct=0.75, psychometric=shape)
    found = acquired(curve, replace(NATO, k={"seen": 3.0}))
    for p in (0.5, 0.75, 0.9):
        ratio = (math.log2(0.75 / (1.0 - p)) / math.log2(0.75 / 0.25)) ** (1.0 / beta)
        expected = math.log(2.0 / (A_K * ratio)) / (SIGMA_PER_KM + B_MRAD * 3.0 / 2.3)
        assert at(found, p)["seen"] == pytest.approx(expected, rel=1e-9)
        (curve_of,) = found.curves
        assert np.interp(expected, curve_of.range_km, curve_of.probability) == pytest.approx(p, abs=2e-3)


@pytest.mark.parametrize(("guess", "lapse"), [(0.25, 0.01), (0.0, 0.0)])
def test_error_of_a_slope_is_that_of_the_likelihood(guess, lapse) -> None:
    """Covariance of ln threshold and ln β, from second differences of the likelihood of the expected counts."""
    levels, n, beta = np.geomspace(0.5, 2.0, 6), 40, 2.2

    def halves(p: float) -> float:
        return math.log2((1.0 - guess - lapse) / (1.0 - lapse - p))

    def proportions(ln_threshold: float, ln_beta: float):
        slope = math.exp(ln_beta)
        alpha = math.exp(ln_threshold) / halves(0.75) ** (1.0 / slope)
        return 1.0 - lapse - (1.0 - guess - lapse) * 2.0 ** -((levels / alpha) ** slope)

    right = n * proportions(0.0, math.log(beta))

    def likelihood(x: float, y: float) -> float:
        p = proportions(x, math.log(beta) + y)
        return float((right * np.log(p) + (n - right) * np.log(1.0 - p)).sum())

    h = 1e-3
    second = [(likelihood(x, y) + likelihood(-x, -y) - 2 * likelihood(0, 0)) / h**2 for x, y in ((h, 0), (0, h))]
    mixed = (likelihood(h, h) + likelihood(-h, -h) - likelihood(h, -h) - likelihood(-h, h)) / (4 * h**2)
    covariance = np.linalg.inv(-np.array([[second[0], mixed], [mixed, second[1]]]))
    sd = np.sqrt(np.diag(covariance))
    points = tuple(FitPoint(*one) for one in zip(levels, [n] * 6, right / n, strict=True))
    known = {"group": {}, "level": "contrast", "status": "ok", "threshold": 1.0, "p_correct": 0.75}
    known |= {"beta": beta, "guess_rate": guess, "lapse_rate": lapse, "n_trials": 6 * n, "points": points}
    fit = tod.Fit(**known, alpha=halves(0.75) ** (-1.0 / beta))
    # Second differences err by h² of the fourth derivative, 1e-5, and by rounding / h², 1e-8 of the largest term.
    slope_sd, correlation = _slope_error(fit)
    assert slope_sd == pytest.approx(sd[1], rel=1e-4)
    assert correlation == pytest.approx(covariance[0, 1] / sd.prod(), abs=1e-4)
    ends = np.exp(2.0 * 1.959964 * sd[0] * np.array([-1.0, 1.0]))
    twice = msgspec.structs.replace(fit, threshold_ci95=tuple(ends))
    assert _slope_error(twice)[0] == pytest.approx(2.0 * sd[1], rel=1e-4)
    # A slope that answers at one level leave open has the error of the others, and no correlation.
    alone = msgspec.structs.replace(fit, points=points[:1], lapse_rate=None)
    shape = _psychometric([fit, alone, msgspec.structs.replace(fit, n_trials=0)])
    found = [shape.beta, shape.lapse_rate, shape.ln_beta_sd, shape.correlation]
    expected = [[beta] * 3, [lapse, 0.0, lapse], [slope_sd, slope_sd, 0.0], [correlation, 0.0, 0.0]]
    np.testing.assert_allclose(found, expected)
    assert (shape.guess_rate, shape.p_correct, _psychometric([alone])) == (guess, 0.75, None)


def test_computed_points_and_open_ends_of_a_measured_curve() -> None:
    """β of points on 1 − 3/4 · 2^−(x^β), of which those near the guess rate and near 1 count for nothing."""
    levels = np.array([0.3, 0.5, 0.8, 1.2, 3.0])
    p = 1.0 - 0.75 * 2.0 ** -(levels**1.7) + np.array([-0.02, 0.0, 0.0, 0.0, -0.01])
    known = {"group": {}, "level": "contrast", "status": "ok", "p_correct": 0.8, "threshold": 2.0}
    computed = tod.Fit(**known, points=tuple(FitPoint(*one) for one in zip(levels, [0] * 5, p, strict=True)))
    assert p[0] < 0.3 and p[-1] > 0.97
    shape = _psychometric([computed])
    assert shape.beta == pytest.approx([1.7]) and shape.guess_rate == 0.25
    assert shape.lapse_rate == shape.ln_beta_sd == shape.correlation == [0.0]
    for points in (computed.points[2:3] * 2, (FitPoint(0.5, 0, 0.8), FitPoint(0.8, 0, 0.5))):
        assert _psychometric([computed, msgspec.structs.replace(computed, points=points)]) is None
    each = (
        {"threshold_ci95": (1.0, None)},
        {"threshold_numerical_error": 0.2},
        {},
        {"threshold_ci95": (1.9, 2.2)},
    )
    fits = [tod.Fit(**known, **one) for one in each]
    below, above = [math.log(2.0), math.log(1.1), math.log(2.0), math.log(2.0 / 1.9)], [*np.log([2, 1.1, 2, 1.1])]
    np.testing.assert_allclose(_ln_sd(fits), np.array([below, above]) / ndtri(0.975), rtol=1e-9)
    assert _ln_sd(fits[2:3]) is None


def test_what_limits_is_the_change_of_range() -> None:
    """Gains against ranges that are computed again with one hundredth more of each."""
    found = acquired()
    step = 0.01
    for one in (one for one in found.ranges if one.probability == 0.5):
        changed = (
            acquired(target=replace(NATO, delta_t_k=2.0 * (1.0 + step))),
            acquired(target=replace(NATO, size_m=2.3 * (1.0 + step))),
            acquired(air=tod.Atmosphere(extinction_per_km=SIGMA_PER_KM * (1.0 - step))),
        )
        gains = (one.gain_contrast_percent, one.gain_resolution_percent, one.gain_air_percent)
        for gain, other in zip(gains, changed, strict=True):
            # Second order in the step: 1 % of the gain, times at most 2.
            assert at(other)[one.task] / one.range_km - 1.0 == pytest.approx(step * gain / 10.0, rel=0.02)
        assert one.limited_by == "resolution"
    assert acquired(air=tod.Atmosphere(extinction_per_km=5.0)).ranges[0].limited_by == "air"
    faint, clear = exponential(threshold=A_K * np.linspace(1.0, 1.5, 6)), tod.Atmosphere(extinction_per_km=1e-3)
    assert acquired(faint, replace(NATO, delta_t_k=0.025), clear).ranges[0].limited_by == "contrast"


def test_band_is_that_of_the_curve_s_errors() -> None:
    """One common error of ln MRTD would move R by SD / slope; independent errors of two points less.

    The crossing of 1 line pair lies at f = 3.154, a share t = 0.577 between 2 and 4 cycles/mrad: its error has the
    SD √((1−t)² + t²) · 0.1 in ln, divided by σ + b/2.3 per km.
    """
    found = acquired(exponential(ln_sd=np.full((2, 6), 0.1))).ranges[0]
    frequency = found.range_km / 2.3
    share = (frequency - 2.0) / 2.0
    sd_km = 0.1 * math.hypot(1.0 - share, share) / (SIGMA_PER_KM + B_MRAD / 2.3)
    low, high = found.range_ci95_km
    # An end of 1,000 draws errs by 0.085 SD: four of them; curvature is 0.1 of 1.96 SD at most.
    assert (found.range_km - low) / sd_km == pytest.approx(1.96, abs=0.4)
    assert (high - found.range_km) / sd_km == pytest.approx(1.96, abs=0.4)
    assert acquired().ranges[0].range_ci95_km is None


def test_no_range_is_extrapolated() -> None:
    short = acquired(exponential(FREQUENCIES[:2]))  # up to 1 cycle/mrad, where the MRTD is 0.054 K
    one = short.ranges[0]
    assert (one.status, one.range_km) == ("beyond_curve", None)
    assert one.at_least_km == pytest.approx(2.3, rel=1e-12)  # 1 cycle/mrad · 2.3 m / 1 line pair
    ended = acquired(exponential(FREQUENCIES[:2], unreached_per_mrad=1.5)).ranges[0]
    assert ended.at_most_km == pytest.approx(3.45, rel=1e-12)
    assert words(one).endswith(
        "if that is the highest frequency that the sensor resolves, its sampling limits the range"
    )
    assert range_words(one, size_m=2.3, is_tod=True).endswith(
        "smaller triangles show whether finer detail is judged"
    )
    sampled = acquired(exponential(FREQUENCIES[:2], unreached_per_mrad=1.05)).ranges[0]
    assert (sampled.status, sampled.range_km) == ("limited_by_sampling", pytest.approx(2.3, rel=1e-12))
    assert words(sampled) == "2.30 km, limited by sampling"
    assert words(ended).endswith("measure one between, such as 1.2 cycles/mrad at the camera")  # √(1 · 1.5)
    assert "such as 0.82 mrad at the camera" in range_words(ended, size_m=2.3, is_tod=True)
    coarse = acquired(exponential([5.0, 6.0])).ranges[0]  # at least 2.97 K
    assert (coarse.status, coarse.range_km) == ("never_reached", None)
    near = acquired(exponential([4.0, 12.0]), air=tod.Atmosphere(extinction_per_km=1.0)).ranges[0]
    assert (near.status, near.at_most_km) == ("nearer_than_curve", pytest.approx(9.2, rel=1e-12))
    air = tod.Atmosphere(range_km=(1.0, 2.0), transmission=(0.8, 0.64))
    beyond = acquired(air=air).ranges[0]
    assert (beyond.status, beyond.at_least_km) == ("beyond_air_table", pytest.approx(2.0, rel=1e-12))
    assert set(short.curves[0].bound) == {1.0}


@pytest.mark.parametrize(
    ("threshold_k", "status", "least_km", "most_km"),
    [
        (1.27, "beyond_air_table", 2.0, math.nan),
        (1.29, "nearer_than_curve", math.nan, 9.2),
        (2.1, "never_reached", math.nan, math.nan),
    ],
)
def test_air_that_ends_before_the_curve_begins(threshold_k, status, least_km, most_km) -> None:
    """The curve begins at 4 cycles/mrad · 2.3 m = 9.2 km; 2 K · 0.64 = 1.28 K arrive where the air ends."""
    air = tod.Atmosphere(range_km=(1.0, 2.0), transmission=(0.8, 0.64))
    one = acquired(exponential([4.0, 12.0], threshold=np.array([threshold_k, 5.0])), air=air).ranges[0]
    assert one.status == status
    bounds = np.array([one.at_least_km, one.at_most_km], np.float64)
    assert bounds == pytest.approx(np.array([least_km, most_km]), rel=1e-12, nan_ok=True)


def test_a_probability_of_ones_own(table) -> None:
    """80 % take 1.452 times the line pairs (the published value); thresholds alone have no other proportion."""
    found = tod.acquisition_range(table, target=NATO, atmosphere=BEER, p=0.8)
    expected = math.log(2.0 / A_K) / (SIGMA_PER_KM + B_MRAD * 1.452 * 3.0 / 2.3)
    assert {one.probability for one in found.numbers.ranges} == {0.5, 0.75, 0.8, 0.9}
    assert at(found.numbers, 0.8)["recognition"] == pytest.approx(expected, rel=5e-4)
    assert f"At 80 %, recognition: {expected:.2f} km" in " ".join(found.sentences())
    curve = exponential(pattern="triangle", p_correct=0.75)
    refused = {
        0.9: "p: found 0.9, expected that of the thresholds, 0.75",
        1.0: "p: found 1, expected a probability",
    }
    for p, message in refused.items():
        with pytest.raises(tod.SettingsError, match=message):
            acquire(curve, replace(NATO, k={"seen": 3.0}), BEER, p=p, rng=np.random.default_rng(1))


def test_a_curve_that_falls_counts_as_level() -> None:
    dip = exponential(threshold=A_K * np.exp([0.2, 1.0, 2.0, 1.5, 8.0, 12.0]))
    level = exponential(threshold=A_K * np.exp([0.2, 1.0, 2.0, 2.0, 8.0, 12.0]))
    assert not dip.is_rising
    assert at(acquired(dip)) == at(acquired(level))


def test_air_by_its_descriptions() -> None:
    ranges = np.array([0.0, 0.5, 3.0])
    day = tod.Atmosphere(visibility_km=23.0)
    np.testing.assert_allclose(day.optical_depth(ranges), 3.912 / 23.0 * ranges, rtol=1e-15)
    # A table of Beer's law is Beer's law between and below its rows: ln depth is linear in ln range, of slope 1.
    table = tod.Atmosphere(range_km=(1.0, 2.0, 8.0), transmission=tuple(np.exp(-0.2 * np.array([1.0, 2.0, 8.0]))))
    np.testing.assert_allclose(table.optical_depth(ranges), 0.2 * ranges, rtol=1e-14)


@pytest.mark.parametrize("ratio", [0.2, 1.0, 4.0])
def test_path_radiance_of_daylight(ratio: float) -> None:
    """Target and background as two lights through the same air and the same path radiance."""
    air = tod.Atmosphere(visibility_km=10.0, sky_to_ground_ratio=ratio)
    ranges = np.array([0.1, 2.0, 20.0])
    tau = np.exp(-0.3912 * ranges)
    background, target, sky = 1.0, 1.4, ratio
    path = sky * (1.0 - tau)
    seen = (target * tau - background * tau) / (background * tau + path)
    # Cancellation in 1 − τ at 0.1 km loses two digits.
    np.testing.assert_allclose(0.4 * np.exp(air.ln_contrast_left(ranges)), seen, rtol=1e-13)
    assert np.isfinite(air.ln_contrast_left(1e5))


def test_airs_of_the_package_are_tables() -> None:
    assert shipped_names(AIRS) == tuple(
        f"{band}_{km}km" for band in ("lwir", "mwir", "swir", "visible") for km in (23, 5)
    )
    for name in shipped_names(AIRS):
        air = find_atmosphere(name)
        assert air.range_km == (1.0, 5.0, 10.0, 20.0) and air.band_um is not None
        assert (np.diff(air.optical_depth(np.linspace(0.0, 20.0, 300))) > 0.0).all()
        # Lines that are full absorb less of the rest, and haze of 5 km visibility more than that of 23 km.
        assert (np.diff(air.optical_depth(air.range_km) / air.range_km) < 0.0).all()
        assert "not your weather" in air.source
        if name.endswith("_23km"):
            hazy = find_atmosphere(name.replace("_23km", "_5km"))
            assert (hazy.optical_depth(air.range_km) > air.optical_depth(air.range_km)).all()
    # The effective extinction of MODTRAN's tables in pyBSM 0.16.1, sensor at 75 m.
    assert find_atmosphere("mwir_23km").optical_depth(5.0) == pytest.approx(0.271 * 5.0, rel=1e-12)


def test_targets_of_the_package() -> None:
    assert {"nato", "nato_daylight", "person", "r46", "face", "number_plate"} <= {*shipped_names(TARGETS)}
    for name in shipped_names(TARGETS):
        assert re.search(rf"\b{name}\b", tod.acquisition_range.__doc__)
    for name in shipped_names(TARGETS):
        assert find_target(name).source
    assert find_target("nato").n50_cycles == {"detection": 1.0, "recognition": 3.0, "identification": 6.0}
    johnson = {"detection": 1.0, "recognition": 4.0, "identification": 6.4}
    assert replace(NATO, cycles="johnson").n50_cycles == johnson
    assert tod.Target(size_m=1.0, reflectance=0.1, background_reflectance=0.4).signal == pytest.approx(0.75)
    assert tod.Target(size_m=1.0, delta_t_k=-3.0, delta_t_sd_k=4.0).signal == 5.0


def test_range_of_a_design() -> None:
    """TOD = a exp(b / S) at sizes in any order: the closed form with k, and a bound where the sizes end."""
    aim = Aim(replace(NATO, k={"seen": 3.0, "read": 8.0}), BEER)
    sizes = 1.0 / FREQUENCIES[[3, 0, 5, 1, 4, 2]]
    found = aim.range_of(sizes, A_K * np.exp(B_MRAD / sizes), ["ok"] * 6, 0.75)
    assert (found.status, found.range_km) == ("ok", pytest.approx(3.0612, abs=1e-4))
    threshold = np.where(sizes > 0.9, A_K * np.exp(B_MRAD / sizes), np.nan)  # 1/S = 0.2 and 1 alone
    statuses = np.where(np.isnan(threshold), "never_reached", "ok").tolist()
    short = aim.range_of(sizes, threshold, statuses, 0.75)
    assert short.status == "beyond_curve" and short.range_km is None
    assert short.at_least_km == pytest.approx(2.3 / 3.0, rel=1e-12)
    assert aim.range_of(sizes, np.full(6, np.nan), ["never_reached"] * 6, 0.75) is None
    with pytest.raises(tod.SettingsError, match="k: is missing, and the sweep is a TOD"):
        Aim(NATO, BEER).check(0.75)
    with pytest.raises(tod.SettingsError, match="target: found a contrast, expected a temperature difference"):
        Aim(DAYLIGHT, BEER).check(0.75)


# Figures of dstl's RET (Apache-2.0), its own function run apart at commit 21902f8: `ret/sensing/sensor.py`,
# `_calculate_confidence_probability`.


@pytest.mark.parametrize(
    ("line_pairs", "time_s", "n50", "probability"),
    [
        (3.0, 10.0, 3.0, 0.3851048626634916),
        (2.0, 20.0, 4.0, 0.050569356466332545),
        (9.6, 30.0, 6.4, 0.8200230063460117),
    ],
)
def test_probabilities_are_those_of_ret(line_pairs, time_s, n50, probability) -> None:
    found = with_search(transfer_probability(line_pairs / n50), time_s)
    assert float(found) == pytest.approx(probability, rel=1e-12)


@pytest.fixture
def table(tmp_path: Path) -> Path:
    rows = [
        ",".join(repr(float(one)) for one in (f, *(A_K * math.exp(f + step) for step in (0.0, -0.2, 0.2))))
        for f in FREQUENCIES
    ]
    path = tmp_path / "mrtd.csv"
    path.write_text("\n".join(["frequency_cyc_per_mrad,mrtd_k,ci95_low,ci95_high", *rows]))
    return path


@pytest.fixture
def air(tmp_path: Path) -> Path:
    path = tmp_path / "air.toml"
    path.write_text("schema = 1\n[atmosphere]\nextinction_per_km = 0.2\n")
    return path


def test_tables_and_words_are_those_of_the_closed_form(table) -> None:
    """The logarithms of ΔT / a are shared out: b f for resolution, σ R for air; together ln 100 = 4.605."""
    table.write_text(
        "frequency_cyc_per_mrad,mrtd_k\n" + "".join(f"{f},{A_K * math.exp(f)}\n" for f in FREQUENCIES)
    )
    found = tod.acquisition_range(table, target=replace(NATO, cycles={"seen": 3.0}), atmosphere=BEER)
    whole, rows = math.log(100.0), []
    for p in (0.5, 0.75, 0.9):
        ratio = cycles_ratio(p)
        km = whole / (SIGMA_PER_KM + ratio * 3.0 / 2.3)
        gains = " | ".join(f"{10 * part / whole:#.2g}" for part in (1.0, ratio * 3 * km / 2.3, SIGMA_PER_KM * km))
        rows.append(f"| seen | 3.00 | {p:g} | {km:.3f} | – | resolution | {gains} | ok |")
    ranges, probability, settings = found.tables()
    assert ranges.title == "Range: target, 2.3 m, ΔT 2 K; air"
    head, _, *lines = ranges.markdown().splitlines()
    assert head.startswith(
        "| task | N50 | P | range (km) | 95 % interval | limited by | 10 % contrast | 10 % resol"
    )
    assert head.endswith(" | 10 % clear air | status |") and lines == rows
    # 1.15 times the range at 50 % in 121 steps; at the 60th 1.7456 km, 4.256 cycles/mrad and 1.869 N50.
    shown = probability.markdown().splitlines()
    assert (len(shown), probability.title) == (123, "Probability against range")
    assert shown[0] == "| task | range (km) | P | 95 % interval |"
    assert shown[61] == "| seen | 1.75 | 0.925 | – |"
    values = dict(row.values() for row in settings.records)
    of_target = {"target.size_m": 2.3, "target.delta_t_k": 2.0, "target.delta_t_sd_k": 0.0}
    assert values == of_target | {"target.cycles": {"seen": 3.0}, "atmosphere.extinction_per_km": 0.2}
    assert found.sentences() == [
        "At 50 %, seen: 3.06 km.",
        "The resolution limits seen: 10 % more contrast gives 2.2 % more range, so much more resolution 8.7 %, "
        "and so much clearer air 1.3 %.",
        "N50: 3 line pairs on the target (your own).",
        "The curve has no errors (ci95_low, ci95_high), so the ranges have no interval.",
    ]


def test_figures_show_the_contrast_that_arrives_the_thresholds_and_the_ranges(table) -> None:
    found = tod.acquisition_range(table, target=NATO, atmosphere=BEER)
    by_size = tod.acquisition_range(of_fits(), target=DAYLIGHT, atmosphere=BEER)
    figures = found.figures()
    crossing, probability = axes = [Figure().subplots() for _ in figures]
    for one, figure in zip(axes, figures, strict=True):
        figure.draw(one)
    arriving, *needed = crossing.lines[:4]
    for mark, reached in zip(crossing.lines[4:], at(found.numbers).values(), strict=True):
        assert mark.get_xydata()[0] == pytest.approx((reached, 2.0 * math.exp(-SIGMA_PER_KM * reached)))
    km = arriving.get_xdata()
    np.testing.assert_allclose(arriving.get_ydata(), 2.0 * np.exp(-SIGMA_PER_KM * km))
    for line, band, n in zip(needed, crossing.collections, (1, 3, 6), strict=True):
        np.testing.assert_allclose(line.get_xdata(), FREQUENCIES * 2.3 / n)
        np.testing.assert_allclose(line.get_ydata(), A_K * np.exp(FREQUENCIES), rtol=1e-9)
        assert band.get_paths()[0].vertices[:, 1].min() < A_K * math.exp(FREQUENCIES[0])
    assert crossing.get_xlim() == (0.0, 1.03 * km[-1]) and crossing.get_ylabel().startswith("ΔT (K)")
    for number, one in enumerate(found.numbers.probability):
        dotted, solid = (line.get_ydata() for line in probability.lines[2 * number : 2 * number + 2])
        np.testing.assert_array_equal(dotted, one.probability)
        np.testing.assert_array_equal(np.isnan(solid), np.array(one.bound) != 0.0)
    assert [line.get_ydata()[0] for line in probability.lines[6:]] == [0.5, 0.75, 0.9]
    assert probability.get_ylabel() == "probability"
    titles, files = ["Contrast at the aperture", "Probability against range"], ["crossing.png", "probability.png"]
    assert [(one.title, one.file) for one in by_size.figures()] == list(zip(titles, files, strict=True))
    records = by_size.tables()[1].records
    k, ranges = (np.array([record[name] for record in records]) for name in ("k", "range_km"))
    np.testing.assert_allclose(ranges, np.log(100.0) / (SIGMA_PER_KM + B_MRAD * k / 2.3), rtol=1e-9)
    assert (k[0], k[-1]) == (1.0, pytest.approx(16.0))
    assert by_size.figures()[1].note == (
        "Bands: 95 %, from the errors of the curve. Dotted: the curve ends there, and the probability is a bound."
    )


def test_units_of_a_table_are_those_of_its_header(table, tmp_path) -> None:
    """The same curve in mK over cycles/deg, and as a TOD of sizes, which needs k; intervals may have no width."""
    rows = [[float(one) for one in line.split(",")] for line in table.read_text().splitlines()[1:]]
    per_deg = tmp_path / "deg.csv"
    lines = [f"{f * math.pi / 0.18!r}{f',{1e3 * value!r}' * 3}" for f, value, *_ in rows]
    per_deg.write_text("\n".join(["frequency_cyc_per_deg,mrtd_mk,ci95_low,ci95_high", *lines]))
    sizes = tmp_path / "sizes.csv"
    sizes.write_text("\n".join(["size_mrad,delta_t_k", *(f"{1 / f!r},{value!r}" for f, value, *_ in rows)]))
    expected = math.log(100.0) / (SIGMA_PER_KM + 3.0 / 2.3)
    for path, more in ((per_deg, {"cycles": 3.0}), (sizes, {"k": 3.0})):
        found = tod.acquisition_range(path, target=NATO, atmosphere=BEER, **more).numbers.ranges[0]
        assert found.range_km == pytest.approx(expected, rel=1e-9)


def of_fits(level="contrast", column="object_size_mrad", **changes) -> tod.Result:
    fits = [
        {"group": {column: 1.0 / x, **changes.get("group", {})}, "level": level, "status": "ok", "p_correct": 0.75}
        | {"threshold": 0.02 * math.exp(x), "threshold_ci95": [0.018 * math.exp(x), 0.0222 * math.exp(x)]}
        | {"beta": 2.0, "gamma": 0.25, "delta": 0.0, "delta_t_mk": changes.get("delta_t_mk")}
        for x in FREQUENCIES
    ]
    content = {"schema": 1, "command": "score", "fits": fits, "dataset": "somewhere"} | changes.get("result", {})
    from todframes.results.result import read_result

    return read_result(json.dumps(content).encode(), "result")


DAYLIGHT = tod.Target(size_m=2.3, contrast=2.0, k={"seen": 3.0})


def test_a_result_is_a_curve_in_the_field() -> None:
    found = tod.acquisition_range(of_fits(), target=DAYLIGHT, atmosphere=BEER)
    (value,) = [one.range_km for one in found.numbers.ranges if one.probability == 0.75]
    assert value == pytest.approx(3.0612, abs=1e-4)
    # ln intervals of ±ln(0.9): a standard deviation of 0.1054 / 1.96 below, ln 1.11 / 1.96 above.
    sd = np.array(found.numbers.curve.ln_threshold_sd)
    np.testing.assert_allclose(sd[:, 0], [-math.log(0.9) / ndtri(0.975), math.log(1.11) / ndtri(0.975)], rtol=1e-9)
    displayed = of_fits(column="size_mrad")
    alone = tod.acquisition_range(displayed, target=DAYLIGHT, atmosphere=BEER)
    assert [one.code for one in alone.warnings] == ["size_at_the_eye"]
    magnified = tod.acquisition_range(displayed, target=DAYLIGHT, atmosphere=BEER, magnification=2.0)
    assert not magnified.warnings
    np.testing.assert_allclose(magnified.numbers.curve.per_mrad, 2.0 * FREQUENCIES, rtol=1e-12)
    for aim, unit in ((DAYLIGHT, "Weber contrast"), (replace(NATO, k={"seen": 3.0}), "K")):
        (warning,) = tod.acquisition_range(of_fits("level"), target=aim, atmosphere=BEER).warnings
        assert warning.code == "level_without_unit" and warning.message.endswith(f"contrast, {unit}")


def test_a_sensor_s_curve_has_its_pitch_and_delta_t() -> None:
    settings = {"settings": {"sensor": {"detector": {"pitch_mrad": 0.5}}}, "command": "curve"}
    result = of_fits("snr", "size_detectors", delta_t_mk=100.0, result=settings)
    curve = tod.acquisition_range(result, target=replace(NATO, k={"seen": 2.0}), atmosphere=BEER).numbers.curve
    np.testing.assert_allclose(curve.per_mrad, FREQUENCIES / 0.5, rtol=1e-12)
    np.testing.assert_allclose(curve.threshold, 0.1, rtol=1e-12)


VISIBLE, TRIANGLES = exponential(quantity="contrast"), exponential(pattern="triangle")
BRIGHT = tod.Target(size_m=2.3, contrast=0.3)
COARSE = exponential([0.02, 0.05], threshold=np.array([0.05, 0.1]))


def target(**changes):
    return lambda _: replace(NATO, **changes)


def air_of(**settings):
    return lambda _: tod.Atmosphere(**settings)


def in_sight(curve=None, target=NATO, air=BEER):
    return lambda _: acquired(curve, target, air)


def of_bars(**asked):
    return lambda table: tod.acquisition_range(table, target=NATO, atmosphere=BEER, **asked)


def of_result(fits=None, **asked):
    return lambda _: tod.acquisition_range(of_fits(**fits or {}), target=DAYLIGHT, atmosphere=BEER, **asked)


LEFT, RIGHT = {"camera": "left"}, {"camera": "right"}
REFUSED_SETTINGS = [
    (target(contrast=0.3), "delta_t_k and contrast: found 2 contrasts, expected one of"),
    (target(cycles="Stanag"), "cycles: found 'Stanag', expected one of stanag, johnson.*; write stanag"),
    (target(k={"seen": 1.0}, cycles_per_size=1.0), "k: found it and cycles_per_size, expected one"),
    (target(delta_t_k=0.0), "which shows no target"),
    (target(k={}), "k: found no task, expected a table such as"),
    (target(view_deg=4.0), "lines: is missing, expected both view_deg and lines or none"),
    (target(reflectance=0.3), "background_reflectance: is missing, expected both reflectances or none"),
    (target(delta_t_k=None, contrast=0.3, delta_t_sd_k=0.1), "delta_t_sd_k: is given but not used without delta"),
    (air_of(range_km=(1.0, 5.0), transmission=(0.5, 0.7)), "grows from 0.5 at 1 km to 0.7 at 5 km, expected"),
    (air_of(range_km=(5.0, 1.0), transmission=(0.5, 0.3)), "range_km: found 5, 1, expected rising ranges"),
    (air_of(range_km=(1.0, 5.0), transmission=(0.5,)), "transmission: found 1 values, expected 2, one a range"),
    (air_of(transmission=(0.5,)), "range_km: is missing"),
    (air_of(extinction_per_km=0.5, band_um=(12.0, 8.0)), r"band_um: found \[12\.0, 8\.0\], expected two rising"),
    (air_of(visibility_km=5.0, extinction_per_km=0.5), "found 2 descriptions of the air, expected one"),
    (in_sight(VISIBLE), "target: found a temperature difference, expected a contrast, as"),
    (
        in_sight(air=tod.Atmosphere(visibility_km=10.0)),
        "found sky_to_.*, which are of daylight",
    ),
    (
        in_sight(air=find_atmosphere("visible_23km")),
        r"found a band of 0\.4 to 0\.7 µm, expected air of a th",
    ),
    (in_sight(TRIANGLES), "k: is missing, and mrtd is a TOD; no public value exists"),
    (in_sight(TRIANGLES, replace(NATO, k={"seen": 3.0}, search_time_s=2.0)), "search_time_s: is given but not"),
    (of_bars(k=3.0), "k: is given but not used: .* is a curve of bars"),
    (of_bars(magnification=2.0), "is one curve in the field, expected no group and no magnification"),
    (of_bars(cycles="1,x"), "cycles: found '1,x', expected a name, or numbers with commas between them"),
    (of_result(cycles="johnson"), r"cycles: is given but not used: .* curve of triangles, without"),
    (of_result(magnification=2.0), "magnification: is given but not used"),
    (of_result({"group": LEFT}, group={"lens": "a"}), "group: found 'lens', expected one of the columns camera"),
    (
        of_result({"group": LEFT}, group=RIGHT),
        "group: found 0 curves in .*, expected a choice of one: camera=left",
    ),
]
REFUSED_DATA = [
    (in_sight(COARSE, tod.Target(size_m=0.01, delta_t_k=2.0)), r"target of 0\.01 m is smaller than the curve's"),
    (of_result({"level": "snr"}), "found thresholds in snr, expected one of .*netd_mk in .noise. gives"),
    (
        of_result({"column": "distance_m"}, group={"distance_m": "1"}),
        "found no column of sizes, expected one of obj",
    ),
    (of_result({"column": "size_detectors"}), "found sizes in detectors but no detector pitch"),
]


@pytest.mark.parametrize(
    ("call", "message", "error"),
    [(*one, tod.SettingsError) for one in REFUSED_SETTINGS] + [(*one, tod.DataError) for one in REFUSED_DATA],
)
def test_what_has_no_range(call, message, error, table) -> None:
    with pytest.raises(error, match=message):
        call(table)


BAD_TABLES = [
    ("frequency_cyc_per_mrad,mrtd_k\n1,54\n3,400\n", 1, "found 54 K as the lowest threshold.*in mK"),
    ("frequency_cyc_per_mrad,mrtd_k\n1000,0.05\n3000,0.4\n", 1, "found 3000 per mrad as the highest freq.*in rad"),
    ("frequency_cyc_per_mrad,mrtd_k\n1,0.05\n", 1, "found thresholds at 1 sizes or frequencies, expected two"),
    ("frequency,mrtd_k\n1,0.05\n2,0.1\n", 1, "found 0 of the columns frequency_cyc_per_mrad, .*columns are freq"),
    ("frequency_cyc_per_mrad,mrtd_k\n1,0.05\n1,0.1\n", 1, "found a size or frequency twice"),
    (
        "frequency_cyc_per_mrad,mrtd_k,ci95_low,ci95_high\n1,0.05,0.06,0.07\n2,1,1,1\n",
        *(1, r"found the interval 0\.06 to 0\.07, expected it to hold 0\.05"),
    ),
    ("frequency_cyc_per_mrad,mrtd_k\n0.001,0.05\n0.005,0.1\n", 1, r"found 0\.005 per mrad as the highest freq"),
    ("frequency_cyc_per_mrad,mrc\n1,0.05\n4,0.1\n", 2, "target: found a temperature difference"),
]


@pytest.mark.parametrize(("text", "status", "message"), BAD_TABLES)
def test_a_bad_table_is_one_line(text, status, message, tmp_path, air, todframes) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    error = error_line(todframes("range", path, "--target", "nato", "--atmosphere", air), status)
    assert re.search(message, error), error


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schema = 1\n[atmosphere]\nextinction = 0.2\n", "unknown key 'extinction'; the nearest valid one is"),
        ("schema = 1\n[atmosphere]\ntable = 'a.csv'\n", r"transmission: grows from 0\.5 at 1 km to 0\.7 at 5 km"),
        ("schema = 1\n[atmosphere]\ntable = '../a.csv'\n", "lies outside of"),
        ("schema = 1\n[target]\nsize_m = 1.0\n", "unknown key 'target'"),
        ("[atmosphere]\nextinction_per_km = 0.2\n", "schema: found None, expected 1"),
    ],
)
def test_bad_files_of_air(text, message, tmp_path) -> None:
    (tmp_path / "a.csv").write_text("range_km,transmission\n0,1\n1,0.5\n5,0.7\n")
    (tmp_path / "air.toml").write_text(text)
    with pytest.raises(tod.SettingsError, match=message):
        find_atmosphere(tmp_path / "air.toml")


def test_one_extinction_in_a_band_of_lines_is_warned_about(table) -> None:
    band = tod.Atmosphere(extinction_per_km=0.3, band_um=(3.0, 5.0))
    found = tod.acquisition_range(table, target=replace(NATO, search_time_s=10.0), atmosphere=band)
    pairs = "N50: detection 1, recognition 3, identification 6 line pairs on the target (stanag)."
    assert found.sentences()[-2:] == [pairs, "With 10 s to search."]
    assert [one.code for one in found.warnings] == ["one_extinction"]
    for ends, varies in (((0.9, 6.0), True), ((0.8, 6.0), False), ((3.0, 6.1), False), ((8.0, 12.0), False)):
        assert replace(band, band_um=ends).varies_unseen is varies
