"""The triangle that frames show: a fit of its place, size, turn, contrast and orientation.

The picture of a triangle is its exact coverage of the pixels, under an affine map, after a Gaussian blur, on a
polynomial background. It is fitted to windows about the stated place by least squares, which is maximum likelihood
for white noise. The covariance does not take the noise to be white: it follows from the power spectrum of what the
fit leaves, so it holds for blurred noise, for fixed patterns, and for windows that the frame's edge cuts.

Lengths are in blocks of pixels, places are counted from the middle of the window, y down.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.frames.dataset import WarningCode
from todframes.stimulus import ORIENTATIONS, moving_coverage, triangle_coverage, vertices

N_PARAMETERS = 8
AMPLITUDE, X, Y, XX, XY, YX, YY, BLUR = range(N_PARAMETERS)
"""Parameters of a picture: amplitude, place, changes of the affine map, variance of the blur."""

OF_TRIAL = np.zeros((4, N_PARAMETERS))
OF_TRIAL[0, AMPLITUDE] = OF_TRIAL[1, X] = OF_TRIAL[2, Y] = OF_TRIAL[3, XX] = OF_TRIAL[3, YY] = 1.0
"""Parameters that are measured of single trials: amplitude, place, and size as a ratio."""

OF_GROUP = np.zeros((5, N_PARAMETERS))
OF_GROUP[:4], OF_GROUP[4, YX], OF_GROUP[4, XY] = OF_TRIAL, 0.5, -0.5
OF_GROUP[3] /= 2.0
"""Combinations whose errors are stated for a group: amplitude, place, size as a share, and rotation."""

UNIT_TRIANGLES = np.array([vertices(size=1.0, orientation=orientation) for orientation in ORIENTATIONS])
"""Corners (x, y) of triangles of size 1 in each orientation about their centroid: (4, 3, 2)."""

ROUGHLY = 1e-3
"""Precision of a fit from which another begins, in sizes and radians."""


class Arrangement(NamedTuple):
    """A change of all orientations that a camera or an import may cause, in `words`. `shown` is the orientation on
    the frames for each of the manifest. `code` is that of the warning about it, None: as stated. `sign` is -1 if
    triangles are darker where the manifest says brighter, or the other way round.
    """

    name: str
    shown: tuple[int, int, int, int]
    code: WarningCode | None
    words: str
    sign: int = 1

    @property
    def mismatches(self) -> tuple[WarningCode, ...]:
        """Codes of the differences from what is stated."""
        polarity: tuple[WarningCode, ...] = ("polarity_mismatch",) if self.sign == -1 else ()
        return polarity if self.code is None else (*polarity, self.code)


TURNED = tuple(
    Arrangement(*turned)
    for turned in (
        ("as stated", (0, 1, 2, 3), None, "all are as stated"),
        ("mirrored", (0, 3, 2, 1), "mirrored", "left and right are swapped"),
        ("flipped", (2, 1, 0, 3), "flipped", "up and down are swapped"),
        ("half_turn", (2, 3, 0, 1), "turned", "all orientations are turned by 180°"),
        ("quarter_turn_right", (1, 2, 3, 0), "turned", "all orientations are turned clockwise by 90°"),
        ("quarter_turn_left", (3, 0, 1, 2), "turned", "all orientations are turned counter-clockwise by 90°"),
        ("anti_transposed", (1, 0, 3, 2), "mirrored", "up and right, and down and left, are swapped"),
        ("transposed", (3, 2, 1, 0), "mirrored", "up and left, and down and right, are swapped"),
    )
)  # fmt: skip
"""The eight arrangements of the stated polarity, the more likely ones first."""

ARRANGEMENTS = tuple(turned._replace(sign=sign) for turned in TURNED for sign in (1, -1))
"""All arrangements, of either polarity."""


class Shape(NamedTuple):
    """The picture of a triangle: contrast per unit of the level, centroid from the middle of the window, affine
    map (2, 2) of a triangle of size 1 in the stated orientation, and variance of the Gaussian blur.
    """

    amplitude: float
    x: float
    y: float
    map: FloatArray
    variance: float

    @classmethod
    def upright(cls, amplitude: float, x: float, y: float, size: float) -> Shape:
        """Return the shape of a triangle that is neither turned nor stretched."""
        return cls(amplitude, x, y, size * np.eye(2), 1.0)

    @property
    def size(self) -> float:
        """√(area)."""
        return math.sqrt(float(np.linalg.det(self.map)))

    @property
    def turn_rad(self) -> float:
        """Clockwise rotation: that of the rotation nearest to the map."""
        (xx, xy), (yx, yy) = self.map.tolist()
        return math.atan2(yx - xy, xx + yy)

    def moved(self, step: FloatArray) -> Shape:
        """Return the shape after a step of the parameters."""
        change = np.eye(2) + step[[XX, XY, YX, YY]].reshape(2, 2)
        return Shape(
            self.amplitude + float(step[AMPLITUDE]),
            self.x + float(step[X]),
            self.y + float(step[Y]),
            change @ self.map,
            self.variance + float(step[BLUR]),
        )


class Square(NamedTuple):
    """A square part of a window of n × n blocks, its first row and column and its side."""

    row: int
    column: int
    side: int

    @classmethod
    def about(cls, shape: Shape, n: int) -> Square:
        """Return the square about a triangle that is fitted; it may reach beyond the window."""
        reach = math.ceil(2.2 * shape.size + 1.0)  # corners lie at 0.88 sizes
        middle = (n - 1) // 2
        return cls(middle + round(shape.y) - reach, middle + round(shape.x) - reach, 2 * reach + 1)

    def shared(self, n: int) -> tuple[slice, slice, tuple[slice, slice]]:
        """Return the rows and columns of a window of n × n blocks in the square, and their place in the square."""
        firsts = (self.row, self.column)
        rows, columns = (slice(max(first, 0), max(min(first + self.side, n), 0)) for first in firsts)
        down, right = (
            slice(part.start - first, part.stop - first)
            for part, first in zip((rows, columns), firsts, strict=True)
        )
        return rows, columns, (down, right)

    def of(self, images: FloatArray) -> FloatArray:
        """Cut the square out of images, (…, n, n); 0 beyond them."""
        rows, columns, inner = self.shared(images.shape[-1])
        cut = np.zeros((*images.shape[:-2], self.side, self.side), images.dtype)
        cut[..., *inner] = images[..., rows, columns]
        return cut


def within(n: int, radius: float) -> NDArray[np.bool_]:
    """Return the blocks of n × n that lie within a distance from the middle."""
    v, u = np.mgrid[:n, :n] - (n - 1) / 2.0
    return np.asarray(np.hypot(u, v) <= radius)


class RenderedTriangle(NamedTuple):
    """A triangle in each orientation, (4, side, side), and its changes by the parameters, (4, 8, side, side)."""

    images: FloatArray
    slopes: FloatArray


def render(shape: Shape, square: Square, n: int) -> RenderedTriangle:
    """Compute the picture of a triangle on a square of a window of n × n blocks, in each orientation."""
    side = square.side
    x, y = _position(shape, square, n)
    parts = moving_coverage(_corners(shape, square, n), (side, side))
    for entry, (motion, at) in enumerate(((1, x), (1, y), (2, x), (2, y)), 3):
        parts[:, entry] -= at * parts[:, motion]  # the map is about the centroid
    shown = np.flatnonzero(parts.any(axis=(0, 1, 3)) | parts.any(axis=(0, 1, 2)))
    box = slice(shown[0], shown[-1] + 1) if shown.size else slice(0, 1)
    kernel, slope = (matrix[:, box] for matrix in blur_matrices(shape.variance, side))
    inner = parts[:, :, box, box]
    half = inner @ kernel.T
    blurred = kernel @ half
    blurring = slope @ half[:, 0] + kernel @ (inner[:, 0] @ slope.T)
    slopes = np.concatenate(
        [blurred[:, :1], shape.amplitude * blurred[:, 1:], shape.amplitude * blurring[:, None]], axis=1
    )
    return RenderedTriangle(shape.amplitude * blurred[:, 0], slopes)


def differences(shape: Shape, square: Square, weight: FloatArray) -> FloatArray:
    """Return the weighted pictures of the orientations less their mean, (4, side, side)."""
    images = render(shape, square, len(weight)).images
    return np.asarray((images - images.mean(axis=0)) * square.of(weight))


def _position(shape: Shape, square: Square, n: int) -> FloatArray:
    """Return the position (x, y) of a triangle on a square of a window."""
    return np.array([shape.x - square.column, shape.y - square.row]) + (n - 1) / 2.0


def _corners(shape: Shape, square: Square, n: int) -> FloatArray:
    """Return the corners (x, y) of a triangle in each orientation on a square of a window: (4, 3, 2)."""
    return UNIT_TRIANGLES @ shape.map.T + _position(shape, square, n)


def blur_matrices(variance: float, side: int) -> tuple[FloatArray, FloatArray]:
    """Return the matrix that blurs columns of blocks by a Gaussian, and its change by the variance: (side, side).
    The kernel is the Gaussian's spectrum up to the blocks' Nyquist frequency; it is exact for band-limited images,
    and sharpens if the variance is negative.
    """
    frequency = np.fft.rfftfreq(2 * side)
    spectrum = np.exp(-2.0 * np.square(np.pi * frequency) * variance)
    apart = np.abs(np.arange(side)[:, None] - np.arange(side))
    kernels = np.fft.irfft([spectrum, -2.0 * np.square(np.pi * frequency) * spectrum], 2 * side)
    return kernels[0][apart], kernels[1][apart]


class Given(NamedTuple):
    """The level, the standard deviation of a block's noise and the stated quarter turns of each trial: "
    "(trial,)."""

    level: FloatArray
    noise: FloatArray
    turns: NDArray[np.intp]


