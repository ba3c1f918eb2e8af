"""The call `compare`: thresholds with and without enhancement algorithms."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from todframes.base.errors import SettingsError, argument
from todframes.base.seeds import Rng, seed_of
from todframes.display.display import Display
from todframes.enhancement.compare import compare_examples, compare_observers
from todframes.enhancement.comparison import JudgedBy, comparisons, frame_warnings, not_proportional, thresholds_of
from todframes.enhancement.enhanced_frame import AlgorithmDisplay
from todframes.enhancement.finding import find_enhancement
from todframes.frames.dataset import Dataset
from todframes.jobs.run import opened_run
from todframes.jobs.work import Engine
from todframes.observers.interface import Observer
from todframes.parameters import (
    Algorithms,
    Cluster,
    Count,
    CurveName,
    Decisions,
    Gazes,
    ObserverNames,
    OnError,
    PlanName,
    Progress,
    Seed,
)
from todframes.psychometrics.fit import FitSettings
from todframes.results.advice import levels_to_add
from todframes.results.data import observer_names
from todframes.results.result import Result, repeatable
from todframes.scoring.error_budget import plan_object
from todframes.scoring.opening import each_once, gazes_of, in_memory, inspected, is_skip, of_observer, opened
from todframes.scoring.records import trials_table
from todframes.scoring.score import fitted_curve

if TYPE_CHECKING:
    from todframes.jobs.store import Store
    from todframes.parameters import Locate
    from todframes.results.thresholds import Thresholds


@repeatable
def compare(
    dataset: Path | str | Dataset,
    enhance: Algorithms | Callable[..., Any] | Iterable[str | Callable[..., Any]],
    *,
    observer: ObserverNames | Observer | Sequence[str | Observer] = "pyramid",
    white: float = 1.0,
    allow_clipping: bool = False,
    decisions: Decisions = "expected",
    curve: CurveName | None = None,
    plan: PlanName = "needed",
    rng: Seed | Rng = 1,
    fit: FitSettings | None = None,
    locate: Locate | bool = False,
    gaze: str | Gazes = "tracked",
    on_error: OnError = "stop",
    workers: Count = 1,
    cluster: Cluster | Engine | None = None,
    store: Store | Path | str | None = None,
    examples: bool = True,
    progress: Progress | None = None,
) -> Result[Thresholds]:
    """Test whether enhancement algorithms lower the thresholds of a dataset, by how much and how surely.

    Each algorithm is compared with the frames as they are, on the same frames and with the same random draws.
    `todframes enhancements` lists the algorithms of the package. With several observers or gazes, each gives a
    verdict, and the first lines say where they disagree.

    Parameters
    ----------
    dataset : path, str or Dataset
        Folder with dataset.toml, manifest.csv and frames, or its URL, such as s3://lab/archive.

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
    gaze : {"tracked", "fixed"} or sequence of them
        Where the observer looks while a triangle moves: at its place in each frame (tracked), or at its mean place
        in the trial, so that it sees the motion as blur (fixed); or both.
    on_error : {"stop", "skip"}
        At a frame or row that cannot be used: end with an error, or go on and list it among the skipped ones. A
        trial that cannot be used with one algorithm is left out for all.
    workers : int
        Processes that share the work.

        With more than one, a script calls this below `if __name__ == "__main__":`, because they import the script.
    cluster : str, optional
        Work on a Dask cluster: the address of its scheduler, tcp://…, or local:N for N processes of this machine.
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
    started, seed = time.perf_counter(), seed_of(rng)
    fit = fit or FitSettings()
    if isinstance(enhance, str) or not isinstance(enhance, Iterable):
        enhance = [enhance]
    found = [find_enhancement(one) for one in enhance]
    if not found:
        raise SettingsError(f"{argument.enhance}: found none, expected one algorithm or more")
    gazes = gazes_of(gaze)
    data, judges, of_judges, way, more, placed_wrong = opened(
        dataset, observer, gaze=gazes[0], locate=locate, on_error=on_error, progress=progress
    )
    screen = AlgorithmDisplay(data.display, white, allow_clipping)
    each_settings = [own | {"gaze": own_gaze} for own in of_judges for own_gaze in gazes]
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
    reference, compared = results[0].scored, tuple(one.record for one in results)
    further = tuple(
        JudgedBy(settings=own, algorithms=tuple(one.record for one in after))
        for own, after in zip(each_settings[1:], others, strict=True)
    )
    names = observer_names(each_settings) if further else [""]
    judged = list(zip(names, [compared, *(one.algorithms for one in further)], strict=True))
    advice = [
        of_observer(name, levels_to_add(thresholds_of(of_each), own.get("aperture_sd_deg")))
        for (name, of_each), own in zip(judged, each_settings, strict=True)
    ]
    if examples:
        more["examples"] = compare_examples(data, results, judges[0], screen)
    black, peak = screen.luminance_range
    scored = [({"algorithm": one.enhancement.spec}, one.scored) for one in results]
    record, shown_wrong = inspected(data, reference.trials, judges[0].centre)
    return Result.made(
        "compare",
        started,
        settings=each_settings[0]
        | asdict(fit)
        | {"decisions": decisions, "curve": fitted_curve(curve, decisions), "locate": way}
        | {"plan": plan, "white": white, "allow_clipping": allow_clipping},
        seed=seed,
        algorithms=compared,
        observers=further,
        data_range_cd_m2=peak - black,
        verdict=comparisons(judged),
        plan=tuple(plan_object(reference.plan, 1.0)),
        skipped=tuple(one._asdict() for one in reference.skipped),
        dataset=record,
        warnings=(
            *each_once(*placed_wrong(reference), *shown_wrong, *advice[0], *not_proportional(compared)),
            *frame_warnings(compared),
            *sum(advice[1:], ()),
        ),
        negative_luminance_pixels=reference.n_negative,
        from_store=run.n_from_store,
        **more,
    ).holding(make_trials=partial(trials_table, data, scored))


def compare_frames(
    frames: Iterable[ArrayLike],
    enhance: str | Callable[..., Any] | Iterable[str | Callable[..., Any]],
    *,
    display: Display | str,
    **settings: Any,
) -> Result[Thresholds]:
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
