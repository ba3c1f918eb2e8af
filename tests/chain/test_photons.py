"""Cameras that count photons: light, electrons, noise against drawn frames, thresholds against brute force."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_texts import DISPLAY, LENS, PHOTONS, PIXELS
from conftest import error_line
from overlaps import weights_at
from scipy.special import ndtr

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.camera import PHOTOPIC, photopic_efficiency, resolve
from sensor_sim.chain.noise import (
    ContrastVariance,
    PhotonCamera,
    check_rounding,
    contrast_variance,
    largest_contrast,
)
from sensor_sim.thresholds.curve_plan import full_plan
from sensor_sim.thresholds.predict import FoldedChain, SensorTrials, covariance_at
from todframes.base.errors import SettingsError
from todframes.observers.decision import answer_probabilities
from todframes.observers.pyramid import PyramidObserver
from todframes.stimulus import ORIENTATIONS

CAMERA = '\nschema = 1\nname = "machine vision"\n' + LENS + PIXELS + PHOTONS + DISPLAY


def camera(tmp_path: Path, *changes: tuple[str, str]) -> ss.Sensor:
    text = CAMERA
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path = tmp_path / "camera.toml"
    path.write_text(text, encoding="utf-8")
    return ss.load_sensor(path)


def test_electrons_of_a_luminance_by_hand(tmp_path):
    # 1 cd/m² at f/2.8 is π/(4·2.8²) = 0.100177 lx on the chip. A watt of 555 nm is 683.0 lm (V is 1 there, and
    # 0.99497 in this table of 10 nm) and 555/1.98645e-16 = 2.79393e18 photons per second. A pixel of 3.45 µm gets
    # 0.100177 · 11.9025e-12 m² · 0.01 s / 683 · 2.79393e18 = 48.78 photons, and 29.27 electrons.
    assert resolve(camera(tmp_path)).background_electrons == pytest.approx(29.27 / 0.99497, rel=2e-3)
    in_light = camera(tmp_path, ("luminance_cd_m2 = 1.0", "illuminance_lx = 20.0\nreflectance = 0.5"))
    assert resolve(in_light).background_electrons / resolve(
        camera(tmp_path)
    ).background_electrons == pytest.approx(10.0 / math.pi)
    # Behind a lens that passes half, and with 4,000 photons a µm² and s for a lux.
    by_lux = ("luminance_cd_m2 = 1.0", "luminance_cd_m2 = 1.0\nphotons_per_lux_s_um2 = 4000.0")
    passed = camera(tmp_path, by_lux, ("[detector]", "transmission = 0.5\n[detector]"))
    photons = 0.5 * math.pi / (4 * 2.8**2) * 4000.0 * 3.45**2 * 0.01
    assert resolve(passed).background_electrons == pytest.approx(0.6 * photons, rel=1e-12)


def with_electrons(tmp_path: Path, electrons: float, **changes: object) -> ss.Sensor:
    sensor = camera(tmp_path)
    photons = replace(sensor.photons, **changes)
    return replace(sensor, photons=photons, scene=ss.Scene(background_electrons=electrons, luminance_cd_m2=2.0))


def test_a_pixel_that_saturates_by_hand(tmp_path):
    # 100 electrons of dark current a second for 10 ms are 1; 12 bits end at 4095 / 0.4 = 10,237.5 electrons.
    assert with_electrons(tmp_path, 9.0).photons.saturation_electrons == 10_000.0
    by_bits = with_electrons(tmp_path, 9.0, full_well_electrons=None)
    assert largest_contrast(resolve(by_bits)) == pytest.approx((10_237.5 - 1.0) / 9.0 - 1.0, rel=1e-12)
    assert largest_contrast(resolve(with_electrons(tmp_path, 9.0, full_well_electrons=None, bits=None))) == 1e9
    assert resolve(with_electrons(tmp_path, 9.0, full_well_electrons=10.001)).background_electrons == 9.0
    with pytest.raises(SettingsError, match="saturates at 10 electrons, and the background gives 9 with 1 of"):
        resolve(with_electrons(tmp_path, 9.0, full_well_electrons=10.0))
    with pytest.raises(SettingsError, match=r"gives 1e\+12 electrons .* current 1, expected at most 1e\+12 tog"):
        resolve(with_electrons(tmp_path, 1e12))
    bright = PhotonCamera(resolve(with_electrons(tmp_path, 9.0)), 2, seed=1)
    with pytest.raises(SettingsError, match=r"^contrast: a triangle gives 9.*e\+19 electrons .* at most 1e\+18$"):
        bright.contrast(np.full((2, 2), 1e19), np.random.default_rng(1))
    lit = with_electrons(tmp_path, 100.0).scene.at(5.0)
    assert (lit.luminance_cd_m2, lit.background_electrons, lit.background_cd_m2) == (5.0, 250.0, 5.0)
    assert ss.Scene(illuminance_lx=3.0, reflectance=0.5).at(2.0) == ss.Scene(luminance_cd_m2=2.0)


def test_photopic_efficiency_is_tabulated_and_smooth():
    # CIE: the integral of V is 106.857 nm. Its logarithm has no step: a cubic through four of five neighbours is
    # off by less than 8 %.
    assert sum(PHOTOPIC) == pytest.approx(10.6857, abs=2e-4)
    of_cubic = np.convolve(np.log(PHOTOPIC), np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0, mode="valid")
    assert np.abs(of_cubic).max() < 0.08
    ends_and_middle = [photopic_efficiency(um) for um in (0.38, 0.555, 0.78)]
    assert ends_and_middle == pytest.approx([3.9e-5, math.sqrt(0.99495 * 0.995), 1.5e-5], rel=1e-9)
    # CIE 1924 at 507.5 nm by a table of 1 nm: V(507) = 0.4450, V(508) = 0.4642 (CIE 018:2019); the logarithm is
    # nearly straight between 500 and 510 nm.
    assert photopic_efficiency(0.5075) == pytest.approx(0.4546, rel=0.02)
    for um in (0.379, 0.781):
        with pytest.raises(
            SettingsError, match=rf"^optics\.wavelength_um: found {um}, which has no luminance; exp"
        ):
            photopic_efficiency(um)


def test_variance_of_drawn_frames_is_the_computed_one(tmp_path):
    """Many cameras, each with a fixed pattern, and a triangle's signal in all pixels."""
    lines = {"row_noise_electrons": 2.0, "row_pattern_electrons": 1.5}
    lines |= {"column_noise_electrons": 4.0, "column_pattern_electrons": 3.0}
    sensor = with_electrons(tmp_path, 30.0, frames_integrated=3, dsnu_electrons=2.0, **lines)
    variance, signal = contrast_variance(resolve(sensor)), 0.7
    # By hand: dark noise 2.5, dark current 1 and rounding 1/12/0.4² a frame, PRNU 2 %.
    white = ((6.25 + 1.0 + 0.5208333 + 30.0) / 3 + 4.0) / 900.0 + 4e-4
    by_hand = (white, (4.0 / 3 + 2.25) / 900.0, (16.0 / 3 + 9.0) / 900.0, 1.0 / 90.0 + 8e-4, 4e-4)
    assert variance == pytest.approx(by_hand, rel=1e-6)
    large = PhotonCamera(resolve(sensor), 400, seed=1)
    assert (large.response.mean(), large.response.std()) == pytest.approx((1.0, 0.02), rel=0.01)
    rng = np.random.default_rng(1)
    drawn = np.array(
        [PhotonCamera(resolve(sensor), 24, seed=n).contrast(np.full((24, 24), signal), rng) for n in range(200)]
    )
    assert drawn.mean() == pytest.approx(signal, abs=4.0 * math.sqrt(variance.column / 24 / 200))
    of_column, of_row = drawn.mean(axis=1).var(ddof=0), drawn.mean(axis=2).var(ddof=0)
    white = variance.white + variance.per_signal * signal + variance.per_squared_signal * signal**2
    # A variance from n values is known to √(2/n): rows and columns give 4,800, their parts 2.1 %.
    assert of_column == pytest.approx(variance.column + white / 24 + variance.row / 24, rel=4 * 0.021)
    assert of_row == pytest.approx(variance.row + white / 24 + variance.column / 24, rel=4 * 0.021)
    assert drawn.var() == pytest.approx(white + variance.row + variance.column, rel=4 * 0.021)


