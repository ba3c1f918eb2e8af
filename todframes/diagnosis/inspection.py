"""The measurement of what the frames of a group show: the triangle, the background and the code values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes._typing import FloatArray
from todframes.errors import DataError, FrameError
from todframes.frames.contrast import LuminanceFound
from todframes.frames.dataset import Dataset
from todframes.frames.display import border_values
from todframes.frames.files import FULL_SCALE
from todframes.frames.position import centroid_position, size_in_px
from todframes.frames.surround import (
    HOLE_IN_SIZES,
    Range,
    Surface,
    SurroundSums,
    TrianglePlace,
    Window,
    block_sums,
    hole_radius_px,
    surround_window,
)
from todframes.frames.trials import Group, Trial, Trials, indices_by
from todframes.stimulus import ORIENTATIONS, Centre, Stimulus, coverage

MOST_SAMPLED, LEAST_SAMPLED = 24, 8
"""Most and fewest trials of a stimulus in a group that are measured."""


SAMPLED, SAMPLED_SHARE = 96, 0.04
"""Number of trials that are measured in all, and their share of the trials if that is more."""


BLOCKS_PER_SIZE = 8
"""Number of square blocks along a triangle's size that its picture is reduced to; fewer if these are pixels."""


SIZES_TRIED = np.geomspace(0.25, 5.0, 11)
"""Sizes of triangles that are tried, as multiples of the stated one."""


TURNS: dict[str, tuple[int, ...]] = {
    "as stated": (0, 1, 2, 3),
    "mirrored": (0, 3, 2, 1),
    "flipped": (2, 1, 0, 3),
    "half_turn": (2, 3, 0, 1),
    "quarter_turn_right": (1, 2, 3, 0),
    "quarter_turn_left": (3, 0, 1, 2),
    "transposed": (3, 2, 1, 0),
    "anti_transposed": (1, 0, 3, 2),
}
"""Quarter turns shown for the stated 0 to 3, by what a camera may do to its picture."""


class FrameSample(NamedTuple):
    """Measurements of one frame of a trial.

    Attributes
    ----------
    trial : Trial
    known : ndarray of bool, shape (n, n)
        Blocks of which the frame has at least half of the pixels.
    seen, even : ndarray, shape (n, n)
        Contrast of the blocks against the background that the dataset declares, and against the surface fitted
        around the triangle; 0 beyond the frame.
    stated_px : (float, float)
        Stated centroid (x, y) on the frame, in pixels.
    offset : (float, float)
        Stated centroid (x, y) from the middle of the blocks, in blocks.
    block_px : int
    frame_px : (int, int)
        Rows and columns of the frame.
    background_cd_m2, ring_cd_m2 : float
        Luminance that contrast refers to, and that around the triangle.
    noise : float
        Standard deviation of a pixel's contrast, from neighbouring blocks of the surround.
    codes : Codes or None
        None for floating-point frames.
    """

    trial: Trial
    known: NDArray[np.bool_]
    seen: FloatArray
    even: FloatArray
    stated_px: tuple[float, float]
    offset: tuple[float, float]
    block_px: int
    frame_px: tuple[int, int]
    background_cd_m2: float
    ring_cd_m2: float
    noise: float
    codes: Codes | None


