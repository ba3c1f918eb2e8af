"""The normal distribution function against mpmath, and its limits."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from todframes.base.normal import normal_cdf


@pytest.mark.parametrize(
    ("lowest", "tolerance"),
    # A rounding of a² / 2 is a factor of exp(a² / 2 · 2⁻⁵³): 2e-15 at 6 and 8e-14 at 37.6, where Φ is 1e-309.
    [(-6.0, 4e-15), (-37.6, 1e-13)],
)
def test_relative_error_is_that_of_rounding(lowest: float, tolerance: float) -> None:
    x = np.concatenate([np.linspace(lowest, 9.0, 400), np.geomspace(1e-12, 1.0, 30)])
    with mpmath.workdps(30):
        exact = np.array([float(mpmath.ncdf(mpmath.mpf(one))) for one in x.tolist()])
    assert np.abs(normal_cdf(x) / exact - 1.0).max() < tolerance


def test_limits_and_shapes() -> None:
    assert np.array_equal(
        normal_cdf([[-np.inf, -1e300, np.nan], [np.inf, 1e300, 41.0]]), [[0, 0, np.nan], [1, 1, 1]], equal_nan=True
    )
    assert normal_cdf(0.0) == pytest.approx(0.5, abs=2**-53)
    assert normal_cdf(np.zeros((2, 0))).shape == (2, 0)
