"""Light of a scene, and the electrons that it frees in a pixel of a camera that counts photons.

EMVA Standard 1288, release 4.0 linear, section 2.
"""

from __future__ import annotations

import math

import numpy as np

from sensor_sim.chain.sensor import Sensor
from todframes.base.errors import SettingsError

LUMENS_PER_WATT = 683.002
"""Lumens of a watt of light of 540 THz, by the definition of the candela (SI brochure, 9th edition)."""

PHOTON_ENERGY_J_UM = 1.98644586e-19
"""Energy of a photon times its wavelength, h·c, in J·µm."""

PHOTOPIC_FIRST_UM, PHOTOPIC_STEP_UM = 0.38, 0.01
PHOTOPIC = (
    0.000039, 0.00012, 0.000396, 0.00121, 0.004, 0.0116, 0.023, 0.038, 0.06, 0.09098, 0.13902, 0.20802, 0.323,
    0.503, 0.71, 0.862, 0.954, 0.99495, 0.995, 0.952, 0.87, 0.757, 0.631, 0.503, 0.381, 0.265, 0.175, 0.107, 0.061,
    0.032, 0.017, 0.00821, 0.004102, 0.002091, 0.001047, 0.00052, 0.000249, 0.00012, 0.00006, 0.00003, 0.000015,
)  # fmt: skip
"""Luminous efficiency V(λ) every 10 nm from 380 to 780 nm: CIE 1924, as in ISO/CIE 23539:2023, table 1."""

MOST_ELECTRONS = 1e12
"""Largest number of electrons of the background and the dark current; beyond it a unit must be wrong."""


def photopic_efficiency(wavelength_um: float) -> float:
    """Return the luminous efficiency V(λ) of the eye in daylight, interpolated in its logarithm; SettingsError if
    the eye does not see the wavelength.
    """
    last_um = PHOTOPIC_FIRST_UM + PHOTOPIC_STEP_UM * (len(PHOTOPIC) - 1)
    if not PHOTOPIC_FIRST_UM <= wavelength_um <= last_um + 1e-9:
        raise SettingsError(
            f"optics.wavelength_um: found {wavelength_um:g}, which has no luminance; expected 0.38 to 0.78, or "
            "scene.photons_per_lux_s_um2"
        )
    step = (wavelength_um - PHOTOPIC_FIRST_UM) / PHOTOPIC_STEP_UM
    return float(np.exp(np.interp(step, np.arange(len(PHOTOPIC)), np.log(PHOTOPIC))))


def photons_per_lux_s_um2(sensor: Sensor) -> float:
    """Return the photons that a lux brings to a µm² in a second: of the scene, or of monochromatic light."""
    assert sensor.scene is not None  # every sensor with photons has one
    if sensor.scene.photons_per_lux_s_um2 is not None:
        return sensor.scene.photons_per_lux_s_um2
    wavelength_um = sensor.optics.wavelength_um
    assert wavelength_um is not None  # checked by `Sensor`
    watt_per_um2 = 1e-12 / (LUMENS_PER_WATT * photopic_efficiency(wavelength_um))
    return watt_per_um2 * wavelength_um / PHOTON_ENERGY_J_UM


def background_electrons(sensor: Sensor) -> float:
    """Return the mean electrons that the background's light frees in a pixel in one exposure. SettingsError if the
    light has no luminance at the wavelength, the electrons are too many, or the full well lies below the scene.
    """
    photons, scene = sensor.photons, sensor.scene
    assert photons is not None and scene is not None  # every sensor with photons has one
    electrons = scene.background_electrons
    if electrons is None:
        electrons = _electrons_of_light(sensor)
    if not electrons + photons.dark_electrons <= MOST_ELECTRONS:
        raise SettingsError(
            f"scene: the background gives {electrons:.4g} electrons in a pixel, and the dark current "
            f"{photons.dark_electrons:.4g}, expected at most {MOST_ELECTRONS:g} together; are light, exposure_ms "
            "and pitch in their units?"
        )
    if electrons + photons.dark_electrons >= photons.saturation_electrons:
        light = "" if scene.background_electrons else f" of {scene.background_cd_m2:.4g} cd/m²"
        raise SettingsError(
            f"noise.full_well_electrons: a pixel saturates at {photons.saturation_electrons:.4g} electrons, and "
            f"the background{light} gives {electrons:.4g} with "
            f"{photons.dark_electrons:.4g} of the dark current; expected fewer: a shorter exposure, a larger "
            "f-number or less light"
        )
    return electrons


def _electrons_of_light(sensor: Sensor) -> float:
    """Return the electrons of the background by lens, light and quantum efficiency. The illuminance of its image
    is π·τ·L / (4 N²), for a distant scene behind a good lens; EMVA 1288 has 4 N² + 1 in its place.
    """
    photons, optics = sensor.photons, sensor.optics
    assert photons is not None and sensor.scene is not None and optics.focal_length_mm is not None
    assert sensor.aperture_mm is not None and photons.quantum_efficiency is not None  # checked by `Sensor`
    f_number = optics.focal_length_mm / sensor.aperture_mm
    image_lx = math.pi * optics.transmission * sensor.scene.background_cd_m2 / (4.0 * f_number**2)
    pitch_um = sensor.pitch_mrad * optics.focal_length_mm
    of_light = photons_per_lux_s_um2(sensor) * image_lx * pitch_um**2
    return float(photons.quantum_efficiency * of_light * photons.exposure_ms / 1000.0)
