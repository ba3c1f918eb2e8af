"""The probability of each answer against closed forms and quadratures that share nothing with the method.

`EXACT` is the promise of the function, 1e-9. Where the covariance is known exactly the tolerance is `SMOOTH`: the
oracles are asked for 1e-12 and the 128 nodes leave up to 1e-11 in degenerate cases, so 3e-11 holds both.
"""

from itertools import combinations, pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial.legendre import leggauss
from scipy.integrate import quad
from scipy.special import ndtr

from todframes.base.errors import SettingsError
from todframes.observers.decision import answer_probabilities, answer_probability

EXACT = 1e-9
SMOOTH = 3e-11


def density(z):
    return np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi)


def integrate(function, *, steps=(), limit=12.0):
    """∫ over ±limit standard deviations (1 − Φ(12) < 1e-32), split where the integrand is steep."""
    edges = [-limit, *sorted(step for step in steps if -limit < step < limit), limit]
    return sum(quad(function, a, b, epsabs=1e-13, epsrel=1e-12, limit=400)[0] for a, b in pairwise(edges))


def circulant(adjacent, opposite):
    """Overlaps of the templates up, right, down, left."""
    return np.array([np.roll([1, adjacent, opposite, adjacent], turn) for turn in range(4)])


CENTROID = circulant(np.sqrt(3) - 1, 2 / 3)
BOUNDING_BOX = circulant(0.60705, 1 / 2)


def panels(edges, nodes=16):
    """Gauss–Legendre nodes and weights on consecutive intervals."""
    node, weight = leggauss(nodes)
    half, middle = np.diff(edges)[:, None] / 2, (edges[1:] + edges[:-1])[:, None] / 2
    return (middle + half * node).ravel(), (half * weight).ravel()


def wins(score, covariance, answer):
    """P(answer) for well-conditioned matrices: the density of two of its differences × the chance of the third."""
    D = np.delete(np.eye(4)[answer] - np.eye(4), answer, axis=0)
    mean, V = D @ score, D @ covariance @ D.T
    scale = np.sqrt(np.diag(V))
    grids = [
        panels(s * np.concatenate([[0, 0.03, 0.1, 0.2], np.arange(0.4, max(m / s, 0) + 12, 0.4)]))
        for m, s in zip(mean[:2], scale, strict=False)
    ]
    (y1, w1), (y2, w2) = grids
    inverse = np.linalg.inv(V[:2, :2])
    e1, e2 = y1[:, None] - mean[0], y2 - mean[1]
    exponent = (inverse[0, 0] * e1**2 + 2 * inverse[0, 1] * e1 * e2 + inverse[1, 1] * e2**2) / 2
    gain = V[2, :2] @ inverse
    third = ndtr((mean[2] + gain[0] * e1 + gain[1] * e2) / np.sqrt(V[2, 2] - gain @ V[2, :2]))
    joint = np.exp(-exponent) * third * np.sqrt(np.linalg.det(inverse)) / (2 * np.pi)
    return w1 @ joint @ w2


def independent(score, deviation):
    """Four independent scores: ∫ φ(z) Π Φ dz, of any scale."""
    score, deviation = np.asarray(score, float), np.asarray(deviation, float)
    answers = []
    for k in range(4):
        others = [j for j in range(4) if j != k]
        middle = (score[others] - score[k]) / deviation[k]
        width = deviation[others] / deviation[k]
        steps = (middle[:, None] + np.outer(width, [-8, -3, 0, 3, 8])).ravel()

        def of_answer(z, m=middle, w=width):
            return density(z) * np.exp(np.log(np.maximum(ndtr((z - m) / w), 1e-300)).sum())

        answers.append(integrate(of_answer, steps=steps))
    return np.array(answers)


@pytest.mark.parametrize(
    "template",
    [
        [[0, 0, 0], [1, 0, 0], [-1, 0, 0], [3, 0, 0]],
        [[2, 1, 0], [-1, 3, 0], [-2, -2, 0], [1, 0, 0]],
        [[1, 0, 0], [0, 2, 0], [0, 0, 3], [-1, -1, -1]],
    ],
    ids=["rank 1", "rank 2", "rank 3"],
)
def test_zero_mean_is_the_solid_angle_of_the_orthant(template):
    template = np.array(template, dtype=float)
    expected = []
    for k in range(4):
        difference = template[k] - np.delete(template, k, axis=0)
        unit = difference / np.linalg.norm(difference, axis=1, keepdims=True)
        rho = [np.clip(unit[i] @ unit[j], -1, 1) for i, j in combinations(range(3), 2)]
        expected.append(1 / 8 + np.arcsin(rho).sum() / (4 * np.pi))
    # Rounding only: no ρ here is so near ±1, without being it, that arcsin enlarges it.
    assert answer_probabilities(np.zeros(4), template @ template.T) == pytest.approx(expected, abs=SMOOTH)


