"""The measurement of what the frames of a group show: the triangle, the background and the code values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError
from todframes.diagnosis.scene_backgrounds import (
    SceneParts,
    numbered_views,
    that_share,
    view_middles,
    whole_views,
    without_scenes,
)
from todframes.diagnosis.triangle import (
    TURNED,
    Given,
    Images,
    TrialEstimates,
    TriangleFit,
    aligned,
    errors_of,
    first_guess,
    fit,
    fitted,
    of_trials,
    within,
)
from todframes.diagnosis.windows import Codes, TrialSample, measure_trial
from todframes.frames.contrast import size_in_px
from todframes.frames.dataset import Dataset
from todframes.frames.surround import HOLE_IN_SIZES
from todframes.frames.trials import Group, Trial, Trials
from todframes.stimulus import ORIENTATIONS, Centre, Stimulus, level_of, orientation_weights

SIZES_ALIKE = 1.15
"""Ratio of the largest stated size of a curve to the least up to which they are one size in perspective: a chart
tilted by 10° in a field of view of 28° has 1.09."""

LEAST_SIZE = 1e-9
"""Least size in blocks that is computed with; smaller ones are mistakes, and ratios to them overflow."""

CLEAR, OFF_LEVEL = 0.1, 0.4
"""Largest error of a trial's contrast or place that shows it clearly, relative to the contrast and the size, and
the relative deviation of a contrast that does not follow its level."""

LEAST_SIGNAL = 8.0
"""Least contrast of the triangle, in standard errors, for its place, size and orientation to be measured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Inspection:
    """The properties that frames of a group with one stimulus show. Errors are standard errors; None: not known.

    Stated: `size_px`, and `stated_px`, the place of the centroid along x and y, the mean over the `n_trials`
    measured, whose median is `level`. The frames have `frame_sizes_px` rows and columns. `are_windows`: the
    manifest gives the place in each of them, and all reach as far from it on one side at least, as do windows that
    the border of a recording cuts.

    Background: `background_luminance_cd_m2` is the mean that contrast refers to, `ring_luminance_cd_m2` that
    around the triangle; `ring_ratio` is the second divided by the first, with its error and its standard deviation
    over trials. `uneven` is the contrast of the triangle that would answer the observer's templates as the empty
    background does, with its error; `uneven_texture` is the same elsewhere in the surround: the fixed pattern of a
    camera, for example.

    Triangle: `contrast_slope` is the displayed contrast per unit of the level, blur removed, positive if of the
    stated polarity, and `signal` that contrast in errors by the noise alone. `offset_px` is the place from the
    stated one along x and y, `size_ratio` the displayed size divided by the stated one, `turned_rad` the clockwise
    rotation from the stated orientation, and `blur_px` the standard deviation of the Gaussian that blurs it.
    `scatter_px` (along an axis), `size_scatter` and, on scenes, `level_scatter` (of the contrast for its level,
    over the mean) are standard deviations over trials, noise removed. `shown_as` is the name of an arrangement.
    `wrong_orientation` of `n_orientation` trials that show one clearly show another than stated; `wrong_level` of
    `n_level` have clearly not the contrast of their level.

    Values: `saturated_share` and `crushed_share` of the triangle's pixels are cut off at the largest and at the
    smallest value, `cut_at`. Codes, None without integer codes: `peak_code` and `full_scale` are the largest code
    read and possible, `code_step` the smallest difference of codes that occur (1 where clean frames have too few
    codes to show it) and `code_step_contrast` its contrast. `noise_contrast` is the standard deviation of a
    pixel's contrast.
    """

    group: Group
    stimulus: Stimulus
    size_px: float
    stated_px: tuple[float, float]
    are_windows: bool
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
    level_scatter: float | None = None
    signal: float = 0.0
    uneven: float = 0.0
    uneven_error: float = 0.0
    uneven_texture: float = 0.0
    saturated_share: float = 0.0
    crushed_share: float = 0.0
    cut_at: str = ""
    peak_code: int | None = None
    full_scale: int | None = None
    code_step: int | None = None
    code_step_contrast: float | None = None


