"""Comparison of algorithms on a dataset: thresholds after each, and their ratios to those without enhancement.

All algorithms get the same frames. The observer sees their results with the same displacement of the retina and
the same noise on its neurons.
"""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.enhancement.algorithm import REFERENCE, Enhancement
from todframes.enhancement.contrast_gain import (
    LevelContrast,
    contrast_gains,
    contrast_responses,
    measured_trials,
    strongest_levels,
    triangle_contrasts,
)
from todframes.enhancement.enhanced_frame import (
    AlgorithmDisplay,
    FrameMeasurements,
    TrialReader,
    check_warm_up_there,
)
from todframes.enhancement.finding import find_enhancement
from todframes.enhancement.image_quality import psnr_db
from todframes.enhancement.repeatability import RepeatedFrames
from todframes.frames.dataset import Dataset, Skipped
from todframes.frames.position import check_places
from todframes.frames.trials import Trial, Trials
from todframes.jobs.run import Run
from todframes.observers.interface import Observer, Readout
from todframes.parameters import CurveName, Decisions, Gaze, PlanName
from todframes.psychometrics.bootstrap import draw_backgrounds, sets_of_backgrounds
from todframes.psychometrics.fit import MAX_RESAMPLES, FitSettings
from todframes.psychometrics.paired_bootstrap import (
    RatioDraws,
    ThresholdRatio,
    holm,
    ratio_draws,
    threshold_ratio,
)
from todframes.scoring.plan import ScorePlan, plan_score
from todframes.scoring.retina_view import to_mean_place_px
from todframes.scoring.score import (
    ScoredDataset,
    check_seen,
    fit_groups,
    fitted_curve,
    settings_of_experiment,
    usable_trials,
)
from todframes.scoring.seen_trials import (
    RATIO_STREAMS,
    Scoring,
    SeenTrial,
    SeenTrials,
    see,
    trial_viewing,
)
from todframes.scoring.work import see_trials
from todframes.stimulus import ORIENTATIONS

Verdict = Literal["better", "worse", "no difference shown", "mixed"]

SIGNIFICANCE = 0.05
"""Corrected p-value below which a difference of thresholds is reported."""

RESAMPLES_PER_COMPARISON = 80
"""Resamples for each ratio: the smallest p-value, 2 / resamples, is half of 5 % even after Holm's correction."""


class BeyondGain(NamedTuple):
    """An algorithm's contrast gain, and its threshold over that of a plain gain of the same amount."""

    contrast_gain: float
    ratio: ThresholdRatio


class Compared(NamedTuple):
    """The threshold ratio of an algorithm to the reference and its verdict, in a group, or in all if it is None.

    `p_value_holm` is corrected for the number of ratios in the whole comparison; the verdict is based on it.
    `is_p_value_least` states whether the resamples allow no smaller one. `beyond_gain` is None if answers were
    drawn, or if the triangle's contrast is not positive before or after the algorithm.
    """

    group: tuple[float | str, ...] | None
    ratio: ThresholdRatio
    p_value_holm: float
    verdict: Verdict
    is_p_value_least: bool
    beyond_gain: BeyondGain | None


@dataclass(frozen=True, slots=True)
class AlgorithmResult:
    """The scores of an algorithm and their comparison with those of the reference.

    `compared` has one item for each group, in the order of `scored.fits`; for several groups `overall` is their
    geometric mean. Both are empty for the reference itself, and so is `responses`: for each group, the displayed
    contrast of the triangle level by level. `n_backgrounds` is the number of scenes that intervals and verdicts
    count as drawn from many; None if the dataset names none. `psnr_db` and `ssim` compare the displayed luminance
    with the frames without noise, over all frames that have one; None if there are none. `edge_factor` is the
    median of that of the frames. `repeat_difference` is the largest difference of pictures of the same frame, in
    units of their mean luminance, 0 if they are the same. `n_clipped` is the number of values beyond the display's
    range. `cpu_s` is the algorithm's own processor time over all frames in seconds, `cpu_s_per_frame` that of a
    frame, and `memory_mb` the most memory that it needed for one; None if it was not measured.
    """

    enhancement: Enhancement
    scored: ScoredDataset
    compared: tuple[Compared, ...]
    overall: Compared | None
    responses: tuple[tuple[LevelContrast, ...], ...]
    n_backgrounds: int | None
    psnr_db: float | None
    ssim: float | None
    edge_factor: float
    repeat_difference: float
    n_clipped: int
    cpu_s: float
    cpu_s_per_frame: float
    memory_mb: float | None


