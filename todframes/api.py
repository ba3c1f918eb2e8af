"""The Python calls behind the commands: each returns a `Result` with the same numbers as its command."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from msgspec.structs import replace as replace_struct
from numpy.typing import ArrayLike

from todframes._typing import Json
from todframes.diagnosis.findings import frame_warnings
from todframes.diagnosis.inspection import inspect, records
from todframes.errors import DataError, SettingsError
from todframes.frames.checksums import dataset_warnings
from todframes.frames.dataset import Dataset, load_dataset
from todframes.frames.display import Display
from todframes.frames.trials import Trial
from todframes.jobs.engine import open_engine
from todframes.jobs.store import Store
from todframes.jobs.work import Engine
from todframes.locations import Location
from todframes.observers.interface import ENTRY_POINT_GROUP, Observer, find_observer
from todframes.psychometrics.fit import CurveName, FitSettings
from todframes.psychometrics.fit import fit_counts as fit_counts_of_one
from todframes.report.advice import above_contrast_1, levels_to_add
from todframes.report.data import (
    DatasetRecord,
    Fit,
    Group,
    PersonResult,
    ResultWarning,
    algorithms,
    group_of,
    thresholds_of,
)
from todframes.report.result import Result
from todframes.scoring.error_budget import PlanName, plan_object
from todframes.scoring.trials import Decisions
from todframes.stimulus import Centre

if TYPE_CHECKING:
    from todframes.diagnosis.locate import Locate
    from todframes.experiment.person import Free, GroupCurve, PersonFit
    from todframes.frames.files import PathLike
    from todframes.report.noise import NoiseResult
    from todframes.scoring.naked_eye import Threshold
    from todframes.scoring.work import Run

OnError = Literal["stop", "skip"]


Progress = Callable[[int], None]


def score(
    dataset: Location | str | Dataset,
    *,
    observer: str | Observer = "pyramid",
    decisions: Decisions = "expected",
    curve: CurveName | None = None,
    tolerance: float | None = None,
    plan: PlanName = "needed",
    seed: int = 1,
    p_correct: float | None = None,
    fit: FitSettings | None = None,
    locate: Locate | bool = False,
    on_error: OnError = "stop",
    workers: int = 1,
    cluster: str | Engine | None = None,
    store: Store | Path | str | None = None,
    examples: bool = True,
    progress: Progress | None = None,
) -> Result:
    """Score the display frames of a dataset and fit its thresholds, as `todframes score` does.

    Parameters
    ----------
    dataset : path, str or Dataset
        Folder with dataset.toml, manifest.csv and frames, its URL ("s3://lab/archive"), or the return value of
        `load_dataset`.
    observer : str or Observer
        Name of a registered observer, "module:Class", or an observer: `PyramidObserver(internal_noise=0.25)`.
    decisions : {"expected", "sampled"}
        Use each frame's probability of a correct answer, or draw one answer for each trial.
    curve : {"observer", "weibull"}, optional
        Psychometric function of the thresholds: the observer's own, which needs expected decisions, or Weibull's,
        as for people's answers. Default: the observer's for expected decisions, Weibull's for sampled ones.
    tolerance : float, optional
        Largest relative error of the thresholds that displacing the retina may cause. The number of displacements
        of each frame is chosen to meet it. Default: one displacement for each frame.
    plan : {"needed", "full"}
        Leave out the computations that the scene does not need, or leave out none.
    seed : int
        Seed of all random draws.
    p_correct : float, optional
        Raw proportion correct at threshold, in place of that of `fit`.
    fit : FitSettings, optional
        Fixed and free parameters of the fits.
    locate : {"group", "each"} or bool
        Find the triangle's position, from that in the manifest if there is one: one for each group (also True), or
        one for each trial, for hand-held or drifting recordings.
    on_error : {"stop", "skip"}
        At a frame or row that cannot be used: raise, or go on and list it in `Result.skipped`.
    workers : int
        Threads that read and score.
    cluster : str, optional
        Address of a Dask scheduler, "tcp://…", or "local:N" for N processes; they do the work instead.
    store : path, optional
        Folder for the results of single trials as they are finished, so that a run that was interrupted goes on
        where it was. It is written once the run turns out to take more than some seconds, and is the caller's to
        remove.
    examples : bool
        Also draw a triangle at threshold, for the page.
    progress : function of an int, optional
        Called with the number of trials that were just done; each trial is done once more with `locate`,
        and twice more with "each".

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
    started = time.perf_counter()
    from todframes.diagnosis.missing_threshold import explain_missing
    from todframes.report import tables
    from todframes.scoring.score import score_dataset

    judge, settings = described(observer)
    fit = _fit_settings(fit, p_correct)
    data, more, found_wrong = _located(dataset, judge, locate, on_error, progress)
    with _run(workers, cluster, store, progress) as run:
        scored = score_dataset(
            data,
            judge,
            decisions=decisions,
            curve=curve,
            seed=seed,
            fit_settings=fit,
            tolerance=tolerance,
            plan_name=plan,
            skip_bad_frames=_is_skip(on_error),
            run=run,
        )
    if examples:
        from todframes.report import examples as drawing

        more["examples"] = drawing.examples(data, scored, judge)
    explained = {one.group: one for one in explain_missing(data, scored, judge, decisions=decisions, seed=seed)}
    fits = tuple(Fit.of_trials(data, one, explained.get(one.group)) for one in scored.fits)
    hints = [
        ResultWarning(**hint._asdict(), group=group_of(data, one.group))
        for one in explained.values()
        for hint in one.hints
    ]
    hinted = [hint.group for hint in hints]  # with a mistake mended, other levels may be near the threshold
    levels = levels_to_add([one for one in fits if one.group not in hinted])
    record, shown_wrong = inspected(data, scored.trials, judge.centre)
    return Result.made(
        "score",
        started,
        settings=settings | asdict(fit) | {"decisions": decisions, "tolerance": tolerance, "plan": plan},
        seed=seed,
        fits=fits,
        plan=tuple(plan_object(scored.plan, 1.0)),
        skipped=tuple(one._asdict() for one in scored.skipped),
        dataset=record,
        warnings=_each_once(*hints, *found_wrong, *shown_wrong, *levels),
        negative_luminance_pixels=scored.n_negative,
        **more,
    ).with_trials(lambda: tables.trials(data, scored))