class Images(NamedTuple):
    """Mean frames of a group by orientation, with their weights. `background`, (n, n), is what all frames share,
    `triangles`, (4, n, n), what grows with the level by stated orientation. `shares`, (5, trial), are the weights
    of the frames in these, the triangles first. `information`, (4, 4), is the inverse covariance of a block of the
    triangles for noise of unit variance. `weight`, (n, n), is the share with which a block counts: 0 beyond the
    frames, less than 1 where they are unsteady. `of_view`, (view, trial), are the weights of the frames in the
    mean of each background, for frames on several.
    """

    background: FloatArray
    triangles: FloatArray
    shares: FloatArray
    information: FloatArray
    weight: FloatArray
    of_view: FloatArray | None = None

    @classmethod
    def of(
        cls,
        frames: FloatArray,
        given: Given,
        *,
        known: NDArray[np.bool_],
        hole: float,
        view: NDArray[np.intp] | None = None,
    ) -> Images:
        """Separate the part that all frames share from the part that grows with the level in each orientation. If
        the levels hardly differ, the two cannot be separated, and all of it counts as triangle. `noise` is the
        standard deviation of a block of each frame, (trial, n, n). `known` are the blocks that all frames have;
        within `hole` from the middle all of them count. With `view`, the number of each frame's background, frames
        share what others of their background have; if its levels do not differ, only the differences of the
        orientations count as triangle, which `information` accounts for.
        """
        level, noise, turns = given
        columns = np.array([np.where(turns == k, level, 0.0) for k in range(4)])
        certain = np.square(1.0 / noise)
        number = np.zeros(len(level), np.intp) if view is None else view
        of_view = np.where(np.arange(number.max() + 1)[:, None] == number, certain, 0.0)
        of_view /= of_view.sum(axis=1, keepdims=True)
        if view is None and level.max() <= 1.2 * level.min():
            of_view[:] = 0.0
        # The regression on levels, from which that on backgrounds is taken out (Frisch, Waugh and Lovell).
        apart = (columns.T - (of_view @ columns.T)[number]) / noise[:, None]
        of_triangles = np.linalg.pinv(apart, rcond=1e-6) / noise
        of_backgrounds = of_view - of_view @ (level[:, None] * of_triangles[turns])
        shares = np.vstack([of_triangles, of_backgrounds.mean(axis=0)])
        information = apart.T @ apart
        parts = np.tensordot(shares, frames, 1)
        weight = known.astype(np.float64)
        if len(frames) > 1:
            backgrounds = parts[4:] if view is None else np.tensordot(of_backgrounds, frames, 1)[view]
            left = frames - backgrounds - level[:, None, None] * parts[turns]
            spread = np.sqrt(np.square(left / noise[:, None, None]).mean(axis=0))
            # Letters that change from frame to frame count no more than the noise does elsewhere.
            steady = np.square(2.0 / np.maximum(spread, 2.0))
            weight *= np.where(within(len(known), hole), 1.0, steady)
        return cls(parts[4], parts[:4], shares, information, weight, None if view is None else of_view)

    @property
    def has_triangle(self) -> bool:
        """Whether the mean of the orientations is known, and not their differences alone."""
        counts = np.diag(self.information)
        return self.of_view is None or bool(self.information.sum() > 1e-3 * counts.sum())