def compare_observers(
    dataset: Dataset,
    observers: Sequence[Observer],
    enhancements: Sequence[Enhancement],
    *,
    gazes: Sequence[Gaze] = (),
    decisions: Decisions = "expected",
    curve: CurveName | None = None,
    seed: int = 1,
    fit_settings: FitSettings | None = None,
    screen: AlgorithmDisplay | None = None,
    plan_name: PlanName = "needed",
    skip_bad_frames: bool = False,
    run: Run | None = None,
) -> tuple[tuple[AlgorithmResult, ...], ...]:
    """Show every trial to observers as it is and after each algorithm, and compare the thresholds of each.

    Frames are decoded and enhanced once for all observers and gazes. Parameters not listed are those of
    `score_dataset`. With the same plan, one observer and one gaze, the scores and fits of the reference are those
    of `score_dataset`, number for number.

    Parameters
    ----------
    observers : sequence of Observer
        Observers that look at the same point of the triangle.
    gazes : sequence of {"tracked", "fixed"}
        Gazes of each observer. Default: that of the dataset.
    enhancements : sequence of Enhancement
        Algorithms to compare. The reference, `none`, is the first in the result even if it is not among them.
    screen : AlgorithmDisplay, optional
        Default: the dataset's display with a white of 1, and no clipping.
    plan_name : {"needed", "full"}
        As in `score_dataset`. All algorithms have one plan, made from frames before and after enhancement.

    Returns
    -------
    tuple of tuples of AlgorithmResult
        For each gaze of each observer one for each algorithm, the reference first.

    Raises
    ------
    FrameError, DataError
        If a row or frame is bad, or an algorithm fails on a frame. If bad frames are skipped, the trial is skipped
        for all algorithms instead.
    SettingsError
        If an algorithm is given twice, there are no resamples, decisions are "expected" and the observer is not
        linear, or the observer's curve is asked for and decisions are not "expected"; or if observers look at
        different points.
    """
    if len({one.centre for one in observers}) > 1:
        found = ", ".join(one.centre for one in observers)
        raise SettingsError(f"centre: found {found} of several observers, expected the same of all")
    fit_settings = settings_of_experiment(fit_settings, dataset.experiment)
    curve = fitted_curve(curve, decisions)
    if not fit_settings.resamples:
        raise SettingsError("resamples: found 0, expected 40 or more: a comparison rests on them")
    algorithms = [find_enhancement(REFERENCE), *(one for one in enhancements if not one.is_reference)]
    for number, one in enumerate(algorithms):
        if one.spec in [other.spec for other in algorithms[:number]]:
            raise SettingsError(f"enhance {one.spec!r}: found twice, expected once")
    screen = screen or AlgorithmDisplay(dataset.display)
    whole, skipped = usable_trials(dataset, skip_bad_frames=skip_bad_frames)
    if of_clips := [one for one in algorithms if one.declaration.clip]:
        whole = whole.with_warm_up(max(one.warm_up_frames for one in of_clips))
    if not skip_bad_frames:
        for trial in whole if of_clips else ():
            check_warm_up_there(dataset, trial, of_clips)
        check_places(dataset, whole, observers[0].centre)
    reader, expected = TrialReader(algorithms, screen), decisions == "expected"
    gazes = tuple(gazes) or (dataset.gaze,)
    repeated = RepeatedFrames(reader, dataset, whole)  # before all others: the first frame may be special
    run = repeated.run(run or Run())
    # The plan considers frames after the algorithms too: what it leaves out is left out for all algorithms.
    plans = [
        plan_score(replace(dataset, gaze=gaze), whole, observer, name=plan_name, expected=expected, read=reader)
        for observer in observers
        for gaze in gazes
    ]
    if len(gazes) > 1:  # a fixed gaze follows from frames read for a tracked one
        dataset = replace(dataset, gaze="tracked")
    strongest = strongest_levels(whole)
    measured = measured_trials(whole, strongest)
    of_observer = [_ResultColumns(whole, len(algorithms)) for _ in plans]

    def collect(row: int, found: _SeenTrial) -> None:
        for number, (columns, seen) in enumerate(zip(of_observer, (found.seen, *found.others), strict=True)):
            columns.put(row, found, seen, found.contrasts[number % len(gazes)])

    skipped += see_trials(
        Scoring(dataset, plans[0], decisions, seed),
        whole,
        _Show(reader, measured, gazes, tuple(plans[1:])),
        kind=_SeenTrial,
        collect=collect,
        skip_bad_frames=skip_bad_frames,
        run=run,
        depends_on=(
            parts_of(algorithms),
            screen,
            sorted(measured),
            gazes,
            _parts(plans[1:]),
            repeated.fingerprint,
        ),
        with_references=True,
        with_levels=True,
    )
    repeated.finish(run)
    return tuple(
        _results(
            algorithms,
            check_seen(dataset, columns.seen(), skipped),
            columns,
            partial(fit_groups, plan, seed=seed, fit_settings=fit_settings, curve=curve, expected=expected),
            skipped=skipped,
            expected=expected,
            seed=seed,
            fit_settings=fit_settings,
            screen=screen,
            repeat_differences=repeated.differences,
        )
        for plan, columns in zip(plans, of_observer, strict=True)
    )


