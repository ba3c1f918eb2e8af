"""Search for triangles: one position for a group, or one for each trial."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, FrameError
from todframes.base.reading import convert
from todframes.diagnosis.arrangement import ARRANGEMENTS, Arrangement
from todframes.diagnosis.inspection import (
    LEAST_SIGNAL,
    GroupTriangle,
    alike,
    is_contrast,
    noise_of_frames,
    strengths,
)
from todframes.diagnosis.places import Template, chosen_places
from todframes.diagnosis.triangle import Shape, multiplicity
from todframes.diagnosis.whole_frames import MeanFrames, search
from todframes.diagnosis.windows import TrialSample, measure_trial
from todframes.frames.contrast import skipped_frames
from todframes.frames.dataset import Dataset, DatasetWarning, Skipped
from todframes.frames.position import from_centroid, size_in_px, to_centroid
from todframes.frames.trials import Group, Trial, Trials, indices_by
from todframes.parameters import Locate, Progress
from todframes.stimulus import Centre

LEAST_PEAK = 6.0
"""Least height of a correlation peak above its surroundings, in their standard deviations."""

MOST_FITTED = 256
"""Largest number of trials, the strongest, that the triangle of a group is fitted to."""

MOST_STRONGEST = 24
"""Number of the strongest trials that are searched over whole frames for positions of their own."""

LEAST_SURE_TRIALS = 4
"""Least number of these with a high peak from which the middle of the positions is known."""

STRONG = 0.5
"""Least level, as a share of the highest, of trials in which the triangle is looked for before it is known."""

SEARCHED, LEAST_SEARCHED_PX = 2.5, 8.0
"""Largest distance of a trial's position from where its search begins: so many sizes, and pixels more."""

NEARBY = 4.0
"""The same distance in standard deviations of the positions, if that is larger."""

MOST_ERROR_MRAD = 0.09
"""Standard error of single positions along an axis from which they raise a threshold by more than 3 %: between
0.1 and 0.15 of noise in docs/validation.md."""


class Location(NamedTuple):
    """The position found for a group's triangles, in pixels, and its standard error along either axis.

    The error is None if no triangle stands out and the manifest's positions stay.

    `arrangement` states whether the triangles are as the manifest says. `n_located` of `n_trials` trials have a
    position of their own, whose standard deviation along either axis is `scatter_px`; all three are None if the
    group has one position. `moved_px` is the mean way from the manifest's positions, None if it has none.
    From `sure_level` on, single positions are known well enough not to raise a threshold; None: nowhere.
    `size_ratio` is the size of the triangles on the frames divided by that in the manifest, 1 if not known.
    """

    group: Group
    x_px: float
    y_px: float
    standard_error_px: float | None
    arrangement: Arrangement = ARRANGEMENTS[0]
    n_trials: int | None = None
    n_located: int | None = None
    scatter_px: float | None = None
    moved_px: tuple[float, float] | None = None
    sure_level: float | None = None
    size_ratio: float = 1.0


