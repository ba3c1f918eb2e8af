"""The Weibull psychometric function of people's answers, and the model that fits it.

Hogervorst et al. 2001, eq. 3: p(x) = (1 − δ) − (1 − δ − γ)·2^−(x/α)^β. In ln x the curve is a complementary
log-log model, ln(ln 2) + β·(ln x − ln α), with a guess and a lapse rate: that is what is fitted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.psychometrics.likelihood import CurveModel

_LN_LN2 = math.log(math.log(2.0))


def weibull(
    level: ArrayLike,
    *,
    alpha: float | FloatArray,
    beta: float | FloatArray,
    guess_rate: float,
    lapse_rate: float | FloatArray,
) -> FloatArray:
    """Compute the proportion correct at levels >= 0, of any shape, in the unit of `alpha`. `alpha` > 0 is the
    level at 1 − δ − (1 − δ − γ)/2, `beta` > 0 the slope, `guess_rate` γ and `lapse_rate` δ the floor and the
    distance of the ceiling from 1. Hogervorst et al. 2001, eq. 3.
    """
    with np.errstate(over="ignore"):
        exponent = (np.asarray(level, dtype=np.float64) / alpha) ** beta
    return np.asarray((1 - lapse_rate) - (1 - lapse_rate - guess_rate) * np.exp2(-exponent))


def weibull_level(
    p_correct: ArrayLike, *, alpha: float, beta: float, guess_rate: float, lapse_rate: float | FloatArray
) -> FloatArray:
    """Return the level of a raw proportion correct, the inverse of `weibull`: 0 up to γ, inf from 1 − δ on."""
    span = 1 - lapse_rate - guess_rate
    left = np.clip(1 - lapse_rate - np.asarray(p_correct, dtype=np.float64), 0.0, span)
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray(alpha * np.log2(span / left) ** (1 / beta))


@dataclass(frozen=True, slots=True)
class WeibullModel(CurveModel):
    """Model of the Weibull curve: parameters `theta` are (ln α about the centre, ln β, δ)."""

    start_offsets = (0.0, -2.0, 1.5)
    is_convention = True

    def curves(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute P(right), P(wrong), (curve, level), and the first's derivative, (parameter, curve, level)."""
        location, ln_slope, lapse_rate = (theta[:, k, None] for k in range(3))
        slope = np.exp(ln_slope)
        offset = slope * (z - location)
        # The bounds keep ln P(wrong) >= -500, so that no ratio below overflows; no datum distinguishes it from −∞.
        hazard = np.exp(np.clip(offset + _LN_LN2, -500.0, math.log(500.0)))
        miss = np.exp(-hazard)
        hit = -np.expm1(-hazard)
        span = 1 - self.guess_rate - lapse_rate
        d_offset = span * miss * hazard
        jacobian = np.stack([-slope * d_offset, offset * d_offset, -hit])
        return self.guess_rate + span * hit, lapse_rate + span * miss, jacobian

    def ln_threshold(self, theta: FloatArray) -> FloatArray:
        """Return the ln threshold of each curve, about the centre; +inf where the criterion is above 1 − δ."""
        location, ln_slope, lapse_rate = theta.T
        left = 1 - lapse_rate - self.p_correct
        span = 1 - lapse_rate - self.guess_rate
        reached = left > 0
        ln_log2 = np.log(np.log2(span / np.where(reached, left, span / 2)))
        return np.where(reached, location + ln_log2 / np.exp(ln_slope), np.inf)

    def ceiling(self, theta: FloatArray) -> float:
        """Return 1 − δ."""
        return 1.0 - float(theta[2])

    def start_ceilings(self) -> FloatArray:
        """Return lapse rates from the lower limit to the upper."""
        return np.unique(np.linspace(self.lower[2], self.upper[2], 3))
