"""The number of a sensor that is varied, and the value of it at which the threshold meets what is asked for."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from operator import attrgetter
from typing import Any, NamedTuple

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import Sensor
from sensor_sim.chain.vary import holds_netd, numeric_keys, value_of, vary
from sensor_sim.sweeps.goals import in_words
from sensor_sim.thresholds.threshold import threshold_at
from todframes.base._typing import Json
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_keys
from todframes.observers.interface import Observer, adapted, resolve_observer, settings_json
from todframes.psychometrics.threshold_search import bracket
from todframes.results.result import Result

STEP = 2.0
"""Factor between the values that are tried until one is judged and its neighbour is not."""

PRECISION = 5e-4
"""Relative precision of the root, below the error of the thresholds."""

UNREACHED = 50.0
"""Logarithm of threshold over target that stands for a threshold that is never reached."""


class Try(NamedTuple):
    """One value of the parameter: ln(threshold / target), its error, and the threshold, if there is one."""

    value: float
    excess: float
    error: float
    threshold: float | None

    @classmethod
    def of(cls, value: float, threshold: float | None, error: float, target: float) -> Try:
        """Return the record of a threshold, None if it is never reached, and its relative error."""
        excess = math.inf if threshold is None else math.log(threshold / target)
        return cls(value, excess, error, threshold)


class Crossing(NamedTuple):
    """The value at which the threshold is the target, and half of its 95 % interval; all values that were tried.
    The error of a whole number is 0 if no other one is in that interval.
    `value` is None if none was found between the ends of the range. `is_least` states that larger values are
    judged, `is_judged` that the first value was.
    """

    value: float | None
    error: float | None
    is_least: bool
    is_judged: bool
    tries: tuple[Try, ...]


def find_crossing(
    attempt: Callable[[float], Try],
    start: float,
    *,
    low: float,
    high: float,
    larger_is_better: bool | None = None,
    is_whole: bool = False,
) -> Crossing:
    """Find the value nearest to `start` at which the excess changes its sign, by steps of a factor and by Brent.
    The range is from `low` to `high`, both > 0. Of whole numbers it is the outermost one that is judged. Both
    directions are tried unless it is known whether larger values are better.
    """
    tries: dict[float, Try] = {}

    def excess(log_value: float) -> float:
        value = start if log_value == first else math.exp(log_value)  # exp(ln(start)) may be its neighbour
        value = float(round(value)) if is_whole else value
        if value not in tries:
            tries[value] = attempt(value)
        return min(tries[value].excess, UNREACHED)

    first = math.log(start)
    is_judged = excess(first) <= 0.0
    ends = math.log(low), math.log(high)
    if larger_is_better is not None:
        ends = (ends[0], first) if larger_is_better is is_judged else (first, ends[1])
    found = bracket(excess, first, ends=ends, step=math.log(STEP))
    if found is None:
        return Crossing(None, None, True, is_judged, tuple(sorted(tries.values())))
    below, above = found
    is_least = excess(below) > 0.0
    if is_whole:
        a, b = round(math.exp(below)), round(math.exp(above))
        while b - a > 1:
            middle = (a + b) // 2
            a, b = (middle, b) if (excess(math.log(middle)) > 0.0) is is_least else (a, middle)
        value = float(b if is_least else a)
        error = _whole_error(tries[float(a)], tries[float(b)], value)
    else:
        from scipy.optimize import brentq

        value = math.exp(brentq(excess, below, above, xtol=PRECISION))
        error = _error(sorted(tries.values()), value)
    return Crossing(value, error, is_least, is_judged, tuple(sorted(tries.values())))


def _error(tries: list[Try], value: float) -> float:
    """Return the error of a root: that of the threshold nearby, over the slope between its two neighbours."""
    number = bisect_right(tries, value, 1, len(tries) - 1, key=attrgetter("value"))
    below, above = tries[number - 1], tries[number]
    slope = (above.excess - below.excess) / math.log(above.value / below.value)
    near = max(below.error, above.error)
    return value * (math.hypot(near / abs(slope), PRECISION) if slope else math.inf)


def _whole_error(below: Try, above: Try, value: float) -> float:
    """Return the error of a whole number, one of two neighbours between which the threshold is the target: the
    distance to the farthest whole number that is the limit if the thresholds are off by their errors.
    """
    excess = [min(attempt.excess, UNREACHED) for attempt in (below, above)]
    root = below.value * (above.value / below.value) ** (excess[0] / (excess[0] - excess[1]))
    error, to_whole = _error([below, above], root), math.ceil if excess[0] > 0.0 else math.floor
    return max(abs(float(to_whole(max(end, 1.0))) - value) for end in (root - error, root + error))


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
