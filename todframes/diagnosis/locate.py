"""Search for triangles whose position the manifest does not give: one position for a group, or one a trial."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, FrameError, SettingsError
from todframes.diagnosis.arrangement import ARRANGEMENTS, Arrangement
from todframes.diagnosis.matching import LEAST_SEARCHED_PX, SEARCHED, Matcher, MeanFrames, Place, TrialMatcher
from todframes.frames.contrast import skipped_frames
from todframes.frames.dataset import Dataset, DatasetWarning, Skipped
from todframes.frames.position import from_centroid, size_in_px, to_centroid
from todframes.frames.trials import Group, Trials, indices_by
from todframes.stimulus import Centre

Locate = Literal["group", "each"]


LEAST_PEAK = 6.0
"""Least height of a correlation peak above its surroundings, in their standard deviations."""


LEAST_PEAK_NEARBY = 4.0
"""The same for a trial whose triangle is near that of other trials."""


LEAST_SURE_TRIALS = 4
"""Least number of trials with a high peak from which the scatter of positions is estimated."""


MOST_STRONGEST = 24
"""Number of the strongest trials that are searched over whole frames, if they have no position in common."""


NEARBY = 4.0
"""Largest distance of a trial's position from that of the group along each axis, in standard deviations."""


LEAST_SCATTER_PX = 1.0
"""Least standard deviation of the positions that are searched, so that chance cannot shut the search out."""


FAINT_SCATTER_MRAD = 0.1
"""Scatter of the positions from which trials without a position of their own raise a threshold."""


class Location(NamedTuple):
    """The position found for a group's triangles, in pixels, and its standard error along either axis.

    The error is None if no triangle stands out and the manifest's positions stay.

    `arrangement` tells whether the triangles are as the manifest says. `n_located` of `n_trials` trials have a
    position of their own, whose standard deviation along either axis is `scatter_px`; all three are None if the
    group has one position. `moved_px` is the mean way from the manifest's positions, None if it has none.
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


def locate_triangles(
    dataset: Dataset,
    *,
    locate: Locate = "group",
    centre: Centre = "centroid",
    skip_bad_frames: bool = False,
    progress: Callable[[int], None] | None = None,
) -> tuple[Dataset, tuple[Location, ...]]:
    """Find the positions of triangles.

    Positions in the manifest are where the search begins: all of a group are moved by one displacement, or each
    by its own. They stay if no triangle stands out near them. Of other trials whole frames are searched.

    The position of a group comes from its mean frames by orientation. Their mean contains everything that the
    orientations share (bezel, overlay, shading, fixed pattern) and is subtracted. The remainder is correlated with
    the differences of the triangles, first on whole pixels, then between them with exact coverage and a fitted
    blur. Triangles that are mirrored, turned or of the opposite polarity are found too.

    The position of a single trial comes from its correlation with the mean triangle of all orientations, near the
    group's position. So it does not depend on the orientation, and cannot make a right answer more probable. It
    is drawn towards the group's position by as much as its error exceeds the scatter of all trials. A trial whose
    triangle is too faint has the group's position.

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
        Called with the number of trials done since the last call: once for each trial, twice with "each".

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
    if locate not in get_args(Locate):
        raise SettingsError(f"locate: found {locate!r}, expected {' or '.join(get_args(Locate))}")
    advance = progress or (lambda _: None)
    trials = dataset.trials
    position_px, is_kept = trials.positions_px, np.ones(len(trials), bool)
    is_placed = np.isfinite(position_px[:, 0])
    locations: list[Location] = []
    skipped: list[Skipped] = []
    for members in indices_by(2 * trials.group_codes.astype(np.int64) + is_placed):
        of_group = trials.select(members)
        frames = MeanFrames(dataset, _reach_px(dataset, of_group) if is_placed[members[0]] else None)
        is_usable = np.ones(len(members), bool)
        for k, trial in enumerate(of_group):
            try:
                frames.add(trial)
            except FrameError as error:
                if not skip_bad_frames:
                    raise
                is_usable[k] = False
                skipped += skipped_frames(dataset, trial, error)
            advance(1)
        is_bad = members[~is_usable]
        members, usable = members[is_usable], of_group.select(is_usable)
        is_kept[is_bad] = False
        try:
            if usable:
                search = _each if locate == "each" else _common
                group = usable[0].group
                if is_placed[members[0]]:
                    found, position_px[members] = _from_stated(search, dataset, group, frames, usable, advance)
                else:
                    found, places_px = search(dataset, group, frames, usable, centre, advance)
                    position_px[members] = _centroids(usable, places_px, centre, dataset.display.pitch_mrad)
                locations.append(found)
        except DataError as error:
            if not skip_bad_frames:
                raise
            is_kept[members] = False
            for trial in usable:
                skipped += skipped_frames(dataset, trial, str(error))
    placed = trials.placed(position_px).select(is_kept)
    return replace(dataset, trials=placed, bad_rows=(*dataset.bad_rows, *skipped)), tuple(locations)


