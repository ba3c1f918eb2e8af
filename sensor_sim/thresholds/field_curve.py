"""The curve of a sensor for a range in the field: at sizes from its acuity on, whoever asks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from sensor_sim.chain.camera import resolve
from sensor_sim.chain.sensor import SCHEMA, Sensor, load_sensor, sensor_from
from sensor_sim.thresholds.curve import curve
from sensor_sim.thresholds.sizes import acuity_detectors, computed_sizes
from todframes.base.errors import SettingsError
from todframes.observers.interface import observer_named, resolve_observer
from todframes.parameters import Progress
from todframes.results.data import Fit, ResultWarning
from todframes.results.thresholds import Thresholds

SIZES_OF_ACUITY = (1.0, 1.05, 1.15, 1.3, 1.6, 2.0, 3.0, 5.0, 8.0)
"""Sizes of the curve, in units of the smallest one that is judged: close where the threshold rises without end."""

TOLERANCE = 0.01
"""Relative error of the thresholds."""


def field_curve(
    source: Path | str | Mapping[str, Any], *, p_correct: float, progress: Progress | None
) -> tuple[Thresholds, tuple[ResultWarning, ...]]:
    """Compute the thresholds of a sensor in a file, or of that in the settings of a result of `curve`, from its
    acuity on. The last size is the largest that no signal suffices for, if one was found. SettingsError if the
    observer or the sensor of a result cannot be made again, or no size is judged.
    """
    sensor, observer = _described(source) if isinstance(source, Mapping) else (load_sensor(source), "pyramid")
    background = sensor.display.background_luminance_cd_m2
    judge, _ = resolve_observer(observer, lambda: background)
    camera = resolve(sensor)
    found = acuity_detectors(camera, judge, p_correct=p_correct, seed=1)
    if found is None:
        raise SettingsError(f"{sensor.name}: found no size that is judged with {100.0 * p_correct:g} % correct")
    smallest, unreached = found
    most = max(computed_sizes(camera, judge))
    sizes = [float(f"{smallest * step:.4g}") for step in SIZES_OF_ACUITY if smallest * step <= most]
    asked: dict[str, Any] = {"p_correct": p_correct, "tolerance": TOLERANCE, "examples": False}
    result = curve(sensor, size_detectors=sizes, observer=observer, progress=progress, **asked)
    fits = result.fits
    if unreached is not None:
        group: dict[str, float | str] = {"size_detectors": unreached}
        fits += (Fit(group=group, level=camera.level, status="never_reached", p_correct=p_correct),)
    warnings = tuple(warning for warning in result.warnings if warning.code != "numerical_error")
    if camera.air is not None and (air := sensor.turbulence) is not None:
        message = f"the turbulence is that of turbulence.path_km = {air.path_km:g}, at whatever range"
        warnings += (ResultWarning(code="turbulence_path", message=message),)
    return replace(result, fits=fits), warnings


def _described(settings: Mapping[str, Any]) -> tuple[Sensor, str]:
    """Return the sensor and the observer of a result; SettingsError if they cannot be made again."""
    name = str(settings.get("observer"))
    usual = resolve_observer(observer_named(name))[1]
    if any(settings.get(key) != value for key, value in usual.items() if key != "observer"):
        raise SettingsError(f"observer: found settings of {name} other than its defaults")
    return sensor_from({"schema": SCHEMA, **settings["sensor"]}, "the sensor of the result"), name