def parts_of(algorithms: Sequence[Enhancement]) -> list[object]:
    """Return what scores depend on of the algorithms.

    Values are not always in the text: those of a file beside a network, or of a `functools.partial`, are not.
    """
    return [(one.spec, one.function, dict(one.values)) for one in algorithms]


def _parts(plans: Sequence[ScorePlan]) -> list[object]:
    """Return what the scores of further observers and gazes depend on; nothing if there are none."""
    return [(plan.observer, plan.whole_frames, sorted(map(repr, plan.stimuli.items()))) for plan in plans]


def _results(
    algorithms: Sequence[Enhancement],
    seen: Sequence[SeenTrials],
    columns: _ResultColumns,
    fit: Callable[..., ScoredDataset],
    *,
    skipped: Sequence[Skipped],
    expected: bool,
    seed: int,
    fit_settings: FitSettings,
    screen: AlgorithmDisplay,
    repeat_differences: Mapping[str, float],
) -> tuple[AlgorithmResult, ...]:
    """Fit and compare the scores of one observer."""
    scored = [replace(fit(one), skipped=tuple(skipped)) for one in seen]
    contrasts = columns.contrasts[columns.is_seen]
    responses = contrast_responses(seen[0].trials, contrasts)
    gains = contrast_gains(responses)
    backgrounds = seen[0].trials.scene_numbers
    plain = [_amplified(fit, seen[0], of_algorithm, fit_settings) for of_algorithm in gains[1:] if expected]
    compared = _compared(scored, plain, gains, seed, fit_settings, backgrounds)
    black, white = screen.luminance_range
    results = []
    for k, (algorithm, own) in enumerate(zip(algorithms, compared, strict=True)):
        measured = columns.measured[k]
        results.append(
            AlgorithmResult(
                enhancement=algorithm,
                scored=scored[k],
                compared=tuple(one for one in own if one.group is not None),
                overall=next((one for one in own if one.group is None), None),
                responses=tuple(responses[k].get(fit.group, ()) for fit in scored[k].fits) if k else (),
                n_backgrounds=None if backgrounds is None else int(backgrounds.max()) + 1,
                psnr_db=psnr_db(_mean(measured.squared_errors), data_range=white - black),
                ssim=_mean(measured.ssims),
                edge_factor=float(np.median(measured.edge_factors)),
                repeat_difference=repeat_differences[algorithm.spec],
                n_clipped=measured.n_clipped,
                cpu_s=math.fsum(measured.cpu_s),
                cpu_s_per_frame=_mean(measured.cpu_s) or 0.0,
                memory_mb=max(measured.memory_mb, default=None),
            )
        )
    return tuple(results)


class _SeenTrial(NamedTuple):
    """The observer's scores of a trial after each algorithm, and the measurements of each of its frames.

    `contrasts`, (gaze, algorithm, 4), are those of `triangle_contrasts`; NaN if they are not measured in this
    trial. `others` are the scores of the first observer's further gazes, and those of further observers.
    """

    seen: tuple[SeenTrial, ...]
    measured: tuple[tuple[FrameMeasurements, ...], ...]
    contrasts: FloatArray
    others: tuple[tuple[SeenTrial, ...], ...] = ()