def score_frames(
    frames: Iterable[ArrayLike],
    *,
    orientation: str | Sequence[str],
    level: float | Sequence[float],
    size_mrad: float | Sequence[float],
    display: Display | str,
    group: Mapping[str, Sequence[float | str]] | None = None,
    position: ArrayLike | None = None,
    polarity: int | Sequence[int] = 1,
    trial: Sequence[object] | None = None,
    level_name: str = "contrast",
    **settings: Any,
) -> Result:
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
    **settings
        Settings as for `score`: observer, decisions, seed, p_correct, locate, workers and so on.

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
    from todframes.frames.display_files import find_display
    from todframes.frames.memory import memory_dataset

    data = memory_dataset(
        frames,
        orientation=orientation,
        level=level,
        size_mrad=size_mrad,
        display=find_display(display).display if isinstance(display, str) else display,
        group=group,
        position=position,
        polarity=polarity,
        trial=trial,
        level_name=level_name,
    )
    return score(data, **settings)


def compare(
    dataset: Location | str | Dataset,
    enhance: Iterable[str | Callable[..., Any]],
    *,
    observer: str | Observer = "pyramid",
    white: float = 1.0,
    allow_clipping: bool = False,
    decisions: Decisions = "expected",
    curve: CurveName | None = None,
    plan: PlanName = "needed",
    seed: int = 1,
    p_correct: float | None = None,
    fit: FitSettings | None = None,
    locate: Locate | bool = False,
    on_error: OnError = "stop",
    workers: int = 1,
    cluster: str | Engine | None = None,
    store: Store | Path | str | None = None,
    examples: bool = True,
    progress: Progress | None = None,
) -> Result:
    """Tell whether enhancement algorithms lower the thresholds of a dataset, as `todframes compare` does.

    Each algorithm is compared with the frames as they are, on the same frames and with the same random draws.

    Parameters
    ----------
    dataset, observer, decisions, curve, plan, seed, p_correct, fit, locate, on_error, workers, cluster, store, \
    examples, progress
        Parameters as in `score`.
    enhance : iterable of str or function
        Algorithms: "name" of a registered one or "module:function", optionally followed by ":parameter=value,…";
        or functions of an image and keyword parameters.
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
    started = time.perf_counter()
    from todframes.enhancement.algorithm import find_enhancement
    from todframes.enhancement.compare import compare_dataset
    from todframes.enhancement.enhanced_frame import Screen
    from todframes.report import tables
    from todframes.report.summary import comparison

    judge, settings = described(observer)
    fit = _fit_settings(fit, p_correct)
    found = [find_enhancement(one) for one in enhance]
    data = _loaded(dataset)
    screen = Screen(data.display, white, allow_clipping)
    data, more, found_wrong = _located(data, judge, locate, on_error, progress)
    with _run(workers, cluster, store, progress) as run:
        results = compare_dataset(
            data,
            judge,
            found,
            decisions=decisions,
            curve=curve,
            seed=seed,
            fit_settings=fit,
            screen=screen,
            plan_name=plan,
            skip_bad_frames=_is_skip(on_error),
            run=run,
        )
    reference, compared = results[0].scored, algorithms(data, results)
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
        data_range_cd_m2=peak - black,
        verdict=comparison(compared),
        plan=tuple(plan_object(reference.plan, 1.0)),
        skipped=tuple(one._asdict() for one in reference.skipped),
        dataset=record,
        warnings=_each_once(*found_wrong, *shown_wrong, *levels_to_add(thresholds_of(compared))),
        negative_luminance_pixels=reference.n_negative,
        **more,
    ).with_trials(lambda: tables.compared_trials(data, results))


def fit_counts(
    level: ArrayLike,
    n_correct: ArrayLike,
    n_trials: ArrayLike,
    *,
    groups: Mapping[str, Sequence[float | str]] | None = None,
    p_correct: float | None = None,
    fit: FitSettings | None = None,
    seed: int = 1,
) -> Result:
    """Fit psychometric functions to counts of correct answers, as `todframes fit` does.

    Parameters
    ----------
    level, n_correct, n_trials : array_like, shape (n,)
        Stimulus strength, > 0; whole numbers with 0 <= n_correct <= n_trials and n_trials >= 1.
    groups : mapping, optional
        Columns of n values each by name; rows with the same values share a curve. Default: one curve.
    p_correct : float, optional
        Raw proportion correct at threshold, in place of that of `fit`.
    fit : FitSettings, optional
        Fixed and free parameters of the fits.
    seed : int
        Seed of the resamples.

    Returns
    -------
    Result
        One threshold and its fitted curve for each group.

    Raises
    ------
    DataError
        If the shapes differ, there is no row, or a value is out of its range.

    Examples
    --------
    >>> import todframes as tod
    >>> result = tod.fit_counts([0.1, 0.2, 0.4, 0.8], [12, 18, 30, 38], [40, 40, 40, 40])
    >>> result
    <Result of fit: At 75 % correct the threshold level is 0.399 (95 % interval 0.315 to 0.528).>
    """
    started = time.perf_counter()
    fit = _fit_settings(fit, p_correct)
    columns = [np.asarray(values) for values in (level, n_correct, n_trials)]
    names = {name: list(values) for name, values in (groups or {}).items()}
    for name, values in names.items():
        if len(values) != columns[0].size:
            raise DataError(f"groups: {name}: found {len(values)} values, expected {columns[0].size}, one a row")
    rows: dict[tuple[float | str, ...], list[int]] = {}
    for row in range(columns[0].size):
        key = tuple(values[row] for values in names.values())
        rows.setdefault(tuple(one if isinstance(one, str) else float(one) for one in key), []).append(row)
    fits = []
    for number, (key, of_group) in enumerate((rows or {(): []}).items()):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
        counts = columns if len(rows) < 2 else [column[of_group] for column in columns]
        one = fit_counts_of_one(*counts, settings=fit, rng=rng)
        fits.append(Fit.of_counts(dict(zip(names, key, strict=True)), "level", one))
    return Result.made(
        "fit", started, settings=asdict(fit), seed=seed, fits=tuple(fits), warnings=levels_to_add(fits)
    )


def calibrate(
    answers: Path | str,
    dataset: Location | str | Dataset,
    *,
    observer: str | Observer = "pyramid",
    free: Sequence[Free] = (),
    subjects: Sequence[str] = (),
    include_flagged: bool = False,
    p_correct: float | None = None,
    fit: FitSettings | None = None,
    seed: int = 1,
    on_error: OnError = "stop",
    workers: int = 1,
    progress: Progress | None = None,
) -> Result:
    """Fit the observer's internal noise to the answers of people, as `todframes calibrate` does.

    Parameters
    ----------
    answers : path
        Folder that `todframes experiment` wrote.
    dataset : path, str or Dataset
        The dataset that was shown.
    observer : str or Observer
        A linear observer with a setting `internal_noise`, whose value is not used.
    free : sequence of {"lapse", "blur"}
        Parameters that are fitted besides: the rate δ of lapses, up to `lapse_rate_max` of `fit`, and the
        observer's `template_blur_samples`, from a quarter to twice its value.
    subjects : sequence of str
        Ids of the persons. Default: all.
    include_flagged : bool
        Whether answers count that came within 150 ms, or while the page was hidden or had lost the focus.
    p_correct : float, optional
        Raw proportion correct at threshold, in place of that of `fit`.
    fit : FitSettings, optional
        Fixed and free parameters of the persons' own curves. A fixed `lapse_rate` is that of the model too.
    seed : int
        Seed of the displacements of the retina and of repeated experiments.
    on_error : {"stop", "skip"}
        At a frame that cannot be used or has changed since: raise, or leave its trials out and list them.
    workers : int
        Threads that read and score.
    progress : function of an int, optional
        Called with the number of trials that were just done.

    Returns
    -------
    Result
        Result whose `persons` have the internal noise of each person and the thresholds that the model then
        has; `pooled` is that of all together. `thresholds` are those of the persons, by their counts alone.

    Raises
    ------
    DataError, FrameError
        If the answers are damaged or to another dataset, or a frame cannot be used or has changed since.
    SettingsError
        If a setting is invalid, or the observer's noise cannot be fitted.
    """
    started = time.perf_counter()
    from todframes.experiment.answers import read_answers
    from todframes.experiment.person import calibrate_persons

    judge, settings = described(observer)
    fit = _fit_settings(fit, p_correct)
    for name in free:
        if name not in ("lapse", "blur"):
            raise SettingsError(f"free: found {name!r}, expected lapse or blur")
    sessions = read_answers(Path(answers), include_flagged=include_flagged)
    known = {one.subject for one in sessions}
    for subject in subjects:
        if subject not in known:
            raise DataError(f"{answers}: found no subject {subject!r}, expected one of {', '.join(sorted(known))}")
    sessions = [one for one in sessions if not subjects or one.subject in subjects]
    data = _loaded(dataset)
    with _run(workers, None, None, progress) as run:
        found = calibrate_persons(
            data,
            sessions,
            judge,
            free=free,
            fit_settings=fit,
            seed=seed,
            skip_bad_frames=_is_skip(on_error),
            run=run,
        )
    level = data.experiment.level
    fits = [
        Fit.of_counts(_group_of_person(data, person, one), level, one.own)
        for person in found.persons
        for one in person.groups
    ]
    persons = [_person_result(data, person) for person in found.persons]
    pooled = None if found.pooled is None else _person_result(data, found.pooled)
    fitted = ("internal_noise", "internal_noise_sd", *(["template_blur_samples"] * ("blur" in free)))
    settings = {name: value for name, value in settings.items() if name not in fitted}
    return Result.made(
        "calibrate",
        started,
        settings=settings | asdict(fit) | {"free": list(free), "include_flagged": include_flagged},
        seed=seed,
        fits=tuple(fits),
        persons=tuple(persons),
        pooled=pooled,
        equal_noise_p_value=found.equal_noise_p_value,
        dataset=DatasetRecord.of(data),
        skipped=tuple(one._asdict() for one in found.skipped),
        warnings=tuple(ResultWarning(**one._asdict()) for one in found.warnings()),
    )


def _person_result(data: Dataset, person: PersonFit) -> PersonResult:
    fit, is_known = person.fit, person.fit.status == "ok"
    level = data.experiment.level
    predicted = [
        replace_struct(
            Fit.of_counts(_group_of_person(data, person, one), level, one.predicted),
            threshold_ci95=one.predicted_ci95,
        )
        for one in person.groups
        if one.predicted is not None
    ]
    return PersonResult(
        subject=person.subject,
        status=fit.status,
        internal_noise=fit.noise,
        internal_noise_ci95=fit.noise_ci95,
        lapse_rate=fit.lapse_rate if is_known else None,
        lapse_rate_ci95=fit.lapse_rate_ci95 if is_known else None,
        template_blur_samples=fit.blur if is_known else None,
        template_blur_samples_ci95=fit.blur_ci95 if is_known else None,
        n_trials=person.n_trials,
        n_correct=person.n_correct,
        n_flagged=dict(person.n_flagged),
        log_likelihood=fit.log_likelihood,
        deviance=fit.deviance,
        deviance_p_value=fit.deviance_p_value,
        n_cells=fit.n_cells,
        predicted=tuple(predicted),
    )


def _group_of_person(data: Dataset, person: PersonFit, curve: GroupCurve) -> Group:
    return {"subject": str(person.subject), **group_of(data, curve.group)}


def naked_eye(
    *,
    size_mrad: float | Sequence[float] | None = None,
    contrast: float | Sequence[float] | None = None,
    observer: str | Observer = "pyramid",
    p_correct: float = 0.75,
    progress: Progress | None = None,
) -> Result:
    """Compute thresholds of the observer without any display in between, as `todframes naked-eye` does.

    Parameters
    ----------
    size_mrad : float or sequence of float
        Sizes √(area) in mrad; the threshold is a Weber contrast for each. Give either this or `contrast`.
    contrast : float or sequence of float
        Weber contrasts; the threshold is a size in mrad for each, the acuity.
    observer : str or Observer
        Observer as in `score`; it must be linear.
    p_correct : float
        Raw proportion correct at threshold.
    progress : function of an int, optional
        Called with the number of thresholds that were just found.

    Returns
    -------
    Result
        One threshold for each size or contrast, and a warning for each contrast above 1.

    Raises
    ------
    SettingsError
        If both or none are given, the observer is not linear, or a value is out of its range.

    Examples
    --------
    >>> import todframes as tod
    >>> (one,) = tod.naked_eye(size_mrad=1.0).thresholds
    >>> f"{one.threshold:.3f} ± {one.threshold_numerical_error:.0e}"
    '0.146 ± 2e-05'
    """
    started = time.perf_counter()
    from todframes.scoring.naked_eye import acuity, contrast_threshold

    if (contrast is None) == (size_mrad is None):
        raise SettingsError("naked-eye: expected one of --contrast and --size-mrad")
    judge, settings = described(observer)
    FitSettings(p_correct=p_correct)  # checks it
    values = np.atleast_1d(np.asarray(size_mrad if contrast is None else contrast, dtype=np.float64)).tolist()
    level, given = ("contrast", "size_mrad") if contrast is None else ("size_mrad", "contrast")
    fits = []
    for value in values:
        if contrast is None:
            found = contrast_threshold(judge, size_mrad=value, p_correct=p_correct)
        else:
            found = acuity(judge, contrast=value, p_correct=p_correct)
        fits.append(_computed({given: value}, level, p_correct, found))
        if progress is not None:
            progress(1)
    return Result.made(
        "naked-eye",
        started,
        settings=settings | {"p_correct": p_correct},
        fits=tuple(fits),
        warnings=above_contrast_1(fits),
    )


def noise(
    recording: PathLike | Sequence[PathLike],
    *,
    region: tuple[int, int, int, int] | None = None,
    patches: Mapping[tuple[int, int, int, int], float] | None = None,
    chart: PathLike | None = None,
    signal: float | Sequence[float] = (),
    mk_per_count: float | None = None,
    frames_per_second: float | None = None,
    max_frame_mb: int = 256,
    progress: Progress | None = None,
) -> NoiseResult:
    """Measure the three-dimensional noise of a recording, as `todframes noise` does.

    The recording shows a uniform scene that does not move; what is not uniform counts as fixed pattern.

    Parameters
    ----------
    recording : path or sequence of path
        A video, image files or a folder of them, camera raw or radiometric files, or a NumPy array.
    region : (int, int, int, int), optional
        Left column, top row, width and height in pixels. Default: the whole frame.
    patches : mapping, optional
        Uniform parts of the frame, as `region`, and the level of each: luminance, reflectance or temperature.
        They give the signal transfer, and a signal-to-noise ratio for each level.
    chart : path, optional
        `chart.toml` of the chart that the recording shows: its patches are found by its markers. Default of
        the region is then the largest patch.
    signal : float or sequence of float
        Differences of the values, whose signal-to-noise ratios are given too.
    mk_per_count : float, optional
        Temperature difference in mK for a difference of one in the values. Default: from the constants of a
        radiometric file, at the mean of the recording.
    frames_per_second : float, optional
        Frame rate in place of what the files say.
    max_frame_mb : int
        Largest decoded size of a frame in 2**20 bytes: all channels, in their own pixel types.
    progress : function of an int, optional
        Called with 1 for each frame.

    Returns
    -------
    NoiseResult
        `measured` has the parts of the noise, each with a 95 % interval; `sensor_toml()` is for sensor_sim.

    Raises
    ------
    DataError, FrameError
        If the files cannot be read, or are several recordings.
    SettingsError
        If a setting is invalid.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import todframes as tod
    >>> rng = np.random.default_rng(1)
    >>> path = tempfile.mkdtemp() + "/frames.npy"
    >>> np.save(path, 100 + rng.normal(0, 1, (64, 64)) + rng.normal(0, 2, (50, 64, 64)))
    >>> measured = tod.noise(path).measured
    >>> f"{measured.dynamic.sd:.1f} from frame to frame, {measured.fixed.sd:.1f} fixed"
    '2.0 from frame to frame, 1.0 fixed'
    """
    started = time.perf_counter()
    from todframes.recordings.noise3d import FramePatch, measure_noise
    from todframes.recordings.opening import open_recordings
    from todframes.recordings.radiometric import mk_per_count_of
    from todframes.report.noise import noise_result

    if mk_per_count is not None and not (np.isfinite(mk_per_count) and mk_per_count > 0):
        raise SettingsError(f"mk_per_count: found {mk_per_count}, expected a number > 0")
    found = open_recordings(recording, frames_per_second=frames_per_second, max_frame_mb=max_frame_mb)
    if len(found) != 1:
        names = ", ".join(str(one.path) for one in found[:3])
        raise DataError(f"noise: found {len(found)} recordings ({names} …), expected one")
    levels = [FramePatch(place, float(level)) for place, level in (patches or {}).items()]
    if chart is not None:
        from todframes.recordings.chart_patches import find_patches

        levels += find_patches(found[0], Path(chart))
        region = region or max((one.region for one in levels), key=lambda place: place[2] * place[3])
    measured = measure_noise(found[0], region=region, patches=levels, progress=progress)
    if mk_per_count is None:
        mk_per_count = mk_per_count_of(found[0], measured.mean)
    signals = tuple(np.atleast_1d(np.asarray(signal, np.float64)).tolist())
    return noise_result(measured, str(found[0].path), mk_per_unit=mk_per_count, signals=signals, started=started)


def _computed(group: Group, level: str, p_correct: float, found: Threshold) -> Fit:
    return Fit(
        group=group,
        level=level,
        status=found.status,
        threshold=found.threshold,
        threshold_numerical_error=found.numerical_error,
        p_correct=p_correct,
    )


def described(observer: str | Observer) -> tuple[Observer, Json]:
    """Return an observer, made if only its name is given, and its name and settings as JSON values."""
    if isinstance(observer, str):
        kind, name = find_observer(observer), observer
        observer = kind(kind.settings_type())
    else:
        name = _name(type(observer))
    settings = getattr(observer, "settings", None)
    values = asdict(settings) if is_dataclass(settings) and not isinstance(settings, type) else {}
    return observer, {"observer": name, **values}


def _name(kind: type) -> str:
    """Return the name that a class is registered under, or "module:Class" if it is not registered."""
    import sys
    from importlib.metadata import entry_points

    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.module in sys.modules and entry.load() is kind:
            return entry.name
    return f"{kind.__module__}:{kind.__qualname__}"


def _fit_settings(fit: FitSettings | None, p_correct: float | None) -> FitSettings:
    fit = fit or FitSettings()
    return fit if p_correct is None else replace(fit, p_correct=p_correct)


@contextmanager
def _run(
    workers: int, cluster: str | Engine | None, store: Store | Path | str | None, progress: Progress | None
) -> Iterator[Run]:
    """Open the engine and the store of a run, unless they are open."""
    from todframes.scoring.work import Run

    kept = Store(Path(store), str(store)) if isinstance(store, str | Path) else store
    with ExitStack() as stack:
        engine = stack.enter_context(open_engine(cluster, workers))
        if kept is not None:
            stack.callback(kept.close)
        yield Run(engine, kept, progress)


def _loaded(dataset: Location | str | Dataset) -> Dataset:
    return dataset if isinstance(dataset, Dataset) else load_dataset(dataset)


def _located(
    dataset: Location | str | Dataset,
    observer: Observer,
    locate: Locate | bool,
    on_error: OnError,
    progress: Progress | None,
) -> tuple[Dataset, Json, tuple[ResultWarning, ...]]:
    """Load a dataset and find its positions if asked to. Returns it, the positions and the warnings about them."""
    data = _loaded(dataset)
    if not locate:
        return data, {}, ()
    from todframes.diagnosis.locate import locate_triangles, location_warnings

    data, locations = locate_triangles(
        data,
        locate="group" if locate is True else locate,
        centre=observer.centre,
        skip_bad_frames=_is_skip(on_error),
        progress=progress,
    )
    located = tuple(
        {
            **one._asdict(),
            "group": group_of(data, one.group),
            "arrangement": list(one.arrangement.mismatches),
        }
        for one in locations
    )
    found = tuple(ResultWarning(**one._asdict()) for one in location_warnings(data, locations))
    return data, {"located": located}, found


def inspected(
    data: Dataset, trials: Sequence[Trial], centre: Centre = "centroid"
) -> tuple[DatasetRecord, tuple[ResultWarning, ...]]:
    """Return a dataset's record with what its frames show, and the warnings about them."""
    inspections = inspect(data, trials, centre=centre)
    warnings = (*dataset_warnings(data, trials), *frame_warnings(data, inspections))
    record = DatasetRecord.of(data, records(data, inspections))
    return record, tuple(ResultWarning(**one._asdict()) for one in warnings)


def _each_once(*warnings: ResultWarning) -> tuple[ResultWarning, ...]:
    """Return the warnings without those whose code and group an earlier one has."""
    found: dict[tuple[str, tuple[tuple[str, float | str], ...]], ResultWarning] = {}
    for one in warnings:
        found.setdefault((one.code, tuple(one.group.items())), one)
    return tuple(found.values())


def _is_skip(on_error: OnError) -> bool:
    if on_error not in ("stop", "skip"):
        raise SettingsError(f"on_error: found {on_error!r}, expected stop or skip")
    return on_error == "skip"
