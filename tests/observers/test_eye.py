"""The optics of the eye: the pupil, its MTF, and the pyramid behind them."""

from __future__ import annotations

import math

import numpy as np
import pytest

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.transfer import diffraction_mtf
from todframes.base.errors import SettingsError
from todframes.observers.eye import eye_mtf, pupil_diameter_mm, sensitivity_ratio
from todframes.observers.interface import settings_file
from todframes.observers.internal_noise import inner_product
from todframes.observers.pyramid import PyramidObserver
from todframes.stimulus import Stimulus

EYE = {"eye_mtf": "watson2013"}
MRAD_PER_DEG = 1000.0 * math.pi / 180.0


@pytest.mark.parametrize("age", [20.0, 28.58, 83.0])
def test_the_pupil_is_that_of_the_solved_formula(age: float) -> None:
    """The same formula solved for d, as others print it, to five digits of its constants."""
    for luminance in (0.02, 1.0, 30.0, 300.0):
        f = (400.0 * luminance) ** 0.41
        solved = (18.5172 + 0.122165 * f - 0.105569 * age + 1.38645e-4 * f * age) / (2.0 + 0.0630635 * f)
        assert pupil_diameter_mm(luminance, age_years=age) == pytest.approx(solved, rel=5e-5)


def test_the_mtf_is_the_root_of_diffraction_and_falls() -> None:
    """The root of diffraction times a factor that is 2^-0.62 where the frequency is the formula's scale."""
    f = np.linspace(0.0, 150.0, 301)
    for pupil in (2.0, 4.0, 6.0):
        found = eye_mtf(f, pupil_mm=pupil)
        assert found[0] == 1.0 and (np.diff(found) <= 0.0).all()
        scale = np.array([21.95 - 5.512 * pupil + 0.3922 * pupil**2])
        root = np.sqrt(diffraction_mtf(scale / MRAD_PER_DEG, wavelength_um=0.555, aperture_mm=pupil))
        assert eye_mtf(scale, pupil_mm=pupil) == pytest.approx(2.0**-0.62 * root, rel=1e-9)
    assert eye_mtf(np.array([1e4]), pupil_mm=3.0) == 0.0


def test_a_grating_on_the_retina_is_attenuated_by_the_mtf() -> None:
    """A cosine that the mirrored border continues: each band has that share of what it has without."""
    side = 129
    for cycles in (3, 17, 40):
        grating = np.cos(math.pi * cycles * np.arange(side) / (side - 1)) * np.ones((side, 1))
        frequency = cycles / (2.0 * (side - 1) * 0.153) * MRAD_PER_DEG
        share = eye_mtf(np.array([frequency]), pupil_mm=4.0)
        seen = PyramidObserver(eye_mtf="watson2013", pupil_mm=4.0).activity(grating)
        for band, plain in zip(seen, PyramidObserver().activity(grating), strict=True):
            np.testing.assert_allclose(band, share * plain, rtol=0.0, atol=1e-13)


def test_a_band_without_noise_worth_naming_decides_alone() -> None:
    """Of many noises, d′² is the sum over bands of energy over variance."""
    stimulus, widths = Stimulus(1.0), (2.0, 0.7, 0.5, 3.0)
    weighed = PyramidObserver(band_noise=widths, position_jitter_samples=0.0)
    plain = PyramidObserver(position_jitter_samples=0.0)
    (up, right, *_) = plain.templates(stimulus)
    energy = [float(np.square(a - b).sum()) for a, b in zip(up, right, strict=True)]
    expected = sum(e / (w * plain.settings.noise_sd) ** 2 for e, w in zip(energy, widths, strict=True))
    covariance = weighed.readout(stimulus).noise_covariance
    variance = covariance[0, 0] + covariance[1, 1] - 2.0 * covariance[0, 1]
    # Matched templates: signal = variance / σ² in units of the band's noise, so d′² = variance / σ⁴.
    assert variance / plain.settings.noise_sd**4 == pytest.approx(expected, rel=1e-12)