class _Show:
    """Function that shows a trial to the observer, and those of further plans, after each algorithm.

    Plans are in the order of `compare_observers`: each observer with all gazes, then the next one.
    """

    def __init__(
        self,
        reader: TrialReader,
        measured: frozenset[int],
        gazes: tuple[Gaze, ...],
        further: tuple[ScorePlan, ...],
    ) -> None:
        self.reader, self.measured, self.gazes, self.further = reader, measured, gazes, further
        self._readouts_of = [lru_cache(maxsize=4)(plan.readout) for plan in further]

    def __reduce__(self) -> tuple[Any, ...]:
        return _Show, (self.reader, self.measured, self.gazes, self.further)

    def __call__(self, scoring: Scoring, trial: Trial, readout: Readout | None) -> _SeenTrial:
        started = time.perf_counter()
        scorings = [scoring, *(replace(scoring, plan=plan) for plan in self.further)]
        viewings = [trial_viewing(scoring, trial, readout)]
        viewings += [
            trial_viewing(one, trial, readout_of(trial.stimulus))
            for one, readout_of in zip(scorings[1:], self._readouts_of, strict=True)
        ]
        # The frames are read once, as wide as the widest of the grids needs at any displacement and gaze.
        widest = max(viewings, key=lambda one: one.grid.width_mrad)
        pitch_mrad = scoring.dataset.display.pitch_mrad
        displaced = [one.reached_samples * (one.grid.pitch_mrad / widest.grid.pitch_mrad) for one in viewings]
        if len(self.gazes) > 1:
            to_gazes_px = np.concatenate([[(0.0, 0.0)], to_mean_place_px(trial)])
            to_gazes = to_gazes_px * (pitch_mrad / widest.grid.pitch_mrad)
            displaced = [(one[:, None] + to_gazes).reshape(-1, 2) for one in displaced]
        found = self.reader.read(
            scoring.dataset,
            trial,
            widest.observer,
            widest.grid,
            np.concatenate(displaced),
            whole=any(one.plan.whole_frames for one in scorings),
        )
        shown = [one.shown for one in found]
        ways = [
            shown if gaze == scoring.dataset.gaze else [one.with_gaze_fixed(trial, pitch_mrad) for one in shown]
            for gaze in self.gazes
        ]
        seen, *others = (
            tuple(see(of_observer, trial, one, ways[number % len(ways)], started))
            for number, (of_observer, one) in enumerate(zip(scorings, viewings, strict=True))
        )
        contrasts = np.full((len(ways), len(found), len(ORIENTATIONS)), np.nan)
        if trial.number in self.measured:
            grid, centre = viewings[0].grid, viewings[0].observer.centre
            for number, of_gaze in enumerate(ways):
                contrasts[number] = triangle_contrasts(of_gaze, trial, grid=grid, centre=centre)
        return _SeenTrial(seen, tuple(one.measured for one in found), contrasts, tuple(others))


class _Measurements:
    """The measurements of all frames after an algorithm: numbers for those that have them, and a sum."""

    def __init__(self) -> None:
        self.squared_errors, self.ssims, self.cpu_s = array("d"), array("d"), array("d")
        self.memory_mb, self.edge_factors = array("d"), array("d")
        self.n_clipped = 0

    def add(self, one: FrameMeasurements) -> None:
        if one.squared_error is not None:
            self.squared_errors.append(one.squared_error)
        if one.ssim is not None:
            self.ssims.append(one.ssim)
        if one.memory_mb is not None:
            self.memory_mb.append(one.memory_mb)
        self.cpu_s.append(one.cpu_s)
        self.edge_factors.append(one.edge_factor)
        self.n_clipped += one.n_clipped


class _ResultColumns:
    """The results of all trials, in columns that are filled in any order.

    Sums are exact whatever the order: `math.fsum` rounds once.
    """

    def __init__(self, trials: Trials, n_algorithms: int) -> None:
        self._seen = [SeenTrials(trials) for _ in range(n_algorithms)]
        self.measured = [_Measurements() for _ in range(n_algorithms)]
        self.contrasts = np.full((len(trials), n_algorithms, len(ORIENTATIONS)), np.nan)
        self.is_seen = np.zeros(len(trials), bool)

    def put(self, row: int, found: _SeenTrial, seen: Sequence[SeenTrial], contrasts: FloatArray) -> None:
        for scores, measured, one, of_frames in zip(self._seen, self.measured, seen, found.measured, strict=True):
            scores.put(row, one)
            for of_frame in of_frames:
                measured.add(of_frame)
        self.contrasts[row], self.is_seen[row] = contrasts, True

    def seen(self) -> list[SeenTrials]:
        """Return the scores after each algorithm; an empty list if there are none."""
        return [one.usable() for one in self._seen if self.is_seen.any()]


def _amplified(
    fit: Callable[..., ScoredDataset],
    seen: SeenTrials,
    gains: Mapping[tuple[float | str, ...], float],
    fit_settings: FitSettings,
) -> ScoredDataset:
    """Fit the trials after a plain gain of contrast; groups whose gain is not known stay as they are."""
    gain = np.array([gains.get(group, 1.0) for group in seen.trials.groups])[seen.trials.group_codes]
    return fit(seen.amplified(gain), fit_settings=replace(fit_settings, resamples=0))


