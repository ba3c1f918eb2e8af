"""The one way to vary a sensor: other values of some keys of its SENSOR.toml, and what follows from them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

from sensor_sim.chain.sensor import TABLES, Detector, Sensor, part_of, used_keys
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import from_table, kinds_of, settings_of

FILL_FACTOR = "detector.fill_factor"
"""Key for the active share of a detector's area; it sets the detector's width from the pitch."""

OPTIONAL = ("motion", "turbulence")
"""Tables that can be varied although the sensor's file lacks them: nothing moves, and the air is at rest."""

WIDTHS, PITCHES = (tuple(f"detector.{name}_{unit}" for unit in ("mrad", "um")) for name in ("width", "pitch"))

NETD = "noise.netd_mk"

NETD_HELD = (
    "The NETD is the same for all apertures and detectors, so a smaller one costs no signal; with {} it follows "
    "f-number² / area."
)
"""The remark about what `holds_netd`; what couples the two is to be filled in."""


@cache
def whole_numbers(settings: type) -> dict[str, bool]:
    """Return the names of the settings that are numbers, and for each whether its values are whole numbers."""
    kinds = {field.name: kinds_of(hint) for field, hint in settings_of(settings)}
    return {name: float not in of_name for name, of_name in kinds.items() if {int, float} & {*of_name}}


def numeric_keys(sensor: Sensor) -> dict[str, bool]:
    """Return the keys of SENSOR.toml that can be varied, those that mean something for this sensor, and for each
    whether its values are whole numbers.
    """
    keys = {FILL_FACTOR: False}
    used = {table: list(whole_numbers(TABLES[table])) for table in OPTIONAL} | used_keys(sensor)
    for table, names in used.items():
        whole = whole_numbers(_settings(sensor, table))
        keys |= {f"{table}.{name}": whole[name] for name in names if name in whole}
    return keys


def _settings(sensor: Sensor, table: str) -> type:
    """Return the class of the settings in a table."""
    part = getattr(sensor, part_of(table, sensor))
    return TABLES[table] if part is None else type(part)


def value_of(sensor: Sensor, key: str) -> float | None:
    """Return the value of a key of `numeric_keys`; None if the sensor does without."""
    table, _, name = key.partition(".")
    pitch, width = pitch_and_width(sensor.detector)
    if key == FILL_FACTOR:
        return (width / pitch) ** 2
    value: float | None = getattr(getattr(sensor, part_of(table, sensor)), name, None)
    return width if value is None and key in WIDTHS else value


def vary(sensor: Sensor, values: Mapping[str, float], *, keep_fill_factor: bool = False) -> Sensor:
    """Return a sensor with other values of some keys; SettingsError if there is no such sensor.

    What is varied has the value that is given. With `keep_fill_factor` the detectors' width follows a varied
    pitch. The NETD of a sensor with `couple_netd` follows its aperture and detectors, unless it is varied itself.
    """
    tables: dict[str, dict[str, Any]] = {}
    for key, value in values.items():
        table, _, name = key.partition(".")
        is_whole = whole_numbers(_settings(sensor, table)).get(name)
        tables.setdefault(table, {})[name] = int(value) if is_whole else float(value)
    if "detector" in tables:
        tables["detector"] = _with_width(sensor.detector, tables["detector"], keep_fill_factor=keep_fill_factor)
    parts: dict[str, Any] = {}
    for table, changes in tables.items():
        part = part_of(table, sensor)
        if getattr(sensor, part) is None:
            parts[part] = from_table(changes, TABLES[table], table)
            continue
        try:
            parts[part] = replace(getattr(sensor, part), **changes)
        except SettingsError as error:
            has_pitch = any(key in values for key in PITCHES) and not any(key in values for key in WIDTHS)
            too_narrow = has_pitch and "expected at most pitch_" in str(error)
            hint = f"; with {argument.keep_fill_factor} the width follows the pitch" if too_narrow else ""
            raise SettingsError(f"{table}.{error}{hint}") from None
    varied = replace(sensor, **parts)
    return varied if NETD in values else with_coupled_netd(sensor, varied)


def with_coupled_netd(sensor: Sensor, varied: Sensor) -> Sensor:
    """Return a varied sensor whose NETD follows the light that it gathers, if `sensor` couples the two."""
    if not sensor.noise.couple_netd:
        return varied
    assert sensor.noise.netd_mk is not None  # checked by `Noise`
    netd_mk = sensor.noise.netd_mk * (_gathered(sensor) / _gathered(varied)) ** 2
    return replace(varied, noise=replace(varied.noise, netd_mk=netd_mk))


def holds_netd(sensor: Sensor, varied: Sensor) -> bool:
    """Return whether a sensor gathers other light at the same NETD, because the two are not coupled."""
    noise = varied.noise
    is_held = varied.level == "snr" and noise.netd_mk is not None and not noise.couple_netd
    return is_held and noise.netd_mk == sensor.noise.netd_mk and _gathered(varied) != _gathered(sensor)


def _gathered(sensor: Sensor) -> float:
    """Return aperture · angular width of a detector, whose square is the light that it gathers: NETD ∝ (f-number)²
    / (area of a detector). The f-number is focal length / aperture, and the side of a detector its angular width ·
    focal length; the focal length cancels. Measured optics without an aperture keep it.
    """
    return (sensor.aperture_mm or 1.0) * sensor.width_mrad


def pitch_and_width(detector: Detector) -> tuple[float, float]:
    """Return pitch and width in the unit in which they were given; without a width, it is the pitch."""
    pitch = detector.pitch_um or detector.pitch_mrad or math.nan  # one of them is there
    return pitch, (detector.width_um or detector.width_mrad or pitch)


def _with_width(detector: Detector, changes: dict[str, float], *, keep_fill_factor: bool) -> dict[str, float]:
    """Return the changes of the detector with a width in place of a fill factor."""
    changes, unit = dict(changes), "mrad" if detector.pitch_um is None else "um"
    before, width = pitch_and_width(detector)
    pitch, share = changes.get(f"pitch_{unit}", before), changes.pop("fill_factor", None)
    if share is not None:
        if not 0.0 < share <= 1.0:
            raise SettingsError(f"{FILL_FACTOR}: found {share:g}, expected a number above 0 and at most 1")
        changes[f"width_{unit}"] = pitch * math.sqrt(share)
    elif keep_fill_factor and f"width_{unit}" not in changes:
        changes[f"width_{unit}"] = pitch * (width / before)
    return changes
