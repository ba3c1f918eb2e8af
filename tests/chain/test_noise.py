"""Detector noise: the split into its parts, its statistics, and temperatures."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sensor_sim.chain.noise import (
    delta_t_mk,
    draw,
    excess_kurtosis,
    line_shares,
    sample_parts,
)
from sensor_sim.chain.sensor import Noise
from todframes.base.errors import SettingsError

PAPER = Noise(distribution="uniform", netd_mk=16.0, fixed_pattern_ratio=0.4, frames_integrated=6)
SETTINGS = st.builds(
    Noise,
    distribution=st.sampled_from(["uniform", "gaussian"]),
    fixed_pattern_ratio=st.floats(0.0, 5.0),
    frames_integrated=st.integers(1, 100),
)


def test_parts_of_lines_by_hand():
    # A frame has 1 where four frames and a fixed pattern of 0.5 have √½; 0.64² = 1 − 0.6² − 0.48² and half of it.
    lines = {
        "row_noise_ratio": 0.6,
        "row_pattern_ratio": 0.3,
        "column_noise_ratio": 0.48,
        "column_pattern_ratio": 0.24,
    }
    noise = Noise(fixed_pattern_ratio=0.5, frames_integrated=4, **lines)
    assert sample_parts(noise, total_sd=0.5**0.5) == pytest.approx((0.32, 0.32, 0.3, 0.3, 0.24, 0.24), rel=1e-12)
    assert line_shares(noise) == pytest.approx((2.0 * (0.09 + 0.09), 2.0 * 2.0 * 0.0576), rel=1e-12)
    # Lines are Gaussian: two equal uniform parts are left, whose sum is triangular.
    assert excess_kurtosis(noise) == pytest.approx(-0.6, rel=1e-12)


# A busy machine is slow.
@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(SETTINGS, st.floats(0.0, 10.0))
def test_parts_add_up_to_the_total_and_have_the_ratio_of_one_frame(noise, total_sd):
    dynamic, static, *_ = sample_parts(noise, total_sd=total_sd)
    # Some five roundings.
    assert math.hypot(dynamic, static) == pytest.approx(total_sd, rel=1e-14)
    single_frame = dynamic * math.sqrt(noise.frames_integrated)
    assert static == pytest.approx(noise.fixed_pattern_ratio * single_frame, rel=1e-14)


def test_temperature_of_the_paper_s_sensor():
    # The paper's k is 1.7496: 16 mK / 1.7496 an SNR of 1, by hand.
    np.testing.assert_allclose(delta_t_mk([1.0, 2.5], noise=PAPER), [9.145, 22.862], atol=1e-3)


def test_temperature_needs_a_netd():
    with pytest.raises(SettingsError, match=r"^netd_mk: is missing, expected a number of mK"):
        delta_t_mk(1.0, noise=Noise())


N = 200_000


@pytest.mark.parametrize(("distribution", "kurtosis"), [("uniform", 1.8), ("gaussian", 3.0)])
def test_draws_have_their_moments(distribution, kurtosis):
    noise = draw(N, sd=0.7, distribution=distribution, rng=np.random.default_rng(1))
    # Five standard errors: of the mean sd/√N, of the variance sd²·√((κ − 1)/N).
    assert abs(noise.mean()) < 5 * 0.7 / math.sqrt(N)
    assert abs(noise.var() / 0.7**2 - 1) < 5 * math.sqrt((kurtosis - 1) / N)
    # Of the fourth moment: below √E(x⁸) = √105 sd⁴ for the Gaussian, less for the uniform.
    assert abs(np.mean((noise / 0.7) ** 4) - kurtosis) < 5 * math.sqrt(105 / N)


def test_excess_kurtosis_of_known_distributions():
    assert excess_kurtosis(Noise()) == pytest.approx(-1.2)
    assert excess_kurtosis(Noise(distribution="gaussian", fixed_pattern_ratio=1.0)) == 0.0
    # Two equal uniform parts make a triangular distribution.
    assert excess_kurtosis(Noise(fixed_pattern_ratio=1.0)) == pytest.approx(-0.6)
