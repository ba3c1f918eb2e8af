"""Thresholds of observers for images, Landolt rings, and the acuity of people: for people.md and its tests.

Images are detected in one of two intervals, or identified as one of four.

The observers are those that give the activity of their neurons, with one standard deviation of independent noise
on all of them. Templates are the expected activity, or what the observer makes of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.observers.decision import answer_probabilities
from todframes.observers.internal_noise import Bands
from todframes.observers.retina import RetinaGrid, resample
from todframes.psychometrics.threshold_search import find_crossing
from todframes.stimulus import coverage

CONTRAST_RANGE = (1e-9, 1e9)
"""Smallest and largest contrast in the search for a threshold."""

SQUARE_WAVE_CONTRAST = 4.0 / math.pi * 0.913
"""Contrast of the fundamental of the square waves of Ashraf et al. 2025; the third harmonic of a grating above 25
cycles/degree is beyond what an eye passes."""

PX_PER_SIZE = 16.0
"""Pixels by which the √area of a triangle is drawn."""

POINTS_PER_PX = 8
"""Points along each side of a pixel by which a ring is drawn; their mean is within 1 % of the area."""


class HasActivity(Protocol):
    """An observer with neurons; `settings` has `retina_pitch_mrad` and `noise_sd`."""

    @property
    def settings(self) -> Any: ...  # noqa: D102 - the class describes it

    def activity(self, contrast: FloatArray) -> Bands:
        """Return the noise-free activity of all neurons for a retina image, its side 4 · 2^k + 1."""


@runtime_checkable
class HasTemplates(Protocol):
    """An observer whose weights are not the expected activity itself."""

    def template_of(self, expected: Bands) -> Bands:
        """Return the weights of an expected activity."""


def activity_of(observer: HasActivity, contrast: FloatArray, pitch_mrad: float) -> Bands:
    """Compute the activity for an image of square pixels, seen with background around it.

    Parameters
    ----------
    contrast : ndarray, shape (rows, columns)
    pitch_mrad : float
        Visual angle of a pixel.
    """
    pitch = observer.settings.retina_pitch_mrad
    samples = max(contrast.shape) * pitch_mrad / pitch
    grid = RetinaGrid(4 * 2 ** math.ceil(math.log2(max(samples / 4.0, 1.0))) + 1, pitch)
    y_px, x_px = ((length - 1) / 2.0 for length in contrast.shape)
    return observer.activity(resample(contrast, grid, x_px=x_px, y_px=y_px, pixel_pitch_mrad=pitch_mrad))


def detection_d_prime(observer: HasActivity, signal: Bands, noise: Sequence[Bands] = ()) -> float:
    """Compute d′ of one of two intervals, one of which shows a signal.

    Parameters
    ----------
    signal : Bands
        Activity caused by the signal.
    noise : sequence of Bands
        Activity caused by draws of the noise in the images. The variance of their scores has a relative standard
        error of √(2 / draws).

    Returns
    -------
    float
        Of 1.406, 84 % of the answers are right: P = Φ(d′ / √2).
    """
    weights = observer.template_of(signal) if isinstance(observer, HasTemplates) else signal
    variance = observer.settings.noise_sd**2 * _product(weights, weights)
    if noise:
        variance += float(np.var([_product(weights, one) for one in noise], ddof=1))
    return _product(weights, signal) / math.sqrt(variance)


def gabor(
    observer: HasActivity,
    frequency_cyc_per_deg: float,
    *,
    sd_deg: float,
    samples_per_deg: int = 1200,
    contrast: float = SQUARE_WAVE_CONTRAST,
) -> Bands:
    """Compute the activity for a grating in a Gaussian envelope, out to 1.4°, four standard deviations of the
    aperture of `csf`. With few samples a degree, replicas of the grating fold into what the retina passes.
    """
    place = np.arange(-1.4, 1.4, 1.0 / samples_per_deg)
    envelope = np.exp(-(place**2) / (2.0 * sd_deg**2))
    wave = contrast * envelope * np.cos(2.0 * math.pi * frequency_cyc_per_deg * place)
    return activity_of(observer, np.outer(envelope, wave), math.radians(1000.0) / samples_per_deg)


def resolution_limit(observer: HasActivity, *, sd_deg: float, d_prime: float) -> float:
    """Find the frequency in cycles/degree, from 20 to 80, at which a grating has this d′."""
    from scipy.optimize import brentq

    def excess(frequency: float) -> float:
        return math.log(detection_d_prime(observer, gabor(observer, frequency, sd_deg=sd_deg)) / d_prime)

    return float(brentq(excess, 20.0, 80.0, xtol=0.005))


def identification_threshold(observer: HasActivity, images: Sequence[Bands], *, p_correct: float = 0.75) -> float:
    """Find the contrast at which one of four images is identified.

    Parameters
    ----------
    images : sequence of four Bands
        Activity caused by each at contrast 1.
    p_correct : float
        Proportion of right answers at the threshold.

    Raises
    ------
    SettingsError
        If there is no such contrast: the images look the same.
    """
    proportion = _identified(observer, images)
    found = find_crossing(proportion, p_correct, bounds=CONTRAST_RANGE, start=1.0, factor=4.0)
    status, threshold = found[:2]
    if threshold is None:
        raise SettingsError(f"images: found none that is identified ({status}), expected four different ones")
    return float(threshold)


def _identified(observer: HasActivity, images: Sequence[Bands]) -> Callable[[float], float]:
    """Return the proportion of images that are identified, as a function of contrast."""
    rows = np.array([np.concatenate([band.ravel() for band in bands]) for bands in images])
    rows -= rows.mean(axis=0)
    products = rows @ rows.T
    covariance = observer.settings.noise_sd**2 * products

    def proportion(contrast: float) -> float:
        return float(np.diagonal(answer_probabilities(contrast * products, covariance)).mean())

    return proportion


def triangle_acuity(observer: HasActivity, *, blur_mrad: float = 0.0) -> float:
    """Find the √area in mrad at which 75 % of triangles of contrast 1 are identified behind a Gaussian blur."""
    from scipy.ndimage import gaussian_filter

    def proportion(size_mrad: float) -> float:
        pitch = size_mrad / PX_PER_SIZE
        half = math.ceil((1.5 * size_mrad + 4.0 * blur_mrad + 1.0) / pitch)
        upright = coverage((2 * half + 1,) * 2, size_px=PX_PER_SIZE, x_px=half, y_px=half, orientation="up")
        seen = gaussian_filter(np.asarray(upright), blur_mrad / pitch, mode="constant", truncate=6.0)
        images = [np.ascontiguousarray(np.rot90(seen, -k)) for k in range(4)]
        return _identified(observer, [activity_of(observer, image, pitch) for image in images])(1.0)

    size = find_crossing(proportion, 0.75, bounds=(0.05, 50.0), start=1.0, factor=2.0)[1]
    if size is None:
        raise SettingsError("triangles: found none from 0.05 to 50 mrad that is identified")
    return float(size)


def intrinsic_blur(blurs: FloatArray, acuities: FloatArray) -> tuple[float, float]:
    """Fit MAR₀ √(1 + (σ / σ_int)²) to the logarithms of acuities behind blurs σ: MAR₀, and σ_int in units of σ."""
    from scipy.optimize import least_squares

    def left(theta: FloatArray) -> FloatArray:
        return np.asarray(theta[0] + 0.5 * np.log1p((blurs / np.exp(theta[1])) ** 2) - np.log(acuities))

    unblurred, intrinsic = np.exp(least_squares(left, [np.log(acuities.min()), np.log(np.median(blurs))]).x)
    return float(unblurred), float(intrinsic)


def _product(a: Bands, b: Bands) -> float:
    return sum(float(np.vdot(one, other)) for one, other in zip(a, b, strict=True))


def landolt_ring(shape_px: int, *, gap_px: float, quarter_turns: int = 0) -> FloatArray:
    """Draw a Landolt ring: outer diameter 5 gaps, width of the ring 1 gap.

    Parameters
    ----------
    shape_px : int
        Side of the square image, whose middle is the ring's.
    gap_px : float
        Width of the gap, > 0.
    quarter_turns : int
        Clockwise turns from a gap on the right.

    Returns
    -------
    ndarray, shape (shape_px, shape_px)
        Share of each pixel that the ring covers.
    """
    place = (np.arange(shape_px * POINTS_PER_PX) + 0.5) / POINTS_PER_PX - shape_px / 2.0
    radius = np.hypot(place, place[:, None]) / gap_px
    is_gap = (np.abs(place[:, None]) < gap_px / 2.0) & (place > 0.0)
    inside = (radius < 2.5) & (radius > 1.5) & ~is_gap
    pixels = inside.reshape(shape_px, POINTS_PER_PX, shape_px, POINTS_PER_PX).mean(axis=(1, 3))
    return np.rot90(pixels, -quarter_turns)


def people_acuity(*, contrast: float, luminance_cd_m2: float) -> float:
    """Compute the decimal acuity of young people for a Landolt ring: 1 / gap in arcmin.

    Parameters
    ----------
    contrast : float
        0.03 to 1.
    luminance_cd_m2 : float
        Of the background, > 0.

    Ikeda, Noda & Yamaguchi, as quoted; not checked against their paper.
    """
    per_cent = 100.0 * contrast
    return float(
        luminance_cd_m2 / (1.6293 * per_cent**-0.3234 * (0.8034 * per_cent**-0.1876 + luminance_cd_m2**0.25) ** 4)
    )
