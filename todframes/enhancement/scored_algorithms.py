"""Datasets scored after enhancement algorithms.

All algorithms get the same frames. The observer sees their results with the same displacement of the retina and
the same noise on its neurons. Before, the first frames show whether an algorithm gives the same pictures again,
and a spot that is added to frames shows where it comes out: networks that enlarge pictures often have another grid
than the display. That is no harm to a person, who looks where the triangle is, so the observer looks there, too.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import NamedTuple

import cv2
import numpy as np

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import DataError, SettingsError
from todframes.enhancement.algorithm import REFERENCE, Enhancement
from todframes.enhancement.contrast_gain import (
    Responses,
    contrast_gains,
    contrast_responses,
    measured_trials,
    triangle_contrasts,
)
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, DecodedFrame, TrialReader, check_warm_up_there
from todframes.enhancement.finding import find_enhancement, plain_value
from todframes.frames.contrast import centroid_position, check_places
from todframes.frames.dataset import Dataset, Skipped
from todframes.frames.trials import FrameReference, Group, Trial, Trials
from todframes.jobs.fingerprint import fingerprint
from todframes.jobs.run import Run
from todframes.observers.interface import Observer, Readout
from todframes.parameters import CurveName, Decisions, Gaze, PlanName
from todframes.psychometrics.fit import FitSettings
from todframes.scoring.score import ScoredDataset, check_seen, fit_groups, usable_trials
from todframes.scoring.trial_scores import (
    Scoring,
    TrialScore,
    TrialScores,
    score_trials,
    score_views,
    scoring_of,
    to_mean_place_px,
    trial_viewing,
)
from todframes.stimulus import ORIENTATIONS, Centre, coverage


class ScoredAlgorithm(NamedTuple):
    """An algorithm and the scores of all trials after it. `plain` are those of the frames as they are after a
    plain gain of contrast as large as the algorithm's, `gains` by group; None for the reference, if answers
    were drawn, or if the observer is not linear. `responses` are displayed contrasts before and after, and
    `measures` what is measured on the frames for all observers, by the names in `ComparedCondition`.
    """

    enhancement: Enhancement
    scored: ScoredDataset
    plain: ScoredDataset | None
    gains: Mapping[Group, float]
    responses: Responses
    measures: Json


def score_algorithms(
    dataset: Dataset,
    observers: Sequence[Observer],
    enhancements: Sequence[Enhancement],
    *,
    gazes: Sequence[Gaze] = (),
    decisions: Decisions = "expected",
    curve: CurveName = "observer",
    seed: int = 1,
    fit_settings: FitSettings,
    screen: AlgorithmDisplay | None = None,
    plan: PlanName = "needed",
    skip_bad_frames: bool = False,
    run: Run | None = None,
) -> list[list[ScoredAlgorithm]]:
    """Show every trial to observers as it is and after each algorithm.

    Frames are decoded and enhanced once for all observers and gazes. For each gaze of each observer comes back a
    result for each algorithm, the reference first; its scores and fits are those of `score_dataset` with the same
    plan. A trial that is skipped is skipped for all. Errors are those of `score_dataset`.
    """
    algorithms = _with_reference(enhancements, observers)
    screen = screen or AlgorithmDisplay(dataset.display)
    whole, skipped = _usable_trials(dataset, algorithms, observers[0].centre, skip_bad_frames=skip_bad_frames)
    gazes, expected = tuple(gazes) or (dataset.gaze,), decisions == "expected"
    # Before all others: the first frame may be special.
    repeated = RepeatedFrames(TrialReader(algorithms, screen), dataset, whole)
    run = repeated.run(run or Run())
    moved = find_displacements(algorithms, screen, dataset, whole)
    algorithms = [
        replace(algorithm, displacement_px=own.px or (0.0, 0.0))
        for algorithm, own in zip(algorithms, moved, strict=True)
    ]
    reader = TrialReader(algorithms, screen)
    if len(gazes) > 1:  # a fixed gaze follows from frames read for a tracked one
        dataset = replace(dataset, gaze="tracked")
    scorings = [
        scoring_of(dataset, observer, plan=plan, decisions=decisions, seed=seed)
        for observer in observers
        for _ in gazes
    ]
    measured_numbers = measured_trials(whole)
    seen = [[TrialScores(whole) for _ in algorithms] for _ in scorings]
    contrasts = np.full((len(gazes), len(whole), len(algorithms), len(ORIENTATIONS)), np.nan)
    measured, is_seen = list[FloatArray](), np.zeros(len(whole), bool)

    def collect(row: int, trial: _TrialScores) -> None:
        for scores, of_trial in zip(chain(*seen), chain(*trial.seen), strict=True):
            scores.put(row, of_trial)
        measured.append(trial.measured)
        contrasts[:, row], is_seen[row] = trial.contrasts, True

    skipped += score_trials(
        scorings[0],
        whole,
        partial(_show, reader, measured_numbers, gazes, scorings),
        kind=_TrialScores,
        collect=collect,
        skip_bad_frames=skip_bad_frames,
        run=run,
        depends_on=(
            parts_of(algorithms),
            screen,
            sorted(measured_numbers),
            gazes,
            [scoring.observer for scoring in scorings],
            repeated.fingerprint,
        ),
    )
    repeated.finish(run)
    check_seen(dataset, measured, skipped)
    described = _described(algorithms, moved, np.concatenate(measured, axis=1), screen)
    for measures, algorithm in zip(described, algorithms, strict=True):
        measures["repeat_difference"] = repeated.differences[str(algorithm.spec)]
    results = []
    for number, scoring in enumerate(scorings):
        fit = partial(fit_groups, scoring, fit_settings=fit_settings, curve=curve)
        of_scoring = [scores.usable() for scores in seen[number]]
        scored = [replace(fit(scores), skipped=tuple(skipped)) for scores in of_scoring]
        responses = contrast_responses(of_scoring[0].trials, contrasts[number % len(gazes), is_seen])
        gains = contrast_gains(responses)
        is_linear = expected and not np.isnan(of_scoring[0]["deviations"]).any()
        once = replace(fit_settings, resamples=0)
        plain: list[ScoredDataset | None] = [None] * len(algorithms)
        for index, of_gain in enumerate(gains[1:] if is_linear else (), 1):
            trials = of_scoring[0].trials  # groups whose gain is not known stay as they are
            of_groups = np.array([of_gain.get(group, 1.0) for group in trials.groups])
            plain[index] = fit(of_scoring[0].amplified(of_groups[trials.group_codes]), fit_settings=once)
        results.append(list(map(ScoredAlgorithm, algorithms, scored, plain, gains, responses, described)))
    return results


def _with_reference(enhancements: Sequence[Enhancement], observers: Sequence[Observer]) -> list[Enhancement]:
    """Return all algorithms, the reference first; SettingsError for one twice, or observers of several centres."""
    if len({observer.centre for observer in observers}) > 1:
        centres = ", ".join(observer.centre for observer in observers)
        raise SettingsError(f"centre: found {centres} of several observers, expected the same of all")
    algorithms = [find_enhancement(REFERENCE), *(each for each in enhancements if not each.is_reference)]
    spec, n_times = Counter(algorithm.spec for algorithm in algorithms).most_common(1)[0]
    if n_times > 1:
        raise SettingsError(f"enhance {spec!r}: found twice, expected once")
    return algorithms


def _usable_trials(
    dataset: Dataset, algorithms: Sequence[Enhancement], centre: Centre, *, skip_bad_frames: bool
) -> tuple[Trials, list[Skipped]]:
    """Return the trials with the frames that algorithms need before them, and the bad rows that are skipped."""
    trials, skipped = usable_trials(dataset, skip_bad_frames=skip_bad_frames)
    if of_clips := [algorithm for algorithm in algorithms if algorithm.declaration.clip]:
        trials = trials.with_warm_up(max(algorithm.warm_up_frames for algorithm in of_clips))
    if not skip_bad_frames:
        for trial in trials if of_clips else ():
            check_warm_up_there(dataset, trial, of_clips)
        check_places(dataset, trials, centre)
    return trials, skipped


def parts_of(algorithms: Sequence[Enhancement]) -> list[object]:
    """Return what scores depend on of the algorithms.

    Values are not always in the text: those of a file beside a network, or of a `functools.partial`, are not.
    """
    return [
        (algorithm.spec, algorithm.function, dict(algorithm.values), algorithm.displacement_px)
        for algorithm in algorithms
    ]


def _described(
    algorithms: Sequence[Enhancement],
    moved: Sequence[Displacement],
    measured: FloatArray,
    screen: AlgorithmDisplay,
) -> list[Json]:
    """Return what is the same for all observers, by the names in `ComparedCondition`: measured over all frames.

    `measured`, (algorithm, frame, `MEASUREMENTS`), may have its frames in any order: `math.fsum` rounds once.
    """
    names = [algorithm.name for algorithm in algorithms]
    records: list[Json] = []
    for algorithm, displacement, of_frames in zip(algorithms, moved, measured, strict=True):
        errors, ssims, edges, clipped, cpu_s = (column[~np.isnan(column)] for column in of_frames.T)
        error, ssim, cpu_mean_s = (
            math.fsum(column) / len(column) if len(column) else None for column in (errors, ssims, cpu_s)
        )
        psnr = 10.0 * math.log10(screen.data_range_cd_m2**2 / error) if error else None
        psnr_before, ssim_before = (records[0]["psnr_db"], records[0]["ssim"]) if records else (psnr, ssim)
        record = {
            "name": algorithm.name if names.count(algorithm.name) == 1 else algorithm.spec,
            "spec": algorithm.spec,
            "what": algorithm.what,
            "library": algorithm.declaration.library,
            "domain": algorithm.declaration.domain,
            "parameters": {name: plain_value(value) for name, value in algorithm.values.items()},
            "magnification": algorithm.magnification,
            "displacement_px": displacement.px,
            "displacement_scatter_px": displacement.scatter_px,
            "psnr_db": psnr,
            "psnr_change_db": None if psnr is None or psnr_before is None else psnr - psnr_before,
            "ssim": ssim,
            "ssim_change": None if ssim is None or ssim_before is None else ssim - ssim_before,
            "edge_factor": float(np.median(edges)),
            "n_clipped": int(clipped.sum()),
            "cpu_s": round(math.fsum(cpu_s), 4),
            "cpu_ms_per_frame": round(1e3 * (cpu_mean_s or 0.0), 3),
        }
        records.append(record)
    return records


class _TrialScores(NamedTuple):
    """The scores of a trial in each scoring after each algorithm, and the measurements of its frames, as
    `TrialReader.read` returns them. `contrasts`, (gaze, algorithm, 4), are those of `triangle_contrasts`; NaN if
    they are not measured in this trial.
    """

    seen: tuple[tuple[TrialScore, ...], ...]
    measured: FloatArray
    contrasts: FloatArray


def _show(
    reader: TrialReader,
    measured_numbers: frozenset[int],
    gazes: Sequence[Gaze],
    scorings: Sequence[Scoring],
    scoring: Scoring,
    trial: Trial,
    readout: Readout | None,
) -> _TrialScores:
    """Show a trial to the observers after each algorithm. Scorings are in the order of `compare_observers`: each
    observer with all gazes, then the next one; `scoring` is the first.
    """
    readouts = [readout, *(further.readout(trial.stimulus) for further in scorings[1:])]
    viewings = [trial_viewing(own, trial, its) for own, its in zip(scorings, readouts, strict=True)]
    # The frames are read once, as wide as the widest of the grids needs at any displacement and gaze.
    widest = max(viewings, key=lambda viewing: viewing.grid.width_mrad)
    pitch_mrad, widest_mrad = scoring.dataset.display.pitch_mrad, widest.grid.pitch_mrad
    displaced = [view.displacement_samples * (view.grid.pitch_mrad / widest_mrad) for view in viewings]
    if len(gazes) > 1:
        to_gazes_px = np.concatenate([[(0.0, 0.0)], to_mean_place_px(trial)])
        to_gazes = to_gazes_px * (pitch_mrad / widest_mrad)
        displaced = [(samples[:, None] + to_gazes).reshape(-1, 2) for samples in displaced]
    whole, at = scoring.plan == "full", np.concatenate(displaced)
    shown, measured = reader.read(scoring.dataset, trial, widest.observer, widest.grid, at, whole=whole)
    by_gaze = [
        shown if gaze == scoring.dataset.gaze else [each.with_gaze_fixed(trial, pitch_mrad) for each in shown]
        for gaze in gazes
    ]
    seen = tuple(
        tuple(score_views(own, trial, viewing, by_gaze[number % len(by_gaze)]))
        for number, (own, viewing) in enumerate(zip(scorings, viewings, strict=True))
    )
    contrasts = np.full((len(by_gaze), len(shown), len(ORIENTATIONS)), np.nan)
    if trial.number in measured_numbers:
        grid, centre = viewings[0].grid, viewings[0].observer.centre
        for number, of_gaze in enumerate(by_gaze):
            contrasts[number] = triangle_contrasts(of_gaze, trial, grid=grid, centre=centre)
    return _TrialScores(seen, measured, contrasts)


SAME_PICTURE = 1e-3
"""Largest difference of two pictures, in units of their mean luminance, that counts as none: rounding of 16-bit
numbers, and less contrast than a triangle needs to be seen."""


class RepeatedFrames:
    """The first two trials of a dataset, shown after each algorithm several times during a comparison.

    The second time they are shown in reverse, so that an algorithm that remembers frames gives other pictures.
    `fingerprint` is a hash of the first pictures, another for other weights that a function reads from a file.
    `differences` are the largest so far from the first pictures of each algorithm, in units of their mean
    luminance; 0 up to `SAME_PICTURE`.
    """

    def __init__(self, reader: TrialReader, dataset: Dataset, trials: Trials) -> None:
        self._reader, self._dataset = reader, dataset
        self._trials = [trials[number] for number in range(min(len(trials), 2))]
        self._first = self._pictures(self._trials)
        self.fingerprint = fingerprint(self._first)
        self.differences = {one.spec: 0.0 for one in reader.algorithms}
        self._compare(reversed(self._trials))

    def run(self, run: Run) -> Run:
        """Return the run, without its store if results could not be taken from there."""
        return replace(run, store=None) if any(self.differences.values()) else run

    def finish(self, run: Run) -> None:
        """Show the trials again after all others, and remove kept results if the pictures are others."""
        self._compare(self._trials)
        if any(self.differences.values()) and run.store is not None:
            run.store.forget()

    def _pictures(self, trials: Iterable[Trial]) -> dict[tuple[str, int], list[FloatArray]]:
        found = {}
        for trial in trials:
            with suppress(DataError):  # the comparison itself reports what cannot be used
                for spec, pictures in self._reader.pictures(self._dataset, trial):
                    n_px = math.prod(pictures[0].values.shape[:2])
                    spread = slice(None, None, math.ceil(math.sqrt(n_px / 2**18)))
                    found[spec, trial.number] = [picture.luminance(spread, spread) for picture in pictures]
        return found

    def _compare(self, trials: Iterable[Trial]) -> None:
        for key, pictures in self._pictures(trials).items():
            for picture, first in zip(pictures, self._first.get(key, ()), strict=False):
                difference = float(np.abs(picture - first).max()) / max(float(first.mean()), 1e-12)
                if difference > max(SAME_PICTURE, self.differences[key[0]]):
                    self.differences[key[0]] = difference


MOST_TRIALS = 8
"""Number of trials in which the displacement is measured: evenly spread."""

LEAST_PX, LEAST_ERRORS = 0.1, 5.0
"""Displacements along an axis up to these numbers of pixels, and of standard errors, are none: 0.1 pixels raise
the threshold of a triangle of 4 pixels by 3 %, and filters that follow a scene move the spot by up to 0.08."""

LEAST_LIKENESS, SURE_LIKENESS = 0.8, 0.95
"""Correlations with the spot from which a trial shows the displacement, and how it differs from others: what an
algorithm does far from the spot, as CLAHE in its tiles, is none."""

SPOT_CONTRAST, SPOT_NOISES, SPOT_PX = 0.25, 4.0, 4.0
"""The spot differs from what is behind it by this share of it, and so many standard deviations of the noise; its
size in the coarsest picture."""


class Displacement(NamedTuple):
    """The displacement of an algorithm's pictures to the right and down, in pixels of the frame, and its standard
    deviation over trials along an axis; None where the pictures do not show it.
    """

    px: tuple[float, float] | None
    scatter_px: float | None


def find_displacements(
    algorithms: Sequence[Enhancement], screen: AlgorithmDisplay, dataset: Dataset, trials: Trials
) -> list[Displacement]:
    """Find one displacement for all frames of each algorithm, of which the first is the reference. It is measured
    in trials of the lowest levels; those that cannot be used are left out.
    """
    found: dict[str, list[tuple[float, float, float]]] = {algorithm.spec: [] for algorithm in algorithms}
    screen = replace(screen, allow_clipping=True)
    plain = TrialReader(algorithms, screen)
    size_px = SPOT_PX / min(algorithm.magnification for algorithm in algorithms)
    faint = np.sort(np.argsort(trials.levels, kind="stable")[: max(len(trials) // 4, MOST_TRIALS)])
    for row in faint[np.unique(np.linspace(0, len(faint) - 1, MOST_TRIALS).round().astype(np.intp))].tolist():
        trial = trials[row]
        with suppress(DataError):  # the comparison itself reports what cannot be used
            before = {spec: pictures[-1].luminance() for spec, pictures in plain.pictures(dataset, trial)}
            reader = _SpotReader(algorithms, screen, trial, size_px)
            changes: dict[str, FloatArray] = {}
            for spec, (*_, picture) in reader.pictures(dataset, trial):
                m = picture.magnification
                rows, columns = (slice(round(m * start), round(m * stop)) for start, stop in reader.window)
                changes[spec] = (picture.luminance() - before[spec])[rows, columns]
                if changes[spec].any():
                    found[spec].append(_moved(changes[spec], changes[algorithms[0].spec], m))
    return [_displacement(np.array(found[algorithm.spec]).reshape(-1, 3)) for algorithm in algorithms]


def _displacement(moved: FloatArray) -> Displacement:
    """Return the displacement of an algorithm from those in single trials, x and y, with the spot's likeness."""
    shown, sure = (moved[moved[:, 2] >= least, :2] for least in (LEAST_LIKENESS, SURE_LIKENESS))
    n_needed = max(len(moved) / 2.0, 2.0)
    if len(shown) < n_needed:
        return Displacement(None, None)
    middle = np.median(shown, axis=0)
    # The standard error of a median of normal values, whose spread is robust, too.
    error = 1.2533 * 1.4826 * np.median(np.abs(shown - middle), axis=0) / math.sqrt(len(shown))
    x, y = np.where(np.abs(middle) > np.maximum(LEAST_PX, LEAST_ERRORS * error), middle, 0.0).tolist()
    return Displacement((x, y), float(sure.std(axis=0, ddof=1).max()) if len(sure) >= n_needed else None)


