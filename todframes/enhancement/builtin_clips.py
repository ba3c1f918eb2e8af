"""The enhancement algorithms of this package that take clips; each calls OpenCV or NumPy.

Frames are code values with white as 1, of shape (n, rows, columns), in the order of time. All of them are causal:
the result of a frame depends on that frame and on those before it. The first lines of the functions' docstrings
appear in lists and reports.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import pairwise
from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from todframes.base.reading import MOST_WARM_UP
from todframes.enhancement.algorithm import Image, algorithm, meaning, parameter

Judged = NDArray[np.intp]

Motion = Literal["translation", "euclidean", "affine"]

Before = Annotated[int, parameter(0, 1000, what="frames before a frame that are taken with it")]

Motions = Annotated[Motion, meaning("how frames may differ: shifted, also turned, also stretched")]

Smoothing = Annotated[
    Literal[5, 11],
    meaning("side in px of the Gaussian that frames are smoothed with to be registered; wider in noise"),
]

_of_clips = partial(algorithm, clip=True, each_channel=True, writes=False)
"""Declare an algorithm of clips of code values that takes one channel at a time and does not write into it."""


@_of_clips(library="NumPy: mean", warm_up_frames="before")
def temporal_mean(frames: Image, *, judged: Judged, before: Before = 3) -> Image:
    """Mean of a frame and those before it."""
    return np.stack([frames[k - before : k + 1].mean(axis=0) for k in judged])


@_of_clips(library="OpenCV: accumulateWeighted", warm_up_frames="before")
def recursive(
    frames: Image,
    *,
    weight: Annotated[
        float, parameter(1e-3, 1.0, what="share of the new frame; the rest is the result before")
    ] = 0.25,
    before: Annotated[
        int, parameter(0, MOST_WARM_UP, what="frames before the trial; the first is the start")
    ] = 16,
) -> Image:
    """Recursive filter: a running mean in which old frames fade."""
    state, found = frames[0].astype(np.float64), []
    for number, frame in enumerate(frames):
        if number:
            cv2.accumulateWeighted(frame, state, weight)
        if number >= before:
            found.append(state.copy())
    return np.stack(found)


@_of_clips(library="OpenCV: fastNlMeansDenoisingMulti", warm_up_frames="before")
def temporal_nlm(
    frames: Image,
    *,
    judged: Judged,
    h: Annotated[
        float, parameter(1e-4, 1.0, unit="white", what="patches that differ by less are averaged")
    ] = 0.02,
    before: Annotated[
        Literal[2, 4, 6, 8], meaning("frames before a frame in which its patches are searched for too")
    ] = 4,
    patch_size: Annotated[Literal[3, 5, 7, 9], meaning("side of a patch in px")] = 7,
    window_size: Annotated[
        Literal[11, 21, 31], meaning("side in px of the window where patches are searched for")
    ] = 21,
) -> Image:
    """Non-local means over a frame and those before it, on 16-bit code values."""
    # Differences of patches do not depend on where the codes begin, so values beyond black and white fit as well.
    low, high = min(0.0, float(frames.min())), max(1.0, float(frames.max()))
    scale = 65535 / (high - low)
    codes = np.rint((frames - np.float32(low)) * np.float32(scale)).astype(np.uint16)
    found = []
    for k in judged:
        # OpenCV denoises the frame in the middle and searches all alike, so their order has no effect.
        earlier = list(codes[k - before : k])
        window = [*earlier[: before // 2], codes[k], *earlier[before // 2 :]]
        denoised = cv2.fastNlMeansDenoisingMulti(
            window,
            before // 2,
            before + 1,
            h=[h * scale],
            templateWindowSize=patch_size,
            searchWindowSize=window_size,
            normType=cv2.NORM_L1,
        )
        found.append(denoised / np.float32(scale) + np.float32(low))
    return np.stack(found)


@_of_clips(library="OpenCV: findTransformECC, warpAffine", warm_up_frames="before")
def registered_mean(
    frames: Image,
    *,
    judged: Judged,
    before: Before = 3,
    motion: Motions = "translation",
    smoothing_px: Smoothing = 5,
) -> Image:
    """Mean of a frame and those before it, registered to it by the whole picture (ECC)."""
    return _registered(frames, judged, before, motion, smoothing_px, factor=1)


@_of_clips(library="OpenCV: findTransformECC, warpAffine")
def stabilize(frames: Image, *, smoothing_px: Smoothing = 5) -> Image:
    """Frames of a trial shifted to their mean place, found from frame to frame (ECC)."""
    steps = [_ecc_warp(one, other, "translation", smoothing_px)[:, 2] for one, other in pairwise(frames)]
    places = np.cumsum([np.zeros(2), *steps], axis=0)
    found = []
    for frame, from_mean in zip(frames, places - places.mean(axis=0), strict=True):
        found.append(_warped(frame, np.hstack([np.eye(2), from_mean[:, None]]), frame.shape))
    return np.stack(found)


@_of_clips(library="OpenCV: findTransformECC, warpAffine", warm_up_frames="before", magnification="factor")
def shift_and_add(
    frames: Image,
    *,
    judged: Judged,
    before: Before = 7,
    factor: Annotated[int, parameter(2, 8, what="pixels for one along each axis")] = 2,
    motion: Motions = "translation",
    smoothing_px: Smoothing = 5,
) -> Image:
    """Super-resolution from several frames: registered (ECC), interpolated and averaged on smaller pixels."""
    return _registered(frames, judged, before, motion, smoothing_px, factor=factor)


def _registered(
    frames: Image, judged: Judged, before: int, motion: Motion, smoothing_px: int, *, factor: int
) -> Image:
    """Average judged frames with those before them, registered to them, on pixels that are finer by a factor."""
    # A pixel of the result, x, lies at (x − (factor − 1) / 2) / factor of the frame.
    middle = (1.0 - factor) / 2.0
    finer = np.array([[1.0, 0.0, middle], [0.0, 1.0, middle], [0.0, 0.0, factor]]) / factor
    shape = factor * frames.shape[1], factor * frames.shape[2]
    means = []
    for k in judged:
        warps = [_ecc_warp(frames[k], frame, motion, smoothing_px) for frame in frames[k - before : k]]
        own = zip(frames[k - before : k + 1], [*warps, np.eye(2, 3)], strict=True)
        means.append(
            sum(_warped(frame, warp @ finer, shape).astype(np.float64) for frame, warp in own) / (before + 1)
        )
    return np.stack(means)


def _ecc_warp(reference: Image, frame: Image, motion: Motion, smoothing_px: int) -> NDArray[np.float64]:
    """Return the place in a frame of each place in the reference, a (2, 3) matrix.

    There is no motion if ECC finds none, or one that brings no more into agreement than the noise of two frames.
    """
    start, everywhere = np.eye(2, 3, dtype=np.float32), np.ones(frame.shape, np.uint8)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-6)
    try:
        kind = getattr(cv2, f"MOTION_{motion.upper()}")
        correlation, warp = cv2.findTransformECC(reference, frame, start, kind, criteria, everywhere, smoothing_px)
    except cv2.error:  # it does not converge
        return np.eye(2, 3)
    common = cv2.warpAffine(everywhere, warp, frame.shape[::-1], flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)
    # Five standard deviations of the correlation of two frames of noise.
    is_sure = correlation > 5.0 * correlation_of_noise(max(int(common.sum()), 1), smoothing_px)
    return np.asarray(warp, np.float64) if is_sure else np.eye(2, 3)


def correlation_of_noise(n_px: int, smoothing_px: int) -> float:
    """Return the standard deviation of the correlation of two pictures of smoothed noise, of so many pixels.

    The autocorrelation of smoothed white noise is exp(−r² / 4σ²), whose square has the integral 2πσ².
    """
    sigma_px = 0.3 * ((smoothing_px - 1) / 2 - 1) + 0.8  # OpenCV's Gaussian of this side
    return math.sqrt(2.0 * math.pi * sigma_px**2 / n_px)


def _warped(frame: Image, warp: NDArray[np.float64], shape: tuple[int, ...]) -> Image:
    """Return a frame at places that a matrix gives for each pixel of the result, by cubic interpolation."""
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(frame, warp, shape[1::-1], flags=flags, borderMode=cv2.BORDER_REFLECT_101))
