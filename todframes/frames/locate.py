"""Search for the triangle's position if the manifest has none: one position for all frames of a group."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from todframes._typing import FloatArray
from todframes.errors import DataError, FrameError
from todframes.frames.contrast import Patch, check_sha256, read_contrast, skipped_frames
from todframes.frames.dataset import Dataset, FrameReference, Skipped, Trial
from todframes.frames.position import to_centroid
from todframes.stimulus import ORIENTATIONS, Centre, Orientation, Stimulus, coverage

Group = tuple[float | str, ...]


LEAST_PEAK = 6.0
"""Least height of the correlation peak above its surroundings, in their standard deviations."""


MOST_LOCATED_PX = 2**21
"""Largest number of pixels of a frame that is searched pixel by pixel; a larger one is averaged over blocks."""


BLOCKS = 2**19
"""Number of square blocks of pixels that a large frame is divided into."""


MOST_BLOCKS = 2**24
"""Largest number of blocks of a frame; more would fill the memory."""


LEAST_BLOCKS = 16
"""Least number of blocks along a triangle's size, unless blocks are pixels: larger blocks blur its edges."""


class Location(NamedTuple):
    """The position found for a group's triangles, in pixels, and its standard error along either axis."""

    group: Group
    x_px: float
    y_px: float
    standard_error_px: float


def locate_triangles(
    dataset: Dataset,
    *,
    centre: Centre = "centroid",
    skip_bad_frames: bool = False,
    progress: Callable[[int], None] | None = None,
) -> tuple[Dataset, tuple[Location, ...]]:
    """Find the triangle position common to the frames of each group, for trials without a position.

    Frames are averaged by orientation. The mean of these averages contains everything that the orientations share
    (bezel, overlay, shading, fixed pattern) and is subtracted. The remainder is correlated with the differences of
    the triangles, first on whole pixels, then between them with exact coverage.

    Parameters
    ----------
    dataset : Dataset
    centre : {"centroid", "bounding_box"}
        The point that the triangles of all orientations have in common.
    skip_bad_frames : bool
        Skip trials that cannot be read and groups in which no triangle stands out, and list them in `bad_rows`.
    progress : callable
        Called with the number of trials done since the last call.

    Returns
    -------
    Dataset
        The dataset with `x_px` and `y_px` set where they were missing, and without the trials that were skipped.
    tuple of Location
        One for each group with trials that had no position.

    Raises
    ------
    DataError
        If no triangle stands out, or the frames of a group differ in size.
    FrameError
        If a frame cannot be read, unless bad frames are skipped.
    """
    groups: dict[Group, list[Trial]] = {}
    for trial in dataset.trials:
        if trial.x_px is None:
            groups.setdefault(trial.group, []).append(trial)
    locations: dict[Group, Location] = {}
    skipped: dict[int, list[Skipped]] = {}
    for group, trials in groups.items():
        sums = _Sums(dataset)
        for trial in trials:
            try:
                sums.add(trial)
            except FrameError as error:
                if not skip_bad_frames:
                    raise
                skipped[trial.number] = skipped_frames(dataset, trial, error)
            if progress is not None:
                progress(1)
        try:
            if sums.totals:
                locations[group] = _locate(dataset, group, sums, centre)
        except DataError as error:
            if not skip_bad_frames:
                raise
            skipped |= {
                t.number: skipped_frames(dataset, t, str(error)) for t in trials if t.number not in skipped
            }
    placed = []
    for trial in dataset.trials:
        if trial.x_px is None and trial.group in locations:
            found = locations[trial.group]
            x, y = to_centroid(trial, found.x_px, found.y_px, centre, dataset.display.pitch_mrad)
            placed.append(trial._replace(x_px=x, y_px=y))
        else:
            placed.append(trial)
    placed = [trial for trial in placed if trial.number not in skipped]
    bad_rows = (*dataset.bad_rows, *(one for frames in skipped.values() for one in frames))
    return replace(dataset, trials=tuple(placed), bad_rows=bad_rows), tuple(locations.values())


