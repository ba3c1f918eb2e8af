"""Probability that each of four noisy scores is the largest: the observer's decision without drawing noise.

Four Gaussian scores are the vertices of a tetrahedron whose edges are the standard deviations of their
differences. Answer k wins when its three differences from the others are positive, which is a trivariate
normal orthant Φ₃(b; R): b is the three mean differences in standard deviations, and the correlations in R are
the cosines of the angles θ at vertex k between the edges to the other three.

Φ₃ comes from Plackett's identity (Plackett 1954; Genz 2004, eq. 9), ∂Φ₃/∂ρ₁₂ = φ₂(b₁, b₂; ρ₁₂)·Φ(u₃), integrated
from independence, θ = π/2, to R. All three correlations move together, along a straight line in the
*angles*, for three reasons:

- φ₂ dρ = exp(−E) dθ / 2π has no singularity when ρ → ±1;
- valid sets of angles form a solid with four flat faces, θ₁₂ + θ₁₃ + θ₂₃ ≤ 2π and each θ at most the sum of
  the others, so a straight line from its middle never leaves it; and with s the half-sum, the determinant
  4 sin(s) sin(s − θ₁₂) sin(s − θ₁₃) sin(s − θ₂₃) is a product that keeps its digits when R is singular;
- where no correlation is negative no term is negative, and an improbable answer is right relatively.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import checked

_ANSWERS = np.arange(4)[:, None]
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Pairs of three other scores: pair i, j has index i + j − 1, and the score that is not in it is 2 minus that."""

_FIRST = OTHERS[:, [pair[0] for pair in PAIRS]]
_SECOND = OTHERS[:, [pair[1] for pair in PAIRS]]
_ROUNDING = 1e-10

# Each of the three others with the pairs it is in.
_SIDES = ((0, 0, 1), (1, 0, 2), (2, 1, 2))

# exp(−40²/2) and Φ(−40) are zero in double precision: a difference beyond 40 σ is certain.
_CERTAIN = 40.0

# Gauss–Legendre nodes t with 1 − x = t⁶, x the place on the path: against 400 nodes the worst error over singular,
# nearly singular and badly scaled covariances is 9e-9 with 64, 2e-10 with 96 and 9e-12 with 128 nodes.
_NODES = 128

# Where all four distances of the angles from the faces exceed 0.05, as those of the triangles do, 48 nodes are as
# good: over 1500 random covariances both differ from 200 nodes by 5e-15 at most.
_FAR_FROM_SINGULAR, _FEWER_NODES = 0.05, 48

_GRADING = 6

# Error of n Gauss–Legendre nodes on the path itself, over the rate ρ^(−2n) that its nearest singularity gives: the
# largest over 50,000 random covariances, down to errors of 1e-12, was 18.
_OVER_RATE = 20.0

# Keeps the arrays of one chunk (chunk × 4 answers × nodes) in the processor's cache.
_CHUNK = 64
_CHUNK_VALUES = 4 * _CHUNK * 24


