"""Limits of a sensor, and the worth of an enhancement: closed forms, thresholds computed apart, drawn frames."""

from __future__ import annotations

import copy
import math
import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from msgspec import structs

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.sensor import part_of, sensor_from
from sensor_sim.chain.vary import FILL_FACTOR, numeric_keys, value_of
from sensor_sim.limits import advise
from sensor_sim.limits.advise import Gain
from sensor_sim.limits.limit import Limit, SensorLimit
from sensor_sim.limits.varied import Try, adapted_to, find_crossing, parameter_to_vary
from sensor_sim.limits.worth import SensorWorth, Worth
from todframes.base.errors import DataError, SettingsError
from todframes.observers.csf import CsfObserver, CsfSettings
from todframes.results.result import read_result
from todframes.results.wording import plain

ROOT = Path(__file__).parents[2]
THERMAL = ROOT / "sample_frames" / "star_like.toml"


def power_law(exponent: float, at: float):
    """Thresholds value**exponent over their value at `at`, with an error of 1 %."""
    return lambda value: Try.of(value, value**exponent, 0.01, at**exponent)


@pytest.mark.parametrize("exponent", [-2.0, -0.5, 0.7, 1.0])
@pytest.mark.parametrize("start", [0.02, 3.0, 40.0])
def test_a_power_law_is_crossed_where_its_closed_form_says(exponent, start):
    crossing = find_crossing(power_law(exponent, 3.7), start, low=1e-3, high=1e3)
    assert crossing.value == pytest.approx(3.7, rel=1e-6)
    assert crossing.is_least is (exponent < 0)
    # 1 % of the threshold is 1 % / |exponent| of the value; the precision of the root, 5e-4, is added in squares.
    assert crossing.error == pytest.approx(3.7 * math.hypot(0.01 / abs(exponent), 5e-4), rel=1e-3)


@pytest.mark.parametrize(
    ("exponent", "start", "expected"), [(-0.5, 1.0, 5.0), (-0.5, 20.0, 5.0), (0.5, 1.0, 4.0), (0.5, 20.0, 4.0)]
)
def test_whole_numbers_end_at_the_outermost_that_is_judged(exponent, start, expected):
    attempt = power_law(exponent, 4.3)
    found = find_crossing(attempt, start, low=1e-3, high=1e3, larger_is_better=exponent < 0, is_whole=True)
    assert (found.value, found.error, found.is_least) == (expected, 0.0, exponent < 0)
    assert found.is_judged is (attempt(start).excess <= 0.0)
    values = [one.value for one in found.tries]
    # Only the side on which the limit is was searched.
    assert values == sorted({*map(round, values)}) and start in (values[0], values[-1])


@pytest.mark.parametrize(
    ("exponent", "at", "expected", "error"),
    [
        (-0.5, 4300.3, 4301.0, 86.0),  # 1 % of the threshold is 2 % of the value, 86.006
        (0.5, 4300.3, 4300.0, 86.0),
        (-0.5, 4.001, 5.0, 1.0),  # 4 may be enough
        (-1.0, 4.5, 5.0, 0.0),
        (0.5, 1.01, 1.0, 0.0),  # no number is below 1
    ],
)
def test_a_whole_number_has_an_error_where_the_thresholds_allow_another_one(exponent, at, expected, error):
    found = find_crossing(power_law(exponent, at), 3.0, low=1.0, high=1e6, is_whole=True)
    # The line between two neighbours is the power law; the precision of the root, 5e-4, is added in squares.
    assert (found.value, found.error) == (expected, pytest.approx(error, abs=1.0 if error > 1.0 else 0.0))


@pytest.mark.parametrize("threshold", [None, 10.0])
def test_a_value_that_never_is_judged_has_no_limit(threshold):
    """Values 5 and more are those of no sensor, and the search ends before; below it goes to the end by halves."""

    def attempt(value: float) -> Try:
        if value >= 5.0:
            raise SettingsError("optics.transmission: found 6, expected a number in (0, 5)")
        return Try.of(value, threshold, 0.0, 1.0)

    found = find_crossing(attempt, 1.0, low=0.1, high=100.0)
    assert found[:4] == (None, None, True, False)
    assert [one.value for one in found.tries] == pytest.approx([0.1, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0])
    assert {one[1:] for one in found.tries} == {
        (math.inf if threshold is None else math.log(10.0), 0.0, threshold)
    }
    ended = find_crossing(attempt, 1.0, low=0.9, high=3.0, larger_is_better=True)
    assert [one.value for one in ended.tries] == pytest.approx([1.0, 2.0, 3.0])


