"""The eye: its pupil in a light, the MTF that goes with it, and people's sensitivity in dim and bright light.

Pupil and MTF are the authors' own averages over published data: Watson & Yellott 2012, *A unified formula for
light-adapted pupil size*, J. Vision 12(10):12; Watson 2013, *A formula for the mean human optical modulation
transfer function as a function of pupil size*, J. Vision 13(6):18.

The equations and parameters of the sensitivity are those of the achromatic, sustained channel of castleCSF
(Ashraf et al. 2024, J. Vision 24(4):5), published with its data under the MIT licence:
github.com/gfxdisp/castleCSF, CSF_stelaCSF_lum_peak.m with the parameters of CSF_castleCSF.m, Copyright (c) 2023
Graphics and Displays group, University of Cambridge.
"""

from __future__ import annotations

import math

import numpy as np

from todframes.base._typing import FloatArray
from todframes.observers.interface import MODELFEST_CD_M2, REFERENCE_AGE_YEARS, EyeSettings

FIELD_DEG2 = 400.0
"""Area of the field to which the eye is adapted: 20° by 20°, a display on a desk. Ten times as much makes a pupil
at 30 cd/m² 1.1 mm narrower."""

WAVELENGTH_NM = 555.0

MRAD_PER_DEG = math.radians(1000.0)


def pupil_of(settings: EyeSettings) -> float:
    """Return the diameter of the pupil that settings name, or that follows from their light and age, in mm."""
    if settings.pupil_mm is not None:
        return settings.pupil_mm
    return pupil_diameter_mm(settings.known_luminance, age_years=settings.age_years)


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


def sensitivity_ratio(
    frequency_cyc_per_deg: FloatArray, *, luminance_cd_m2: float, pupil_mm: float | None = None
) -> FloatArray:
    """Compute the sensitivity to a frequency in this light, over that at 30 cd/m² with a natural pupil. The
    default pupil is that of the people of the formula, in this light. Ashraf et al. 2024, achromatic sustained
    channel without flicker; its dependence on the stimulus' area cancels. Another pupil lets in the light of
    another luminance, through other optics.
    """
    optics: FloatArray | float = 1.0
    if pupil_mm is not None:
        luminance_cd_m2 = _equivalent_luminance(luminance_cd_m2, pupil_mm)
        natural = eye_mtf(frequency_cyc_per_deg, pupil_mm=pupil_diameter_mm(luminance_cd_m2))
        own = eye_mtf(frequency_cyc_per_deg, pupil_mm=pupil_mm)
        # Beyond the limit of diffraction there is nothing to see, however wide the pupil.
        optics = np.divide(own, natural, out=np.zeros_like(own), where=natural > 0.0)
    ratio = _sensitivity(frequency_cyc_per_deg, luminance_cd_m2) / _sensitivity(
        frequency_cyc_per_deg, MODELFEST_CD_M2
    )
    return np.asarray(ratio * optics)


def _equivalent_luminance(luminance: float, pupil_mm: float) -> float:
    """Return the luminance that lights the retina as much through its natural pupil, by iteration. A step leaves
    less than a third of the error, since the area of a pupil falls as L^-0.3 at most.
    """
    equivalent = luminance
    for _ in range(40):
        equivalent = luminance * (pupil_mm / pupil_diameter_mm(equivalent)) ** 2
    return equivalent


def _sensitivity(frequency: FloatArray, luminance: float) -> FloatArray:
    peak = (
        56.4947
        * (1.0 + 7.54726 / luminance) ** -0.144532
        * -math.expm1(-9.66862e9 * math.log1p(5.58341e-7 / luminance))
    )
    peak_frequency = 1.78119 * (1.0 + 91.5718 / luminance) ** -0.256682
    octaves = np.log10(np.maximum(frequency, 1e-6) / peak_frequency)
    parabola = 10.0 ** (-(octaves**2) / 2.0**0.000213047)
    return np.asarray(peak * np.where(octaves < 0.0, np.maximum(parabola, 1.0 - 0.100207), parabola))
