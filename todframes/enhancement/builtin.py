"""The enhancement algorithms of this package; each calls scikit-image or OpenCV.

Images are code values with white as 1, of shape (rows, columns). The first lines of the functions' docstrings
appear in lists and reports.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal

import cv2
import numpy as np

from todframes.enhancement.algorithm import Image, algorithm, meaning, parameter

Sigma = Annotated[float, parameter(0.1, 50.0, unit="px", what="standard deviation of the Gaussian")]

Radius = Annotated[int, parameter(1, 50, unit="px", what="half the window's side")]

Factor = Annotated[int, parameter(2, 8, what="pixels for one along each axis")]

Iterations = Annotated[int, parameter(1, 1000, what="iterations")]

_built_in = partial(algorithm, each_channel=True, writes=False)
"""Declare an algorithm of code values that takes one channel at a time and does not write into its input."""


@_built_in(library="–")
def none(image: Image) -> Image:
    """The frame as it is; all others are compared with it."""
    return image


@_built_in(library="OpenCV: createCLAHE")
def clahe(
    image: Image,
    *,
    clip_limit: Annotated[
        float, parameter(0.0, 1000.0, what="most contrast gain, as a factor; 0: no limit")
    ] = 2.0,
    tiles: Annotated[int, parameter(1, 64, what="tiles along each axis")] = 8,
    bits: Annotated[Literal[8, 16], meaning("of the code values that it works on")] = 8,
) -> Image:
    """Contrast-limited adaptive histogram equalisation."""
    full_scale, kind = 2**bits - 1, {8: np.uint8, 16: np.uint16}[bits]
    codes = np.rint(_within_0_and_1(image) * full_scale).astype(kind)
    return np.asarray(cv2.createCLAHE(clip_limit, (tiles, tiles)).apply(codes) / np.float32(full_scale))


@_built_in(library="scikit-image: filters.unsharp_mask")
def unsharp(
    image: Image,
    *,
    radius: Sigma = 2.0,
    amount: Annotated[
        float, parameter(0.0, 100.0, what="share of the difference from the blurred image, added")
    ] = 1.0,
) -> Image:
    """Unsharp mask."""
    from skimage.filters import unsharp_mask

    return np.asarray(unsharp_mask(image, radius=radius, amount=amount, preserve_range=True))


@_built_in(library="OpenCV: GaussianBlur")
def gaussian(image: Image, *, sigma: Sigma = 1.0) -> Image:
    """Gaussian blur."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REFLECT_101))


@_built_in(library="OpenCV: medianBlur; from radius 3 scikit-image: filters.median")
def median(
    image: Image, *, radius: Annotated[int, parameter(1, 20, unit="px", what="half the window's side")] = 1
) -> Image:
    """Median of a square window."""
    side = 2 * radius + 1
    if side <= 5:
        return np.asarray(cv2.medianBlur(image, side))
    from skimage.filters import median as median_filter

    return np.asarray(median_filter(image, np.ones((side, side)), mode="nearest"))


@_built_in(library="OpenCV: bilateralFilter")
def bilateral(
    image: Image,
    *,
    sigma: Sigma = 2.0,
    sigma_value: Annotated[
        float, parameter(1e-4, 10.0, unit="white", what="differences much above it are kept")
    ] = 0.05,
) -> Image:
    """Bilateral filter: a blur that stops at edges."""
    return np.asarray(cv2.bilateralFilter(image, -1, sigma_value, sigma))


@_built_in(library="scikit-image: restoration.denoise_nl_means")
def nlm(
    image: Image,
    *,
    h: Annotated[
        float, parameter(1e-4, 10.0, unit="white", what="patches that differ by less are averaged")
    ] = 0.05,
    patch_size: Annotated[int, parameter(3, 15, unit="px", what="side of a patch")] = 5,
    patch_distance: Annotated[int, parameter(1, 50, unit="px", what="how far patches are searched for")] = 6,
    sigma: Annotated[
        float, parameter(0.0, 10.0, unit="white", what="the noise's standard deviation, if known")
    ] = 0.0,
) -> Image:
    """Non-local means."""
    from skimage.restoration import denoise_nl_means

    return np.asarray(
        denoise_nl_means(image, patch_size=patch_size, patch_distance=patch_distance, h=h, sigma=sigma)
    )


