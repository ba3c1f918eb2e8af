"""Datasets scored after enhancement algorithms.

All algorithms get the same frames. The observer sees their results with the same displacement of the retina and
the same noise on its neurons.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import SettingsError
from todframes.enhancement.algorithm import REFERENCE, Enhancement
from todframes.enhancement.contrast_gain import (
    Responses,
    contrast_gains,
    contrast_responses,
    measured_trials,
    triangle_contrasts,
)
from todframes.enhancement.displacement import Displacement, find_displacements
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, TrialReader, check_warm_up_there
from todframes.enhancement.finding import find_enhancement, plain_value
from todframes.enhancement.repeatability import RepeatedFrames
from todframes.frames.contrast import check_places
from todframes.frames.dataset import Dataset, Skipped
from todframes.frames.trials import Group, Trial, Trials
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
from todframes.stimulus import ORIENTATIONS, Centre


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
    """Return the trials with the frames that algorithms need before them, and the bad rows that are skipped.

    Raises FrameError for frames or places that are missing, unless these are skipped.
    """
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