OF = "A contrast of 0.3 at"
TRIED = "luminance (cd/m²) that was tried, from 0.100 to 1.00."


@pytest.mark.parametrize(
    ("changes", "limit", "words"),
    [
        ({"exposure_ms": 40.0}, {}, f"{OF} 4 mrad needs a luminance of at least 0.500 ± 0.01 cd/m²."),
        ({"parameter": "noise.frames_integrated", "unit": "", "level": "snr", "exposure_ms": 50.0},
         {"is_least": False, "error": 0.0},
         "An SNR of 0.3 at 4 mrad needs noise.frames_integrated of at most 0.500."),
        ({"level": "delta_t_mk"}, {"value": None, "error": None, "status": "always_judged"},
         f"A ΔT of 0.3 mK at 4 mrad is judged at every {TRIED}"),
        ({"exposure_ms": 50.0}, {"value": None, "error": None, "status": "never_judged"},
         f"{OF} 4 mrad is judged at no {TRIED} The exposure is 50 ms; IEC 62676-5 allows 40 ms at most."),
    ],
)  # fmt: skip
def test_a_limit_in_words(changes, limit, words):
    found = sensor_limit(changes, limit)
    assert " ".join(found.sentences()) == words
    (record,) = found.tables()[0].records
    assert record["error"] == (found.limits[0].error or None)  # no "± 0"
    assert record["bound"] == (None if "value" in limit else "largest" if "is_least" in limit else "least")
    axes = Figure().subplots()
    found.figures()[0].draw(axes)
    curve, *cross, line = axes.lines
    assert (curve.get_label(), curve.get_xydata().tolist()) == ("4 mrad", [[0.2, 0.4], [1.0, 0.2]])
    assert line.get_ydata() == [0.3, 0.3]
    assert [one.get_xydata().tolist() for one in cross] == ([] if "value" in limit else [[[0.5, 0.3]]])


def sensor_limit(changes, limit) -> SensorLimit:
    found = {"size": 4.0, "status": "ok", "value": 0.5, "error": 0.01, "is_least": True, "own_threshold": 0.1}
    tries = {"values": (0.1, 0.2, 1.0), "thresholds": (None, 0.4, 0.2)}
    common = {"sensor": "camera", "parameter": "light", "unit": "cd/m²", "own_value": 1.0, "target": 0.3}
    return SensorLimit.made(
        "limit", 0.0, **common | {"level": "contrast", "limits": (Limit(**found | tries | limit),)} | changes
    )


def test_what_is_varied_has_its_unit_and_range(photon_camera):
    thermal, photons = ss.load_sensor(THERMAL), ss.load_sensor(photon_camera)
    counted = replace(photons, scene=ss.Scene(background_electrons=50.0))
    coupled = replace(thermal, noise=replace(thermal.noise, couple_netd=True))
    along = parameter_to_vary(coupled, "aperture").sensor_at(110.0).noise.netd_mk
    assert along == pytest.approx(4.0 * 16.0, rel=1e-12)  # a quarter of the light
    for sensor, limit, key, unit, own, better, is_whole in (
        (photons, "light", "light", "cd/m²", 0.5, True, False),
        (counted, "light", "scene.background_electrons", "", 50.0, True, False),
        (photons, "aperture", "optics.f_number", "", 2.0, False, False),
        (thermal, "aperture", "optics.aperture_mm", "mm", 220.0, True, False),
        (thermal, "netd", "noise.netd_mk", "mK", 16.0, False, False),
        (thermal, "noise.frames_integrated", "noise.frames_integrated", "", 6, None, True),
    ):
        varied = parameter_to_vary(sensor, limit)
        assert varied[:5] == (key, unit, own, better, is_whole)
        changed = varied.sensor_at(3.0)
        if key == "light":
            assert changed == replace(sensor, scene=ss.Scene(luminance_cd_m2=3.0))
        else:
            table, _, name = key.partition(".")
            assert getattr(getattr(changed, part_of(table, sensor)), name) == 3.0