class TriangleFit(NamedTuple):
    """The triangle that explains mean frames best. `shown` are the orientations on the frames for the four stated
    ones.
    """

    shape: Shape
    shown: tuple[int, ...]
    picture: RenderedTriangle
    square: Square


def _whitened(information: FloatArray) -> FloatArray:
    """Return factors (4, 4) that turn images of this information into images of unit variance."""
    values, vectors = np.linalg.eigh(information)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)


@lru_cache(maxsize=16)
def _polynomial(side: int) -> FloatArray:
    """Return the terms of the quadratic background on a square: (terms, side²)."""
    u = np.linspace(-1.0, 1.0, side)
    terms = [np.outer(u**i, u**j) for i in range(3) for j in range(3 - i)]
    return np.asarray(terms).reshape(len(terms), -1)


def _without_background(images: FloatArray, weight: FloatArray) -> FloatArray:
    """Return images times √weight, (…, side²), without the polynomial that fits them best."""
    root = np.sqrt(weight).ravel()
    terms = _polynomial(weight.shape[-1]) * root
    flat = images.reshape(*images.shape[:-2], -1) * root
    return np.asarray(flat - (flat @ terms.T) @ np.linalg.pinv(terms @ terms.T, hermitian=True) @ terms)


def fit(
    images: Images, start: Shape, shown: tuple[int, ...] = (0, 1, 2, 3), precision: float = 2e-4
) -> TriangleFit:
    """Fit the picture of a triangle to mean frames by Gauss–Newton steps, in the orientations `shown` for the
    stated ones, until a step is smaller than `precision`, in sizes and radians.
    """
    n = images.weight.shape[0]
    shape, most_rounds = start, 12
    for _ in range(most_rounds):
        square = Square.about(shape, n)
        model = render(shape, square, n)
        left = square.of(images.triangles) - model.images[list(shown)]
        products = _products(np.concatenate([model.slopes[list(shown)], left[:, None]], axis=1), images, square)
        scale = np.sqrt(np.maximum(np.diag(products)[:-1], 1e-300))
        step = np.linalg.lstsq(
            products[:-1, :-1] / np.outer(scale, scale), products[:-1, -1] / scale, rcond=1e-10
        )[0]
        step = step / scale
        shape = _bounded(shape.moved(_limited(step, shape)), start, n)
        if np.abs(np.append(step[[X, Y]] / shape.size, step[[XX, XY, YX, YY]])).max() < precision:
            break
    square = Square.about(shape, n)
    return TriangleFit(shape, shown, render(shape, square, n), square)


