"""Thresholds of many designs of a sensor: each computation once, in an order in which neighbours share parts.

The numbers of a design are those of its curve alone, to the last bit: the key of a shared part holds everything on
which its value depends, and each size has the same places of the triangle, plan and seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, NamedTuple, cast

import msgspec

from sensor_sim.chain.camera import Camera
from sensor_sim.chain.sensor import Sensor
from sensor_sim.sweeps.designs import Base, Changes, Designs
from sensor_sim.thresholds.curve_plan import not_linear
from sensor_sim.thresholds.predict import PredictedThreshold
from sensor_sim.thresholds.sharing import Caches
from sensor_sim.thresholds.threshold import threshold_at
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_positive, distinct_numbers
from todframes.jobs.fingerprint import fingerprint
from todframes.jobs.run import Run, StoredWork, run_stored
from todframes.observers.interface import Observer
from todframes.parameters import PlanName
from todframes.psychometrics.fit import FitSettings
from todframes.psychometrics.threshold_search import IMPOSSIBLE
from todframes.stimulus import Stimulus

SHARED_MB = 512
"""Largest size of the parts that are shared, in each process, in units of 2**20 bytes."""

ALIKE_TOGETHER = 8
"""Number of displays whose weights are kept while the sensors before them change; more may not fit."""

OBSERVERS_KEPT = 4
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
    """Work that computes the threshold of a `Chain`, with the settings of `sensor_sim.curve`. No number depends on
    `shared_mb`, the largest size of the parts that are shared, in units of 2**20 bytes.
    """

    observer: Observer
    p_correct: float
    tolerance: float
    seed: int
    plan: PlanName = "needed"
    shared_mb: int = SHARED_MB

    def function(self) -> Callable[[Chain], PredictedThreshold]:
        """Return the function of a chain; the parts that chains share are kept as long as the function."""
        shared = Caches.of(self.shared_mb * 2**20)
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
                    shared=shared,
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
    """Return the computations that designs need, once, ordered so that neighbours share most; and the designs."""
    made: list[Made] = []
    for values in designs.values.tolist():
        try:
            made.append(base.design(dict(zip(designs.keys, values, strict=True))))
        except SettingsError as error:
            made.append(str(error))
    ordered = _ordered(dict.fromkeys(design[1:] for design in made if not isinstance(design, str)))
    return [Chain(*each, size) for size in sizes for each in ordered], made


def _ordered(unique: Iterable[tuple[Camera, Changes]]) -> list[tuple[Camera, Changes]]:
    """Return sensors in the order in which neighbours share most. Samples depend on what is before the detectors,
    weights on what is behind them. A few observers, and the weights of a few displays, stay in memory while the
    samples change.
    """
    before: dict[Any, int] = {}
    behind: dict[Any, int] = {}
    observers: dict[Changes, int] = {}

    def place(sensor: tuple[Camera, Changes]) -> tuple[int, ...]:
        camera, changes = sensor
        sampled = before.setdefault(camera.samples_key, len(before))
        # Displays that differ in gain alone, and observers in noise alone, share weights and stay neighbours.
        weighed = behind.setdefault(camera.weights_key, len(behind))
        observer = observers.setdefault(changes, len(observers))
        return observer // OBSERVERS_KEPT, weighed // ALIKE_TOGETHER, sampled, weighed

    return sorted(unique, key=place)


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