@checked
def answer_probabilities(
    score: ArrayLike, covariance: ArrayLike | None = None, *, factor: ArrayLike | None = None
) -> FloatArray:
    """Compute the probability that each of four noisy scores is the largest.

    Parameters
    ----------
    score : array_like, shape (..., 4)
        Mean scores; only their differences matter.
    covariance : array_like, shape (..., 4, 4)
        Covariance of the Gaussian noise on the scores, symmetric and positive semi-definite, of any rank,
        broadcast against `score`. If you compute it from templates, subtract their mean first: otherwise the
        differences lose digits.
    factor : array_like, shape (..., 4, n)
        Used instead of `covariance`, which is the inner products of these rows: templates, for instance. Only
        their differences matter. These keep the digits that a covariance of nearly equal templates has lost.

    Returns
    -------
    ndarray, shape (..., 4)
        Non-negative, with sum 1. Scores without noise between them are compared exactly; equal ones share.

        The absolute error is below 1e-9, for the covariance as it was rounded: the distance between two
        templates that differ by less than 1e-6 of what they have in common has lost digits in it.

        The largest answer is 1 minus the others, so the probability of an error is the sum of the others; it is
        right to 6 digits down to 1e-30. So is each of them wherever the score differences that decide it are not
        negatively correlated.

    Raises
    ------
    SettingsError
        A ValueError, for a wrong shape, a value that is not finite, a matrix that is not a covariance, or noise
        that is given in both ways or none.

    Examples
    --------
    >>> import numpy as np
    >>> import todframes as tod
    >>> tod.answer_probabilities([1.0, 0.0, 0.0, 0.0], np.eye(4)).round(4)
    array([0.552 , 0.1493, 0.1493, 0.1493])
    """
    if (covariance is None) == (factor is None):
        raise SettingsError("noise: found both or none of covariance and factor, expected one of them")
    noise = checked_factor(factor) if factor is not None else checked_covariance(np.asarray(covariance))
    measured = of_covariance if factor is None else of_factor
    scores = _checked_score(score)
    shape = np.broadcast_shapes(scores.shape[:-1], noise.shape[:-2])
    scores = np.broadcast_to(scores, (*shape, 4)).reshape(-1, 4)
    own_shape = noise.shape[-2:]
    if one_for_all := math.prod(noise.shape[:-2]) == 1:
        geometry = _geometry(*measured(noise.reshape(1, *own_shape)))
    else:
        noise = np.broadcast_to(noise, (*shape, *own_shape)).reshape(-1, *own_shape)

    probability = np.empty_like(scores)
    for start in range(0, len(scores), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        if not one_for_all:
            geometry = _geometry(*measured(noise[chunk]))
        probability[chunk] = _chunk_probabilities(scores[chunk], geometry)
    return probability.reshape(*shape, 4)


def answer_probability(
    score: ArrayLike, covariance: ArrayLike, answer: int, *, tolerance: float = 0.0
) -> FloatArray:
    """Compute the probability that one of four noisy scores is the largest, (...), at a quarter of the cost of all
    four.

    Score and covariance are as for `answer_probabilities`. Scores that differ along their last but one axis only
    share the work that a covariance causes, if it has no such axis or one of length 1. With a `tolerance`, an
    absolute error, fewer nodes of the integral do, unless the covariance is nearly singular; otherwise the error
    is below 1e-9, also of the small rest near 1.

    The integrand is analytic but where a face's distance, (1 − x) π/4 + x d on the path x, is 0. The nearest such
    place, x = 1 / (1 − 4d/π), gives n nodes an error that falls as ρ^(−2n), ρ = (1 + √(4d/π)) / (1 − √(4d/π))
    (Trefethen 2008, theorem 4.5); 20 ρ^(−2n) held for all covariances tried. So 6 nodes give 1e-8 and 4 give 1e-5
    for large triangles, d = 0.5, while d = 0.02 takes 35 and 24.
    """
    scores, covariances = _checked_score(score), checked_covariance(covariance)
    shape = np.broadcast_shapes(scores.shape[:-1], covariances.shape[:-2])
    scores = np.broadcast_to(scores, (*shape, 4))
    # Scores along the last axis often share a covariance, and with it most of the work; or all scores share one.
    if covariances.ndim == 2:
        covariances, scores = covariances[None], scores.reshape(1, -1, 4)
    elif shape and covariances.shape[-3] == 1:
        covariances = np.broadcast_to(covariances[..., 0, :, :], (*shape[:-1], 4, 4)).reshape(-1, 4, 4)
        scores = scores.reshape(len(covariances), -1, 4)
    else:
        covariances = np.broadcast_to(covariances, (*shape, 4, 4)).reshape(-1, 4, 4)
        scores = scores.reshape(-1, 1, 4)
    own = slice(answer, answer + 1)
    nodes = None
    if tolerance > 0.0:
        # Matrices that few nodes are enough for do not need extended precision either.
        deviation, angle = of_covariance(covariances, own, extended=False)
        nodes = _sufficient_nodes(angle, tolerance)
    if nodes is None:
        deviation, angle = of_covariance(covariances, own)
    by_column = scores.swapaxes(0, 1)
    probability = np.empty(by_column.shape[:2])
    at_once = _CHUNK_VALUES // (nodes or _NODES)
    n_rows = max(at_once // len(by_column), 1)
    n_columns = max(at_once // n_rows, 1)
    for first in range(0, len(covariances), n_rows):
        rows = slice(first, first + n_rows)
        geometry = _geometry(deviation[rows], angle[rows], nodes)
        for start in range(0, len(by_column), n_columns):
            columns = slice(start, start + n_columns)
            probability[columns, rows] = _shared_orthants(by_column[columns, rows], geometry, own)[..., 0]
    return probability.T.reshape(shape)


def _sufficient_nodes(angle: FloatArray, tolerance: float) -> int | None:
    """Return how many nodes give all these angles an absolute error; None if only the graded path does."""
    root = math.sqrt(min(_face_distances(angle).min(initial=math.pi / 4.0) / (math.pi / 4.0), 0.99))
    if root == 0.0:
        return None
    rate = 2.0 * (math.log1p(root) - math.log1p(-root))
    nodes = max(math.ceil(math.log(_OVER_RATE / tolerance) / rate), 1)
    return nodes if nodes < _FEWER_NODES else None


def _chunk_probabilities(score: FloatArray, geometry: _Geometry) -> FloatArray:
    probability = _shared_orthants(score, geometry, slice(None))
    likeliest = probability.argmax(axis=-1)[:, None]
    np.put_along_axis(probability, likeliest, 0, axis=-1)
    np.put_along_axis(probability, likeliest, 1 - probability.sum(axis=-1, keepdims=True), axis=-1)
    return probability


def _shared_orthants(score: FloatArray, geometry: _Geometry, answers: slice) -> FloatArray:
    """Compute each of these answers by its own orthant; scores that are equal and without noise share."""
    with np.errstate(over="ignore"):
        difference = score[..., answers, None] - score[..., OTHERS[answers]]
        limit = np.where(difference >= 0, np.inf, -np.inf)
        noisy = np.broadcast_to(geometry.deviation > 0, difference.shape)
        np.divide(difference, geometry.deviation, out=limit, where=noisy)
    shares = 1 + np.count_nonzero(~noisy & (difference == 0), axis=-1)
    return np.asarray(np.clip(_orthant(np.clip(limit, -_CERTAIN, _CERTAIN), geometry), 0, 1) / shares)


def _orthant(limit: FloatArray, geometry: _Geometry) -> FloatArray:
    """Compute Φ₃ of the limits b (..., answer, 3) by Plackett's identity, from independence on."""
    b = limit[..., None]
    probability: FloatArray = ndtr(limit).prod(axis=-1)
    for pair, (i, j) in enumerate(PAIRS):
        # (b_i² − 2ρ b_i b_j + b_j²) / 2(1 − ρ²) without cancellation.
        exponent = (limit[..., i, None] + limit[..., j, None]) ** 2 * geometry.sum_factor[:, :, pair]
        exponent += (limit[..., i, None] - limit[..., j, None]) ** 2 * geometry.difference_factor[:, :, pair]
        cut = geometry.cut[:, :, pair]
        u = b[..., 0, :] * cut[..., 0, :]
        u += b[..., 1, :] * cut[..., 1, :]
        u += b[..., 2, :] * cut[..., 2, :]
        density = np.exp(np.negative(exponent, out=exponent), out=exponent)
        density *= ndtr(u)
        density *= geometry.weight[:, :, pair]
        probability += density.sum(axis=-1)
    return probability


class _Geometry(NamedTuple):
    """Terms of Plackett's integral that the covariances determine; leading axes: matrix, answer. The `sum_factor`,
    `difference_factor` and `weight` of each pair of others, and the `cut` of its conditional limit u with each of
    the three limits b, are sampled at the nodes of the path (last axis).
    """

    deviation: FloatArray  # (matrix, answer, 3) of the differences from the others
    sum_factor: FloatArray  # (matrix, answer, pair, node)
    difference_factor: FloatArray
    weight: FloatArray
    cut: FloatArray  # (matrix, answer, pair, limit, node)


def _face_distances(angle: FloatArray) -> FloatArray:
    """Compute the distances of the angles from the four faces, s − θ and π − s: (matrix, answer, 4). All are π/4
    at independence, rounding must not carry them beyond a face at the end, and every angle is the sum of two of
    them.
    """
    half_sum = angle.sum(axis=-1, keepdims=True) / 2
    distance = np.maximum(np.concatenate([half_sum - angle, np.pi - half_sum], axis=-1), 0)
    distance *= np.pi / distance.sum(axis=-1, keepdims=True)
    return np.asarray(distance)


def _geometry(deviation: FloatArray, angle: FloatArray, nodes: int | None = None) -> _Geometry:
    """Compute the geometry at so many nodes; None: at as many on the graded path as the angles need."""
    end = _face_distances(angle)[..., None]
    grading = 1
    if nodes is None:
        nodes = _FEWER_NODES if end.min() > _FAR_FROM_SINGULAR else _NODES
        grading = _GRADING
    left, node_weight = _path_nodes(nodes, grading)
    face = left * (np.pi / 4) + (1 - left) * end
    # The four add up to π: where one is near π, its sine is that of the sum of the others, which keeps the digits.
    sum_of_others = face[..., [1, 0, 0, 0], :] + face[..., [2, 2, 1, 1], :] + face[..., [3, 3, 3, 2], :]
    sine = np.sin(np.minimum(face, sum_of_others))
    root_determinant = 2 * np.sqrt(sine.prod(axis=-2))
    # partial[i] = ρ_jk − ρ_ij ρ_ik for the three others i, j, k.
    partial = np.stack(
        [sine[..., 3, :] * sine[..., 2 - i, :] - sine[..., q, :] * sine[..., r, :] for i, q, r in _SIDES], axis=-2
    )
    half_open = np.sin((face[..., :3, :] + face[..., 3:, :]) / 2)
    half_closed = np.sin((face[..., [1, 0, 0], :] + face[..., [2, 2, 1], :]) / 2)
    sine_angle = 2 * half_open * half_closed

    cut = np.empty((*sine_angle.shape[:-1], 3, len(left)))
    for pair, (i, j) in enumerate(PAIRS):
        scale = sine_angle[..., pair, :] * root_determinant
        cut[..., pair, 2 - pair, :] = sine_angle[..., pair, :] / root_determinant
        cut[..., pair, i, :] = -partial[..., j, :] / scale
        cut[..., pair, j, :] = -partial[..., i, :] / scale
    return _Geometry(
        deviation=deviation,
        sum_factor=1 / (8 * half_open**2),
        difference_factor=1 / (8 * half_closed**2),
        weight=(np.pi / 2 - end[..., [1, 0, 0], :] - end[..., [2, 2, 1], :]) * node_weight / (2 * np.pi),
        cut=cut,
    )


@cache
def _path_nodes(nodes: int, grading: int) -> tuple[FloatArray, FloatArray]:
    """Return the rest 1 − x = t^grading of the path at nodes t, and their weights. Graded, they are dense on every
    scale where R may become singular.
    """
    node, weight = np.polynomial.legendre.leggauss(nodes)
    t = (1 + node) / 2
    graded = weight * t ** (grading - 1)
    return t**grading, graded / graded.sum()  # numpy's weights add up to 1e-14 only


def of_covariance(
    covariance: FloatArray, answers: slice = slice(None), *, extended: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Compute the edges from some scores to the three others, in the order of `OTHERS`, and the angles between
    them, in that of `PAIRS`, (matrix, answers, 3) each, of checked covariances (matrix, 4, 4). The angle is
    Kahan's, from the three edges of a face, so that slender faces keep their digits. A rounding of 1e-16 in the
    covariance can turn it by 1e-8: hence `extended` precision (where the platform has it) for matrices that are
    nearly singular, and a face whose area is lost in that rounding, though its edges are not, is taken as flat.
    """
    own, first, second = _ANSWERS[answers], _FIRST[answers], _SECOND[answers]
    exact: NDArray[Any] = covariance.astype(np.longdouble) if extended else covariance
    variance = np.diagonal(exact, axis1=-2, axis2=-1)
    square = (variance[:, :, None] - exact) + (variance[:, None, :] - exact)
    square = np.maximum(square, 0)
    edge = np.sqrt(square)
    a, b, c2 = edge[:, own, first], edge[:, own, second], square[:, first, second]
    a2, b2 = square[:, own, first], square[:, own, second]
    beyond_closed = np.maximum(c2 - (a - b) ** 2, 0)
    beyond_open = np.maximum((a + b) ** 2 - c2, 0)
    slender = 2 * np.arctan2(np.sqrt(beyond_closed), np.sqrt(beyond_open))
    common = (variance[:, answers, None] - exact[:, own, first]) + (
        exact[:, first, second] - exact[:, own, second]
    )
    cosine = np.divide(common, a * b, out=np.ones_like(a), where=(a > 0) & (b > 0))
    angle = np.where(np.abs(cosine) < 0.7, np.arccos(np.clip(cosine, -1, 1)), slender)

    rounding = np.finfo(np.float64).eps * (variance[:, :, None] + variance[:, None, :])
    rounding_a, rounding_b = rounding[:, own, first], rounding[:, own, second]
    rounding_c = rounding[:, first, second]
    area_rounding = 2 * (  # of 16 area², to first order in the squared edges
        np.abs(b2 + c2 - a2) * rounding_a + np.abs(a2 + c2 - b2) * rounding_b + np.abs(a2 + b2 - c2) * rounding_c
    )
    edges_known = (a2 > 64 * rounding_a) & (b2 > 64 * rounding_b) & (c2 > 64 * rounding_c)
    flat = edges_known & (beyond_closed * beyond_open <= area_rounding)
    angle = np.where(flat, np.where(c2 > a2 + b2, np.pi, 0), angle)
    angle = np.where((a == 0) | (b == 0), np.pi / 2, angle)
    return edge[:, own, OTHERS[answers]].astype(np.float64), angle.astype(np.float64)


def of_factor(factor: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute edges and angles of checked factors, shape (matrix, 4, n), as `of_covariance` does. The angle is
    Kahan's between two vectors, which keeps its digits however small or flat it is.
    """
    difference = factor[:, :, None, :] - factor[:, OTHERS, :]
    largest = np.abs(difference).max(axis=-1, keepdims=True, initial=0.0)
    unit = np.divide(
        difference, largest, out=np.zeros_like(difference), where=largest > 0
    )  # squares may underflow
    length = np.sqrt(np.square(unit).sum(axis=-1, keepdims=True))
    unit = np.divide(unit, length, out=unit, where=length > 0)
    a, b = (unit[:, :, [pair[side] for pair in PAIRS]] for side in (0, 1))
    apart, together = (np.sqrt(np.square(c).sum(axis=-1)) for c in (a - b, a + b))
    angle = np.where((apart == 0) & (together == 0), np.pi / 2, 2 * np.arctan2(apart, together))
    return (largest * length)[..., 0], angle


def checked_covariance(covariance: ArrayLike) -> FloatArray:
    """Check a covariance of four scores, (..., 4, 4), and return it symmetric. SettingsError if it has a wrong
    shape, a value that is not finite or is no covariance.
    """
    covariances = np.asarray(covariance, dtype=np.float64)
    if covariances.ndim < 2 or covariances.shape[-2:] != (4, 4):
        raise SettingsError(f"covariance has shape {covariances.shape}, expected (..., 4, 4)")
    reject(~np.isfinite(covariances), covariances, "covariance", "finite numbers")
    asymmetry = np.abs(covariances - covariances.swapaxes(-2, -1)).max(axis=(-2, -1))
    largest = np.abs(covariances).max(axis=(-2, -1))
    reject(asymmetry > _ROUNDING * largest, asymmetry, "asymmetry of covariance", "a symmetric matrix")
    covariances = (covariances + covariances.swapaxes(-2, -1)) / 2
    eigenvalues = np.linalg.eigvalsh(covariances)
    negative = eigenvalues[..., 0] < -_ROUNDING * np.abs(eigenvalues).max(axis=-1)
    reject(negative, eigenvalues[..., 0], "smallest eigenvalue of covariance", "a positive semi-definite matrix")
    return covariances


def checked_factor(factor: ArrayLike) -> FloatArray:
    """Check a factor of such a covariance, (..., 4, n), and return it as an array."""
    rows = np.asarray(factor, dtype=np.float64)
    if rows.ndim < 2 or rows.shape[-2] != 4:
        raise SettingsError(f"factor has shape {rows.shape}, expected (..., 4, n)")
    reject(~np.isfinite(rows), rows, "factor", "finite numbers")
    return rows


def _checked_score(score: ArrayLike) -> FloatArray:
    scores = np.asarray(score, dtype=np.float64)
    if scores.ndim < 1 or scores.shape[-1] != 4:
        raise SettingsError(f"score has shape {scores.shape}, expected (..., 4)")
    reject(~np.isfinite(scores), scores, "score", "finite numbers")
    return scores


def reject(bad: NDArray[np.bool_], values: NDArray[Any], name: str, expected: str) -> None:
    """Raise SettingsError for the first of some values that is bad."""
    if bad.any():
        place = tuple(int(index) for index in np.argwhere(bad)[0])
        where = f"[{', '.join(map(str, place))}]" if place else ""
        raise SettingsError(f"{name}{where} is {values[place]:g}, expected {expected}")
