"""Correlation of frames with triangles: the position, blur and arrangement that explain a group's frames best."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from todframes.base._typing import ComplexArray, FloatArray
from todframes.base.errors import FrameError
from todframes.diagnosis.arrangement import ARRANGEMENTS, Arrangement
from todframes.frames.contrast import Patch, read_contrast
from todframes.frames.dataset import Dataset
from todframes.frames.position import size_in_px
from todframes.frames.surround import TrianglePlace
from todframes.frames.trials import FrameReference, Trial
from todframes.stimulus import ORIENTATIONS, Centre, Orientation, Stimulus, coverage

MOST_LOCATED_PX = 2**21
"""Largest number of pixels of a frame that is searched pixel by pixel; a larger one is averaged over blocks."""


BLOCKS = 2**19
"""Number of square blocks of pixels that a large frame is divided into."""


MOST_BLOCKS = 2**24
"""Largest number of blocks of a frame; more would fill the memory."""


LEAST_BLOCKS = 16
"""Least number of blocks along a triangle's size, unless blocks are pixels: larger blocks blur its edges."""


LARGEST_BLUR = 0.5
"""Largest standard deviation of the blur that is fitted, in sizes of the triangle."""


HALF_STEPS = ((0.5, 0.0), (0.0, 0.5))
"""Distances, in pixels, to the positions whose correlations are compared for the slope along x and along y."""


STEP_PX = 0.1
"""Step of the change of that slope."""


ROUNDS, MOST_STEPS = 3, 6
"""Number of times that the blur is fitted, and largest number of steps to the position for each."""


SMALL_PX = 12.0
"""Size below which half pixels are searched, too."""


LARGEST_STEP_PX = 1.0
"""Largest step of the refined position along each axis."""


CLEARLY = 1.1
"""Least ratio of the correlation in another arrangement to that in the stated one."""


LEAST_GAIN = 12.0
"""Least gain in log likelihood of another arrangement than the stated one; chance: once in 10,000 groups."""


SEARCHED, LEAST_SEARCHED_PX = 2.5, 8
"""Largest distance of a trial's position from its group's: so many sizes, and pixels more."""


DISC = 1.2
"""Radius of the disc that is subtracted from the mean triangle, in sizes; triangles reach 0.88."""


MOST_TRIAL_BLUR = 0.15
"""Largest blur of the triangle of a single trial, in sizes; a larger blur of the mean frames is scatter."""


NOISE_REACH = 4
"""Distance from a trial's highest peak within which noise is measured, in half widths of the weights."""


MOST_PEAKS = 12
"""Largest number of peaks of a trial that are kept."""


Means = dict[Stimulus, dict[Orientation, FloatArray]]


