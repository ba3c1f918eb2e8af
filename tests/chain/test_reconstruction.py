"""Sample & hold and post-sample blur against repetition, SciPy's filter, moments, and the adjoint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from sensor_sim.chain.reconstruction import axis_matrix, display_position_px, display_signal, gaussian_kernel
from sensor_sim.chain.sensor import SensorDisplay
from sensor_sim.chain.transfer import gaussian_mtf

DISPLAY = SensorDisplay(
    pixels_per_detector=6, pixel_pitch_mm=0.25, viewing_distance_mm=350.0, background_luminance_cd_m2=50.0
)
SIGMA = st.floats(0.0, 12.0)


def matrix_of(n=9, *, electronics=0.0, display=0.0, pixels=6):
    return axis_matrix(n, pixels_per_detector=pixels, blur_px=[electronics, display])


def random(*shape):
    return np.random.default_rng(1).normal(size=shape)


@given(SIGMA)
def test_kernel_has_sum_one_mean_zero_and_its_variance(sigma):
    kernel = gaussian_kernel(sigma)
    place = np.arange(kernel.size) - kernel.size // 2
    assert kernel.sum() == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_array_equal(kernel, kernel[::-1])
    # Halved to the last digit of the exponent below 1.5 pixels; above, aliases are e^-44 and 9 σ leave 1e-16.
    assert kernel @ place**2 == pytest.approx(sigma**2, rel=1e-12, abs=1e-15)
    assert kernel.min() >= 0.0


@pytest.mark.parametrize(("sigma", "tolerance"), [(5.0, 1e-14), (2.0, 1e-8), (1.0, 0.011)])
def test_kernel_s_transfer_is_the_gaussian_s(sigma, tolerance):
    # Aliases: up to half a cycle per pixel the nearest repetition adds exp(−2π²σ²(1 − f)²), 0.0072 at the
    # middle for 1 pixel, and as much again is in the normalisation's favour.
    kernel = gaussian_kernel(sigma)
    frequency = np.linspace(0.0, 0.5, 50)
    place = np.arange(kernel.size) - kernel.size // 2
    transfer = np.cos(2 * np.pi * np.outer(frequency, place)) @ kernel
    np.testing.assert_allclose(transfer, gaussian_mtf(frequency, sigma=sigma), atol=tolerance)


@pytest.mark.parametrize("pixels", [1, 2, 6])
def test_without_blur_samples_are_repeated(pixels):
    samples = random(9, 9)
    shown = display_signal(samples, matrix_of(pixels=pixels))
    np.testing.assert_array_equal(shown, samples.repeat(pixels, axis=0).repeat(pixels, axis=1))


@pytest.mark.parametrize(("n", "sigma"), [(9, 2.0), (2, 5.0)])
def test_blur_is_scipy_s_gaussian_filter_of_the_held_samples(n, sigma):
    """Also where it is wider than the field, at whose border it is cut."""
    samples = random(n, n)
    held = samples.repeat(6, axis=0).repeat(6, axis=1)
    # The same sampled kernel, of the same radius of 9 σ, applied in another order.
    expected = gaussian_filter(held, sigma, mode="constant", truncate=9.0)
    np.testing.assert_allclose(display_signal(samples, matrix_of(n, display=sigma)), expected, atol=1e-14)


def test_variances_of_electronics_and_display_add():
    together = matrix_of(electronics=1.5, display=2.0)
    np.testing.assert_allclose(together, matrix_of(display=2.5), rtol=1e-13)
    np.testing.assert_array_equal(matrix_of(electronics=2.0), matrix_of(display=2.0))


@pytest.mark.parametrize("n", [8, 9])
@pytest.mark.parametrize("pixels", [1, 5, 6])
def test_a_sample_is_shown_where_it_was_taken(n, pixels):
    display = replace(DISPLAY, pixels_per_detector=pixels)
    matrix = matrix_of(n, pixels=pixels)
    for detector in range(n):
        centroid = matrix[:, detector] @ np.arange(n * pixels) / matrix[:, detector].sum()
        place = display_position_px(detector - (n - 1) / 2, n_detectors=n, display=display)
        assert place == pytest.approx(centroid, abs=1e-12)