def test_variance_of_scores_by_hand():
    """Relative to the square of a contrast of 0.5: parts that do not depend on the triangle count four times."""
    phases = SensorTrials(np.zeros((1, 1, 4)), np.full((1, 4, 4), 10.0), 0, np.ones((1, 1, 4, 4, 4)))
    light = ContrastVariance(white=1.0, row=0.1, column=0.02, per_signal=0.003, per_squared_signal=0.0004)
    found = covariance_at("snr", 0.5, np.full((4, 4), 100.0), phases, light)
    assert found == pytest.approx(np.full((1, 1, 4, 4), 4.0 * (110.0 + 0.1 + 0.02) + 2.0 * 0.003 + 0.0004))


def test_saturation_and_rounding(tmp_path):
    sensor = camera(tmp_path, ("full_well_electrons = 10000.0", "full_well_electrons = 60.0"))
    seen = PhotonCamera(resolve(sensor), 64, seed=1).contrast(np.full((64, 64), 50.0), np.random.default_rng(1))
    few_bits = replace(sensor, photons=replace(sensor.photons, bits=5, full_well_electrons=None))
    converted = PhotonCamera(resolve(few_bits), 2, seed=1).contrast(np.full((2, 2), 1e3), np.random.default_rng(1))
    most = ((2**5 - 1) / 0.4 - 1.0) / resolve(sensor).background_electrons - 1.0
    assert converted == pytest.approx(np.full((2, 2), most), rel=1e-12)
    # Far beyond saturation only the noise behind the well remains: dark noise, DSNU and rounding.
    behind = math.sqrt(2.5**2 + 1.0 + 1.0 / 12.0 / 0.4**2) / resolve(sensor).background_electrons
    assert seen.std() == pytest.approx(behind, rel=4 / math.sqrt(2 * 4096))
    number = (1.0 + seen) * resolve(sensor).background_electrons + sensor.photons.dark_electrons
    assert np.abs(number * 0.4 - np.rint(number * 0.4)).max() < 1e-9