class Codes(NamedTuple):
    """Integer code values about the triangle.

    `top_share` and `bottom_share` are the shares of the triangle's pixels at full scale and at 0; `peak` is the
    largest code read, `step` the smallest difference of codes that occur, and `step_contrast` its contrast.
    """

    full_scale: int
    top_share: float
    bottom_share: float
    peak: int
    step: int
    step_contrast: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """The properties that frames of a group with one stimulus show. Errors are standard errors; None: not known.

    Attributes
    ----------
    group : tuple
        Values of the `group_by` columns.
    stimulus : Stimulus
    size_px : float
        The stated size in pixels.
    stated_px : (float, float)
        The stated place of the centroid along x and y, the mean over the trials measured.
    n_trials : int
        Number of trials measured.
    frame_sizes_px : tuple of (int, int)
        Rows and columns of the frames that occur.
    background_luminance_cd_m2, ring_luminance_cd_m2 : float
        Mean luminance that contrast refers to, and mean luminance around the triangle.
    ring_ratio, ring_ratio_error, ring_scatter : float
        Mean of the second divided by the first, its error, and its standard deviation over trials.
    contrast_slope, contrast_slope_error : float or None
        Displayed contrast of the triangle per unit of the level, blur removed, positive if of the stated polarity.
    offset_px, offset_error_px : (float, float) or None
        The triangle's place from the stated one, along x and y.
    scatter_px : float or None
        Standard deviation over trials of that place along an axis, noise removed.
    size_ratio, size_ratio_error, size_scatter : float or None
        Displayed size divided by the stated one, and its standard deviation over trials, noise removed.
    turned_rad, turned_error_rad : float or None
        Clockwise rotation of the triangle from the stated orientation.
    blur_px : float or None
        Standard deviation of the Gaussian that blurs the triangle.
    shown_as : str or None
        Key of `TURNS`.
    wrong_orientation, n_orientation : int
        Number of trials that clearly show another orientation than stated, and number that clearly show one.
    wrong_level, n_level : int
        Number of trials whose contrast clearly does not follow their level, and number that show it clearly.
    signal : float
        The triangle's contrast in standard errors by the noise alone.
    uneven, uneven_error : float
        Contrast of a triangle to whose orientations the background's own structure is like, and its error.
    uneven_texture : float
        The same elsewhere in the surround: the fixed pattern of a camera, for example.
    saturated_share, crushed_share : float or None
        Shares of the triangle's pixels at full scale and at code 0; None without integer codes.
    peak_code, full_scale, code_step : int or None
        Largest code read, largest code possible, and the smallest difference of codes that occur.
    code_step_contrast, noise_contrast : float or None
        Contrast of that difference, and standard deviation of a pixel's contrast.
    level : float
        Median level of the trials measured.
    """

    group: Group
    stimulus: Stimulus
    size_px: float
    stated_px: tuple[float, float]
    n_trials: int
    frame_sizes_px: tuple[tuple[int, int], ...]
    background_luminance_cd_m2: float
    ring_luminance_cd_m2: float
    ring_ratio: float
    ring_ratio_error: float
    ring_scatter: float
    level: float
    noise_contrast: float
    contrast_slope: float | None = None
    contrast_slope_error: float | None = None
    offset_px: tuple[float, float] | None = None
    offset_error_px: tuple[float, float] | None = None
    scatter_px: float | None = None
    size_ratio: float | None = None
    size_ratio_error: float | None = None
    size_scatter: float | None = None
    turned_rad: float | None = None
    turned_error_rad: float | None = None
    blur_px: float | None = None
    shown_as: str | None = None
    wrong_orientation: int = 0
    n_orientation: int = 0
    wrong_level: int = 0
    n_level: int = 0
    signal: float = 0.0
    uneven: float = 0.0
    uneven_error: float = 0.0
    uneven_texture: float = 0.0
    saturated_share: float | None = None
    crushed_share: float | None = None
    peak_code: int | None = None
    full_scale: int | None = None
    code_step: int | None = None
    code_step_contrast: float | None = None


def inspect(dataset: Dataset, trials: Sequence[Trial], *, centre: Centre = "centroid") -> list[Inspection]:
    """Measure what the frames of each group show, on a sample of the trials.

    Frames that cannot be read are left out: scoring reports them.

    Parameters
    ----------
    dataset : Dataset
    trials : sequence of Trial
        The trials of all groups.
    centre : {"centroid", "bounding_box"}
        The point of a triangle without a position that lies at the frame's centre.

    Returns
    -------
    list of Inspection
        One for each stimulus of each group, in the order of the trials.
    """
    trials = Trials.of(trials)
    of_stimulus = indices_by(trials.group_codes.astype(np.int64) * len(trials.stimuli) + trials.stimulus_codes)
    in_all = max(SAMPLED, SAMPLED_SHARE * len(trials))
    most = int(min(max(in_all / max(len(of_stimulus), 1), LEAST_SAMPLED), MOST_SAMPLED))
    found = []
    for members in of_stimulus:
        samples = list(_samples(dataset, _spread(trials.select(members), most), centre))
        if samples:
            first = samples[0].trial
            found.append(_measured(dataset, first.group, first.stimulus, samples))
    return found


CONTRAST_LEVELS = ("contrast", "weber_contrast")
"""Names of levels that are the displayed contrast of the triangle."""


CONTRASTS = (1e-9, 1e9)
"""Range of contrasts that are computed with; beyond it are mistakes in a manifest, whose squares may overflow."""


def is_contrast(dataset: Dataset) -> bool:
    """Tell whether the level of a dataset is the triangle's contrast, by its name."""
    return dataset.experiment.level.strip().lower() in CONTRAST_LEVELS


def _spread(trials: Trials, most: int) -> Trials:
    """Choose trials of all levels and orientations, evenly over the manifest."""
    if len(trials) <= most:
        return trials
    ordered = np.lexsort([np.argsort(np.argsort(ORIENTATIONS))[trials.quarter_turns], trials.levels])
    return trials.select(ordered[np.linspace(0, len(trials) - 1, most).round().astype(int)])


def _samples(dataset: Dataset, trials: Sequence[Trial], centre: Centre) -> Iterator[FrameSample]:
    for trial in trials:
        try:
            yield measure_frame(dataset, trial, centre)
        except DataError:
            continue