def inspect(dataset: Dataset, trials: Sequence[Trial], *, centre: Centre = "centroid") -> list[Inspection]:
    """Return what the frames of each group show for each stimulus, from a sample of the trials, in their order.
    Frames that cannot be read are left out: scoring reports them. `centre` is the point of a triangle without a
    position that lies at the frame's centre.
    """
    inspections = []
    for chosen, size_mrad in sampled(dataset, trials):
        if samples := _samples(dataset, chosen, centre, size_mrad):
            inspections.append(_measured(dataset, samples, size_mrad))
    return inspections


def sampled(dataset: Dataset, trials: Sequence[Trial]) -> Iterator[tuple[Trials, float]]:
    """Yield the trials of each group and stimulus that are measured, and the median size of all of them in mrad.
    On scenes, these are trials that share their background with others.
    """
    trials = Trials.of(trials)
    of_stimulus = list(alike(trials))
    frames_a_trial = max(trials.n_frames / max(len(trials), 1), 1.0)
    # 64 frames are measured in all, or 4 % of them if that is more, and from 8 to 24 trials of each stimulus.
    of_each = max(64, 0.04 * trials.n_frames) / frames_a_trial / max(len(of_stimulus), 1)
    most = int(min(max(of_each, 8), 24))
    for members in of_stimulus:
        ours = trials.select(members)
        size_mrad = float(np.median(_sizes_mrad(ours)))
        if ours.has_scenes:
            yield ours.select(whole_views(ours, strengths(dataset, ours.levels), most)), size_mrad
        else:
            yield _spread(ours, most), size_mrad


def is_contrast(dataset: Dataset) -> bool:
    """Return whether the level of a dataset is the triangle's contrast, by its name."""
    return level_of(dataset.experiment.level).quantity == "contrast"


def strengths(dataset: Dataset, level: FloatArray) -> FloatArray:
    """Return the value that the displayed contrast is proportional to: the level if it is a contrast, otherwise
    1."""
    # Contrasts beyond are mistakes in a manifest, whose squares may overflow.
    return np.clip(level, 1e-9, 1e9) if is_contrast(dataset) else np.ones(len(level))


def _sizes_mrad(trials: Trials) -> FloatArray:
    return np.array([stimulus.size_mrad for stimulus in trials.stimuli])[trials.stimulus_codes]


def alike(trials: Trials) -> Iterator[NDArray[np.intp]]:
    """Yield the trials, ascending, of each group and polarity whose sizes are one size in perspective."""
    sizes = _sizes_mrad(trials)
    polarity = np.array([stimulus.polarity for stimulus in trials.stimuli])[trials.stimulus_codes]
    parts = []
    for group, sign in np.unique([trials.group_codes, polarity], axis=1).T:
        left = np.flatnonzero((trials.group_codes == group) & (polarity == sign))
        while len(left):
            is_alike = sizes[left] <= SIZES_ALIKE * sizes[left].min()
            parts.append(left[is_alike])
            left = left[~is_alike]
    yield from sorted(parts, key=lambda part: int(part[0]))


def _spread(trials: Trials, most: int) -> Trials:
    """Choose trials of all levels and orientations, evenly over the manifest."""
    if len(trials) <= most:
        return trials
    ordered = np.lexsort([np.argsort(np.argsort(ORIENTATIONS))[trials.quarter_turns], trials.levels])
    return trials.select(ordered[np.linspace(0, len(trials) - 1, most).round().astype(int)])


def _samples(dataset: Dataset, trials: Trials, centre: Centre, size_mrad: float) -> Sequence[TrialSample]:
    """Measure trials of a group; on scenes, those are left out whose background no other shares."""
    middles = view_middles(trials) if trials.has_scenes else [None] * len(trials)
    size_px = min(size_mrad / dataset.display.pitch_mrad, 1e300)
    samples = []
    for trial, middle in zip(trials, middles, strict=True):
        with suppress(DataError):
            samples.append(measure_trial(dataset, trial, centre, size_px=size_px, middle_px=middle))
    return that_share(samples) if trials.has_scenes else samples


