"""Search for triangles: one position for a group, or one for each trial of a shaken recording.

The likelihood of a single place is the mean over the four orientations, so that no place favours the stated one.
Peaks of its logarithm are weighed with a normal distribution about the mean place, which is estimated from the
clear trials (empirical Bayes). A trial that shows nothing has the mean place.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import ComplexArray, FloatArray
from todframes.base.errors import DataError, FrameError
from todframes.base.reading import convert
from todframes.diagnosis.inspection import (
    LEAST_SIGNAL,
    GroupTriangle,
    alike,
    is_contrast,
    noise_of_frames,
    strengths,
)
from todframes.diagnosis.triangle import ARRANGEMENTS, Arrangement, Shape, Square, multiplicity, render
from todframes.diagnosis.whole_frames import MeanFrames, search
from todframes.diagnosis.windows import TrialSample, measure_trial
from todframes.frames.contrast import from_centroid, size_in_px, skipped_frames, to_centroid
from todframes.frames.dataset import Dataset, DatasetWarning, Skipped
from todframes.frames.trials import Group, Trial, Trials, indices_by
from todframes.parameters import Locate, Progress
from todframes.stimulus import Centre

MOST_ERROR_MRAD = 0.09
"""Standard error of single positions along an axis from which they raise a threshold by more than 3 %: between
0.1 and 0.15 of noise in docs/evidence/validation.md."""


class Location(NamedTuple):
    """The position found for a group's triangles, in pixels, and its standard error along either axis, None if no
    triangle stands out and the manifest's positions stay. `n_located` of `n_trials` trials have a position of
    their own, whose standard deviation along either axis is `scatter_px`; all three are None if the group has one
    position. `moved_px` is the mean way from the manifest's positions, None if it has none. From `sure_level` on,
    single positions are known well enough not to raise a threshold; None: nowhere.
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


LeaveOut = Callable[[int, FrameError | str], None]
"""Leave out the trial at an index because of an error, or raise it."""


