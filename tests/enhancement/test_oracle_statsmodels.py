"""Holm's correction against statsmodels'."""

from __future__ import annotations

import numpy as np
import pytest

from todframes.comparison.ratios import holm

multitest = pytest.importorskip("statsmodels.stats.multitest")

pytestmark = pytest.mark.oracle


@pytest.mark.every_case
@pytest.mark.parametrize("seed", range(20))
def test_holm(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p_values = rng.random(rng.integers(1, 30)) ** rng.integers(1, 6)
    p_values[rng.random(p_values.size) < 0.2] = p_values[0]  # ties
    assert np.allclose(holm(p_values), multitest.multipletests(p_values, method="holm")[1], rtol=1e-14, atol=0.0)