class MeanFrames:
    """Mean contrast of a group's frames by stimulus and orientation; all frames must have one size.

    With `reach_px`, frames are cut to a square of 2 `reach_px` + 1 pixels about the pixel of the trial's position.
    """

    def __init__(self, dataset: Dataset, reach_px: int | None = None) -> None:
        self.dataset = dataset
        self.reach_px = reach_px
        self.shape: tuple[int, ...] | None = None
        self.block_px = 1
        self.totals: dict[tuple[Stimulus, Orientation], FloatArray] = {}
        self.counts: Counter[tuple[Stimulus, Orientation]] = Counter()

    def add(self, trial: Trial) -> None:
        """Add all frames of a trial; if one cannot be read, add none."""
        contrasts = self._contrasts(trial)
        key = (trial.stimulus, trial.orientation)
        total = self.totals.setdefault(key, np.zeros(contrasts[0].shape))
        for contrast in contrasts:
            total += contrast
        self.counts[key] += len(contrasts)

    def of_trial(self, trial: Trial) -> FloatArray:
        """Return the mean contrast of a trial's frames, in blocks."""
        contrasts = self._contrasts(trial)
        return contrasts[0] if len(contrasts) == 1 else np.asarray(sum(contrasts) / len(contrasts))

    def take_means(self) -> Means:
        """Return the mean contrast of each stimulus and orientation; the totals become them, and are given up."""
        means: Means = {}
        for (stimulus, orientation), total in self.totals.items():
            total /= self.counts[stimulus, orientation]
            means.setdefault(stimulus, {})[orientation] = total
        self.totals = {}
        return means

    def _contrasts(self, trial: Trial) -> list[FloatArray]:
        if self.reach_px is None:
            return [self._contrast(frame, trial.stimulus) for frame in trial.frames]
        return [self._square(frame, trial, self.reach_px) for frame in trial.frames]

    def _square(self, frame: FrameReference, trial: Trial, reach: int) -> FloatArray:
        """Return the contrast of a square about the position of a trial; beyond the frame it is 0."""
        assert trial.x_px is not None and trial.y_px is not None
        triangle = TrianglePlace(trial.x_px, trial.y_px, size_in_px(trial, self.dataset.display.pitch_mrad))
        top, left = round(trial.y_px) - reach, round(trial.x_px) - reach
        square = np.zeros((2 * reach + 1, 2 * reach + 1))
        rows, columns = ((first, first + len(square)) for first in (top, left))
        with self.dataset.open(frame, verify=True) as file:
            patch = read_contrast(file, self.dataset.display, frame, rows, columns, triangle=triangle)
        for band in patch.bands():
            row, column = band.row - top, band.column - left
            square[row : row + len(band.values), column : column + band.values.shape[1]] = band.values
        return square

    def _contrast(self, frame: FrameReference, stimulus: Stimulus) -> FloatArray:
        path = self.dataset.frame_path(frame)
        with self.dataset.open(frame, verify=True) as file:
            patch = read_contrast(file, self.dataset.display, frame)
            header = file.header
        shape = patch.values.shape[:2]
        if (patch.row, patch.column, *shape) != (0, 0, header.height, header.width):
            raise FrameError(path, "has no pixels in part of the frame; its triangle cannot be located")
        if self.shape is None:
            self.shape = shape
            size_px = stimulus.size_mrad / self.dataset.display.pitch_mrad
            self.block_px = _block_px(shape, size_px)
            if shape[0] * shape[1] / self.block_px**2 > MOST_BLOCKS:
                raise FrameError(
                    path,
                    f"{_size(shape)} pixels are too many to find a triangle of {size_px:.3g} pixels among them, "
                    f"expected at most {MOST_BLOCKS / 1e6:.1f} million; give x_px and y_px in the manifest",
                )
        if self.shape != shape:
            found, expected = _size(shape), _size(self.shape)
            raise FrameError(path, f"found {found} pixels, expected {expected} as in the group's other frames")
        return block_means(patch, self.block_px)


def _block_px(shape: tuple[int, ...], size_px: float) -> int:
    """Return the side of the blocks that a frame is searched in, in pixels: 1 unless the frame is large."""
    n_px = shape[0] * shape[1]
    wanted = 1 if n_px <= MOST_LOCATED_PX else math.ceil(math.sqrt(n_px / BLOCKS))
    return max(min(wanted, int(min(size_px, 1e9) / LEAST_BLOCKS)), 1)