def measure_frame(dataset: Dataset, trial: Trial, centre: Centre) -> FrameSample:
    """Measure the first frame of a trial.

    Raises
    ------
    FrameError, DataError
        If the frame cannot be read, or has no background.
    """
    display, frame = dataset.display, trial.frames[0]
    rule = display.background_luminance_cd_m2
    with dataset.open(frame) as file:
        header = file.header
        x, y = centroid_position(trial, header, centre, display.pitch_mrad)
        triangle = TrianglePlace(x, y, size_in_px(trial, display.pitch_mrad))
        all_rows, all_columns = file.clip(None, None)
        window = surround_window(triangle, rows=all_rows, columns=all_columns)
        if triangle.size_px > 2 * max(header.height, header.width) or min(b - a for a, b in window) < 1:
            raise FrameError(file.path, "the triangle does not lie on the frame")
        whole = rule in ("border", "frame_mean")
        blocks = _Blocks.about(triangle)
        surround, found, codes = SurroundSums(triangle, window), LuminanceFound(), _CodeCounts(triangle)
        stop_row = all_rows[1]
        for band in file.bands() if whole else file.bands(rows=window.rows, columns=window.columns):
            luminance = display.luminance(band.values)
            begin, end = band.first_row, band.first_row + len(luminance)
            if rule == "border":
                found.average(border_values(luminance, top=begin == all_rows[0], bottom=end == stop_row))
            elif rule == "frame_mean":
                found.average(luminance)
            surround.add(luminance, begin, band.first_column)
            blocks.add(luminance, begin, band.first_column, window)
            if header.pixel_type in FULL_SCALE:
                codes.add(band.stored, begin, band.first_column)
        surface: Surface | None
        try:
            surface = surround.surface()
        except DataError:
            surface = None
    means, known = blocks.means()
    at = blocks.places()
    even_cd_m2: float | FloatArray
    if surface is None:
        ring = float(np.median(means[known]))
        even_cd_m2, noise = ring, 0.0
    else:
        ring, even_cd_m2 = surface.middle_cd_m2, surface.luminance_at(*at)
        noise = surface.noise_cd_m2 * surround.block_px / ring
    background = (
        frame.background_luminance_cd_m2
        if rule == "column"
        else ring if rule == "surround" else found.sum / found.n_averaged if isinstance(rule, str) else rule
    )  # fmt: skip
    assert background is not None
    if not (background > 0.0 and ring > 0.0):
        raise FrameError(file.path, "there is no background")
    with np.errstate(divide="ignore", invalid="ignore"):
        even = np.where(known & (np.asarray(even_cd_m2) > 0.0), means / even_cd_m2 - 1.0, 0.0)
    seen = np.where(known, means / background - 1.0, 0.0)
    if surface is not None:
        outside = ~surface.has(*at)
        even[outside] = 0.0
        if rule == "surround":
            seen = even
    return FrameSample(
        trial=trial,
        known=known,
        seen=seen,
        even=even,
        stated_px=(x, y),
        offset=blocks.offset,
        block_px=blocks.block_px,
        frame_px=(header.height, header.width),
        background_cd_m2=background,
        ring_cd_m2=ring,
        noise=noise,
        codes=codes.found(dataset, ring) if header.pixel_type in FULL_SCALE else None,
    )


