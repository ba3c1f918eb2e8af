"""Transfer functions against pyBSM and prysm.

Neither installs beside this project (pyBSM wants numpy < 2), so these run in an environment of their own:

    pip install pybsm prysm "setuptools<81" "numpy<2" pytest msgspec scipy lazy_loader
    PYTHONPATH=. python -m pytest tests/chain/test_oracle_mtf.py --noconftest --override-ini filterwarnings=
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from sensor_sim.chain.camera import AirBlur, fried_length_mm
from sensor_sim.chain.sensor import Motion
from sensor_sim.chain.transfer import box_mtf, diffraction_mtf, gaussian_mtf, motion_mtf, turbulence_mtf

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


def test_pybsm_moved_and_through_turbulent_air() -> None:
    otf = pytest.importorskip("pybsm.otf", reason="pyBSM has an environment of its own")
    u, v = 1e3 * FREQUENCY[None], 500.0 * np.ones((1, FREQUENCY.size))  # cycles/rad
    jitter = otf.jitter_OTF(u=u, v=v, s_x=2e-5, s_y=2e-5)
    drift = otf.drift_OTF(u=u, v=v, a_x=4e-5, a_y=0.0)
    moved = motion_mtf(FREQUENCY, 0.5, motion=Motion(jitter_sigma_mrad=0.02, smear_mrad=0.04))
    assert np.allclose((jitter * drift)[0], moved, rtol=0.0, atol=1e-12)
    path_m = np.linspace(0.0, 2000.0, 200_001)
    length_m = otf.coherence_diameter(lambda0=0.55e-6, z_path=path_m, cn2=np.full(path_m.shape, 1e-14))
    ours = fried_length_mm(cn2_m23=1e-14, path_km=2.0, wavelength_um=0.55)
    assert ours == pytest.approx(1e3 * length_m, rel=1e-8)
    for alpha in (0.0, 0.5):
        theirs = otf.turbulence_OTF(u=u, v=0.0 * v, lambda0=4e-6, D=0.22, r0=0.1, alpha=alpha)
        air = AirBlur(coherence_cyc_per_mrad=25.0, aperture_cyc_per_mrad=55.0, short_exposure_alpha=alpha)
        # Beyond the cut-off of the aperture α counts as at it.
        inside = FREQUENCY <= 55.0
        assert np.allclose(theirs[0, inside], turbulence_mtf(FREQUENCY[inside], air=air), rtol=0.0, atol=1e-12)


def test_prysm() -> None:
    otf = pytest.importorskip("prysm.otf", reason="prysm has an environment of its own")
    inside = FREQUENCY[FREQUENCY < APERTURE_MM / WAVELENGTH_UM]
    # With f-number 1 and a focal length of the aperture, 1 cycle/mrad is 1000 / aperture cycles/mm.
    theirs = otf.diffraction_limited_mtf(1.0, WAVELENGTH_UM, frequencies=inside * 1000.0 / APERTURE_MM)
    ours = diffraction_mtf(inside, wavelength_um=WAVELENGTH_UM, aperture_mm=APERTURE_MM)
    assert np.allclose(np.asarray(theirs), ours, rtol=0.0, atol=1e-12)