def locate_triangles(
    dataset: Dataset,
    *,
    locate: Locate = "group",
    centre: Centre = "centroid",
    skip_bad_frames: bool = False,
    progress: Progress | None = None,
    sizes: Sequence[float] = (1.0,),
) -> tuple[Dataset, tuple[Location, ...]]:
    """Find the positions of triangles.

    The search begins at the positions in the manifest: all of a group are moved by one displacement, or each by
    its own. They stay if no triangle stands out near them. Of other trials whole frames are searched.

    The search of whole frames compares the mean frames of the orientations: the part that these share (bezel,
    overlay, shading, fixed pattern) is subtracted. There, the triangle is fitted to the group's strongest trials.
    Triangles that are mirrored, turned or of the opposite polarity are found too.

    The position of a single trial is where a triangle of any of the four orientations is most likely. So it does
    not depend on the stated one, and cannot make a right answer more probable. It is weighed against where the
    others are. A trial that shows no triangle has their mean position.

    Parameters
    ----------
    dataset : Dataset
    locate : {"group", "each"}
        Find one position for all trials of a group, or one for each trial.
    centre : {"centroid", "bounding_box"}
        The point that the triangles of all orientations have in common.
    skip_bad_frames : bool
        Skip trials that cannot be read and groups in which no triangle stands out, and list them in `bad_rows`.
    progress : callable
        Called with the number of trials that are done, and of all; with "each" again for each.
    sizes : sequence of float
        Sizes to search whole frames for, as multiples of those in the manifest.

    Returns
    -------
    Dataset
        The dataset with `x_px` and `y_px` as found, and without the trials that were skipped.
    tuple of Location
        One for each group; two if only a part of its trials has positions in the manifest.

    Raises
    ------
    DataError
        If no triangle stands out where the manifest has no position, or the frames of a group differ in size.
    FrameError
        If a frame cannot be read, unless bad frames are skipped.
    SettingsError
        If `locate` is neither of the two.
    """
    convert(locate, Locate, "locate")
    trials = dataset.trials
    position_px, is_kept = trials.positions_px, np.ones(len(trials), bool)
    is_placed = np.isfinite(position_px[:, 0])
    locations: list[Location] = []
    skipped: list[Skipped] = []
    n_done, n_all = 0, int(np.count_nonzero(~is_placed)) + (len(trials) if locate == "each" else 0)

    def advance(n: int) -> None:
        nonlocal n_done
        n_done += n
        if progress is not None:
            progress(n_done, n_all)

    def leave_out(k: int, error: FrameError | str) -> None:
        if not skip_bad_frames:
            raise error if isinstance(error, FrameError) else DataError(error)
        is_kept[k] = False
        skipped.extend(skipped_frames(dataset, trials[k], error))

    for members in indices_by(2 * trials.group_codes.astype(np.int64) + is_placed):
        try:
            if is_placed[members[0]]:
                start_px, reach_px, ratio = position_px[members], 0.0, 1.0
            else:
                members, start_px, reach_px, ratio = _begun(
                    dataset, members, locate, centre, sizes, leave_out, advance
                )
            if not len(members):
                continue
            found, of_size = [], list(alike(trials.select(members)))
            for part in of_size:
                ours = trials.select(members[part]).placed(start_px[part])
                ways = _Ways(dataset, ours if ratio == 1.0 else _scaled(ours, ratio), reach_px)
                found.append(
                    ways.of_each(members[part], leave_out, advance) if locate == "each" else ways.of_all()
                )
            if not is_placed[members[0]] and all(one.error_px is None for one in found):
                raise _nothing_stands_out(dataset, trials[int(members[0])].group)
            if locate == "group":
                common = _location(trials.select(members), found, 0.0 * start_px, None, 1.0)
                found = [one._replace(way_px=0.0 * one.way_px + (common.x_px, common.y_px)) for one in found]
            for part, one in zip(of_size, found, strict=True):
                position_px[members[part]] = start_px[part] + one.way_px
            wanted = None if is_placed[members[0]] else centre
            location = _location(trials.select(members), found, start_px, wanted, dataset.display.pitch_mrad)
            locations.append(location._replace(size_ratio=ratio * location.size_ratio))
        except FrameError:
            raise
        except DataError as error:
            for k in members[is_kept[members]].tolist():
                leave_out(k, str(error))
    placed = trials.placed(position_px).select(is_kept)
    return replace(dataset, trials=placed, bad_rows=(*dataset.bad_rows, *skipped)), tuple(locations)


def _scaled(trials: Trials, ratio: float) -> Trials:
    """Return trials with another size."""
    return Trials.of(
        one._replace(stimulus=replace(one.stimulus, size_mrad=ratio * one.stimulus.size_mrad)) for one in trials
    )


LeaveOut = Callable[[int, FrameError | str], None]
"""Leave out the trial at an index because of an error, or raise it."""