class _Blocks:
    """The means of square blocks about a triangle, by bands; their number depends on its size alone."""

    def __init__(self, triangle: TrianglePlace, block_px: int, n_blocks: int) -> None:
        self.block_px, self.n = block_px, n_blocks
        length = n_blocks * block_px
        self.first = tuple(round(at) - length // 2 for at in (triangle.y_px, triangle.x_px))
        middle_y, middle_x = (first + (length - 1) / 2.0 for first in self.first)
        self.offset = (triangle.x_px - middle_x) / block_px, (triangle.y_px - middle_y) / block_px
        self.sums, self.counts = np.zeros((n_blocks, n_blocks)), np.zeros((n_blocks, n_blocks))

    @classmethod
    def about(cls, triangle: TrianglePlace) -> _Blocks:
        block_px = max(int(triangle.size_px / BLOCKS_PER_SIZE), 1)
        reach = max(3.0 * triangle.size_px, hole_radius_px(triangle.size_px) + 8.0)
        return cls(triangle, block_px, 2 * math.ceil(reach / block_px) + 1)

    def add(self, luminance: FloatArray, row: int, column: int, window: Window) -> None:
        """Add the part of a rectangle of luminance, its first pixel at (row, column), that lies in the window."""
        stop = self.n * self.block_px
        rows, columns = (
            (max(first, start, low), min(first + stop, start + length, high))
            for first, start, length, (low, high) in zip(
                self.first, (row, column), luminance.shape, window, strict=True
            )
        )
        if rows[0] >= rows[1] or columns[0] >= columns[1]:
            return
        part = luminance[rows[0] - row : rows[1] - row, columns[0] - column : columns[1] - column]
        top, left = rows[0] - self.first[0], columns[0] - self.first[1]
        sums, at = block_sums(part, top, left, self.block_px)
        n_rows, n_columns = sums.shape
        here = slice(at[0], at[0] + n_rows), slice(at[1], at[1] + n_columns)
        self.sums[here] += sums
        lengths = (
            np.bincount((first + np.arange(length)) // self.block_px - start)
            for first, length, start in zip((top, left), part.shape, at, strict=True)
        )
        self.counts[here] += np.multiply.outer(*lengths)

    def means(self) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the means, and which blocks have at least half of their pixels."""
        return self.sums / np.maximum(self.counts, 1), self.counts >= self.block_px**2 / 2.0

    def places(self) -> tuple[FloatArray, FloatArray]:
        """Return the rows and columns of the middles of the blocks."""
        middles = np.asarray((np.arange(self.n) + 0.5) * self.block_px - 0.5)
        return self.first[0] + middles, self.first[1] + middles


class _CodeCounts:
    """Counts of integer code values: of the whole window, and of the square that the triangle fills."""

    def __init__(self, triangle: TrianglePlace) -> None:
        self.square: tuple[Range, ...] = tuple(
            (round(at - 0.9 * triangle.size_px), round(at + 0.9 * triangle.size_px) + 1)
            for at in (triangle.y_px, triangle.x_px)
        )
        self.counts: NDArray[np.intp] = np.zeros(0, np.intp)
        self.inner = np.zeros(3, np.intp)

    def add(self, stored: NDArray[np.unsignedinteger], row: int, column: int) -> None:
        full_scale = np.iinfo(stored.dtype).max
        if not self.counts.size:
            self.counts = np.zeros(full_scale + 1, np.intp)
        self.counts += np.bincount(stored.ravel(), minlength=full_scale + 1)
        (top, bottom), (left, right) = self.square
        part = stored[max(top - row, 0) : max(bottom - row, 0), max(left - column, 0) : max(right - column, 0)]
        self.inner += np.array([part.size, np.count_nonzero(part == full_scale), np.count_nonzero(part == 0)])

    def found(self, dataset: Dataset, ring_cd_m2: float) -> Codes:
        used = np.flatnonzero(self.counts)
        full_scale = len(self.counts) - 1
        step = int(np.diff(used).min()) if len(used) > 1 else full_scale
        middle = int(np.searchsorted(np.cumsum(self.counts), self.counts.sum() / 2.0))
        pair = np.clip(np.array([middle, middle + step]), 0, full_scale) / full_scale
        low, high = dataset.display.luminance(pair.astype(np.float32).reshape(2, 1, 1))[:, 0]
        n, n_top, n_bottom = (int(one) for one in self.inner)
        contrast = float(high - low) / ring_cd_m2
        return Codes(full_scale, n_top / max(n, 1), n_bottom / max(n, 1), int(used[-1]), step, contrast)


class _Model(NamedTuple):
    """A blurred triangle in each orientation, and its derivatives by its parameters.

    `images` has shape (4, n, n), `slopes` (4, parameters, n, n); parameters are counted as by `_X`.
    """

    images: FloatArray
    slopes: FloatArray


_AMPLITUDE, _X, _Y, _SIZE, _BLUR, _TURN = range(6)
"""Parameters of the picture of a triangle: amplitude, place and size in blocks, variance of the blur, rotation."""


def _model(n: int, values: FloatArray) -> _Model:
    """Compute the picture of a triangle on n × n blocks, in each orientation."""
    import cv2  # scipy.ndimage would take a tenth of the time of scoring 1,000 frames to load

    amplitude, x, y, size, _, turn = values
    middle = (n - 1) / 2.0
    v, u = np.mgrid[:n, :n] - middle
    u, v = u - x, v - y
    images, slopes = [], []
    for image in _unturned(n, values):
        down, right = np.gradient(image)
        around = v * right - u * down  # change by a clockwise turn, y down
        laplacian = cv2.Laplacian(image, -1, borderType=cv2.BORDER_REFLECT)
        image = image + turn * around
        images.append(amplitude * image)
        slopes.append(
            np.array([image, -amplitude * right, -amplitude * down, -amplitude * (u * right + v * down) / size,
                      amplitude * laplacian / 2.0, amplitude * around])
        )  # fmt: skip
    return _Model(np.array(images), np.array(slopes))


def _unturned(n: int, values: FloatArray) -> FloatArray:
    """Compute the picture without its amplitude and its rotation from the orientations: (4, n, n)."""
    import cv2

    _, x, y, size, variance, _ = values
    middle = (n - 1) / 2.0
    sigma = math.sqrt(variance)
    side = 2 * int(6.0 * sigma + 0.5) + 1
    return np.array(
        [
            cv2.GaussianBlur(
                coverage((n, n), size_px=size, x_px=middle + x, y_px=middle + y, orientation=orientation),
                (side, side),
                sigma,
                borderType=cv2.BORDER_CONSTANT,
            )
            for orientation in ORIENTATIONS
        ]
    )


FOUND = 2e-4
"""Last step of the fit, in sizes and radians; the errors that matter are a hundred times as large."""


LEAST_SIZE = 1e-9
"""Least size in blocks that is computed with; smaller ones are mistakes, and ratios to them overflow."""


LEAST_BLUR = 0.3
"""Least standard deviation of the blur in blocks; the derivatives of a sharper picture are not known."""


def _measured(dataset: Dataset, group: Group, stimulus: Stimulus, samples: Sequence[FrameSample]) -> Inspection:
    level = np.array([sample.trial.level for sample in samples])
    # Of a level that is no contrast it is not known how the contrast follows from it.
    strength = np.clip(level, *CONTRASTS) if is_contrast(dataset) else np.ones(len(level))
    ratio = np.array([sample.ring_cd_m2 / sample.background_cd_m2 for sample in samples])
    scatter = float(ratio.std(ddof=1)) if len(ratio) > 1 else 0.0
    block_px = samples[0].block_px
    size_px = size_in_px(samples[0].trial, dataset.display.pitch_mrad)
    codes = [sample.codes for sample in samples if sample.codes is not None]
    return Inspection(
        group=group,
        stimulus=stimulus,
        size_px=size_px,
        stated_px=(
            float(np.mean([sample.stated_px[0] for sample in samples])),
            float(np.mean([sample.stated_px[1] for sample in samples])),
        ),
        n_trials=len(samples),
        frame_sizes_px=tuple(sorted({sample.frame_px for sample in samples})),
        background_luminance_cd_m2=float(np.mean([sample.background_cd_m2 for sample in samples])),
        ring_luminance_cd_m2=float(np.mean([sample.ring_cd_m2 for sample in samples])),
        ring_ratio=float(ratio.mean()),
        ring_ratio_error=math.hypot(
            scatter / math.sqrt(len(ratio)), _static_error(samples, scatter, size_px / block_px)
        ),
        ring_scatter=scatter,
        level=float(np.median(level)),
        noise_contrast=float(np.median([sample.noise for sample in samples])),
        **_of_codes(codes),
        **_of_triangle(samples, strength, max(size_px / block_px, LEAST_SIZE), stimulus.polarity, block_px),
    )


def _static_error(samples: Sequence[FrameSample], scatter: float, size: float) -> float:
    """Estimate the relative error of the luminance around the triangle from a pattern that all frames share.

    It is that of the mean of eight sectors around the triangle. On a small frame a blurred pattern makes all
    sectors alike. Therefore it is also estimated from the `scatter` of the relative luminance over trials, which
    the noise causes: pattern and noise are taken to be blurred alike, so that the ratio of their errors is the
    ratio of their standard deviations within the frames. The larger estimate counts.
    """
    known = np.logical_and.reduce([sample.known for sample in samples])
    v, u = np.mgrid[: len(known), : len(known)] - (len(known) - 1) / 2.0
    around = known & (np.hypot(u, v) > HOLE_IN_SIZES * size)
    sector = ((np.arctan2(v, u)[around] / np.pi + 1.0) * 4.0).astype(int) % 8
    even = np.array([sample.even[around] for sample in samples])
    pattern = even.mean(axis=0)
    sectors = [pattern[sector == k].mean() for k in range(8) if (sector == k).any()]
    if len(sectors) < 2:
        return 0.0
    # The differences of neighbours: the few across an edge between two levels do not count.
    apart = np.abs(np.diff(sectors, append=sectors[0]))
    of_sectors = 1.4826 * float(np.median(apart)) / math.sqrt(2.0 * len(sectors))
    noise_variance = float(even.var(axis=0).mean()) * len(even) / max(len(even) - 1, 1)
    if not noise_variance > 0.0:
        return of_sectors
    pattern_variance = max(float(pattern.var()) - noise_variance / len(even), 0.0)
    return max(of_sectors, scatter * math.sqrt(pattern_variance / noise_variance))


def _of_codes(codes: Sequence[Codes]) -> dict[str, Any]:
    if not codes:
        return {}
    return {
        "saturated_share": float(np.mean([one.top_share for one in codes])),
        "crushed_share": float(np.mean([one.bottom_share for one in codes])),
        "peak_code": max(one.peak for one in codes),
        "full_scale": codes[0].full_scale,
        "code_step": min(one.step for one in codes),
        "code_step_contrast": float(np.median([one.step_contrast for one in codes])),
    }


def _of_triangle(
    samples: Sequence[FrameSample], level: FloatArray, size: float, polarity: int, block_px: int
) -> dict[str, Any]:
    """Measure the triangle; lengths are in blocks until the end."""
    turns = np.array([sample.trial.orientation.quarter_turns for sample in samples])
    even = polarity * np.array([sample.even for sample in samples])
    offsets = np.array([sample.offset for sample in samples])
    known = np.logical_and.reduce([sample.known for sample in samples])
    relative = level / _noise_of_frames(even, level, known, size)
    background, triangles, _ = _separated(even, level, relative, turns)
    weights = np.array([np.square(relative[turns == k]).sum() for k in range(4)])
    mean = np.average(triangles, axis=0, weights=weights)
    mean *= _steadiness(even - background - level[:, None, None] * triangles[turns], relative / level)
    start, sign = _found_place(mean, size)
    values = np.array([sign, *start, 1.0, 0.0])
    shown_as, margin = _found_turn(triangles, weights, values)
    shift = np.array(TURNS[shown_as])
    values, model = _fitted_shape(triangles, weights, values, shift)
    # One step of the fit for each trial, from the picture that all share.
    shown = shift[turns]
    n = len(known)
    steps = np.array([np.linalg.pinv(slopes.reshape(-1, n * n).T).reshape(-1, n, n) for slopes in model.slopes])
    per_level = (even - background) / level[:, None, None]
    residual = per_level - model.images[shown]
    each = _applied(steps, residual, shown)
    noise = residual * relative[:, None, None]
    share = np.square(relative) / np.square(relative).sum()
    of_noise = [_applied(moved, noise, shown) for moved in _beside(steps, known, size)]
    # If the frames have no place beside the triangle, the noise is the spread over the trials.
    spread = np.abs(np.concatenate(of_noise or [each * relative[:, None]]))
    at_level = 1.4826 * np.median(spread, axis=0) / relative[:, None]
    # The noise, the spread over trials if that is larger, and the noise that all trials share.
    noise_variance, variance = (
        (np.square(share)[:, None] * np.square(one)).sum(axis=0)
        for one in (at_level, np.maximum(np.abs(each), at_level))
    )
    shared = np.square([(share / relative) @ one for one in of_noise]).mean(axis=0) if of_noise else np.zeros(6)
    error = np.sqrt(variance + shared)
    amplitude = abs(values[_AMPLITUDE])
    noise_error = math.sqrt(noise_variance[_AMPLITUDE] + shared[_AMPLITUDE])
    signal = float(amplitude / noise_error) if noise_error > 0.0 else math.inf
    seen = polarity * np.array([sample.seen for sample in samples])
    # A triangle that is cut off by the edge of some frames has a place, but no sure size and contrast.
    is_whole = bool(known[_within(n, WHOLE_IN_SIZES * size)].all())
    found: dict[str, Any] = {
        "contrast_slope": float(values[_AMPLITUDE]),
        "contrast_slope_error": float(error[_AMPLITUDE]) if is_whole else None,
        "signal": signal,
        **_unevenness(seen, level, relative, turns, known, size),
    }
    if signal < LEAST_SIGNAL:
        return found
    middle = share @ offsets
    apart = each[:, [_X, _Y]] - (offsets - middle)
    clear_place = at_level[:, [_X, _Y]].max(axis=1) < CLEAR * size
    clear_level = at_level[:, _AMPLITUDE] < CLEAR * amplitude
    off_level = clear_level & (np.abs(each[:, _AMPLITUDE]) > OFF_LEVEL * amplitude)
    wrong, judged, likeness_noise = _orientations(
        per_level * relative[:, None, None], noise, model, shown, known, size
    )
    turn_error = 2.0 * likeness_noise * math.sqrt(np.square(relative).sum())
    return found | {
        "offset_px": tuple((block_px * (values[[_X, _Y]] - middle)).tolist()),
        "offset_error_px": tuple((block_px * error[[_X, _Y]]).tolist()),
        "scatter_px": _scatter(block_px * apart[clear_place], block_px * at_level[clear_place][:, [_X, _Y]]),
        "size_ratio": float(values[_SIZE] / size),
        "size_ratio_error": float(error[_SIZE] / size) if is_whole else None,
        "size_scatter": _scatter(each[clear_place][:, [_SIZE]] / size, at_level[clear_place][:, [_SIZE]] / size),
        "turned_rad": float(values[_TURN]),
        "turned_error_rad": float(error[_TURN]),
        "blur_px": block_px * math.sqrt(values[_BLUR]),
        "shown_as": shown_as if margin > LEAST_TURN_ERRORS * turn_error else "as stated",
        "wrong_orientation": wrong,
        "n_orientation": judged,
        "wrong_level": int(off_level.sum()),
        "n_level": int(clear_level.sum()),
    }


CLEAR, OFF_LEVEL = 0.1, 0.4
"""Largest error of a trial's contrast or place that shows it clearly, relative to the contrast and the size, and
the relative deviation of a contrast that does not follow its level."""


LEAST_TURN_ERRORS = 5.0
"""Least advantage of another orientation than stated, in standard errors."""


WHOLE_IN_SIZES = 1.2
"""Distance from the centroid within which all frames must have pixels for size and contrast to be judged."""


ON_FRAME = 0.9
"""Least share of the pixels of a place beside the triangle that lie on the frames."""


LEAST_SIGNAL = 8.0
"""Least contrast of the triangle, in standard errors, for its place, size and orientation to be measured."""


UNSTEADY = 2.0
"""Standard deviation of a block over trials, in those of the noise around the triangle, beyond which the block
counts less."""


def _noise_of_frames(images: FloatArray, level: FloatArray, known: NDArray[np.bool_], size: float) -> FloatArray:
    """Estimate the standard deviation of the contrast of each frame's blocks around the triangle.

    It is at least a twentieth of the level, so that frames without noise count alike.
    """
    around = known & ~_within(len(known), HOLE_IN_SIZES * size)
    if not around.any():
        return np.ones(len(images))
    apart = np.abs(images[:, around] - np.median(images[:, around], axis=1)[:, None])
    return np.maximum(1.4826 * np.median(apart, axis=1), level / 20.0)


class _Separated(NamedTuple):
    """The image that all frames share, (n, n), and those that grow with the level, by orientation, (4, n, n).

    `share` is the weight of each frame in the former, (trial,).
    """

    background: FloatArray
    triangles: FloatArray
    share: FloatArray


def _separated(images: FloatArray, level: FloatArray, relative: FloatArray, turns: NDArray[np.intp]) -> _Separated:
    """Separate what all frames share from what grows with the level in each orientation.

    `relative` is the level in units of the frame's noise.
    """
    columns = [np.where(turns == k, level, 0.0) for k in range(4)]
    separable = level.max() > 1.2 * level.min()
    design = np.stack([*columns, np.ones(len(level))] if separable else columns, axis=1)
    certain = relative / level
    shares = np.linalg.pinv(design * certain[:, None]) * certain
    parts = (shares @ images.reshape(len(level), -1)).reshape(-1, *images.shape[1:])
    if not separable:
        return _Separated(np.zeros(images.shape[1:]), parts, np.zeros(len(level)))
    return _Separated(parts[4], parts[:4], shares[4])


def _steadiness(residuals: FloatArray, certain: FloatArray) -> FloatArray:
    """Return weights of blocks, (n, n): 1, and less where the frames differ from each other more than by noise.

    Letters that change from frame to frame then count no more than the noise does elsewhere. `residuals`, (trial,
    n, n), are the frames without what they share, and `certain`, (trial,), is the inverse of their noise.
    """
    spread = np.sqrt(np.square(residuals * certain[:, None, None]).mean(axis=0))
    return np.asarray(UNSTEADY / np.maximum(spread, UNSTEADY))


def _found_place(mean: FloatArray, size: float) -> tuple[tuple[float, float, float], float]:
    """Find the place and size of the triangle, (x, y, size) in blocks, and the sign of its contrast.

    The mean over the orientations, (n, n), is correlated with that of triangles of many sizes at all places.
    """
    n = mean.shape[0]
    spectrum = np.fft.rfft2(mean)
    best, found, sign = -1.0, (0.0, 0.0, size), 1.0
    for factor in (1.0, *SIZES_TRIED):
        if factor * size > n / 1.6 or factor * size < 1.0:
            continue
        template = np.mean(
            [
                coverage((n, n), size_px=factor * size, x_px=n // 2, y_px=n // 2, orientation=o)
                for o in ORIENTATIONS
            ],
            axis=0,
        )
        likeness = np.fft.fftshift(np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(template)), (n, n)))
        likeness /= math.sqrt(float(np.square(template).sum()))
        edge = int(0.5 * factor * size)
        likeness[: max(edge, 0)] = likeness[n - max(edge, 0) :] = 0.0
        likeness[:, : max(edge, 0)] = likeness[:, n - max(edge, 0) :] = 0.0
        row, column = np.unravel_index(int(np.abs(likeness).argmax()), likeness.shape)
        if abs(likeness[row, column]) > (1.02 if factor != 1.0 else 1.0) * best:
            best, sign = abs(float(likeness[row, column])), math.copysign(1.0, likeness[row, column])
            found = float(column - n // 2), float(row - n // 2), factor * size
    return found, sign


def _found_turn(triangles: FloatArray, weights: FloatArray, values: FloatArray) -> tuple[str, float]:
    """Find what was done to the orientations, and how much more like the frames that is than as stated."""
    images = values[_AMPLITUDE] * _unturned(triangles.shape[1], values)
    shown = np.flatnonzero(weights)
    differ = triangles - np.average(triangles, axis=0, weights=weights)
    like = np.einsum("ayx,byx->ab", differ, images - images.mean(axis=0), optimize=True)
    scores = {name: float(sum(weights[k] * like[k, turn[k]] for k in shown)) for name, turn in TURNS.items()}
    best = max(scores, key=lambda name: scores[name])
    if len(shown) < 2 or best == "as stated":
        return "as stated", 0.0
    return best, scores[best] - scores["as stated"]


def _fitted_shape(
    triangles: FloatArray, weights: FloatArray, values: FloatArray, shift: NDArray[np.intp]
) -> tuple[FloatArray, _Model]:
    """Fit the parameters of the triangle's picture by Gauss–Newton steps."""
    n = triangles.shape[1]
    root = np.sqrt(weights / max(weights.max(), 1e-300))[:, None]
    values = values.copy()
    for _ in range(6):
        model = _model(n, values)
        away = (triangles - model.images[shift]).reshape(4, -1) * root
        slopes = model.slopes[shift].reshape(4, 6, -1) * root[:, None]
        design = np.concatenate(list(slopes), axis=1).T
        scale = np.linalg.norm(design, axis=0)
        step = np.linalg.lstsq(design / np.where(scale > 0, scale, 1.0), away.ravel(), rcond=1e-6)[0]
        step = step / np.where(scale > 0, scale, 1.0)
        size = values[_SIZE]
        reach = np.array([np.inf, 0.3 * size, 0.3 * size, 0.25 * size, max(0.5 * values[_BLUR], 0.5), 0.3])
        values += np.clip(step, -reach, reach)
        is_found = bool((np.abs(step[[_X, _Y, _SIZE, _TURN]]) < FOUND * np.array([size, size, size, 1.0])).all())
        values[_SIZE] = min(max(values[_SIZE], 0.5), n)
        values[_BLUR] = min(max(values[_BLUR], LEAST_BLUR**2), (n / 4.0) ** 2)
        values[[_X, _Y]] = np.clip(values[[_X, _Y]], -n / 2.0, n / 2.0)
        values[_TURN] = min(max(values[_TURN], -0.5), 0.5)
        if is_found:
            break
    return values, _model(n, values)


def _applied(filters: FloatArray, images: FloatArray, which: NDArray[np.intp]) -> FloatArray:
    """Multiply each image, (n, n), by the filters (p, n, n) of its orientation, and sum: (trial, p)."""
    found = np.empty((len(images), filters.shape[1]))
    for k, one in enumerate(filters):
        found[which == k] = images[which == k].reshape(-1, one[0].size) @ one.reshape(len(one), -1).T
    return found


def _beside(filters: FloatArray, known: NDArray[np.bool_], size: float) -> Iterator[FloatArray]:
    """Yield filters, (…, n, n), that measure a place beside the triangle instead, for each place on the frames."""
    n = len(known)
    v, u = np.mgrid[:n, :n] - (n - 1) / 2.0
    away, ways = round(1.8 * size), (-1, 0, 1)
    for down, right in ((down, right) for down in ways for right in ways if down or right):
        near = np.hypot(v - down * away, u - right * away) < size
        if known[near].mean() > ON_FRAME:
            yield np.roll(filters, (down * away, right * away), axis=(-2, -1))


SCATTER_ERRORS = 5.0
"""Least scatter over trials that is more than noise, in standard errors."""


def _scatter(apart: FloatArray, noise: FloatArray) -> float | None:
    """Return the standard deviation over trials beyond the noise: 0 if it may be noise, None if few show it.

    Both arguments have shape (trial, axes). Trials count by the inverse of their noise variance, so that the
    faintest do not decide.
    """
    n, axes = apart.shape
    if n < 4:
        return None
    weight = 1.0 / np.square(np.maximum(noise, 1e-6))  # frames without noise count alike
    sums = weight.sum(axis=0)
    excess = weight * np.square(apart - (weight * apart).sum(axis=0) / sums)
    freedom = (n - 1) * axes
    # The cube root of a mean square is normal, very nearly (Wilson and Hilferty).
    if excess.sum() <= freedom * (1.0 + SCATTER_ERRORS * math.sqrt(2.0 / (9.0 * freedom))) ** 3:
        return 0.0
    return math.sqrt((excess.sum() - freedom) / (sums - np.square(weight).sum(axis=0) / sums).sum())


def _orientations(
    images: FloatArray,
    noise: FloatArray,
    model: _Model,
    shown: NDArray[np.intp],
    known: NDArray[np.bool_],
    size: float,
) -> tuple[int, int, float]:
    """Count the trials that clearly show another orientation than stated, and those that clearly show one.

    `images` and `noise` are the frames without their background, and without the triangle too. Also returns the
    noise of a trial's likeness to an orientation; it is infinite if nothing is beside the triangle.
    """
    differ = model.images - model.images.mean(axis=0)
    flat = noise.reshape(len(noise), -1)
    beside = [flat @ moved.reshape(4, -1).T for moved in _beside(differ, known, size)]
    if not beside:
        return 0, 0, math.inf
    error = 1.4826 * float(np.median(np.abs(beside)))
    scores = images.reshape(len(images), -1) @ differ.reshape(4, -1).T
    ranked = np.sort(scores, axis=1)
    clear = (ranked[:, 3] - ranked[:, 2]) > 8.0 * error
    wrong = clear & (scores.argmax(axis=1) != shown)
    return int(wrong.sum()), int(clear.sum()), error


def _unevenness(
    seen: FloatArray,
    level: FloatArray,
    relative: FloatArray,
    turns: NDArray[np.intp],
    known: NDArray[np.bool_],
    size: float,
) -> dict[str, Any]:
    """Measure how like the orientations of a triangle the background's own structure is, in contrast.

    The structure elsewhere on the frames, such as a fixed pattern, is measured in the same way. Nothing is
    returned if the frames show too little else.
    """
    import cv2

    n = len(known)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    around = math.ceil(0.6 * size)
    inner = cv2.erode(
        known.astype(np.uint8), cross, iterations=around, borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    elsewhere = (inner > 0) & ~_within(n, size)
    if elsewhere.sum() < np.square(2.0 * size):
        return {}
    static, triangles, share = _separated(seen, level, relative, turns)
    noise = seen - static - level[:, None, None] * triangles[turns]
    images = _unturned(n, np.array([1.0, 0.0, 0.0, size, np.square(LEAST_BLUR), 0.0]))
    differ = images - images.mean(axis=0)
    energy = float(np.square(differ).sum()) / 4.0
    if not energy > 0.0:  # within one pixel all orientations are alike
        return {}
    spectrum = np.fft.rfft2(static)
    maps = np.array([np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(one)), static.shape) for one in differ])
    spread = np.fft.fftshift(np.ptp(maps, axis=0)) / energy
    each = noise.reshape(len(noise), -1) @ differ.reshape(4, -1).T / energy
    return {
        "uneven": float(spread[n // 2, n // 2]),
        "uneven_error": math.sqrt((np.square(share) @ np.square(each)).max()),
        "uneven_texture": float(np.median(spread[elsewhere])),
    }


def _within(n: int, radius: float) -> NDArray[np.bool_]:
    """Return the blocks of n × n that lie within a distance from the middle."""
    v, u = np.mgrid[:n, :n] - (n - 1) / 2.0
    return np.asarray(np.hypot(u, v) <= radius)


def records(dataset: Dataset, inspections: Sequence[Inspection]) -> list[dict[str, Any]]:
    """Return inspections as plain values for JSON; the group's values have the names of their columns."""
    found = []
    for one in inspections:
        values = asdict(one)
        values["group"] = dict(zip(dataset.experiment.group_by, one.group, strict=True))
        values |= values.pop("stimulus")
        found.append({name: value for name, value in values.items() if value is not None})
    return found
