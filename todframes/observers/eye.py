"""The optics of the eye: the diameter of the pupil in a light, and the MTF that goes with it.

Both are the authors' own averages over published data: Watson & Yellott 2012, *A unified formula for
light-adapted pupil size*, J. Vision 12(10):12; Watson 2013, *A formula for the mean human optical modulation
transfer function as a function of pupil size*, J. Vision 13(6):18.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from todframes.base._typing import FloatArray
from todframes.observers.interface import REFERENCE_AGE_YEARS, known_luminance

FIELD_DEG2 = 400.0
"""Area of the field to which the eye is adapted: 20° by 20°, a display on a desk. Ten times as much makes a pupil
at 30 cd/m² 1.1 mm narrower."""

WAVELENGTH_NM = 555.0

MRAD_PER_DEG = math.radians(1000.0)


def pupil_of(settings: Any) -> float:
    """Return the diameter of the pupil that settings name, or that follows from their light and age, in mm."""
    if settings.pupil_mm is not None:
        return float(settings.pupil_mm)
    return pupil_diameter_mm(known_luminance(settings), age_years=settings.age_years)


def pupil_diameter_mm(
    luminance_cd_m2: float, *, age_years: float = REFERENCE_AGE_YEARS, field_deg2: float = FIELD_DEG2
) -> float:
    """Compute the mean diameter of the pupils of two eyes adapted to a light: 7.75 mm in the dark to 2, at the
    reference age. Watson & Yellott 2012, with the formula of Stanley & Davies 1995.
    """
    flux = (luminance_cd_m2 * field_deg2 / 846.0) ** 0.41
    at_reference_age = 7.75 - 5.75 * flux / (flux + 2.0)
    return float(at_reference_age + (age_years - REFERENCE_AGE_YEARS) * (0.02132 - 0.009562 * at_reference_age))


def eye_mtf(frequency_cyc_per_deg: FloatArray, *, pupil_mm: float) -> FloatArray:
    """Compute the mean MTF of the optics of young, well-corrected eyes in white light; 0 at and beyond the limit
    of diffraction. The formula was fitted to pupils of 2 to 6 mm. Watson 2013.
    """
    scale = 21.95 - 5.512 * pupil_mm + 0.3922 * pupil_mm**2
    cut_off = pupil_mm * math.pi * 1e6 / (WAVELENGTH_NM * 180.0)
    share = np.minimum(frequency_cyc_per_deg / cut_off, 1.0)
    diffraction = 2.0 / math.pi * (np.arccos(share) - share * np.sqrt(1.0 - share**2))
    root = np.sqrt(np.maximum(diffraction, 0.0))  # rounding at the limit
    return np.asarray((1.0 + (frequency_cyc_per_deg / scale) ** 2) ** -0.62 * root)
