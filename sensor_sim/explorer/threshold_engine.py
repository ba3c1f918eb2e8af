"""Thresholds of one sensor after the other; parts that earlier sensors have in common with a later one are kept.
The key of a part holds everything on which the part depends: samples have optics and detector, weights have
display and observer, trials have both. Only the ratio of internal noise to gain matters, and only in the step from
trials to answers; so do light and noise of a camera that counts photons. Background and NETD do not change a
threshold SNR. A threshold contrast is that on the display, so the gain does not change it either.
"""

from __future__ import annotations

import math
import pickle
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar, cast

import numpy as np

from sensor_sim.chain.photons import ContrastVariance, contrast_variance, largest_contrast
from sensor_sim.chain.sampling import field_detectors
from sensor_sim.chain.sensor import Sensor
from sensor_sim.explorer.estimate import (
    FEW_PLACES,
    LATTICES,
    MORE_PLACES,
    QUICK_ORTHANT_TOLERANCE,
    corrected,
    lattice_phases,
    quick_plan,
    seen_samples,
)
from sensor_sim.explorer.limits import Shares, decision_shares
from sensor_sim.explorer.scaled import ScaledObserver, Unit
from sensor_sim.sweeps.work import as_computed
from sensor_sim.thresholds.curve_plan import CurvePlan, plan_curve
from sensor_sim.thresholds.predict import (
    PLACES,
    FoldedChain,
    Level,
    Phases,
    PooledThreshold,
    PredictedThreshold,
    Reference,
    covariance_at,
    find_threshold,
    predict_threshold,
)
from sensor_sim.thresholds.sharing import Kept, Shared
from todframes.base._typing import FloatArray
from todframes.observers.interface import Observer
from todframes.psychometrics.fit import FitSettings
from todframes.stimulus import Stimulus

T = TypeVar("T")

KEPT_MB = {"readouts": 44, "samplers": 6, "samples": 8, "weights": 8, "refined weights": 24, "trials": 10}
"""Largest size of the kept parts, by kind, in units of 2**20 bytes. The weights at the many places of a refined
threshold are kept apart; otherwise they would displace those that the next estimate needs."""

THRESHOLDS_KEPT = 2000

FAR_TOO_LARGE = 1.5
"""Error of an estimate, in tolerances, above which a second estimate with more places is computed. The stated
error is an upper bound, usually several times the true error, so below this limit the first estimate is good
enough."""


class Request(NamedTuple):
    """Thresholds to compute.

    Attributes
    ----------
    number : int
        Number of the request.
    sensor : Sensor
    observer : Unit
    sizes : tuple of (int, float)
        Places in the curve, and sizes in detectors.
    p_correct : float
    tolerances : (float, float)
        Relative errors to reach, of estimates and of refined thresholds.
    level : {"snr", "contrast"}
        Quantity whose threshold is asked for; with detector noise "snr", also where it is the contrast of a camera
        that counts photons.
    n_points : int
        Number of points of the psychometric function of each refined threshold.
    """

    number: int
    sensor: Sensor
    observer: Unit
    sizes: tuple[tuple[int, float], ...]
    p_correct: float
    tolerances: tuple[float, float]
    level: Level = "snr"
    n_points: int = 0


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """A threshold at the place `index` of the curve, and the slope dP / d ln level there, NaN without one."""

    index: int
    threshold: PredictedThreshold
    shares: Shares
    slope: float
    is_refined: bool


