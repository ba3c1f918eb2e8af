"""A camera simulated from photons up, for tests and campaigns. It shares no code with the packages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class PhotonCamera:
    """A linear camera: photons become electrons, which a full well and the end of the scale limit."""

    quantum_efficiency: float = 0.45
    gain_dn_per_electron: float = 0.28
    read_noise_electrons: float = 8.0
    dark_current_electrons_per_s: float = 400.0
    dsnu_electrons: float = 2.0
    prnu_percent: float = 0.8
    full_well_electrons: float = 13_000.0
    offset_dn: float = 30.0
    bits: int = 12
    bend: float = 0.0
    """Relative loss of the response at the full well; a faint signal loses nothing."""

    def patterns(self, rng: np.random.Generator, shape: tuple[int, int]) -> tuple[NDArray, NDArray]:
        """Draw the fixed patterns of one camera: electrons added, and relative sensitivity."""
        return self.dsnu_electrons * rng.normal(size=shape), 1.0 + self.prnu_percent / 100.0 * rng.normal(
            size=shape
        )

    def dark_noise_electrons(self, exposure_ms: float) -> float:
        """Temporal dark noise: that of reading, and the dark current's own."""
        return float(np.sqrt(self.read_noise_electrons**2 + self.dark_current_electrons_per_s * exposure_ms / 1e3))

    def film(
        self,
        rng: np.random.Generator,
        patterns: tuple[NDArray, NDArray],
        n: int,
        *,
        photons: float,
        exposure_ms: float,
        flicker: float = 0.0,
        drift: float = 0.0,
        fall_off: float = 0.0,
    ) -> NDArray[np.uint16]:
        """Film n frames under a mean number of photons of a pixel.

        The lamp flickers from frame to frame, drifts from the first to the last, and falls off from the middle to
        the corners, each by so much of its light.
        """
        added, sensitivity = patterns
        shape = (n, *added.shape)
        y, x = (np.linspace(-1.0, 1.0, one) for one in added.shape)
        even = 1.0 - fall_off * np.add.outer(y**2, x**2) / 2.0
        of_frame = 1.0 + drift * np.linspace(0.0, 1.0, n) + (flicker * rng.normal(size=n) if flicker else 0.0)
        arrived = rng.poisson(photons * of_frame[:, None, None] * (even / even.mean()))
        counted = rng.binomial(arrived, np.clip(self.quantum_efficiency * sensitivity, 0.0, 1.0))
        thermal = rng.poisson(self.dark_current_electrons_per_s * exposure_ms / 1e3, shape)
        electrons = np.minimum(counted + thermal, self.full_well_electrons)
        electrons = electrons + added + self.read_noise_electrons * rng.normal(size=shape)
        electrons *= 1.0 - self.bend * electrons / self.full_well_electrons
        values = np.rint(self.offset_dn + self.gain_dn_per_electron * electrons)
        return np.clip(values, 0, 2**self.bits - 1).astype(np.uint16)
