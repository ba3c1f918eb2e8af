"""Enhancement algorithms: functions of an image and named parameters, with an optional declaration.

Any function that takes an image of code values and returns one of the same shape is an algorithm.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import Positive, WarmUpFrames, check_keys, check_values, checked, convert, toml_value
from todframes.base.user_code import in_words

Domain = Literal["code_value", "luminance"]

Image = NDArray[np.floating]

F = TypeVar("F", bound=Callable[..., Any])

REFERENCE = "none"
"""Name of the algorithm that leaves frames as they are."""

DECLARATION = "todframes_enhancement"
"""Name of the function attribute that holds its declaration."""

ROUNDING = 1e-6
"""Largest excess of a value over its range that counts as rounding of 32-bit values near 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Declaration:
    """Decorator that declares the properties of `function(image, **parameters)`, an enhancement algorithm.

    The image has shape (rows, columns), or (rows, columns, 3) if a frame is in colour, and 32-bit values. The
    function returns an image of this shape times the magnification. The first line of its docstring describes it
    in lists and reports; parameters may be annotated with `parameter`.

    With `clip`, the function takes frames of shape (n, rows, columns) or (n, rows, columns, 3), in the order of
    time: `warm_up_frames` that come before the trial in its recording, then those of the trial. It returns one
    frame for each of the trial: (m, rows, columns[, 3]). It may have two keyword-only parameters that users do not
    set: `judged`, an array of the m indices of the trial's frames, and `frame_rate_hz`, None if it is not known.

    Attributes
    ----------
    domain : {"code_value", "luminance"}
        Values of the image: code values with white as 1, or luminance with black as 0 and white as 1.
    magnification : float or str
        Number of output pixels for one input pixel along each axis, or the name of the parameter with this number.
    each_channel : bool
        Whether it takes one channel at a time; otherwise it takes a colour image whole.
    writes : bool
        Whether it may write into the image; if so, it gets a copy.
    clip : bool
        Whether it takes the frames of a trial together.
    warm_up_frames : int or str
        Number of frames before a trial that an algorithm of clips needs, or the name of the parameter with it.
    library : str
        Library and function that do the work.

    Raises
    ------
    SettingsError
        If the domain, the magnification or the number of frames of warm-up is not valid.

    Examples
    --------
    >>> import todframes as tod
    >>> @tod.algorithm(library="mine")
    ... def brighter(image):
    ...     return image + 0.1
    >>> tod.find_enhancement(brighter).declaration.library
    'mine'
    """

    domain: Domain = "code_value"
    magnification: Positive | str = 1.0
    each_channel: bool = False
    writes: bool = True
    clip: bool = False
    warm_up_frames: WarmUpFrames | str = 0
    library: str = ""

    def __post_init__(self) -> None:
        check_values(self)
        if self.warm_up_frames != 0 and not self.clip:
            raise SettingsError(f"warm_up_frames: found {self.warm_up_frames!r} without clip, expected 0")

    def __call__(self, function: F) -> F:
        """Return the function with this declaration."""
        setattr(function, DECLARATION, self)
        return function


algorithm = Declaration


@checked
def parameter(low: float, high: float, *, unit: str = "", what: str = "") -> msgspec.Meta:
    """Return a parameter's range, unit and meaning for annotations: `Annotated[float, parameter(0.1, 50.0)]`.

    Parameters
    ----------
    low, high : float
        Smallest and largest value.
    unit, what : str
        Unit, and meaning in a few words, for lists and reports.

    Returns
    -------
    msgspec.Meta
        The annotation.

    Examples
    --------
    >>> from typing import Annotated
    >>> import todframes as tod
    >>> def scaled(image, factor: Annotated[float, tod.parameter(0.1, 10.0, what="factor of all values")] = 2.0):
    ...     return factor * image
    >>> tod.find_enhancement(scaled).parameters[0].name
    'factor'
    """
    return msgspec.Meta(ge=low, le=high, description=what, extra={"unit": unit})


