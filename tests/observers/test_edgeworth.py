"""The first Edgeworth term against differences of orthants, sums of uniform numbers and an exact inversion."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from todframes.observers.decision import answer_probabilities
from todframes.observers.internal_noise import _participation, edgeworth_correction, fourth_cumulants
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.observers.retina import triangle_on
from todframes.stimulus import Stimulus

UNIFORM = -1.2


@pytest.mark.parametrize("seed", range(4))
def test_term_is_the_fourth_derivative_along_each_neuron_s_weights(seed):
    rng = np.random.default_rng(seed)
    covariance = np.cov(rng.normal(size=(4, 9))) + np.eye(4)
    score = rng.normal(size=4)
    neurons = rng.normal(size=(4, 20))
    # Central differences: the error is 7/240 h⁴ of the eighth derivative, up to 10³ for
    # weights up to 3 in noise of 1 and more; orthants round by 1e-15, times 20 neurons · 19 / (24 h⁴).
    h, c = 0.02, np.array([-1, 12, -39, 56, -39, 12, -1]) / 6.0
    steps = h * np.arange(-3, 4)[:, None, None] * neurons.T
    by_differences = np.einsum("s,snk->k", c, answer_probabilities(score + steps, covariance)) / h**4 / 24.0
    found = edgeworth_correction(score, covariance, fourth_cumulants(neurons, excess_kurtosis=1.0))
    assert found == pytest.approx(by_differences, abs=1e-5)
    assert np.abs(found).max() > 0.03


def test_cumulants_are_those_of_the_sums():
    factor = np.array([[1.0, 2.0, 0.0], [0.0, 1.0, 1.0], [3.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = fourth_cumulants(factor, excess_kurtosis=UNIFORM)
    assert found[0, 0, 0, 0] == pytest.approx(UNIFORM * 17.0, rel=1e-15)
    assert found[0, 1, 1, 0] == pytest.approx(UNIFORM * 4.0, rel=1e-15)
    assert found[0, 2, 0, 0] == pytest.approx(UNIFORM * 3.0, rel=1e-15)
    assert not found[3].any() and not found[1, 2].any()
    bands = (1e-3 * factor[0], np.zeros(2)), (np.zeros(3), np.zeros(2))
    assert _participation(*bands) == pytest.approx(17.0 / 25.0, rel=1e-14)
    assert _participation(bands[1], bands[1]) == 0.0


def test_nothing_where_noise_does_not_decide_or_lies_in_a_plane():
    plane = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [-1.0, 0.0]])
    for factor in (np.zeros((4, 2)), np.ones((4, 2)), plane):
        cumulant = fourth_cumulants(factor, excess_kurtosis=UNIFORM)
        assert not edgeworth_correction([1.0, 0.0, 0.0, 0.0], factor @ factor.T, cumulant).any()


def sign_series_probability(score, weights, answer):
    """P(answer) for uniform noise on every neuron, by inverting its characteristic function.

    Π (1 + sgn D_j)/8, each sign as the Fourier series of a square wave of half-period 4π > 12 standard deviations,
    so that the expectation is a sum of values of the characteristic function. It is a product over the 400 or so
    neurons with weights above 1/250; the others enter by their second and fourth cumulants.
    """
    others = [k for k in range(4) if k != answer]
    difference = weights[answer] - weights[others]
    sd = np.linalg.norm(difference, axis=1)
    alpha, mean = difference / sd[:, None], (score[answer] - score[others]) / sd
    heavy = np.abs(alpha).max(axis=0) > 0.004
    light = alpha[:, ~heavy]
    second, fourth = light @ light.T, np.einsum("in,jn,kn,ln->ijkl", *[light] * 4, optimize=True)

    def characteristic(t):
        squares = t[:, :, None] * t[:, None, :]
        exponent = np.einsum("nij,ij->n", squares, second) / 2.0
        exponent += np.einsum("nij,nkl,ijkl->n", squares, squares, fourth, optimize=True) / 20.0
        value = np.exp(-exponent + 1j * t @ mean)
        for one in alpha[:, heavy].T:
            value *= np.sinc(np.sqrt(3.0) / np.pi * (t @ one))
        return value

    correlation = alpha @ alpha.T
    # exp(−17) = 4e-8 is what the characteristic function has fallen to at the ends of the grids.
    ends = np.ceil(2.0 * np.sqrt(2.0 * 17.0 * np.diag(np.linalg.inv(correlation)))).astype(int)
    odd = [np.arange(-end, end) + 0.5 for end in ends]
    total = 1.0
    for size in (1, 2, 3):
        for axes in combinations(range(3), size):
            grid = np.stack(np.meshgrid(*[odd[axis] for axis in axes], indexing="ij"), axis=-1).reshape(-1, size)
            t = np.zeros((len(grid), 3))
            t[:, axes] = 0.5 * grid
            t, grid = (kept[np.einsum("ni,ij,nj->n", t, correlation, t) < 40.0] for kept in (t, grid))
            total += np.sum(characteristic(t) / (np.pi * 1j * grid).prod(axis=1)).real
    return total / 8.0


@pytest.mark.parametrize(("size_mrad", "gaussian", "corrected"), [(0.3, 1.5e-3, 1e-4), (1.0, 5e-4, 1e-5)])
def test_uniform_noise_on_the_observer_s_neurons(size_mrad, gaussian, corrected):
    observer = PyramidObserver(PyramidSettings())
    stimulus = Stimulus(size_mrad)
    readout = observer.readout(stimulus)
    image = triangle_on(readout.grid, size_mrad, x=0.3, y=-0.2)
    weights = np.array(
        [np.concatenate([band.ravel() for band in bands]) for bands in observer.templates(stimulus)]
    )
    weights = observer.settings.noise_sd * (weights - weights.mean(axis=0))
    cumulant = fourth_cumulants(weights, excess_kurtosis=UNIFORM)
    scores = readout.score_deviations(image)
    largest = 0.0
    for lead in (0.5, 1.5, 2.5):
        score = lead * scores / np.ptp(scores) * np.sqrt(readout.noise_covariance[0, 0]) * 2.0
        plain = answer_probabilities(score, readout.noise_covariance)
        better = plain + edgeworth_correction(score, readout.noise_covariance, cumulant)
        for answer in (0, 2):
            exact = sign_series_probability(score, weights, answer)
            largest = max(largest, abs(plain[answer] - exact))
            assert abs(better[answer] - exact) < corrected
    assert largest > gaussian
