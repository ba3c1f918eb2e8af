"""Designs of a sweep: values of varied keys, from ranges, a CSV file or a Latin hypercube, and their thresholds.

Each computation is made once. The numbers of a design are those of its curve alone, to the last bit: each size has
the same places of the triangle, plan and seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import msgspec
import numpy as np

from sensor_sim.chain.camera import Camera, resolve
from sensor_sim.chain.sensor import Sensor
from sensor_sim.chain.vary import FILL_FACTOR, WIDTHS, numeric_keys, value_of, vary, whole_numbers
from sensor_sim.thresholds.curve_plan import not_linear
from sensor_sim.thresholds.predict import PredictedThreshold
from sensor_sim.thresholds.threshold import threshold_at
from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.reading import MAX_ROWS, check_keys, check_positive, distinct_numbers, read_table
from todframes.jobs.fingerprint import fingerprint
from todframes.jobs.run import Run, StoredWork, run_stored
from todframes.observers.interface import BACKGROUND, Observer
from todframes.parameters import PlanName
from todframes.psychometrics.fit import FitSettings
from todframes.psychometrics.threshold_search import IMPOSSIBLE
from todframes.stimulus import Stimulus

MOST_DESIGNS = MAX_ROWS

LUMINANCE = "luminance_cd_m2"
"""Setting of an observer that may be the background of the display."""

NAME_COLUMN = "name"
"""Column of a CSV file of designs that names them."""

Changes = tuple[tuple[str, Any], ...]
"""Changed settings of the observer, by name."""


class Range(NamedTuple):
    """Values of one key from `low` to `high`, by ratios if it `is_log`; `n` of them, or any if `n` is None."""

    low: float
    high: float
    n: int | None
    is_log: bool


class Designs(NamedTuple):
    """Values of some keys of SENSOR.toml and of the observer for each design, (designs, keys), and the designs'
    names, where they have some.
    """

    keys: tuple[str, ...]
    values: FloatArray
    names: tuple[str, ...] | None = None


def parse_range(text: str, where: str) -> Range:
    """Return the range of a text FROM:TO:N, FROM:TO:N:log, FROM:TO or FROM:TO:log; SettingsError, which begins
    with `where`, if it is none.
    """
    *parts, last = text.split(":")
    is_log = last.strip() == "log"
    try:
        low, high, *more = parts if is_log else [*parts, last]
        n = int(more.pop(0)) if more else None
        found = Range(float(low), float(high), n, is_log)
        is_range = -math.inf < found.low < found.high < math.inf and (found.low > 0.0 or not is_log)
        if more or not is_range or (n is not None and n < 2):
            raise ValueError(text)
    except ValueError:
        raise SettingsError(
            f"{where}: found {text!r}, expected FROM:TO:N or FROM:TO:N:log, such as 50:200:7, with finite FROM "
            "below TO, above 0 with log, and N of 2 or more"
        ) from None
    return found


def grid(vary: Mapping[str, str | Sequence[float]], known: Mapping[str, bool]) -> Designs:
    """Return all combinations of some values of each key, or the text of a range; the last key's values change
    fastest. SettingsError if a key is not `known`, a range is invalid, or there are too many designs.
    """
    _check(vary, known)
    axes = [_axis(key, of_key, is_whole=known[key]) for key, of_key in vary.items()]
    _check_number(math.prod(len(axis) for axis in axes))
    values = np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], axis=1)
    return Designs(tuple(vary), values)


def _axis(key: str, of_key: str | Sequence[float], *, is_whole: bool) -> FloatArray:
    where = f"vary {key}"
    if not isinstance(of_key, str):
        values = _finite(of_key, where, is_whole=is_whole)
        if len(np.unique(values)) < len(values):
            raise SettingsError(f"{where}: found a value twice in {of_key!r}, expected each once")
        return values
    span = parse_range(of_key, where)
    if span.n is None:
        raise SettingsError(f"{where}: found {of_key!r}, expected a number of values N: FROM:TO:N")
    _check_number(span.n)
    space = np.geomspace if span.is_log else np.linspace
    values = np.asarray(space(span.low, span.high, span.n))
    if is_whole:
        values = np.rint(values)
        if len(np.unique(values)) < span.n:
            most = math.floor(span.high) - math.ceil(span.low) + 1
            raise SettingsError(
                f"{where}: found {of_key!r}, in which some values are the same whole number; expected fewer, at "
                f"most {max(most, 1)}"
            )
    return values


def _finite(of_key: Sequence[float], where: str, *, is_whole: bool) -> FloatArray:
    values = np.array(of_key, dtype=np.float64)
    if values.ndim != 1 or not len(values) or not np.isfinite(values).all():
        raise SettingsError(f"{where}: found {of_key!r}, expected one or more finite numbers")
    if is_whole and (values != np.rint(values)).any():
        raise SettingsError(f"{where}: found {of_key!r}, expected whole numbers")
    return values


def latin_hypercube(
    vary: Mapping[str, str | Sequence[float]], known: Mapping[str, bool], *, n: int, seed: int
) -> Designs:
    """Return designs that cover ranges evenly: each key's range in `n` equal parts has one design in each.
    SettingsError if a key is not `known`, or a range is invalid or has a number of values.
    """
    from scipy.stats import qmc

    _check(vary, known)
    _check_number(n)
    columns = []
    unit = qmc.LatinHypercube(len(vary), seed=np.random.default_rng(seed)).random(n)
    for (key, text), share in zip(vary.items(), unit.T, strict=True):
        where = f"vary {key}"
        if not isinstance(text, str):
            raise SettingsError(f"{where}: found {text!r}, expected FROM:TO or FROM:TO:log for a sample")
        span = parse_range(text, where)
        if span.n is not None:
            raise SettingsError(
                f"{where}: found {text!r}, expected FROM:TO or FROM:TO:log: N is that of the sample"
            )
        low, high = span.low, span.high
        if known[key]:  # the whole numbers nearest to half a number further: each has the same share
            low, high = (low, high) if span.is_log else (low - 0.5, high + 0.5)
        drawn = low * (high / low) ** share if span.is_log else low + (high - low) * share
        if known[key]:
            drawn = np.clip(np.rint(drawn), math.ceil(span.low), math.floor(span.high))
        columns.append(drawn)
    return Designs(tuple(vary), np.stack(columns, axis=1))


def read_designs(path: Path, known: Mapping[str, bool]) -> Designs:
    """Return the designs of a CSV file: a column for each key, a row for each design, and perhaps a column `name`.
    DataError if the file cannot be read, a column is no key, or a value is no number.
    """
    header, rows = read_table(path)
    keys = [name for name in header if name != NAME_COLUMN]
    try:
        _check(keys, known)
    except SettingsError as error:
        raise DataError(f"{path}: {error}") from None
    values, names = [], []
    for row in rows:
        of_row = row.numbers(keys)
        for key, value in zip(keys, of_row, strict=True):
            if known[key] and value != round(value):
                raise DataError(f"{row.where}: {key}: found {row.texts[key]!r}, expected a whole number")
        values.append(of_row)
        names.append(row.texts.get(NAME_COLUMN, ""))
    if not values:
        raise DataError(f"{path}: found no design, expected a row for each")
    return Designs(tuple(keys), np.array(values), tuple(names) if NAME_COLUMN in header else None)


def make_designs(
    base: Base,
    *,
    vary: Mapping[str, str | Sequence[float]] | None,
    design: Path | str | Sequence[Mapping[str, float]] | None,
    sample: int | None,
    seed: int,
) -> Designs:
    """Return the designs that a call or command asks for, in one of three ways. SettingsError if it asks in none
    of them or in several, or for a design that `grid` or `latin_hypercube` refuses; DataError if a file of designs
    is refused.
    """
    if design is None:
        if not vary:
            raise SettingsError(
                "sweep: found nothing to vary, expected keys with their ranges, or a file of designs"
            )
        if sample is not None:
            return latin_hypercube(vary, base.keys, n=sample, seed=seed)
        return grid(vary, base.keys)
    if vary or sample is not None:
        raise SettingsError("sweep: found designs and also keys to vary or a sample, expected one of them")
    if isinstance(design, Path | str):
        return read_designs(Path(design), base.keys)
    return _listed(design, base.keys)


def _listed(design: Sequence[Mapping[str, float]], known: Mapping[str, bool]) -> Designs:
    keys = list(design[0]) if len(design) else []
    _check(keys, known)
    _check_number(len(design))
    for number_of_design, row in enumerate(design, 1):
        if set(row) != set(keys):
            raise SettingsError(
                f"design {number_of_design}: found keys {', '.join(row)}, expected {', '.join(keys)}"
            )
    columns = [_finite([row[key] for row in design], f"design {key}", is_whole=known[key]) for key in keys]
    return Designs(tuple(keys), np.stack(columns, axis=1))


def _check(keys: Iterable[str], known: Mapping[str, bool]) -> None:
    """Raise SettingsError if a key cannot be varied, there is none, or two set the same value."""
    keys = list(keys)
    if not keys:
        raise SettingsError(f"{argument.vary}: found no key, expected one or more, such as optics.aperture_mm")
    check_keys(keys, known, argument.vary)
    for alike in (
        *((FILL_FACTOR, width) for width in WIDTHS),
        ("observer.internal_noise", "observer.internal_noise_sd"),
    ):
        if set(alike) <= set(keys):
            found = " and ".join(alike)
            raise SettingsError(f"{argument.vary}: found {found}, expected one of them: they set the same value")


def _check_number(n: int) -> None:
    if n < 1:
        raise SettingsError(f"{argument.sample}: found {n}, expected 1 or more designs")
    if n > MOST_DESIGNS:
        raise SettingsError(f"designs: found {n}, expected at most {MOST_DESIGNS}")


@dataclass(frozen=True)
class Base:
    """The sensor and the observer's settings that designs differ from, None if the observer has none. With
    `keep_fill_factor` the detectors' width follows a varied pitch.
    """

    sensor: Sensor
    observer_settings: Any
    keep_fill_factor: bool

    @cached_property
    def keys(self) -> dict[str, bool]:
        """Keys that can be varied, and for each whether its values are whole numbers."""
        keys = numeric_keys(self.sensor)
        if self.observer_settings is not None:
            whole = whole_numbers(self.observer_settings.__class__)
            keys |= {f"observer.{name}": is_whole for name, is_whole in whole.items()}
        return keys

    def design(self, values: Mapping[str, float]) -> tuple[Sensor, Camera, Changes]:
        """Return the sensor and the camera of a design, and the changes of the observer's settings; SettingsError
        if there is no such design.
        """
        of_sensor = {key: value for key, value in values.items() if not key.startswith("observer.")}
        changes: dict[str, Any] = {
            key.removeprefix("observer."): int(value) if self.keys[key] else float(value)
            for key, value in values.items()
            if key not in of_sensor
        }
        sensor = vary(self.sensor, of_sensor, keep_fill_factor=self.keep_fill_factor)
        if getattr(self.observer_settings, LUMINANCE, None) == BACKGROUND:
            changes.setdefault(LUMINANCE, sensor.display.background_luminance_cd_m2)
        if "internal_noise" in changes and getattr(self.observer_settings, "internal_noise_sd", None) is not None:
            changes["internal_noise_sd"] = None  # it would take precedence
        if changes:
            try:
                replace(self.observer_settings, **changes)
            except SettingsError as error:
                raise SettingsError(f"observer.{error}") from None
        return sensor, resolve(sensor), tuple(changes.items())

    def check_moves(self, designs: Designs) -> None:
        """Raise SettingsError if a key changes no threshold of any design, whatever its values."""
        rows = [dict(zip(designs.keys, row, strict=True)) for row in designs.values.tolist()]
        for key in designs.keys:
            values = dict.fromkeys(row[key] for row in rows)
            values |= {} if key.startswith("observer.") else {value_of(self.sensor, key): None}
            differs: set[bool] = set()
            for row in rows:
                other = next((value for value in values if value not in (row[key], None)), None)
                if other is None or True in differs:
                    break
                with suppress(SettingsError):  # no sensor has such a value
                    differs.add(self._decisive(row) != self._decisive(row | {key: other}))
            if differs == {False}:
                raise SettingsError(f"sweep: {key} changes no threshold of this sensor; leave it out")

    def _decisive(self, values: Mapping[str, float]) -> tuple[object, ...]:
        _, camera, changes = self.design(values)
        return camera, camera.mk_per_snr, changes


OBSERVERS_KEPT = 16
"""Number of observers that are kept, each with its readouts, while sensors change."""


class Chain(NamedTuple):
    """Everything that a threshold depends on: the camera, the settings of the observer that are not the usual
    ones, and the size.
    """

    camera: Camera
    observer_changes: Changes
    size_detectors: float


def with_settings(observer: Observer, changes: Changes) -> Observer:
    """Return an observer with some settings changed; SettingsError if a value is refused."""
    if not changes:
        return observer
    kind, settings = type(observer), cast("Any", observer).settings
    return kind(replace(settings, **dict(changes)))


@dataclass(frozen=True, kw_only=True)
class SweepWork(StoredWork[Chain, PredictedThreshold]):
    """Work that computes the threshold of a `Chain`, with the settings of `sensor_sim.curve`."""

    observer: Observer
    p_correct: float
    tolerance: float
    seed: int
    plan: PlanName = "needed"

    def function(self) -> Callable[[Chain], PredictedThreshold]:
        """Return the function of a chain."""
        observer_of = lru_cache(maxsize=OBSERVERS_KEPT)(partial(with_settings, self.observer))

        def compute(chain: Chain) -> PredictedThreshold:
            size = chain.size_detectors
            try:
                return threshold_at(
                    chain.camera,
                    observer_of(chain.observer_changes),
                    size,
                    p_correct=self.p_correct,
                    tolerance=self.tolerance,
                    seed=self.seed,
                    plan=self.plan,
                    n_points=0,
                ).found
            except SettingsError as error:
                return PredictedThreshold(IMPOSSIBLE, size_detectors=size, reason=str(error))
            except MemoryError:
                return PredictedThreshold(
                    IMPOSSIBLE, size_detectors=size, reason="it needs more memory than there is"
                )

        return compute

    def name(self, chain: Chain) -> str:
        """Return the size of the triangles in words."""
        return f"triangles of {chain.size_detectors:g} detectors"

    def identity(self) -> bytes:
        """Return a hash of the settings."""
        return fingerprint(self.observer, self.p_correct, self.tolerance, self.seed, self.plan)

    def item_identity(self, item: Chain) -> str:
        """Return a hash of a sensor, settings of the observer, and a size."""
        return fingerprint(tuple(item)).hex()[:32]

    def decode(self, encoded: bytes) -> PredictedThreshold:
        """Return the result that `encode` made these bytes of."""
        return msgspec.json.decode(encoded, type=PredictedThreshold)


Made = tuple[Sensor, Camera, Changes] | str
"""Sensor and camera of a design and changes of the observer's settings, or why there is no such design."""