def _are_windows(samples: Sequence[TrialSample]) -> bool:
    """Return whether all frames with places reach equally far from them, which frames of two scales do not."""
    if any(sample.trial.x_px is None for sample in samples):
        return False
    reaches = [
        max(x + 0.5, columns - 0.5 - x, y + 0.5, rows - 0.5 - y)
        for (x, y), (rows, columns) in ((sample.stated_px, sample.frame_px) for sample in samples)
    ]
    return max(reaches) <= SIZES_ALIKE * min(reaches)


def _measured(dataset: Dataset, samples: Sequence[TrialSample], size_mrad: float) -> Inspection:
    """Measure samples of one stimulus, whose sizes are alike: about `size_mrad`."""
    trial, level = samples[0].trial, np.array([sample.trial.level for sample in samples])
    stimulus = replace(trial.stimulus, size_mrad=size_mrad)
    size_px = min(size_mrad / dataset.display.pitch_mrad, 1e300)
    size = size_px / samples[0].block_px
    triangle = GroupTriangle.of(dataset, samples, size_px)
    names = np.array(["" if sample.trial.view is None else sample.trial.view.scene for sample in samples])
    if triangle.scenes is not None:
        keeps_ring = dataset.display.background_luminance_cd_m2 == "surround"
        samples = triangle.scenes.on_even_field(samples, stimulus.polarity, size, keeps_ring=keeps_ring)
    ratio = np.array([sample.ring_cd_m2 / sample.background_cd_m2 for sample in samples])
    if triangle.scenes is not None:  # trials on one scene have the same luminance around their triangles
        ratio = np.array([ratio[names == name].mean() for name in sorted(set(names))])
    scatter = float(ratio.std(ddof=1)) if len(ratio) > 1 else 0.0
    stated_x, stated_y = np.mean([sample.stated_px for sample in samples], axis=0).tolist()
    return Inspection(
        group=trial.group,
        stimulus=stimulus,
        size_px=size_px,
        stated_px=(stated_x, stated_y),
        are_windows=_are_windows(samples),
        n_trials=len(samples),
        frame_sizes_px=tuple(sorted({sample.frame_px for sample in samples})),
        background_luminance_cd_m2=float(np.mean([sample.background_cd_m2 for sample in samples])),
        ring_luminance_cd_m2=float(np.mean([sample.ring_cd_m2 for sample in samples])),
        ring_ratio=float(ratio.mean()),
        ring_ratio_error=math.hypot(scatter / math.sqrt(len(ratio)), _static_error(samples, scatter, size)),
        ring_scatter=scatter,
        level=float(np.median(level)),
        noise_contrast=float(np.median([sample.noise for sample in samples])),
        saturated_share=float(np.mean([sample.cut.top for sample in samples])),
        crushed_share=float(np.mean([sample.cut.bottom for sample in samples])),
        cut_at=next((sample.cut.where for sample in samples if sample.cut.where), ""),
        **_of_codes([(sample.trial.level, sample.codes) for sample in samples if sample.codes is not None]),
        **_of_triangle(triangle, samples, strengths(dataset, level), max(size, LEAST_SIZE), names.tolist()),
    )