def _compared(
    scored: Sequence[ScoredDataset],
    plain: Sequence[ScoredDataset],
    gains: Sequence[Mapping[tuple[float | str, ...], float]],
    seed: int,
    fit_settings: FitSettings,
    backgrounds: NDArray[np.intp] | None,
) -> list[list[Compared]]:
    """Compare each algorithm with the reference: once a group, and once over all groups if there are several.

    `plain` are the reference's trials after a plain gain of contrast, as large as that of each other algorithm;
    there are none if answers were drawn. `backgrounds` is the number of each trial's scene: the same scenes are
    drawn in all groups.
    """
    trials, groups = scored[0].trials, [fit.group for fit in scored[0].fits]
    several = len(groups) > 1
    n_comparisons = (len(scored) - 1) * (len(groups) + several)
    resamples = max(fit_settings.resamples, min(RESAMPLES_PER_COMPARISON * n_comparisons, MAX_RESAMPLES))
    settings = replace(fit_settings, resamples=resamples)
    level = trials.levels
    of_group = [trials.indices_of_group(group) for group in groups]

    # All series of a group at once: each is drawn and fitted only once.
    others = range(1, len(scored))
    pairs = [(k, 0) for k in others] + [(k, k + len(plain)) for k in others if plain]

    drawn = None
    if backgrounds is not None:
        stream = np.random.SeedSequence(seed, spawn_key=(RATIO_STREAMS, len(groups)))
        backgrounds = sets_of_backgrounds(backgrounds)
        drawn = draw_backgrounds(int(backgrounds.max()) + 1, resamples, np.random.default_rng(stream))

    def of_group_backgrounds(these: NDArray[np.intp]) -> NDArray[np.intp] | None:
        """Return the backgrounds of a group's trials; None if there is but one, which says nothing of others."""
        found = None if backgrounds is None else backgrounds[these]
        return None if found is None or len(np.unique(found)) < 2 else found

    def draw(number: int) -> list[RatioDraws]:
        these = of_group[number]
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(RATIO_STREAMS, number)))
        fits = [one.fits[number].fit for one in (*scored, *plain)]
        p_correct = np.array([one.p_correct[these] for one in (*scored, *plain)])
        return ratio_draws(
            level[these],
            p_correct,
            fits,
            pairs=pairs,
            settings=settings,
            rng=rng,
            backgrounds=of_group_backgrounds(these),
            drawn_backgrounds=drawn,
        )

    draws = list(zip(*(draw(number) for number in range(len(groups))), strict=True))
    ratios = [
        [threshold_ratio([one]) for one in own] + ([threshold_ratio(own)] if several else [])
        for own in draws[: len(others)]
    ]
    beyond = [
        _beyond(own, of_algorithm, groups) if plain else [None] * (len(groups) + several)
        for own, of_algorithm in zip(draws[-len(others) :], gains[1:], strict=True)
    ]
    least = 2 / (resamples + 1)
    corrected = iter(holm([ratio.p_value for own in ratios for ratio in own]).tolist())
    compared: list[list[Compared]] = [[]]
    for own, own_beyond in zip(ratios, beyond, strict=True):
        p_values = [next(corrected) for _ in own]
        verdicts = [_verdict(ratio, p) for ratio, p in zip(own, p_values, strict=True)]
        if several and {"better", "worse"} <= set(verdicts):
            verdicts[-1] = "mixed"
        elif several and verdicts[-1] == "no difference shown":
            verdicts[-1] = next((found for found in verdicts if found != "no difference shown"), verdicts[-1])
        names = [*groups, None] if several else groups
        at_least = [ratio.p_value <= least for ratio in own]
        compared.append(
            [Compared(*one) for one in zip(names, own, p_values, verdicts, at_least, own_beyond, strict=True)]
        )
    return compared


def _beyond(
    draws: Sequence[RatioDraws],
    gains: Mapping[tuple[float | str, ...], float],
    groups: Sequence[tuple[float | str, ...]],
) -> list[BeyondGain | None]:
    """Return the comparison with a plain gain in each group, and in all together if there are several."""
    found = [
        BeyondGain(gains[group], threshold_ratio([one])) if group in gains else None
        for group, one in zip(groups, draws, strict=True)
    ]
    if len(groups) < 2:
        return found
    if None in found:
        return [*found, None]
    mean = math.exp(math.fsum(math.log(gains[group]) for group in groups) / len(groups))
    return [*found, BeyondGain(mean, threshold_ratio(draws))]


def _verdict(ratio: ThresholdRatio, p_value: float) -> Verdict:
    if p_value >= SIGNIFICANCE:
        return "no difference shown"
    return "better" if ratio.is_lower else "worse"


def _mean(values: array[float]) -> float | None:
    return math.fsum(values) / len(values) if values else None
