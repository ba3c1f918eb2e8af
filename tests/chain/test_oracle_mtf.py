"""Transfer functions against pyBSM and prysm.

Neither installs beside this project (pyBSM wants numpy < 2), so these run in an environment of their own:

    pip install pybsm prysm "setuptools<81" "numpy<2" pytest msgspec scipy
    PYTHONPATH=. python -m pytest tests/chain/test_oracle_mtf.py --noconftest --override-ini filterwarnings=
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from sensor_sim.chain.transfer import box_mtf, diffraction_mtf, gaussian_mtf

pytestmark = pytest.mark.oracle

FREQUENCY = np.linspace(0.0, 60.0, 121)
APERTURE_MM, WAVELENGTH_UM = 220.0, 4.0


def test_pybsm() -> None:
    otf = pytest.importorskip("pybsm.otf", reason="pyBSM has an environment of its own")
    u, v = 1e3 * FREQUENCY[None], np.zeros((1, FREQUENCY.size))  # cycles/rad
    aperture = otf.circular_aperture_OTF(u=u, v=v, lambda0=1e-6 * WAVELENGTH_UM, D=1e-3 * APERTURE_MM, eta=0.0)
    ours = diffraction_mtf(FREQUENCY, wavelength_um=WAVELENGTH_UM, aperture_mm=APERTURE_MM)
    assert np.allclose(aperture[0], ours, rtol=0.0, atol=1e-12)
    # Its width b is that of exp(−πb²f²).
    width = 0.01e-3 * math.sqrt(2.0 * math.pi)
    gaussian = otf.gaussian_OTF(u=u, v=v, blur_size_x=width, blur_size_y=width)
    assert np.allclose(gaussian[0], gaussian_mtf(FREQUENCY, sigma=0.01), rtol=0.0, atol=1e-12)
    detector = otf.detector_OTF(u=u, v=v, w_x=0.0681e-3, w_y=0.0681e-3, f=1.0)
    assert np.allclose(detector[0], box_mtf(FREQUENCY, width=0.0681), rtol=0.0, atol=1e-12)


def test_prysm() -> None:
    otf = pytest.importorskip("prysm.otf", reason="prysm has an environment of its own")
    inside = FREQUENCY[FREQUENCY < APERTURE_MM / WAVELENGTH_UM]
    # With f-number 1 and a focal length of the aperture, 1 cycle/mrad is 1000 / aperture cycles/mm.
    theirs = otf.diffraction_limited_mtf(1.0, WAVELENGTH_UM, frequencies=inside * 1000.0 / APERTURE_MM)
    ours = diffraction_mtf(inside, wavelength_um=WAVELENGTH_UM, aperture_mm=APERTURE_MM)
    assert np.allclose(np.asarray(theirs), ours, rtol=0.0, atol=1e-12)
