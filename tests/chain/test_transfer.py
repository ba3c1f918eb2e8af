"""Transfer functions against published values, point spreads, limits and bounds worked out elsewhere."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from repetition import repetition_bound
from scipy.integrate import quad
from scipy.special import j0, j1
from scipy.stats import halfnorm

import sensor_sim as ss
from sensor_sim.chain import transfer
from sensor_sim.chain.camera import AirBlur, Camera, ModelledOptics, fried_length_mm, resolve
from sensor_sim.chain.transfer import (
    band_limit_cyc_per_mrad,
    box_mtf,
    diffraction_mtf,
    gaussian_mtf,
    motion_mtf,
    optics_otf,
    sharpness_bound,
    turbulence_mtf,
)

STAR_LIKE = Path(__file__).parents[2] / "sample_frames" / "star_like.toml"
NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(400)
POSITIVE = st.floats(1e-3, 1e3)


def camera_with(optics, motion=None, air=None, width_mrad=1.0):
    return Camera(
        optics=optics,
        motion=motion,
        air=air,
        pitch_mrad=width_mrad,
        width_mrad=width_mrad,
        pixels_per_detector=1,
        shown_pitch_mrad=1.0,
    )


def unit_diffraction(x):
    return diffraction_mtf(x, wavelength_um=1.0, aperture_mm=1.0)


def airy(radius, cut_off):
    """Point spread of a circular aperture, of volume 1 (Born & Wolf, section 8.5.2)."""
    v = np.pi * cut_off * np.maximum(radius, 1e-12)
    return np.pi * cut_off**2 * np.square(j1(v) / v)


def test_diffraction_has_the_tabulated_values():
    expected = [1.0, 0.872889, 0.685038, 0.391002, 0.144294, 0.037386]
    np.testing.assert_allclose(unit_diffraction([0.0, 0.1, 0.25, 0.5, 0.75, 0.9]), expected, atol=5e-7)


@given(POSITIVE, POSITIVE, st.floats(1.0, 1e6))
def test_nothing_passes_from_the_cut_off_on(aperture_mm, wavelength_um, times):
    cut_off = ModelledOptics(aperture_mm=aperture_mm, wavelength_um=wavelength_um).cut_off_cyc_per_mrad
    mtf = diffraction_mtf([cut_off, times * cut_off], wavelength_um=wavelength_um, aperture_mm=aperture_mm)
    np.testing.assert_array_equal(mtf, [0.0, 0.0])


@pytest.mark.parametrize("frequency", [0.0, 0.31, 0.8, 1.4, 2.5])
def test_diffraction_is_the_transform_of_the_airy_pattern(frequency):
    # Hankel transform back: psf(r) = 2π ∫ H(f) J₀(2πfr) f df, with f = 2 sin θ for the root at the cut-off.
    theta = (NODES + 1.0) * np.pi / 4.0
    f = 2.0 * np.sin(theta)
    measure = 2.0 * np.cos(theta) * NODE_WEIGHTS * np.pi / 4.0
    mtf = diffraction_mtf(f, wavelength_um=0.5, aperture_mm=1.0)
    psf = 2.0 * np.pi * np.sum(mtf * j0(2.0 * np.pi * f * frequency) * f * measure)
    # 400 Gauss nodes integrate a smooth function to rounding of a peak of π.
    assert psf == pytest.approx(airy(frequency, 2.0), abs=1e-12)


@pytest.mark.parametrize(
    ("frequency", "sigma", "expected"),
    [(4, 0.01, 0.968910791191297), (8, 0.01, 0.881323136669471), (4, 0.05, 0.454040738727245)],
)
def test_gaussian_has_the_tabulated_values(frequency, sigma, expected):
    assert gaussian_mtf(frequency, sigma=sigma) == pytest.approx(expected, rel=1e-13)


@given(st.floats(-3.0, 3.0), st.floats(0.1, 2.0))
def test_box_is_the_mean_of_a_wave_over_its_width(frequency, width):
    mean = np.sum(NODE_WEIGHTS / 2.0 * np.cos(np.pi * frequency * width * NODES))
    assert box_mtf(frequency, width=width) == pytest.approx(mean, abs=1e-13)


@given(st.floats(0.1, 100.0), st.floats(0.0, 10.0))
def test_nothing_of_weight_passes_beyond_the_band_limit(cut_off, sigma):
    optics = ModelledOptics(aperture_mm=cut_off, wavelength_um=1.0, blur_sigma_mrad=sigma)
    assert optics_otf(band_limit_cyc_per_mrad(optics), 0.0, optics=optics) < 1e-17


@pytest.mark.parametrize("v", [3.0, 30.0, 300.0, 3000.0])
def test_sharpness_bound_holds_for_the_energy_of_the_airy_pattern(v):
    # Mean of min(1, √2 r/width) over the pattern, by parts: √2/v ∫₀ᵛ/√² (J₀² + J₁²), v = πc·width.
    edges = np.linspace(0.0, v / math.sqrt(2), 20)
    x = (edges[:-1, None] + np.diff(edges)[:, None] * (NODES + 1.0) / 2.0).ravel()
    weights = (np.diff(edges)[:, None] * NODE_WEIGHTS / 2.0).ravel()
    moved = math.sqrt(2) / v * np.sum(weights * (j0(x) ** 2 + j1(x) ** 2))
    bound = sharpness_bound(camera_with(ModelledOptics(aperture_mm=v / math.pi, wavelength_um=1.0)))
    assert moved <= bound < 2.5 * moved
    # A Gaussian blur adds the mean of |u_x| + |u_y| over the width.
    blurred = ModelledOptics(aperture_mm=v / math.pi / 2.0, wavelength_um=1.0, blur_sigma_mrad=0.1)
    wider = camera_with(blurred, width_mrad=2.0)
    assert sharpness_bound(wider) - bound == pytest.approx(halfnorm.mean(scale=0.1), rel=1e-9)
    # So do an even motion, whose |u_x| is s/4 on average, and turbulence, E|u| = (2/π) ∫ (1 − transfer(t/2π))/t².
    smeared = replace(wider, motion=ss.Motion(smear_mrad=0.2))
    assert sharpness_bound(smeared) - sharpness_bound(wider) == pytest.approx(0.2 / 4.0 / 2.0, rel=1e-9)
    air = AirBlur(coherence_cyc_per_mrad=5.0)
    mean = sum(
        quad(lambda t: (1.0 - float(turbulence_mtf(t / 2.0 / np.pi, air=air))) / t**2, *ends, limit=200)[0]
        for ends in ((1e-9, 1.0), (1.0, 100.0), (100.0, np.inf))
    )
    added = sharpness_bound(replace(wider, air=air)) - sharpness_bound(wider)
    assert added == pytest.approx(2.0 * 2.0 / np.pi * mean / 2.0, rel=1e-3)  # below 1e-9, 0.1 % of the integral


def test_repetition_bound_is_above_and_near_the_lattice_sum_of_a_point():
    # The bound takes cos² for 1 in the pattern's tail, where it is 1/2 on average, and each place at its worst.
    cut_off, period = 1.7, 12.0
    place = (np.arange(-40, 41)[:, None] * period, np.arange(-40, 41) * period)
    radius = np.hypot(*place)
    neighbours = airy(radius[radius > 0.0], cut_off).sum()
    bound = repetition_bound(
        ModelledOptics(aperture_mm=cut_off, wavelength_um=1.0),
        area_mrad2=1.0, reach_mrad=0.0, field_mrad=0.0, period_mrad=period,
    )  # fmt: skip
    assert neighbours < bound < 6 * neighbours


def test_a_stage_more_is_in_the_product_the_table_and_the_figure(monkeypatch):
    known, sensor = transfer.transfers_before_sampling, ss.load_sensor(STAR_LIKE)
    before = ss.mtf(sensor)
    monkeypatch.setattr(
        transfer,
        "transfers_before_sampling",
        lambda camera: known(camera) | {"turbulence": lambda fx, fy: gaussian_mtf(np.hypot(fx, fy), sigma=0.05)},
    )
    found = ss.mtf(sensor)
    blur = np.exp(-2.0 * (np.pi * 0.05 * np.array(found.frequency_cyc_per_mrad)) ** 2)
    assert found.mtf["turbulence"] == pytest.approx(blur, rel=1e-12)
    assert found.mtf["pre_sample"] == pytest.approx(np.array(before.mtf["pre_sample"]) * blur, abs=1e-12)
    assert "turbulence" in [line.get_label() for line in found.plot().lines]


# By pyBSM 0.16.1 (Apache-2.0): `otf.turbulence_OTF` with λ 0.55 µm, D 12.5 mm and r₀ 30 mm, `jitter_OTF` with 0.02
# mrad, `drift_OTF` with 0.04 mrad; `coherence_diameter` over 200,001 places. The oracle test computes them again.
PYBSM_CYC_PER_MRAD = [1.0, 5.0, 10.0, 20.0]
PYBSM_TURBULENCE = {
    0.0: [0.9956246881742602, 0.9379038925110055, 0.8158460849529715, 0.5240510973281408],
    0.5: [0.9963956131926957, 0.9562293738485864, 0.8815017976192618, 0.7142224688430511],
}
PYBSM_JITTER = [0.9921354055113971, 0.8208687174155399, 0.45404073872724504, 0.04249905628536254]
PYBSM_DRIFT = [0.9973701827725034, 0.935489283788639, 0.7568267286406569, 0.2338723209471596]
PYBSM_LENGTH_MM = {
    (1e-14, 2.0, 0.55): 26.9016183367,
    (1e-15, 10.0, 4.0): 440.994493336,
    (1e-12, 1.0, 10.0): 83.5528324,
}


def test_motion_and_turbulence_are_those_of_pybsm():
    for alpha, expected in PYBSM_TURBULENCE.items():
        air = AirBlur(
            coherence_cyc_per_mrad=30.0 / 0.55, aperture_cyc_per_mrad=12.5 / 0.55, short_exposure_alpha=alpha
        )
        assert turbulence_mtf(PYBSM_CYC_PER_MRAD, air=air) == pytest.approx(expected, rel=1e-12)
    for motion, expected in (
        (ss.Motion(jitter_sigma_mrad=0.02), PYBSM_JITTER),
        (ss.Motion(smear_mrad=0.04), PYBSM_DRIFT),
    ):
        assert motion_mtf(PYBSM_CYC_PER_MRAD, 0.0, motion=motion) == pytest.approx(expected, rel=1e-12)
    for (cn2, path, wavelength), expected in PYBSM_LENGTH_MM.items():
        # The trapezoids of 2e5 steps err by less than 1e-9.
        assert fried_length_mm(cn2_m23=cn2, path_km=path, wavelength_um=wavelength) == pytest.approx(
            expected, rel=1e-8
        )


def test_turbulence_is_a_stage_that_widens_the_field_and_turns():
    sensor = ss.load_sensor(STAR_LIKE)
    still = resolve(sensor)
    for idle in (ss.Turbulence(cn2_m23=0.0, path_km=2.0), None):
        assert resolve(replace(sensor, turbulence=idle)) == still
    air = ss.Turbulence(cn2_m23=1e-13, path_km=5.0, short_exposure_alpha=1.0)
    camera = resolve(replace(sensor, turbulence=air))
    assert camera.samples_key != still.samples_key and transfer.looks_the_same_when_turned(camera)
    assert (
        camera.air.coherence_cyc_per_mrad == fried_length_mm(cn2_m23=1e-13, path_km=5.0, wavelength_um=4.0) / 4.0
    )
    of_stages = transfer.stages(np.array([0.0, 3.0, 200.0]), camera=camera)
    assert next(iter(of_stages)) == "turbulence" and of_stages["turbulence"][0] == 1.0
    # At and beyond the cut-off of 55 cycles/mrad, a short exposure in the near field is not blurred.
    assert of_stages["turbulence"][2] == 1.0
    # A Gaussian of the same half transfer; the long exposure's is at (ln 2 / 3.44)^(3/5) r₀/λ.
    half = math.sqrt(math.log(2.0) / 2.0) / math.pi / transfer.air_blur_mrad(camera.air)
    long = replace(camera.air, short_exposure_alpha=0.0)
    assert turbulence_mtf(half, air=long) == pytest.approx(0.5, rel=1e-12)
    assert transfer.blur_mrad(camera) == pytest.approx(math.hypot(0.01, transfer.air_blur_mrad(long)), rel=1e-12)