class ThresholdEngine:
    """Computes thresholds, and keeps the parts that the next sensor may need.

    Parameters
    ----------
    check : function of no arguments
        Called every few milliseconds; it raises an exception when the computation is no longer wanted. Kept parts
        stay valid.
    """

    def __init__(self, check: Callable[[], None]) -> None:
        self._check = check
        self._kept: dict[str, Kept[Any]] = {name: _Checked(size * 2**20, check) for name, size in KEPT_MB.items()}
        self._shared = Shared(*(self._kept[name] for name in ("samplers", "samples", "weights")))
        self._refined_shared = Shared(
            self._kept["samplers"], _Checked(0, check), self._kept["refined weights"], self._kept["trials"]
        )
        self._known: OrderedDict[Hashable, tuple[PredictedThreshold, Shares, float]] = OrderedDict()
        self._near: dict[_Kind, tuple[float, float]] = {}
        self._references: dict[_Kind, Reference] = {}

    def answers(self, request: Request) -> Iterator[CurvePoint]:
        """Yield estimates of all sizes and then refined thresholds, the easiest first.

        A refined threshold that is already known is yielded at once, instead of the estimate.

        Raises
        ------
        SettingsError
            If the observer is not linear, or the proportion, a size or a field is out of range.
        """
        FitSettings(p_correct=request.p_correct)  # checks it
        for _, size in request.sizes:
            field_detectors(request.sensor, size)  # checks it
        sensor = as_computed(request.sensor)
        if request.level == "contrast":
            sensor = replace(sensor, photons=None, scene=None)  # there is no detector noise
        pickled, noise_sd = request.observer
        scale = noise_sd / (sensor.display.gain if request.level == "snr" else 1.0)
        sensor = replace(sensor, display=replace(sensor.display, gain=1.0))
        observer = ScaledObserver(partial(pickle.loads, pickled), pickled, scale, self._kept["readouts"])
        rough, fine = request.tolerances
        todo: list[tuple[float, int, _Task, Hashable, _OnLattices]] = []
        for index, size in request.sizes:
            task = _Task(
                sensor, observer, size, request.p_correct, request.level, _light(sensor), request.n_points
            )
            key: Hashable = (
                sensor,
                pickled,
                scale,
                size,
                request.p_correct,
                request.level,
                fine,
                request.n_points,
            )
            if key in self._known:
                yield CurvePoint(index, *self._known[key], is_refined=True)
                continue
            self._check()
            found, shares, on_few = self._estimated(task, rough)
            yield CurvePoint(index, found, shares, on_few.found.slope, is_refined=False)
            difficulty = (
                found.numerical_error / found.threshold if found.threshold and found.numerical_error else 0.0
            )
            todo.append((difficulty, index, task, key, on_few))
        for _, index, task, name, on_few in sorted(todo, key=lambda one: one[0]):
            self._known[name] = (*self._refined(task, fine, on_few), on_few.found.slope)
            if len(self._known) > THRESHOLDS_KEPT:
                self._known.popitem(last=False)
            yield CurvePoint(index, *self._known[name], is_refined=True)

    def _estimated(self, task: _Task, tolerance: float) -> tuple[PredictedThreshold, Shares, _OnLattices]:
        """Return an estimate, its shares, and the trials on few places.

        More places, which take three times as long, are for an estimate whose error is far too large.
        """
        found = on_few = self._on_lattices(task, FEW_PLACES)
        threshold = error = None
        if on_few.found.status == "ok":
            threshold, error = corrected(on_few.found, self._references.get(task.kind))
            if error > FAR_TOO_LARGE * tolerance * threshold:
                found = self._on_lattices(task, MORE_PLACES)
                threshold, error = corrected(found.found, None) if found.found.status == "ok" else (None, None)
        n_phases = sum(part.signal[..., 0].size for part in found.phases)
        of_size = PredictedThreshold(found.found.status, threshold, error, task.size, n_phases)
        return of_size, _shares(found, task, threshold), on_few

    def _on_lattices(self, task: _Task, places: int) -> _OnLattices:
        sensor, observer, size, p_correct, level, light, _ = task
        judge = cast("Observer", observer)
        stimulus = Stimulus(size * sensor.display.detector_pitch_mrad)
        grid = judge.grid(stimulus)
        half_width = seen_samples(sensor, judge, size, grid)
        noise = observer.noise(stimulus, half_width)

        plan = quick_plan(sensor, judge, size, symmetric=noise.is_symmetric, shared=self._shared)

        def make() -> list[Phases]:
            return lattice_phases(
                sensor,
                judge,
                size,
                plan,
                places=places,
                jitter=observer.position_jitter_samples * grid.pitch_mrad / sensor.display.detector_pitch_mrad,
                name=(observer.name, stimulus),
                pitch_mrad=grid.pitch_mrad,
                images=partial(observer.weights, stimulus, half_width),
                counts_photons=light is not None,
            )

        seen = replace(sensor, photons=None, scene=None)  # light and noise come in after the trials
        key = (seen, light is not None, plan.orientations, observer.name, size, places)
        phases = self._kept["trials"].get(key, make)
        near, slope = self._near.get(task.kind, (None, math.nan))
        found = find_threshold(
            phases,
            noise.noise_covariance,
            p_correct,
            n_replicates=LATTICES,
            level=level,
            variance=None if light is None else light.variance,
            most=math.inf if light is None else light.largest_contrast,
            near=near,
            slope=slope,
            tolerance=QUICK_ORTHANT_TOLERANCE,
        )
        if found.status == "ok":
            self._near[task.kind] = found.threshold, found.slope
        return _OnLattices(found, phases, noise.noise_covariance)

    def _refined(self, task: _Task, tolerance: float, on_few: _OnLattices) -> tuple[PredictedThreshold, Shares]:
        sensor, observer, size, p_correct, level, light, n_points = task
        is_known = on_few.found.status == "ok"
        unit, near, slope = 1.0, None, math.nan
        if level == "contrast" and is_known:
            # What a plan leaves out is bounded at the contrast 1, which is to be near the threshold.
            unit = 2.0 ** round(math.log2(on_few.found.threshold))
        if is_known:
            near, slope = on_few.found.threshold / unit, on_few.found.slope
        judge = cast("Observer", observer.times(1.0 / unit))
        plan = plan_curve(
            sensor,
            judge,
            size,
            tolerance=tolerance,
            p_correct=p_correct,
            external_noise=level == "snr",
            shared=self._shared,
        )
        plan = replace(plan, shared=self._refined_shared)
        chain = _CheckedChain(sensor, judge, size, plan, check=self._check)
        found = predict_threshold(
            chain,
            p_correct=p_correct,
            tolerance=tolerance,
            n_points=n_points,
            level=level,
            near=near,
            slope=slope,
            most_places=PLACES[-1 if light is None else -2],
            check=self._check,
        )
        if found.threshold is not None and found.numerical_error is not None:
            threshold, error = unit * found.threshold, unit * found.numerical_error
            points = tuple((unit * value, p) for value, p in found.points)
            found = replace(found, threshold=threshold, numerical_error=error, points=points)
            if is_known:
                self._references[task.kind] = Reference.of(on_few.found, threshold, error)
        return found, _shares(on_few, task, found.threshold)