Located = tuple[Location, FloatArray]
"""A group's location, and the position (x, y) of each of its trials in pixels, shape (n, 2)."""


PLACED_REACH = 4.0
"""Distance from the manifest's position that is searched, in sizes."""


def _reach_px(dataset: Dataset, trials: Trials) -> int:
    """Return the distance from the manifest's positions that is searched, in pixels, within the first frame."""
    first = trials[0]
    assert first.x_px is not None and first.y_px is not None
    size_px = max(size_in_px(trial, dataset.display.pitch_mrad) for trial in trials)
    with dataset.open(first.frames[0]) as file:
        (top, bottom), (left, right) = file.clip(None, None)
    within = min(first.y_px - top, bottom - 1 - first.y_px, first.x_px - left, right - 1 - first.x_px)
    return math.ceil(min(PLACED_REACH * size_px + LEAST_SEARCHED_PX, max(within, size_px)))


def _from_stated(
    search: Callable[..., Located],
    dataset: Dataset,
    group: Group,
    frames: MeanFrames,
    trials: Trials,
    advance: Callable[[int], None],
) -> Located:
    """Find the ways of triangles from the manifest's positions; none if no triangle stands out near them."""
    assert frames.reach_px is not None
    stated_px = trials.positions_px
    try:
        found, places_px = search(dataset, group, frames, trials, "centroid", advance)
    except DataError:
        x_px, y_px = stated_px.mean(axis=0).tolist()
        return Location(group, x_px, y_px, None, moved_px=(0.0, 0.0)), stated_px
    if found.n_located is None:  # one way for all, from positions that lie on whole pixels and beside them
        moved = places_px - frames.reach_px - (stated_px - np.rint(stated_px)).mean(axis=0)
    else:
        moved = places_px - frames.reach_px + np.rint(stated_px) - stated_px
    x_px, y_px = (stated_px + moved).mean(axis=0).tolist()
    of_all = tuple(moved.mean(axis=0).tolist())
    return found._replace(x_px=x_px, y_px=y_px, moved_px=of_all), stated_px + moved


def _centroids(trials: Trials, places_px: FloatArray, centre: Centre, pitch_mrad: float) -> FloatArray:
    """Return the centroids of triangles whose `centre` lies at these places, all in pixels, shape (n, 2)."""
    centroids = (
        to_centroid(trial, x, y, centre, pitch_mrad) for trial, (x, y) in zip(trials, places_px, strict=True)
    )
    return np.fromiter(centroids, np.dtype((np.float64, 2)), len(trials))


def _common(
    dataset: Dataset,
    group: Group,
    frames: MeanFrames,
    trials: Trials,
    centre: Centre,
    _: Callable[[int], None],
) -> Located:
    """Find the position that a group's trials have in common."""
    found = _group_place(dataset, group, frames, centre)[0]
    return found, np.tile([found.x_px, found.y_px], (len(trials), 1))


def _group_place(dataset: Dataset, group: Group, frames: MeanFrames, centre: Centre) -> tuple[Location, float]:
    """Find the position that a group's trials have in common, and the blur in blocks of pixels."""
    block_px = frames.block_px
    matcher = Matcher(frames.take_means(), block_px * dataset.display.pitch_mrad, centre)
    found = matcher.search()
    if found.height == -math.inf:
        size = f"frames of {matcher.shape[1] * block_px} × {matcher.shape[0] * block_px} pixels"
        raise DataError(f"{dataset.path}: {size} are smaller than the triangle")
    if found.peak <= 0.0 or found.height < LEAST_PEAK * found.spread:
        raise DataError(
            f"{dataset.path}: no triangle stands out in the frames of {_group_name(dataset, group)}; "
            "expected x_px and y_px in the manifest"
        )
    fitted = matcher.refined_of_twins(found)
    x_px, y_px = _in_pixels(block_px, (fitted.x, fitted.y))
    standard_error_px = block_px * math.sqrt(float(fitted.covariance.diagonal().max()))
    return Location(group, x_px, y_px, standard_error_px, fitted.arrangement), fitted.blur