def test_the_four_triangles_as_tabulated():
    scores = np.arange(1, 6)[:, None] * CENTROID[:, 0]
    # Four or five decimals in the table.
    assert answer_probabilities(scores, CENTROID)[:, 0] == pytest.approx(
        [0.4045, 0.57444, 0.73016, 0.84961, 0.92669], abs=1e-5
    )
    for overlap, level in [(CENTROID, 3.1445), (BOUNDING_BOX, 2.5890)]:
        # The level is given to 5e-5 and the slope there is 0.14 per unit.
        assert answer_probabilities(level * overlap[:, 0], overlap)[0] == pytest.approx(0.75, abs=1e-5)


@pytest.mark.parametrize(
    "deviation", [[1, 2, 3, 4], [1e-6, 1, 1e6, 1e3], [1e-6, 1e-6, 1e6, 1e6], [1, 1e-3, 1e-5, 1e-6]]
)
def test_independent_scores_of_any_scale(deviation):
    deviation = np.array(deviation)
    for score in (np.zeros(4), deviation * [1, -0.5, 0.3, 0.7], deviation[::-1] * [0.1, 0, 1, -1]):
        assert answer_probabilities(score, np.diag(deviation**2)) == pytest.approx(
            independent(score, deviation), abs=EXACT
        )


@pytest.mark.parametrize("spread", [2**-5, 2**-15, 2**-20])
@pytest.mark.parametrize("gap", [0, 1e-3, 1, -5])
def test_two_templates_nearly_alike(spread, gap):
    # x_0, x_1 = m ± e with e of deviation `spread`: x_0 wins when e > 0 and m + e beats independent x_2 and x_3.
    covariance = np.diag([1 + spread**2, 1 + spread**2, 2, 5])
    covariance[0, 1] = covariance[1, 0] = 1 - spread**2
    score = np.array([gap * spread, -gap * spread, 0.2, -0.7])
    z, z_weight = panels(np.linspace(-9, 9, 37))
    e, e_weight = panels(np.linspace(0, abs(gap) + 10, 41))

    def of_pair(gap):
        x = z[:, None] + spread * e
        others = ndtr((x - score[2]) / np.sqrt(2)) * ndtr((x - score[3]) / np.sqrt(5))
        return (z_weight * density(z)) @ others @ (e_weight * density(e - gap))

    # 1 − Φ(9) is 1e-19.
    found = answer_probabilities(score, covariance)
    assert found[:2] == pytest.approx([of_pair(gap), of_pair(-gap)], abs=EXACT)


def test_random_templates_on_a_line():
    rng = np.random.default_rng(20)
    for _ in range(50):
        template, score = rng.normal(size=(2, 4))
        z = np.sort([(score[i] - score[j]) / (template[j] - template[i]) for i, j in combinations(range(4), 2)])
        edges = np.clip(np.concatenate([[-40], z, [40]]), -40, 40)
        winner = np.argmax(score + np.outer((edges[1:] + edges[:-1]) / 2, template), axis=1)
        expected = np.bincount(winner, weights=np.diff(ndtr(edges)), minlength=4)
        # The products t_j t_k round: faces with less area than that must be taken as flat. What is left is the
        # rounding 1e-16 of a squared difference, 1e-4 at the smallest, in d/σ.
        assert answer_probabilities(score, np.outer(template, template)) == pytest.approx(expected, abs=EXACT)


@pytest.mark.parametrize("seed", range(6))
def test_random_covariances_by_integration(seed):
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(4, 4)) + np.eye(4)
    score = factor @ rng.normal(size=4)
    expected = [wins(score, factor @ factor.T, k) for k in range(4)]
    # 16 nodes on 0.4 deviations integrate to rounding unless a third difference is nearly decided by two: 1e-10.
    assert answer_probabilities(score, factor @ factor.T) == pytest.approx(expected, abs=1e-10)


@pytest.mark.parametrize("overlap", [CENTROID, BOUNDING_BOX, np.eye(4)], ids=["centroid", "bounding box", "none"])
@pytest.mark.parametrize("level", [5, 10, 15, 20, 28])
def test_improbable_answers_are_right_relatively(overlap, level):
    score = level * overlap[:, 0]
    expected = np.array([wins(score, overlap, k) for k in (1, 2, 3)])
    found = answer_probabilities(score, overlap)
    relevant = expected > 1e-30
    # The promise is 6 digits; both sides have positive terms only and the oracle's panels resolve the decay of
    # exp(−b²/2), so the quadrature over 128 nodes decides: 1e-9 was found against 600 nodes.
    assert found[1:][relevant] == pytest.approx(expected[relevant], rel=1e-7, abs=0)
    assert found[1] == pytest.approx(found[3], rel=1e-12, abs=0)


