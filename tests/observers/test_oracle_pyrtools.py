"""The pyramid against pyrtools, which scales band k by 2^k. Needs the `dev` extra."""

from __future__ import annotations

import numpy as np
import pytest

from todframes.observers.pyramid import LaplacianPyramid

pytestmark = pytest.mark.oracle


@pytest.mark.every_case
@pytest.mark.slow
@pytest.mark.parametrize("shape", [(257, 257), (64, 96), (129, 65)])
def test_bands_agree(shape: tuple[int, int]) -> None:
    pyrtools = pytest.importorskip("pyrtools", reason="pyrtools is in the group dev")
    image = np.random.default_rng(0).normal(size=shape)
    theirs = pyrtools.pyramids.LaplacianPyramid(image, height=5).pyr_coeffs
    for k, band in enumerate(LaplacianPyramid(4).build(image)):
        assert np.allclose(band, theirs[(k, 0)] / 2**k, rtol=0.0, atol=1e-14)