@pytest.mark.parametrize("is_coupled", [False, True])
def test_the_netd_is_that_of_the_closed_form(is_coupled):
    """The threshold in SNR does not depend on the NETD: the largest NETD is the target over the threshold a mK."""
    sensor = ss.load_sensor(THERMAL)
    sensor = replace(sensor, noise=replace(sensor.noise, couple_netd=is_coupled))
    limit = ss.limit(sensor, limit="netd", size_mrad=[0.5], delta_t_k=0.02, tolerance=0.02).limits[0]
    curve = ss.curve(THERMAL, size_mrad=[0.5], tolerance=0.02).thresholds[0]
    assert limit.value == pytest.approx(16.0 * 20.0 / curve.delta_t_mk, rel=1e-6) and 16.0 in limit.values
    assert not limit.is_least and limit.own_threshold == pytest.approx(curve.delta_t_mk, rel=1e-9)


def test_advice_and_worth_in_words():
    gains = [
        Gain(key=key, unit="mm", value=2.0, change_percent=of, error_percent=0.1)
        for key, of in (
            ("optics.wavelength_um", 9.0),
            ("optics.aperture_mm", -4.0),
            ("noise.netd_mk", 0.06),
            ("display.gain", 0.04),
        )
    ]
    shares = {"internal": 0.25, "detector": 0.5, "sampling": 0.25}
    sizes = {"sizes_detectors": (2.5, 4.0, 8.0), "sizes_mrad": (0.5, 0.8, 1.6), "size_detectors": 4.0}
    advice = advise.SensorAdvice.made(
        "advise", 0.0, sensor="camera", limits="Noise limits.", gains=tuple(gains), **shares, **sizes
    )
    asked = "Sizes worth asking for: 2.5, 4 and 8 detectors (0.500 to 1.60 mrad at the camera)."
    buys = "A tenth {} of optics.aperture_mm buys most: the threshold falls by about {} %."
    assert advice.sentences() == ["Noise limits.", asked, buys.format("more", "4.0")]
    with pytest.raises(SettingsError, match=r"^p_correct: found 2\.0"):
        ss.advise(THERMAL, p_correct=2.0)
    assert [row["key"] for row in advice.tables()[0].records] == [gain.key for gain in gains[:3]]
    less, unsure = (structs.replace(gains[1], change_percent=4.0, error_percent=error) for error in (0.1, 4.0))
    # A power law: 0.9 to the power ln 1.04 / ln 1.1 is 0.9576.
    assert structs.replace(advice, gains=(less,)).sentences()[2:] == [buys.format("less", "4.2")]
    assert structs.replace(advice, gains=(unsure,)).sentences()[2:] == []
    axes = Figure().subplots()
    advice.figures()[0].draw(axes)
    assert [bar.get_width() for bar in axes.patches] == [0.04, 0.06, -4.0, 9.0]  # the most important on top
    bars = [[x for x, _ in bar] for bar in axes.collections[0].get_segments()]
    assert bars == pytest.approx(np.add.outer([0.04, 0.06, -4.0, 9.0], [-0.1, 0.1]))
    worth = {"algorithm": "sharper", "ratio": 0.8, "ratio_ci95": (0.7, 0.9)}
    records = [
        Worth(**worth, size_detectors=size, factor=factor, factor_ci95=ends)
        for size, factor, ends in ((4.0, 1.3, (1.1, None)), (6.0, None, (None, None)), (8.0, 2.0, (1.5, 3.0)))
    ]
    found = SensorWorth.made(
        "worth", 0.0, sensor="camera", parameter="light", unit="cd/m²", own_value=1.0, worth=tuple(records)
    )
    assert found.sentences() == [
        "sharper at 4 detectors: as good as 1.30 times the light (1.10 to no limit).",
        "sharper at 6 detectors: no factor of the light changes the threshold by 0.800.",
        "sharper at 8 detectors: as good as 2.00 times the light (1.50 to 3.00).",
    ]
    unreached = structs.replace(records[1], status="never_reached", ratio=None)
    assert structs.replace(found, worth=(unreached,), unchecked_level="distance_m").sentences() == [
        "sharper at 6 detectors: no factor, because a threshold is never reached.",
        "Whether the sensor took the frames cannot be checked: it has no threshold distance_m.",
    ]
    axes = Figure().subplots()
    found.figures()[0].draw(axes)
    assert axes.lines[0].get_xydata().tolist() == [[4.0, 1.3], [8.0, 2.0]]
    assert [one.get_segments()[0].tolist() for one in axes.collections] == [[[8.0, 1.5], [8.0, 3.0]]]


