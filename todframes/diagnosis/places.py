"""The places of single triangles in a shaken recording: what each frame shows, and where the others are.

The likelihood of a place is the mean over the four orientations, so that no place favours the stated one. Peaks of
its logarithm are weighed with a normal distribution about the mean place, which is estimated from the clear trials
(empirical Bayes). A trial that shows nothing has the mean place.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from todframes.base._typing import ComplexArray, FloatArray
from todframes.diagnosis.triangle import Shape, Square, multiplicity, picture

MOST_PEAKS = 12
"""Largest number of peaks of a trial that are kept."""

CLEAR_LIKELIHOOD, CLEAR_LEAD = 18.0, 5.0
"""Least log likelihood of a peak, that of six standard deviations, and its least lead over the next, for a trial
whose place is clear without the others."""

LIKELY = 0.5
"""Least probability of a peak for a trial to have a place of its own."""

LEAST_CLEAR = 4
"""Least number of clear trials from which the scatter is estimated."""


class Template(NamedTuple):
    """A triangle in each orientation, divided by the noise's spectrum, for windows of n × n blocks.

    `spectra` has shape (4, length, length/2 + 1). `energy`, (4,), is the squared signal-to-noise ratio of a
    triangle of contrast 1 in noise of unit variance.
    """

    spectra: ComplexArray
    energy: FloatArray
    length: int

    @classmethod
    def of(cls, shape: Shape, noise: FloatArray, n: int) -> Template:
        """Return the template of a shape, for noise whose power spectrum, (length, length/2 + 1), has mean 1."""
        centred = shape._replace(amplitude=1.0, x=0.0, y=0.0)
        square = Square.about(centred, n)
        length = len(noise)
        reach = min(square.side, length - 1) // 2  # of a large triangle, the square is larger than all
        part = slice(square.side // 2 - reach, square.side // 2 + reach + 1)
        padded = np.zeros((4, length, length))
        padded[:, : 2 * reach + 1, : 2 * reach + 1] = picture(centred, square, n).images[:, part, part]
        # The middle of the square goes to (0, 0), so that peaks lie where the centroids are.
        spectrum = np.fft.rfft2(np.roll(padded, (-reach, -reach), axis=(1, 2)))
        spectrum[:, 0, 0] = 0.0
        energy = (multiplicity(length) * np.square(np.abs(spectrum)) / noise).sum(axis=(1, 2))
        return cls(np.asarray(np.conj(spectrum) / noise, np.complex128), energy, length)

    def peaks(self, window: FloatArray, *, contrast: float | None, noise: float, reach: float) -> Peaks:
        """Return the peaks of the log likelihood within a distance from the middle along each axis, highest first.

        `window`, (n, n), is a contrast, `contrast` that of the triangle, None if it is not known, and `noise` the
        standard deviation of a block.
        """
        n = len(window)
        spectrum = np.fft.rfft2(window, (self.length, self.length))
        heights = np.fft.irfft2(spectrum * self.spectra, (self.length, self.length))[:, :n, :n]
        energy = self.energy[:, None, None]
        if contrast is None:
            of_turn = np.square(np.maximum(heights, 0.0)) / (2.0 * energy * noise**2)
        else:
            of_turn = contrast * (heights - contrast * energy / 2.0) / noise**2
        likelihood = np.logaddexp.reduce(of_turn, axis=0) - math.log(4.0)
        middle = (n - 1) // 2
        first = max(middle - math.ceil(reach), 1)
        inner = slice(first, n - first)
        highest_around = maximum_filter(likelihood, 3)[inner, inner]
        rows, columns = np.nonzero(likelihood[inner, inner] >= highest_around) + np.array(first)
        order = np.argsort(-likelihood[rows, columns], kind="stable")[:MOST_PEAKS]
        rows, columns = rows[order], columns[order]
        at = likelihood[rows, columns]
        left, right = likelihood[rows, columns - 1], likelihood[rows, columns + 1]
        above, below = likelihood[rows - 1, columns], likelihood[rows + 1, columns]
        bend_x, bend_y = (
            np.maximum(2.0 * at - before - after, 1e-9) for before, after in ((left, right), (above, below))
        )
        x, y = columns + (right - left) / (2.0 * bend_x), rows + (below - above) / (2.0 * bend_y)
        places = np.column_stack([x, y])
        return Peaks(places - (n - 1) / 2.0, 2.0 / (bend_x + bend_y), at)


class Peaks(NamedTuple):
    """Peaks of a trial's log likelihood: places (x, y) from the middle, (peak, 2), variances, heights, (peak,)."""

    places: FloatArray
    variance: FloatArray
    height: FloatArray

    def moved(self, offset: tuple[float, float]) -> Peaks:
        """Return the peaks with places counted from an offset from the middle."""
        return self._replace(places=self.places - offset)