class _OnLattices(NamedTuple):
    """An estimate without correction, its trials, and the covariance of the internal noise."""

    found: PooledThreshold
    phases: list[Phases]
    internal: FloatArray


def _shares(found: _OnLattices, task: _Task, threshold: float | None) -> Shares:
    """Return the shares at a threshold, or without one at the strongest signal."""
    internal, nothing = found.internal, [np.zeros((4, 4))] * len(found.phases)
    if task.light is not None:
        contrast, variance = threshold or task.light.largest_contrast, task.light.variance
        noise = [covariance_at("contrast", contrast, nothing[0], part, variance) for part in found.phases]
        return decision_shares(found.phases, internal / contrast**2, [one.mean(axis=(0, 1)) for one in noise])
    if task.level == "contrast":
        # A contrast that is never enough has no internal noise that matters at the largest one.
        return decision_shares(found.phases, nothing[0] if threshold is None else internal / threshold**2, nothing)
    if threshold is None:
        return decision_shares(found.phases, internal, nothing)
    return decision_shares(
        found.phases, internal, [part.noise.mean(axis=0) / threshold**2 for part in found.phases]
    )


class _Light(NamedTuple):
    """Noise of a camera that counts photons, as contrast, and the contrast at which its pixels saturate."""

    variance: ContrastVariance
    largest_contrast: float


def _light(sensor: Sensor) -> _Light | None:
    """Return the noise of the photons that a camera counts; None if it counts none."""
    if sensor.photons is None:
        return None
    return _Light(contrast_variance(sensor), largest_contrast(sensor))


class _Task(NamedTuple):
    sensor: Sensor
    observer: ScaledObserver
    size: float
    p_correct: float
    level: Level
    light: _Light | None
    n_points: int

    @property
    def kind(self) -> _Kind:
        """Return what tasks have in common whose thresholds may be near each other."""
        return self.level, self.light is not None, self.size


_Kind = tuple[Level, bool, float]


class _Checked(Kept[T], Generic[T]):
    """Parts that are made only while the computation is wanted."""

    def __init__(self, most_bytes: int, check: Callable[[], None]) -> None:
        super().__init__(most_bytes)
        self._check = check

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        self._check()
        return super().get(key, make)


class _CheckedChain(FoldedChain):
    """A folded chain whose trials are made only while the computation is wanted."""

    def __init__(
        self,
        sensor: Sensor,
        observer: Observer,
        size_detectors: float,
        plan: CurvePlan,
        *,
        check: Callable[[], None],
    ) -> None:
        super().__init__(sensor, observer, size_detectors, plan)
        self._check = check

    def phases(self, places: int, rng: np.random.Generator) -> list[Phases]:
        self._check()
        return super().phases(places, rng)