@pytest.fixture(scope="module")
def photon_camera(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("camera") / "camera.toml"
    path.write_text(
        ss.new_sensor(
            preset="emva_basler",
            focal_length_mm=8.0,
            f_number=2.0,
            pitch_um=5.6,
            wavelength_um=0.55,
            luminance=0.5,
        )
    )
    return path


def test_at_the_least_light_the_threshold_is_the_contrast_asked_for(photon_camera):
    limit = ss.limit(photon_camera, limit="light", size_mrad=[4.0], contrast=0.3).limits[0]
    at_limit = ss.curve(photon_camera, size_mrad=[4.0], luminance_cd_m2=[limit.value]).thresholds[0]
    # The root has a relative precision of 5e-4, and the threshold changes less than the light.
    assert at_limit.threshold == pytest.approx(0.3, rel=1e-3)
    assert limit.is_least
    assert limit.error < 0.01 * limit.value


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"limit": "light", "size_mrad": [1], "delta_t_k": 1}, "background_electrons"),
        ({"limit": "netd", "size_mrad": [1]}, "found no target, expected delta_t_k or snr"),
        ({"limit": "netd", "size_mrad": [1], "contrast": 0.3}, "found contrast, expected delta_t_k or snr"),
        ({"limit": "netd", "delta_t_k": 1}, "expected sizes"),
        ({"limit": "range", "size_mrad": [1], "delta_t_k": 1}, "todframes range gives the range of a sensor"),
        ({"limit": "appertur", "size_mrad": [1], "delta_t_k": 1}, "the nearest valid one is 'aperture'"),
        ({"limit": "electronics.blur_sigma_px", "size_mrad": [1], "delta_t_k": 1}, "is missing or 0"),
        ({"limit": "netd", "size_mrad": [1], "delta_t_k": -1}, "delta_t_k: found -1"),
        (
            {"limit": "netd", "size_mrad": [1], "snr": 1},
            "no threshold of this sensor in SNR; give delta_t_k",
        ),
        (
            {"limit": "noise.frames_integrated", "size_mrad": [1], "snr": 1},
            "integrated changes no threshold",
        ),
        (
            {"limit": "display.background_luminance_cd_m2", "size_mrad": [1], "delta_t_k": 1},
            r"^limit: display\.background_luminance_cd_m2 changes no threshold of this sensor$",
        ),
        ({"limit": "optics.transmission", "size_mrad": [1], "delta_t_k": 1}, "unknown key 'optics.transmission'"),
    ],
)
def test_what_does_not_fit_is_refused(arguments, message):
    with pytest.raises(SettingsError, match=message):
        ss.limit(THERMAL, **arguments)


def test_a_number_that_changes_no_threshold_has_no_limit():
    """As the full well in faint light, of which nothing says so beforehand: all thresholds are the same."""
    varied = parameter_to_vary(ss.load_sensor(THERMAL), "display.gain")
    with pytest.raises(SettingsError, match=r"^limit: display\.gain changes no threshold of this sensor$"):
        varied.crossing(lambda value: Try.of(value, 2.0, 0.01, 1.0))
    assert varied.crossing(lambda value: Try.of(value, None, 0.0, 1.0)).value is None


def test_a_background_has_a_limit_for_an_observer_that_adapts_to_it():
    varied = parameter_to_vary(ss.load_sensor(THERMAL), "display.background_luminance_cd_m2")
    adapting = CsfObserver(CsfSettings(luminance_cd_m2="background"))
    assert varied.check_moves(adapting, in_mk=True) is False
    with pytest.raises(SettingsError, match="changes no threshold"):
        varied.check_moves(CsfObserver(CsfSettings(luminance_cd_m2=20.0)), in_mk=True)
    luminances = [adapted_to(adapting, varied.sensor_at(at)).settings.luminance_cd_m2 for at in (10.0, 90.0)]
    assert luminances == [10.0, 90.0]