def _begun(
    dataset: Dataset,
    members: NDArray[np.intp],
    locate: Locate,
    centre: Centre,
    sizes: Sequence[float],
    leave_out: LeaveOut,
    advance: Callable[[int], None],
) -> tuple[NDArray[np.intp], FloatArray, float, float]:
    """Find the approximate place of a group's triangles, anywhere on the frames.

    Returns
    -------
    ndarray of int
        The trials that can be read.
    ndarray, shape (trial, 2)
        Centroids, in pixels.
    float
        Distance within which the places of single trials are expected, in pixels; 0: not known.
    float
        Size of the triangles divided by the stated one: one of `sizes`.
    """
    frames, is_usable = MeanFrames(dataset), np.ones(len(members), bool)
    for k, (member, trial) in enumerate(zip(members.tolist(), dataset.trials.select(members), strict=True)):
        try:
            frames.add(trial)
        except FrameError as error:
            leave_out(member, error)
            is_usable[k] = False
        advance(1)
    members = members[is_usable]
    usable = dataset.trials.select(members)
    if not len(members):
        return members, np.zeros((0, 2)), 0.0, 1.0
    pitch_mrad = dataset.display.pitch_mrad
    strongest = _of_strongest(frames, usable, pitch_mrad) if locate == "each" else None
    if strongest is not None:
        (x_px, y_px), scatter_px = strongest
        return members, np.tile([x_px, y_px], (len(members), 1)), NEARBY * scatter_px, 1.0
    found = search(frames.take_means(), frames.block_px * pitch_mrad, centre, sizes)
    if found.height == -math.inf:
        rows, columns = frames.shape or (0, 0)
        size = f"frames of {columns} × {rows} pixels"
        raise DataError(f"{dataset.path}: {size} are smaller than the triangle")
    if not found.height > LEAST_PEAK * found.spread:
        raise _nothing_stands_out(dataset, usable[0].group)
    x_px, y_px = frames.in_pixels((found.x, found.y))
    seen = usable if found.size == 1.0 else _scaled(usable, found.size)
    start_px = np.array([to_centroid(one, x_px, y_px, centre, pitch_mrad) for one in seen])
    return members, start_px, 0.0, found.size


def _nothing_stands_out(dataset: Dataset, group: Group) -> DataError:
    names = zip(dataset.experiment.group_by, group, strict=True)
    name = ", ".join(f"{key} {value}" for key, value in names) or "the dataset"
    return DataError(
        f"{dataset.path}: no triangle stands out in the frames of {name}; expected x_px and y_px in the manifest"
    )


def _of_strongest(
    frames: MeanFrames, trials: Trials, pitch_mrad: float
) -> tuple[tuple[float, float], float] | None:
    """Find the middle and the scatter of the positions in the strongest trials, anywhere on the frames, in pixels.

    None if a triangle stands out in less than half of these.
    """
    strongest = trials.select(np.argsort(-trials.levels, kind="stable")[:MOST_STRONGEST])
    common = frames.mean()
    tops: dict[int, list[tuple[float, float, float]]] = {1: [], -1: []}
    for trial in strongest:
        image = frames.of_trial(trial) - common
        n = max(image.shape)
        size = size_in_px(trial, pitch_mrad) / frames.block_px
        if size > n / 2.0:
            return None
        noise = max(1.4826 * float(np.median(np.abs(image - np.median(image)))), 1e-12)
        padded = np.zeros((n, n))
        padded[: image.shape[0], : image.shape[1]] = image - np.median(image)
        template = Template.of(Shape.upright(1.0, 0.0, 0.0, size), np.ones((2 * n, n + 1)), n)
        for sign, of_sign in tops.items():
            signed = sign * trial.stimulus.polarity * padded
            peaks = template.peaks(signed, contrast=None, noise=noise, reach=n / 2.0 - 2.0)
            if len(peaks.height):
                x, y = peaks.places[0] + (n - 1) / 2.0
                of_sign.append((float(x), float(y), math.sqrt(2.0 * max(float(peaks.height[0]), 0.0))))
    best = max(tops.values(), key=lambda one: float(np.median([height for *_, height in one] or [0.0])))
    sure = np.array([(x, y) for x, y, height in best if height >= LEAST_PEAK])
    if len(sure) < max(LEAST_SURE_TRIALS, len(strongest) / 2.0):
        return None
    middle = np.median(sure, axis=0)
    scatter = 1.4826 * float(np.median(np.abs(sure - middle)))
    return frames.in_pixels((float(middle[0]), float(middle[1]))), frames.block_px * scatter