def _group_name(dataset: Dataset, group: Group) -> str:
    names = zip(dataset.experiment.group_by, group, strict=True)
    return ", ".join(f"{key} {value}" for key, value in names) or "the dataset"


def _in_pixels(block_px: int, place: tuple[float, float]) -> tuple[float, float]:
    """Return a position in pixels from one in blocks, which counts from the middle of the first block."""
    x_px, y_px = (float(block_px * at + (block_px - 1) / 2.0) for at in place)
    return x_px, y_px


def _each(
    dataset: Dataset,
    group: Group,
    frames: MeanFrames,
    trials: Trials,
    centre: Centre,
    advance: Callable[[int], None],
) -> Located:
    """Find a position for each trial of a group; trials whose triangle is too faint have the group's."""
    pitch_mrad = frames.block_px * dataset.display.pitch_mrad
    guess = _place_of_strongest(dataset, group, frames, trials)
    try:
        of_group, blur = _group_place(dataset, group, frames, centre)
    except DataError:
        if guess is None:
            raise
        of_group, blur = guess[0], 0.0
    reach = 0.0
    if guess is not None and guess[1] > SEARCHED * trials[0].stimulus.size_mrad / pitch_mrad:
        of_group, reach = guess  # the scatter is too large for a position in common
    block_px = frames.block_px
    middle = [(at - (block_px - 1) / 2.0) / block_px for at in (of_group.x_px, of_group.y_px)]
    matcher = TrialMatcher(pitch_mrad, blur, of_group.arrangement.sign)
    peaks = []
    for trial in trials:
        of_trial = matcher.peaks(frames.of_trial(trial), trial.stimulus, middle[0], middle[1], reach)
        dx, dy = from_centroid(trial, centre, pitch_mrad)
        peaks.append([one._replace(x=one.x + dx, y=one.y + dy) for one in of_trial])
        advance(1)
    mean, scatter, chosen = _scatter(peaks, np.array(middle))
    places_px = np.empty((len(trials), 2))
    for k, place in enumerate(chosen):
        at = mean
        if place is not None:
            share = scatter**2 / (scatter**2 + place.variance)
            at = mean + share * (np.array([place.x, place.y]) - mean)
        places_px[k] = _in_pixels(block_px, (float(at[0]), float(at[1])))
    variances = [scatter**2 + place.variance for place in chosen if place is not None]
    if variances:
        x_px, y_px = _in_pixels(block_px, (float(mean[0]), float(mean[1])))
        error_px = block_px * math.sqrt(float(np.mean(variances)) / len(variances))
        of_group = of_group._replace(x_px=x_px, y_px=y_px, standard_error_px=error_px)
    found = of_group._replace(n_trials=len(trials), n_located=len(variances), scatter_px=block_px * scatter)
    return found, places_px


def _place_of_strongest(
    dataset: Dataset, group: Group, frames: MeanFrames, trials: Trials
) -> tuple[Location, float] | None:
    """Find the middle of the positions in the strongest trials, anywhere on the frames.

    Returns
    -------
    Location
        Location whose arrangement tells the sign only.
    reach : float
        Distance from it within which all positions are expected, in blocks of pixels.

    None if a triangle stands out in less than half of the strongest trials.
    """
    strongest = trials.select(np.argsort(-trials.levels, kind="stable")[:MOST_STRONGEST])
    block_px = frames.block_px
    common = sum(frames.totals.values()) / frames.counts.total()
    tops: dict[Arrangement, list[Place]] = {}
    for trial in strongest:
        image = frames.of_trial(trial) - common
        for arrangement in ARRANGEMENTS[:2]:
            matcher = TrialMatcher(block_px * dataset.display.pitch_mrad, 0.0, arrangement.sign)
            middle = [(n - 1) / 2.0 for n in image.shape]
            peaks = matcher.peaks(image, trial.stimulus, middle[1], middle[0], max(image.shape))
            tops.setdefault(arrangement, []).extend(peaks[:1])
    arrangement = max(tops, key=lambda one: float(np.median([top.height for top in tops[one]] or [0.0])))
    sure = np.array([(top.x, top.y) for top in tops[arrangement] if top.height >= LEAST_PEAK])
    if len(sure) < max(LEAST_SURE_TRIALS, len(strongest) / 2.0):
        return None
    middle = np.median(sure, axis=0)
    scatter = 1.4826 * float(np.median(np.abs(sure - middle)))
    x_px, y_px = _in_pixels(block_px, (float(middle[0]), float(middle[1])))
    error_px = block_px * 1.2533 * scatter / math.sqrt(len(sure))  # the median's, of Gaussian positions
    return Location(group, x_px, y_px, error_px, arrangement), NEARBY * scatter