@pytest.mark.parametrize("is_coupled", [False, True])
def test_gains_are_those_of_a_power_law(monkeypatch, is_coupled):
    """Thresholds NETD / aperture² / √width with an error of 3 %; the width of a detector has no room above."""

    def threshold(sensor, *_, **__):
        width = sensor.width_mrad
        return sensor.noise.netd_mk / sensor.optics.aperture_mm**2 / math.sqrt(width), 0.03

    monkeypatch.setattr(advise, "threshold_of", threshold)
    sensor = ss.load_sensor(THERMAL)
    sensor = replace(sensor, noise=replace(sensor.noise, couple_netd=is_coupled))
    gains = advise._gains(sensor, None, 4.0, None, {})
    found = {one.key: (one.change_percent, one.has_room_above) for one in gains}
    by_light = 2.0 if is_coupled else 0.0  # NETD ∝ (aperture · width)⁻²
    exponents = {
        "noise.netd_mk": 1.0,
        "optics.aperture_mm": -2.0 - by_light,
        "detector.width_mrad": -0.5 - by_light,
    }
    assert found == {
        key: (pytest.approx(100.0 * (1.1**exponent - 1.0)), key != "detector.width_mrad")
        for key, exponent in exponents.items()
    }
    assert (gains[0].key, gains[0].value, gains[0].unit) == ("optics.aperture_mm", 220.0, "mm")
    assert gains[0].error_percent == pytest.approx(3.0 * math.sqrt(2.0))
    monkeypatch.setattr(advise, "threshold_of", lambda *_, **__: (None, 0.0))
    assert advise._gains(sensor, None, 4.0, None, {}) == ()


def every_preset() -> dict[str, dict]:
    """The tables of all presets, of the explorer and of `new`."""
    boson = ss.new_sensor(preset="boson", focal_length_mm=14.0, f_number=1.4)
    basler = ss.new_sensor(preset="emva_basler", focal_length_mm=8.0, f_number=2.0, pitch_um=5.6, luminance=0.5)
    of_page = (ROOT / "sensor_sim" / "chain" / "presets").glob("*.toml")
    made = {"boson": tomllib.loads(boson), "basler": tomllib.loads(basler)}
    return made | {path.stem: tomllib.loads(path.read_text(encoding="utf-8")) for path in of_page}


def netd_by_light(tables: dict) -> float:
    """The square of f-number / side of a detector, to which the NETD is proportional."""
    side_um = tables["detector"].get("width_um", tables["detector"]["pitch_um"])
    return (tables["optics"]["f_number"] / side_um) ** 2


@pytest.mark.slow
@pytest.mark.parametrize("name", every_preset())
def test_advice_agrees_with_differences_of_curves(name):
    """Each number is changed in the file, with the NETD by hand where it is coupled, at other places."""
    tables = every_preset()[name]
    advice = ss.advise(sensor_from(tables, name))
    pitch_mrad = sensor_from(tables, name).pitch_mrad

    def threshold(changed: dict) -> float:
        sizes = {"size_mrad": [advice.size_detectors * pitch_mrad]}
        [found] = ss.curve(sensor_from(changed, name), **sizes, examples=False, rng=2).thresholds
        return found.threshold if found.delta_t_mk is None else found.delta_t_mk

    before, gains = threshold(tables), {gain.key: gain for gain in advice.gains}
    sensor = sensor_from(tables, name)
    values = {key: value_of(sensor, key) for key, is_whole in numeric_keys(sensor).items() if not is_whole}
    keys = [key for key, value in values.items() if value and key != FILL_FACTOR]
    assert gains.keys() <= {*keys} and len(keys) >= 10
    for name in keys:  # those without a row change nothing
        gain, (table, _, key) = gains.get(name), name.partition(".")
        changed, factor = copy.deepcopy(tables), 1.1 if gain is None or gain.has_room_above else 1.0 / 1.1
        changed.setdefault(table, {})[key] = values[name] * factor
        if tables["noise"].get("couple_netd") and key != "netd_mk":
            changed["noise"]["netd_mk"] *= netd_by_light(changed) / netd_by_light(tables)
        change = (threshold(changed) / before) ** (1.0 if factor > 1.0 else -1.0) - 1.0
        stated = 0.0 if gain is None else gain.change_percent
        assert stated == pytest.approx(100.0 * change, abs=1.0), name
    if sensor.level == "snr" and sensor.noise.netd_mk is not None:
        assert gains["noise.netd_mk"].change_percent == pytest.approx(10.0, abs=1e-6)
    says_why = "Without noise.netd_mk" in " ".join(advice.findings())
    assert says_why is (sensor.noise.netd_mk is None and sensor.photons is None)