def strong_peaks(images: Iterable[tuple[FloatArray, float, float]], *, reach: float) -> list[Peaks]:
    """Return the peaks of strong trials for a triangle of unknown contrast, in the polarity that shows it better.

    Each item has an image, (n, n), the standard deviation of its white noise and the size of the triangle.
    """
    of_sign: dict[float, list[Peaks]] = {1.0: [], -1.0: []}
    template, its_size = None, 0.0
    for image, noise, size in images:
        if template is None or size != its_size:
            n, its_size = len(image), size
            template = Template.of(Shape.upright(1.0, 0.0, 0.0, size), np.ones((2 * n, n + 1)), n)
        for sign, peaks in of_sign.items():
            peaks.append(template.peaks(sign * image, contrast=None, noise=noise, reach=reach))

    def typical_height(peaks: list[Peaks]) -> float:
        return float(np.median([one.height[0] if len(one.height) else 0.0 for one in peaks]))

    return max(of_sign.values(), key=typical_height)


class TrialPlaces(NamedTuple):
    """Places of trials, (trial, 2), with their standard errors along an axis, (trial,).

    `is_own` marks trials whose own frames show the place; the others have the `mean`, (2,). `scatter` is the
    standard deviation of the places along an axis.
    """

    places: FloatArray
    error: FloatArray
    is_own: NDArray[np.bool_]
    mean: FloatArray
    scatter: float


def chosen_places(peaks: list[Peaks]) -> TrialPlaces | None:
    """Choose the place of each trial from its peaks; None if too few trials are clear.

    Places are counted from the start of each trial's search.
    """
    n = len(peaks)
    places, variance = np.zeros((n, MOST_PEAKS, 2)), np.ones((n, MOST_PEAKS))
    height = np.full((n, MOST_PEAKS), -np.inf)
    for k, of_trial in enumerate(peaks):
        count = len(of_trial.height)
        places[k, :count], variance[k, :count], height[k, :count] = of_trial
    lead = height[:, 0] - np.where(np.isfinite(height[:, 1]), height[:, 1], 0.0)
    is_clear = (height[:, 0] >= CLEAR_LIKELIHOOD) & (lead >= CLEAR_LEAD)
    if is_clear.sum() < LEAST_CLEAR:
        return None
    best, each = np.zeros(n, np.intp), np.arange(n)
    mean = np.median(places[is_clear, 0], axis=0)
    for _ in range(3):
        known = np.flatnonzero(is_clear)
        mean, scatter = _scatter(places[known, best[known]], variance[known, best[known]], mean)
        both = scatter**2 + variance
        away = np.square(places - mean).sum(axis=2)
        # A peak of a flat likelihood is no more likely than the rest of what may be: its height counts above 0.
        score = np.where(np.isfinite(height), height - away / (2.0 * both) - np.log(both / variance), -np.inf)
        best = score.argmax(axis=1)
        top = score[each, best]
        top = np.maximum(top, -1e300)  # of a trial without any peak
        total = np.exp(score - top[:, None]).sum(axis=1) + np.exp(-np.maximum(top, -50.0))
        likely = 1.0 / total
        is_clear = (likely > 0.99) & (height[each, best] > CLEAR_LIKELIHOOD / 2.0)
        if is_clear.sum() < LEAST_CLEAR:
            return None
    is_own = likely >= LIKELY
    share = np.where(is_own, scatter**2 / both[each, best], 0.0)
    found = mean + share[:, None] * (places[each, best] - mean)
    error = np.sqrt(np.where(is_own, share * variance[each, best], scatter**2))
    return TrialPlaces(found, error, is_own, mean, scatter)


def _scatter(places: FloatArray, variance: FloatArray, middle: FloatArray) -> tuple[FloatArray, float]:
    """Return the mean of places, and their standard deviation along an axis beyond their errors, by moments."""
    weight = 1.0 / (variance + float(np.square(places - middle).mean()) + 1e-12)
    mean = weight @ places / weight.sum()
    excess = np.square(places - mean).mean(axis=1) * len(places) / (len(places) - 1.0) - variance
    return mean, math.sqrt(max(float(weight @ excess / weight.sum()), 1e-8))