def _scatter(peaks: Sequence[Sequence[Place]], middle: FloatArray) -> tuple[FloatArray, float, list[Place | None]]:
    """Estimate the mean and the scatter of the positions, and choose the peak of each trial.

    Parameters
    ----------
    peaks : sequence
        Peaks of each trial, the highest first.
    middle : ndarray, shape (2,)
        The group's position.

    Returns
    -------
    mean : ndarray, shape (2,)
        Mean position; `middle` if too few trials have a high peak.
    scatter : float
        Standard deviation of the positions along each axis, without the errors of measurement.
    chosen : list of Place or None
        The peak of each trial; None if its triangle is too faint.
    """
    sure = [of_trial[0] for of_trial in peaks if of_trial and of_trial[0].height >= LEAST_PEAK]
    if len(sure) < LEAST_SURE_TRIALS:
        return middle, 0.0, [None] * len(peaks)
    places = np.array([(one.x, one.y) for one in sure])
    mean = np.median(places, axis=0)
    scatter = 1.4826 * float(np.median(np.abs(places - mean)))
    chosen: list[Place | None] = []
    for _ in range(3):
        reach = max(scatter, LEAST_SCATTER_PX)
        chosen = [_chosen(of_trial, mean, reach) for of_trial in peaks]
        found = [one for one in chosen if one is not None]
        if len(found) < LEAST_SURE_TRIALS:
            return middle, 0.0, [None] * len(peaks)
        places = np.array([(one.x, one.y) for one in found])
        variance = np.array([one.variance for one in found])
        weight = 1.0 / (variance + scatter**2 + 1e-12)
        mean = weight @ places / weight.sum()
        # The errors' share of the squared distances is subtracted: method of moments.
        excess = np.square(places - mean).mean(axis=1) * len(found) / (len(found) - 1.0) - variance
        scatter = math.sqrt(max(float(weight @ excess / weight.sum()), 0.0))
    return mean, scatter, chosen


def _chosen(peaks: Sequence[Place], mean: FloatArray, scatter: float) -> Place | None:
    """Return the most probable of a trial's peaks for a mean and a scatter of positions; None if all are low."""
    possible = [
        one
        for one in peaks
        if one.height >= LEAST_PEAK_NEARBY
        and max(abs(one.x - mean[0]), abs(one.y - mean[1])) <= NEARBY * math.sqrt(scatter**2 + one.variance)
    ]

    def log_probability(one: Place) -> float:
        distance = (one.x - mean[0]) ** 2 + (one.y - mean[1]) ** 2
        return float(one.height**2 - distance / (scatter**2 + one.variance)) / 2.0

    return max(possible, key=log_probability, default=None)


def location_warnings(dataset: Dataset, locations: Sequence[Location]) -> list[DatasetWarning]:
    """Return warnings about triangles that were found but are not as the manifest says."""
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
        n_faint = (one.n_trials or 0) - (one.n_located or 0)
        if n_faint and one.scatter_px and one.scatter_px * dataset.display.pitch_mrad > FAINT_SCATTER_MRAD:
            message = (
                f"{n_faint} of {one.n_trials} trials are too faint for a position of their own, and the others "
                f"scatter by {one.scatter_px:.2g} pixels: the observer looks beside faint triangles, and the "
                "threshold comes out high; fix the camera and record again, or give each frame its x_px and y_px"
            )
            found.append(DatasetWarning("position_scatter", group, message, one.scatter_px, 0.0))
    return found
