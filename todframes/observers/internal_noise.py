"""Internal noise of many neurons, summed over the four scores: covariance and its Edgeworth correction."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtr, owens_t

from todframes.base._typing import FloatArray
from todframes.observers.decision import OTHERS, PAIRS

_Order = tuple[int, int, int]
_SQRT_2PI = math.sqrt(2.0 * math.pi)

_NEARLY_PLANE = 1e-6
"""Determinant of three differences' correlations below which two of them all but determine the third."""

Bands = tuple[FloatArray, ...]
"""Activity, or weights, of all neurons: arrays of any shape, the finest band first."""

UNIFORM_EXCESS_KURTOSIS = -1.2

LEAST_KURTOSIS = 2e-3
"""Smallest excess kurtosis that is not taken as Gaussian. A smaller one comes from so many neurons that their
fourth cumulants take more time than everything else, and it changes P(correct) by less than 1.4e-4."""


class SummedNoise(NamedTuple):
    """Noise summed in four score deviations, by the names of the attributes of `Readout`."""

    noise_covariance: FloatArray
    excess_kurtosis: float
    find_fourth_cumulants: Callable[[], FloatArray] | None


def summed_noise(
    upright: Bands, turned: Callable[[Bands, int], Bands], noise_sd: float, excess_kurtosis: float
) -> SummedNoise:
    """Sum independent noise of standard deviation `noise_sd` and an excess kurtosis, with the weights of template
    deviations: those of the upright triangle, `turned` by none to three quarters. Two of these are held at once.
    """
    products, participation = [sum(map(inner_product, upright, upright))], 0.0
    for quarter_turns in (1, 2):
        other = turned(upright, quarter_turns)
        products.append(sum(map(inner_product, upright, other)))
        if excess_kurtosis:
            participation = max(participation, _participation(upright, other))
    kurtosis = excess_kurtosis * participation

    def find_fourth_cumulants() -> FloatArray:
        rows = [np.concatenate([band.ravel() for band in turned(upright, turns)]) for turns in range(4)]
        return fourth_cumulants(noise_sd * np.array(rows), excess_kurtosis=excess_kurtosis)

    is_gaussian = abs(kurtosis) <= LEAST_KURTOSIS
    # A circulant matrix by symmetry.
    row = noise_sd**2 * np.array([*products, products[1]])
    covariance = np.array([np.roll(row, k) for k in range(4)])
    return SummedNoise(covariance, kurtosis, None if is_gaussian else find_fourth_cumulants)


def summed_variance(weights: Bands, noise_sd: float) -> float:
    """Compute the variance of noise of standard deviation `noise_sd`, independent, summed with these weights."""
    return noise_sd**2 * sum(map(inner_product, weights, weights))


def _participation(weights: Bands, others: Bands) -> float:
    """Compute Σw⁴ / (Σw²)² of the differences of weights; 0 if there are none."""
    squares = [np.square(a - b) for a, b in zip(weights, others, strict=True)]
    total = sum(float(band.sum()) for band in squares)
    if not total > 0.0:
        return 0.0
    for band in squares:
        band /= total
    return sum(map(inner_product, squares, squares))


def fourth_cumulants(factor: ArrayLike, *, excess_kurtosis: float) -> FloatArray:
    """Compute the fourth cumulants, (4, 4, 4, 4), of four scores that sum independent noise of many neurons.
    `factor`, (4, n), is the weight of each neuron's noise in each score times the noise's standard deviation,
    `excess_kurtosis` that of one neuron's noise; −1.2 if it is uniform.
    """
    rows = np.asarray(factor, dtype=np.float64)
    products = np.einsum("in,jn->ijn", rows, rows).reshape(16, -1)
    return np.asarray(excess_kurtosis * (products @ products.T).reshape(4, 4, 4, 4))


def edgeworth_correction(score: ArrayLike, covariance: ArrayLike, fourth_cumulant: ArrayLike) -> FloatArray:
    """Compute the correction of `answer_probabilities`, (..., 4) with sum 0, for the fourth cumulants of the
    noise, (..., 4, 4, 4, 4). Scores and covariances are as there. For the summed noise of the observer's neurons
    corrections leave errors below 8e-5 for triangles of 0.3 mrad, where the Gaussian is 2.6e-3 off, and below 8e-6
    at 1 mrad. They are 0 for answers that differ from another without noise, and where noise is all but in a
    plane: there the term is no approximation. The triangles' never is.
    """
    scores, covariances, cumulants = (
        np.asarray(a, dtype=np.float64) for a in (score, covariance, fourth_cumulant)
    )
    return np.stack([_of_answer(scores, covariances, cumulants, answer) for answer in range(4)], axis=-1)


def _of_answer(score: FloatArray, covariance: FloatArray, cumulant: FloatArray, answer: int) -> FloatArray:
    difference = np.eye(4)[answer] - np.eye(4)[OTHERS[answer]]
    variance = np.einsum("ia,jb,...ab->...ij", difference, difference, covariance)
    deviation = np.sqrt(np.maximum(np.diagonal(variance, axis1=-2, axis2=-1), 0.0))
    deviation = np.where(deviation > 0.0, deviation, np.inf)
    b = np.einsum("ia,...a->...i", difference, score) / deviation
    rho = variance / (deviation[..., :, None] * deviation[..., None, :])
    regular = np.linalg.det(rho) > _NEARLY_PLANE
    kappa = np.einsum("ia,jb,lc,md,...abcd->...ijlm", *[difference] * 4, cumulant, optimize=True)
    total: FloatArray = np.zeros(())
    for order, derivative in _fourth_derivatives(b, rho).items():
        axes = [axis for axis, count in enumerate(order) for _ in range(count)]
        of_order = kappa[..., *axes] / deviation[..., axes].prod(axis=-1)
        total = total + of_order * derivative / math.prod(map(math.factorial, order))
    return np.asarray(np.where(regular, total, 0.0))