class _Found(NamedTuple):
    """Displacements of trials from the start of their search, (trial, 2), and their mean, its error and scatter,
    in pixels.

    `error_px` is None if no triangle stands out; `is_own`, (trial,), marks those with a place of their own.
    """

    way_px: FloatArray
    mean_px: FloatArray
    error_px: float | None
    arrangement: Arrangement
    is_own: NDArray[np.bool_] | None = None
    scatter_px: float = 0.0
    sure_level: float = math.inf
    size_ratio: float = 1.0


@dataclass(frozen=True, slots=True)
class _Ways:
    """The search for the triangles of trials of similar sizes, from their approximate places."""

    dataset: Dataset
    trials: Trials
    reach_px: float

    def _size_px(self) -> float:
        pitch_mrad = self.dataset.display.pitch_mrad
        return min(float(np.median([one.stimulus.size_mrad for one in self.trials])) / pitch_mrad, 1e300)

    def _window(self, trial: Trial, reach_px: float) -> TrialSample:
        return measure_trial(self.dataset, trial, "centroid", size_px=self._size_px(), reach_px=reach_px)

    def _windows(self, trials: Trials, reach_px: float = 0.0) -> list[TrialSample]:
        """Measure the strongest trials; those that cannot be read are reported where all are read."""
        found = []
        for trial in trials.select(np.sort(np.argsort(-trials.levels, kind="stable")[:MOST_FITTED])):
            try:
                found.append(self._window(trial, reach_px))
            except DataError:
                continue
        return found

    def _fit(self, trials: Trials) -> tuple[GroupTriangle, int] | None:
        """Fit the triangle of the strongest trials; returns it and the pixels along a block, or None."""
        samples = self._windows(trials)
        if not samples:
            return None
        found = GroupTriangle.of(self.dataset, samples, self._size_px())
        return (found, samples[0].block_px) if found.signal >= LEAST_SIGNAL else None

    def _nothing(self) -> _Found:
        n = len(self.trials)
        return _Found(np.zeros((n, 2)), np.zeros(2), None, ARRANGEMENTS[0], np.zeros(n, bool))

    def of_all(self) -> _Found:
        """Find the displacement that all trials have in common."""
        fitted = self._fit(self.trials)
        if fitted is None:
            return self._nothing()._replace(is_own=None)
        found, block_px = fitted
        mean = block_px * found.offset
        way = np.tile(mean, (len(self.trials), 1))
        error_px = block_px * float(found.error[1:3].max())
        return _Found(way, mean, error_px, _arrangement(found), size_ratio=found.size_ratio)

    def of_each(self, members: NDArray[np.intp], leave_out: LeaveOut, advance: Callable[[int], None]) -> _Found:
        """Find the displacement of each trial."""
        size_px = self._size_px()
        reach_px = max(SEARCHED * size_px + LEAST_SEARCHED_PX, self.reach_px)
        # The place of the strongest, with a triangle as stated, and the picture of the triangle from these.
        levels = self.trials.levels
        strong = self._windows(self.trials.select(levels >= STRONG * levels.max()), reach_px)
        if not strong:
            advance(len(self.trials))
            return self._nothing()
        block_px = strong[0].block_px
        size, n = size_px / block_px, len(strong[0].known)
        first = Template.of(Shape.upright(1.0, 0.0, 0.0, size), np.ones((2 * n, n + 1)), n)
        noise = self._noise(strong, size)
        rough = max(
            (
                [
                    first.peaks(sign * one.even, contrast=None, noise=spread, reach=reach_px / block_px)
                    for one, spread in zip(strong, noise.tolist(), strict=True)
                ]
                for sign in (1.0, -1.0)
            ),
            key=lambda peaks: float(np.median([one.height[0] if len(one.height) else 0.0 for one in peaks])),
        )
        offsets = np.array([one.offset for one in strong])
        chosen = chosen_places(
            [one._replace(places=one.places - off) for one, off in zip(rough, offsets, strict=True)]
        )
        some = Trials.of([one.trial for one in strong])
        if chosen is not None:
            some = some.placed(some.positions_px + block_px * chosen.places)
        fitted = self._fit(some.select(chosen.is_own) if chosen is not None and chosen.is_own.any() else some)
        if fitted is None:
            advance(len(self.trials))
            return self._nothing()
        found, _ = fitted
        polarity = strong[0].trial.stimulus.polarity
        sign = polarity * math.copysign(1.0, found.fit.shape.amplitude)
        template = Template.of(found.fit.shape, _isotropic(found.trials.spectrum, 2 * n), n)
        slope = abs(found.fit.shape.amplitude) if is_contrast(self.dataset) else None
        peaks, kept = [], []
        for k, (member, trial) in enumerate(zip(members.tolist(), self.trials, strict=True)):
            try:
                sample = self._window(trial, reach_px)
            except FrameError as error:
                leave_out(member, error)
            else:
                (spread,) = self._noise([sample], size)
                contrast = None if slope is None else slope * float(strengths(self.dataset, np.array(trial.level)))
                one = template.peaks(
                    sign * sample.even, contrast=contrast, noise=spread, reach=reach_px / block_px
                )
                peaks.append(one._replace(places=one.places - sample.offset))
                kept.append(k)
            advance(1)
        chosen = chosen_places(peaks)
        if chosen is None:
            return self.of_all()._replace(is_own=np.zeros(len(self.trials), bool))
        mean = block_px * chosen.mean
        way, is_own = np.tile(mean, (len(self.trials), 1)), np.zeros(len(self.trials), bool)
        way[kept], is_own[kept] = block_px * chosen.places, chosen.is_own
        scatter_px = block_px * chosen.scatter
        mean_square = scatter_px**2 + float(np.square(block_px * chosen.error[chosen.is_own]).mean())
        error_px = math.sqrt(mean_square / int(chosen.is_own.sum()))
        error_mrad = block_px * self.dataset.display.pitch_mrad * chosen.error
        sure_level = _sure_level(levels[kept], error_mrad)
        return _Found(way, mean, error_px, _arrangement(found), is_own, scatter_px, sure_level, found.size_ratio)

    def _noise(self, samples: Sequence[TrialSample], size: float) -> FloatArray:
        known = np.logical_and.reduce([one.known for one in samples])
        level = strengths(self.dataset, np.array([one.trial.level for one in samples]))
        return noise_of_frames(np.array([one.even for one in samples]), level, known, size)