def locate_triangles(
    dataset: Dataset,
    *,
    locate: Locate = "group",
    centre: Centre = "centroid",
    skip_bad_frames: bool = False,
    progress: Progress | None = None,
) -> tuple[Dataset, tuple[Location, ...]]:
    """Return the dataset with the positions of triangles as found, without skipped trials, and the locations: one
    for each group, two if only a part of its trials has positions in the manifest.

    The search begins at these: all of a group are moved by one displacement, or each by its own. They stay if no
    triangle stands out near them. Of other trials whole frames are searched; `centre` is the point that all
    orientations have in common. There, the mean over the
    orientations is subtracted from that of each: what these share (bezel, overlay, shading, fixed pattern) is
    gone. A single position does not depend on the stated orientation, and cannot make a right answer more
    probable.

    If bad frames are skipped, trials that cannot be read and groups in which no triangle stands out are listed in
    `bad_rows`. `progress` is called with the number of trials done, and of all; with "each" again for each. Raises
    DataError if no triangle stands out where the manifest has no position, or frames of a group differ in size,
    and FrameError if one cannot be read.
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
        has_positions = bool(is_placed[members[0]])
        try:
            if has_positions:
                start = _Start(members, position_px[members])
            else:
                start = _begun(dataset, members, locate, centre, leave_out, advance)
            if not len(start.members):
                continue
            ours = trials.select(start.members)
            parts, of_size = [], list(alike(ours))
            for rows in of_size:
                alike_trials = ours.select(rows).placed(start.position_px[rows])
                search_of_size = _Search(dataset, alike_trials, start.reach_px)
                parts.append(
                    search_of_size.of_each(start.members[rows], leave_out, advance)
                    if locate == "each"
                    else search_of_size.of_all()
                )
            if not has_positions and all(part.error_px is None for part in parts):
                raise _nothing_stands_out(dataset, ours[0].group)
            location, moved_px = _location(ours, parts, start, centre, dataset.display.pitch_mrad, has_positions)
            locations.append(location)
            for rows, part in zip(of_size, parts, strict=True):
                moves_px = moved_px if locate == "group" else part.moves_px
                position_px[start.members[rows]] = start.position_px[rows] + moves_px
        except FrameError:
            raise
        except DataError as error:
            for k in members[is_kept[members]].tolist():
                leave_out(k, str(error))
    placed = trials.placed(position_px).select(is_kept)
    return replace(dataset, trials=placed, bad_rows=(*dataset.bad_rows, *skipped)), tuple(locations)


class _Start(NamedTuple):
    """The trials of a group that can be read and the approximate centroids of their triangles, in pixels. Single
    positions are expected within `reach_px`, 0 if that is not known.
    """

    members: NDArray[np.intp]
    position_px: FloatArray
    reach_px: float = 0.0


def _begun(
    dataset: Dataset,
    members: NDArray[np.intp],
    locate: Locate,
    centre: Centre,
    leave_out: LeaveOut,
    advance: Callable[[int], None],
) -> _Start:
    """Find the approximate position of a group's triangles, anywhere on the frames."""
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
        return _Start(members, np.zeros((0, 2)))
    pitch_mrad = dataset.display.pitch_mrad
    if locate == "each" and (strongest := _of_strongest(frames, usable, pitch_mrad)) is not None:
        middle_px, scatter_px = strongest
        return _Start(members, np.tile(middle_px, (len(members), 1)), 4.0 * scatter_px)
    peak = search(frames, centre)
    if peak.height == -math.inf:
        rows, columns = frames.shape or (0, 0)
        size = f"frames of {columns} × {rows} pixels"
        raise DataError(f"{dataset.path}: {size} are smaller than the triangle")
    if not peak.height > 6.0 * peak.spread:
        raise _nothing_stands_out(dataset, usable[0].group)
    x_px, y_px = frames.in_pixels((peak.x, peak.y))
    position_px = np.array([to_centroid(trial, x_px, y_px, centre, pitch_mrad) for trial in usable])
    return _Start(members, position_px)


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
    None if a triangle stands out in less than half of these 24.
    """
    strongest = trials.select(np.argsort(-trials.levels, kind="stable")[:24])
    common = frames.mean()
    n = max(common.shape)
    if max(size_in_px(trial, pitch_mrad) for trial in strongest) / frames.block_px > n / 2.0:
        return None

    def image_of(trial: Trial) -> tuple[FloatArray, float, float]:
        image = frames.of_trial(trial) - common
        image -= np.median(image)
        padded = np.zeros((n, n))
        padded[: image.shape[0], : image.shape[1]] = trial.stimulus.polarity * image
        noise = max(1.4826 * float(np.median(np.abs(image))), 1e-12)
        return padded, noise, size_in_px(trial, pitch_mrad) / frames.block_px

    peaks = strong_peaks(map(image_of, strongest), reach=n / 2.0 - 2.0)
    sure = np.array([peak.places[0] for peak in peaks if len(peak.height) and peak.height[0] >= CLEAR_LIKELIHOOD])
    if len(sure) < max(LEAST_CLEAR, len(strongest) / 2.0):
        return None
    middle = np.median(sure, axis=0)  # something else, such as text that changes, may be higher in some trials
    scatter = 1.4826 * float(np.median(np.abs(sure - middle)))
    x, y = (middle + (n - 1) / 2.0).tolist()
    return frames.in_pixels((x, y)), frames.block_px * scatter


class _Displacements(NamedTuple):
    """Displacements of trials from the start of their search, (trial, 2), and their mean, its error and scatter,
    in pixels. `error_px` is None if no triangle stands out; `is_own`, (trial,), marks those with a position of
    their own.
    """

    moves_px: FloatArray
    mean_px: FloatArray
    error_px: float | None
    arrangement: Arrangement
    is_own: NDArray[np.bool_] | None = None
    scatter_px: float = 0.0
    sure_level: float = math.inf


@dataclass(frozen=True, slots=True)
class _Search:
    """The search for the triangles of trials of similar sizes, from their approximate positions."""

    dataset: Dataset
    trials: Trials
    reach_px: float

    @property
    def size_px(self) -> float:
        """Median size in pixels."""
        pitch_mrad = self.dataset.display.pitch_mrad
        return min(float(np.median([trial.stimulus.size_mrad for trial in self.trials])) / pitch_mrad, 1e300)

    def _window(self, trial: Trial, reach_px: float) -> TrialSample:
        return measure_trial(self.dataset, trial, "centroid", size_px=self.size_px, reach_px=reach_px)

    def _windows(self, trials: Trials, reach_px: float = 0.0) -> list[TrialSample]:
        """Measure the 256 strongest trials; those that cannot be read are reported where all are read."""
        samples = []
        for trial in trials.select(np.sort(np.argsort(-trials.levels, kind="stable")[:256])):
            with suppress(DataError):
                samples.append(self._window(trial, reach_px))
        return samples

    def _fit(self, trials: Trials) -> GroupTriangle | None:
        """Fit the triangle of the strongest trials; None if it does not stand out."""
        samples = self._windows(trials)
        triangle = GroupTriangle.of(self.dataset, samples, self.size_px) if samples else None
        return None if triangle is None or triangle.signal < LEAST_SIGNAL else triangle

    def of_all(self) -> _Displacements:
        """Find the displacement that all trials have in common."""
        triangle = self._fit(self.trials)
        if triangle is None:
            return _Displacements(np.zeros((len(self.trials), 2)), np.zeros(2), None, ARRANGEMENTS[0])
        mean_px = triangle.block_px * triangle.offset
        moves_px = np.tile(mean_px, (len(self.trials), 1))
        error_px = triangle.block_px * float(triangle.error[1:3].max())
        return _Displacements(moves_px, mean_px, error_px, _arrangement(triangle))

    def _fit_strong(self, strong: Sequence[TrialSample], reach_px: float) -> GroupTriangle | None:
        """Fit the triangle of strong trials about their own positions, first found with a triangle as stated."""
        if not strong:
            return None
        block_px, size = strong[0].block_px, self.size_px / strong[0].block_px
        images = zip([sample.even for sample in strong], self._noise(strong, size).tolist(), strict=True)
        peaks = strong_peaks(((image, noise, size) for image, noise in images), reach=reach_px / block_px)
        chosen = chosen_places([peak.moved(sample.offset) for peak, sample in zip(peaks, strong, strict=True)])
        trials = Trials.of([sample.trial for sample in strong])
        if chosen is not None:
            trials = trials.placed(trials.positions_px + block_px * chosen.places)
            if chosen.is_own.any():
                trials = trials.select(chosen.is_own)
        return self._fit(trials)

    def of_each(
        self, members: NDArray[np.intp], leave_out: LeaveOut, advance: Callable[[int], None]
    ) -> _Displacements:
        """Find the displacement of each trial."""
        n_trials, levels = len(self.trials), self.trials.levels
        reach_px = max(2.5 * self.size_px + 8.0, self.reach_px)
        # Before the triangle is known, it is looked for in the trials of at least half of the highest level.
        strong = self._windows(self.trials.select(levels >= 0.5 * levels.max()), reach_px)
        triangle = self._fit_strong(strong, reach_px)
        if triangle is None:
            advance(n_trials)
            nowhere, is_own = np.zeros((n_trials, 2)), np.zeros(n_trials, bool)
            return _Displacements(nowhere, np.zeros(2), None, ARRANGEMENTS[0], is_own)
        shape, block_px, n = triangle.fit.shape, strong[0].block_px, len(strong[0].known)
        sign = strong[0].trial.stimulus.polarity * math.copysign(1.0, shape.amplitude)
        template = Template.of(shape, _isotropic(triangle.trials.spectrum, 2 * n), n)
        peaks, kept = [], []
        for k, (member, trial) in enumerate(zip(members.tolist(), self.trials, strict=True)):
            try:
                sample = self._window(trial, reach_px)
            except FrameError as error:
                leave_out(member, error)
            else:
                (noise,) = self._noise([sample], self.size_px / block_px)
                contrast = None
                if is_contrast(self.dataset):
                    contrast = abs(shape.amplitude) * float(strengths(self.dataset, np.array(trial.level)))
                of_trial = template.peaks(
                    sign * sample.even, contrast=contrast, noise=noise, reach=reach_px / block_px
                )
                peaks.append(of_trial.moved(sample.offset))
                kept.append(k)
            advance(1)
        chosen = chosen_places(peaks)
        if chosen is None:
            return self.of_all()._replace(is_own=np.zeros(n_trials, bool))
        mean_px = block_px * chosen.mean
        moves_px, is_own = np.tile(mean_px, (n_trials, 1)), np.zeros(n_trials, bool)
        moves_px[kept], is_own[kept] = block_px * chosen.places, chosen.is_own
        scatter_px = block_px * chosen.scatter
        mean_square = scatter_px**2 + float(np.square(block_px * chosen.error[chosen.is_own]).mean())
        return _Displacements(
            moves_px,
            mean_px,
            math.sqrt(mean_square / int(chosen.is_own.sum())),
            _arrangement(triangle),
            is_own,
            scatter_px,
            _sure_level(levels[kept], block_px * self.dataset.display.pitch_mrad * chosen.error),
        )

    def _noise(self, samples: Sequence[TrialSample], size: float) -> FloatArray:
        known = np.logical_and.reduce([sample.known for sample in samples])
        level = strengths(self.dataset, np.array([sample.trial.level for sample in samples]))
        return noise_of_frames(np.array([sample.even for sample in samples]), level, known, size)


def _sure_level(levels: FloatArray, error_mrad: FloatArray) -> float:
    """Return the lowest level from which single positions are known well; infinite if there is none."""
    distinct = np.unique(levels)
    error = np.array([math.sqrt(float(np.square(error_mrad[levels == level]).mean())) for level in distinct])
    is_sure = np.logical_and.accumulate((error <= MOST_ERROR_MRAD)[::-1])[::-1]
    first = int(is_sure.argmax())
    if not is_sure.any() or first == 0:
        return float(distinct[0]) if is_sure.any() else math.inf
    # Errors are powers of the level, very nearly.
    ends = np.log(np.maximum(error[[first, first - 1]], 1e-9))
    share = (math.log(MOST_ERROR_MRAD) - ends[0]) / (ends[1] - ends[0])
    return float(distinct[first] * (distinct[first - 1] / distinct[first]) ** share)


def _arrangement(triangle: GroupTriangle) -> Arrangement:
    key = triangle.fit.shown, 1 if triangle.fit.shape.amplitude > 0.0 else -1
    return next(arrangement for arrangement in ARRANGEMENTS if (arrangement.shown, arrangement.sign) == key)


def _isotropic(spectrum: FloatArray, length: int) -> FloatArray:
    """Return a power spectrum on another grid, (length, length/2 + 1), the mean over all directions."""

    def distance(n: int) -> FloatArray:
        return np.asarray(np.hypot(np.fft.fftfreq(n)[:, None], np.fft.rfftfreq(n)))

    n_rings = 16
    ring = np.minimum((2.0 * n_rings * distance(len(spectrum))).astype(int), n_rings)
    weight = multiplicity(len(spectrum))
    total, weights = (np.bincount(ring.ravel(), values.ravel()) for values in (weight * spectrum, weight))
    power = total / np.maximum(weights, weight.min())  # a ring may be empty
    floor = 1e-3 * float(power.mean()) + 1e-12
    at = 2.0 * n_rings * distance(length) - 0.5
    return np.asarray(np.interp(at, np.arange(len(power)), np.maximum(power, floor)), np.float64)


def _location(
    trials: Trials,
    parts: Sequence[_Displacements],
    start: _Start,
    centre: Centre,
    pitch_mrad: float,
    has_positions: bool,
) -> tuple[Location, FloatArray]:
    """Return the location of a group from those of its sizes, and the mean displacement from the start, (2,)."""
    is_found = any(part.error_px is not None for part in parts)
    weight = np.array([0.0 if part.error_px is None else 1.0 / max(part.error_px, 1e-9) ** 2 for part in parts])
    moved_px = np.average([part.mean_px for part in parts], axis=0, weights=weight if is_found else None)
    middle_px = start.position_px.mean(axis=0) + moved_px
    if not has_positions:
        middle_px += np.mean([from_centroid(trial, centre, pitch_mrad) for trial in trials], axis=0)
    own = [part.is_own for part in parts if part.is_own is not None]
    sure_level = max(part.sure_level for part in parts)
    surest = parts[int(weight.argmax())]
    location = Location(
        trials[0].group,
        float(middle_px[0]),
        float(middle_px[1]),
        1.0 / math.sqrt(float(weight.sum())) if is_found else None,
        surest.arrangement,
        len(trials) if own else None,
        int(sum(is_own.sum() for is_own in own)) if own else None,
        math.sqrt(float(np.mean([part.scatter_px**2 for part in parts]))) if own else None,
        (float(moved_px[0]), float(moved_px[1])) if has_positions else None,
        None if math.isinf(sure_level) else sure_level,
    )
    return location, np.asarray(moved_px)


def location_warnings(
    dataset: Dataset, locations: Sequence[Location], thresholds: Mapping[Group, float | None]
) -> list[DatasetWarning]:
    """Return warnings about triangles at a group's threshold, if known, that are too faint to be located."""
    warnings = []
    for location in locations:
        group = dict(zip(dataset.experiment.group_by, location.group, strict=True))
        threshold = thresholds.get(location.group)
        if threshold is not None and location.n_trials and not threshold >= (location.sure_level or math.inf):
            message = (
                f"triangles at the threshold, {threshold:.3g}, are too faint for a position of their own, and the "
                f"positions scatter by {location.scatter_px:.2g} pixels: the observer looks beside them, and the "
                "threshold comes out high; fix the camera and record again, or give each frame its x_px and y_px"
            )
            warnings.append(DatasetWarning("position_scatter", group, message, location.scatter_px or 0.0, 0.0))
    return warnings