class Swept(NamedTuple):
    """All designs of a sweep with their thresholds, (designs, sizes). Of these `n_computed` were computed; designs
    that differ in noise alone have theirs in common.
    """

    made: list[Made]
    thresholds: list[list[PredictedThreshold]]
    n_computed: int


def check_sweep(
    sensor: Sensor, observer: Observer, sizes: Sequence[float], *, p_correct: float, tolerance: float
) -> None:
    """Check what is the same for all designs; SettingsError if a value is out of its range, a size is there twice,
    or the observer is not linear.
    """
    FitSettings(p_correct=p_correct)  # checks it
    check_positive(argument.tolerance, tolerance)
    distinct_numbers(argument.size_detectors, sizes)
    try:
        readout = observer.readout(Stimulus(sizes[0] * sensor.display.detector_pitch_mrad))
    except SettingsError:
        return  # this size is impossible for the sensor as it is, but perhaps not for all designs
    if readout is None:
        raise not_linear()


def plan_sweep(base: Base, designs: Designs, sizes: Sequence[float]) -> tuple[list[Chain], list[Made]]:
    """Return the computations that designs need, once, size by size, so that neighbours share most; and the
    designs.
    """
    made: list[Made] = []
    for values in designs.values.tolist():
        try:
            made.append(base.design(dict(zip(designs.keys, values, strict=True))))
        except SettingsError as error:
            made.append(str(error))
    unique = dict.fromkeys(design[1:] for design in made if not isinstance(design, str))
    return [Chain(*each, size) for size in sizes for each in unique], made


def run_sweep(base: Base, designs: Designs, sizes: Sequence[float], work: SweepWork, run: Run) -> Swept:
    """Compute the thresholds of all designs; OutputError if the store of the run cannot be written."""
    chains, made = plan_sweep(base, designs, sizes)
    found = {chains[number]: threshold for number, threshold in run_stored(work, chains, run)}
    rows = [
        [PredictedThreshold(IMPOSSIBLE, reason=design)] * len(sizes)
        if isinstance(design, str)
        else [found[Chain(*design[1:], size)] for size in sizes]
        for design in made
    ]
    return Swept(made, rows, len(chains))