def test_without_noise_the_largest_wins_and_equals_share():
    score = [[1, 2, 3, 4], [4, 4, 1, 0], [2, 2, 2, 1], [0, 0, 0, 0], [1, 1, 1 + 1e-12, 1]]
    expected = [[0, 0, 0, 1], [0.5, 0.5, 0, 0], [1 / 3, 1 / 3, 1 / 3, 0], [0.25] * 4, [0, 0, 1, 0]]
    for covariance in (np.zeros((4, 4)), np.ones((4, 4))):
        # Thirds round.
        assert answer_probabilities(score, covariance) == pytest.approx(np.array(expected), abs=1e-15)


def test_identical_templates_share_or_yield():
    # Answers 0 and 1 are one template: together they are one of three independent alternatives.
    template = np.array([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    ahead = integrate(lambda z: density(z - 0.7) * ndtr(z) ** 2)
    shared = answer_probabilities([0.7, 0.7, 0, 0], template @ template.T)
    assert shared == pytest.approx([ahead / 2, ahead / 2, (1 - ahead) / 2, (1 - ahead) / 2], abs=SMOOTH)
    yielded = answer_probabilities([0.7, 0.5, 0, 0], template @ template.T)
    assert yielded == pytest.approx([ahead, 0, (1 - ahead) / 2, (1 - ahead) / 2], abs=SMOOTH)
    # Two pairs of them.
    template = np.array([[1, 0], [0, 1], [1, 0], [0, 1.0]])
    first = ndtr(0.6 / np.sqrt(2))
    found = answer_probabilities([0.6, 0, 0.6, -1], template @ template.T)
    assert found == pytest.approx([first / 2, 1 - first, first / 2, 0], abs=SMOOTH)


def test_factor_is_as_good_as_its_covariance():
    rng = np.random.default_rng(6)
    factor, scores = rng.normal(size=(7, 4, 5)), rng.normal(size=(7, 4))
    covariance = factor @ factor.swapaxes(1, 2)
    # Both are right to `SMOOTH` where the covariance is far from singular.
    found = answer_probabilities(scores, factor=factor)
    assert found == pytest.approx(answer_probabilities(scores, covariance), abs=SMOOTH)
    one = answer_probabilities(scores, factor=factor[0])
    assert one == pytest.approx(answer_probabilities(scores, covariance[0]), abs=SMOOTH)
    assert one.shape == (7, 4)


def test_factors_of_any_rank():
    # Two templates coincide, and then all four are on a line: exact angles of 0, 90 and 180 degrees.
    score = [0.7, 0.7, 0.0, 0.0]
    for rows in ([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[-2], [-1], [0], [3]], [[0], [0], [0], [0]]):
        template = np.array(rows, dtype=float)
        expected = answer_probabilities(score, template @ template.T)
        assert answer_probabilities(score, factor=template) == pytest.approx(expected, abs=SMOOTH)


finite = st.floats(-5, 5, allow_subnormal=False)
score_lists = st.lists(finite, min_size=4, max_size=4).map(np.array)
# Coarse templates: every rank, many exact coincidences.
template_arrays = st.lists(st.integers(-3, 3), min_size=12, max_size=12).map(lambda t: np.reshape(t, (4, 3)) / 1.0)
quick = settings(max_examples=25, deadline=None)


@quick
@given(score_lists, template_arrays, st.sampled_from(list(permutations(range(4)))))
def test_permuted_answers_have_permuted_probabilities_whose_sum_is_one(score, template, order):
    order = list(order)
    covariance = template @ template.T
    found = answer_probabilities(score[order], covariance[np.ix_(order, order)])
    assert found == pytest.approx(answer_probabilities(score, covariance)[order], abs=SMOOTH)
    assert (found >= 0).all()
    # A few units in the last place.
    assert found.sum() == pytest.approx(1, abs=1e-15)


def test_one_matrix_per_score_and_one_for_all_agree():
    rng = np.random.default_rng(3)
    scores = rng.normal(size=(2, 75, 4))
    one = answer_probabilities(scores, BOUNDING_BOX)
    assert one.shape == (2, 75, 4)
    # The same operations on the same numbers.
    assert answer_probabilities(scores, np.broadcast_to(BOUNDING_BOX, (75, 4, 4))) == pytest.approx(one, abs=1e-15)
    assert answer_probabilities(scores[0, 0], np.stack([np.eye(4), BOUNDING_BOX]))[1] == pytest.approx(
        one[0, 0], abs=1e-15
    )
    assert answer_probabilities(np.zeros((0, 4)), BOUNDING_BOX).shape == (0, 4)


SKEW = np.eye(4) + 1e-6 * np.eye(4, k=1)


@pytest.mark.parametrize(
    ("score", "noise", "message"),
    [
        ([[0, 0, 0, 0], [0, 0, np.nan, 0]], {"covariance": np.eye(4)}, r"score\[1, 2\] is nan, expected finite"),
        ([-np.inf, 0, 0, 0], {"covariance": np.eye(4)}, r"score\[0\] is -inf, expected finite"),
        (np.zeros(3), {"covariance": np.eye(4)}, r"score has shape \(3,\), expected \(\.\.\., 4\)"),
        (np.zeros(4), {"covariance": np.diag([np.inf, 1, 1, 1])}, r"covariance\[0, 0\] is inf, expected finite"),
        (np.zeros(4), {"covariance": SKEW}, "asymmetry of covariance is 1e-06, expected a symmetric matrix"),
        (np.zeros(4), {"covariance": np.stack([np.eye(4), np.diag([1, 1, 1, -1e-6])])},
         r"smallest eigenvalue of covariance\[1\] is -1e-06, expected a positive semi"),
        (np.zeros(4), {"covariance": np.eye(3)}, r"covariance has shape \(3, 3\), expected \(\.\.\., 4, 4\)"),
        (np.zeros(4), {}, "noise: found both or none of covariance and factor, expected one"),
        (np.zeros(4), {"covariance": np.eye(4), "factor": np.eye(4)}, "noise: found both or none"),
        (np.zeros(4), {"factor": np.ones((3, 4))}, r"factor has shape \(3, 4\), expected \(\.\.\., 4, n\)"),
        (np.zeros(4), {"factor": [[0, np.nan], [0, 0], [0, 0], [0, 0]]}, r"factor\[0, 1\] is nan, exp"),
    ],
)  # fmt: skip
def test_bad_scores_and_noise_are_refused(score, noise, message):
    with pytest.raises(SettingsError, match=message):
        answer_probabilities(score, **noise)


def test_rounding_of_a_covariance_is_allowed():
    """To 1e-10 of its largest value."""
    answer_probabilities(np.zeros(4), np.diag([1, 1, 1, -1e-11]))


def test_one_answer_is_that_of_all_four() -> None:
    """In all shapes: one covariance, one for each score, one for several scores."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(7, 4, 4))
    covariance, score = root @ root.swapaxes(1, 2), rng.normal(size=(7, 3, 4))
    for scores, covariances in (
        (score, covariance[:, None]),
        (score[0], covariance[0]),
        (score[0, 0], covariance[0]),
        (score[0, 0], covariance),
        (score[:, 0], covariance),
        (score[:, 0], covariance[:1]),
        (score[:, None], covariance[:, None, None]),
    ):
        expected = answer_probabilities(scores, covariances)
        for answer in range(4):
            found = answer_probability(scores, covariances, answer)
            assert found.shape == expected.shape[:-1]
            # Both are exact to 1e-9; the largest of the four is 1 less the others there.
            assert np.allclose(found, expected[..., answer], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5, 1e-8])
def test_one_answer_is_as_exact_as_its_tolerance(tolerance: float) -> None:
    """Covariances at all distances from singular ones, alone and together, against the default."""
    rng = np.random.default_rng(5)
    near = np.exp(rng.uniform(-4.0, 0.0, (400, 1, 1)))
    factor = np.concatenate([np.eye(4), np.zeros((4, 1))], axis=1) + near * rng.normal(size=(400, 4, 5))
    factor[::2] = np.exp(0.5 * rng.normal(size=(200, 4, 1))) * rng.normal(size=(200, 4, 5))
    score = rng.normal(size=(400, 4)) * np.geomspace(0.3, 3.0, 400)[:, None]
    covariance = factor @ factor.swapaxes(1, 2)
    exact = answer_probability(score, covariance, 2)  # to 1e-9, as other tests hold
    alone = [answer_probability(s, c, 2, tolerance=tolerance) for s, c in zip(score, covariance, strict=True)]
    assert np.abs(np.array(alone) - exact).max() < tolerance + EXACT
    assert np.abs(answer_probability(score, covariance, 2, tolerance=tolerance) - exact).max() < tolerance + EXACT
