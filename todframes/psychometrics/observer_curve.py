"""The psychometric function of a linear observer: a choice among four Gaussian scores, and the model that fits it.

The right answer's score exceeds the others by d′ standard deviations on average. The observer is right with
probability P(d′) = ∫ φ(t − d′) Φ(t)³ dt, the largest of four independent scores. In frames of a fixed noise d′ is
proportional to the level x. Noise of the observer's own limits it where the level is a signal-to-noise ratio, and
so do places on the detectors where the triangle is not recognised: 1/d′² = (α/x)^2β + 1/d_max². The exponent β is
1 for linear chains; enhancement, gamma and clipping may change it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr

from todframes.base._typing import FloatArray
from todframes.psychometrics.likelihood import CurveModel

GUESS_RATE = 0.25
LARGEST_D_PRIME = 16.0
"""Largest d′; larger ones count as equal to it: an error has the probability 1e-29."""

SMALLEST_CEILING = 0.1
"""Smallest `max_d_prime` of a fit: P(right) is 0.28 at most."""

_KNOTS_PER_UNIT = 16


def observer_curve(level: ArrayLike, *, alpha: float, beta: float, max_d_prime: float | None) -> FloatArray:
    """Compute the proportion correct at levels >= 0, of any shape, in the unit of `alpha`. `alpha` > 0 is the
    level where d′ would be 1 without a limit, `beta` > 0 the exponent, `max_d_prime` the limit of d′ at high
    levels, None for no limit.
    """
    with np.errstate(over="ignore", divide="ignore"):
        inverse_square = (np.asarray(level, dtype=np.float64) / alpha) ** (-2.0 * beta)
        inverse_square = inverse_square + (0.0 if max_d_prime is None else max_d_prime**-2.0)
        d_prime = 1.0 / np.sqrt(inverse_square)
    ln_wrong, _ = _ln_wrong(d_prime)
    return np.asarray(-np.expm1(ln_wrong))


@cache
def _cubics() -> FloatArray:
    """Return the cubics of ln P(wrong) between knots in d′, (power, piece), in units of the distance of the knots.
    They have the values and slopes of the integral, a sum over steps of 0.1 in t that is exact to rounding for
    functions this smooth. Halving the distance of the knots moves no P by more than 1e-8.
    """
    d_prime = np.arange(LARGEST_D_PRIME * _KNOTS_PER_UNIT + 1)[:, None] / _KNOTS_PER_UNIT
    t = np.arange(-LARGEST_D_PRIME - 10.0, 10.0, 0.1)
    density = np.exp(-(t**2) / 2.0)
    others, own = ndtr(-(t + d_prime)), ndtr(t + d_prime)
    wrong = density * others * (1.0 + own + own**2)  # 1 − Φ³ without cancellation
    slope = -3.0 * density * own**2 * np.exp(-((t + d_prime) ** 2) / 2.0) / math.sqrt(2.0 * math.pi)
    scale = 0.1 / math.sqrt(2.0 * math.pi)
    value, slope = np.log(scale * wrong.sum(axis=1)), slope.sum(axis=1) / wrong.sum(axis=1) / _KNOTS_PER_UNIT
    rise = np.diff(value)
    powers = [value[:-1], slope[:-1], 3 * rise - 2 * slope[:-1] - slope[1:], slope[:-1] + slope[1:] - 2 * rise]
    return np.stack(powers)


def _ln_wrong(d_prime: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute ln P(wrong) and its derivative at d′ >= 0; the derivative is 0 from `LARGEST_D_PRIME` on."""
    place = np.minimum(d_prime, LARGEST_D_PRIME) * _KNOTS_PER_UNIT
    piece = np.minimum(place.astype(np.intp), int(LARGEST_D_PRIME) * _KNOTS_PER_UNIT - 1)
    u = place - piece
    a, b, c, d = (power.take(piece) for power in _cubics())
    value = a + u * (b + u * (c + u * d))
    slope = np.where(d_prime < LARGEST_D_PRIME, (b + u * (2 * c + 3 * u * d)) * _KNOTS_PER_UNIT, 0.0)
    return value, slope


@cache
def d_prime_of(p_correct: float) -> float:
    """Return the d′ at a proportion correct < 1; 0 at the guess rate and below."""
    low, high = 0.0, LARGEST_D_PRIME
    # Each step halves the range: 60 of them leave 16 / 2^60, a rounding.
    for _ in range(60):
        middle = (low + high) / 2
        is_above = -math.expm1(float(_ln_wrong(np.array(middle))[0])) > p_correct
        low, high = (low, middle) if is_above else (middle, high)
    return low


@dataclass(frozen=True, slots=True)
class ObserverModel(CurveModel):
    """Model of the observer's curve: parameters `theta` are (ln α about the centre, ln β, 1/d_max²)."""

    start_offsets = (0.0, -1.0, 1.0)
    is_convention = False

    def curves(self, theta: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Compute P(right), P(wrong), (curve, level), and the first's derivative, (parameter, curve, level)."""
        location, ln_slope, limit = (theta[:, k, None] for k in range(3))
        slope = np.exp(ln_slope)
        offset = slope * (z - location)
        # The bounds keep all powers below within the range of numbers; d′ beyond them is 0 or `LARGEST_D_PRIME`.
        by_level = np.exp(-2.0 * np.clip(offset, -100.0, 100.0))
        d_prime = 1.0 / np.sqrt(by_level + limit)
        ln_wrong, d_ln_wrong = _ln_wrong(d_prime)
        wrong = np.exp(ln_wrong)
        # −dP(wrong)/dd′ · d′³, as every derivative of d′ has this power of it.
        change = -wrong * d_ln_wrong * (d_prime * d_prime * d_prime)
        jacobian = np.stack([-slope * by_level * change, offset * by_level * change, -change / 2.0])
        return -np.expm1(ln_wrong), wrong, jacobian

    def ln_threshold(self, theta: FloatArray) -> FloatArray:
        """Return the ln threshold of each curve, about the centre; +inf where it is never reached."""
        location, ln_slope, limit = theta.T
        d_prime = d_prime_of(self.p_correct)
        if d_prime == 0.0:
            return np.full(len(theta), -np.inf)
        left = d_prime**-2.0 - limit
        reached = left > 0
        return np.where(
            reached, location - np.log(np.where(reached, left, 1.0)) / (2.0 * np.exp(ln_slope)), np.inf
        )

    def ceiling(self, theta: FloatArray) -> float:
        """Return P(right) at the largest d′."""
        limit = float(theta[2])
        return -math.expm1(float(_ln_wrong(np.array(limit**-0.5 if limit else math.inf))[0]))

    def start_ceilings(self) -> FloatArray:
        """Return 1/d_max² of no limit, and of limits at which P(right) is 0.98 and 0.8."""
        return np.unique(np.clip([0.0, 0.1, 0.35], self.lower[2], self.upper[2]))
