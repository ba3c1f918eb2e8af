"""The base class of observers: a stimulus in, weights on the retina and noise on the four scores out.

A linear observer needs no more than a `Readout`: its four scores are inner products with the retina image, and the
noise on all its neurons reaches the decision as one four-vector. An observer that is not linear returns its own
answers.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import cached_property, wraps
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Concatenate,
    Literal,
    NamedTuple,
    ParamSpec,
    TypeVar,
    cast,
)

import numpy as np
from msgspec import Meta

from todframes.base._typing import FloatArray, Json
from todframes.base.errors import SettingsError
from todframes.base.reading import check_keys, checked, settings_path
from todframes.base.user_code import import_named, registered
from todframes.observers.decision import answer_probabilities
from todframes.observers.internal_noise import Bands, edgeworth_correction, inner_product
from todframes.observers.retina import RetinaGrid
from todframes.stimulus import Centre, Orientation, Stimulus

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

ENTRY_POINT_GROUP = "todframes.observers"

FILE_GROUP = "todframes.observer_files"
"""Entry-point group of functions that return the observer in a file; its name is that of the entry point, `:` and
the file."""

SECOND_ORDER = 20.0

SETTINGS_FOLDER = Path(__file__).with_name("settings")
"""Settings of observers that this package provides."""

MODELFEST_CD_M2 = 30.0
"""Luminance of the displays of ModelFest."""

REFERENCE_AGE_YEARS = 28.58
"""Mean age of the people to whom the formula of the pupil's diameter was fitted."""

BACKGROUND = "background"

PYRAMID_LEVELS = "pyramid levels"
"""Name of what most observers omit."""

P = ParamSpec("P")
S = TypeVar("S")
T = TypeVar("T")


