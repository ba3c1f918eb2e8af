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

MODELFEST_CD_M2 = 30.0
"""Luminance of the displays of ModelFest."""

LEAST_CD_M2, MOST_CD_M2 = 0.02, 300.0
"""Range of luminance for which sensitivity is scaled."""


def sensitivity_ratio(frequency_cyc_per_deg: FloatArray, *, luminance_cd_m2: float) -> FloatArray:
    """Compute the sensitivity to a frequency in this light, over that at 30 cd/m².

    Parameters
    ----------
    frequency_cyc_per_deg : ndarray, any shape
        Radial spatial frequency, >= 0.
    luminance_cd_m2 : float
        Background, > 0.

    Returns
    -------
    ndarray, same shape
        1 at 30 cd/m².

    Ashraf et al. 2024, achromatic sustained channel without flicker; its dependence on the stimulus' area cancels.
    """
    return _sensitivity(frequency_cyc_per_deg, luminance_cd_m2) / _sensitivity(
        frequency_cyc_per_deg, MODELFEST_CD_M2
    )


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