def _sure_level(levels: FloatArray, error_mrad: FloatArray) -> float:
    """Return the lowest level from which single positions are known well; infinite if there is none."""
    distinct = np.unique(levels)
    error = np.array([math.sqrt(float(np.square(error_mrad[levels == one]).mean())) for one in distinct])
    is_sure = np.logical_and.accumulate((error <= MOST_ERROR_MRAD)[::-1])[::-1]
    first = int(is_sure.argmax())
    if not is_sure.any() or first == 0:
        return float(distinct[0]) if is_sure.any() else math.inf
    # Errors are powers of the level, very nearly.
    ends = np.log(np.maximum(error[[first, first - 1]], 1e-9))
    share = (math.log(MOST_ERROR_MRAD) - ends[0]) / (ends[1] - ends[0])
    return float(distinct[first] * (distinct[first - 1] / distinct[first]) ** share)


def _arrangement(found: GroupTriangle) -> Arrangement:
    sign = 1 if found.fit.shape.amplitude > 0.0 else -1
    return next(one for one in ARRANGEMENTS if (one.shown, one.sign) == (found.fit.shown, sign))


def _isotropic(spectrum: FloatArray, length: int) -> FloatArray:
    """Return a power spectrum on another grid, (length, length/2 + 1), the mean over all directions."""

    def distance(n: int) -> FloatArray:
        return np.asarray(np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)))

    n_rings = 16
    ring = np.minimum((2.0 * n_rings * distance(len(spectrum))).astype(int), n_rings)
    weight = multiplicity(len(spectrum))
    total, weights = (np.bincount(ring.ravel(), one.ravel()) for one in (weight * spectrum, weight))
    power = total / np.maximum(weights, weight.min())  # a ring may be empty
    floor = 1e-3 * float(power.mean()) + 1e-12
    at = 2.0 * n_rings * distance(length) - 0.5
    return np.asarray(np.interp(at, np.arange(len(power)), np.maximum(power, floor)), np.float64)


