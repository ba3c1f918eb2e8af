"""Records of a result, with the keys of its JSON, and a decoder that checks every key.

Unknown keys are ignored, so results of later versions can be read.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

import msgspec
from msgspec import Meta, Struct, field

from todframes.base.errors import DataError
from todframes.base.reading import read_file
from todframes.base.safe_text import in_utf8, visible_json
from todframes.results.wording import count, warning_text

if TYPE_CHECKING:
    from todframes.display.display import Display
    from todframes.frames.dataset import Dataset, Experiment
    from todframes.psychometrics.fit import PsychometricFit
    from todframes.psychometrics.threshold_search import ComputedThreshold
    from todframes.results.figure import ReportFigure
    from todframes.results.table import Table

SCHEMA = 1

MAX_MB = 64

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

Positive = Annotated[float, Meta(gt=0)]

Proportion = Annotated[float, Meta(ge=0, le=1)]

Interval = tuple[Positive | None, Positive | None]

Group = dict[str, float | str]

Record = dict[str, Any]

NO_DIFFERENCE = "no difference shown"

PSNR_STEP_DB, SSIM_STEP = 0.1, 0.005
"""Largest changes of PSNR and SSIM that count as no change."""


def _null() -> None:
    return None


def _empty() -> tuple[()]:
    return ()


# JSON leaves out a value that equals its default, but not one that equals the value of a default factory.
NULL: Any = field(default_factory=_null)
"""Field that may be missing when a result is read, and is written as null if it has no value."""

EMPTY: Any = field(default_factory=_empty)
"""Field of a list that may be missing when a result is read, and is written even if it is empty."""


class FitPoint(Struct, frozen=True):
    """The proportion correct at one level; `n_trials` is 0 if it was computed without trials."""

    level: Positive
    n_trials: int
    p_correct: Proportion


class CurveParameters(Struct, frozen=True):
    """Parameters of the observer's curve; `max_d_prime` is None where d′ has no limit."""

    alpha: Positive
    beta: Positive
    max_d_prime: Positive | None = NULL


