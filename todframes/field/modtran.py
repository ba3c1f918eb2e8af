"""Air from the MODTRAN tables of pyBSM: mid-latitude summer, rural haze of 23 or 5 km visibility."""

from __future__ import annotations

import math

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError

HAZES = {23.0: 1, 5.0: 2}
"""MODTRAN's code of the haze by the visibility in km."""

LEAST_HEIGHT_M, MOST_HEIGHT_M = 75.0, 20_000.0
"""Heights of the sensor. The table at 2 m is not used: there the effective extinction of visible light falls from
0.174 to 0.129 per km between 2 and 5 km, at 75 m from 0.175 to 0.172. That at 32.55 m is not in the package."""

TABLED_UM = (0.3, 14.0)
"""Wavelengths of the tables, in steps of 0.01 µm."""

GROUND_RANGES_KM = (0.5, *range(1, 21), *range(22, 82, 2))
"""Ranges on the ground at which the tables are read, as far as the horizon."""

LEAST_THERMAL_UM, SCENE_K = 3.0, 300.0
"""Wavelength from which on a band is thermal, and temperature of the scene for its weights."""


def modtran_table(
    *, band_um: tuple[float, float], visibility_km: float, height_m: float
) -> tuple[list[float], list[float]]:
    """Read the transmission of a band over range from the tables of pyBSM.

    Thermal bands are weighted with dB/dT at 300 K, others evenly. `height_m` is that of the sensor above a target
    on the ground. Returns slant ranges in km, and transmissions, which do not rise. SettingsError if pyBSM is not
    installed, or a value is out of range.
    """
    if visibility_km not in HAZES:
        raise SettingsError(f"visibility_km: found {visibility_km:g}, expected 23 or 5, those of MODTRAN's tables")
    if not LEAST_HEIGHT_M <= height_m <= MOST_HEIGHT_M:
        raise SettingsError(
            f"modtran_height_m: found {height_m:g}, expected {LEAST_HEIGHT_M:g} to {MOST_HEIGHT_M:g}"
        )
    if not TABLED_UM[0] <= band_um[0] < band_um[1] <= TABLED_UM[1]:
        raise SettingsError(f"band_um: found {list(band_um)}, expected two rising wavelengths from 0.3 to 14 µm")
    try:
        from pybsm.utils import load_database_atmosphere
    except ImportError as error:
        raise SettingsError(
            f"modtran_height_m: needs the package {error.name or 'pybsm'}, which is not installed: "
            "pip install 'todframes[atmosphere]'"
        ) from None
    ranges, transmissions = [], []
    for ground_km in GROUND_RANGES_KM:
        try:
            table = load_database_atmosphere(
                altitude=height_m, ground_range=1000.0 * ground_km, ihaze=HAZES[visibility_km]
            )
        except IndexError:  # beyond the horizon
            break
        ranges.append(math.hypot(ground_km, height_m / 1000.0))
        transmissions.append(_in_band(1e6 * table[:, 0], table[:, 1], band_um))
    return ranges, np.minimum.accumulate(transmissions).tolist()


def _in_band(wavelength_um: FloatArray, transmission: FloatArray, band_um: tuple[float, float]) -> float:
    """Return the mean transmission of a band."""
    low, high = band_um
    inside = (wavelength_um >= low - 1e-6) & (wavelength_um <= high + 1e-6)
    if not inside.any():
        raise SettingsError(f"band_um: found {list(band_um)}, narrower than the tables' steps of 0.01 µm")
    weight = np.ones(int(inside.sum()))
    if low >= LEAST_THERMAL_UM:
        # dB/dT ∝ exp(x) / (exp(x) − 1)² / λ⁶, x = c₂ / (λ T), c₂ = 14,387.77 µm K.
        x = 14_387.77 / (wavelength_um[inside] * SCENE_K)
        weight = np.exp(-x) / np.square(-np.expm1(-x)) / wavelength_um[inside] ** 6
    return float(np.average(transmission[inside], weights=weight))
