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
    ) -> NDArray[np.uint16]:
        """Film n frames under a mean number of photons of a pixel."""
        added, sensitivity = patterns
        shape = (n, *added.shape)
        arrived = rng.poisson(photons, shape)
        counted = rng.binomial(arrived, np.clip(self.quantum_efficiency * sensitivity, 0.0, 1.0))
        thermal = rng.poisson(self.dark_current_electrons_per_s * exposure_ms / 1e3, shape)
        electrons = np.minimum(counted + thermal, self.full_well_electrons)
        electrons = electrons + added + self.read_noise_electrons * rng.normal(size=shape)
        values = np.rint(self.offset_dn + self.gain_dn_per_electron * electrons)
        return np.clip(values, 0, 2**self.bits - 1).astype(np.uint16)
