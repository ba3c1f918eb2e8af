"""Probability of each answer when the triangle may be at one of several places.

The observer has four scores at each place, takes the largest of all, and answers its orientation: it is right from
the triangle's own place, or by luck from another one. If the noise of the places is independent, this is one
integral over the largest score t: with g the density of a place's score being t and the place's other scores below
it, and F the probability that all four are below t, P(answer k) = Σ_m ∫ g_mk(t) Π_{n ≠ m} F_n(t) dt. The other
three scores of a place are a trivariate normal given the one that is t. If Q places have four independent scores
each, one of mean d′, P(correct) = ∫ φ(t − d′) Φ(t)^(4Q − 1) + (Q − 1) φ(t) Φ(t)^(4Q − 2) Φ(t − d′) dt.

If the noise of the places is correlated, the multivariate normal of all scores is drawn, the same draws for all
trials, and the largest is counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.observers.decision import OTHERS, PAIRS, checked_covariance, orthants

REACH = 6.5
"""Standard deviations around the largest mean within which the largest score is sought: 1e-10 lies beyond."""

NODES, MOST_NODES = 48, 160
"""Gauss–Legendre nodes within that reach, besides one for each place, and their largest number. Against twice as
many, P is within 1e-7 for 1 to 256 places."""

DRAWS = 1 << 17
"""Number of draws of the noise at correlated places: a probability has a standard error of 0.0014 or less."""

_DRAWN_AT_ONCE = 1 << 13
_AT_ONCE = 1 << 15


class PlaceProbabilities(NamedTuple):
    """Probabilities of the four answers, (..., 4), and their standard error; it is 0 if the places are
    independent, where the integral is right to 1e-7.
    """

    probability: FloatArray
    standard_error: FloatArray


def unknown_place_probabilities(
    score: ArrayLike, covariance: ArrayLike, *, empty_places: int = 0
) -> PlaceProbabilities:
    """Compute the probability of each answer by the largest of the scores of all places, (..., place, 4). Unlike
    for a known place, the part that the four scores of a place have in common matters. The covariance is that of
    the Gaussian noise on the scores of a place, (4, 4), the same at all places, which are then independent; or the
    joint one, (place, 4, place, 4). `empty_places` more have mean scores of 0, if all are independent.
    SettingsError if a shape or value is wrong, a matrix is no covariance, or the covariance is not the same at all
    places.
    """
    scores = np.asarray(score, dtype=np.float64)
    if scores.ndim < 2 or scores.shape[-1] != 4:
        raise SettingsError(f"score has shape {scores.shape}, expected (..., place, 4)")
    if not np.isfinite(scores).all():
        raise SettingsError("score: found a value that is not finite, expected finite numbers")
    joint, (n_places, _) = np.asarray(covariance, dtype=np.float64), scores.shape[-2:]
    flat = scores.reshape(-1, n_places, 4)
    if joint.shape == (4, 4):
        if empty_places:
            flat = np.concatenate([flat, np.zeros((len(flat), 1, 4))], axis=1)
        probability = _independent(flat, checked_covariance(joint), max(empty_places, 1))
        error = np.zeros_like(probability)
    elif joint.shape == (n_places, 4, n_places, 4) and not empty_places:
        probability, error = _correlated(flat, joint.reshape(4 * n_places, 4 * n_places))
    else:
        raise SettingsError(f"covariance has shape {joint.shape}, expected (4, 4) or {(n_places, 4, n_places, 4)}")
    shape = (*scores.shape[:-2], 4)
    return PlaceProbabilities(probability.reshape(shape), error.reshape(shape))


def correct_at_unknown_place(
    score: FloatArray, covariance: FloatArray, correct: int, *, empty_places: int
) -> FloatArray:
    """Compute the probability of a correct answer, right to 1e-7, of trials that each have a noise of their own.
    `score`, (..., 4), is that at the triangle's place, and `covariance`, (..., 4, 4), that of the noise there and
    at each of the `empty_places`; it is not checked. Leading axes are broadcast.
    """
    shape = np.broadcast_shapes(score.shape[:-1], covariance.shape[:-2])
    flat = np.broadcast_to(score, (*shape, 4)).reshape(-1, 1, 4)
    flat = np.concatenate([flat, np.zeros_like(flat)], axis=1)
    each = np.broadcast_to(covariance, (*shape, 4, 4)).reshape(-1, 4, 4)
    return _independent(flat, each, empty_places)[:, correct].reshape(shape)


def _independent(score: FloatArray, covariance: FloatArray, last_alike: int) -> FloatArray:
    """Compute the probabilities, (n, 4), for scores (n, place, 4) and a checked covariance of each place, (4, 4),
    or of each trial, (n, 4, 4). `last_alike` is the number of places that are as the last one.
    """
    each = covariance.reshape(-1, 4, 4)
    deviation = np.sqrt(np.maximum(np.diagonal(each, axis1=1, axis2=2), 0.0))
    if not deviation.any():
        return _largest(score)
    unlike = deviation.min(axis=1) < 0.1 * deviation.max(axis=1)
    if unlike.any():
        first = deviation[unlike][0]
        raise SettingsError(
            f"covariance: found standard deviations of {first.min():g} and {first.max():g} of a place's "
            "scores, expected about the same of all four"
        )
    nodes = min(NODES + score.shape[1] + last_alike, MOST_NODES)
    node, weight, above = _rule(nodes)
    probability = np.empty((len(score), 4))
    n_rows = max(_AT_ONCE // (score.shape[1] * nodes), 1)
    for start in range(0, len(score), n_rows):
        rows = slice(start, start + n_rows)
        of_rows = slice(None) if len(each) == 1 else rows
        part, reach = score[rows], REACH * deviation[of_rows].max(axis=1)[:, None, None]
        largest = part.max(axis=(1, 2))[:, None, None] + reach * node  # (row, 1, node)
        density = _densities(part, largest, each[of_rows], deviation[of_rows])  # (row, place, node, 4)
        below = np.clip(1.0 - reach * (density.sum(axis=-1) @ above.T), 0.0, 1.0)
        alike = below[:, -1:] ** (last_alike - 1)
        others = _product_of_others(below) * alike
        others[:, -1] *= last_alike
        integral = reach[:, 0] * np.einsum("rpnk,rpn,n->rk", density, others, weight)
        probability[rows] = integral / integral.sum(axis=-1, keepdims=True)
    return probability


def _densities(
    score: FloatArray, largest: FloatArray, covariance: FloatArray, deviation: FloatArray
) -> FloatArray:
    """Compute the density of each score being t and the three others of its place below t: (row, place, node, 4).
    `largest` holds the values t, (row, 1, node). The covariance is (1 or row, 4, 4).
    """
    slope = covariance / np.square(deviation)[:, None]  # [row, j, k]: change of the mean of score j with score k
    left = covariance[:, None] - np.einsum("rjk,rki->rkji", slope, covariance)  # given score k
    given = np.stack([left[:, k][:, others[:, None], others] for k, others in enumerate(OTHERS)], axis=1)
    spread = np.sqrt(np.maximum(np.diagonal(given, axis1=2, axis2=3), 0.0))  # (row, 4, 3)
    spread = np.where(spread > 1e-7 * deviation[..., None], spread, 0.0)
    product = np.stack([spread[..., i] * spread[..., j] for i, j in PAIRS], axis=-1)
    cosine = np.divide(
        np.stack([given[..., i, j] for i, j in PAIRS], axis=-1),
        product,
        out=np.zeros_like(product),
        where=product > 0.0,
    )
    distance = largest[..., None] - score[:, :, None, :]  # (row, place, node, 4)
    following = slope[:, OTHERS, np.arange(4)[:, None]][:, None, None]
    room = largest[..., None, None] - score[:, :, None, OTHERS] - following * distance[..., None]
    limit = np.where(room >= 0.0, np.inf, -np.inf)
    each = spread[:, None, None]
    np.divide(room, each, out=limit, where=np.broadcast_to(each > 0.0, room.shape))
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)).reshape(-1, 3)
    by_matrix = limit if len(spread) == 1 else np.moveaxis(limit, 0, 2)
    below = orthants(by_matrix.reshape(-1, len(angle), 3), angle).reshape(by_matrix.shape[:-1])
    if len(spread) > 1:
        below = np.moveaxis(below, 2, 0)
    own = deviation[:, None, None]
    return np.asarray(below * np.exp(-np.square(distance / own) / 2.0) / (np.sqrt(2.0 * np.pi) * own))


def _product_of_others(values: FloatArray) -> FloatArray:
    """Compute for each place the product of the values (row, place, node) of all other places."""
    before, after = np.ones_like(values), np.ones_like(values)
    np.cumprod(values[:, :-1], axis=1, out=before[:, 1:])
    np.cumprod(values[:, :0:-1], axis=1, out=after[:, -2::-1])
    return before * after


@cache
def _rule(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return Gauss–Legendre nodes on [−1, 1], weights, and a matrix (n, n) of integrals from each node to 1. The
    matrix integrates the polynomial through the values at the nodes.
    """
    from numpy.polynomial import legendre

    node, weight = legendre.leggauss(n)
    order = np.arange(n)
    value = legendre.legvander(node, n)  # (node, order 0 … n)
    # ∫ P_k from x to 1 is (P_{k−1}(x) − P_{k+1}(x)) / (2k + 1), and 1 − x for k = 0.
    integral = np.empty((n, n))
    integral[:, 0] = 1.0 - node
    integral[:, 1:] = (value[:, : n - 1] - value[:, 2:]) / (2.0 * order[1:] + 1.0)
    to_coefficients = (2.0 * order[:, None] + 1.0) / 2.0 * value[:, :n].T * weight
    return node, weight, integral @ to_coefficients


