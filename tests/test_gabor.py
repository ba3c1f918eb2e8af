"""Gabor functions on a pyramid: their tuning in closed form, their adjoint, their energy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from todframes.observers.gabor_pyramid import GaborPyramid, _kernels

VARIANTS = [
    {},
    {"kernel_a": 0.4, "orientations": 6, "phases": "odd"},
    {"phases": "even", "elongation": 2.0, "wavelength_samples": 6.0},
    {"elongation": 0.5, "bandwidth_octaves": 1.5, "wavelength_samples": 3.0},
]
MARGIN = 12


def grating(side: int, frequency: float, direction: float, phase: float = 0.0) -> np.ndarray:
    """Amplitude 1, `frequency` in cycles a sample; `direction` of its modulation, from x to y (down)."""
    y, x = np.mgrid[:side, :side] - side // 2
    return np.cos(2.0 * np.pi * frequency * (x * math.cos(direction) + y * math.sin(direction)) + phase)


def response(filters: GaborPyramid, image: np.ndarray, level: int = 0) -> np.ndarray:
    """Root of the sum of squares of both phases, mean over the middle, of each orientation."""
    squares = np.square(filters.build(image)[level])[..., MARGIN:-MARGIN, MARGIN:-MARGIN]
    return np.sqrt(squares.sum(axis=0).mean(axis=(1, 2)))


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
@pytest.mark.parametrize("side", [33, 65])
def test_adjoint(variant: dict, side: int) -> None:
    filters, rng = GaborPyramid(levels=3, **variant), np.random.default_rng(0)
    image = rng.normal(size=(side, side))
    responses = filters.build(image)
    weights = [rng.normal(size=one.shape) for one in responses]
    there = sum(float((w * one).sum()) for w, one in zip(weights, responses, strict=True))
    back = float((filters.adjoint(weights) * image).sum())
    # Some 1e5 products of unit variance, each rounded to 1e-16.
    assert there == pytest.approx(back, abs=1e-10)


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_a_uniform_field_is_not_seen(variant: dict) -> None:
    *levels, residual = GaborPyramid(levels=3, **variant).build(np.full((65, 65), 7.0))
    for responses in levels:
        assert np.abs(responses).max() < 1e-13
    assert np.allclose(residual, 7.0, rtol=1e-14)


@pytest.mark.parametrize("octaves", [0.7, 1.0, 1.4])
def test_bandwidth(octaves: float) -> None:
    """Half the best response at f (1 ± w), w = (2ᵇ − 1)/(2ᵇ + 1), but for what keeps a uniform field unseen.

    In closed form the even function's spectrum is (G(f − f₀) + G(f + f₀))/2 − G(f₀) G(f), the odd one's the
    difference's half, G a Gaussian. It ends at 4 standard deviations: 3e-4 of its middle, 1e-3 of the response.
    """
    filters = GaborPyramid(levels=1, wavelength_samples=6.0, bandwidth_octaves=octaves)
    width = (2.0**octaves - 1.0) / (2.0**octaves + 1.0)
    sigma = 6.0 * math.sqrt(math.log(2.0) / 2.0) / math.pi / width
    for elongation, longer in ((1.0, 1.0), (0.5, 1.0), (2.0, 2.0)):
        sides = _kernels(replace(filters, elongation=elongation)).shape[1:]
        assert sides == (2 * math.ceil(4.0 * sigma * longer) + 1,) * 2
    assert math.log2((1 + width) / (1 - width)) == pytest.approx(octaves)

    def gaussian(f: np.ndarray) -> np.ndarray:
        return 0.5 ** np.square(f / width)

    f = np.array([0.5, 1 - width, 0.9, 1.0, 1.2, 1 + width, 2.0])
    even = (gaussian(f - 1) + gaussian(f + 1)) / 2 - gaussian(np.ones(1)) * gaussian(f)
    expected = np.hypot(even, (gaussian(f - 1) - gaussian(f + 1)) / 2)
    found = np.array([response(filters, grating(129, one / 6.0, 0.0))[0] for one in f])
    assert np.allclose(found / found[3], expected / expected[3], rtol=0.0, atol=2e-3)
    half = expected[[1, 5]] / expected[3]
    assert np.allclose(half, 0.5, atol=0.015)


@pytest.mark.parametrize("elongation", [1.0, 2.0])
def test_orientation_tuning(elongation: float) -> None:
    """The spectrum of a Gabor function is a Gaussian about its best frequency f, broader across short fields.

    A grating of f turned by φ is f sin φ away across and f (1 − cos φ) along; one octave has σ f = 0.5622.
    """
    filters = GaborPyramid(levels=1, wavelength_samples=5.0, elongation=elongation)
    sigma_f = math.sqrt(math.log(2.0) / 2.0) / math.pi * 3.0
    assert sigma_f == pytest.approx(0.5622, abs=5e-5)
    best = response(filters, grating(129, 0.2, 0.0))[0]
    for turn in np.radians([10.0, 18.0, 30.0]):
        exponent = (1.0 - math.cos(turn)) ** 2 + (elongation * math.sin(turn)) ** 2
        expected = math.exp(-2.0 * (math.pi * sigma_f) ** 2 * exponent)
        for sign in (1, -1):
            found = response(filters, grating(129, 0.2, sign * turn))[0]
            # The envelope's end, 3e-4 of its middle all around, is some 1e-3 of the best response.
            assert found / best == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_orientations_are_evenly_spaced(variant: dict) -> None:
    """Each responds best to the grating of its own direction, turned the same way round as the images are."""
    filters = GaborPyramid(levels=1, **variant)
    for k in range(filters.orientations):
        image = grating(97, 1.0 / filters.wavelength_samples, np.pi * k / filters.orientations, phase=0.4)
        assert response(filters, image).argmax() == k


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
@pytest.mark.parametrize("level", [0, 1, pytest.param(2, marks=pytest.mark.slow)])
def test_neurons_of_a_place_share_the_energy_of_their_best_gratings(variant: dict, level: int) -> None:
    """Mean squares of all responses add up to that of the grating, 1/2, averaged over its direction.

    Of the fold-over at halving, 6 % in amplitude where the wavelength is 3 samples, the square is left; and of one
    phase alone, whose energy rises and falls along the grating, what the middle does not average out.
    """
    filters = GaborPyramid(levels=level + 1, **variant)
    frequency = 1.0 / filters.wavelength_samples / 2.0**level
    directions = np.pi * (np.arange(1.5 * filters.orientations) + 0.3) / (1.5 * filters.orientations)
    energies = [
        np.square(response(filters, grating(65 * 2**level, frequency, direction, phase), level)).sum()
        for direction in directions
        for phase in (0.0, np.pi / 2.0)
    ]
    assert np.mean(energies) == pytest.approx(0.5, rel=0.01)
