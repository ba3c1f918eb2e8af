"""TTP against published figures and closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest

from todframes.base.errors import SettingsError
from todframes.field.ttp import (
    at_the_eye,
    channel,
    contrast_threshold,
    cycles_of_contrast,
    eye_mtf,
    noise_bandwidth,
    noise_gain_root_hz,
    pupil_mm,
)


def test_contrast_threshold_is_the_published_one():
    # whale-ir-model (MITRE), evaluated apart at 34.26 cd/m², 15 degrees, two eyes; printed to four digits.
    found = contrast_threshold([0.5, 1, 2, 4, 8, 16], luminance_cd_m2=34.26, width_deg=15.0)
    expected = [0.006855, 0.003738, 0.002357, 0.002070, 0.003201, 0.009000]
    assert found == pytest.approx(expected, abs=5.1e-7)


def test_contrast_threshold_at_its_limits():
    # A wide field and much light: √(2/2) / (540 f exp(−0.3 f) √(1 + 0.06 exp(0.3 f))).
    f = 7.0
    closed = 1.0 / (540.0 * f * math.exp(-0.3 * f) * math.sqrt(1.0 + 0.06 * math.exp(0.3 * f)))
    assert contrast_threshold(f, luminance_cd_m2=1e9, width_deg=1e9) == pytest.approx(closed, rel=1e-6)
    assert contrast_threshold(1e5, luminance_cd_m2=10.0, width_deg=5.0) == math.inf


def test_channels_are_1_6_octaves_wide():
    f = 2.0 ** np.linspace(-4.0, 4.0, 8001)
    above = np.flatnonzero(channel(3.0 * f, 3.0) >= 0.5)
    assert math.log2(f[above[-1]] / f[above[0]]) == pytest.approx(1.6, abs=0.05)  # one decimal is printed


def test_integral_of_an_exponential_threshold_is_its_closed_form():
    # ∫ √(C / c e^(bf)) df from 0 to ln(C/c)/b is √(C/c) · 2/b · (1 − √(c/C)).
    c, b, contrast = 0.01, 0.7, 0.3
    closed = 2.0 / b * (math.sqrt(contrast / c) - 1.0)
    f = np.linspace(0.0, 20.0, 7)
    assert cycles_of_contrast(f, c * np.exp(b * f), contrast) == pytest.approx(closed, rel=1e-12)
    # Beyond the last frequency that passes anything, and with a threshold that falls before it rises.
    ends = np.where(f > 15.0, np.inf, c * np.exp(b * f))
    assert cycles_of_contrast(f, ends, contrast) == pytest.approx(closed, rel=1e-12)
    both = cycles_of_contrast(np.linspace(-20.0, 20.0, 13), c * np.exp(b * np.abs(np.linspace(-20, 20, 13))), 0.3)
    assert both == pytest.approx(2.0 * closed, rel=1e-12)
    assert cycles_of_contrast(f, np.full(7, 0.5), 0.3) == 0.0
    assert cycles_of_contrast(f, np.full(7, 0.3 / 4.0), 0.3) == pytest.approx(40.0)


def test_noise_bandwidth_of_a_channel_is_its_closed_form():
    # ∫ exp(−4.4 ln²(f′/f)) df′ = f √(π/4.4) exp(1/17.6).
    f = np.geomspace(1e-3, 1e3, 1201)
    along_x, along_y = noise_bandwidth(f, np.ones_like(f))
    assert along_x[600] == pytest.approx(2.0 * math.sqrt(math.pi / 4.4) * math.exp(1.0 / 17.6), rel=1e-4)
    assert along_y == pytest.approx(2.0 * (1e3 - 1e-3), rel=1e-4)


def test_eye_is_that_of_the_code():
    # whale-ir-model: the pupil at 20 fL is 2.928 mm; evaluated by hand.
    assert pupil_mm(20.0 * 3.426) == pytest.approx(-9.011 + 13.23 * math.exp(-math.log10(20.0) / 21.082) - 0.5)
    assert eye_mtf(0.0, luminance_cd_m2=34.26) == 1.0
    # By hand at 10 fL: f₀ = 0.70444 cycles/mrad and i₀ = 0.76155 for a pupil of 3.1061 mm.
    assert eye_mtf([1.0, 2.0], luminance_cd_m2=34.26) == pytest.approx(np.exp([-2.1249, -4.8576]), rel=2e-4)
    # At 10 fL: a pupil of 3.106 mm, so β² Q_p / (L A) is 1.5051.
    assert noise_gain_root_hz(34.26) == pytest.approx(math.sqrt(2.0 * 240.0**2 * 3.538 / 2.5051), rel=1e-4)
    with pytest.raises(SettingsError, match="luminance_cd_m2: found 1e-60, at which the pupil would have"):
        pupil_mm(1e-60)


def test_a_degree_at_the_eye_is_smaller_in_the_scene_of_a_magnifying_display():
    # 1 cycle/mrad in the scene, magnified 5 times, is 0.2 cycles/mrad: 0.2 · π / 0.18 cycles/deg.
    assert at_the_eye(1.0, 5.0) == pytest.approx(0.2 * math.pi / 0.18)
