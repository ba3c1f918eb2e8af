"""Records of a result, with the keys of its JSON, and a decoder that checks every key.

Unknown keys are ignored, so results of later versions can be read.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, Struct, field

from todframes.base.errors import DataError
from todframes.base.safe_text import in_utf8, visible_json
from todframes.psychometrics.curves import CurveParameters, FitPoint
from todframes.results.wording import count, warning_text

if TYPE_CHECKING:
    from todframes.display.display import Display
    from todframes.frames.dataset import Dataset
    from todframes.psychometrics.fit import PsychometricFit
    from todframes.psychometrics.threshold_search import ComputedThreshold

SCHEMA = 1

MAX_MB = 64

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

Positive = Annotated[float, Meta(gt=0)]

Proportion = Annotated[float, Meta(ge=0, le=1)]

Interval = tuple[Positive | None, Positive | None]

Group = dict[str, float | str]

Record = dict[str, Any]


class Fit(Struct, frozen=True, kw_only=True):
    """A threshold and the curve it was read from, one object of `fits`.

    Attributes
    ----------
    group : dict
        Values that the trials of this curve share, by column, such as {"size_mrad": 2.0}.
    level : str
        Quantity of `threshold`, `alpha` and the levels of `points`: contrast, snr, size_mrad.
    status : str
        "ok", the threshold lies within the levels shown; "between_levels", the data bound it between two of them
        and do not show how the curve rises; "extrapolated", outside of them but near; or there is no threshold:
        "never_reached" and "always_exceeded", the curve stays below or above the criterion; "falling", answers get
        worse as the level grows; "too_few_levels", fewer than two; "too_uncertain", its numerical error is above
        30 %.
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
    points_threshold : float or None
        Level at which the points themselves cross the criterion; None for sampled decisions, fewer than three
        levels, or fewer than three trials at a level.
    alpha, beta, guess_rate, lapse_rate : float or None
        Parameters α, β, γ and δ of the Weibull curve p(x) = (1−δ) − (1−δ−γ)·2^−(x/α)^β, Hogervorst et al. 2001,
        eq. 3; `gamma` and `delta` in JSON. α is not the 75 % point.
    observer_curve : CurveParameters or None
        Parameters of the observer's curve, 1/d′² = (α/x)^(2β) + 1/d_max².
    p_correct : float
        Raw proportion correct that defines the threshold.
    points : tuple of FitPoint
        Proportion correct at each level.
    p_correct_error_bound : float or None
        Bound on the error in P(correct) from noise that is not Gaussian.
    delta_t_mk : float or None
        Threshold as a temperature difference in mK, SNR · NETD / k: the noise of a displayed sample is NETD / k.
    answers, answers_from_level : tuple of tuple of float, or None
        If there is no threshold: numbers of answers, expected or drawn, in the trials at `answers_from_level` and
        above. A row for each orientation shown, a column for each answered: up, right, down, left.
    background_luminance_cd_m2 : float or None
        Luminance that contrast refers to, averaged over the trials; None if there are no frames.
    """

    group: Group
    level: str
    status: str
    threshold: Positive | None = None
    threshold_ci95: Interval | None = None
    threshold_ci95_same_scenes: Interval | None = None
    threshold_numerical_error: float | None = None
    threshold_displacement_error: float | None = None
    p_correct: Proportion
    curve: str | None = None
    observer_curve: CurveParameters | None = None
    alpha: Positive | None = None
    beta: Positive | None = None
    guess_rate: Proportion | None = field(default=None, name="gamma")
    lapse_rate: Proportion | None = field(default=None, name="delta")
    n_trials: int = 0
    points: tuple[FitPoint, ...] = ()
    points_threshold: Positive | None = None
    delta_t_mk: float | None = None
    background_luminance_cd_m2: float | None = None
    n_displacements: int | None = None
    n_phases: int | None = None
    p_correct_error_bound: float | None = None
    plan: tuple[Record, ...] = ()
    answers: tuple[tuple[float, ...], ...] | None = None
    answers_from_level: Positive | None = None

    @classmethod
    def of_counts(cls, group: Group, level: str, fit: PsychometricFit) -> Fit:
        """Return the record of a psychometric fit."""
        values = {field.name: getattr(fit, field.name) for field in dataclasses.fields(fit)}
        return cls(group=group, level=level, **values)

    @classmethod
    def of_computed(
        cls, group: Group, level: str, p_correct: float, computed: ComputedThreshold, **more: Any
    ) -> Fit:
        """Return the record of a threshold that was computed without trials, with `more` of its values."""
        return cls(
            group=group,
            level=level,
            p_correct=p_correct,
            status=computed.status,
            threshold=computed.threshold,
            threshold_numerical_error=computed.numerical_error,
            **more,
        )


class Efficiency(Struct, frozen=True, kw_only=True):
    """The efficiency of an observer relative to another one on the same trials, one object of `efficiencies`.

    Attributes
    ----------
    relative_to, threshold : str, float or None
        The other observer, and its threshold.
    efficiency : float or None
        (Threshold of the other ÷ that of the observer)², the ratio of the signal energies.
    efficiency_ci95 : (float or None, float or None) or None
        95 % interval; an end is None if the data leave it open.
    """

    relative_to: str
    group: Group
    threshold: Positive | None = None
    efficiency: Positive | None = None
    efficiency_ci95: Interval | None = None


def group_of(dataset: Dataset, values: Sequence[float | str]) -> Group:
    """Return the values of a group by the names of the columns that group the dataset's trials."""
    return dict(zip(dataset.experiment.group_by, values, strict=True))


