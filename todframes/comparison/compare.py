"""The calls `compare` and `compare_frames`: thresholds of several conditions, over those of the first."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from functools import partial
from inspect import signature
from itertools import chain, starmap
from pathlib import Path
from typing import Any

from msgspec import structs
from numpy.typing import ArrayLike

from todframes.base._typing import Json
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import checked
from todframes.base.seeds import Rng, seed_of
from todframes.comparison.conditions import (
    check_before_scoring,
    comparable,
    names_of,
    of_result,
    opened_condition,
    pixel_of_sizes,
    split_by,
)
from todframes.comparison.ratios import Compared, Measured, compare_measured
from todframes.comparison.records import (
    NO_DIFFERENCE,
    ComparedCondition,
    Comparison,
    JudgedBy,
    bands_changed,
    basis_of,
    comparisons,
    frame_warnings,
    named,
    not_proportional,
    thresholds_of,
)
from todframes.comparison.seen import Seen, compare_examples, unchanged, with_bands, with_frames
from todframes.comparison.viewing import differences
from todframes.display.display import Display
from todframes.enhancement.enhanced_frame import AlgorithmDisplay
from todframes.enhancement.finding import find_enhancement
from todframes.enhancement.scored_algorithms import score_algorithms
from todframes.frames.dataset import Dataset
from todframes.jobs.rows import Rows
from todframes.jobs.run import opened_run
from todframes.jobs.work import Engine
from todframes.observers.interface import Observer
from todframes.parameters import (
    MAX_FRAME_MB,
    Algorithms,
    Cluster,
    ColumnName,
    ConditionPath,
    Count,
    CurveName,
    Decisions,
    FrameLimit,
    Gazes,
    Locate,
    ObserverNames,
    OnError,
    PlanName,
    Progress,
    Seed,
)
from todframes.psychometrics.fit import FitSettings
from todframes.results.advice import levels_to_add
from todframes.results.data import Fit, ResultWarning
from todframes.results.result import Result
from todframes.results.tables import Table
from todframes.results.thresholds import Thresholds
from todframes.results.wording import size_column
from todframes.scoring.naked_eye import contrast_threshold
from todframes.scoring.opening import each_once, gazes_of, in_memory, inspected, of_observer
from todframes.scoring.opening import opened as opened_dataset
from todframes.scoring.plan import explain
from todframes.scoring.score import (
    ScoredDataset,
    fitted_curve,
    score_dataset,
    settings_of_experiment,
    trials_table,
)
from todframes.scoring.trial_scores import scoring_of

SAME_QUALITY = {"psnr": 0.1, "ssim": 0.005}
"""Changes of PSNR in dB, and of SSIM, that count as none up to that."""


@checked
def compare(
    *conditions: ConditionPath | Dataset | Result,
    enhance: str | Algorithms | Callable[..., Any] | Sequence[str | Callable[..., Any]] = (),
    by: ColumnName | None = None,
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
    max_frame_mb: FrameLimit = MAX_FRAME_MB,
    workers: Count = 1,
    cluster: Cluster | Engine | None = None,
    store: Rows | Path | str | None = None,
    examples: bool = True,
    progress: Progress | None = None,
) -> Thresholds:
    """Test whether a camera, display, curve or algorithm has lower thresholds than another, how much, how surely.

    The first condition is the reference. Datasets are scored; results of the commands score, curve, naked-eye, fit
    and calibrate stand beside them as they are. The same trials are compared trial by trial.

    With one dataset, algorithms are compared with the frames as they are. `todframes enhancements` lists those of
    the package. With several observers or gazes, each gives a verdict; the first lines say where they disagree.

    Parameters
    ----------
    *conditions : path, Dataset or Result
        Folders of datasets, and results: result.json or its folder.

        The return values of `load_dataset`, `score` and the like are taken as well.
    enhance : str, function, or iterable of them
        Algorithm, as a further condition of each dataset: NAME, MODULE:FUNCTION (whose code is run), or onnx:FILE
        (a network, which is run), each also with :PARAMETER=VALUE,… behind.

        A function of an image and keyword parameters is taken as well.
    by : str, optional
        Column of groups, such as camera: each of its values is a condition.
    observer : str, Observer, or sequence of them
        Observers by name: pyramid, informative, oriented, csf or others that are registered; or MODULE:CLASS, a
        class of your own, whose code is run; or onnx:FILE, a network of four outputs, which is run.

        Objects are taken as well. The first is that of `conditions`, the others of `observers`, and `verdict`
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
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes, all channels in their own pixel types, at least 8 bytes a
        pixel.
    workers : int
        Processes that share the work.
    cluster : str, optional
        Work on a Dask cluster: the address of its scheduler, tcp://….
    store : path, optional
        Folder for the results of finished trials, as in `score`.
    examples : bool
        Also draw a triangle at threshold, and the eye's own curve, for the page.
    progress : function of two ints, optional
        Called with the number of trials that are done, and of all; finding positions counts apart.

    Returns
    -------
    Result
        Result whose `conditions` have thresholds, ratios to the reference and verdicts, the reference first.

    Raises
    ------
    DataError, FrameError
        If a dataset, a result, a frame or the output of an algorithm cannot be used, or conditions cannot be
        compared.
    SettingsError
        If a setting or an algorithm is invalid.

    Examples
    --------
    >>> import todframes as tod
    >>> def brighter(image, gain=1.2):
    ...     return gain * image
    >>> fit = tod.FitSettings(resamples=200)
    >>> result = tod.compare("sample_frames/enhancement", enhance=[brighter], allow_clipping=True, fit=fit)
    >>> [one.verdict for one in result.conditions]
    [None, 'no difference shown']
    """
    started, seed, fit = time.perf_counter(), seed_of(rng), fit or FitSettings()
    if isinstance(enhance, str) or not isinstance(enhance, Iterable):
        enhance = [enhance]
    enhancements = [find_enhancement(each) for each in enhance]
    given = [opened_condition(each, number, max_frame_mb) for number, each in enumerate(conditions)]
    if len(given) < 2 and by is None and not (given and enhancements):
        alone = f"or one with {argument.enhance} or {argument.by}"
        raise SettingsError(f"conditions: found {len(given)}, expected two or more, {alone}")
    if not fit.resamples:
        raise SettingsError("resamples: found 0, expected 40 or more: a comparison rests on them")
    asked = () if gaze is None else gazes_of(gaze)
    if enhancements and all(isinstance(each, Result) for each in given):
        raise SettingsError(f"{argument.enhance}: found an algorithm and no dataset, expected frames to show it")
    check_before_scoring(given, fit)
    names, is_of_algorithms = names_of(conditions, given), len(given) == 1 and by is None
    curve = fitted_curve(curve, decisions)
    how: Json = {"decisions": decisions, "curve": curve, "plan": plan}
    seen: list[Seen | Result] = []
    with opened_run(workers, cluster, store, progress) as run:
        for name, each in zip(names, given, strict=True):
            if isinstance(each, Result):
                seen.append(each)
                continue
            first_gaze = asked[0] if asked else None
            looks = opened_dataset(
                each, observer, gaze=first_gaze, locate=locate, on_error=on_error, progress=progress
            )
            screen = AlgorithmDisplay(looks.data.display, white, allow_clipping)
            all_of = how | {"seed": seed, "skip_bad_frames": on_error == "skip", "run": run}
            all_of["fit_settings"] = settings_of_experiment(fit, looks.data.experiment)
            gazes = asked or (looks.data.gaze,)
            if enhancements:
                results = score_algorithms(
                    looks.data, looks.observers, enhancements, gazes=gazes, screen=screen, **all_of
                )
            else:
                results = [
                    [unchanged(score_dataset(replace(looks.data, gaze=own), judge, **all_of))]
                    for judge in looks.observers
                    for own in gazes
                ]
            each_settings = [own | {"gaze": own_gaze} for own in looks.settings for own_gaze in gazes]
            seen.append(Seen("" if is_of_algorithms else name, looks, screen, each_settings, results))
    judged, basis, way = list[JudgedBy](), list[str](), "group" if locate is True else locate or None
    found = [each for each in seen if isinstance(each, Seen)]
    views: list[Json] = found[0].settings if found else [each.settings for each in given[:1]]  # type: ignore[union-attr]
    for view, settings in enumerate(views):
        measured: list[Measured] = []
        for name, one in zip(names, seen, strict=True):
            measured += [of_result(one, name)] if isinstance(one, Result) else one.measured(view, fit)
        if by is not None:
            measured = [part for condition in measured for part in split_by(condition, by)]
        measured, changed = comparable(measured)
        shown = differences([(one.name, one.viewing) for one in measured])
        compared = compare_measured(measured, seed=seed, weighted=not is_of_algorithms)
        records = [_record(*pair) for pair in zip(measured, [None, *compared], strict=True)]
        judged.append(JudgedBy(settings=settings, conditions=tuple(records)))
        basis += [] if is_of_algorithms else [*basis_of(records, compared), *changed]
    each_observer = named(judged)
    first, advice = each_observer[0][1].conditions, list(starmap(_advice, each_observer)) if found else [()]
    more, make_trials = _of_datasets(found, decisions=decisions, plan=plan, seed=seed)
    pictured = [with_frames(*pair, max_frame_mb) for pair in zip(names, seen, strict=True)] if examples else []
    if those := [each for each in pictured if each is not None]:
        more["eye"] = _eye(those[0].looks.observers[0], first[0].fits)
        more["examples"] = compare_examples(those, first) if by is None else ()
        first = with_bands(those, first) if by is None else first
    result = Comparison.made(
        "compare",
        started,
        settings=views[0]
        | (asdict(fit) | how | {"locate": way, "white": white, "allow_clipping": allow_clipping} if found else {})
        | ({} if is_of_algorithms else {"by": by, "conditions": names}),
        seed=seed,
        conditions=first,
        observers=tuple(of_judge for _, of_judge in each_observer[1:]),
        verdict=(*shown, *comparisons(each_observer), *bands_changed(() if is_of_algorithms else first)),
        basis=tuple(dict.fromkeys(basis)),
        warnings=(
            *each_once(*more.pop("warnings"), *advice[0], *not_proportional(first)),
            *frame_warnings(first),
            *chain(*advice[1:]),
        ),
        from_store=run.n_from_store,
        **more,
    )
    return result if make_trials is None else result.holding(make_trials=make_trials)


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
    return compare(in_memory(frames, display, **shown), enhance=enhance, **settings)


def _record(condition: Measured, compared: Compared | None) -> ComparedCondition:
    """Return the record of a condition, with the measures of image quality that contradict its verdict."""
    ratios, overall, by, *_ = compared or ((), None, None)
    verdict = overall.verdict if overall else ratios[0].verdict if ratios else None
    keys = {"psnr": "psnr_change_db", "ssim": "ssim_change"}
    changes = {name: condition.measures.get(key) for name, key in keys.items()}
    opinions = {
        name: NO_DIFFERENCE if abs(change) < SAME_QUALITY[name] else "better" if change > 0 else "worse"
        for name, change in changes.items()
        if change is not None
    }
    disagrees = tuple(name for name, opinion in opinions.items() if opinion != verdict) if verdict else ()
    own: Json = {"name": condition.name, "fits": condition.fits, "ratios": ratios, "overall": overall, "by": by}
    own |= {"pixel_size": pixel_of_sizes(condition)}
    return ComparedCondition(**condition.measures | own, verdict=verdict, disagrees=disagrees)


def _eye(judge: Observer, fits: Sequence[Fit]) -> tuple[Fit, ...]:
    """Return thresholds without a display, where levels are contrasts and sizes are angles at the eye."""
    if size_column(fits) != "size_mrad" or fits[0].level != "contrast":
        return ()
    sizes = sorted({float(fit.group["size_mrad"]) for fit in fits})
    try:
        found = [contrast_threshold(judge, size_mrad=size, p_correct=fits[0].p_correct) for size in sizes]
    except SettingsError:
        return ()  # it is not linear
    return tuple(
        Fit.of_computed({"size_mrad": size}, "contrast", fits[0].p_correct, threshold)
        for size, threshold in zip(sizes, found, strict=True)
    )


def _advice(name: str, judged: JudgedBy) -> tuple[ResultWarning, ...]:
    """Return warnings about levels to add for an observer."""
    levels = levels_to_add(thresholds_of(judged.conditions), judged.settings.get("aperture_sd_deg"))
    return of_observer(name, levels)


def _of_datasets(
    seen: Sequence[Seen], *, decisions: Decisions, plan: PlanName, seed: int
) -> tuple[Json, Callable[[], Table] | None]:
    """Return parts of the result that are about the datasets, and a function that makes the table of trials; None
    if they cannot stand in one table.
    """
    more: Json = {"warnings": [], "skipped": (), "negative_luminance_pixels": None}
    parts: list[tuple[Json, ScoredDataset]] = []
    for each in seen:
        data, scored, group = (
            each.looks.data,
            each.results[0][0].scored,
            {"condition": each.name} if each.name else {},
        )
        record, shown_wrong = inspected(data, scored.trials, each.looks.observers[0].centre)
        warnings = each_once(*each.looks.location_warnings(scored), *shown_wrong)
        more["warnings"] += [structs.replace(warning, group=group | warning.group) for warning in warnings]
        more["skipped"] += tuple(group | skipped._asdict() for skipped in scored.skipped)
        more["negative_luminance_pixels"] = (more["negative_luminance_pixels"] or 0) + scored.n_negative
        for located in each.looks.extra_fields.get("located", ()):
            more["located"] = (*more.get("located", ()), located | {"group": group | located["group"]})
        if not each.name:
            more |= {"dataset": record, "data_range_cd_m2": each.screen.data_range_cd_m2}
        names = each.names() if each.name else [one.enhancement.spec for one in each.results[0]]
        parts += [({"condition": name}, one.scored) for name, one in zip(names, each.results[0], strict=True)]
    if not seen:
        return more, None
    data, judge = seen[0].looks.data, seen[0].looks.observers[0]
    scoring = scoring_of(data, judge, plan=plan, decisions=decisions, seed=seed)
    more["plan"] = explain(scoring, parts[0][1].trials)
    is_one_table = all(each.looks.data.experiment == data.experiment for each in seen)
    return more, partial(trials_table, data, parts) if is_one_table else None
