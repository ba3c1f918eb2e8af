"""Stability cases of the decision, and the list of all cases of todframes.

Numbers from mpmath were computed with 50 digits; tests/test_stability_references.py does it again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.observers.decision import answer_probabilities
from todframes.studies.stability import fits_and_frames, observer, observers_and_field
from todframes.studies.stability.case import MPMATH, Case


def cases() -> list[Case]:
    """List all cases of todframes."""
    further = [*observers_and_field.observer_cases(), *observers_and_field.field_cases()]
    return [*decision_cases(), *observer.cases(), *fits_and_frames.cases(), *further]


def circulant(beside: float, opposite: float) -> FloatArray:
    """Return the overlaps of four templates of length 1 that are one, turned."""
    return np.array([np.roll([1.0, beside, opposite, beside], turns) for turns in range(4)])


TRIANGLES = circulant(math.sqrt(3.0) - 1.0, 2.0 / 3.0)
"""Overlaps of the four triangles themselves, centred on their centroids."""

SNRS = 10.0 ** np.arange(-9.0, 10.0, 3.0)
HIGH_SNRS = np.array([5.0, 15.0, 25.0, 31.0])
NOISE_SDS = np.array([1e-150, 1e-9, 1e9, 1e150])

LEADS = np.array([1.0, 4.0, 8.0, 11.4])
"""Leads in standard deviations."""

EVEN_PARTS = (1e-3, 1e-6, 1e-12)
LINE = np.array([[-2.0], [-1.0], [0.0], [3.0]])

OBTUSE = np.array([[0.0, 0.0, 0.0], [4.0, 1.0, 0.0], [6.0, 0.0, 1.0], [5.0, -2.0, 1.0]])
"""Answer 1 lies between the others: its differences from two of them are negatively correlated."""

OBTUSE_SNRS = np.array([2.0, 6.0, 12.5])

ALIKE = 1.0 + 2e-6 * np.eye(4)
"""Any two have the correlation 1 − 1e-12: (4 + 4e-6) / (4 + 4e-6 + 4e-12)."""

D_PRIMES = np.array([0.5, 1.0, 1.5, 2.0, 3.0])
HIGH_D_PRIMES = np.array([5.0, 10.0, 16.2])


def pairs(even: float) -> FloatArray:
    """Return templates of a tiny triangle: up and down, right and left are opposite except for the part `even`."""
    odd = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return odd + even * np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.0, 0, 0], [-1.0, 0, 0]])


def right(score: ArrayLike, covariance: ArrayLike | None = None, *, factor: ArrayLike | None = None) -> FloatArray:
    """Compute the probability of answer 0."""
    return np.asarray(answer_probabilities(score, covariance, factor=factor)[..., 0])


def wrong(score: ArrayLike, covariance: ArrayLike | None = None, *, factor: ArrayLike | None = None) -> FloatArray:
    """Compute the probability of the other answers, with the digits that 1 less answer 0 would lose."""
    return np.asarray(answer_probabilities(score, covariance, factor=factor)[..., 1:].sum(axis=-1))


def like_template(snr: ArrayLike, factor: FloatArray) -> FloatArray:
    """Return scores of an image that looks like template 0."""
    return np.asarray(np.multiply.outer(snr, factor @ factor[0]))


def decision_cases() -> list[Case]:
    """List the cases of `answer_probabilities`."""
    tails = np.array([math.erfc(lead / math.sqrt(2.0)) / 2.0 for lead in LEADS])
    of_line = [math.erfc(-edge / math.sqrt(2.0)) / 2.0 for edge in (-0.8, 0.1, 1.4 / 3.0)]
    line_tail = (math.erfc(11.4 / math.sqrt(2.0)) + math.erfc(12.0 / math.sqrt(2.0))) / 2.0

    def of_triangles(snr: ArrayLike) -> FloatArray:
        return np.asarray(np.multiply.outer(snr, TRIANGLES[0]))

    def with_even_parts(lead: float, probability: Callable[..., FloatArray]) -> list[float]:
        return [float(probability(like_template(lead, pairs(even)), factor=pairs(even))) for even in EVEN_PARTS]

    def identical() -> list[float]:
        return [float(right(np.ones(4), np.full((4, 4), noise))) for noise in (0.0, 1e-300, 1.0, 1e300)]

    def scaled() -> list[float]:
        return [float(right(3.0 * sd * TRIANGLES[0], sd**2 * TRIANGLES)) for sd in NOISE_SDS]

    case = partial(Case, "decision")
    plackett = MPMATH + "orthants by Plackett's identity"
    independent = MPMATH + "∫ φ(z − d′) Φ(z)³ dz"
    on_line = "closed form: normal probabilities of intervals"
    return [
        case("four triangles, SNR 1e-9 to 1e9: P(correct)",
             [0.2500000001380203, 0.25000013802033644, 0.2501380400549598, 0.40449964244458675, 1.0, 1.0, 1.0],
             plackett, lambda: right(of_triangles(SNRS), TRIANGLES), 9),
        case("four triangles, SNR 1e-9: P(correct) − 1/4", 1.380203167375258e-10, plackett,
             lambda: float(right(of_triangles(1e-9), TRIANGLES)) - 0.25, 5),
        case("four triangles, SNR 5 to 31: P(error) to 1e-30",
             [0.07330579875767375, 4.055292575223019e-08, 5.660073880337489e-20, 7.693775917894176e-30],
             plackett, lambda: wrong(of_triangles(HIGH_SNRS), TRIANGLES)),
        case("noise SD 1e-150 to 1e150, SNR 3: P(correct)", [0.7301635803834369] * 4, plackett, scaled, 9),
        case("two opposite pairs (rank 2): P(error) to 1e-30", tails * (2.0 - tails),
             "closed form: 1 − Φ(lead)²",
             lambda: wrong(like_template(math.sqrt(2.0) * LEADS, pairs(0.0)), pairs(0.0) @ pairs(0.0).T)),
        case("opposite pairs but for 1e-3 to 1e-12 of them, SNR 2: P(correct)",
             [0.8488869354973887, 0.8488865530847595, 0.848886553084377], plackett,
             lambda: with_even_parts(2.0, right), 9),
        case("opposite pairs but for 1e-3 to 1e-12 of them, SNR 16.1: P(error)",
             [4.999374840440415e-30, 5.000027751434586e-30, 5.000027752087541e-30], plackett,
             lambda: with_even_parts(16.1, wrong)),
        case("templates on a line (rank 1): all four", np.diff([0.0, *of_line, 1.0]), on_line,
             lambda: answer_probabilities([-0.3, 0.5, 0.4, -1.0], LINE @ LINE.T), 9),
        case("templates on a line (rank 1): P(error) at 1e-30", line_tail, on_line,
             lambda: float(wrong([0.0, -11.4, -12.0, -50.0], LINE[[1, 0, 2, 3]] @ LINE[[1, 0, 2, 3]].T))),
        case("negatively correlated differences: P(error) to 1e-30",
             [0.04717755001633491, 2.426531172407078e-08, 1.845132359098363e-30], plackett,
             lambda: wrong(np.multiply.outer(OBTUSE_SNRS, -OBTUSE[:, 0]), OBTUSE @ OBTUSE.T)),
        case("templates 1 − 1e-12 alike: P(correct)",
             [0.3933178428150768, 0.5520314384430163, 0.7018627009324003, 0.8227929559932297, 0.9563743715605859],
             independent, lambda: right(2e-6 * np.multiply.outer(D_PRIMES, np.eye(4)[0]), factor=ALIKE), 9),
        case("templates 1 − 1e-12 alike: P(error) to 1e-30",
             [0.0005927685870461995, 2.3061133514624445e-12, 3.324462858005453e-30], independent,
             lambda: wrong(2e-6 * np.multiply.outer(HIGH_D_PRIMES, np.eye(4)[0]), factor=ALIKE)),
        case("four identical templates, variance 0 to 1e300", [0.25] * 4, "symmetry", identical, 15),
        case("no noise, scores 1e-300 apart: all four", [1.0, 0.0, 0.0, 0.0], "the largest wins",
             lambda: answer_probabilities([1e-300, 0.0, 0.0, 0.0], np.ones((4, 4))), 15),
        case("scores of ±1e308: all four", [1.0, 0.0, 0.0, 0.0], "the largest wins",
             lambda: answer_probabilities([1e308, -1e308, 0.0, 0.0], TRIANGLES), 15),
    ]  # fmt: skip
