"""Gabor functions on a pyramid: their tuning in closed form, their adjoint, their energy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from todframes.observers.oriented import GaborPyramid, _kernels

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


@pytest.mark.parametrize("variant", [*VARIANTS, {"elongation": 1.05}], ids=str)
def test_neurons_are_gabor_functions(variant: dict) -> None:
    """A wave across a Gaussian whose spectrum is 1/2 at f (1 ± w), w = (2ᵇ − 1)/(2ᵇ + 1): Daugman 1985.

    They end at four standard deviations of the longer side. Even ones are blind to a uniform field by a part of
    the Gaussian; the second half of the orientations is the first after a quarter turn.
    """
    filters = GaborPyramid(levels=1, **variant)
    octaves, wavelength, longer = filters.bandwidth_octaves, filters.wavelength_samples, filters.elongation
    width = (2.0**octaves - 1.0) / (2.0**octaves + 1.0)
    assert math.log2((1 + width) / (1 - width)) == pytest.approx(octaves)
    sigma = wavelength * math.sqrt(math.log(2.0) / 2.0) / math.pi / width
    reach = math.ceil(4.0 * sigma * max(1.0, longer))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    expected = []
    for phase in {"both": (0.0, 0.5), "even": (0.0,), "odd": (0.5,)}[filters.phases]:
        for k in range(filters.orientations):
            turn = math.pi * k / filters.orientations
            across, along = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
            envelope = np.exp(-(across**2 + (along / longer) ** 2) / (2.0 * sigma**2))
            wave = envelope * np.cos(2.0 * math.pi * across / wavelength - math.pi * phase)
            expected.append(wave - envelope * wave.sum() / envelope.sum())
    np.testing.assert_allclose(_kernels(filters), expected, rtol=0.0, atol=1e-13)


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