def _products(pictures: FloatArray, images: Images, square: Square) -> FloatArray:
    """Return the inner products of pictures, (4, p, side, side), summed over the orientations as their information
    weighs them, without the background that fits them best: (p, p).
    """
    root = np.sqrt(square.of(images.weight)).ravel()
    terms = _polynomial(square.side) * root
    inverse = np.linalg.pinv(terms @ terms.T, hermitian=True)
    n_pictures, flat = pictures.shape[1], pictures.reshape(4, -1)
    sums = np.zeros((n_pictures, n_pictures))
    for factors in _whitened(images.information):
        white = (factors @ flat).reshape(n_pictures, -1) * root
        of_terms = white @ terms.T
        sums += white @ white.T - of_terms @ inverse @ of_terms.T
    return sums


def errors_of(triangle: TriangleFit, images: Images) -> tuple[FloatArray, float]:
    """Return the standard errors of the contrast, of the place along x and y, of the size as a share, and of the
    rotation, (5,), and that of the contrast by noise alone, as the fit leaves it. The errors are larger by two
    factors: the fit has taken some of the noise, and leaves more at the edges of the triangle.
    """
    square, order = triangle.square, list(triangle.shown)
    factors, weight = _whitened(images.information), square.of(images.weight)
    left = images.triangles.copy()
    subtract(left, triangle.picture.images[order], square)
    white = np.tensordot(factors, left, 1)
    spectrum = noise_spectrum(white, images.weight, square.side)
    slopes = triangle.picture.slopes[order]
    products = _products(slopes, images, square)
    scale = np.sqrt(np.maximum(np.diag(products), 1e-200))  # its square is a number, too
    inverse = np.linalg.pinv(products / np.outer(scale, scale), rcond=1e-10, hermitian=True)
    of_slopes = OF_GROUP @ (inverse / np.outer(scale, scale))
    combined = np.tensordot(factors, np.tensordot(of_slopes, slopes, (1, 1)), (1, 1))
    filters = _without_background(combined, weight).reshape(combined.shape).swapaxes(0, 1) * np.sqrt(weight)
    alone = np.sqrt(filter_variances(filters, spectrum).sum(axis=1))
    # A square of 2.2 sizes counts as one independent value, set by `tests/triangles.py`: 95 % intervals hold
    # 96.8 % of true values, and 92.6 % with 1.5.
    cells = np.linalg.matrix_rank(images.information) * float(images.weight.sum())
    cells /= (2.2 * triangle.shape.size) ** 2
    inflation = cells / max(cells - N_PARAMETERS, cells / 4.0)
    inflation *= _roughness(white, images.weight, triangle.picture.images[order], square)
    return alone * math.sqrt(inflation), float(alone[0])


