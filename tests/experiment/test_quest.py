"""QUEST+: the posterior and its expected entropy against literal loops; simulated people."""

from __future__ import annotations

import math

import numpy as np
import pytest

from todframes.experiment.order import QuestGrid
from todframes.psychometrics.curves import weibull

LEVELS = np.geomspace(0.02, 0.4, 9)


def literal_posterior(grid: QuestGrid, answers: list[tuple[int, bool]]) -> list[float]:
    """Bayes' rule answer by answer, each likelihood from eq. 3 itself."""
    belief = [1.0] * grid.alpha.size
    for level, is_right in answers:
        for k, (alpha, beta, lapse) in enumerate(zip(grid.alpha, grid.beta, grid.lapse_rate, strict=True)):
            right = (1 - lapse) - (1 - lapse - 0.25) * 2.0 ** (-((grid.levels[level] / alpha) ** beta))
            belief[k] *= right if is_right else 1.0 - right
        total = sum(belief)
        belief = [one / total for one in belief]
    return belief


def counts(answers: list[tuple[int, bool]], n_levels: int) -> tuple[np.ndarray, np.ndarray]:
    found = np.zeros((2, n_levels))
    for level, is_right in answers:
        found[int(is_right), level] += 1
    return found[0], found[1]


ANSWERS = [(4, True), (2, False), (3, True), (3, False), (8, True), (0, False)]


def test_posterior_is_the_product_of_the_likelihoods_in_any_order():
    grid = QuestGrid.of_levels(LEVELS)
    found = grid.posterior(*counts(ANSWERS, 9))
    # Both are exact up to the rounding of six products and a sum of 3294 terms.
    np.testing.assert_allclose(found, literal_posterior(grid, ANSWERS), rtol=1e-10, atol=1e-15)
    assert math.isclose(found.sum(), 1.0, rel_tol=1e-12)


def test_expected_entropy_is_that_of_a_loop_over_answers():
    grid = QuestGrid.of_levels(LEVELS)
    found = grid.expected_entropy(grid.posterior(*counts(ANSWERS, 9)))
    before = literal_posterior(grid, ANSWERS)
    for level in (3, 8):
        expected = 0.0
        for is_right in (True, False):
            after = literal_posterior(grid, [*ANSWERS, (level, is_right)])
            p_right = sum(
                p * float(weibull(LEVELS[level], alpha=a, beta=b, guess_rate=0.25, lapse_rate=d))
                for p, a, b, d in zip(before, grid.alpha, grid.beta, grid.lapse_rate, strict=True)
            )
            entropy = -sum(p * math.log(p) for p in after if p > 0)
            expected += entropy * (p_right if is_right else 1.0 - p_right)
        # Cancellation of terms near ln 3294 = 8: a few of their roundings.
        assert math.isclose(found[level], expected, rel_tol=1e-11)


def sit(grid: QuestGrid, people: np.ndarray, *, n_trials: int, seed: int) -> np.ndarray:
    """Return the posteriors of people who answer as functions of the grid, given by their indices."""
    rng = np.random.default_rng(seed)
    wrong, right = np.zeros((2, people.size, LEVELS.size))
    for _ in range(n_trials):
        at = np.argmin(grid.expected_entropy(grid.posterior(wrong, right)), axis=1)
        is_right = rng.random(people.size) < grid.p_answer[1, at, people]
        right[np.arange(people.size), at] += is_right
        wrong[np.arange(people.size), at] += ~is_right
    return grid.posterior(wrong, right)


@pytest.mark.slow
def test_thresholds_of_simulated_people_are_unbiased_with_the_error_that_is_stated():
    grid = QuestGrid.of_levels(LEVELS)
    people = np.random.default_rng(5).integers(grid.alpha.size, size=500)
    posterior = sit(grid, people, n_trials=60, seed=6)
    for truth in (np.log(grid.alpha), np.log(grid.beta), grid.lapse_rate):
        # For people drawn from the prior, whatever levels they saw, the mean error of the posterior's mean is 0,
        # and the mean of its square is that of the posterior's variance: four standard errors of each.
        mean = posterior @ truth
        variance = posterior @ truth**2 - mean**2
        error = mean - truth[people]
        assert abs(error.mean()) < 4 * error.std() / math.sqrt(people.size)
        off = error**2 - variance
        assert abs(off.mean()) < 4 * off.std() / math.sqrt(people.size)