Means = dict[Stimulus, dict[Orientation, FloatArray]]


class _Sums:
    """Sums of the contrast of a group's frames by stimulus and orientation; all frames must have one size."""

    def __init__(self, dataset: Dataset) -> None:
        self.dataset = dataset
        self.shape: tuple[int, ...] | None = None
        self.block_px = 1
        self.totals: dict[tuple[Stimulus, Orientation], FloatArray] = {}
        self.counts: Counter[tuple[Stimulus, Orientation]] = Counter()

    def add(self, trial: Trial) -> None:
        """Add all frames of a trial; if one cannot be read, add none."""
        contrasts = [self._contrast(frame, trial.stimulus) for frame in trial.frames]
        key = (trial.stimulus, trial.orientation)
        total = self.totals.setdefault(key, np.zeros(contrasts[0].shape))
        for contrast in contrasts:
            total += contrast
        self.counts[key] += len(contrasts)

    def means(self) -> Means:
        """Return the mean contrast of each stimulus and orientation."""
        means: Means = {}
        for (stimulus, orientation), total in self.totals.items():
            means.setdefault(stimulus, {})[orientation] = total / self.counts[stimulus, orientation]
        return means

    def _contrast(self, frame: FrameReference, stimulus: Stimulus) -> FloatArray:
        path = self.dataset.frame_path(frame)
        check_sha256(self.dataset, frame)
        with self.dataset.open(frame) as file:
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
        return _block_means(patch, self.block_px)


def _block_px(shape: tuple[int, ...], size_px: float) -> int:
    """Return the side of the blocks that a frame is searched in, in pixels: 1 unless the frame is large."""
    n_px = shape[0] * shape[1]
    wanted = 1 if n_px <= MOST_LOCATED_PX else math.ceil(math.sqrt(n_px / BLOCKS))
    return max(min(wanted, int(min(size_px, 1e9) / LEAST_BLOCKS)), 1)


def _block_means(patch: Patch, block_px: int) -> FloatArray:
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


