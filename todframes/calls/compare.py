"""The call `compare`: thresholds with and without enhancement algorithms."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from todframes.base.locations import Location
from todframes.base.seeds import Rng, seed_of
from todframes.calls.shared import (
    OnError,
    Progress,
    background_of,
    described_each,
    each_once,
    gazes_of,
    in_memory,
    inspected,
    is_skip,
    knowing_background,
    loaded,
    located,
    of_observer,
    opened_run,
)
from todframes.display.display import Display
from todframes.frames.dataset import Dataset, Gaze
from todframes.jobs.work import Engine
from todframes.observers.interface import Observer
from todframes.psychometrics.fit import CurveName, FitSettings
from todframes.report.advice import levels_to_add, not_proportional
from todframes.report.data import (
    ComparedObserver,
    algorithms,
    observer_names,
    thresholds_of,
)
from todframes.report.result import Result
from todframes.scoring.error_budget import PlanName, plan_object
from todframes.scoring.seen_trials import Decisions

if TYPE_CHECKING:
    from todframes.diagnosis.locate import Locate
    from todframes.jobs.store import Store


def compare(
    dataset: Location | str | Dataset,
    enhance: Iterable[str | Callable[..., Any]],
    *,
    observer: str | Observer | Sequence[str | Observer] = "pyramid",
    white: float = 1.0,
    allow_clipping: bool = False,
    decisions: Decisions = "expected",
    curve: CurveName | None = None,
    plan: PlanName = "needed",
    rng: Rng = 1,
    fit: FitSettings | None = None,
    locate: Locate | bool = False,
    gaze: str | Sequence[Gaze] = "tracked",
    on_error: OnError = "stop",
    workers: int = 1,
    cluster: str | Engine | None = None,
    store: Store | Path | str | None = None,
    examples: bool = True,
    progress: Progress | None = None,
) -> Result:
    """Test whether enhancement algorithms lower the thresholds of a dataset, as `todframes compare` does.

    Each algorithm is compared with the frames as they are, on the same frames and with the same random draws.

    Parameters
    ----------
    dataset, decisions, curve, plan, rng, fit, locate, on_error, workers, cluster, store, examples, \
    progress
        Parameters as in `score`.
    observer : str, Observer, or sequence of them
        As in `score`; several, also named as "pyramid,csf", each give a verdict on the same frames. The first is
        that of `algorithms`, the others of `observers`, and `verdict` begins with where they disagree.
    gaze : {"tracked", "fixed"} or sequence of them
        As in `score`. With both, also named as "tracked,fixed", each observer gives a verdict for each, as if it
        were two.
    enhance : iterable of str or function
        Algorithms: "name" of a registered one, "module:function" or "onnx:file", optionally followed by
        ":parameter=value,…"; or functions of an image and keyword parameters.
    white : float
        Code value of white for the algorithms.
    allow_clipping : bool
        Clip values beyond the display's range in the output of an algorithm, instead of raising.

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
    started, seed = time.perf_counter(), seed_of(rng)
    from todframes.enhancement.compare import compare_observers
    from todframes.enhancement.enhanced_frame import AlgorithmDisplay
    from todframes.enhancement.finding import find_enhancement
    from todframes.report import tables
    from todframes.report.summary import comparison, comparisons

    fit = fit or FitSettings()
    found = [find_enhancement(one) for one in enhance]
    gazes = gazes_of(gaze)
    data = replace(loaded(dataset), gaze=gazes[0])
    judges, each_settings = described_each(observer, lambda: background_of(data))
    judge, settings = judges[0], each_settings[0]
    screen = AlgorithmDisplay(data.display, white, allow_clipping)
    data, more, placed_wrong = located(data, judge, locate, on_error, progress)
    known = [knowing_background(*one, data) for one in zip(judges, each_settings, strict=True)]
    judges, each_settings = [one for one, _ in known], [own for _, own in known]
    judge = judges[0]
    each_settings = [own | {"gaze": one} for own in each_settings for one in gazes]
    settings = each_settings[0]
    with opened_run(workers, cluster, store, progress) as run:
        results, *others = compare_observers(
            data,
            judges,
            found,
            gazes=gazes,
            decisions=decisions,
            curve=curve,
            seed=seed,
            fit_settings=fit,
            screen=screen,
            plan_name=plan,
            skip_bad_frames=is_skip(on_error),
            run=run,
        )
    reference, compared = results[0].scored, algorithms(data, results)
    further = tuple(
        ComparedObserver(settings=own, algorithms=algorithms(data, one))
        for own, one in zip(each_settings[1:], others, strict=True)
    )
    names = observer_names(settings, further) if further else [None]
    advice = [
        of_observer(name, levels_to_add(thresholds_of(of_each)))
        for name, of_each in zip(names, [compared, *(one.algorithms for one in further)], strict=True)
    ]
    if examples:
        from todframes.report.examples import compare_examples

        more["examples"] = compare_examples(data, results, judge, screen)
    black, peak = screen.luminance_range
    record, shown_wrong = inspected(data, reference.trials, judge.centre)
    return Result.made(
        "compare",
        started,
        settings=settings
        | asdict(fit)
        | {"decisions": decisions, "plan": plan, "white": white, "allow_clipping": allow_clipping},
        seed=seed,
        algorithms=compared,
        observers=further,
        data_range_cd_m2=peak - black,
        verdict=comparisons(settings, compared, further) if further else comparison(compared),
        plan=tuple(plan_object(reference.plan, 1.0)),
        skipped=tuple(one._asdict() for one in reference.skipped),
        dataset=record,
        warnings=(
            *each_once(*placed_wrong(reference), *shown_wrong, *advice[0], *not_proportional(compared)),
            *sum(advice[1:], ()),
        ),
        negative_luminance_pixels=reference.n_negative,
        from_store=run.n_from_store,
        **more,
    ).with_trials(lambda: tables.compared_trials(data, results))


def compare_frames(
    frames: Iterable[ArrayLike],
    enhance: Iterable[str | Callable[..., Any]],
    *,
    display: Display | str,
    **settings: Any,
) -> Result:
    """Compare enhancement algorithms on frames that are in memory, without touching a disk.

    Parameters
    ----------
    frames : array_like, shape (n, rows, columns), or iterable of n arrays (rows, columns)
        Frames as in `score_frames`.
    enhance : iterable of str or function
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
