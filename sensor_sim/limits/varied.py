"""The number of a sensor that is varied, and the threshold of a sensor at one size."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import Sensor
from sensor_sim.chain.vary import holds_netd, numeric_keys, value_of, vary
from sensor_sim.limits.crossing import STEP, Crossing, Try, find_crossing
from sensor_sim.sweeps.goals import in_words
from sensor_sim.thresholds.threshold import threshold_at
from todframes.base._typing import Json
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_keys
from todframes.observers.interface import Observer, adapted, resolve_observer, settings_json
from todframes.results.result import Result

REACH = 1e6
"""Largest factor between the sensor's own value and a limit."""

COUPLED = "couple_netd = true in [noise]"
"""The setting by which the NETD follows the light."""


class SensorResult(Result, frozen=True, kw_only=True):
    """Result about one sensor.

    Attributes
    ----------
    sensor : str
        The sensor's name.
    """

    sensor: str

    @property
    def name(self) -> str:
        """Return the sensor's name."""
        return self.sensor


class Varied(NamedTuple):
    """The number that is varied: name and unit, the sensor's value, and the sensor with another value."""

    name: str
    unit: str
    own: float
    larger_is_better: bool | None
    is_whole: bool
    sensor_at: Callable[[float], Sensor]

    def crossing(self, attempt: Callable[[float], Try]) -> Crossing:
        """Find the value at which the threshold meets what is asked for. SettingsError if no value changes it."""
        crossing = find_crossing(
            attempt,
            self.own,
            low=self.own / REACH,
            high=self.own * REACH,
            larger_is_better=self.larger_is_better,
            is_whole=self.is_whole,
        )
        thresholds = {attempt.threshold for attempt in crossing.tries}
        if len(crossing.tries) > 1 and len(thresholds) == 1 and None not in thresholds:
            raise self.idle()
        return crossing

    def idle(self, hint: str = "") -> SettingsError:
        """Return the error of a number that changes no threshold."""
        return SettingsError(f"{argument.limit}: {self.name} changes no threshold of this sensor{hint}")

    def check_moves(self, observer: Observer, *, in_mk: bool) -> bool:
        """Return whether light is gained at the same NETD. SettingsError if the number changes no threshold."""
        own, others = self.sensor_at(self.own), list[Sensor]()
        for value in (STEP * self.own, self.own / STEP):
            with suppress(SettingsError):
                others.append(self.sensor_at(value))
        if not others:
            return False
        other = others[0]
        camera, changed = resolve(own), resolve(other)
        if camera == changed and adapted_to(observer, own) is adapted_to(observer, other):
            if camera.mk_per_snr == changed.mk_per_snr:
                raise self.idle()
            if not in_mk:
                raise self.idle(f" in SNR; give {argument.delta_t_k}")
        return in_mk and holds_netd(own, other)


@lru_cache(maxsize=4)
def _adapted(observer: Observer, background_cd_m2: float) -> Observer:
    return adapted(observer, lambda: background_cd_m2)


def adapted_to(observer: Observer, sensor: Sensor) -> Observer:
    """Return an observer adapted to the background of a sensor's display, if its settings ask for that."""
    return _adapted(observer, sensor.display.background_luminance_cd_m2)


def described_for(observer: str | Observer, sensor: Sensor) -> tuple[Observer, Json]:
    """Return an observer that each sensor adapts anew, and its name and settings with this one as JSON values."""
    judge, settings = resolve_observer(observer)
    return judge, settings | settings_json(adapted_to(judge, sensor))


def threshold_of(
    sensor: Sensor, observer: Observer, size_detectors: float, *, in_mk: bool = False, **asked: Any
) -> tuple[float | None, float]:
    """Return the threshold of a sensor at one size, None if it is never reached, and its relative error."""
    camera = resolve(sensor)
    found, _ = threshold_at(camera, adapted_to(observer, sensor), size_detectors, n_points=0, **asked)
    threshold = found.threshold
    if threshold is None:
        return None, 0.0
    error = (found.numerical_error or 0.0) / threshold
    return threshold * (camera.mk_per_snr or math.nan) if in_mk else threshold, error


def parameter_to_vary(sensor: Sensor, limit: str) -> Varied:
    """Return what is varied for a limit, by its name or a key of SENSOR.toml."""
    if limit == "range":
        raise SettingsError(
            f"{argument.limit}: found range, expected light, aperture, netd or a key of a sensor; todframes range "
            "gives the range of a sensor"
        )
    scene = sensor.scene
    if limit == "light" and scene is not None and scene.background_electrons is None:
        own = scene.background_cd_m2
        return Varied("light", "cd/m²", own, True, False, lambda at: replace(sensor, scene=scene.at(at)))
    aliases = {
        "light": "scene.background_electrons",
        "aperture": "optics.aperture_mm" if sensor.optics.f_number is None else "optics.f_number",
        "netd": "noise.netd_mk",
    }
    key = aliases.get(limit, limit)
    known = numeric_keys(sensor)
    check_keys([key], [*aliases, *known], argument.limit)
    value = value_of(sensor, key)
    if not value:
        raise SettingsError(f"{argument.limit}: {key} is missing or 0 in this sensor, expected a number above 0")
    better = {"light": True, "aperture": key == "optics.aperture_mm", "netd": False}.get(limit)
    return Varied(key, in_words(key)[1], value, better, known[key], lambda at: vary(sensor, {key: at}))
