"""`sensor-sim mrtd`: bars, the literature's form and TTP of a sensor, beside its TOD."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import error_line
from matplotlib.figure import Figure
from scipy.integrate import quad
from scipy.stats import norm

import sensor_sim as ss
import todframes as tod
from sensor_sim.chain.sensor import Detector, Noise, Optics, Sensor
from sensor_sim.four_bars.mrtd import lloyd_mrtd_mk, sensor_ttp, snr_of
from todframes.base.errors import SettingsError
from todframes.field.ttp import at_the_eye, contrast_threshold, cycles_of_contrast
from todframes.results.wording import plain

CAMERA = Path(__file__).parents[2] / "sample_frames" / "star_like.toml"
SENSOR = ss.load_sensor(CAMERA)
FEW = {"frequency_nyquist": [1.0, 1.2, 2.0], "size_detectors": [6.0], "tolerance": 0.05}


@pytest.fixture(scope="module")
def found():
    return ss.mrtd(SENSOR, **FEW)


def test_thresholds_in_mk_are_those_of_the_triangles_rule(found):
    # ΔT = SNR · NETD / k for bars as for triangles.
    (fit,) = found.tod
    for one in found.bars[:2]:
        assert one.mrtd_mk / one.threshold_snr == pytest.approx(fit.delta_t_mk / fit.threshold)
        assert one.best_mrtd_mk / one.best_threshold_snr == pytest.approx(fit.delta_t_mk / fit.threshold)
        assert one.best_mrtd_mk < one.mrtd_mk
    assert found.bars[2].status == found.bars[2].best_status == "never_reached"
    assert found.bars[2].mrtd_mk is None
    assert [one.lloyd_mrtd_mk is None for one in found.bars] == [False, True, True]  # it ends at Nyquist
    low, high = (f"{plain(one.mrtd_mk)} mK at {one.frequency_nyquist:g} times" for one in found.bars[:2])
    first, second, ttp, last, *advice = found.sentences()
    assert (
        len(advice) == 2 and "column `best phase`" in advice[0] and "p_correct 0.944 needs the same" in advice[1]
    )
    assert first == f"The MRTD of the bars is {low} the Nyquist frequency and {high} the Nyquist frequency."
    assert second == "No contrast is enough from 2 times the Nyquist frequency on."
    per_mrad = found.ttp.cyc_per_mrad
    sizes = ", ".join(f"{task} {v50 / per_mrad:.3g}" for task, v50 in found.ttp.v50_cycles.items())
    assert ttp.startswith(
        f"TTP: a target of 2 K, shown at contrast {SENSOR.display.gain:g}, has V = {per_mrad:.4g} f"
    )
    assert ttp.endswith(f"Half of the observers need, in mrad: {sizes}.")
    assert last == "The display without bars shows a uniform square of their mean."
    (row,) = found.tables()[1].records
    assert (row["inverse"], row["snr"], row["delta_t_mk"]) == (1.0 / 6.0, fit.threshold, fit.delta_t_mk)
    axes = Figure().subplots()
    found.figures()[0].draw(axes)
    lines = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert lines["TOD"] == [[1.0 / 6.0, fit.delta_t_mk]] and lines["Lloyd"] == [[1.0, found.bars[0].lloyd_mrtd_mk]]
    assert lines["bars, mean over phases"] == [[one.frequency_nyquist, one.mrtd_mk] for one in found.bars[:2]]
    assert lines["bars, best phase"] == [[one.frequency_nyquist, one.best_mrtd_mk] for one in found.bars[:2]]
    assert lines["bars, frequency × 0.5"] == [[one.frequency_nyquist / 2, one.mrtd_mk] for one in found.bars[:2]]


def test_warnings_about_triangles_are_those_of_curve():
    found = ss.mrtd(SENSOR, **FEW | {"frequency_nyquist": [1.2], "size_detectors": [1.0]})
    assert found.tod[0].status == "never_reached"
    assert [one.code for one in found.warnings] == ["never_reached"]


def test_lloyds_form_of_a_sensor_without_blur():
    # Optics and display that pass all: MTF = sinc² of detector and hold; (π²/8) · SNR · NETD · f / MTF · w / √n.
    sensor = Sensor(
        optics=Optics(aperture_mm=1e6, wavelength_um=1.0),
        detector=Detector(pitch_mrad=0.2, width_mrad=0.2),
        display=replace(SENSOR.display, blur_sigma_px=0.0),
        noise=Noise(netd_mk=50.0, frames_integrated=4),
    )
    f = np.array([0.5, 1.0, 2.5])
    closed = np.pi**2 / 8 * 3.0 * 50.0 * f / np.sinc(0.2 * f) ** 2 * 0.2 / 2.0
    assert lloyd_mrtd_mk(f, sensor, snr=3.0) == pytest.approx(closed, rel=1e-5)


def test_ttp_without_noise_is_that_of_eye_and_blur():
    quiet = replace(SENSOR, noise=replace(SENSOR.noise, netd_mk=1e-9))
    of = {"delta_t_k": 2.0, "width_deg": 15.0, "eye_time_s": 0.1}
    f = np.geomspace(1e-3, 1.0, 4000) * 55.0
    # The modelled stages by hand: diffraction and blur, detector and hold, display spot of 2/6 detectors.
    x = np.minimum(f / 55.0, 1.0)
    mtf = 2 / np.pi * (np.arccos(x) - x * np.sqrt(1 - x**2)) * np.exp(-2 * (np.pi * 0.01 * f) ** 2)
    mtf *= np.sinc(0.0681 * f) ** 2 * np.exp(-2 * (np.pi * 2.0 / 6.0 * 0.0681 * f) ** 2)
    eye = contrast_threshold(at_the_eye(f, SENSOR.magnification), luminance_cd_m2=50.0, width_deg=15.0)
    with np.errstate(divide="ignore"):
        by_hand = cycles_of_contrast(f, eye / np.maximum(mtf, 0.0), 1.0)
    # 400 steps of 1.7 % in frequency; ln(threshold) bends little within one.
    assert sensor_ttp(quiet, **of).cyc_per_mrad == pytest.approx(by_hand, rel=2e-3)
    noisy = replace(SENSOR, noise=replace(SENSOR.noise, netd_mk=500.0, frames_integrated=2))
    assert sensor_ttp(noisy, **of).cyc_per_mrad < 0.9 * by_hand
    # Noise acts by (gain · NETD / ΔT)² · pitch² · frame time: four times one factor and a quarter of another.
    as_noisy = replace(noisy, noise=replace(noisy.noise, netd_mk=1000.0, frames_integrated=8))
    for sensor, changes in ((as_noisy, {}), (as_noisy, {"delta_t_k": 1.0, "eye_time_s": 0.025})):
        assert sensor_ttp(sensor, **of | changes).cyc_per_mrad == pytest.approx(
            sensor_ttp(noisy, **of).cyc_per_mrad
        )


def test_table_is_a_curve_that_range_reads(found, tmp_path):
    found.save(tmp_path / "out")
    for name, expected in (("mrtd", "mrtd_mk"), ("mrtd_best_phase", "best_mrtd_mk")):
        read = tod.acquisition_range(tmp_path / "out" / f"{name}.csv", target="nato", atmosphere="mwir_23km")
        curve = read.numbers.curve
        assert (curve.pattern, curve.quantity) == ("bars", "delta_t_k")
        rows = found.bars[:2]
        assert curve.per_mrad == pytest.approx([one.frequency_cyc_per_mrad for one in rows])
        assert curve.threshold == pytest.approx([getattr(one, expected) / 1000.0 for one in rows])
        ends = [getattr(one, f"{expected}_error") / getattr(one, expected) / 1.96 for one in rows]
        assert np.mean(curve.ln_threshold_sd, axis=0) == pytest.approx(ends, rel=0.02)
    with pytest.raises(tod.DataError, match=r"command: found 'mrtd', .* in mrtd\.csv, which"):
        tod.acquisition_range(tmp_path / "out", target="nato", atmosphere="mwir_23km")


@pytest.mark.usefixtures("blank_pictures")
def test_sensor_without_netd_has_thresholds_in_snr():
    sensor = replace(SENSOR, noise=replace(SENSOR.noise, netd_mk=None))
    found = ss.mrtd(sensor, frequency_nyquist=[1.2], size_detectors=[], tolerance=0.1)
    assert found.ttp is None
    assert found.bars[0].mrtd_mk is None
    assert found.bars[0].threshold_snr > 0.0
    assert {"bars.csv", "mrtd.png"} <= set(found.files())
    assert "mrtd.csv" not in found.files()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frequency_nyquist": []}, "frequency_nyquist: found no values"),
        ({"frequency_nyquist": [1.0, 1.0]}, "frequency_nyquist: found a value twice in 1, 1"),
        ({"frequency_nyquist": [0.0]}, "frequency_nyquist: found 0.0, expected a finite"),
        ({"frequency_nyquist": [1000.0]}, "frequency_nyquist: found 1000, expected a number from"),
        ({"frequency_nyquist": [0.05]}, "more than the observer looks at; expected a higher frequency"),
        ({"p_correct": 0.5}, "p_correct: found 0.5, expected a proportion above 0.5"),
        ({"against": "grey"}, "against: found 'grey', expected one of square, background"),
        ({"direction": "slanted"}, "direction: found 'slanted', expected one of upright, lying"),
        ({"lloyd_snr": -1.0}, "lloyd_snr: found -1.0"),
        ({"ttp_delta_t_k": math.nan}, "ttp_delta_t_k: found nan"),
        ({"tolerance": 0.0}, "tolerance: found 0.0"),
        ({"observer": "informative"}, "observer: HotellingObserver with these settings judges triangles only"),
    ],
)
def test_settings_that_make_no_curve(changes, message):
    with pytest.raises(SettingsError) as error:
        ss.mrtd(SENSOR, **{**FEW, **changes})
    assert message in str(error.value)


def test_camera_that_counts_photons_is_refused(sensor_sim, tmp_path):
    text = ss.new_sensor(preset="emva_basler", focal_length_mm=25.0, f_number=2.8, pitch_um=3.45)
    (tmp_path / "camera.toml").write_text(text)
    message = error_line(sensor_sim("mrtd", tmp_path / "camera.toml", "-o", tmp_path / "out"))
    assert message == "error: sensor: found one that counts photons, expected one whose level is an SNR\n"
    assert not (tmp_path / "out").exists()


def test_an_snr_is_that_of_two_displays():
    # The larger one of two draws, d' apart, is right: P = ∫ φ(x − d') Φ(x) dx (Hacker & Ratcliff 1979).
    for p in (0.6, 0.75, 0.944):
        right = quad(lambda x, d: norm.pdf(x - d) * norm.cdf(x), -12.0, 12.0, args=(snr_of(p),))[0]
        assert right == pytest.approx(p, rel=1e-9)


def test_lloyds_line_is_above_the_bars_as_its_threshold_is():
    """At the same SNR, the observer and Lloyd's form agree to a factor of 1.5 up to half the Nyquist frequency."""
    asked = {"frequency_nyquist": [0.3, 0.5], "size_detectors": [], "tolerance": 0.02}
    usual, same = (ss.mrtd("uncooled_lwir", p_correct=p, **asked).bars for p in (0.75, 0.944))
    for one, other in zip(usual, same, strict=True):
        assert 1.6 < one.lloyd_mrtd_mk / one.mrtd_mk < 3.1
        assert 1 / 1.5 < other.lloyd_mrtd_mk / other.mrtd_mk < 1.5