def keeps_last(most: int) -> Callable[[Callable[Concatenate[S, P], T]], Callable[Concatenate[S, P], T]]:
    """Return a decorator of methods whose last results, so many of them, are kept in the object. A cache of the
    class would keep every object alive. Results are not pickled, see `Observer.__getstate__`.
    """

    def decorated(method: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
        @wraps(method)
        def result(self: S, *args: P.args, **kwargs: P.kwargs) -> T:
            results = vars(self).setdefault(CACHE, {}).setdefault(method.__qualname__, {})
            key = (*args, *kwargs.items())
            if key not in results:
                new = method(self, *args, **kwargs)
                for oldest in list(results)[: max(len(results) - most + 1, 0)]:
                    results.pop(oldest, None)
                results[key] = new
                return new
            return cast("T", results[key])

        return cast("Callable[Concatenate[S, P], T]", result)

    return decorated


CACHE = "_cache"
"""Attribute of an object with the results that `keeps_last` keeps."""


@dataclass(frozen=True, eq=False)
class Readout:
    """A linear observer of one stimulus: the weight of each retina sample in each of the four scores.

    The four templates are nearly equal, so they are kept as their mean and the deviations from it. The noise
    covariance is computed from the deviations, so the common part costs no digits.

    Attributes
    ----------
    grid : RetinaGrid
    find_common : function of no arguments
        Returns `common`, the weights that all four scores share, (side, side). Decisions do not need them, so they
        are computed only if the scores themselves are needed.
    deviations : ndarray, shape (4, side, side)
        Weights of each score minus `common`, in the order of `ORIENTATIONS`.
    noise_covariance : ndarray, shape (4, 4)
        Covariance of the internal noise on the four scores, minus the noise that they share.
    excess_kurtosis : float
        Excess kurtosis of the noise on the difference of two scores, for the pair that is farthest from 0, the
        value of a Gaussian.
    find_fourth_cumulants : function of no arguments, or None
        Returns `fourth_cumulants`, (4, 4, 4, 4), of the same noise as `noise_covariance`, when a decision needs
        them. None: decisions take the noise as Gaussian.

    Examples
    --------
    >>> import todframes as tod
    >>> readout = tod.PyramidObserver().readout(tod.Stimulus(size_mrad=2.4))
    >>> readout.noise_covariance.shape
    (4, 4)
    """

    grid: RetinaGrid
    find_common: Callable[[], FloatArray]
    deviations: FloatArray
    noise_covariance: FloatArray
    excess_kurtosis: float
    find_fourth_cumulants: Callable[[], FloatArray] | None = None

    @cached_property
    def common(self) -> FloatArray:
        """Weights that all four scores share: (side, side)."""
        return self.find_common()

    @cached_property
    def weights_key(self) -> bytes:
        """Hash of the grid and of `deviations`: readouts of the same weights share it, whatever their noise."""
        digest = hashlib.blake2b(repr((self.grid, self.deviations.shape)).encode(), digest_size=32)
        digest.update(np.ascontiguousarray(self.deviations[:1] if self.is_symmetric else self.deviations).data)
        return digest.digest()

    @cached_property
    def is_symmetric(self) -> bool:
        """Whether the templates of the four scores are turns of each other, to the last bit."""
        first, covariance = self.deviations[0], self.noise_covariance
        return all(
            np.array_equal(other, np.rot90(first, -k))
            and np.allclose(np.roll(covariance[0], k), covariance[k], rtol=1e-12)
            for k, other in enumerate(self.deviations[1:], 1)
        )

    @cached_property
    def norm(self) -> float:
        """Euclidean norm of `deviations`."""
        return float(np.linalg.norm(self.deviations))

    @cached_property
    def fourth_cumulants(self) -> FloatArray | None:
        """Fourth cumulants of the noise on the scores, (4, 4, 4, 4); None if the noise is taken as Gaussian."""
        return None if self.find_fourth_cumulants is None else self.find_fourth_cumulants()

    def scores(self, contrast: FloatArray) -> FloatArray:
        """Compute the noise-free inner products of a retina image, (side, side), with the four templates: (4,)."""
        return self.score_deviations(contrast) + self.common_score(contrast)

    def score_deviations(self, contrast: FloatArray) -> FloatArray:
        """Compute the scores minus their mean, with all digits: (4,). The decision needs no more. Deviations that
        are rounding are 0: without noise or with huge contrast, equal scores may differ by it alone.
        """
        deviations = self.deviations.reshape(4, -1) @ contrast.reshape(-1)
        rounding = 1e-13 * self.norm * math.sqrt(np.vecdot(contrast, contrast).sum())
        return np.where(np.abs(deviations) < rounding, 0.0, deviations)

    def common_score(self, contrast: FloatArray) -> float:
        """Compute the mean of the four scores."""
        return inner_product(self.common, contrast)

    @keeps_last(2)
    def cropped(self, half_width: int) -> Readout:
        """Return the readout of the middle of the grid only: so many samples on each side of the middle one."""
        margin = self.grid.side // 2 - half_width
        inner = slice(margin, self.grid.side - margin)
        return replace(
            self,
            grid=RetinaGrid(2 * half_width + 1, self.grid.pitch_mrad),
            find_common=lambda: np.ascontiguousarray(self.common[inner, inner]),
            deviations=np.ascontiguousarray(self.deviations[:, inner, inner]),
        )

    def answer_probabilities(self, deviations: FloatArray) -> FloatArray:
        """Compute the probability of each answer under the internal noise, for score deviations of shape (..., 4).

        If the fourth cumulants of the summed noise are known, its deviation from a Gaussian is corrected to first
        order.
        """
        probability: FloatArray = answer_probabilities(deviations, self.noise_covariance)
        if self.fourth_cumulants is None or not self.noise_covariance.any():
            return probability
        change = edgeworth_correction(deviations, self.noise_covariance, self.fourth_cumulants)
        # The change of an improbable answer is a factor: the term itself could make it negative.
        factor = np.exp(np.clip(change / np.maximum(probability, 1e-300), -1.0, 1.0))
        changed = probability * factor
        largest = probability.argmax(axis=-1)[..., None]
        np.put_along_axis(changed, largest, 0.0, axis=-1)
        np.put_along_axis(changed, largest, 1.0 - changed.sum(axis=-1, keepdims=True), axis=-1)
        return changed

    @property
    def non_gaussian_bound(self) -> float:
        """Bound on the error in P(correct) from noise that is not Gaussian.

        The bound is of first order in the kurtosis. If that order is corrected, it is twenty times the square,
        which is two to five times the errors found for triangles of 0.1 to 2 mrad.
        """
        first_order = non_gaussian_bound(self.excess_kurtosis)
        return first_order if self.find_fourth_cumulants is None else SECOND_ORDER * first_order**2


class OmittedWeights(NamedTuple):
    """Weights that a readout omits to save time.

    Attributes
    ----------
    grid : RetinaGrid
        May be coarser than the readout's; its middle lies at the same place.
    kept : ndarray, shape (4, side, side)
        The readout's own weights on this grid, approximately.
    deviations : ndarray, shape (4, side, side)
        Weights that are missing from them.
    noise_covariance : ndarray, shape (4, 4)
        Covariance that is missing from the readout's.
    """

    grid: RetinaGrid
    kept: FloatArray
    deviations: FloatArray
    noise_covariance: FloatArray


def non_gaussian_bound(excess_kurtosis: float) -> float:
    """Bound the error in P(correct) from taking noise on score differences as Gaussian, to first order. The first
    Edgeworth term of one score difference is κ/24 · He₃(x) φ(x), at most 0.5506 |κ| / 24; three differences
    decide.
    """
    return 3.0 * 0.5506 / 24.0 * abs(excess_kurtosis)


class Detection(NamedTuple):
    """A linear observer of one pattern that is there or not: the score is an inner product with the retina image.

    Attributes
    ----------
    weights : ndarray, shape (side, side)
        Weights of the retina samples; the middle one lies on the pattern's middle.
    noise_variance : float
        Variance of the internal noise on the score.
    """

    weights: FloatArray
    noise_variance: float


@dataclass(frozen=True, slots=True, kw_only=True)
class EyeSettings:
    """Settings of an observer with an eye.

    Attributes
    ----------
    luminance_cd_m2 : float or "background"
        Luminance of the background to which the eye is adapted, or that of the display.
    age_years : float
        Age of the eye in years, on which its pupil depends; all else is as in young eyes.
    pupil_mm : float or None
        Diameter of the pupil, instead of the one that follows from light and age.
    """

    luminance_cd_m2: Annotated[float, Meta(ge=0.02, le=300.0)] | Literal["background"] = MODELFEST_CD_M2
    age_years: Annotated[float, Meta(ge=20.0, le=83.0)] = REFERENCE_AGE_YEARS
    pupil_mm: Annotated[float, Meta(ge=1.5, le=8.0)] | None = None

    @property
    def known_luminance(self) -> float:
        """Luminance in cd/m²; SettingsError if it is that of a display, which `adapted` has not replaced."""
        if self.luminance_cd_m2 == BACKGROUND:
            raise SettingsError("luminance_cd_m2: found background where there is no display, expected a number")
        return float(self.luminance_cd_m2)


@dataclass(frozen=True, slots=True)
class NoSettings:
    """Settings of an observer that has none."""


class Observer:
    """Base class of all observers; register a subclass under the entry-point group `todframes.observers`.

    A subclass has a `grid` and can `respond`. All other abilities are optional, and by default they are missing: a
    method then returns None, or the observer itself. `check_observer` reports what a subclass does wrong.

    Parameters
    ----------
    settings : dataclass, optional
        Of the type `settings_type`. Default: its defaults.
    **changes
        Settings by name, in place of those of `settings`.

    Attributes
    ----------
    settings_type : type
        Frozen dataclass whose fields are the names that users set.
    omitted_part : str
        Name of what the readout omits.

    Raises
    ------
    SettingsError
        If there is no such setting, or a value is out of its range.
    """

    settings_type: ClassVar[type[Any]] = NoSettings
    omitted_part: ClassVar[str] = PYRAMID_LEVELS

    def __init__(self, settings: Any = None, **changes: Any) -> None:
        check_keys(changes, [field.name for field in fields(self.settings_type)], "settings")
        self.settings = replace(settings if settings is not None else self.settings_type(), **changes)

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle, without the results that are kept."""
        return {name: value for name, value in vars(self).items() if name != CACHE}

    @cached_property
    def centre(self) -> Centre:
        """Point of the triangle on which the middle of the grid lies: the setting `centre`, or the centroid."""
        centre: Centre = getattr(self.settings, "centre", "centroid")
        return centre

    @cached_property
    def position_jitter_samples(self) -> float:
        """Largest displacement of the grid along x and y in a trial, in retina samples: the setting, or 0."""
        return float(getattr(self.settings, "position_jitter_samples", 0.0))

    @property
    def own_name(self) -> str:
        """Name in results of an observer that is in a file. Default: empty, it is that of the class."""
        return ""

    def pixel_offset(self, stimulus: Stimulus) -> tuple[float, float] | None:  # noqa: ARG002
        """Return the vector (x, y), in samples, from the middle of what it looks at to that of its grid, if its
        samples are to be pixels of frames: the grid then moves by half a pixel at most, so that it divides none.
        Default: None, the middle of the grid lies on the triangle, wherever pixels are.
        """
        return None

    def grid(self, stimulus: Stimulus) -> RetinaGrid:
        """Return the retina samples that the observer looks at."""
        raise NotImplementedError

    def respond(self, contrast: FloatArray, stimulus: Stimulus, rng: np.random.Generator) -> Orientation:
        """Answer a retina image of shape (side, side) once, with internal noise drawn from `rng`."""
        raise NotImplementedError

    def expected_answers(self, contrast: FloatArray, stimulus: Stimulus) -> FloatArray | None:  # noqa: ARG002
        """Compute the probabilities of the four answers to a retina image, of an observer that is not linear.
        Default: None, answers are drawn.
        """
        return None

    @property
    def knows_probabilities(self) -> bool:
        """Whether the observer has `expected_answers`."""
        return type(self).expected_answers is not Observer.expected_answers

    def on_display(self, display: Any, find_background: Callable[[], float]) -> Observer:  # noqa: ARG002
        """Return the observer of the pixels and code values of a display, whose background in cd/m² the function
        finds. Default: itself, it depends on contrast alone.
        """
        return self

    @keeps_last(2)
    def readout(self, stimulus: Stimulus) -> Readout | None:
        """Return the readout that `make_readout` makes; the last two are kept."""
        return self.make_readout(stimulus)

    def make_readout(self, stimulus: Stimulus) -> Readout | None:  # noqa: ARG002 - subclasses need it
        """Compute the readout of a linear observer. Default: None, it is not linear and can only `respond`."""
        return None

    def linear_readout(self, stimulus: Stimulus) -> Readout:
        """Return the readout; SettingsError if the observer is not linear."""
        readout = self.readout(stimulus)
        if readout is None:
            raise SettingsError("observer: it is not linear; the probability of its answers cannot be computed")
        return readout

    def activity(self, contrast: FloatArray) -> Bands:  # noqa: ARG002
        """Return the noise-free activity of all neurons for a retina image of shape (side, side).

        It is shown in reports: arrays with the same middle as the retina grid. Default: none.
        """
        return ()

    def omitted_bands(self, stimulus: Stimulus) -> OmittedWeights | None:  # noqa: ARG002
        """Estimate what the readout omits. Default: None, it omits nothing."""
        return None

    def with_extra_level(self) -> Observer:
        """Return the observer with one extra level, which omits nothing that matters. Default: itself."""
        return self

    def detection(self, pattern: FloatArray, width_mrad: float, half_width: int) -> Detection | None:  # noqa: ARG002
        """Fold the observer of a pattern that it knows beforehand onto the middle of its retina.

        Default: None, it judges triangles only.

        Parameters
        ----------
        pattern : ndarray, shape (2n + 1, 2n + 1)
            Contrast of the pattern on the retina's middle; beyond it there is nothing.
        width_mrad : float
            Visual angle of the pattern: the observer looks at a field as for a triangle of this √area.
        half_width : int
            Samples on each side of the retina's middle one that are asked for.
        """
        return None

    def with_retina_step(self, factor: float) -> Observer | None:  # noqa: ARG002
        """Return the observer on a retina of so many times the pitch, where that is the step of a computation: it
        shows what the step changes. Default: None, the pitch is a part of the model. SettingsError if there is no
        such observer.
        """
        return None


@checked
def find_observer(name: str) -> type[Observer]:
    """Return the class of the observer with a given name.

    Parameters
    ----------
    name : str
        That of an entry point of the group `todframes.observers`, or `module:Class`, which is imported.

    Returns
    -------
    type
        Subclass of `Observer`.

    Raises
    ------
    SettingsError
        If there is none of this name, or it cannot be imported.

    Examples
    --------
    >>> import todframes as tod
    >>> tod.find_observer("csf").__name__
    'CsfObserver'
    """
    if ":" in name:
        module, _, class_name = name.partition(":")
        if module in registered(FILE_GROUP):
            raise SettingsError(f"observer: {name!r} is an observer in a file, expected the name of a class")
        kind = import_named(module, class_name, f"observer: {name!r}")
    else:
        entries = registered(ENTRY_POINT_GROUP)
        check_keys([name], entries, "observer")
        kind = _loaded(entries[name])
    if isinstance(kind, type) and issubclass(kind, Observer):
        return kind
    raise SettingsError(f"observer: {name!r}: found no observer, expected a subclass of todframes.Observer")


def _loaded(entry: EntryPoint) -> Any:
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        raise SettingsError(f"observer: {entry.name!r} cannot be loaded ({error})") from None


def observer_named(name: str) -> Observer:
    """Return the observer with a given name and its default settings: that of `find_observer`, or the one in a
    file after the name of an entry point of the group `todframes.observer_files`: "onnx:classifier.onnx".
    """
    head, colon, file = name.partition(":")
    if colon and head in (readers := registered(FILE_GROUP)):
        if not file:
            raise SettingsError(f"observer: found {name!r}, expected {head}:FILE")
        read: Callable[[str], Observer] = _loaded(readers[head])
        return read(file)
    kind = find_observer(name)
    return kind(kind.settings_type())


def setting_names(settings: Any) -> list[str]:
    """Return the names of the settings of an observer; fields that its dataclass does not show are none."""
    return [field.name for field in fields(settings) if field.repr]


def observers_with(setting: str) -> list[str]:
    """Return the names of the registered observers that have a setting; those that cannot be loaded have none."""
    judges = []
    for name in registered(ENTRY_POINT_GROUP):
        try:
            kind = find_observer(name)
        except SettingsError:
            continue
        if setting in [field.name for field in fields(kind.settings_type)]:
            judges.append(name)
    return judges


def settings_file(name: Path | str) -> Path:
    """Return the path of a file of settings, or that of the settings of this package with a name; SettingsError if
    there is none.
    """
    path = Path(name)
    return path if path.exists() else settings_path(name, SETTINGS_FOLDER, "observer settings")


def resolve_observer(
    observer: str | Observer, find_background: Callable[[], float] | None = None
) -> tuple[Observer, Json]:
    """Return an observer, made if only its name is given, and its name and settings as JSON values. With the
    function that returns the background of a display in cd/m², it is `adapted` to it.
    """
    if isinstance(observer, str):
        name, observer = observer, observer_named(observer)
    else:
        if not isinstance(observer, Observer):
            raise SettingsError(
                f"observer: found {observer!r:.80}, expected an object of a subclass of todframes.Observer"
            )
        name = observer.own_name or _name(type(observer))
    if find_background is not None:
        observer = adapted(observer, find_background)
    return observer, {"observer": name, **settings_json(observer)}


def settings_json(observer: Observer) -> Json:
    """Return the settings of an observer as JSON values."""
    settings = getattr(observer, "settings", None)
    if not is_dataclass(settings) or isinstance(settings, type):
        return {}
    values = {name: getattr(settings, name) for name in setting_names(settings)}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in values.items()}


def _name(kind: type) -> str:
    """Return the name that a class is registered under, or "module:Class" if it is not registered."""
    for entry in registered(ENTRY_POINT_GROUP).values():
        if entry.module in sys.modules and entry.load() is kind:
            return entry.name
    return f"{kind.__module__}:{kind.__qualname__}"


def adapted(observer: Observer, find_background: Callable[[], float]) -> Observer:
    """Return the observer adapted to the background of a display, in cd/m², if its settings ask for that."""
    settings: Any = getattr(observer, "settings", None)
    if getattr(settings, "luminance_cd_m2", None) != BACKGROUND:
        return observer
    luminance = find_background()
    try:
        return type(observer)(replace(settings, luminance_cd_m2=luminance))
    except SettingsError as error:
        raise SettingsError(f"the background of the display: {error}") from None