def drawn_scores(sensor: ss.Sensor, signal: np.ndarray, weights: np.ndarray, n: int, rng) -> np.ndarray:
    """Scores of n exposures of cameras of their own, by NumPy's Poisson and normal numbers alone."""
    photons, electrons = sensor.photons, resolve(sensor).background_electrons
    shape = (n, len(signal))
    response = 1.0 + 0.01 * photons.prnu_percent * rng.standard_normal(shape)
    seen = rng.poisson(np.maximum(electrons * (1.0 + signal) * response, 0.0) + photons.dark_electrons).astype(
        float
    )
    seen += math.hypot(photons.dark_noise_electrons, photons.dsnu_electrons) * rng.standard_normal(shape)
    seen = np.rint(seen * photons.system_gain_dn_per_electron) / photons.system_gain_dn_per_electron
    return ((seen - photons.dark_electrons) / electrons - 1.0) @ weights.T


def test_coarse_rounding_is_in_the_error_or_refused(tmp_path):
    """The mean of a rounded normal number changes by up to 1 + 2 exp(−2π²σ²) of a change before rounding."""
    gain, sd = 0.4, 0.55
    sensor = with_electrons(tmp_path, (sd / gain) ** 2 - 1.0, dark_noise_electrons=0.0)  # and 1 of dark current
    edges, x, step = np.arange(-20.0, 21.0) - 0.5, np.linspace(0.0, 1.0, 101), 1e-4
    mean = [(1.0 - ndtr((edges - at[:, None]) / sd)).sum(axis=1) for at in (x - step, x + step)]
    largest = np.abs((mean[1] - mean[0]) / (2.0 * step) - 1.0).max()
    assert check_rounding(resolve(sensor)) == pytest.approx(largest, rel=1e-3)
    (fit,) = ss.curve(sensor, size_detectors=[4], tolerance=1e-3, examples=False).fits
    assert fit.threshold_numerical_error / fit.threshold == pytest.approx(largest, abs=2e-3)
    assert (
        check_rounding(resolve(with_electrons(tmp_path, 9.0, bits=None, system_gain_dn_per_electron=None))) == 0.0
    )