def observer_names(each_settings: Sequence[Record]) -> list[str]:
    """Return the names of observers, with the gaze if it is not the same of all, and a number if two are alike."""
    first = each_settings[0].get("gaze")
    names = [str(settings.get("observer")) for settings in each_settings]
    gazes = [settings.get("gaze", first) for settings in each_settings]
    if len(set(gazes)) > 1:
        names = [f"{name} ({gaze})" for name, gaze in zip(names, gazes, strict=True)]
    if len(set(names)) < len(names):
        return [f"{name} ({number})" for number, name in enumerate(names, 1)]
    return names


class Thumbnail(Struct, frozen=True):
    """A PNG of an example. `scale` is the value of white; black is `black`, or minus white if zero is mid-grey."""

    name: str
    png: bytes
    scale: float | None = None
    black: float | None = None


class Example(Struct, frozen=True, kw_only=True):
    """A trial near threshold, the frame as displayed and the observer's images of it; or a strong trial, whole.
    There is one for each of at most four groups; a group without a threshold has its strongest trial. `pictures`
    are PNG in base64.
    """

    group: Group
    condition: str | None = None
    level: str = "level"
    strength: float | None = None
    orientation: str | None = None
    p_correct: float | None = None
    frame: str | None = None
    n_frames: int | None = None
    scene: str | None = None
    width_mrad: float | None = None
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
            experiment={"level": dataset.experiment.level, "group_by": list(dataset.experiment.group_by)},
            manifest_sha256=dataset.manifest_sha256,
            n_frames=dataset.n_frames,
            n_scenes=None if scenes is None else len(set(scenes.tolist())),
            motion_mrad=motion_mrad or None,
            measured={"stimuli": as_read_again} if measured else {},
        )


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


S = TypeVar("S", bound=Struct)

T = TypeVar("T")


def json_file(content: object) -> bytes:
    """Return a record as indented JSON; NaN becomes null. Characters that a terminal would obey are escaped; the
    values of the JSON are the same.
    """
    text = msgspec.json.format(msgspec.json.encode(content), indent=2).decode()
    return (visible_json(text) + "\n").encode()


def as_read(values: object, kind: type[T]) -> T:
    """Return values as they are read from their JSON, to equal what is loaded: what is not finite becomes None.
    Arrays become lists.
    """
    return msgspec.json.decode(msgspec.json.encode(values, enc_hook=lambda array: array.tolist()), type=kind)


def decode(content: bytes, where: str, kind: type[S]) -> S:
    """Return the keys of a result that a record of this kind has, decoded from JSON and checked. The JSON may
    begin with a byte-order mark. DataError if it is not JSON, or a value is not of its type; the message begins
    with `where`, the name of the file.
    """
    try:
        return msgspec.json.decode(content.removeprefix(b"\xef\xbb\xbf"), type=kind)
    except msgspec.ValidationError as error:
        raise DataError(f"{where}: {_in_words(str(error))}") from None
    except UnicodeDecodeError:
        raise DataError(f"{where}: not UTF-8, expected a result in JSON") from None
    except (msgspec.DecodeError, RecursionError) as error:
        raise DataError(f"{where}: not a result in JSON ({error})") from None


def _in_words(problem: str) -> str:
    """Return a message of msgspec in this package's wording: where, found, expected."""
    what, _, place = problem.partition(" - at ")
    place = place.strip("`").removeprefix("$").removeprefix(".")
    if missing := re.fullmatch(r"Object missing required field `(\w+)`", what):
        return f"{place}.{missing[1]} is missing".removeprefix(".")
    expected, _, found = what.replace("`", "").replace(" | null", "").partition(", got ")
    found = f"found {found}, " if found else ""
    return f"{place or 'the result'}: {found}{expected[0].lower()}{expected[1:]}"