def meaning(what: str) -> msgspec.Meta:
    """Return the meaning of a parameter without a range for its annotation."""
    return msgspec.Meta(description=what)


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter of an algorithm; `kind` is its type, with a range if the function declares one."""

    name: str
    kind: Any
    default: Any

    @property
    def meta(self) -> msgspec.Meta:
        """Range, unit and meaning of the parameter; empty if the function does not declare them."""
        found = [part for part in get_args(self.kind) if isinstance(part, msgspec.Meta)]
        return found[0] if found else msgspec.Meta()

    @property
    def choices(self) -> tuple[Any, ...]:
        """The allowed values of a parameter of type Literal; empty for other types."""
        kind = get_args(self.kind)[0] if get_origin(self.kind) is Annotated else self.kind
        return get_args(kind) if get_origin(kind) is Literal else ()


@dataclass(frozen=True, slots=True)
class Enhancement:
    """An algorithm with the values of its parameters.

    Attributes
    ----------
    name, spec : str
        Text that the user wrote (`spec`), and its part before the parameters (`name`).
    function : function of an image and keyword parameters
    values : mapping of str to value
        Values of the parameters.
    displacement_px : tuple of float
        How far its pictures lie to the right and down, in pixels of the frame; `compare` finds it.
    """

    name: str
    spec: str
    function: Callable[..., Any]
    values: Mapping[str, Any] = field(default_factory=dict)
    displacement_px: tuple[float, float] = (0.0, 0.0)

    @property
    def declaration(self) -> Declaration:
        """The properties that the author has declared with `algorithm`."""
        declared: Declaration = getattr(self.function, DECLARATION, Declaration())
        return declared

    @property
    def context(self) -> list[str]:
        """The parameters of the function that users do not set: "judged", "frame_rate_hz"."""
        names = ("judged", "frame_rate_hz") if self.declaration.clip else ()
        return [name for name in names if name in inspect.signature(self.function).parameters]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The parameters of the function that users may set."""
        try:
            kinds = get_type_hints(self.function, include_extras=True)
        except Exception:  # annotations may use names that exist for type checkers only
            kinds = {}
        _, *others = inspect.signature(self.function).parameters.values()
        return tuple(
            Parameter(each.name, kinds.get(each.name, _kind_of(each.default)), each.default)
            for each in others
            if each.kind in (each.KEYWORD_ONLY, each.POSITIONAL_OR_KEYWORD) and each.name not in self.context
        )

    @property
    def what(self) -> str:
        """The first line of the function's docstring; empty if there is none."""
        return (inspect.getdoc(self.function) or "").partition("\n")[0]

    @property
    def is_reference(self) -> bool:
        """True for the algorithm that leaves frames as they are."""
        return self.name == REFERENCE

    @property
    def magnification(self) -> float:
        """Number of output pixels for one input pixel along each axis."""
        declared = self.declaration.magnification
        return float(self.values[declared] if isinstance(declared, str) else declared)

    @property
    def warm_up_frames(self) -> int:
        """Number of frames before a trial that the algorithm needs."""
        declared = self.declaration.warm_up_frames
        return int(self.values[declared] if isinstance(declared, str) else declared)

    def run(self, image: Image) -> tuple[Image, float]:
        """Return an image, (rows, columns[, 3]), after the algorithm, and its processor time in s.

        DataError, with the algorithm's name, if the function fails or returns anything but finite floating-point
        numbers of the given shape times the magnification.
        """
        return self._applied(image, {}, ())

    def run_clip(
        self, frames: Image, judged: NDArray[np.intp], frame_rate_hz: float | None
    ) -> tuple[Image, float]:
        """Return the judged ones of frames in the order of time, (n, rows, columns[, 3]), after the algorithm.

        Then comes the processor time; DataError as `run` raises it, also for another number of frames.
        """
        known = {"judged": judged, "frame_rate_hz": frame_rate_hz}
        return self._applied(frames, {name: known[name] for name in self.context}, (len(judged),))

    def _applied(self, image: Image, context: Mapping[str, Any], n_judged: tuple[int, ...]) -> tuple[Image, float]:
        """Apply the algorithm to an image, or to frames of which `n_judged` come back, and check the result."""
        n_leading = len(n_judged)
        if self.declaration.each_channel and image.ndim == 3 + n_leading:
            each = (np.ascontiguousarray(image[..., k]) for k in range(3))
            channels, times = zip(*(self._applied(one, context, n_judged) for one in each), strict=True)
            return np.stack(channels, axis=-1), sum(times)
        given = image.copy() if self.declaration.writes else image
        started = time.process_time()  # the threads of libraries count
        try:
            with np.errstate(all="ignore"):  # the result is checked below
                found = self.function(given, **self.values, **context)
        except SystemExit:
            raise DataError(f"{self.spec}: called sys.exit, expected it to return") from None
        except Exception as error:
            raise DataError(f"{self.spec}: {in_words(error)}") from None
        cpu_s = time.process_time() - started
        sides = [self.magnification * side for side in image.shape[n_leading:][:2]]
        expected = (*n_judged, *map(round, sides), *image.shape[n_leading + 2 :])
        if not isinstance(found, np.ndarray) or found.dtype.kind != "f":
            kind = f"values of {found.dtype}" if isinstance(found, np.ndarray) else type(found).__name__
            raise DataError(f"{self.spec}: gave {kind}, expected an array of floating-point numbers")
        if found.shape != expected or any(abs(side - round(side)) > 1e-6 for side in sides):
            raise DataError(
                f"{self.spec}: gave shape {found.shape} for {image.shape}, expected {expected} with the declared "
                f"magnification of {self.magnification:g}"
            )
        if not (np.isfinite(found.min()) and np.isfinite(found.max())):
            bad = np.argwhere(~np.isfinite(found))
            *of_frame, row, column = bad[0, : n_leading + 2]
            where = f"frame {of_frame[0]}, " if of_frame else ""
            raise DataError(
                f"{self.spec}: gave {len(bad)} values that are NaN or infinite, the first at {where}row {row}, "
                f"column {column}"
            )
        return found, cpu_s