PLACES = 12


@pytest.mark.parametrize(("draws", "error"), [(800, 0.05), pytest.param(20_000, 0.01, marks=pytest.mark.weekly)])
def test_thresholds_of_photons_are_those_of_brute_force(tmp_path, draws, error):
    """12 places with exposures each: electrons are drawn and rounded, weights are dense overlaps, no covariance.

    The same places computed with the covariance at the threshold are the control: what differs is the noise alone.
    """
    sensor, size, observer, rng = camera(tmp_path), 3.0, PyramidObserver(), np.random.default_rng(1)
    (fit,) = ss.curve(sensor, size_detectors=[size], examples=False).fits
    chain = FoldedChain(resolve(sensor), observer, size, full_plan(resolve(sensor), observer, size))
    readout, contrast, differences = chain.readout, fit.threshold, []
    of_levels = np.array([(math.log(point.level), point.p_correct) for point in fit.points])
    slope = np.interp(math.log(contrast), of_levels[:, 0], np.gradient(of_levels[:, 1], of_levels[:, 0]))
    white, _, _, per_signal, per_square = contrast_variance(resolve(sensor))
    for n in range(PLACES):
        orientation = ORIENTATIONS[n % 4]
        x, y = rng.uniform(-0.5, 0.5, 2)
        weights = weights_at(sensor, readout, chain.field, x, y)
        signal = contrast * chain.sampler.samples(x, y, orientation=orientation)[0].ravel()
        answers = answer_probabilities(drawn_scores(sensor, signal, weights, draws, rng), readout.noise_covariance)
        in_pixels = white + per_signal * signal + per_square * signal**2
        covariance = readout.noise_covariance + (weights * in_pixels) @ weights.T
        k = orientation.quarter_turns
        computed = answer_probabilities((weights @ signal)[None], covariance)[0, k]
        differences.append(answers[:, k].mean() - computed)
    # P of an exposure has a standard deviation of at most 0.3. In 9,600 its mean has 0.0031, 1.2 % of the level at
    # a slope of 0.25; in 240,000 it has 0.25 %: four of these, in both.
    assert slope > 0.25
    assert abs(np.mean(differences)) / slope < error
    assert fit.threshold_numerical_error < 2e-3 * contrast


def test_curves_at_several_lights_are_those_of_each_light(tmp_path):
    sensor, asked = camera(tmp_path), {"size_detectors": [4], "tolerance": 0.01, "examples": False}
    together = ss.curve(sensor, luminance_cd_m2=[0.001, 0.002, 30.0], **asked)
    dim, brighter, light = together.fits
    assert dim.group == {"luminance_cd_m2": 0.001, "size_detectors": 4.0}
    (alone,) = ss.curve(replace(sensor, scene=ss.Scene(luminance_cd_m2=30.0)), **asked).fits
    assert light.threshold == pytest.approx(alone.threshold, rel=0.02)  # twice the tolerance
    # With hardly any light the noise in the dark decides: the contrast at threshold falls as 1 / luminance.
    assert dim.threshold / brighter.threshold == pytest.approx(2.0, rel=0.05)


def test_pixels_that_saturate_show_no_more_contrast(tmp_path):
    sensor = camera(tmp_path, ("full_well_electrons = 10000.0", "full_well_electrons = 45.0"))
    result = ss.curve(sensor, size_detectors=[3], tolerance=0.02, examples=False)
    assert (result.fits[0].status, result.fits[0].threshold) == ("never_reached", None)
    assert "more contrast than the pixels can show before they saturate" in result.warnings[0].message


