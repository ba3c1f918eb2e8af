"""Comparison of algorithms on a dataset: thresholds after each, and their ratios to those without enhancement.

All algorithms get the same frames. The observer sees their results with the same displacement of the retina and
the same noise on its neurons.
"""

from __future__ import annotations

import math
import time
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.enhancement.algorithm import REFERENCE, Enhancement
from todframes.enhancement.comparison import NO_DIFFERENCE, Algorithm, ContrastResponse, Ratio
from todframes.enhancement.contrast_gain import (
    Responses,
    contrast_gains,
    contrast_responses,
    measured_trials,
    triangle_contrasts,
)
from todframes.enhancement.enhanced_frame import (
    AlgorithmDisplay,
    FrameMeasurements,
    TrialReader,
    check_warm_up_there,
)
from todframes.enhancement.finding import find_enhancement, plain_value
from todframes.enhancement.repeatability import RepeatedFrames
from todframes.frames.dataset import Dataset
from todframes.frames.position import check_places
from todframes.frames.trials import Trial, Trials
from todframes.jobs.run import Run
from todframes.observers.interface import Observer, Readout
from todframes.parameters import CurveName, Decisions, Gaze, PlanName
from todframes.psychometrics.fit import MAX_RESAMPLES, FitSettings
from todframes.psychometrics.paired_bootstrap import RatioDraws, threshold_ratio
from todframes.results.data import Example, group_of
from todframes.results.thumbnails import ExamplePatch, pictures
from todframes.results.wording import evenly
from todframes.scoring.examples import example_of, nearest_trial
from todframes.scoring.paired import paired_ratios
from todframes.scoring.plan import ScorePlan, plan_score
from todframes.scoring.records import fit_record
from todframes.scoring.retina_view import retina_image, to_mean_place_px
from todframes.scoring.score import (
    ScoredDataset,
    check_seen,
    fit_groups,
    fitted_curve,
    settings_of_experiment,
    usable_trials,
)
from todframes.scoring.seen_trials import Scoring, SeenTrial, SeenTrials, see, trial_viewing
from todframes.scoring.work import see_trials
from todframes.stimulus import ORIENTATIONS

Gains = Mapping[tuple[float | str, ...], float]
"""Contrast gains by group."""

MOST_GROUPS, MOST_ALGORITHMS = 2, 6
"""Largest numbers of groups and algorithms of the examples."""

SAME_QUALITY = {"psnr": 0.1, "ssim": 0.005}
"""Changes of PSNR in dB, and of SSIM, that count as none up to that."""


