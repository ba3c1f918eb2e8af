"""Parts of computations that several sensors share: samplers, samples, weights and trials, each computed once.

A part is found by a key that holds all that its value depends on. So what is shared changes no number, and neither
do the order of the sensors and the memory that is allowed.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from typing import Any, Generic, TypeVar

from sensor_sim.chain.detector_noise import NO_LINES, delta_t_mk, line_shares
from sensor_sim.chain.sensor import Noise, Scene, Sensor
from todframes.base._typing import FloatArray

T = TypeVar("T")

OVERHEAD_BYTES = 1000
"""Size of a key and of an object, about; it is added to that of each value."""

MOST_BYTES = 512 * 2**20
"""Largest size of the parts that are shared, if no other is asked for."""


class LruCache(Generic[T]):
    """Values by key, up to a number of bytes; those not used for the longest time are dropped first. With 0 bytes
    nothing is kept. `check` is called whenever a value is asked for; it may raise an exception.
    """

    def __init__(self, most_bytes: int, check: Callable[[], None] = lambda: None) -> None:
        self._most_bytes, self._check = most_bytes, check
        self._values: OrderedDict[Hashable, tuple[T, int]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value of a key, made now if it is not kept. The caller must not change it."""
        self._check()
        if not self._most_bytes:
            return make()
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key][0]
        value = make()  # without the lock: other threads go on, and at worst make it too
        size = _size_bytes(value) + OVERHEAD_BYTES
        with self._lock:
            if key not in self._values and size <= self._most_bytes:
                self._values[key] = value, size
                self._bytes += size
            while self._bytes > self._most_bytes:
                self._bytes -= self._values.popitem(last=False)[1][1]
        return value


def _size_bytes(value: Any) -> int:
    """Return the size of an array, of a list of arrays, or of an object with the attribute `nbytes`."""
    return sum(map(_size_bytes, value)) if isinstance(value, list) else int(value.nbytes)


@dataclass(frozen=True, slots=True)
class Caches:
    """Parts that the curves of several sensors have in common: samplers of triangles, their samples at some
    places, the weights of folded readouts at some places, and the trials of replicates, scores of both.
    """

    samplers: LruCache[Any] = field(default_factory=lambda: LruCache(0))
    samples: LruCache[FloatArray] = field(default_factory=lambda: LruCache(0))
    weights: LruCache[Any] = field(default_factory=lambda: LruCache(0))
    trials: LruCache[Any] = field(default_factory=lambda: LruCache(0))

    @classmethod
    def of(cls, most_bytes: int = MOST_BYTES, check: Callable[[], None] = lambda: None) -> Caches:
        """Return a `Caches` that keeps up to so many bytes: 40 % each of samples and weights, 10 % of others.
        `check` is that of `LruCache`.
        """
        return cls(*(LruCache(most_bytes * percent // 100, check) for percent in (10, 40, 40, 10)))


NO_CACHE = Caches()
"""Nothing is kept: the computation of a single sensor."""


def as_computed(sensor: Sensor) -> Sensor:
    """Return a sensor with the same thresholds, with defaults for all settings that do not change these.
    Thresholds in SNR do not depend on the noise but for the shares of rows and columns; those of photons do. Where
    the electrons are not those of the light, the focal length matters for lengths on the chip alone.
    """
    optics, scene, photons = sensor.optics, sensor.scene, sensor.photons
    if scene is None or scene.background_electrons is not None:
        optics = replace(optics, transmission=1.0)
        on_chip = optics.mtf is not None and optics.mtf.unit == "cyc_per_mm"
        if not on_chip and sensor.detector.pitch_um is optics.psf_pitch_um is None:
            optics = replace(optics, focal_length_mm=None, f_number=None)
        scene = None if scene is None else Scene(background_electrons=scene.background_electrons)
        photons = None if photons is None else replace(photons, quantum_efficiency=None)
    display = replace(sensor.display, background_luminance_cd_m2=1.0)
    has_lines = line_shares(sensor.noise) != NO_LINES
    noise = replace(sensor.noise, netd_mk=None, couple_netd=False) if has_lines else Noise()
    return replace(sensor, optics=optics, scene=scene, photons=photons, noise=noise, display=display, name="")


def decisive(sensor: Sensor) -> tuple[Sensor, float | None]:
    """Return what the thresholds of a sensor depend on, besides the background to which an observer may adapt:
    sensors that have the same have the same thresholds, in mK too.
    """
    in_mk = None if sensor.noise.netd_mk is None else float(delta_t_mk(1.0, noise=sensor.noise))
    return as_computed(sensor), in_mk
