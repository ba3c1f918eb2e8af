"""The Laplacian pyramid: published impulse responses, inverse, adjoint, symmetry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from todframes.observers.pyramid import LaplacianPyramid, framed

shapes = st.tuples(st.integers(1, 70), st.integers(1, 70))
kernels = st.one_of(st.sampled_from([0.375, 0.4]), st.floats(0.0, 1.0))


@settings(max_examples=40, deadline=None)
@given(shape=shapes, levels=st.integers(0, 6), kernel_a=kernels, seed=st.integers(0, 2**32 - 1))
def test_an_image_follows_from_its_bands(shape: tuple[int, int], levels: int, kernel_a: float, seed: int) -> None:
    image = np.random.default_rng(seed).normal(size=shape)
    pyramid = LaplacianPyramid(levels, kernel_a)
    *bands, restored = pyramid.build(image)
    for band in reversed(bands):
        restored = band + pyramid.expand(restored, band.shape)
    assert np.allclose(restored, image, rtol=0.0, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(shape=shapes, levels=st.integers(0, 6), kernel_a=kernels, seed=st.integers(0, 2**32 - 1))
def test_adjoint(shape: tuple[int, int], levels: int, kernel_a: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    pyramid = LaplacianPyramid(levels, kernel_a)
    image = rng.normal(size=shape)
    bands = pyramid.build(image)
    other = [rng.normal(size=band.shape) for band in bands]
    forward = sum(np.vdot(y, x) for y, x in zip(other, bands, strict=True))
    backward = np.vdot(pyramid.adjoint(other), image)
    scale = np.sqrt(sum(np.square(y).sum() for y in other) * np.square(image).sum())
    assert abs(forward - backward) <= 1e-12 * scale


@pytest.mark.parametrize("kernel_a", [0.3, 0.375, 0.4, 0.6])
def test_reduce_of_an_impulse(kernel_a: float) -> None:
    """Burt & Adelson 1983: even places see the kernel's odd taps, odd places the even ones."""
    pyramid = LaplacianPyramid(1, kernel_a)
    edge = 0.25 - kernel_a / 2.0
    for place, expected in ((8, [0, edge, kernel_a, edge, 0]), (9, [0, 0, 0.25, 0.25, 0])):
        impulse = np.zeros((17, 17))
        impulse[8, place] = 1.0
        row = pyramid.reduce(impulse)[4, 2:7]
        assert np.allclose(row, kernel_a * np.array(expected), atol=1e-15)


def test_fast_path_is_the_general_filter() -> None:
    """cv2.pyrDown against the separable filter, at all sizes, borders included."""
    rng = np.random.default_rng(0)
    for shape in [(1, 1), (1, 9), (2, 2), (2, 7), (3, 3), (4, 5), (33, 20), (257, 64)]:
        image = rng.normal(size=shape)
        fast = LaplacianPyramid(1, 0.375).reduce(image)
        general = LaplacianPyramid(1, np.nextafter(0.375, 1.0)).reduce(image)
        assert np.allclose(fast, general, rtol=0.0, atol=1e-14)


@pytest.mark.parametrize("shape", [(1, 1), (1, 6), (5, 1), (2, 3), (64, 31), (65, 65)])
@pytest.mark.parametrize("kernel_a", [0.375, 0.4])
def test_uniform_image_has_no_bands(shape: tuple[int, int], kernel_a: float) -> None:
    *bands, residual = LaplacianPyramid(5, kernel_a).build(np.full(shape, 3.0))
    # Five taps that sum to 1 within an ulp each, along two axes, on a value of 3.
    assert max(np.abs(band).max() for band in bands) < 1e-14
    assert np.allclose(residual, 3.0, rtol=1e-14)


def test_the_middle_of_an_image_has_zeros_beyond_its_edges() -> None:
    image = np.arange(25.0).reshape(5, 5)
    for half in range(5):
        middle = slice(4 - half, 5 + half)
        assert np.array_equal(framed(image, half), np.pad(image, 2)[middle, middle])


def test_input_is_left_alone() -> None:
    image = np.random.default_rng(4).normal(size=(20, 21))
    before = image.copy()
    pyramid = LaplacianPyramid(3)
    bands = pyramid.build(image)
    kept = [band.copy() for band in bands]
    pyramid.adjoint(bands)
    pyramid.build(image)[-1][:] = 0.0
    LaplacianPyramid(0).build(image)[0][:] = 0.0
    assert np.array_equal(image, before)
    assert all(np.array_equal(a, b) for a, b in zip(bands, kept, strict=True))