@_built_in(library="scikit-image: restoration.denoise_tv_chambolle")
def tv(
    image: Image,
    *,
    weight: Annotated[float, parameter(1e-5, 100.0, unit="white", what="strength")] = 0.05,
    iterations: Iterations = 200,
) -> Image:
    """Total-variation denoising (Chambolle)."""
    from skimage.restoration import denoise_tv_chambolle

    return np.asarray(denoise_tv_chambolle(image, weight=weight, max_num_iter=iterations))


@_built_in(library="scikit-image: restoration.wiener")
def wiener(
    image: Image,
    *,
    sigma: Sigma = 1.0,
    balance: Annotated[float, parameter(1e-9, 1e9, what="weight of smoothness against sharpness")] = 0.1,
) -> Image:
    """Wiener–Hunt deconvolution of a Gaussian blur."""
    from skimage.restoration import wiener as deconvolve

    return _deconvolved(image, lambda wide, psf: deconvolve(wide, psf, balance, clip=False), sigma, 16.0)


@_built_in(library="scikit-image: restoration.richardson_lucy")
def richardson_lucy(image: Image, *, sigma: Sigma = 1.0, iterations: Iterations = 10) -> Image:
    """Richardson–Lucy deconvolution of a Gaussian blur."""
    from skimage.restoration import richardson_lucy as deconvolve

    # The effect of the border spreads inwards like a random walk, by a blur's width at each iteration.
    reach = 5.0 * math.sqrt(iterations)
    image = _not_negative(image)
    return _deconvolved(image, lambda wide, psf: deconvolve(wide, psf, iterations, clip=False), sigma, reach)


@_built_in(library="OpenCV contrib: ximgproc.guidedFilter")
def guided(
    image: Image,
    *,
    radius: Radius = 4,
    eps: Annotated[float, parameter(1e-10, 100.0, unit="white²", what="variances much above it are kept")] = 1e-3,
) -> Image:
    """Guided filter, the image its own guide: a blur that stops at edges."""
    return np.asarray(cv2.ximgproc.guidedFilter(image, image, radius, eps))


@_built_in(library="scikit-image: exposure.adjust_gamma")
def gamma(image: Image, *, gamma: Annotated[float, parameter(0.05, 20.0, what="exponent")] = 0.7) -> Image:
    """Code values to the power of gamma: below 1 brighter."""
    from skimage.exposure import adjust_gamma

    return np.asarray(adjust_gamma(_not_negative(image), gamma))


@_built_in(library="scikit-image: exposure.equalize_hist")
def equalize(
    image: Image, *, bins: Annotated[int, parameter(2, 65536, what="bins of the histogram")] = 256
) -> Image:
    """Histogram equalisation."""
    from skimage.exposure import equalize_hist

    return np.asarray(equalize_hist(image, nbins=bins))


@_built_in(library="OpenCV: resize, INTER_CUBIC", magnification="factor")
def bicubic(image: Image, *, factor: Factor = 2) -> Image:
    """Super-resolution by bicubic interpolation: smaller pixels."""
    return np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC))


@_built_in(library="OpenCV: resize, INTER_LANCZOS4", magnification="factor")
def lanczos(image: Image, *, factor: Factor = 2) -> Image:
    """Super-resolution by Lanczos interpolation: smaller pixels."""
    return np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_LANCZOS4))


def _deconvolved(
    image: Image, deconvolve: Callable[[Image, Image], Any], sigma: float, reach_in_sigmas: float
) -> Image:
    """Deconvolve a Gaussian blur with the image reflected at its borders.

    The reflected margin is as wide as the effect of a border, `reach_in_sigmas`. Without it, deconvolution would
    use the opposite side of the frame, or black, beyond a border.
    """
    line = cv2.getGaussianKernel(2 * math.ceil(4.0 * sigma) + 1, sigma)
    margin = math.ceil(reach_in_sigmas * sigma)
    found = deconvolve(np.pad(image, margin, mode="symmetric"), line @ line.T)
    return np.ascontiguousarray(found[margin:-margin, margin:-margin])


def _not_negative(image: Image) -> Image:
    if image.min() < 0.0:
        raise ValueError(f"code values start at {image.min():g} of white, expected 0 or more")
    return image


def _within_0_and_1(image: Image) -> Image:
    if image.min() < 0.0 or image.max() > 1.0:
        raise ValueError(f"code values run from {image.min():g} to {image.max():g} of white, expected 0 to 1")
    return image