def _fourth_derivatives(b: FloatArray, rho: FloatArray) -> dict[_Order, FloatArray]:
    """Compute ∂⁴Φ₃ of limits b (..., 3) with correlations rho (..., 3, 3), by the order in each limit."""
    limit = np.moveaxis(b, -1, 0)
    derivatives: dict[_Order, FloatArray] = {}
    mixed: dict[tuple[int, int], list[FloatArray]] = {}  # of i and j: ∂_i ∂_j, ∂_i² ∂_j, ∂_i³ ∂_j
    for i, j in PAIRS:
        k = 3 - i - j
        r, r_ik, r_jk = rho[..., i, j], rho[..., i, k], rho[..., j, k]
        precision = 1.0 / np.maximum(1.0 - r**2, _NEARLY_PLANE)
        gain = {i: (r_ik - r * r_jk) * precision, j: (r_jk - r * r_ik) * precision}
        left = np.sqrt(np.maximum(1.0 - gain[i] * r_ik - gain[j] * r_jk, _NEARLY_PLANE))
        u = (limit[k] - gain[i] * limit[i] - gain[j] * limit[j]) / left
        third, at_third = ndtr(u), _density(u)
        fall = {n: gain[n] / left for n in (i, j)}  # −∂u/∂b_n
        pull = {i: (limit[i] - r * limit[j]) * precision, j: (limit[j] - r * limit[i]) * precision}
        of_pair = np.exp(-(limit[i] * pull[i] + limit[j] * pull[j]) / 2.0) * np.sqrt(precision) / (2.0 * math.pi)
        for x, y in ((i, j), (j, i)):
            p, f = pull[x], fall[x]
            mixed[x, y] = [
                of_pair * third,
                -of_pair * (p * third + f * at_third),
                of_pair * ((p**2 - precision) * third + (2.0 * p - f * u) * f * at_third),
            ]
            derivatives[_order(x, x, x, y)] = mixed[x, y][2]
            derivatives[_order(x, x, y, k)] = of_pair * (f * u - p) * at_third / left
        derivatives[_order(i, i, j, j)] = of_pair * (
            (pull[i] * pull[j] + r * precision) * third
            + (pull[i] * fall[j] + pull[j] * fall[i] - fall[i] * fall[j] * u) * at_third
        )
    for i in range(3):
        j, k = (n for n in range(3) if n != i)
        by_i = [np.zeros(()), _density(limit[i]) * _both_below(limit, rho, i, j, k)]
        for n in range(3):  # Stein's identity, differentiated n times
            last, before = by_i[-1], by_i[-2]
            across = rho[..., i, j] * mixed[i, j][n] + rho[..., i, k] * mixed[i, k][n]
            by_i.append(-limit[i] * last - n * before - across)
        derivatives[_order(i, i, i, i)] = by_i[-1]
    return derivatives


def _both_below(limit: FloatArray, rho: FloatArray, i: int, j: int, k: int) -> FloatArray:
    """Compute P(j and k below their limits) with i at its limit."""
    r_ij, r_ik = rho[..., i, j], rho[..., i, k]
    left_j, left_k = (np.sqrt(np.maximum(1.0 - r**2, _NEARLY_PLANE)) for r in (r_ij, r_ik))
    partial = np.clip((rho[..., j, k] - r_ij * r_ik) / (left_j * left_k), -1.0, 1.0)
    return _bivariate((limit[j] - r_ij * limit[i]) / left_j, (limit[k] - r_ik * limit[i]) / left_k, partial)


def _bivariate(h: FloatArray, k: FloatArray, rho: FloatArray) -> FloatArray:
    """Compute Φ₂ by Owen's T function (Owen 1956)."""
    root = np.sqrt(np.maximum((1.0 - rho) * (1.0 + rho), _NEARLY_PLANE))
    h, k = (np.where(x == 0.0, 1e-300, x) for x in (h, k))
    with np.errstate(over="ignore"):
        beyond_h, beyond_k = (k - rho * h) / (h * root), (h - rho * k) / (k * root)
    below = (ndtr(h) + ndtr(k)) / 2.0 - owens_t(h, beyond_h) - owens_t(k, beyond_k)
    return np.asarray(below - np.where((h > 0.0) == (k > 0.0), 0.0, 0.5))


def _density(x: FloatArray) -> FloatArray:
    return np.asarray(np.exp(-(x**2) / 2.0) / _SQRT_2PI)


def _order(*limits: int) -> _Order:
    return limits.count(0), limits.count(1), limits.count(2)


def inner_product(a: FloatArray, b: FloatArray) -> float:
    """Sum the products of two arrays of one shape. The sum is taken row by row: BLAS divides the work on a longer
    vector between threads. These wait for each other a hundred times longer than the sum takes when other work
    keeps the processors busy.
    """
    return float(np.vecdot(a, b).sum())