def _kind_of(default: object) -> Any:
    """Return the type of a parameter without an annotation, from its default."""
    if isinstance(default, bool | str):
        return type(default)
    return float if isinstance(default, int | float) else Any


def values_of(
    algorithm: Enhancement, assignments: str, where: str, given: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the values of all parameters: those in `assignments`, `name=value,…`, then `given`, then defaults."""
    known = {own.name: own for own in algorithm.parameters}
    signature = inspect.signature(algorithm.function).parameters.values()
    takes_any = any(each.kind is each.VAR_KEYWORD for each in signature)
    assigned: dict[str, Any] = {}
    written: set[str] = set()
    for assignment in filter(None, assignments.split(",")):
        name, equals, text = (part.strip() for part in assignment.partition("="))
        if not equals or not name or not text:
            raise SettingsError(f"{where}: found {assignment!r}, expected parameter=value")
        if name in written:
            raise SettingsError(f"{where}: found {name} twice, expected it once")
        written.add(name)
        try:
            value = toml_value(text)
        except ValueError:
            raise SettingsError(f"{where}: found {assignment!r}, expected parameter=value") from None
        table, dot, key = name.partition(".")
        if dot and table in known:  # an entry of a table, as TOML writes it: name.key=value
            name, value = table, dict(assigned.get(table) or (given or {}).get(table) or {}) | {key: value}
        if not takes_any:
            check_keys([name], known, where)
        assigned[name] = convert(value, known[name].kind, f"{where}: {name}") if name in known else value
    for name, own in known.items():
        if own.default is inspect.Parameter.empty and name not in assigned:
            raise SettingsError(f"{where}: parameter {name!r} is missing")
    return {name: own.default for name, own in known.items()} | dict(given or {}) | assigned