class _Matcher:
    """Correlation of the orientation differences in the frames with those of triangles at any position."""

    def __init__(self, means: Means, pixel_pitch_mrad: float, centre: Centre) -> None:
        self.centre = centre
        self.means = {stimulus: _less_common(images) for stimulus, images in means.items()}
        self.pitch = pixel_pitch_mrad
        self.shape = next(iter(next(iter(means.values())).values())).shape
        self.largest_px = max(stimulus.size_mrad for stimulus in means) / pixel_pitch_mrad

    def templates(self, stimulus: Stimulus, x: float, y: float, shape: tuple[int, int]) -> FloatArray:
        """Compute the triangle differences of unit energy, shape (orientation, rows, columns)."""
        size_px = stimulus.size_mrad / self.pitch
        triangles = {
            orientation: stimulus.polarity
            * coverage(shape, size_px=size_px, x_px=x, y_px=y, orientation=orientation, centre=self.centre)
            for orientation in self.means[stimulus]
        }
        stack = np.array(list(_less_common(triangles).values()))
        norm = float(np.sqrt(np.square(stack).sum()))
        return np.asarray(stack / norm) if norm > 0.0 else stack  # within one pixel all orientations are alike

    def on_whole_pixels(self) -> FloatArray:
        """Compute the correlation for a centroid on each pixel, of a frame's shape; it wraps at the edges."""
        total = np.zeros(self.shape)
        for stimulus, images in self.means.items():
            templates = self.templates(stimulus, self.shape[1] // 2, self.shape[0] // 2, self.shape)
            for image, template in zip(images.values(), templates, strict=True):
                spectrum = np.fft.rfft2(image) * np.conj(np.fft.rfft2(template))
                total += np.fft.fftshift(np.fft.irfft2(spectrum, self.shape))
        return total

    def at(self, x: float, y: float) -> float:
        """Compute the correlation for a centroid at (x, y), with exact coverage."""
        return sum(float(np.einsum("oij,oij->", images, templates)) for images, templates in self._around(x, y))

    def standard_error_px(self, x: float, y: float) -> float:
        """Compute the standard error of x or y in pixels; the best triangle's residual counts as white noise."""
        step = 0.25
        unexplained, steepness, n_pixels = 0.0, 0.0, 0
        for (images, best), (_, left), (_, right) in zip(
            self._around(x, y), self._around(x - step, y, x, y), self._around(x + step, y, x, y), strict=True
        ):
            amplitude = float(np.einsum("oij,oij->", images, best))
            unexplained += float(np.square(images - amplitude * best).sum())
            n_pixels += images.size - images[0].size
            steepness += float(np.square(amplitude * (right - left) / (2.0 * step)).sum())
        return float(np.sqrt(unexplained / max(n_pixels, 1) / steepness)) if steepness > 0 else np.inf

    def _around(
        self, x: float, y: float, window_x: float | None = None, window_y: float | None = None
    ) -> Iterable[tuple[FloatArray, FloatArray]]:
        """Yield the images and templates in a window around a position, for each stimulus."""
        reach = int(np.ceil(self.largest_px)) + 2
        middle_x = round(x if window_x is None else window_x)
        middle_y = round(y if window_y is None else window_y)
        rows = slice(max(middle_y - reach, 0), middle_y + reach + 1)
        columns = slice(max(middle_x - reach, 0), middle_x + reach + 1)
        for stimulus, images in self.means.items():
            part = np.array([image[rows, columns] for image in images.values()])
            yield part, self.templates(stimulus, x - columns.start, y - rows.start, part.shape[1:])


def _less_common(images: dict[Orientation, FloatArray]) -> dict[Orientation, FloatArray]:
    """Subtract from each image the mean of all; a single orientation only loses its mean level."""
    common = np.mean(list(images.values()), axis=0) if len(images) > 1 else next(iter(images.values())).mean()
    return {orientation: images[orientation] - common for orientation in ORIENTATIONS if orientation in images}


def _locate(dataset: Dataset, group: Group, sums: _Sums, centre: Centre) -> Location:
    from scipy.optimize import minimize

    block_px = sums.block_px
    matcher = _Matcher(sums.means(), block_px * dataset.display.pitch_mrad, centre)
    correlation = matcher.on_whole_pixels()
    rows, columns = matcher.shape
    # The centroid is at least a third of the height, 0.439 sizes, away from each edge of the triangle.
    edge = int(np.ceil(0.4386 * matcher.largest_px - 0.5))
    if 2 * edge >= min(rows, columns):
        frames = f"frames of {columns * block_px} × {rows * block_px} pixels"
        raise DataError(f"{dataset.path}: {frames} are smaller than the triangle")
    inside = correlation[edge : rows - edge, edge : columns - edge]
    row, column = np.unravel_index(inside.argmax(), inside.shape)
    spread = 1.4826 * float(np.median(np.abs(inside - np.median(inside))))
    name = ", ".join(f"{key} {value}" for key, value in zip(dataset.experiment.group_by, group, strict=True))
    if inside.max() <= 0.0 or inside.max() - np.median(inside) < LEAST_PEAK * spread:
        raise DataError(
            f"{dataset.path}: no triangle stands out in the frames of {name or 'the dataset'}; "
            "expected x_px and y_px in the manifest"
        )
    start = np.array([column + edge, row + edge], dtype=np.float64)
    found = minimize(
        lambda place: -matcher.at(place[0], place[1]),
        start,
        method="Nelder-Mead",
        options={
            "initial_simplex": start + np.array([[0, 0], [0.5, 0], [0, 0.5]]),
            "xatol": 1e-4,
            "fatol": np.inf,
        },
    )
    x, y = (float(value) for value in found.x)
    # Conversion from blocks to pixels; block coordinates count from the middle of the first block.
    x_px, y_px = (block_px * place + (block_px - 1) / 2.0 for place in (x, y))
    return Location(group, x_px, y_px, block_px * matcher.standard_error_px(x, y))
