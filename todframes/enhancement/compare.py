"""The calls `compare` and `compare_frames`: thresholds after enhancement algorithms, over those without.

All algorithms get the same frames. The observer sees their results with the same displacement of the retina and
the same noise on its neurons.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from inspect import signature
from itertools import chain, starmap
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import checked
from todframes.base.seeds import Rng, seed_of
from todframes.display.display import Display
from todframes.enhancement.algorithm import REFERENCE, Enhancement
from todframes.enhancement.comparison import (
    NO_DIFFERENCE,
    Algorithm,
    Comparison,
    ContrastPoint,
    ContrastResponse,
    JudgedBy,
    Ratio,
    comparisons,
    frame_warnings,
    named,
    not_proportional,
    thresholds_of,
)
from todframes.enhancement.contrast_gain import (
    contrast_gains,
    contrast_responses,
    measured_trials,
    triangle_contrasts,
)
from todframes.enhancement.displacement import Displacement, find_displacements
from todframes.enhancement.enhanced_frame import AlgorithmDisplay, TrialReader, check_warm_up_there
from todframes.enhancement.finding import find_enhancement, plain_value
from todframes.enhancement.repeatability import RepeatedFrames
from todframes.frames.dataset import Dataset, Skipped
from todframes.frames.position import check_places
from todframes.frames.trials import Group, Trial, Trials
from todframes.jobs.rows import Rows
from todframes.jobs.run import Run, opened_run
from todframes.jobs.work import Engine
from todframes.observers.interface import Observer, Readout
from todframes.parameters import (
    Algorithms,
    Cluster,
    Count,
    CurveName,
    Decisions,
    Gaze,
    Gazes,
    Locate,
    ObserverNames,
    OnError,
    PlanName,
    Progress,
    Seed,
)
from todframes.psychometrics.fit import MAX_RESAMPLES, FitSettings, PsychometricFit
from todframes.psychometrics.paired_bootstrap import RatioDraws, threshold_ratio
from todframes.results.advice import levels_to_add
from todframes.results.data import Example, ResultWarning, group_of
from todframes.results.thresholds import Thresholds
from todframes.results.thumbnails import ExamplePatch, pictures
from todframes.results.wording import subsample
from todframes.scoring.examples import example_of, nearest_trial
from todframes.scoring.opening import each_once, gazes_of, in_memory, inspected, of_observer, opened
from todframes.scoring.paired import paired_ratios
from todframes.scoring.plan import explain
from todframes.scoring.records import fit_record, trials_table
from todframes.scoring.retina_view import retina_image, to_mean_place_px
from todframes.scoring.score import (
    ScoredDataset,
    check_seen,
    fit_groups,
    fitted_curve,
    settings_of_experiment,
    usable_trials,
)
from todframes.scoring.seen_trials import Scoring, TrialScore, TrialScores, score_views, scoring_of, trial_viewing
from todframes.scoring.work import score_trials
from todframes.stimulus import ORIENTATIONS, Centre

MOST_GROUPS, MOST_ALGORITHMS = 2, 6
"""Largest numbers of groups and algorithms of the examples."""

SAME_QUALITY = {"psnr": 0.1, "ssim": 0.005}
"""Changes of PSNR in dB, and of SSIM, that count as none up to that."""


@checked
def compare(
    dataset: Path | str | Dataset,
    enhance: str | Algorithms | Callable[..., Any] | Sequence[str | Callable[..., Any]],
    *,
    observer: str | ObserverNames | Observer | Sequence[str | Observer] = "pyramid",
    white: float = 1.0,
    allow_clipping: bool = False,
    decisions: Decisions = "expected",
    curve: CurveName | None = None,
    plan: PlanName = "needed",
    rng: Seed | Rng = 1,
    fit: FitSettings | None = None,
    locate: Locate | bool = False,
    gaze: str | Gazes | None = None,
    on_error: OnError = "stop",
    workers: Count = 1,
    cluster: Cluster | Engine | None = None,
    store: Rows | Path | str | None = None,
    examples: bool = True,
    progress: Progress | None = None,
) -> Thresholds:
    """Test whether enhancement algorithms lower the thresholds of a dataset, by how much and how surely.

    Each algorithm is compared with the frames as they are, on the same frames and with the same random draws.
    `todframes enhancements` lists the algorithms of the package. With several observers or gazes, each gives a
    verdict, and the first lines say where they disagree.

    Parameters
    ----------
    dataset : path, str or Dataset
        Folder with dataset.toml, manifest.csv and frames.

        The return value of `load_dataset` is taken as well.
    enhance : str, function, or iterable of them
        Algorithm: NAME, MODULE:FUNCTION (whose code is run), or onnx:FILE (a network, which is run), each also
        with :PARAMETER=VALUE,… behind.

        A function of an image and keyword parameters is taken as well.
    observer : str, Observer, or sequence of them
        Observers by name: pyramid, informative, oriented, csf or others that are registered; or MODULE:CLASS, a
        class of your own, whose code is run; or onnx:FILE, a network of four outputs, which is run.

        Objects are taken as well. The first is that of `algorithms`, the others of `observers`, and `verdict`
        begins with where they disagree.
    white : float
        Code value that algorithms take as white; for EXR in cd/m² give the display's white.
    allow_clipping : bool
        Clip values beyond the display's range in the output of an algorithm; without it they are an error.
    decisions : {"expected", "sampled"}
        Use each frame's probability of a correct answer, or draw one answer for each trial.
    curve : {"observer", "weibull"}, optional
        Psychometric function of the thresholds: the observer's own, which needs expected decisions, or Weibull's,
        as for people. Default: observer for expected decisions, weibull for sampled ones.
    plan : {"needed", "full"}
        Leave out what the scene does not need, or nothing.
    rng : int, SeedSequence or Generator
        Seed of all random draws.
    fit : FitSettings, optional
        Criterion (`p_correct`), fixed and free parameters of the fits.
    locate : {"group", "each"} or bool
        Find the triangle: one position for each group, or one for each trial, for hand-held or drifting
        recordings. The search begins at the position in the manifest, if there is one.

        True is the same as "group".
    gaze : {"tracked", "fixed"} or sequence of them, optional
        Where the observer looks while a triangle moves: at its place in each frame (tracked), or at its mean place
        in the trial, so that it sees the motion as blur (fixed); or both. Default: tracked.

        A `Dataset` has its own default.
    on_error : {"stop", "skip"}
        At a frame or row that cannot be used: end with an error, or go on and list it among the skipped ones. A
        trial that cannot be used with one algorithm is left out for all.
    workers : int
        Processes that share the work.
    cluster : str, optional
        Work on a Dask cluster: the address of its scheduler, tcp://….
    store : path, optional
        Folder for the results of finished trials, as in `score`.
    examples : bool
        Also draw a triangle at threshold, for the page.
    progress : function of two ints, optional
        Called with the number of trials that are done, and of all; finding positions counts apart.

    Returns
    -------
    Result
        Result whose `algorithms` have thresholds, ratios to the reference and verdicts, the reference first.

    Raises
    ------
    DataError, FrameError
        If the dataset, a frame or the output of an algorithm cannot be used.
    SettingsError
        If a setting or an algorithm is invalid.

    Examples
    --------
    >>> import todframes as tod
    >>> def brighter(image, gain=1.2):
    ...     return gain * image
    >>> fit = tod.FitSettings(resamples=200)
    >>> result = tod.compare("sample_frames/enhancement", [brighter], allow_clipping=True, fit=fit)
    >>> [one.verdict for one in result.algorithms]
    [None, 'no difference shown']
    """
    started, seed, fit = time.perf_counter(), seed_of(rng), fit or FitSettings()
    if isinstance(enhance, str) or not isinstance(enhance, Iterable):
        enhance = [enhance]
    enhancements = [find_enhancement(each) for each in enhance]
    if not enhancements:
        raise SettingsError(f"{argument.enhance}: found none, expected one algorithm or more")
    asked = () if gaze is None else gazes_of(gaze)
    data, judges, of_judges, way, more, placed_wrong = opened(
        dataset, observer, gaze=asked[0] if asked else None, locate=locate, on_error=on_error, progress=progress
    )
    gazes = asked or (data.gaze,)
    screen = AlgorithmDisplay(data.display, white, allow_clipping)
    each_settings = [own | {"gaze": own_gaze} for own in of_judges for own_gaze in gazes]
    with opened_run(workers, cluster, store, progress) as run:
        each_results = compare_observers(
            data,
            judges,
            enhancements,
            gazes=gazes,
            decisions=decisions,
            curve=curve,
            seed=seed,
            fit_settings=fit,
            screen=screen,
            plan=plan,
            skip_bad_frames=on_error == "skip",
            run=run,
        )
    judged = named(list(map(_judged_by, each_settings, each_results)))
    compared, advice = judged[0][1].algorithms, list(starmap(_advice, judged))
    results, reference = each_results[0], each_results[0][0].scored
    if examples:
        more["examples"] = compare_examples(data, results, judges[0], screen)
    record, shown_wrong = inspected(data, reference.trials, judges[0].centre)
    scored = [({"algorithm": result.enhancement.spec}, result.scored) for result in results]
    return Comparison.made(
        "compare",
        started,
        settings=each_settings[0]
        | asdict(fit)
        | {"decisions": decisions, "curve": fitted_curve(curve, decisions), "locate": way}
        | {"plan": plan, "white": white, "allow_clipping": allow_clipping},
        seed=seed,
        algorithms=compared,
        observers=tuple(of_judge for _, of_judge in judged[1:]),
        data_range_cd_m2=screen.data_range_cd_m2,
        verdict=comparisons(judged),
        plan=explain(scoring_of(data, judges[0], plan=plan, decisions=decisions, seed=seed), reference.trials),
        skipped=tuple(skipped._asdict() for skipped in reference.skipped),
        dataset=record,
        warnings=(
            *each_once(*placed_wrong(reference), *shown_wrong, *advice[0], *not_proportional(compared)),
            *frame_warnings(compared),
            *chain(*advice[1:]),
        ),
        negative_luminance_pixels=reference.n_negative,
        from_store=run.n_from_store,
        **more,
    ).holding(make_trials=partial(trials_table, data, scored))


@checked
def compare_frames(
    frames: Iterable[ArrayLike],
    enhance: str | Callable[..., Any] | Sequence[str | Callable[..., Any]],
    *,
    display: Display | str,
    **settings: Any,
) -> Thresholds:
    """Compare enhancement algorithms on frames that are in memory, without touching a disk.

    Parameters
    ----------
    frames : array_like, shape (n, rows, columns), or iterable of n arrays (rows, columns)
        Frames as in `score_frames`.
    enhance : str, function, or iterable of them
        Algorithms as in `compare`.
    display : Display or str
        Display as in `score_frames`.
    **settings
        What the frames show, as for `score_frames`: orientation, level, size_mrad, group, position, polarity,
        trial, level_name, clip, time_s and judged. All other settings are those of `compare`.

    Returns
    -------
    Result
        Result as that of `compare`.

    Raises
    ------
    DataError, FrameError, SettingsError
        As `score_frames` and `compare` do.
    """
    from todframes.frames.memory import memory_dataset

    shown = {name: settings.pop(name) for name in signature(memory_dataset).parameters if name in settings}
    return compare(in_memory(frames, display, **shown), enhance, **settings)


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
    plan: PlanName = "needed",
    skip_bad_frames: bool = False,
    run: Run | None = None,
) -> list[list[AlgorithmResult]]:
    """Show every trial to observers as it is and after each algorithm, and compare the thresholds of each.

    Frames are decoded and enhanced once for all observers and gazes. For each gaze of each observer comes back a
    result for each algorithm, the reference first; its scores and fits are those of `score_dataset` with the same
    plan. A trial that is skipped is skipped for all. Errors are those of `score_dataset`.
    """
    fit_settings = settings_of_experiment(fit_settings, dataset.experiment)
    curve = fitted_curve(curve, decisions)
    if not fit_settings.resamples:
        raise SettingsError("resamples: found 0, expected 40 or more: a comparison rests on them")
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
    results = []
    for number, scoring in enumerate(scorings):
        fit = partial(fit_groups, scoring, fit_settings=fit_settings, curve=curve)
        of_scoring = [scores.usable() for scores in seen[number]]
        scored = [replace(fit(scores), skipped=tuple(skipped)) for scores in of_scoring]
        responses = contrast_responses(of_scoring[0].trials, contrasts[number % len(gazes), is_seen])
        gains = contrast_gains(responses)
        is_linear = expected and not np.isnan(of_scoring[0]["deviations"]).any()
        once = replace(fit_settings, resamples=0)
        plain = [fit(_amplified(of_scoring[0], of_gain), fit_settings=once) for of_gain in gains[1:] if is_linear]
        ratios = _ratios(dataset, scored, plain, gains, seed, fit_settings)
        records = map(partial(_judged, dataset, repeated), described, scored, ratios, responses)
        results.append(list(map(AlgorithmResult, algorithms, scored, records)))
    return results


def _judged_by(settings: Json, results: Sequence[AlgorithmResult]) -> JudgedBy:
    return JudgedBy(settings=settings, algorithms=tuple(result.record for result in results))


def _advice(name: str, judged: JudgedBy) -> tuple[ResultWarning, ...]:
    """Return warnings about levels to add for an observer."""
    levels = levels_to_add(thresholds_of(judged.algorithms), judged.settings.get("aperture_sd_deg"))
    return of_observer(name, levels)


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


def _amplified(seen: TrialScores, gains: Mapping[Group, float]) -> TrialScores:
    """Return scores after a plain gain of contrast; groups whose gain is not known stay as they are."""
    of_groups = np.array([gains.get(group, 1.0) for group in seen.trials.groups])
    return seen.amplified(of_groups[seen.trials.group_codes])


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
) -> list[Algorithm]:
    """Return the records of algorithms, with what is the same for all observers: measurements over all frames.

    `measured`, (algorithm, frame, `MEASUREMENTS`), may have its frames in any order: `math.fsum` rounds once.
    """
    names = [algorithm.name for algorithm in algorithms]
    records: list[Algorithm] = []
    for algorithm, displacement, of_frames in zip(algorithms, moved, measured, strict=True):
        errors, ssims, edges, clipped, cpu_s = (column[~np.isnan(column)] for column in of_frames.T)
        error, ssim, cpu_mean_s = (
            math.fsum(column) / len(column) if len(column) else None for column in (errors, ssims, cpu_s)
        )
        psnr = 10.0 * math.log10(screen.data_range_cd_m2**2 / error) if error else None
        psnr_before, ssim_before = (records[0].psnr_db, records[0].ssim) if records else (psnr, ssim)
        record = Algorithm(
            name=algorithm.name if names.count(algorithm.name) == 1 else algorithm.spec,
            spec=algorithm.spec,
            what=algorithm.what,
            library=algorithm.declaration.library,
            domain=algorithm.declaration.domain,
            parameters={name: plain_value(value) for name, value in algorithm.values.items()},
            magnification=algorithm.magnification,
            displacement_px=displacement.px,
            displacement_scatter_px=displacement.scatter_px,
            psnr_db=psnr,
            psnr_change_db=None if psnr is None or psnr_before is None else psnr - psnr_before,
            ssim=ssim,
            ssim_change=None if ssim is None or ssim_before is None else ssim - ssim_before,
            edge_factor=float(np.median(edges)),
            n_clipped=int(clipped.sum()),
            cpu_s=round(math.fsum(cpu_s), 4),
            cpu_ms_per_frame=round(1e3 * (cpu_mean_s or 0.0), 3),
        )
        records.append(record)
    return records


def _judged(
    dataset: Dataset,
    repeated: RepeatedFrames,
    algorithm: Algorithm,
    scored: ScoredDataset,
    ratios: Sequence[Ratio],
    points: Mapping[Group, tuple[ContrastPoint, ...]],
) -> Algorithm:
    """Return the record of an algorithm with what an observer finds; the reference has no ratios."""
    verdict, scenes = ratios[-1].verdict if ratios else None, scored.trials.scene_numbers
    changes = {"psnr": algorithm.psnr_change_db, "ssim": algorithm.ssim_change}
    opinions = {
        name: NO_DIFFERENCE if abs(change) < SAME_QUALITY[name] else "better" if change > 0 else "worse"
        for name, change in changes.items()
        if change is not None
    }
    responses = [
        ContrastResponse(group=group_of(dataset, fit.group), points=points.get(fit.group, ()))
        for fit in scored.fits
        if ratios
    ]
    return structs.replace(
        algorithm,
        fits=tuple(fit_record(dataset, fit) for fit in scored.fits),
        ratios=tuple(ratios[: len(scored.fits)]),
        overall=ratios[-1] if len(ratios) > len(scored.fits) else None,
        verdict=verdict,
        contrast_responses=tuple(responses),
        n_scenes=None if scenes is None else int(scenes.max()) + 1,
        disagrees=tuple(name for name, opinion in opinions.items() if opinion != verdict) if verdict else (),
        repeat_difference=repeated.differences[str(algorithm.spec)],
    )


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
    ways = [
        shown if gaze == scoring.dataset.gaze else [way.with_gaze_fixed(trial, pitch_mrad) for way in shown]
        for gaze in gazes
    ]
    seen = tuple(
        tuple(score_views(own, trial, viewing, ways[number % len(ways)]))
        for number, (own, viewing) in enumerate(zip(scorings, viewings, strict=True))
    )
    contrasts = np.full((len(ways), len(shown), len(ORIENTATIONS)), np.nan)
    if trial.number in measured_numbers:
        grid, centre = viewings[0].grid, viewings[0].observer.centre
        for number, of_gaze in enumerate(ways):
            contrasts[number] = triangle_contrasts(of_gaze, trial, grid=grid, centre=centre)
    return _TrialScores(seen, measured, contrasts)


def _ratios(
    dataset: Dataset,
    scored: Sequence[ScoredDataset],
    plain: Sequence[ScoredDataset],
    gains: Sequence[Mapping[Group, float]],
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
    draws: list[list[Sequence[RatioDraws]]] = [
        [[of_group] for of_group in of_pair] + [of_pair] * several for of_pair in zip(*of_groups, strict=True)
    ]
    ratios = [[threshold_ratio(each) for each in own] for own in draws[: len(others)]]
    corrected = iter(holm([ratio.p_value for own in ratios for ratio in own]).tolist())
    names = [group_of(dataset, group) for group in groups] + ([{}] if several else [])
    compared: list[list[Ratio]] = [[]]
    reached = [[_reached(fit.fit) for fit in each.fits] for each in scored]
    for own, own_draws, of_algorithm, own_reached in zip(
        ratios, draws[-len(others) :], gains[1:], reached[1:], strict=True
    ):
        with np.errstate(divide="ignore"):
            bounds = [low_high / before[::-1] for low_high, before in zip(own_reached, reached[0], strict=True)]
            bounds += [np.exp(np.log(bounds).mean(axis=0))] * several
        each_gain = [of_algorithm.get(group) for group in groups]
        own_gains = [[gain] for gain in each_gain] + [each_gain] * several
        p_values = [next(corrected) for _ in own]
        verdicts = [
            NO_DIFFERENCE if p >= 0.05 else "better" if ratio.is_lower else "worse"
            for ratio, p in zip(own, p_values, strict=True)
        ]
        if several and {"better", "worse"} <= set(verdicts):
            verdicts[-1] = "mixed"
        elif several and verdicts[-1] == NO_DIFFERENCE:
            verdicts[-1] = next((verdict for verdict in verdicts if verdict != NO_DIFFERENCE), NO_DIFFERENCE)
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
                    **(_bounds(low_high) if ratio.ratio is None else {}),
                    **(_beyond(of_plain, known) if plain else {}),
                )
                for verdict, name, ratio, p_holm, of_plain, known, low_high in zip(
                    verdicts, names, own, p_values, own_draws, own_gains, bounds, strict=True
                )
            ]
        )
    return compared


def _reached(fit: PsychometricFit) -> FloatArray:
    """Return the least and the largest level at which a threshold may be: its own, or beyond the levels shown."""
    if fit.threshold is not None:
        return np.array([fit.threshold, fit.threshold])
    never, exceeded = fit.status == "never_reached", fit.status == "always_exceeded"
    return np.array([fit.points[-1].level if never else 0.0, fit.points[0].level if exceeded else math.inf])


def _bounds(low_high: FloatArray) -> dict[str, Any]:
    """Return fields of `Ratio`: the ends between which a ratio without an estimate lies, where they are known."""
    ends = zip(("ratio_above", "ratio_below"), low_high.tolist(), strict=True)
    return {name: end for name, end in ends if 0.0 < end < math.inf}


def _beyond(draws: Sequence[RatioDraws], gains: Sequence[float | None]) -> dict[str, Any]:
    """Return fields of `Ratio`: the comparison with a plain gain, of all groups with the mean of their gains.

    They are empty where the triangle's contrast is not positive before or after the algorithm.
    """
    known = [gain for gain in gains if gain is not None]
    if len(known) < len(gains):
        return {}
    gain = known[0] if len(known) == 1 else math.exp(math.fsum(map(math.log, known)) / len(known))
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
    for group in subsample([fit for fit in reference.fits if fit.fit.threshold is not None], MOST_GROUPS):
        row = nearest_trial(reference, group)  # all algorithms have the same trials
        trial = reference.trials[row]
        grid, displaced = observer.grid(trial.stimulus), np.nan_to_num(reference.displacement_samples[row])
        dx, dy = displaced.tolist()
        draw = partial(pictures, observer=observer, stimulus=trial.stimulus)
        drawings = [
            partial(
                draw,
                [ExamplePatch(*part) for part in zip(shown.patches, shown.x_px, shown.y_px, strict=True)],
                retina_image(shown, grid, (dx, dy)),
                pixel_pitch_mrad=shown.pixel_pitch_mrad,
            )
            for shown in reader(dataset, trial, observer, grid, [(dx, dy)], whole=True)
        ]
        white = max(drawn()[1][0].scale or 0.0 for drawn in drawings)
        for result, drawn in zip(some, drawings, strict=True):
            p_correct, spec = float(result.scored.p_correct[row]), result.enhancement.spec
            examples.append(example_of(dataset, trial, p_correct, *drawn(white=white), algorithm=spec))
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
