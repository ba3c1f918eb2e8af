"""The calls `score` and `score_frames`: thresholds of frames in a folder or in memory."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike

from todframes.base.reading import checked
from todframes.base.seeds import Rng, seed_of
from todframes.diagnosis.findings import MISTAKES
from todframes.diagnosis.inspection import sampled
from todframes.display.display import Display
from todframes.frames.contrast import HoldingDataset
from todframes.frames.dataset import Dataset
from todframes.jobs.rows import Rows
from todframes.jobs.run import opened_run
from todframes.jobs.work import Engine
from todframes.observers.interface import Observer
from todframes.parameters import (
    Cluster,
    Count,
    CurveName,
    Decisions,
    Gaze,
    Locate,
    ObserverName,
    ObserverNames,
    OnError,
    PlanName,
    Progress,
    Seed,
    Tolerance,
)
from todframes.psychometrics.fit import FitSettings
from todframes.results.advice import levels_to_add, numerical_errors
from todframes.results.data import observer_names
from todframes.results.thresholds import Thresholds
from todframes.scoring.opening import each_once, in_memory, inspected, opened


@checked
def score(
    dataset: Path | str | Dataset,
    *,
    observer: ObserverName | Observer = "pyramid",
    decisions: Decisions = "expected",
    curve: CurveName | None = None,
    tolerance: Tolerance | None = None,
    plan: PlanName = "needed",
    rng: Seed | Rng = 1,
    fit: FitSettings | None = None,
    locate: Locate | bool = False,
    gaze: Gaze | None = None,
    on_error: OnError = "stop",
    workers: Count = 1,
    cluster: Cluster | Engine | None = None,
    store: Rows | Path | str | None = None,
    relative_to: str | ObserverNames | Observer | Sequence[str | Observer] = (),
    examples: bool = True,
    progress: Progress | None = None,
) -> Thresholds:
    """Score the display frames of a dataset and fit its thresholds.

    Parameters
    ----------
    dataset : path, str or Dataset
        Folder with dataset.toml, manifest.csv and frames.

        The return value of `load_dataset` is taken as well.
    observer : str or Observer
        Observer by name: pyramid, informative, oriented, csf or another that is registered; or MODULE:CLASS, a
        class of your own, whose code is run; or onnx:FILE, a network of four outputs, which is run.

        An object is taken as well: `PyramidObserver(internal_noise=0.25)`.
    decisions : {"expected", "sampled"}
        Use each frame's probability of a correct answer, or draw one answer for each trial.
    curve : {"observer", "weibull"}, optional
        Psychometric function of the thresholds: the observer's own, which needs expected decisions, or Weibull's,
        as for people. Default: observer for expected decisions, weibull for sampled ones.
    tolerance : float, optional
        Relative error of the thresholds that displacing the retina may cause: each frame is seen with as many
        displacements as that takes. Default: one displacement for each frame.
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
    gaze : {"tracked", "fixed"}, optional
        Where the observer looks while a triangle moves: at its place in each frame, or at its mean place in the
        trial, so that it sees the motion as blur. Default: tracked.

        A `Dataset` has its own default.
    on_error : {"stop", "skip"}
        At a frame or row that cannot be used: end with an error, or go on and list it among the skipped ones.
    workers : int
        Processes that share the work.
    cluster : str, optional
        Work on a Dask cluster: the address of its scheduler, tcp://….
    store : path, optional
        Folder for the results of finished trials, so that an interrupted run can be continued. It is written from
        the first finished trials on. The caller has to remove it.
    relative_to : str, Observer, or sequence of them
        Other observers, with their default settings, that look at the same frames: the result has the efficiency
        relative to each, (its threshold ÷ the observer's threshold)².

        Objects are taken as well.
    examples : bool
        Also draw a triangle at threshold, for the page.
    progress : function of two ints, optional
        Called with the number of trials that are done, and of all; finding positions and further observers count
        apart.

    Returns
    -------
    Result
        Thresholds of each group, scores of each trial, warnings and settings.

    Raises
    ------
    DataError, FrameError
        If the dataset or a frame cannot be used.
    SettingsError
        If a setting is invalid.

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.score("sample_frames/naked_eye", observer=tod.PyramidObserver(internal_noise=0.25))
    >>> result.thresholds[0].group, result.thresholds[0].status
    ({'size_mrad': 0.6}, 'extrapolated')
    """
    started, seed = time.perf_counter(), seed_of(rng)
    from todframes.scoring.plan import explain
    from todframes.scoring.score import fit_record, fitted_curve, score_dataset, trials_table
    from todframes.scoring.trial_scores import scoring_of

    fit = fit or FitSettings()
    others = relative_to.split(",") if isinstance(relative_to, str) else relative_to
    asked = [observer, *(others if isinstance(others, Sequence) else [others])]
    data, observers, each_settings, locate_mode, extra_fields, location_warnings = opened(
        dataset, asked, gaze=gaze, locate=locate, on_error=on_error, progress=progress
    )
    first, settings = observers[0], each_settings[0]
    decoded = data
    if workers == 1 and cluster is None:  # what the frames show is measured on pixels that scoring decodes
        measured = (trial for trials, _ in sampled(data, data.trials) for trial in trials)
        decoded = HoldingDataset.of(data, measured, first.centre)
    with opened_run(workers, cluster, store, progress) as run:
        how = partial(
            score_dataset,
            decoded,
            decisions=decisions,
            curve=curve,
            seed=seed,
            fit_settings=fit,
            tolerance=tolerance,
            plan=plan,
            skip_bad_frames=on_error == "skip",
            run=run,
        )
        scored, *beside = [how(observer=each) for each in observers]
    if beside:
        from todframes.scoring.paired import efficiencies

        named = list(zip(observer_names(each_settings[1:]), beside, strict=True))
        extra_fields["efficiencies"] = efficiencies(data, scored, named, seed=seed, fit_settings=fit)
    if examples:
        from todframes.scoring.examples import examples as drawn

        extra_fields["examples"] = drawn(data, scored, first)
    fits = tuple(fit_record(data, group_fit, scored) for group_fit in scored.fits)
    record, shown_wrong = inspected(decoded, scored.trials, first.centre)
    # With a mistake mended, other levels may be near the threshold.
    wrong = [warning.group.items() for warning in shown_wrong if warning.code in MISTAKES]
    right = [fit for fit in fits if not any(group <= fit.group.items() for group in wrong)]
    levels = levels_to_add(right, settings.get("aperture_sd_deg"))
    return Thresholds.made(
        "score",
        started,
        settings=settings
        | asdict(fit)
        | {"decisions": decisions, "curve": fitted_curve(curve, decisions), "locate": locate_mode}
        | {"tolerance": tolerance, "plan": plan, "gaze": data.gaze},
        seed=seed,
        fits=fits,
        plan=explain(scoring_of(data, first, plan=plan, decisions=decisions, seed=seed), scored.trials),
        skipped=tuple(skipped._asdict() for skipped in scored.skipped),
        dataset=record,
        warnings=each_once(*location_warnings(scored), *shown_wrong, *levels, *numerical_errors(fits, tolerance)),
        negative_luminance_pixels=scored.n_negative,
        from_store=run.n_from_store,
        **extra_fields,
    ).holding(make_trials=lambda: trials_table(data, [({}, scored)]))


@checked
def score_frames(
    frames: Iterable[ArrayLike],
    *,
    orientation: str | Sequence[str],
    level: float | Sequence[float],
    size_mrad: float | Sequence[float],
    display: Display | str,
    group: Mapping[str, float | str | Sequence[float | str]] | None = None,
    position: ArrayLike | None = None,
    polarity: int | Sequence[int] = 1,
    trial: str | Sequence[object] | None = None,
    level_name: str = "contrast",
    clip: str | Sequence[str | None] | None = None,
    time_s: float | Sequence[float] | None = None,
    judged: bool | Sequence[bool] | None = None,
    **settings: Any,
) -> Thresholds:
    """Score frames that are in memory and fit their thresholds, without touching a disk.

    An argument that has a value for each frame may also be one value for all frames.

    Parameters
    ----------
    frames : array_like, shape (n, rows, columns), or iterable of n arrays (rows, columns)
        Code values or luminance, according to `display`; (rows, columns, 3) for colour. Integers of 8 and 16 bits
        are divided by their full scale.
    orientation : str or sequence of str
        Direction of the apex: "up", "right", "down" or "left".
    level : float or sequence of float
        Stimulus strength, > 0.
    size_mrad : float or sequence of float
        √(area) of the triangle as displayed, in mrad of visual angle.
    display : Display or str
        Conversion of code values to luminance, and the visual angle of a pixel; or the name of a display of this
        package, such as "reference_sdr", or of a file that describes one.
    group : mapping, optional
        Columns of n values each by name; frames with the same values share a curve. Default: one curve for each
        size.
    position : array_like, shape (2,) or (n, 2), optional
        x and y of the triangle's centroid in pixels; (0, 0) is the centre of the top left one. Default: the middle
        of the frame.
    polarity : int or sequence of int
        1 brighter or -1 darker than the background.
    trial : sequence, optional
        Names of trials: frames of one trial are averaged in contrast before the observer sees them. Default: each
        frame is a trial.
    level_name : str
        Name of the level, for tables and pictures.
    clip : str or sequence of str, optional
        Names of continuous recordings, in which the triangle may move: frames of one stand in the order of time.
    time_s : sequence of float, optional
        Time of each frame in its clip, in seconds; needed with `clip`.
    judged : sequence of bool, optional
        False for frames that are in no trial, and only come before one in their clip. Default: all are judged.
    **settings
        Settings as for `score`: observer, decisions, rng, fit, locate, workers and so on.

    Returns
    -------
    Result
        Thresholds of each group, scores of each trial, warnings and settings.

    Raises
    ------
    DataError
        If there are no frames, an argument has another number of values, or a value is out of its range.
    FrameError
        If a frame cannot be used; the message gives its number, from 0.
    SettingsError
        If a setting is invalid.

    Examples
    --------
    >>> import numpy as np
    >>> import todframes as tod
    >>> shown = [(turn, level) for level in (0.02, 0.05, 0.1, 0.2, 0.4) for turn in tod.ORIENTATIONS]
    >>> middle = {"size_px": 6, "x_px": 31.5, "y_px": 31.5}
    >>> frames = [50 * (1 + level * tod.coverage((64, 64), orientation=turn, **middle)) for turn, level in shown]
    >>> display = tod.Display(
    ...     eotf="linear", white_luminance_cd_m2=1, pixel_pitch_mrad=0.25, background_luminance_cd_m2=50
    ... )
    >>> orientation, level = zip(*shown)
    >>> result = tod.score_frames(frames, orientation=orientation, level=level, size_mrad=1.5, display=display)
    >>> result.thresholds[0].status
    'ok'
    """
    data = in_memory(
        frames,
        display,
        orientation=orientation,
        level=level,
        size_mrad=size_mrad,
        group=group,
        position=position,
        polarity=polarity,
        trial=trial,
        level_name=level_name,
        clip=clip,
        time_s=time_s,
        judged=judged,
    )
    return score(data, **settings)