class Fit(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A threshold and the curve it was read from, one object of `fits`.

    Attributes
    ----------
    group : dict
        Values that the trials of this curve share, by column, such as {"size_mrad": 2.0}.
    level : str
        Quantity of `threshold`, `alpha` and the levels of `points`: contrast, snr, size_mrad.
    status : str
        "ok", the threshold lies within the levels shown; "extrapolated", outside of them but near; or there is no
        threshold: "never_reached" and "always_exceeded", the curve stays below or above the criterion;
        "too_few_levels", fewer than two; "too_uncertain", its numerical error is above 30 %.
    threshold : float or None
        Level at the raw proportion correct `p_correct`.
    threshold_ci95 : (float or None, float or None) or None
        95 % interval; an end is None if the data leave it open.
    threshold_ci95_same_scenes : (float or None, float or None) or None
        95 % interval for other trials on the same scenes, where `threshold_ci95` takes scenes as drawn from many.
    threshold_numerical_error, threshold_displacement_error : float or None
        Error of a computed threshold, and half the 95 % interval over displacements of the retina.
    curve : str or None
        Psychometric function of the threshold, "observer" or "weibull"; None for a threshold that was computed.
    n_trials : int
        Number of trials.
    n_displacements, n_phases : int or None
        Number of displacements of the retina in each trial, and of positions on the detectors.
    plan : tuple of dict
        The plan of this threshold, as in the result.
    run_time_s : float or None
        Time for this threshold; with several workers, the sum over them.
    points_threshold : float or None
        Level at which the points themselves cross the criterion; None for sampled decisions, fewer than three
        levels, or fewer than three trials at a level.
    weibull_threshold : float or None
        Threshold of the Weibull curve, which `threshold` is too if `curve` is "weibull".
    alpha, beta, guess_rate, lapse_rate : float or None
        Parameters α, β, γ and δ of the Weibull curve p(x) = (1−δ) − (1−δ−γ)·2^−(x/α)^β, Hogervorst et al. 2001,
        eq. 3; `gamma` and `delta` in JSON. α is not the 75 % point.
    observer_curve : CurveParameters or None
        Parameters of the observer's curve, 1/d′² = (α/x)^(2β) + 1/d_max².
    p_correct : float
        Raw proportion correct that defines the threshold.
    points : tuple of FitPoint
        Proportion correct at each level.
    p_correct_error_bound, p_correct_left_out_bound : float or None
        Bounds on the error in P(correct) from noise that is not Gaussian, and from the omissions of the plan.
    p_correct_places_error : float or None
        Largest standard error of a trial's P(correct) if the noise of the places at which the triangle may be is
        correlated, 0 if it is not; None if the place is known.
    delta_t_mk : float or None
        Threshold as a temperature difference in mK, SNR · NETD / k: the noise of a displayed sample is NETD / k.
    delta_t_as_printed_mk : float or None
        Temperature difference by eq. 4 of Hogervorst et al. 2001 as printed, SNR · NETD · k, in mK.
    answers, answers_from_level : tuple of tuple of float, or None
        If there is no threshold: numbers of answers, expected or drawn, in the trials at `answers_from_level` and
        above. A row for each orientation shown, a column for each answered: up, right, down, left.
    background_luminance_cd_m2 : float or None
        Luminance that contrast refers to, averaged over the trials; None if there are no frames.
    """

    group: Group
    level: str
    status: str
    threshold: Positive | None = NULL
    threshold_ci95: Interval | None = NULL
    threshold_ci95_same_scenes: Interval | None = None
    threshold_numerical_error: float | None = NULL
    threshold_displacement_error: float | None = NULL
    p_correct: Proportion
    curve: str | None = NULL
    weibull_threshold: Positive | None = NULL
    observer_curve: CurveParameters | None = NULL
    alpha: Positive | None = NULL
    beta: Positive | None = NULL
    guess_rate: Proportion | None = field(default_factory=_null, name="gamma")
    lapse_rate: Proportion | None = field(default_factory=_null, name="delta")
    n_trials: int = field(default_factory=int)
    points: tuple[FitPoint, ...] = EMPTY
    points_threshold: Positive | None = NULL
    delta_t_mk: float | None = NULL
    delta_t_as_printed_mk: float | None = NULL
    background_luminance_cd_m2: float | None = None
    n_displacements: int | None = None
    n_phases: int | None = None
    p_correct_error_bound: float | None = NULL
    p_correct_left_out_bound: float | None = NULL
    p_correct_places_error: float | None = None
    plan: tuple[Record, ...] = ()
    run_time_s: float | None = NULL
    answers: tuple[tuple[float, ...], ...] | None = None
    answers_from_level: Positive | None = None

    @classmethod
    def of_counts(cls, group: Group, level: str, fit: PsychometricFit) -> Fit:
        """Return the record of a psychometric fit."""
        values = {one.name: getattr(fit, one.name) for one in dataclasses.fields(fit) if one.name != "points"}
        points = tuple(FitPoint(one.level, one.n_trials, one.p_correct) for one in fit.points)
        if fit.observer_curve is not None:
            values["observer_curve"] = CurveParameters(*fit.observer_curve)
        return cls(group=group, level=level, points=points, **values)

    @classmethod
    def of_computed(cls, group: Group, level: str, p_correct: float, found: ComputedThreshold, **more: Any) -> Fit:
        """Return the record of a threshold that was computed without trials, with `more` of its values."""
        return cls(
            group=group,
            level=level,
            p_correct=p_correct,
            status=found.status,
            threshold=found.threshold,
            threshold_numerical_error=found.numerical_error,
            **more,
        )


def group_of(dataset: Dataset, values: Sequence[float | str]) -> Group:
    """Return the values of a group by the names of the columns that group the dataset's trials."""
    return dict(zip(dataset.experiment.group_by, values, strict=True))


class Ratio(Struct, frozen=True, kw_only=True):
    """An algorithm's threshold divided by that of the reference, in one group or, without `group`, in all.

    `p_value_is_least`: the p-value is the smallest that the resamples allow, so the true one may be smaller.
    `contrast_gain` is the algorithm's gain of the triangle's displayed contrast, and `beyond_gain` its threshold
    divided by that of a plain gain of the same amount: below 1, it does more than to amplify.
    """

    verdict: str
    group: Group = {}
    ratio: Positive | None = None
    ratio_ci95: Interval | None = None
    p_value: float | None = None
    p_value_holm: float | None = None
    p_value_is_least: bool = False
    contrast_gain: Positive | None = None
    beyond_gain: Positive | None = None
    beyond_gain_ci95: Interval | None = None


class ContrastPoint(Struct, frozen=True, kw_only=True):
    """Displayed contrast of the triangle at a level, before and after an algorithm: means over `n_trials` trials.

    `gain` is their quotient, and `gain_standard_error` its standard error over the trials.
    """

    level: Positive
    before: float
    after: float
    gain: float | None = None
    gain_standard_error: float | None = None
    n_trials: int = 0


class ContrastResponse(Struct, frozen=True, kw_only=True):
    """Displayed contrast after an algorithm against that before it, level by level, in one group."""

    group: Group = {}
    points: tuple[ContrastPoint, ...] = ()


class Algorithm(Struct, frozen=True, kw_only=True):
    """An algorithm of `compare`; the reference has no ratios.

    Attributes
    ----------
    name, spec : str
        Short name, and the text of `--enhance`.
    what, library, domain : str or None
        Its description, the library that does the work, and the values that it takes.
    parameters : dict
        Values of its parameters.
    magnification : float
        Factor by which it enlarges the frame.
    fits : tuple of Fit
        Thresholds with the algorithm.
    ratios : tuple of Ratio
        Ratio of the thresholds in each group.
    overall : Ratio or None
        The same for the geometric mean of all groups, if there are several.
    verdict : str or None
        That of `overall`, or of the only group.
    contrast_responses : tuple of ContrastResponse
        Displayed contrast before and after the algorithm, in each group.
    n_scenes : int or None
        Number of scenes that the interval takes as drawn from many; None if the dataset names none.
    psnr_db, psnr_change_db, ssim, ssim_change : float or None
        PSNR and SSIM against `reference_frame`, and their changes by the algorithm.
    disagrees : tuple of str
        Those of psnr and ssim that contradict the verdict.
    edge_factor : float or None
        Factor by which it changes the luminance of a frame's outermost pixels, divided by that around the
        triangle: the median over the frames.
    repeat_difference : float or None
        Largest difference between pictures of the same frame, in units of their mean luminance.
    n_clipped : int or None
        Number of values that were clipped.
    cpu_s, cpu_ms_per_frame : float or None
        Processor time of the algorithm over all frames, and for a frame.
    memory_mb : float or None
        Memory that it needs for a frame.
    """

    name: str
    spec: str | None = None
    what: str | None = None
    library: str | None = None
    domain: str | None = None
    parameters: Record = {}
    magnification: float = 1.0
    fits: tuple[Fit, ...] = ()
    ratios: tuple[Ratio, ...] = ()
    overall: Ratio | None = None
    verdict: str | None = None
    contrast_responses: tuple[ContrastResponse, ...] = ()
    n_scenes: int | None = None
    psnr_db: float | None = None
    psnr_change_db: float | None = None
    ssim: float | None = None
    ssim_change: float | None = None
    disagrees: tuple[str, ...] = ()
    edge_factor: float | None = None
    repeat_difference: float | None = None
    n_clipped: int | None = None
    cpu_s: float | None = None
    cpu_ms_per_frame: float | None = None
    memory_mb: float | None = None


class ComparedObserver(Struct, frozen=True, kw_only=True):
    """A further observer of `compare` or `calibrate`: its name and settings, and what a result has of the first.

    These are its verdicts on the algorithms, or the internal noise, or efficiency, of the persons by it.
    """

    settings: Record
    algorithms: tuple[Algorithm, ...] = ()
    persons: tuple[PersonResult, ...] = EMPTY
    pooled: PersonResult | None = NULL

    @property
    def name(self) -> str:
        """Return the name of the observer."""
        return str(self.settings.get("observer"))


def observer_names(settings: Record, others: Sequence[ComparedObserver]) -> list[str]:
    """Return the names of a result's observers, numbered if two have the same with other settings.

    They state the gaze if it is not the same of all.
    """
    names, gazes = [str(settings.get("observer")), *(one.name for one in others)], [settings.get("gaze")]
    gazes += [one.settings.get("gaze", gazes[0]) for one in others]
    if len(set(gazes)) > 1:
        names = [f"{name} ({gaze})" for name, gaze in zip(names, gazes, strict=True)]
    if len(set(names)) < len(names):
        return [f"{name} ({number})" for number, name in enumerate(names, 1)]
    return names


def each_observer(result: ResultData) -> list[tuple[str, tuple[Algorithm, ...]]]:
    """Return the algorithms as each observer of a comparison judges them, with its name, "" if it is alone."""
    if not result.observers:
        return [("", result.algorithms)]
    each = [result.algorithms, *(one.algorithms for one in result.observers)]
    return list(zip(observer_names(result.settings, result.observers), each, strict=True))


def thresholds_of(algorithms: Sequence[Algorithm]) -> tuple[Fit, ...]:
    """Return the fits of all algorithms, each with the algorithm's name in its group."""
    return tuple(
        msgspec.structs.replace(fit, group={"algorithm": one.name} | fit.group)
        for one in algorithms
        for fit in one.fits
    )


def plain_value(value: object) -> object:
    """Return a parameter's value as a JSON value, or as a text if JSON has no such value."""
    if isinstance(value, Mapping):
        return {str(name): plain_value(one) for name, one in value.items()}
    return value if value is None or isinstance(value, bool | int | float | str) else repr(value)


class Estimator(Struct, frozen=True, kw_only=True):
    """A method to compute a threshold, with its CPU time and error at each budget.

    Attributes
    ----------
    name, label : str
        Name, and how it is shown.
    set_up_cpu_s : float or None
        CPU time before the first trial.
    slope, slope_standard_error : float or None
        Slope of ln(error) against ln(CPU time).
    points : tuple of dict
        For each budget: `trials` of an estimate, `repeats` behind the errors, `cpu_s`, `wall_s`, `p_correct_error`
        and `threshold_error` (relative).
    cpu_s_at : tuple of dict
        `cpu_s` at a `threshold_error`, or None; `extrapolated`, `at_most`.
    """

    name: str
    label: str | None = None
    set_up_cpu_s: float | None = None
    slope: float | None = None
    slope_standard_error: float | None = None
    points: tuple[Record, ...] = ()
    cpu_s_at: tuple[Record, ...] = ()

    @property
    def title(self) -> str:
        """The name as shown to readers."""
        return self.label or self.name


class SpeedRatio(Struct, frozen=True, kw_only=True):
    """The first estimator's CPU time divided by that of the closed form, at a relative error of the threshold."""

    threshold_error: Positive
    ratio: Positive | None = None
    closed_form: str | None = None
    extrapolated: bool = False
    at_least: bool = False


class SceneResult(Struct, frozen=True, kw_only=True):
    """The result of `accuracy` for one scene.

    Attributes
    ----------
    name, title, description, level : str
        The scene, and the quantity of its threshold.
    threshold, threshold_bound : float or None
        Converged value, and the half-width of its error.
    slope : float or None
        dP(correct) / d ln(level) at the threshold.
    p_correct_error_bound : float or None
        Bound on the error of P(correct) from noise that is not Gaussian.
    estimators : tuple of Estimator
        The ways to compute the threshold.
    variants : tuple of dict
        The closed form with something changed: `label`, `cpu_ratio`, `p_correct_change`, `threshold_change`.
    speed_ratios : tuple of SpeedRatio
        CPU time of the literal Monte Carlo over that of the fastest closed form.
    """

    name: str
    title: str | None = None
    description: str = ""
    level: str = "level"
    threshold: float | None = None
    threshold_bound: float | None = None
    slope: float | None = None
    p_correct_error_bound: float | None = None
    estimators: tuple[Estimator, ...] = ()
    variants: tuple[Record, ...] = ()
    speed_ratios: tuple[SpeedRatio, ...] = ()

    @property
    def heading(self) -> str:
        """The title with a capital letter."""
        title = self.title or self.name
        return title[:1].upper() + title[1:]


class PersonResult(Struct, frozen=True, kw_only=True):
    """The internal noise that explains the answers of a person, or those of several persons together.

    Attributes
    ----------
    subject : str or None
        Anonymous id of the person; None for all together.
    status : str
        "ok", or why there is no noise: "noise_free" (without noise the model would answer no worse), "at_chance"
        (the answers cannot be distinguished from guesses), "too_few_trials" (neither is).
    internal_noise : float or None
        Full width of each neuron's noise.
    internal_noise_ci95 : (float or None, float or None)
        95 % interval; an end is None if the answers leave it open.
    efficiency, efficiency_ci95
        Squared ratio of the person's d′ to that of an observer such as `csf`, in place of an internal noise; the
        interval is None for observers with an internal noise.
    lapse_rate, template_blur_samples : float or None
        Error rate δ of lapses and blur of the templates, in retina samples; fitted if they have an interval.
    n_trials, n_correct : int
        Number of main trials, and of correct answers.
    n_flagged : mapping of str to int
        Number of answers with each flag that occurs: hidden, unfocused, too_fast. They are among `n_trials` only
        with the setting `include_flagged`.
    log_likelihood : float
        Sum of the ln probabilities of the answers.
    aic : float or None
        Akaike's criterion, 2 · (fitted parameters) − 2 · log_likelihood; of two observers, that with the smaller
        one explains the same answers better.
    deviance, deviance_p_value : float
        Deviance of the proportions correct of the `n_cells` groups and levels, and the share of experiments with
        the fitted model that have as large a one.
    predicted : tuple of Fit
        Thresholds of the fitted model, a record for each of the person's own in `fits`, in the same order; their
        intervals are those of the noise.
    """

    subject: str | None
    status: str
    internal_noise: Positive | None = NULL
    internal_noise_ci95: Interval
    efficiency: Positive | None = NULL
    efficiency_ci95: Interval | None = NULL
    lapse_rate: Proportion | None = NULL
    lapse_rate_ci95: tuple[Proportion, Proportion] | None = NULL
    template_blur_samples: float | None = NULL
    template_blur_samples_ci95: Interval | None = NULL
    n_trials: int
    n_correct: int
    n_flagged: dict[str, int] = field(default_factory=dict)
    log_likelihood: float
    aic: float | None = NULL
    deviance: float
    deviance_p_value: Proportion | None = NULL
    n_cells: int
    predicted: tuple[Fit, ...] = EMPTY


class Thumbnail(Struct, frozen=True):
    """A PNG of an example. `scale` is the value of white; black is `black`, or minus white if zero is mid-grey."""

    name: str
    png: bytes
    scale: float | None = None
    black: float | None = None


class Example(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A trial near threshold, the frame as displayed and the observer's images of it; or a strong trial, whole.

    There is one for each of at most four groups; a group without a threshold has its strongest trial. `pictures`
    are PNG in base64.
    """

    group: Group
    algorithm: str | None = None
    level: str = field(default_factory=lambda: "level")
    strength: float | None = NULL
    orientation: str | None = NULL
    p_correct: float | None = None
    frame: str | None = None
    n_frames: int | None = None
    scene: str | None = None
    width_mrad: float | None = NULL
    pictures: tuple[Thumbnail, ...]


class DatasetRecord(Struct, frozen=True, kw_only=True):
    """The dataset of a result, with all that luminance, visual angle and curves were computed from.

    Attributes
    ----------
    path : str
        Folder of the dataset as given; "in memory" if there is none.
    display, experiment : dict
        Settings of `dataset.toml`, defaults included. `pixel_pitch_mrad` is the pitch that was used, whether given
        or from `pixel_pitch_mm` and `viewing_distance_mm`; `lut` has the columns of the table.
    manifest_sha256 : str or None
        Checksum of `manifest.csv`; None for frames in memory.
    n_frames : int or None
        Number of frames in the manifest, those left out included.
    n_scenes : int or None
        Number of scenes behind the triangles; None if the manifest names none.
    motion_mrad : float or None
        Largest distance of a triangle from its mean place in its trial; None if none moves.
    measured : dict
        `stimuli`: what the frames of each group and stimulus show, measured on some of them, as attributes of
        `todframes.diagnosis.inspection.Inspection`. Empty if nothing was measured.
    """

    path: str
    display: Record = {}
    experiment: Record = {}
    manifest_sha256: str | None = None
    n_frames: int | None = None
    n_scenes: int | None = None
    motion_mrad: Positive | None = None
    measured: Record = {}

    @classmethod
    def of(cls, dataset: Dataset, measured: Sequence[Record] = ()) -> DatasetRecord:
        """Return the record of a dataset, with what was measured of each stimulus."""
        as_read_again = msgspec.json.decode(msgspec.json.encode(measured))
        scenes = dataset.trials.scene_numbers
        motion_mrad = dataset.trials.most_motion_px * dataset.display.pitch_mrad
        return cls(
            path=in_utf8(str(dataset.path)),
            display=_display(dataset.display),
            experiment=_experiment(dataset.experiment),
            manifest_sha256=dataset.manifest_sha256,
            n_frames=dataset.n_frames,
            n_scenes=None if scenes is None else len(set(scenes.tolist())),
            motion_mrad=motion_mrad or None,
            measured={"stimuli": as_read_again} if measured else {},
        )


def _experiment(experiment: Experiment) -> Record:
    values: Record = {"level": experiment.level, "group_by": list(experiment.group_by)}
    return values | {"places": experiment.places} if experiment.places > 1 else values


def _display(display: Display) -> Record:
    values = {field.name: getattr(display, field.name) for field in dataclasses.fields(display)}
    if display.lut is not None:  # its luminances are absolute
        del values["white_luminance_cd_m2"], values["black_luminance_cd_m2"]
        values["lut"] = {
            "code_value": display.lut.code_value.tolist(),
            "luminance_cd_m2": display.lut.luminance_cd_m2.tolist(),
        }
    values["pixel_pitch_mrad"] = display.pitch_mrad
    return {name: value for name, value in values.items() if value is not None}


class ResultWarning(Struct, frozen=True, kw_only=True):
    """A fact that makes the result less certain.

    Attributes
    ----------
    code : str
        Name of the kind of fact, which stays the same from version to version.
    group : dict
        Values of the group concerned, by column; empty for the whole dataset.
    message : str
        The fact, its meaning and what to do, for people.
    found, expected : number, tuple of numbers, or None
        Value that was measured, and the one expected.
    """

    code: str = ""
    group: Group = {}
    message: str
    found: Any = None
    expected: Any = None


MOST_ALIKE = 10
"""Largest number of warnings with the same code that are shown."""


def warning_texts(warnings: Iterable[ResultWarning]) -> Iterator[str]:
    """Yield the text of each warning, but only for the first groups of those with the same code, and a count."""
    of_code: dict[str, list[ResultWarning]] = {}
    for warning in warnings:
        of_code.setdefault(warning.code, []).append(warning)
    for code, alike in of_code.items():
        for warning in alike[:MOST_ALIKE]:
            yield warning_text(warning.group, warning.message)
        if len(alike) > MOST_ALIKE:
            yield f"… and {count(len(alike) - MOST_ALIKE, 'more warning')} with the code {code}"


class Head(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Keys that the results of all commands have.

    Attributes
    ----------
    schema : int
        Number of the form of the JSON, 1.
    command : str
        Command or call that made the result.
    version : str
        Version of todframes.
    versions : dict
        Versions of Python, todframes and the libraries that were used.
    seed : int or None
        Seed of the random draws.
    warnings : tuple of ResultWarning
        Facts that make the result less certain. A command also prints each, with `--json` on standard error.
    run_time_s : float or None
        Run time in s.
    date : str
        Day on which the result was made, such as "2026-11-24".
    call : dict
        All that the call was given, defaults included, but for workers and the like; `todframes rerun` repeats it.
    """

    schema: int
    command: str
    version: str = field(default_factory=lambda: "?")
    versions: Record = field(default_factory=lambda: {})  # noqa: PIE807 - `dict` would be left out when empty
    seed: int | None = NULL
    warnings: tuple[ResultWarning, ...] = EMPTY
    run_time_s: float | None = NULL
    date: str = ""
    call: Record = {}


class Content(Struct, frozen=True, kw_only=True, omit_defaults=True, dict=True):
    """Base of the data that a feature gives to its `Result`; fields are keys in JSON, beside those of `Head`.

    The first table is that of a notebook, the first figure that of `plot`. Values for which JSON has no room, such
    as images, may stand in `__dict__`; a result that was read has none.

    Attributes
    ----------
    settings : dict
        All settings, defaults included.
    """

    settings: Record = field(default_factory=lambda: {})  # noqa: PIE807

    json_file: ClassVar[str] = "result.json"
    page_file: ClassVar[str] = "report.html"

    @property
    def name(self) -> str:
        """Return the path or name of what was measured."""
        return ""

    def table(self) -> Table:
        """Return the main table, all of whose columns `to_csv` and `to_dataframe` have."""
        return self.tables()[0]

    def tables(self) -> list[Table]:
        """List the tables; a folded one is not printed, and closed on the page."""
        return []

    def sentences(self) -> list[str]:
        """Return the findings in words, the answer first."""
        return []

    def remarks(self) -> list[str]:
        """Return sentences about how the numbers were made, and how exact they are."""
        return []

    def figures(self) -> list[ReportFigure]:
        """List the figures, the most important first."""
        return []

    def files(self) -> dict[str, bytes | Iterable[bytes]]:
        """Return the content of the files besides figures, page and JSON, by name: tables as CSV, and others."""
        return {one.file: one.csv().encode() for one in self.tables() if one.file}

    def found_in(self, folder: Path) -> None:
        """Take what stands beside the JSON in its folder, when it is asked for."""

    def check(self, where: str) -> None:
        """Raise DataError, which begins with `where`, if what was read contradicts itself."""


class ResultData(Content, frozen=True, kw_only=True):
    """Thresholds, and what else the commands about them give; `Thresholds` adds the methods.

    Attributes
    ----------
    fits : tuple of Fit
        A threshold for each group; empty for `compare`, `accuracy` and `stability`. Of `calibrate`, each person's
        own thresholds, with `subject` in their group.
    algorithms : tuple of Algorithm
        Of `compare`: an object for each algorithm, the reference `none` first.
    observers : tuple of ComparedObserver
        What the second and further observers or gazes find.
    scenes : tuple of SceneResult
        Of `accuracy`: an object for each scene.
    cases : tuple of dict
        Of `stability`: an object for each case.
    persons : tuple of PersonResult
        Of `calibrate`: an object for each person.
    pooled : PersonResult or None
        Of `calibrate` with several people: all answers together.
    equal_noise_p_value : float or None
        p-value of the likelihood-ratio test that all people have the same noise.
    data_range_cd_m2 : float or None
        Range of luminance for PSNR and SSIM.
    verdict : tuple of str
        A sentence for each algorithm.
    plan : tuple of dict
        What was kept and left out: `stage`, `kept`, `why`, `bound` on P(correct), `saves_s`.
    dataset : DatasetRecord, str or None
        Dataset of `score`, `compare` and `calibrate`; results of earlier versions have the folder alone.
    skipped : tuple of dict
        Frames or trials that were left out, and why.
    negative_luminance_pixels : int or None
        Number of pixels of the display with a luminance below zero.
    located : tuple of dict or None
        With `--locate`, an object for each group: `x_px`, `y_px`, `standard_error_px`, `moved_px` (displacement
        from the positions of the manifest, which stay if the standard error is None), and `arrangement`: those of
        the codes `polarity_mismatch`, `mirrored`, `flipped` and `turned` that apply. With `each`, `n_located` of
        `n_trials` trials have a position of their own, with the standard deviation `scatter_px`; from `sure_level`
        on, single positions are known to 0.09 mrad.
    examples : tuple of Example or None
        With `-o`: pictures of trials near threshold.
    from_store : int or None
        Number of results that an earlier, interrupted run had computed.
    """

    fits: tuple[Fit, ...] = EMPTY
    algorithms: tuple[Algorithm, ...] = ()
    observers: tuple[ComparedObserver, ...] = ()
    scenes: tuple[SceneResult, ...] = ()
    cases: tuple[Record, ...] = ()
    persons: tuple[PersonResult, ...] = ()
    pooled: PersonResult | None = None
    equal_noise_p_value: Proportion | None = None
    data_range_cd_m2: float | None = None
    verdict: tuple[Any, ...] | str = ()
    plan: tuple[Record, ...] = ()
    dataset: DatasetRecord | str | None = None
    skipped: tuple[Record, ...] = EMPTY
    negative_luminance_pixels: int | None = None
    located: tuple[Record, ...] | None = None
    examples: tuple[Example, ...] | None = None
    from_store: int | None = None

    @property
    def dataset_path(self) -> str | None:
        """The dataset's folder; results of earlier versions have nothing else about it."""
        return self.dataset.path if isinstance(self.dataset, DatasetRecord) else self.dataset

    @property
    def thresholds(self) -> tuple[Fit, ...]:
        """All thresholds as `Fit` records; in a comparison, `group` has the key "algorithm" too."""
        return (*self.fits, *thresholds_of(self.algorithms))


S = TypeVar("S", bound=Struct)

T = TypeVar("T")


def read_bytes(path: Path) -> bytes:
    """Return the content of a result's file.

    Raises
    ------
    DataError
        If it cannot be read or is too long.
    """
    return read_file(path, most_mb=MAX_MB)


def json_file(content: object) -> bytes:
    """Return a record as indented JSON; NaN becomes null.

    Characters that a terminal would obey are escaped; the values of the JSON are the same.
    """
    text = msgspec.json.format(msgspec.json.encode(content), indent=2).decode()
    return (visible_json(text) + "\n").encode()


def as_read(values: object, kind: type[T]) -> T:
    """Return values as they are read from their JSON, to equal what is loaded: what is not finite becomes None."""
    return msgspec.json.decode(msgspec.json.encode(values), type=kind)


def decode(content: bytes, where: str, kind: type[S]) -> S:
    """Return the keys of a result that a record has, decoded from JSON and checked.

    Parameters
    ----------
    content : bytes
        One JSON object, with or without a byte-order mark.
    where : str
        Name of the file; every message begins with it.
    kind : type
        `Head`, or a subclass of `Content`.

    Raises
    ------
    DataError
        If it is not JSON, or a value is not of its type.
    """
    try:
        return msgspec.json.decode(content.removeprefix(b"\xef\xbb\xbf"), type=kind)
    except msgspec.ValidationError as error:
        raise DataError(f"{where}: {_in_words(str(error))}") from None
    except UnicodeDecodeError:
        raise DataError(f"{where}: not UTF-8, expected a result in JSON") from None
    except (msgspec.DecodeError, RecursionError) as error:
        raise DataError(f"{where}: not a result in JSON ({error})") from None


def check_fits(fits: Sequence[Fit], where: str) -> None:
    """Raise DataError unless all fits have the same level and group columns, as one table needs."""
    for number, fit in enumerate(fits):
        for name, found, expected in (
            ("level", fit.level, fits[0].level),
            ("group", ", ".join(fit.group), ", ".join(fits[0].group)),
        ):
            if found != expected:
                raise DataError(
                    f"{where}[{number}].{name}: found {found!r}, expected {expected!r} as in the first"
                )


def _in_words(problem: str) -> str:
    """Return a message of msgspec in this package's wording: where, found, expected."""
    what, _, place = problem.partition(" - at ")
    place = place.strip("`").removeprefix("$").removeprefix(".")
    if missing := re.fullmatch(r"Object missing required field `(\w+)`", what):
        return f"{place}.{missing[1]} is missing".removeprefix(".")
    expected, _, found = what.replace("`", "").replace(" | null", "").partition(", got ")
    found = f"found {found}, " if found else ""
    return f"{place or 'the result'}: {found}{expected[0].lower()}{expected[1:]}"