def test_the_settings_of_the_package_are_found_by_name(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert settings_file("modelfest").is_file()
    assert settings_file("own.toml").name == "own.toml"
    with pytest.raises(SettingsError, match=r"observer settings: found 'modelfst', .* or one of modelfest"):
        settings_file("modelfst")


def test_a_pattern_is_folded_through_the_eye() -> None:
    """Of any pattern, as the bars of MRTD are: the literal score, and the variance of its noise."""
    observer, rng = PyramidObserver(band_noise=(3.0, 1.0, 0.5), **EYE), np.random.default_rng(0)
    pattern, half = rng.normal(size=(21, 21)), observer.grid(Stimulus(3.0)).side // 2
    image = rng.normal(size=(2 * half + 1,) * 2)
    found = observer.detection(pattern, 3.0, half)
    template = observer.pattern_template(pattern, len(image))
    expected = sum(map(inner_product, template, observer.activity(image)))
    # Sums of 1e4 products, as of the triangles' scores.
    assert float((found.weights * image).sum()) == pytest.approx(expected, abs=1e-10 * max(1.0, abs(expected)))


def test_the_sensitivity_is_the_published_parabola() -> None:
    """Ashraf et al. 2024: a peak and its frequency, and a parabola in log axes, low-pass below."""

    def sensitivity(f: np.ndarray, light: float) -> np.ndarray:
        peak = 56.4947 * (1 + 7.54726 / light) ** -0.144532 * (1 - (1 + 5.58341e-7 / light) ** -9.66862e9)
        at = np.log10(f) - np.log10(1.78119 * (1 + 91.5718 / light) ** -0.256682)
        parabola = 10.0 ** -(at**2 / 2.0**0.000213047)
        return peak * np.where(at < 0.0, np.maximum(parabola, 1 - 0.100207), parabola)

    f = np.array([0.1, 0.4, 0.7, 0.9, 2.0, 8.0, 30.0])
    for light in (0.02, 0.5, 30.0, 300.0):
        # 1 less a power of 1 + 1e-9 keeps 7 digits.
        expected = sensitivity(f, light) / sensitivity(f, 30.0)
        assert sensitivity_ratio(f, luminance_cd_m2=light) == pytest.approx(expected, rel=1e-6)
    assert sensitivity_ratio(np.zeros(1), luminance_cd_m2=1.0) == pytest.approx(
        sensitivity_ratio(np.array([0.01]), luminance_cd_m2=1.0), rel=1e-12
    )
    assert sensitivity_ratio(np.array([200.0]), luminance_cd_m2=300.0, pupil_mm=1.5).tolist() == [0.0]


def test_a_small_pupil_is_dim_light_through_sharp_optics() -> None:
    """Pupils of the same retinal illuminance differ by their optics alone."""
    f = np.array([1.0, 8.0, 24.0])
    wide = sensitivity_ratio(f, luminance_cd_m2=3.0, pupil_mm=6.0)
    narrow = sensitivity_ratio(f, luminance_cd_m2=12.0, pupil_mm=3.0)
    expected = eye_mtf(f, pupil_mm=3.0) / eye_mtf(f, pupil_mm=6.0)
    assert narrow / wide == pytest.approx(expected, rel=1e-12)


BACKGROUND = "background"


def observers(luminance) -> list:
    return [
        tod.CsfObserver(luminance_cd_m2=luminance, retina_pitch_mrad=0.2),
        tod.PyramidObserver(luminance_cd_m2=luminance, eye_mtf="watson2013"),
    ]


@pytest.mark.parametrize("rule", [50.0, "surround"])
def test_the_background_of_the_display_is_a_luminance(make_dataset, rule) -> None:
    """The frames of `make_dataset` have a background of 50 cd/m²; half floats have 11 bits."""
    path = make_dataset(contrasts=(0.05, 0.1, 0.2), display={"background_luminance_cd_m2": rule}).path
    for seen, stated in zip(observers(BACKGROUND), observers(50.0), strict=True):
        found, expected = (tod.score(path, observer=one) for one in (seen, stated))
        assert found.settings["luminance_cd_m2"] == pytest.approx(50.0, rel=5e-4)
        assert found.thresholds[0].threshold == pytest.approx(expected.thresholds[0].threshold, rel=1e-3)


def test_without_a_display_there_is_no_background() -> None:
    for observer in observers(BACKGROUND):
        with pytest.raises(SettingsError, match="luminance_cd_m2: found background where there is no display"):
            tod.naked_eye(size_mrad=3.0, observer=observer)


@pytest.mark.slow
def test_designs_with_other_displays_are_seen_in_their_light() -> None:
    camera, sizes, (eye,) = (
        "sample_frames/staring_camera.toml",
        {"size_detectors": [6], "tolerance": 0.1},
        observers(BACKGROUND)[1:],
    )
    vary = {"display.background_luminance_cd_m2": [1.0, 100.0]}
    swept = ss.sweep(camera, **sizes, vary=vary, observer=eye)
    for row, luminance in zip(swept.records(), (1.0, 100.0), strict=True):
        (stated,) = observers(luminance)[1:]
        (expected,) = ss.curve(camera, **sizes, observer=stated).thresholds
        assert row["threshold_snr"] == pytest.approx(expected.threshold, rel=0.1)
    varied = ss.sweep(camera, **sizes, vary={"observer.luminance_cd_m2": [1.0, 100.0]}, observer=eye)
    assert [row["threshold_snr"] for row in varied.records()] == [row["threshold_snr"] for row in swept.records()]
    own = ss.curve(camera, **sizes, observer=eye).settings
    assert own["luminance_cd_m2"] == ss.load_sensor(camera).display.background_luminance_cd_m2