def _moved(change: FloatArray, seen: FloatArray, magnification: float) -> tuple[float, float, float]:
    """Return how far a change of a picture lies to the right of that of the frame, and below it, in pixels of the
    frame, and their correlation. It is the shift with the largest correlation.
    """
    from skimage.registration import phase_cross_correlation

    # What is interpolated, or averaged, lies where it was.
    kind = cv2.INTER_AREA if magnification < 1.0 else cv2.INTER_LINEAR
    there = cv2.resize(seen, change.shape[::-1], interpolation=kind)
    (y, x), rms, _ = phase_cross_correlation(there, change, normalization=None, upsample_factor=100)
    return -float(x) / magnification, -float(y) / magnification, math.sqrt(max(1.0 - float(rms) ** 2, 0.0))


class _SpotReader(TrialReader):
    """Reader of a trial with the same spot in all of its frames, where the triangle is in the mean. `window` has
    the rows and columns about it.
    """

    window: Sequence[tuple[int, int]]

    def __init__(
        self, algorithms: Sequence[Enhancement], screen: AlgorithmDisplay, trial: Trial, size_px: float
    ) -> None:
        super().__init__(algorithms, screen)
        self._trial, self._size_px = trial, size_px

    def decoded(self, dataset: Dataset, frame: FrameReference) -> DecodedFrame:
        """Return a frame with the spot, brighter or darker than what is behind it: where there is more room."""
        decoded, pitch_mrad, size_px = super().decoded(dataset, frame), dataset.display.pitch_mrad, self._size_px
        header, values = decoded.header, decoded.original.values.copy()
        along = centroid_position(self._trial, header, "centroid", pitch_mrad)
        x, y = (at - first for at, first in zip(along, (header.first_column, header.first_row), strict=True))
        reach = math.ceil(3.0 * size_px) + 8
        self.window = (top, bottom), (left, right) = [
            (max(round(at) - reach, 0), min(round(at) + reach + 1, side))
            for at, side in zip((y, x), values.shape, strict=False)
        ]
        near = values[top:bottom, left:right]
        behind = float(np.median(near))
        noise = 1.4826 * float(np.median(np.abs(near - behind)))
        low, high = self.screen.code_range
        amount = math.copysign(SPOT_CONTRAST * abs(behind) + SPOT_NOISES * noise, low + high - 2.0 * behind)
        ends = min(low, float(values.min())), max(high, float(values.max()))
        place: Json = {"size_px": size_px, "x_px": x - left, "y_px": y - top}
        each = [coverage(near.shape[:2], orientation=turned, **place) for turned in ORIENTATIONS]
        near += (amount * np.mean(each, axis=0)[..., None]).astype(values.dtype)
        decoded.original = replace(decoded.original, values=np.clip(values, *ends))
        return decoded
