"""The number of a sensor that is varied, and the threshold of a sensor at one size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from sensor_sim.chain.detector_noise import delta_t_mk
from sensor_sim.chain.sensor import Sensor, part_of
from sensor_sim.limits.crossing import Crossing, Try, find_crossing
from sensor_sim.sweeps.designs import Base, numeric_keys
from sensor_sim.sweeps.goals import in_words
from sensor_sim.thresholds.threshold import threshold_at
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_keys
from todframes.observers.interface import Observer

REACH = 1e6
"""Largest factor between the sensor's own value and a limit."""

LARGEST_DETECTORS, OWN_DETECTORS, SMALLEST_DETECTORS = 32.0, 4.0, 0.5
"""Sizes of the triangle in detectors at the ends of the ranges that are tried, and at the first one."""


class Varied(NamedTuple):
    """The number that is varied: name and unit, the sensor's value, its range, the sensor with another value."""

    name: str
    unit: str
    own: float
    low: float
    high: float
    larger_is_better: bool | None
    is_whole: bool
    sensor_at: Callable[[float], Sensor]

    def crossing(self, attempt: Callable[[float], Try]) -> Crossing:
        """Find the value at which the threshold meets what is asked for."""
        better, is_whole = self.larger_is_better, self.is_whole
        return find_crossing(
            attempt, self.own, low=self.low, high=self.high, larger_is_better=better, is_whole=is_whole
        )


def threshold_of(
    sensor: Sensor, observer: Observer, size_detectors: float, *, in_mk: bool = False, **asked: Any
) -> tuple[float | None, float]:
    """Return the threshold of a sensor at one size, None if it is never reached, and its relative error."""
    found, _ = threshold_at(sensor, observer, size_detectors, n_points=0, **asked)
    threshold = found.threshold
    if threshold is None:
        return None, 0.0
    error = (found.numerical_error or 0.0) / threshold
    return float(delta_t_mk(threshold, noise=sensor.noise)) if in_mk else threshold, error


def find_varied(sensor: Sensor, limit: str, size: float) -> Varied:
    """Return what is varied for a limit, by its name or a key of SENSOR.toml."""
    if limit == "range":
        nearest, farthest = (
            size / (n * sensor.detector.pitch_mrad) for n in (LARGEST_DETECTORS, SMALLEST_DETECTORS)
        )
        own = size / (OWN_DETECTORS * sensor.detector.pitch_mrad)
        return Varied("range", "km", own, nearest, farthest, False, False, lambda _: sensor)
    scene = sensor.scene
    if limit == "light" and scene is not None and scene.background_electrons is None:
        own = scene.background_cd_m2
        ends = own / REACH, own * REACH
        return Varied("light", "cd/m²", own, *ends, True, False, lambda at: replace(sensor, scene=scene.at(at)))
    aliases = {
        "light": "scene.background_electrons",
        "aperture": "optics.aperture_mm" if sensor.optics.f_number is None else "optics.f_number",
        "netd": "noise.netd_mk",
    }
    key = aliases.get(limit, limit)
    known = numeric_keys(sensor, type(None))
    check_keys([key], [*aliases, "range", *known], argument.limit)
    base = Base(sensor, None, keep_fill_factor=False, couple_netd=sensor.noise.couple_netd)
    table, _, name = key.partition(".")
    own = getattr(getattr(sensor, part_of(table, sensor)), name, None) or 0.0
    if not own:
        raise SettingsError(f"{argument.limit}: {key} is missing or 0 in this sensor, expected a number above 0")
    better = {"light": True, "aperture": key == "optics.aperture_mm", "netd": False}.get(limit)
    return Varied(
        key,
        in_words(key)[1],
        own,
        own / REACH,
        own * REACH,
        better,
        known[key],
        lambda value: base.design({key: value})[0],
    )