MOST_PEAKS = 12
"""Largest number of peaks of a trial that are kept."""

CLEAR_LIKELIHOOD, CLEAR_LEAD = 18.0, 5.0
"""Least log likelihood of a peak, that of six standard deviations, and its least lead over the next, for a trial
whose place is clear without the others."""

LEAST_CLEAR = 4
"""Least number of clear trials from which the scatter is estimated."""


class Template(NamedTuple):
    """A triangle in each orientation, divided by the noise's spectrum, for windows of n × n blocks. `spectra` has
    shape (4, length, length/2 + 1). `energy`, (4,), is the squared signal-to-noise ratio of a triangle of contrast
    1 in noise of unit variance.
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
        padded[:, : 2 * reach + 1, : 2 * reach + 1] = render(centred, square, n).images[:, part, part]
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
        from scipy.ndimage import maximum_filter

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
        return float(np.median([peak.height[0] if len(peak.height) else 0.0 for peak in peaks]))

    return max(of_sign.values(), key=typical_height)


class TrialPlaces(NamedTuple):
    """Places of trials, (trial, 2), with their standard errors along an axis, (trial,). `is_own` marks trials
    whose own frames show the place; the others have the `mean`, (2,). `scatter` is the standard deviation of the
    places along an axis.
    """

    places: FloatArray
    error: FloatArray
    is_own: NDArray[np.bool_]
    mean: FloatArray
    scatter: float


def chosen_places(peaks: list[Peaks]) -> TrialPlaces | None:
    """Choose the place of each trial from its peaks; None if too few trials are clear. Places are counted from the
    start of each trial's search.
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
    is_own = likely >= 0.5
    share = np.where(is_own, scatter**2 / both[each, best], 0.0)
    shrunk = mean + share[:, None] * (places[each, best] - mean)
    error = np.sqrt(np.where(is_own, share * variance[each, best], scatter**2))
    return TrialPlaces(shrunk, error, is_own, mean, scatter)


def _scatter(places: FloatArray, variance: FloatArray, middle: FloatArray) -> tuple[FloatArray, float]:
    """Return the mean of places, and their standard deviation along an axis beyond their errors, by moments."""
    weight = 1.0 / (variance + float(np.square(places - middle).mean()) + 1e-12)
    mean = weight @ places / weight.sum()
    excess = np.square(places - mean).mean(axis=1) * len(places) / (len(places) - 1.0) - variance
    return mean, math.sqrt(max(float(weight @ excess / weight.sum()), 1e-8))