WRONG = {
    "full well": ("bits = 12", "bits = 3", "noise.full_well_electrons: a pixel saturates at 17.5 electrons, and"),
    "both apertures": ("f_number = 2.8", "f_number = 2.8\naperture_mm = 9.0", "found aperture_mm and f_number"),
    "no focal length": ("focal_length_mm = 25.0", "", r"\[optics\]: focal_length_mm is missing: the aperture is"),
    "no focal length for light": (
        "f_number = 2.8\nfocal_length_mm = 25.0\nwavelength_um = 0.555\n[detector]\npitch_um = 3.45",
        "aperture_mm = 9.0\nwavelength_um = 0.555\n[detector]\npitch_mrad = 0.1\nwidth_mrad = 0.1",
        "optics.focal_length_mm is missing: light falls on a pixel by f-number and area",
    ),
    "no efficiency": ("quantum_efficiency = 0.6", "", "noise.quantum_efficiency is missing: it turns photons"),
    "coarse numbers": (
        "system_gain_dn_per_electron = 0.4",
        "system_gain_dn_per_electron = 0.05",
        r"the noise of a frame is 0\.3 digital numbers, expected 0\.5 or more: rounding changes",
    ),
    "no scene": ("[scene]\nluminance_cd_m2 = 1.0", "", r"table \[scene\] is missing: \[noise\] with model"),
    "two lights": ("luminance_cd_m2 = 1.0", "luminance_cd_m2 = 1.0\nreflectance = 0.5", "found luminance_cd_m2 a"),
    "a wrong unit": (
        "luminance_cd_m2 = 1.0\n[noise]",
        "luminance_cd_m2 = 1e12\nphotons_per_lux_s_um2 = 1e9\n[noise]",
        "gives .* electrons in a pixel, .* expected at most 1e.12 together",
    ),
    "half a light": ("luminance_cd_m2 = 1.0", "reflectance = 0.5", "luminance_cd_m2 is missing; expected it, or"),
    "wide": ("pitch_um = 3.45", "pitch_um = 3.45\nwidth_um = 5.0", "width_um: found 5.0, expected at most"),
    "another model": ('"photon"', '"emva"', "model: found 'emva', expected photon"),
    "a key of the other model": ("bits = 12", "netd_mk = 12.0", "unknown key 'netd_mk'; the nearest valid one is"),
    "bits without gain": ("system_gain_dn_per_electron = 0.4", "", "system_gain_dn_per_electron is missing: bits"),
    "a scene without photons": ('model = "photon"', "#", "unknown key"),
}


@pytest.mark.parametrize(("before", "after", "message"), WRONG.values(), ids=WRONG.keys())
def test_a_wrong_setting_is_one_clear_line(tmp_path, sensor_sim, before, after, message):
    assert before in CAMERA
    path = tmp_path / "camera.toml"
    path.write_text(CAMERA.replace(before, after), encoding="utf-8")
    assert re.fullmatch(rf"error: .*{message}.*\n", error_line(sensor_sim("curve", path, "--size-detectors", "3")))


def test_levels_of_another_kind_are_refused(tmp_path):
    sensor, out = camera(tmp_path), tmp_path / "out"
    with pytest.raises(SettingsError, match="contrast: the sensor counts photons; expected levels as contrast"):
        ss.simulate(sensor, size_detectors=[3], snr=[1.0], out=out)
    snr = Path(__file__).parents[2] / "sample_frames" / "star_like.toml"
    with pytest.raises(SettingsError, match=r"snr: the sensor has no \[noise\] with model"):
        ss.simulate(snr, size_detectors=[3], contrast=[1.0], out=out)
    with pytest.raises(SettingsError, match=r"luminance_cd_m2: found for a sensor without \[noise\] model"):
        ss.curve(snr, size_detectors=[3], luminance_cd_m2=[1.0])
    with pytest.raises(SettingsError, match=r"scene: found a table \[scene\], expected \[noise\]"):
        replace(ss.load_sensor(snr), scene=sensor.scene)


def test_frames_of_photons_are_a_dataset_of_contrasts(tmp_path):
    sensor, out = camera(tmp_path), tmp_path / "out"
    assert ss.simulate(sensor, size_detectors=[2], contrast=[0.5, 2.0], trials=4, out=out).n_frames == 8
    assert (out / "manifest.csv").read_text().splitlines()[0].split(",")[4] == "contrast"
    assert {fit.level for fit in tod.score(out, fit=tod.FitSettings(resamples=0), examples=False).fits} == {
        "contrast"
    }