def block_means(patch: Patch, block_px: int) -> FloatArray:
    """Average the contrast of a whole frame over square blocks; incomplete blocks are dropped."""
    if block_px == 1 and patch.to_contrast is None:
        return patch.values
    n_rows, n_columns = (length // block_px for length in patch.values.shape[:2])
    means = np.zeros((n_rows, n_columns))
    for band in patch.bands():
        within = band.values[: max(n_rows * block_px - band.row, 0), : n_columns * block_px]
        if len(within) == 0:
            continue
        by_columns = within.reshape(len(within), n_columns, block_px).sum(axis=2)
        block_rows = (band.row + np.arange(len(within))) // block_px
        starts = np.flatnonzero(np.diff(block_rows, prepend=-1))
        means[block_rows[0] : block_rows[-1] + 1] += np.add.reduceat(by_columns, starts, axis=0)
    return means / block_px**2


def _size(shape: tuple[int, ...]) -> str:
    """Return the text "columns × rows"."""
    return f"{shape[1]} × {shape[0]}"


class Found(NamedTuple):
    """The highest correlation on whole pixels: where, in which arrangement, and how high.

    `height` is that of the peak above the median of the correlation as stated, `spread` the standard deviation of
    that correlation over the frame.
    """

    arrangement: Arrangement
    x: int
    y: int
    peak: float
    height: float
    spread: float


class Fitted(NamedTuple):
    """The position, arrangement and blur of the triangles that explain frames best, in blocks of pixels.

    `peak` is the correlation there, of unit-energy triangles; `covariance`, (2, 2), is that of x and y.
    """

    x: float
    y: float
    blur: float
    arrangement: Arrangement
    peak: float
    covariance: FloatArray


class Matcher:
    """Correlation of the orientation differences in mean frames with those of triangles at any position.

    The mean over orientations is subtracted from frames and triangles alike. It contains everything that the
    orientations share: bezel, overlay, shading, fixed pattern.
    """

    def __init__(self, means: Means, pixel_pitch_mrad: float, centre: Centre) -> None:
        self.centre = centre
        self.orientations = {stimulus: _in_order(images) for stimulus, images in means.items()}
        self.differences = {stimulus: _less_common(images) for stimulus, images in means.items()}
        self.pitch = pixel_pitch_mrad
        self.shape = next(iter(self.differences.values())).shape[1:]
        self.largest_px = max(stimulus.size_mrad for stimulus in means) / pixel_pitch_mrad

    def templates(
        self,
        stimulus: Stimulus,
        x: float,
        y: float,
        shape: tuple[int, int],
        *,
        arrangement: Arrangement = ARRANGEMENTS[0],
        blur: float = 0.0,
    ) -> FloatArray:
        """Compute the triangle differences of unit energy, shape (orientation, rows, columns)."""
        stack = blurred_coverages(
            shape,
            [arrangement.of(orientation) for orientation in self.orientations[stimulus]],
            size_px=stimulus.size_mrad / self.pitch,
            x_px=x,
            y_px=y,
            centre=self.centre,
            blur=blur,
        )
        stack -= stack.mean(axis=0) if len(stack) > 1 else stack.mean()
        norm = arrangement.sign * stimulus.polarity * math.sqrt(np.vdot(stack, stack))
        if norm != 0.0:  # within one pixel all orientations are alike
            stack /= norm
        return stack

    def search(self) -> Found:
        """Find the highest correlation over all whole pixels and arrangements.

        Another arrangement than the stated one is taken only if it explains the frames clearly better.

        Returns
        -------
        Found
            `height` is -inf if the frames are smaller than the triangles.
        """
        # The centroid is at least a third of the height, 0.439 sizes, away from each edge of the triangle.
        edge = max(int(np.ceil(0.4386 * self.largest_px - 0.5)), 0)
        rows, columns = self.shape
        spectra = [self._spectra(stimulus) for stimulus in self.differences]
        best = Found(ARRANGEMENTS[0], 0, 0, -np.inf, -np.inf, 0.0)
        if 2 * edge >= min(rows, columns):
            return best
        for arrangement in ARRANGEMENTS:
            if arrangement.sign == 1:
                whole = np.fft.fftshift(np.fft.irfft2(sum(one.cross(arrangement) for one in spectra), self.shape))
                correlation = whole[edge : rows - edge, edge : columns - edge]
            else:
                correlation = -correlation
            row, column = np.unravel_index(correlation.argmax(), correlation.shape)
            peak = float(correlation[row, column])
            found = best._replace(arrangement=arrangement, x=int(column) + edge, y=int(row) + edge, peak=peak)
            if arrangement == ARRANGEMENTS[0]:
                median = float(np.median(correlation))
                spread = 1.4826 * float(np.median(np.abs(correlation - median)))
                best = found._replace(height=peak - median, spread=spread)
            elif peak > CLEARLY * best.peak and peak**2 - max(best.peak, 0.0) ** 2 > 2.0 * LEAST_GAIN * spread**2:
                best = found._replace(height=peak - median)
        return best

    def _spectra(self, stimulus: Stimulus) -> _Spectra:
        """Return the spectra of a stimulus's images and of its triangles in the middle of the frame."""
        rows, columns = self.shape
        images = dict(zip(self.orientations[stimulus], self.differences[stimulus], strict=True))
        triangles = np.array(
            [
                stimulus.polarity
                * coverage(
                    self.shape,
                    size_px=stimulus.size_mrad / self.pitch,
                    x_px=columns // 2,
                    y_px=rows // 2,
                    orientation=orientation,
                    centre=self.centre,
                )
                for orientation in ORIENTATIONS
            ]
        ).reshape(4, -1)
        products = triangles @ triangles.T
        if len(images) == 1:  # a single orientation only loses its mean level
            products = products - np.outer(triangles.sum(axis=1), triangles.sum(axis=1)) / triangles.shape[1]
        return _Spectra(
            {orientation: np.fft.rfft2(image) for orientation, image in images.items()},
            [np.conj(np.fft.rfft2(one.reshape(self.shape))) for one in triangles],
            products,
        )

    def refined_of_twins(self, found: Found) -> Fitted:
        """Fit the position and blur of the arrangement that was found, or of its twin, if that explains as much.

        Whole pixels cannot tell an arrangement from its twin if triangles are small.
        """
        if found.arrangement == ARRANGEMENTS[0]:
            return self.refined(found.x, found.y, found.arrangement)
        likely = sorted((found.arrangement, found.arrangement.twin), key=ARRANGEMENTS.index)
        first, second = (self.refined(found.x, found.y, one) for one in likely)
        return second if second.peak > CLEARLY * first.peak else first

    def refined(self, x: float, y: float, arrangement: Arrangement) -> Fitted:
        """Fit the position between pixels and the blur, from a position on whole pixels.

        At the fitted position, the remainder after subtraction of the triangles does not correlate with a shift of
        the triangles. The covariance follows from the spread of that correlation over the frame, so it holds for
        noise that is correlated between pixels, too.
        """
        x, y, blur = self._refined_place(x, y, arrangement)
        peak = self._cut(x, y, arrangement).correlation(x, y, blur)
        return Fitted(x, y, blur, arrangement, peak, self._covariance(x, y, arrangement, blur))

    def _refined_place(self, x: float, y: float, arrangement: Arrangement) -> tuple[float, float, float]:
        """Fit x, y and the blur in turn."""
        from scipy.optimize import minimize_scalar

        if self.largest_px < SMALL_PX:  # the slope on the nearest whole pixel may lead away from the peak
            cut = self._cut(x, y, arrangement)
            offsets = (-1.0, -0.5, 0.0, 0.5, 1.0)
            near = [(x + dx, y + dy) for dx in offsets for dy in offsets]
            x, y = max(near, key=lambda at: cut.correlation(at[0], at[1], 0.5))
        blur = 0.0
        for _ in range(ROUNDS):
            cut = self._cut(x, y, arrangement)
            sharp = cut.correlation(x, y, 0.0)
            found = minimize_scalar(
                lambda blur, cut=cut, x=x, y=y: -cut.correlation(x, y, blur),
                bounds=(0.0, LARGEST_BLUR * self.largest_px),
                method="bounded",
                options={"xatol": 0.02},
            )
            blur = float(found.x) if -found.fun > sharp else 0.0
            jacobian = cut.fitted(x, y, blur).slope_change(x, y, blur)
            for _ in range(MOST_STEPS):
                step = _step(cut.slope(x, y, blur), jacobian)
                x, y = x + step[0], y + step[1]
                if np.abs(step).max() < 1e-3:
                    break
        return float(x), float(y), blur

    def _cut(self, x: float, y: float, arrangement: Arrangement) -> _Cut:
        """Cut the part out of the differences that triangles near a position touch, with their blur."""
        reach = int(np.ceil((1.0 + 2.0 * LARGEST_BLUR) * self.largest_px)) + 4
        rows, columns = (slice(max(round(at) - reach, 0), round(at) + reach + 1) for at in (y, x))
        # Not a copy where the part is all: large frames would fill the memory.
        parts = {
            stimulus: np.ascontiguousarray(differences[:, rows, columns])
            for stimulus, differences in self.differences.items()
        }
        return _Cut(self, parts, rows.start, columns.start, arrangement)

    def _covariance(self, x: float, y: float, arrangement: Arrangement, blur: float) -> FloatArray:
        """Compute the covariance of the position, (2, 2), from the noise of the slopes and their change."""
        fitted = self._cut(x, y, arrangement).fitted(x, y, blur)
        noise = self._slope_noise(fitted, x, y, blur)
        jacobian = fitted.slope_change(x, y, blur)
        if not np.linalg.det(jacobian) > 0.0:
            return np.full((2, 2), np.inf)
        inverse = np.linalg.inv(jacobian)
        return np.asarray(inverse @ noise @ inverse.T)

    def _slope_noise(self, fitted: _Cut, x: float, y: float, blur: float) -> FloatArray:
        """Compute the covariance of the slopes, (2, 2), over the frame, after subtraction of fitted triangles."""
        spectra = np.zeros((2, self.shape[0], self.shape[1] // 2 + 1), dtype=np.complex128)
        for stimulus in self.differences:
            for spectrum, (dx, dy) in zip(spectra, HALF_STEPS, strict=True):
                self._add_slope_spectrum(spectrum, fitted, stimulus, (x + dx, y + dy), (x - dx, y - dy), blur)
        slopes = np.fft.irfft2(spectra, self.shape)
        return np.asarray(np.einsum("aij,bij->ab", slopes, slopes) / slopes[0].size)

    def _add_slope_spectrum(
        self,
        spectrum: ComplexArray,
        fitted: _Cut,
        stimulus: Stimulus,
        ahead: tuple[float, float],
        behind: tuple[float, float],
        blur: float,
    ) -> None:
        """Add the spectrum of the slope between two places, after subtraction of fitted triangles, in place."""
        parts = fitted.parts[stimulus]
        rows = slice(fitted.row, fitted.row + parts.shape[1])
        columns = slice(fitted.column, fitted.column + parts.shape[2])
        slope = fitted.templates(stimulus, *ahead, blur)
        slope -= fitted.templates(stimulus, *behind, blur)
        for difference, part, one in zip(self.differences[stimulus], parts, slope, strict=True):
            residual = difference.copy()
            residual[rows, columns] -= part
            spectrum += np.fft.rfft2(residual) * np.conj(np.fft.rfft2(one, self.shape))


@dataclass(frozen=True, slots=True)
class _Cut:
    """The part of each stimulus's images, (orientation, rows, columns), that triangles near a position touch."""

    matcher: Matcher
    parts: dict[Stimulus, FloatArray]
    row: int
    column: int
    arrangement: Arrangement

    def templates(self, stimulus: Stimulus, x: float, y: float, blur: float) -> FloatArray:
        """Compute unit-energy templates at a place in the frame, (orientation, rows, columns)."""
        shape = self.parts[stimulus].shape[1:]
        return self.matcher.templates(
            stimulus, x - self.column, y - self.row, shape, arrangement=self.arrangement, blur=blur
        )

    def correlation(self, x: float, y: float, blur: float) -> float:
        """Compute the correlation for a centroid at (x, y), with exact coverage."""
        return sum(
            float(np.vdot(part, self.templates(stimulus, x, y, blur))) for stimulus, part in self.parts.items()
        )

    def fitted(self, x: float, y: float, blur: float) -> _Cut:
        """Return the triangles with their centroid at (x, y) that explain the images best."""
        parts = {}
        for stimulus, part in self.parts.items():
            best = self.templates(stimulus, x, y, blur)
            best *= float(np.vdot(part, best))
            parts[stimulus] = best
        return replace(self, parts=parts)

    def slope(self, x: float, y: float, blur: float) -> FloatArray:
        """Compute the slope of the correlation, (2,), after subtraction of the triangle at (x, y)."""
        total = np.zeros(2)
        remainders = self.fitted(x, y, blur).parts
        for stimulus, part in self.parts.items():
            remainder = np.subtract(part, remainders[stimulus], out=remainders[stimulus])
            # One template at a time, which no name keeps during the next: large frames would fill the memory.
            for axis, (dx, dy) in enumerate(HALF_STEPS):
                for sign in (1, -1):
                    at = x + sign * dx, y + sign * dy
                    total[axis] += sign * np.vdot(remainder, self.templates(stimulus, *at, blur))
        return total

    def slope_change(self, x: float, y: float, blur: float) -> FloatArray:
        """Compute minus the change of the slope with x and y, (slope, axis)."""
        along_x = self.slope(x - STEP_PX, y, blur) - self.slope(x + STEP_PX, y, blur)
        along_y = self.slope(x, y - STEP_PX, blur) - self.slope(x, y + STEP_PX, blur)
        return np.array([along_x, along_y]).T / (2.0 * STEP_PX)


class _Spectra(NamedTuple):
    """Spectra of images by orientation, conjugate spectra of triangles and their inner products, (4, 4)."""

    images: dict[Orientation, ComplexArray]
    triangles: list[ComplexArray]
    products: FloatArray

    def cross(self, arrangement: Arrangement) -> ComplexArray:
        """Return the spectrum of the correlation with unit-energy triangle differences in an arrangement."""
        shown = [arrangement.of(orientation).quarter_turns for orientation in self.images]
        products = self.products[np.ix_(shown, shown)]
        energy = float(np.trace(products) - (products.sum() / len(shown) if len(shown) > 1 else 0.0))
        # The images add up to zero, so the mean of the triangles needs no subtraction.
        total = sum(image * self.triangles[k] for image, k in zip(self.images.values(), shown, strict=True))
        # Within one pixel all orientations are alike: only rounding is left of their differences.
        return np.asarray(total / math.sqrt(energy) if energy > 1e-9 * np.trace(products) else 0.0 * total)


def blurred_coverages(
    shape: tuple[int, int],
    orientations: Sequence[Orientation],
    *,
    size_px: float,
    x_px: float,
    y_px: float,
    centre: Centre,
    blur: float,
) -> FloatArray:
    """Compute the coverage of pixels by a triangle in some orientations after a Gaussian blur.

    `blur` is its standard deviation in pixels. The result has shape (orientation, rows, columns).
    """
    triangles = np.empty((len(orientations), *shape))
    for triangle, orientation in zip(triangles, orientations, strict=True):
        triangle[:] = coverage(
            shape, size_px=size_px, x_px=x_px, y_px=y_px, orientation=orientation, centre=centre
        )
    if blur < 0.05:
        return triangles
    from scipy.ndimage import gaussian_filter

    gaussian_filter(triangles, (0.0, blur, blur), output=triangles, mode="constant", truncate=3.0)
    return triangles


def _step(slope: FloatArray, slope_change: FloatArray) -> FloatArray:
    """Return the step to where the slope is zero, at most `LARGEST_STEP_PX` along each axis."""
    if not np.linalg.eigvalsh(slope_change + slope_change.T)[0] > 0.0:
        return np.zeros(2)
    return np.clip(np.linalg.solve(slope_change, slope), -LARGEST_STEP_PX, LARGEST_STEP_PX)


def _in_order(images: dict[Orientation, FloatArray]) -> list[Orientation]:
    """Return the orientations of images, clockwise from up."""
    return [orientation for orientation in ORIENTATIONS if orientation in images]


def _less_common(images: dict[Orientation, FloatArray]) -> FloatArray:
    """Subtract the images' mean from each, from a single one its mean level: (orientation, rows, columns)."""
    common = np.mean(list(images.values()), axis=0) if len(images) > 1 else next(iter(images.values())).mean()
    differences = np.array([images[orientation] for orientation in _in_order(images)])
    differences -= common
    return differences


class Place(NamedTuple):
    """A peak of a trial's correlation: position in blocks of pixels, variance along each axis, height.

    `height` is in standard deviations of the correlation's noise.
    """

    x: float
    y: float
    variance: float
    height: float


class TrialMatcher:
    """Correlation of single frames with the mean triangle of all orientations.

    The peak lies at the centroid of a triangle of any orientation. The weights add up to zero, so shading does not
    shift the peak.

    Parameters
    ----------
    pixel_pitch_mrad : float
        Visual angle of a pixel, or of a block of pixels.
    blur : float
        Standard deviation of the triangles' blur, in pixels.
    sign : int
        -1 if triangles are darker where the manifest says brighter, and the other way round.
    """

    def __init__(self, pixel_pitch_mrad: float, blur: float, sign: int) -> None:
        self.pitch = pixel_pitch_mrad
        self.blur = blur
        self.sign = sign
        self._weights: dict[Stimulus, FloatArray] = {}

    def peaks(self, image: FloatArray, stimulus: Stimulus, x: float, y: float, reach: float = 0.0) -> list[Place]:
        """Return the peaks of a trial's correlation near a position, the highest first.

        Parameters
        ----------
        image : ndarray, shape (rows, columns)
            Contrast of the whole frame.
        stimulus : Stimulus
        x, y : float
            The group's position, in pixels.
        reach : float
            Least distance from it that is searched, in pixels.
        """
        from scipy.ndimage import maximum_filter
        from scipy.signal import fftconvolve

        weights = self._of(stimulus)
        half = len(weights) // 2
        least = SEARCHED * stimulus.size_mrad / self.pitch + LEAST_SEARCHED_PX
        margin = math.ceil(max(reach, least)) + half
        rows, columns = (
            slice(max(round(at) - margin, 0), min(round(at) + margin + 1, n))
            for at, n in zip((y, x), image.shape, strict=True)
        )
        part = image[rows, columns]
        if min(part.shape) <= 2 * half + 2:
            return []
        correlation = fftconvolve(part, weights[::-1, ::-1], mode="valid")
        inner = correlation[1:-1, 1:-1]
        tops = (inner == maximum_filter(correlation, 3)[1:-1, 1:-1]) & (inner > 0.0)
        found = sorted(np.argwhere(tops).tolist(), key=lambda at: -inner[at[0], at[1]])[:MOST_PEAKS]
        if not found:
            return []
        places = [_top(correlation, at[0] + 1, at[1] + 1) for at in found]
        top_x, top_y = places[0][0] + half, places[0][1] + half
        local_rows, local_columns = (
            slice(max(round(at) - NOISE_REACH * half, 0), round(at) + NOISE_REACH * half + 1)
            for at in (top_y, top_x)
        )
        noise = self._residual(
            part[local_rows, local_columns], stimulus, top_x - local_columns.start, top_y - local_rows.start
        )
        rest = fftconvolve(noise, weights[::-1, ::-1], mode="valid")
        spread = math.sqrt(float(np.square(rest).mean()))
        slopes = [
            float(np.square(rest[2:] - rest[:-2]).mean()),
            float(np.square(rest[:, 2:] - rest[:, :-2]).mean()),
        ]
        slope_variance = max(slopes) / 4.0
        return [
            Place(
                x + columns.start + half,
                y + rows.start + half,
                slope_variance / curvature**2,
                height / spread if spread > 0.0 else math.inf,
            )
            for x, y, height, curvature in places
            if curvature > 0.0
        ]

    def _of(self, stimulus: Stimulus) -> FloatArray:
        """Return the weights of a stimulus: the mean triangle less a disc, so that they add up to zero."""
        if stimulus not in self._weights:
            size_px = stimulus.size_mrad / self.pitch
            half = math.ceil(DISC * size_px) + 1
            mean = np.mean(self._triangles(stimulus, (2 * half + 1, 2 * half + 1), half, half), axis=0)
            squares = np.square(np.arange(-half, half + 1.0))
            disc = (squares[:, None] + squares <= half**2).astype(np.float64)
            weights = stimulus.polarity * self.sign * (mean - mean.sum() / disc.sum() * disc)
            self._weights[stimulus] = weights / math.sqrt(float(np.square(weights).sum()))
        return self._weights[stimulus]

    def _triangles(self, stimulus: Stimulus, shape: tuple[int, int], x: float, y: float) -> FloatArray:
        """Return the blurred coverage by triangles of all orientations at a position, (4, rows, columns)."""
        size_px = stimulus.size_mrad / self.pitch
        return blurred_coverages(
            shape,
            ORIENTATIONS,
            size_px=size_px,
            x_px=x,
            y_px=y,
            centre="centroid",
            blur=min(self.blur, MOST_TRIAL_BLUR * size_px),
        )

    def _residual(self, part: FloatArray, stimulus: Stimulus, x: float, y: float) -> FloatArray:
        """Subtract the triangles of all orientations, a mean and a slope from an image by least squares."""
        rows, columns = np.indices(part.shape)
        triangles = self._triangles(stimulus, (part.shape[0], part.shape[1]), x, y)
        basis = np.array([np.ones(part.shape), rows - rows.mean(), columns - columns.mean(), *triangles])
        basis = basis.reshape(len(basis), -1)
        fit, *_ = np.linalg.lstsq(basis @ basis.T, basis @ part.ravel(), rcond=None)
        return np.asarray(part - (fit @ basis).reshape(part.shape))


def _top(image: FloatArray, row: int, column: int) -> tuple[float, float, float, float]:
    """Return x, y, height and the least curvature of a peak, from parabolas through its highest pixel."""
    at = image[row, column]
    (left, right), (above, below) = image[row, [column - 1, column + 1]], image[[row - 1, row + 1], column]
    curvature_x, curvature_y = 2.0 * at - left - right, 2.0 * at - above - below
    x = column + (right - left) / 2.0 / curvature_x if curvature_x > 0.0 else float(column)
    y = row + (below - above) / 2.0 / curvature_y if curvature_y > 0.0 else float(row)
    return float(x), float(y), float(at), float(min(curvature_x, curvature_y))
