"""Sensitivity of people in dim and bright light, relative to that in the light of ModelFest.

The equations and parameters of the sensitivity are those of the achromatic, sustained channel of castleCSF
(Ashraf et al. 2024, J. Vision 24(4):5), published with its data under the MIT licence:
github.com/gfxdisp/castleCSF, CSF_stelaCSF_lum_peak.m with the parameters of CSF_castleCSF.m, Copyright (c) 2023
Graphics and Displays group, University of Cambridge.
"""

from __future__ import annotations

import math

import numpy as np

from todframes.base._typing import FloatArray
from todframes.observers.eye import eye_mtf, pupil_diameter_mm
from todframes.observers.interface import MODELFEST_CD_M2


def sensitivity_ratio(
    frequency_cyc_per_deg: FloatArray, *, luminance_cd_m2: float, pupil_mm: float | None = None
) -> FloatArray:
    """Compute the sensitivity to a frequency in this light, over that at 30 cd/m² with a natural pupil. The
    default pupil is that of the people of the formula, in this light.

    Ashraf et al. 2024, achromatic sustained channel without flicker; its dependence on the stimulus' area cancels.
    Another pupil lets in the light of another luminance, through other optics (`eye.eye_mtf`).
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
    """Return the luminance that lights the retina as much through its natural pupil, by iteration.

    A step leaves less than a third of the error, since the area of a pupil falls as L^-0.3 at most.
    """
    found = luminance
    for _ in range(40):
        found = luminance * (pupil_mm / pupil_diameter_mm(found)) ** 2
    return found


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