def _static_error(samples: Sequence[TrialSample], scatter: float, size: float) -> float:
    """Estimate the relative error of the luminance around the triangle from a pattern that all frames share: the
    larger of two estimates. The first is the error of the mean of eight sectors around the triangle. On a small
    frame a blurred pattern makes all sectors alike; so the second follows from the `scatter` of the relative
    luminance over trials, which the noise causes. Pattern and noise are taken to be blurred alike: the ratio of
    their errors is that of their standard deviations within the frames.
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


def _of_codes(of_trials: Sequence[tuple[float, Codes]]) -> dict[str, Any]:
    """Return what codes show, from the level and the codes of each trial. A triangle of one code on a background
    of one shows its own contrast and no step of the codes, unless fainter ones vanish: they are rounded to the
    background.
    """
    if not of_trials:
        return {}
    faintest = min((level for level, codes in of_trials if codes.step), default=math.inf)
    vanished = [level for level, codes in of_trials if not codes.step]
    are_rounded = bool(vanished) and max(vanished) <= faintest < math.inf
    each = [codes for _, codes in of_trials]
    stepped = [codes for codes in each if codes.step and (are_rounded or not codes.is_flat)]
    contrasts = [codes.step_contrast for codes in stepped] or [codes.bit_contrast for codes in each]
    return {
        "peak_code": max(codes.peak for codes in each),
        "full_scale": each[0].full_scale,
        "code_step": min((codes.step for codes in stepped), default=1),
        "code_step_contrast": float(np.median(contrasts)),
    }


class GroupTriangle(NamedTuple):
    """The triangle of a group's frames, and of each of them, in blocks. The contrast of `fit`, the triangle that
    all share, is positive if of the stated polarity. `middle`, (3,), is the mean stated place, from the middle of
    the window, and the mean logarithm of the stated size. `error`, (5,), has the standard errors of contrast, x, y
    and size (as a share), by noise and by the spread over the trials, and of the turn. `signal` is the contrast in
    standard errors by noise alone; 0 if the frames show none. `scenes` are the frames as background, triangle and
    noise, if they show scenes.
    """

    images: Images
    fit: TriangleFit
    trials: TrialEstimates
    middle: FloatArray
    error: FloatArray
    signal: float
    scenes: SceneParts | None
    block_px: int

    @classmethod
    def of(cls, dataset: Dataset, samples: Sequence[TrialSample], size_px: float) -> GroupTriangle:
        """Fit the triangle of some trials, whose sizes are alike: about `size_px` pixels."""
        block_px, pitch = samples[0].block_px, dataset.display.pitch_mrad
        size = max(size_px / block_px, LEAST_SIZE)
        sizes = np.maximum([size_in_px(sample.trial, pitch) / block_px for sample in samples], LEAST_SIZE)
        level = strengths(dataset, np.array([sample.trial.level for sample in samples]))
        turns = np.array([sample.trial.orientation.quarter_turns for sample in samples])
        has_views = any(sample.trial.view is not None for sample in samples)
        view = numbered_views(samples) if has_views else None
        shown = [sample.even if view is None else sample.seen for sample in samples]
        even = samples[0].trial.stimulus.polarity * np.array(shown)
        known = np.logical_and.reduce([sample.known for sample in samples])
        given = Given(level, np.ones(len(level)), turns)
        left = even if view is None else without_scenes(even, given, known, view)
        given = given._replace(noise=noise_of_frames(left, level, known, size))
        share = np.square(level / given.noise) / np.square(level / given.noise).sum()
        stated = np.column_stack([[sample.offset for sample in samples], np.log(sizes)])
        hole = HOLE_IN_SIZES * size
        images = Images.of(even, given, known=known, hole=hole, view=view)
        middle = share @ stated
        apart = stated - middle
        triangle = fitted(images, first_guess(images, size))
        if np.abs(apart).max() > 1e-3:  # a twentieth of what fits of single frames resolve
            even = aligned(even, triangle, given, apart)
            images = Images.of(even, given, known=known, hole=hole, view=view)
        triangle = fit(images, triangle.shape, triangle.shown)
        scenes, of_noise_alone = None, images
        if view is not None:
            scenes = SceneParts.of(even, triangle, images, given, view)
            even, of_noise_alone = scenes.even, images._replace(background=np.zeros_like(images.background))
        each = of_trials(triangle, of_noise_alone, even, given)
        excess = np.maximum(np.square(share) @ (np.square(each.residual) - np.square(each.error)), 0.0)
        errors, alone = errors_of(triangle, images)
        signal = abs(triangle.shape.amplitude) / alone if alone > 0.0 else math.inf
        # Equal frames may leave a contrast by rounding: luminance has single precision, 6e-8 of itself.
        if abs(triangle.shape.amplitude) * level.max() <= 1e-6:
            signal = 0.0
        errors[:4] = np.hypot(errors[:4], np.sqrt(excess))
        return cls(images, triangle, each, middle, errors, signal, scenes, block_px)

    @property
    def size_ratio(self) -> float:
        """Size of the triangle divided by the stated one."""
        return float(self.fit.shape.size / math.exp(self.middle[2]))

    @property
    def offset(self) -> FloatArray:
        """The displacement from the stated place to the triangle, (2,)."""
        return np.array([self.fit.shape.x, self.fit.shape.y]) - self.middle[:2]


def _of_triangle(
    of_group: GroupTriangle, samples: Sequence[TrialSample], level: FloatArray, size: float, scenes: Sequence[str]
) -> dict[str, Any]:
    """Measure the triangle; lengths are in blocks until the end."""
    images, triangle, each, _, error, signal, parts, block_px = of_group
    shape = triangle.shape
    turns = np.array([sample.trial.orientation.quarter_turns for sample in samples])
    known = images.weight > 0.0
    polarity = samples[0].trial.stimulus.polarity
    amplitude = abs(shape.amplitude)
    # A triangle that is cut off by the edge of some frames has a place, but no sure size and contrast.
    is_whole = bool(known[within(len(known), 1.2 * size)].all())
    # Where levels do not tell a scene from its triangles, only their differences are known: little, if blurred.
    # From 0.29 sizes on, fits of triangles of 4 pixels end with contrasts off by half, and sizes off by a tenth.
    is_whole &= images.has_triangle or shape.variance <= (0.22 * size) ** 2
    seen = polarity * np.array([sample.seen for sample in samples])
    measured: dict[str, Any] = {
        "contrast_slope": shape.amplitude if signal else 0.0,
        "contrast_slope_error": float(error[0]) if is_whole else None,
        "signal": signal,
        **_unevenness(
            seen, images, level, turns, size, None if parts is None else (parts, parts.of_scenes(scenes))
        ),
    }
    if signal < LEAST_SIGNAL:
        return measured
    clear_place = each.error[:, 1:3].max(axis=1) < CLEAR * size
    clear_level = each.error[:, 0] < CLEAR * amplitude
    off_level = clear_level & (np.abs(each.residual[:, 0]) > OFF_LEVEL * amplitude)
    ranked = np.sort(each.likeness, axis=1)
    clear_turn = ranked[:, 3] - ranked[:, 2] > 8.0 * each.likeness_error
    shown = np.array(triangle.shown)[turns]
    # Where levels are wrong, so are the backgrounds, and no single trial is clear.
    level_scatter = None if parts is None else _scatter(each.residual[:, :1], each.error[:, :1])
    return measured | {
        "offset_px": tuple((block_px * of_group.offset).tolist()),
        "offset_error_px": tuple((block_px * error[1:3]).tolist()),
        "scatter_px": _scatter(
            block_px * each.residual[clear_place, 1:3], block_px * each.error[clear_place, 1:3]
        ),
        "size_ratio": of_group.size_ratio,
        "size_ratio_error": of_group.size_ratio * float(error[3]) if is_whole else None,
        "size_scatter": _scatter(each.residual[clear_place, 3:], each.error[clear_place, 3:]),
        "turned_rad": shape.turn_rad,
        "turned_error_rad": float(error[4]),
        "blur_px": block_px * math.sqrt(max(shape.variance, 0.0)),
        "shown_as": next(turned.name for turned in TURNED if turned.shown == triangle.shown),
        "wrong_orientation": int((clear_turn & (each.likeness.argmax(axis=1) != shown)).sum()),
        "n_orientation": int(clear_turn.sum()),
        "wrong_level": int(off_level.sum()),
        "n_level": int(clear_level.sum()),
        "level_scatter": None if level_scatter is None else level_scatter / amplitude,
    }


def noise_of_frames(images: FloatArray, level: FloatArray, known: NDArray[np.bool_], size: float) -> FloatArray:
    """Estimate the standard deviation of the contrast of each frame's blocks around the triangle. It is at least a
    twentieth of the level, so that frames without noise count alike.
    """
    around = known & ~within(len(known), HOLE_IN_SIZES * size)
    if not around.any():
        return np.ones(len(images))
    apart = np.abs(images[:, around] - np.median(images[:, around], axis=1)[:, None])
    return np.maximum(1.4826 * np.median(apart, axis=1), level / 20.0)


def _scatter(apart: FloatArray, noise: FloatArray) -> float | None:
    """Return the standard deviation over trials beyond the noise: 0 if it may be noise, None if few show it. Both
    arguments have shape (trial, axes). Trials count by the inverse of their noise variance, so that the faintest
    do not decide.
    """
    n, axes = apart.shape
    if n < 4:
        return None
    weight = 1.0 / np.square(np.maximum(noise, 1e-6))  # frames without noise count alike
    sums = weight.sum(axis=0)
    excess = weight * np.square(apart - (weight * apart).sum(axis=0) / sums)
    freedom = (n - 1) * axes
    # The cube root of a mean square is normal, very nearly (Wilson and Hilferty): beyond five errors is no noise.
    if excess.sum() <= freedom * (1.0 + 5.0 * math.sqrt(2.0 / (9.0 * freedom))) ** 3:
        return 0.0
    return math.sqrt((excess.sum() - freedom) / (sums - np.square(weight).sum(axis=0) / sums).sum())


def _unevenness(
    seen: FloatArray,
    images: Images,
    level: FloatArray,
    turns: NDArray[np.intp],
    size: float,
    scenes: tuple[SceneParts, FloatArray | None] | None,
) -> dict[str, Any]:
    """Measure the contrast of the triangle that would answer the templates as the background's own structure does.
    The structure elsewhere on the frames, such as a fixed pattern, is measured in the same way. Nothing is
    returned if the frames show too little else. Of scenes, that is the mean of their backgrounds, which is as
    uncertain as they differ; nothing is returned if they are too few.
    """
    known = images.weight > 0.0
    n = len(known)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    steps = math.ceil(0.6 * size)
    inner = cv2.erode(
        known.astype(np.uint8), cross, iterations=steps, borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    elsewhere = (inner > 0) & ~within(n, size)
    if elsewhere.sum() < np.square(2.0 * size):
        return {}
    of_scenes: FloatArray | None = None
    if scenes is None:
        known_apart = np.linalg.matrix_rank(images.information, tol=1e-9 * np.trace(images.information))
        if known_apart < len(set(turns.tolist())):  # levels and orientations do not tell triangles from background
            return {}
        static = np.tensordot(images.shares[4], seen, 1)
        triangles = np.tensordot(images.shares[:4], seen, 1)
        noise = seen - static - level[:, None, None] * triangles[turns]
    else:
        parts, of_scenes = scenes
        if of_scenes is None:
            return {}
        static, noise = of_scenes.mean(axis=0), parts.noise
    middle = (n - 1) / 2.0
    weights = orientation_weights((n, n), size_px=size, x_px=middle, y_px=middle)
    if not weights.any():
        return {}
    spectrum = np.fft.rfft2(static)
    maps = np.fft.irfft2(spectrum * np.conj(np.fft.rfft2(weights)), static.shape)
    spread = np.fft.fftshift(np.ptp(maps, axis=0))
    each = noise.reshape(len(noise), -1) @ weights.reshape(4, -1).T
    variance = float((np.square(images.shares[4]) @ np.square(each)).max())
    if of_scenes is not None:
        apart = np.tensordot(of_scenes - static, weights, ([1, 2], [1, 2]))
        variance += float(np.square(apart).sum(axis=0).max()) / (len(apart) * (len(apart) - 1))
    return {
        "uneven": float(spread[n // 2, n // 2]),
        "uneven_error": math.sqrt(variance),
        "uneven_texture": float(np.median(spread[elsewhere])),
    }


def records(dataset: Dataset, inspections: Sequence[Inspection]) -> list[dict[str, Any]]:
    """Return inspections as plain values for JSON; the group's values have the names of their columns."""
    each = []
    for inspection in inspections:
        values = asdict(inspection)
        values["group"] = dict(zip(dataset.experiment.group_by, inspection.group, strict=True))
        values |= values.pop("stimulus")
        each.append({name: value for name, value in values.items() if value is not None})
    return each