def _location(
    trials: Trials, found: Sequence[_Found], start_px: FloatArray, centre: Centre | None, pitch_mrad: float
) -> Location:
    """Return the location of a group from those of its sizes. `centre` is None if the manifest gives positions."""
    errors = [one.error_px for one in found if one.error_px is not None]
    weight = np.array([0.0 if one.error_px is None else 1.0 / max(one.error_px, 1e-9) ** 2 for one in found])
    moved = np.average([one.mean_px for one in found], axis=0, weights=weight if errors else None)
    middle = start_px.mean(axis=0) + moved
    if centre is not None:
        middle += np.mean([from_centroid(one, centre, pitch_mrad) for one in trials], axis=0)
    own = [one.is_own for one in found if one.is_own is not None]
    sure_level = max(one.sure_level for one in found)
    surest = found[int(weight.argmax())]
    return Location(
        trials[0].group,
        float(middle[0]),
        float(middle[1]),
        1.0 / math.sqrt(float(weight.sum())) if errors else None,
        surest.arrangement,
        len(trials) if own else None,
        int(sum(one.sum() for one in own)) if own else None,
        math.sqrt(float(np.mean([one.scatter_px**2 for one in found]))) if own else None,
        (float(moved[0]), float(moved[1])) if centre is None else None,
        None if math.isinf(sure_level) else sure_level,
        surest.size_ratio,
    )


def location_warnings(
    dataset: Dataset, locations: Sequence[Location], thresholds: Mapping[Group, float | None] | None = None
) -> list[DatasetWarning]:
    """Return warnings about triangles that are not as the manifest says, or too faint to be located.

    Without a group's threshold, its faint triangles are not judged.
    """
    found = []
    for one in locations:
        group = dict(zip(dataset.experiment.group_by, one.group, strict=True))
        for code in one.arrangement.mismatches:
            what, remedy = (
                ("of the opposite polarity to that in the manifest", "correct the column polarity")
                if code == "polarity_mismatch"
                else (
                    f"not as the manifest says: {one.arrangement.words.format(are='are')}",
                    "mirror or turn the frames back, or correct the column orientation",
                )
            )
            message = f"the triangles that were located are {what}; {remedy}"
            found.append(DatasetWarning(code, group, message, found=1.0, expected=0.0))
        threshold = (thresholds or {}).get(one.group)
        if threshold is not None and one.n_trials and not threshold >= (one.sure_level or math.inf):
            message = (
                f"triangles at the threshold, {threshold:.3g}, are too faint for a position of their own, and the "
                f"positions scatter by {one.scatter_px:.2g} pixels: the observer looks beside them, and the "
                "threshold comes out high; fix the camera and record again, or give each frame its x_px and y_px"
            )
            found.append(DatasetWarning("position_scatter", group, message, one.scatter_px or 0.0, 0.0))
    return found