def drawn_answers(
    score: ArrayLike, covariance: ArrayLike, rngs: Sequence[np.random.Generator]
) -> NDArray[np.intp]:
    """Draw the answer of the largest of the scores of all places, an index into `ORIENTATIONS` for each trial.
    Scores are (trial, place, 4), the covariance is as for `unknown_place_probabilities`, and each trial has its
    own random stream.
    """
    scores, joint = np.asarray(score, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    n_places = scores.shape[1]
    is_joint = joint.ndim == 4
    factor = _noise_factor(joint.reshape(4 * n_places, -1)) if is_joint else _root(checked_covariance(joint))
    answers = np.empty(len(scores), np.intp)
    for row, rng in enumerate(rngs):
        noise = rng.standard_normal((1, 4 * n_places) if is_joint else (n_places, 4)) @ factor.T
        answers[row] = (scores[row].ravel() + noise.ravel()).argmax() % 4
    return answers


def _root(covariance: FloatArray) -> FloatArray:
    """Return a matrix whose product with its transpose is a covariance."""
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2.0)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _noise_factor(joint: FloatArray) -> FloatArray:
    """Return the root of the covariance of the scores of all places, which is checked."""
    n_places = len(joint) // 4
    blocks = joint.reshape(n_places, 4, n_places, 4)
    own = checked_covariance(np.array([blocks[m, :, m] for m in range(n_places)]))
    scale = float(np.abs(own).max())
    if np.abs(own - own[0]).max() > 1e-6 * scale or np.abs(joint - joint.T).max() > 1e-6 * scale:
        raise SettingsError("covariance: found an asymmetric one or places that differ, expected neither")
    least = float(np.linalg.eigvalsh((joint + joint.T) / 2.0)[0])
    if least < -1e-2 * scale:
        raise SettingsError(f"covariance: found an eigenvalue of {least:g}, expected none below 0")
    return _root(joint)


def _correlated(score: FloatArray, joint: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute probabilities and standard errors, (n, 4), for scores (n, place, 4) and their joint covariance."""
    n_places, factor = score.shape[1], _noise_factor(joint)
    counts, rng = np.zeros((len(score), 4)), np.random.default_rng(0)
    for _ in range(DRAWS // _DRAWN_AT_ONCE):
        noise = rng.standard_normal((_DRAWN_AT_ONCE, 4 * n_places)) @ factor.T
        for row, one in enumerate(score.reshape(-1, 4 * n_places)):
            counts[row] += np.bincount((one + noise).argmax(axis=1) % 4, minlength=4)
    # As if one draw more had given each answer: no error is 0 because an answer was never drawn.
    share = (counts + 1.0) / (DRAWS + 4.0)
    return counts / DRAWS, np.sqrt(share * (1.0 - share) / DRAWS)


def _largest(score: FloatArray) -> FloatArray:
    """Return 1 for the orientation of the largest score without noise, (n, 4); equal ones share."""
    is_largest = score == score.max(axis=(1, 2), keepdims=True)
    return np.asarray(is_largest.sum(axis=1) / is_largest.sum(axis=(1, 2))[:, None])