def _roughness(white: FloatArray, weight: FloatArray, pictures: FloatArray, square: Square) -> float:
    """Return the power that a fit leaves at the edges of triangles over that elsewhere: from 1 to 2. Pictures with
    little blur are not quite exact there, and in little noise that is 1.0 to 1.3 times it. More is a mishap, such
    as trials without a triangle.
    """
    edges = np.square(np.gradient(pictures, axis=(1, 2))).sum(axis=(0, 1))
    at = np.zeros(weight.shape)
    subtract(at, -edges / max(float(edges.max()), 1e-300), square)
    power = np.square(white).sum(axis=0)
    here = float((at * weight * power).sum() / max((at * weight).sum(), 1e-300))
    all_of = float((weight * power).sum() / max(weight.sum(), 1e-300))
    return min(max(here / max(all_of, 1e-300), 1.0), 2.0)


def _limited(step: FloatArray, shape: Shape) -> FloatArray:
    """Limit a step to the range in which the derivatives hold."""
    reach = np.full(N_PARAMETERS, 0.25)
    reach[AMPLITUDE] = np.inf
    reach[[X, Y]] = 0.3 * shape.size
    reach[BLUR] = max(0.5 * abs(shape.variance), 0.5)
    return np.asarray(np.clip(step, -reach, reach))


def _bounded(shape: Shape, start: Shape, n: int) -> Shape:
    """Return a shape that fits into the window and is not far from a triangle."""
    left, stretch, right = np.linalg.svd(shape.map)
    mean = float(np.sqrt(stretch.prod()))
    size = min(max(mean, 0.5 * start.size, 0.5), 2.0 * start.size, float(n))
    # A picture seen from 60° to the side has an axis of 1.41 times the mean of the two.
    stretch = size * np.clip(stretch / max(mean, 1e-9), 1.0 / 1.5, 1.5)
    variance = min(max(shape.variance, -0.05), np.square(n / 4.0))  # sharpened pictures have a negative one
    x, y = (min(max(at, -n / 2.0), n / 2.0) for at in (shape.x, shape.y))
    return Shape(shape.amplitude, x, y, left * stretch @ right, variance)


def subtract(images: FloatArray, pictures: FloatArray, square: Square) -> None:
    """Subtract pictures on a square from images, (…, n, n), in place."""
    n = images.shape[-1]
    rows, columns, inner = square.shared(n)
    images[..., rows, columns] -= pictures[..., *inner]