@pytest.fixture(scope="module")
def comparison(photon_camera, tmp_path_factory) -> tod.Result:
    out = tmp_path_factory.mktemp("frames") / "frames"
    ss.simulate(
        photon_camera,
        size_detectors=[6],
        contrast=[0.05, 0.1, 0.2, 0.4, 0.8],
        trials=8,
        out=out,
        frame_format="exr",
    )
    return tod.compare(out, enhance=["gaussian:sigma=0.6"], white=200.0)


def test_the_factor_of_light_changes_the_threshold_by_the_ratio(photon_camera, comparison):
    [found] = ss.worth(comparison, photon_camera).worth
    lights = [0.5, 0.5 * found.factor]
    before, after = ss.curve(photon_camera, size_detectors=[6], luminance_cd_m2=lights).thresholds
    assert after.threshold / before.threshold == pytest.approx(found.ratio, rel=1e-3)
    low, high = found.factor_ci95
    assert low < found.factor < high


def test_a_sensor_that_did_not_take_the_frames_is_reported_with_the_factor(photon_camera, comparison):
    sensor, fit = ss.load_sensor(photon_camera), comparison.conditions[0].fits[0]
    assert ss.worth(comparison, sensor, tolerance=0.02).warnings == ()
    brighter = replace(sensor, scene=sensor.scene.at(5.0))
    [own] = ss.curve(brighter, size_detectors=[6], tolerance=0.02).thresholds
    found = ss.worth(comparison, brighter, tolerance=0.02)
    [warning] = found.warnings
    assert (warning.code, warning.group, warning.expected) == ("sensor_mismatch", fit.group, fit.threshold)
    assert warning.found == pytest.approx(own.threshold, rel=1e-12)
    assert (
        f"and the sensor {plain(own.threshold)}, {plain(own.threshold / fit.threshold)} times that"
        in warning.message
    )
    assert found.unchecked_level is None


def test_an_algorithm_that_is_never_reached_has_a_row(photon_camera, comparison):
    reference, blurred = comparison.conditions
    fit = structs.replace(blurred.fits[0], status="never_reached", threshold=None, threshold_ci95=None)
    ratio = structs.replace(blurred.ratios[0], ratio=None, ratio_ci95=None, ratio_above=1.5)
    worst = structs.replace(blurred, name="worst", fits=(fit,), ratios=(ratio,))
    with_worst = structs.replace(comparison, conditions=(reference, worst, blurred))
    found = ss.worth(with_worst, photon_camera, tolerance=0.02).worth
    assert [(one.algorithm, one.status, one.factor is None) for one in found] == [
        ("worst", "never_reached", True),
        ("gaussian", "ok", False),
    ]
    # A threshold that is more than 1.5 times as high is that of less light.
    low, high = found[0].factor_ci95
    lights = [0.5, 0.5 * high]
    before, after = ss.curve(photon_camera, size_detectors=[6], luminance_cd_m2=lights, tolerance=0.02).thresholds
    assert low is None and after.threshold / before.threshold == pytest.approx(1.5, rel=1e-3)


def test_a_result_of_another_kind_is_refused(photon_camera):
    curve = ss.curve(photon_camera, size_detectors=[6], tolerance=0.05)
    with pytest.raises(DataError, match="command: found 'curve', expected compare"):
        ss.worth(curve, photon_camera)


def test_a_range_and_groups_without_sizes_have_no_worth(photon_camera, comparison):
    with pytest.raises(SettingsError, match="limit: found range, expected light, aperture, netd or a key"):
        ss.worth(comparison, photon_camera, limit="range")
    written, sensor = comparison.to_json(), ss.load_sensor(photon_camera)
    for content, changes, message in (
        (written.replace(b'"size_detectors"', b'"lens"'), {}, "found groups without size_mrad or size_detectors"),
        (
            re.sub(rb'(\},\s*"ratio": )[\d.]+', rb"\1null", written),
            {},
            "found no ratio of thresholds, expected at",
        ),
        (written, {"blur_sigma_mrad": 5.0}, "the sensor has no threshold at 6 detectors, expected one"),
    ):
        with pytest.raises(DataError, match=message):
            ss.worth(read_result(content, "result"), replace(sensor, optics=replace(sensor.optics, **changes)))