class AlgorithmResult(NamedTuple):
    """An algorithm, the scores of all trials after it, and their comparison with those of the reference."""

    enhancement: Enhancement
    scored: ScoredDataset
    record: Algorithm


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

    Frames are decoded and enhanced once for all observers, which look at the same point of the triangle, and for
    all their gazes, by default that of the dataset. For each gaze of each observer comes back a result for each
    algorithm, the reference, `none`, first. The default screen is the dataset's display with a white of 1. Other
    parameters, and errors, are those of `score_dataset`; all algorithms have one plan, made from frames before and
    after enhancement, and a trial that is skipped is skipped for all. With the same plan, one observer and one
    gaze, the scores and fits of the reference are those of `score_dataset`, number for number.
    """
    fit_settings = settings_of_experiment(fit_settings, dataset.experiment)
    curve = fitted_curve(curve, decisions)
    if not fit_settings.resamples:
        raise SettingsError("resamples: found 0, expected 40 or more: a comparison rests on them")
    algorithms = _with_reference(enhancements, observers)
    screen = screen or AlgorithmDisplay(dataset.display)
    whole, skipped = usable_trials(dataset, skip_bad_frames=skip_bad_frames)
    if of_clips := [algorithm for algorithm in algorithms if algorithm.declaration.clip]:
        whole = whole.with_warm_up(max(algorithm.warm_up_frames for algorithm in of_clips))
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
    measured = measured_trials(whole)
    columns = _ResultColumns(whole, len(plans), len(gazes), len(algorithms))
    skipped += see_trials(
        Scoring(dataset, plans[0], decisions, seed),
        whole,
        _Show(reader, measured, gazes, tuple(plans[1:])),
        kind=_SeenTrial,
        collect=columns.put,
        skip_bad_frames=skip_bad_frames,
        run=run,
        depends_on=(
            parts_of(algorithms),
            screen,
            sorted(measured),
            gazes,
            [(plan.observer, plan.whole_frames, sorted(map(repr, plan.stimuli.items()))) for plan in plans[1:]],
            repeated.fingerprint,
        ),
        with_references=True,
        with_levels=True,
    )
    repeated.finish(run)
    results = []
    for number, plan in enumerate(plans):
        fit = partial(fit_groups, plan, seed=seed, fit_settings=fit_settings, curve=curve, expected=expected)
        seen = check_seen(dataset, columns.usable(number), skipped)
        scored = [replace(fit(scores), skipped=tuple(skipped)) for scores in seen]
        contrasts = columns.contrasts[number % len(gazes), columns.is_seen]
        responses = contrast_responses(seen[0].trials, contrasts)
        gains = contrast_gains(responses)
        # The reference after plain gains of contrast; groups whose gain is not known stay as they are.
        groups, codes = seen[0].trials.groups, seen[0].trials.group_codes
        is_linear = expected and not np.isnan(seen[0]["deviations"]).any()
        each = [np.array([of_one.get(group, 1.0) for group in groups])[codes] for of_one in gains[1:] if is_linear]
        once = replace(fit_settings, resamples=0)
        plain = [fit(seen[0].amplified(gain), fit_settings=once) for gain in each]
        ratios = _ratios(dataset, scored, plain, gains, seed, fit_settings)
        records = _records(dataset, algorithms, scored, ratios, responses, columns.measured, repeated, screen)
        results.append(tuple(map(AlgorithmResult, algorithms, scored, records)))
    return tuple(results)


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


def parts_of(algorithms: Sequence[Enhancement]) -> list[object]:
    """Return what scores depend on of the algorithms.

    Values are not always in the text: those of a file beside a network, or of a `functools.partial`, are not.
    """
    return [(algorithm.spec, algorithm.function, dict(algorithm.values)) for algorithm in algorithms]


def _records(
    dataset: Dataset,
    algorithms: Sequence[Enhancement],
    scored: Sequence[ScoredDataset],
    ratios: Sequence[Sequence[Ratio]],
    responses: Sequence[Responses],
    measured: Sequence[array[float]],
    repeated: RepeatedFrames,
    screen: AlgorithmDisplay,
) -> Iterator[Algorithm]:
    """Yield the records of algorithms as one observer judges them, the reference first."""
    scenes, names = scored[0].trials.scene_numbers, [algorithm.name for algorithm in algorithms]
    black, white = screen.luminance_range
    before: dict[str, float | None] = {}
    for k, (algorithm, own, of_algorithm) in enumerate(zip(algorithms, scored, ratios, strict=True)):
        columns = np.reshape(measured[k], (-1, len(FrameMeasurements._fields))).T
        errors, ssims, edges, clipped, cpu_s, memory = (column[~np.isnan(column)] for column in columns)
        error, ssim, cpu_mean_s = (
            math.fsum(one) / len(one) if len(one) else None for one in (errors, ssims, cpu_s)
        )
        psnr = 10.0 * math.log10((white - black) ** 2 / error) if error else None
        quality = {"psnr": psnr, "ssim": ssim}
        before = before or quality
        changes = {
            name: after - reference
            for (name, after), reference in zip(quality.items(), before.values(), strict=True)
            if after is not None and reference is not None
        }
        opinions = {
            name: NO_DIFFERENCE if abs(change) < SAME_QUALITY[name] else "better" if change > 0 else "worse"
            for name, change in changes.items()
        }
        verdict = of_algorithm[-1].verdict if of_algorithm else None
        yield Algorithm(
            name=algorithm.name if names.count(algorithm.name) == 1 else algorithm.spec,
            spec=algorithm.spec,
            what=algorithm.what,
            library=algorithm.declaration.library,
            domain=algorithm.declaration.domain,
            parameters={name: plain_value(value) for name, value in algorithm.values.items()},
            magnification=algorithm.magnification,
            fits=tuple(fit_record(dataset, fit) for fit in own.fits),
            ratios=tuple(of_algorithm[: len(own.fits)]),
            overall=of_algorithm[-1] if len(of_algorithm) > len(own.fits) else None,
            verdict=verdict,
            contrast_responses=tuple(
                ContrastResponse(group=group_of(dataset, fit.group), points=responses[k].get(fit.group, ()))
                for fit in own.fits
                if k
            ),
            n_scenes=None if scenes is None else int(scenes.max()) + 1,
            psnr_db=psnr,
            psnr_change_db=changes.get("psnr"),
            ssim=ssim,
            ssim_change=changes.get("ssim"),
            disagrees=tuple(name for name, one in opinions.items() if one != verdict) if verdict else (),
            edge_factor=float(np.median(edges)),
            repeat_difference=repeated.differences[algorithm.spec],
            n_clipped=int(clipped.sum()),
            cpu_s=round(math.fsum(cpu_s), 4),
            cpu_ms_per_frame=round(1e3 * (cpu_mean_s or 0.0), 3),
            memory_mb=round(float(memory.max()), 1) if memory.size else None,
        )


class _SeenTrial(NamedTuple):
    """The scores of a trial by each plan after each algorithm, and the measurements of each of its frames.

    `contrasts`, (gaze, algorithm, 4), are those of `triangle_contrasts`; NaN if they are not measured in this
    trial.
    """

    seen: tuple[tuple[SeenTrial, ...], ...]
    measured: tuple[tuple[FrameMeasurements, ...], ...]
    contrasts: FloatArray


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
        readouts = [readout, *(readout_of(trial.stimulus) for readout_of in self._readouts_of)]
        viewings = [trial_viewing(own, trial, its) for own, its in zip(scorings, readouts, strict=True)]
        # The frames are read once, as wide as the widest of the grids needs at any displacement and gaze.
        widest = max(viewings, key=lambda viewing: viewing.grid.width_mrad)
        pitch_mrad, widest_mrad = scoring.dataset.display.pitch_mrad, widest.grid.pitch_mrad
        displaced = [view.reached_samples * (view.grid.pitch_mrad / widest_mrad) for view in viewings]
        if len(self.gazes) > 1:
            to_gazes_px = np.concatenate([[(0.0, 0.0)], to_mean_place_px(trial)])
            to_gazes = to_gazes_px * (pitch_mrad / widest_mrad)
            displaced = [(samples[:, None] + to_gazes).reshape(-1, 2) for samples in displaced]
        after = self.reader.read(
            scoring.dataset,
            trial,
            widest.observer,
            widest.grid,
            np.concatenate(displaced),
            whole=any(own.plan.whole_frames for own in scorings),
        )
        shown = [enhanced.shown for enhanced in after]
        ways = [
            shown if gaze == scoring.dataset.gaze else [way.with_gaze_fixed(trial, pitch_mrad) for way in shown]
            for gaze in self.gazes
        ]
        seen = tuple(
            tuple(see(own, trial, viewing, ways[number % len(ways)], started))
            for number, (own, viewing) in enumerate(zip(scorings, viewings, strict=True))
        )
        contrasts = np.full((len(ways), len(after), len(ORIENTATIONS)), np.nan)
        if trial.number in self.measured:
            grid, centre = viewings[0].grid, viewings[0].observer.centre
            for number, of_gaze in enumerate(ways):
                contrasts[number] = triangle_contrasts(of_gaze, trial, grid=grid, centre=centre)
        return _SeenTrial(seen, tuple(enhanced.measured for enhanced in after), contrasts)


class _ResultColumns:
    """The results of all trials, in columns that are filled in any order.

    `measured` has the `FrameMeasurements` of all frames after each algorithm, NaN for None, and `contrasts` has
    shape (gaze, trial, algorithm, 4). Sums are exact whatever the order: `math.fsum` rounds once.
    """

    def __init__(self, trials: Trials, n_plans: int, n_gazes: int, n_algorithms: int) -> None:
        self._seen = [[SeenTrials(trials) for _ in range(n_algorithms)] for _ in range(n_plans)]
        self.measured = [array("d") for _ in range(n_algorithms)]
        self.contrasts = np.full((n_gazes, len(trials), n_algorithms, len(ORIENTATIONS)), np.nan)
        self.is_seen = np.zeros(len(trials), bool)

    def put(self, row: int, trial: _SeenTrial) -> None:
        """Set the results of a trial."""
        for scores, seen in zip(chain(*self._seen), chain(*trial.seen), strict=True):
            scores.put(row, seen)
        for column, of_frames in zip(self.measured, trial.measured, strict=True):
            column.extend(math.nan if value is None else value for value in chain(*of_frames))
        self.contrasts[:, row], self.is_seen[row] = trial.contrasts, True

    def usable(self, plan: int) -> list[SeenTrials]:
        """Return the scores of a plan after each algorithm; an empty list if there are none."""
        return [scores.usable() for scores in self._seen[plan] if self.is_seen.any()]


def _ratios(
    dataset: Dataset,
    scored: Sequence[ScoredDataset],
    plain: Sequence[ScoredDataset],
    gains: Sequence[Gains],
    seed: int,
    fit_settings: FitSettings,
) -> list[list[Ratio]]:
    """Compare each algorithm with the reference: once a group, and once over all groups if there are several.

    `plain` are the reference's trials after a plain gain of contrast, as large as that of each other algorithm;
    there are none if answers were drawn or the observer is not linear. The same scenes are drawn in all groups.
    """
    groups = [fit.group for fit in scored[0].fits]
    several, others = len(groups) > 1, range(1, len(scored))
    n_comparisons = len(others) * (len(groups) + several)
    # The smallest p-value, 2 / resamples, is then half of 5 % even after Holm's correction.
    resamples = max(fit_settings.resamples, min(80 * n_comparisons, MAX_RESAMPLES))
    settings = replace(fit_settings, resamples=resamples)
    pairs = [(k, 0) for k in others] + [(k, k + len(plain)) for k in others if plain]
    of_groups = paired_ratios((*scored, *plain), pairs, seed=seed, settings=settings)
    draws = list(zip(*of_groups, strict=True))
    ratios = [
        [threshold_ratio([one]) for one in own] + ([threshold_ratio(own)] if several else [])
        for own in draws[: len(others)]
    ]
    corrected = iter(holm([ratio.p_value for own in ratios for ratio in own]).tolist())
    names = [group_of(dataset, group) for group in groups] + ([{}] if several else [])
    compared: list[list[Ratio]] = [[]]
    for own, own_draws, own_gains in zip(ratios, draws[-len(others) :], gains[1:], strict=True):
        p_values = [next(corrected) for _ in own]
        verdicts = [
            NO_DIFFERENCE if p >= 0.05 else "better" if ratio.is_lower else "worse"
            for ratio, p in zip(own, p_values, strict=True)
        ]
        if several and {"better", "worse"} <= set(verdicts):
            verdicts[-1] = "mixed"
        elif several and verdicts[-1] == NO_DIFFERENCE:
            verdicts[-1] = next((verdict for verdict in verdicts if verdict != NO_DIFFERENCE), NO_DIFFERENCE)
        beyond: list[dict[str, Any]] = _beyond(own_draws, own_gains, groups) if plain else [{}] * len(own)
        compared.append(
            [
                Ratio(
                    verdict=verdict,
                    group=name,
                    ratio=ratio.ratio,
                    ratio_ci95=ratio.ratio_ci95,
                    p_value=ratio.p_value,
                    p_value_holm=p_holm,
                    p_value_is_least=ratio.p_value <= 2 / (resamples + 1),
                    **more,
                )
                for verdict, name, ratio, p_holm, more in zip(verdicts, names, own, p_values, beyond, strict=True)
            ]
        )
    return compared


def _beyond(
    draws: Sequence[RatioDraws], gains: Gains, groups: Sequence[tuple[float | str, ...]]
) -> list[dict[str, Any]]:
    """Return fields of `Ratio`: the comparison with a plain gain in each group, and in all if there are several.

    They are empty where the triangle's contrast is not positive before or after the algorithm.
    """
    found = [
        _of_gain(gains[group], [one]) if group in gains else {} for group, one in zip(groups, draws, strict=True)
    ]
    if len(groups) < 2:
        return found
    if not all(found):
        return [*found, {}]
    mean = math.exp(math.fsum(math.log(gains[group]) for group in groups) / len(groups))
    return [*found, _of_gain(mean, draws)]


def _of_gain(gain: float, draws: Sequence[RatioDraws]) -> dict[str, Any]:
    ratio = threshold_ratio(draws)
    return {"contrast_gain": gain, "beyond_gain": ratio.ratio, "beyond_gain_ci95": ratio.ratio_ci95}


def compare_examples(
    dataset: Dataset, results: Sequence[AlgorithmResult], observer: Observer, screen: AlgorithmDisplay
) -> tuple[Example, ...]:
    """Draw the trial nearest to the reference's threshold in up to two groups, after each of up to six algorithms.

    All pictures of a group have the same white. Raises FrameError if a frame can no longer be used.
    """
    some, reference, examples = results[:MOST_ALGORITHMS], results[0].scored, []
    reader = TrialReader([result.enhancement for result in some], screen)
    for group in evenly([fit for fit in reference.fits if fit.fit.threshold is not None], MOST_GROUPS):
        row = nearest_trial(reference, group)  # all algorithms have the same trials
        trial = reference.trials[row]
        grid, displaced = observer.grid(trial.stimulus), np.nan_to_num(reference.displacement_samples[row])
        dx, dy = displaced.tolist()
        drawings = [
            partial(
                pictures,
                [ExamplePatch(*part) for part in zip(shown.patches, shown.x_px, shown.y_px, strict=True)],
                retina_image(shown, grid, (dx, dy)),
                observer=observer,
                stimulus=trial.stimulus,
                pixel_pitch_mrad=shown.pixel_pitch_mrad,
            )
            for shown in reader(dataset, trial, observer, grid, [(dx, dy)], whole=True)
        ]
        white = max(draw()[1][0].scale or 0.0 for draw in drawings)
        for result, draw in zip(some, drawings, strict=True):
            p_correct, spec = float(result.scored.p_correct[row]), result.enhancement.spec
            examples.append(example_of(dataset, trial, p_correct, *draw(white=white), algorithm=spec))
    return tuple(examples)


def holm(p_values: ArrayLike) -> FloatArray:
    """Correct p-values for their number, so that any wrong verdict among all is as rare as for a single test. The
    smallest times their number, the next times one less, and so on, never falling (Holm 1979).
    """
    p = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(p)
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1)), 1.0)
    return corrected