def noise_spectrum(noise: FloatArray, weight: FloatArray, side: int) -> FloatArray:
    """Return the power spectrum of noise images, (…, n, n), for filters of a side: the mean over the images. It is
    periodic over n + side blocks; its mean is the variance of a block.
    """
    length = 16 * math.ceil((weight.shape[0] + side) / 16)  # a product of small primes: fast
    spectra = np.fft.rfft2(noise * weight, (length, length))
    power = np.square(np.abs(spectra)).reshape(-1, length, length // 2 + 1).mean(axis=0)
    return np.asarray(power / max(float(np.square(weight).sum()), 1e-300))


def multiplicity(length: int) -> FloatArray:
    """Return how often each value of a real spectrum, (length, length/2 + 1), counts in a mean over an image."""
    counts = np.full((length, length // 2 + 1), 2.0 / length**2)
    counts[:, [0, -1] if length % 2 == 0 else 0] = 1.0 / length**2
    return counts


def filter_variances(filters: NDArray[np.floating], spectrum: FloatArray) -> FloatArray:
    """Return the variance of the output of each filter, (…, side, side), for noise with this spectrum: (…)."""
    length = len(spectrum)
    seen = np.fft.rfft2(filters, (length, length))
    power = np.square(seen.real) + np.square(seen.imag)
    return np.asarray(power.reshape(*power.shape[:-2], -1) @ (spectrum * multiplicity(length)).ravel())


class TrialEstimates(NamedTuple):
    """Estimates of single trials by one step of the fit from the picture that all share. `residual` and `error`,
    (trial, 4), are deviations of the contrast per level, of the place along x and y, and of the size as a ratio.
    `likeness`, (trial, 4), is the product of each trial, without its background, with the differences of the
    orientations, less what these differ in energy. `spectrum` is the power of the noise in units of the trials'
    noise.
    """

    residual: FloatArray
    error: FloatArray
    likeness: FloatArray
    likeness_error: FloatArray
    spectrum: FloatArray


def of_trials(triangle: TriangleFit, images: Images, frames: FloatArray, given: Given) -> TrialEstimates:
    """Estimate what each trial shows, for frames as in `Images.of`."""
    level, noise, turns = given
    weight = triangle.square.of(images.weight)
    shown = np.array(triangle.shown)[turns]
    slopes = np.tensordot(OF_TRIAL, triangle.picture.slopes, (1, 1)).swapaxes(0, 1)
    design = _without_background(slopes, weight)
    steps = np.linalg.pinv(design.swapaxes(1, 2)) * np.sqrt(weight).ravel()
    per_level = (frames - images.background) / level[:, None, None]
    models = triangle.picture.images[shown]
    cut = triangle.square.of(per_level)
    left = (cut - models).reshape(len(frames), -1)
    differ = (triangle.picture.images - triangle.picture.images.mean(axis=0)) * weight
    subtract(per_level, models, triangle.square)
    relative = noise / level
    per_level /= relative[:, None, None]
    freedom = max(1.0 - 5.0 / len(frames), 0.2)
    spectrum = noise_spectrum(per_level, images.weight, triangle.square.side) / freedom
    shaped = steps.reshape(4, 4, triangle.square.side, -1)
    errors = np.sqrt(filter_variances(shaped, spectrum))
    likeness_error = math.sqrt(float(filter_variances(differ, spectrum).mean()))
    likeness = cut.reshape(len(frames), -1) @ differ.reshape(4, -1).T
    # A stretched triangle has more energy in some orientations, which is not likeness: half of it counts, as in a
    # sum of squares.
    energy = (np.square(triangle.picture.images) * weight).sum(axis=(1, 2))
    likeness -= (energy - energy.mean()) / 2.0
    return TrialEstimates(
        np.einsum("kpi,ki->kp", steps[shown], left),
        errors[shown] * relative[:, None],
        likeness,
        likeness_error * relative,
        spectrum,
    )


def aligned(frames: FloatArray, triangle: TriangleFit, given: Given, apart: FloatArray) -> FloatArray:
    """Return frames, (trial, n, n), as if their triangles were at one place and of one size. The picture of the
    fit where a triangle is said to be is replaced by the picture at the place of the fit. `apart`, (trial, 3), are
    the distances of the stated place, along x and y, and of the logarithm of the size from those of the group.
    """
    moved, square, side = frames.copy(), triangle.square, triangle.square.side
    shown, middle = np.array(triangle.shown)[given.turns], _position(triangle.shape, square, frames.shape[-1])
    corners = _corners(triangle.shape, square, frames.shape[-1])
    own = middle + apart[:, None, :2] + np.exp(apart[:, 2, None, None]) * (corners[shown] - middle)
    differ = triangle_coverage(own, (side, side)) - triangle_coverage(corners, (side, side))[shown]
    # The places apart have blurred the first fit.
    by_places = float(np.square(apart[:, :2]).mean())
    kernel, _ = blur_matrices(max(triangle.shape.variance - by_places, 0.0), side)
    subtract(moved, triangle.shape.amplitude * given.level[:, None, None] * (kernel @ differ @ kernel.T), square)
    return moved


def first_guess(images: Images, size: float) -> Shape:
    """Find the place, the size and the sign of a triangle: where those of many sizes correlate best. The mean over
    the orientations is compared, so the guess does not depend on how these are arranged.
    """
    n = len(images.weight)
    counts = np.diag(images.information)
    if not images.has_triangle:
        return _stated(images, size)
    mean = np.average(images.triangles, axis=0, weights=counts) * np.sqrt(images.weight)
    sizes = size * np.array([1.0, *np.geomspace(0.25, 5.0, 11)])
    sizes = sizes[(sizes >= 1.0) & (sizes <= n / 1.6)]
    best, guess = -1.0, Shape.upright(1.0, 0.0, 0.0, size)
    if not sizes.size:
        return guess
    upright = UNIT_TRIANGLES[0] * sizes[:, None, None] + n // 2
    templates = triangle_coverage(upright, (n, n))
    templates = np.mean([np.rot90(templates, -turns, (1, 2)) for turns in range(4)], axis=0)
    crossed = np.fft.irfft2(np.fft.rfft2(mean) * np.conj(np.fft.rfft2(templates)), (n, n))
    heights = np.fft.fftshift(crossed, (1, 2)) / np.sqrt(np.square(templates).sum(axis=(1, 2)))[:, None, None]
    for tried, likeness in zip(sizes.tolist(), heights, strict=True):
        edge = int(0.5 * tried)
        likeness = likeness[edge : n - edge, edge : n - edge]
        row, column = np.unravel_index(int(np.abs(likeness).argmax()), likeness.shape)
        height = float(likeness[row, column])
        if abs(height) > (1.02 if tried != size else 1.0) * best:
            best = abs(height)
            x, y = float(column + edge - n // 2), float(row + edge - n // 2)
            guess = Shape.upright(math.copysign(1.0, height), x, y, tried)
    return guess


def _stated(images: Images, size: float) -> Shape:
    """Return the shape of the stated place and size; its amplitude is that of the differences of images."""
    start = Shape.upright(1.0, 0.0, 0.0, size)
    square = Square.about(start, len(images.weight))
    differ = differences(start, square, images.weight)
    counts = np.diag(images.information)[:, None, None]
    like = float((counts * square.of(images.triangles) * differ).sum())
    energy = float((counts * np.square(differ)).sum())
    return start._replace(amplitude=(like / energy if energy > 0.0 else 0.0) or 1e-9)


def fitted(images: Images, start: Shape) -> TriangleFit:
    """Fit a triangle roughly, and take another arrangement of the orientations if it certainly fits the frames
    better.
    """
    triangle = fit(images, start, precision=ROUGHLY)
    counts = np.diag(images.information)
    stated = np.flatnonzero(counts)
    if len(stated) < 2:
        return triangle
    square = Square.about(start, len(images.weight))
    differ = differences(start, square, images.weight)
    like = np.einsum("ayx,byx->ab", square.of(images.triangles), differ, optimize=True)
    like -= np.average(like, axis=0, weights=counts)
    gain = {
        shown: float(sum(counts[k] * (like[k, shown[k]] - like[k, k]) for k in stated))
        for shown in (arrangement.shown for arrangement in TURNED)
    }
    best = max(gain, key=lambda shown: gain[shown])
    if gain[best] <= 0.0:
        return triangle
    other = fit(images, start, best, ROUGHLY)
    left = images.triangles.copy()
    subtract(left, other.picture.images[list(best)], other.square)
    whitened = np.tensordot(_whitened(images.information), left, 1)
    # The advantage is a sum over the orientations of the products of noise with differences of pictures.
    moved = np.sqrt(counts)[:, None, None] * (differ[list(best)] - differ)
    variances = filter_variances(moved, noise_spectrum(whitened, images.weight, square.side))
    is_certain = gain[best] > 5.0 * math.sqrt(float(variances.sum()))
    # A triangle turned by 25° is one turned by -90° and by 5° back.
    return other if is_certain and abs(other.shape.turn_rad) < math.radians(8.0) else triangle
