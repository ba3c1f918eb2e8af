"""Sensors of pyBSM: what its JSON files state that a SENSOR.toml has a key for.

Names and units, all SI, are those of pyBSM 0.16 (github.com/Kitware/pybsm, Apache-2.0).
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta

from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import convert, from_table, read_text
from todframes.field.atmosphere import LEAST_THERMAL_UM

EARTH_RADIUS_M = 6.378e6

OF_PHOTONS = ("qe", "qe_wavelengths", "dark_current", "read_noise", "max_n", "bit_depth", "frame_stacks")
"""Keys of a camera that counts photons."""

NODES = 10_001
"""Number of places along a path, and of wavelengths in a band."""

NotNegative = Annotated[float, Meta(ge=0.0, le=1e12)]
Length = Annotated[float, Meta(ge=1e-4, le=100.0)]
ChipLength = Annotated[float, Meta(ge=1e-7, le=1e-2)]
Wavelengths = Annotated[list[Annotated[float, Meta(ge=1e-7, le=1e-4)]], Meta(min_length=1)]
Angle = Annotated[float, Meta(ge=-1.0, le=1.0)]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sensor:
    """Keys of pyBSM's sensor that have a counterpart; a default is pyBSM's."""

    name: str = "pyBSM"
    D: Length
    f: Length
    p_x: ChipLength
    w_x: ChipLength | None = None
    opt_trans_wavelengths: Wavelengths
    eta: Annotated[float, Meta(ge=0.0, le=0.99)] = 0.0
    int_time: Annotated[float, Meta(ge=1e-9, le=1e5)] = 1.0
    qe: list[Annotated[float, Meta(ge=0.0, le=1.0)]] | None = None
    qe_wavelengths: Wavelengths | None = None
    dark_current: NotNegative = 0.0
    read_noise: NotNegative = 0.0
    max_n: Annotated[float, Meta(ge=1.0, le=1e12)] | None = None
    bit_depth: Annotated[float, Meta(ge=1.0, le=1e3)] | None = None
    frame_stacks: Annotated[int, Meta(ge=1, le=10_000)] = 1
    s_x: Angle = 0.0
    s_y: Angle = 0.0
    da_x: Angle = 0.0
    da_y: Angle = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Scenario:
    """Keys of pyBSM's scenario from which its turbulence follows; a default is pyBSM's."""

    altitude: Annotated[float, Meta(ge=0.0, le=1e5)]
    ground_range: Annotated[float, Meta(ge=0.0, le=1e6)]
    ha_wind_speed: Annotated[float, Meta(ge=0.0, le=1e3)] = 21.0
    cn2_at_1m: Annotated[float, Meta(ge=0.0, le=1e-9)] = 1.7e-14


KINDS = {"sensor": _Sensor, "scenario": _Scenario}


class PybsmSensor(NamedTuple):
    """A sensor of pyBSM: values by the arguments of `new_sensor` and the keys of its noise, further keys by their
    table, and the names of the file that have no counterpart.
    """

    name: str
    values: dict[str, float]
    tables: dict[str, dict[str, Any]]
    left_out: list[str]


def read_pybsm(path: Path | str) -> PybsmSensor:
    """Return the sensor of a JSON file of pyBSM, with the turbulence of its scenario. DataError if the file is no
    such JSON; SettingsError if a key is missing or out of its range.
    """
    text = read_text(Path(path), most_mb=1)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: is no JSON ({error})") from None
    if not isinstance(content, dict) or "sensor" not in content:
        raise DataError(f"{path}: found no object sensor, expected a JSON file of pyBSM")
    left_out, parts = [name for name in content if name not in KINDS], dict[str, Any]()
    for name, kind in KINDS.items():
        table = convert(content.get(name, {}), dict[str, Any], f"{path}: {name}")
        if "qewavelengths" in table:  # as pyBSM's own files have it
            table["qe_wavelengths"] = table.pop("qewavelengths")
        known = {one.name for one in fields(kind)} & table.keys()
        same = {f"{length}_y" for length in "pw" if table.get(f"{length}_y") == table.get(f"{length}_x")}
        left_out += [f"{name}.{key}" for key in table if key not in known | same | {"name"}]
        if table or name == "sensor":
            parts[name] = from_table({key: table[key] for key in known}, kind, f"{path}: {name}")
    sensor: _Sensor = parts["sensor"]
    left_out += ["sensor.s_y"] * (sensor.s_x != sensor.s_y) + ["sensor.da_y"] * bool(sensor.da_x and sensor.da_y)
    wavelength = (min(sensor.opt_trans_wavelengths) + max(sensor.opt_trans_wavelengths)) / 2.0
    if 1e6 * wavelength >= LEAST_THERMAL_UM:  # its noise is the NETD
        left_out += [f"sensor.{key}" for key in OF_PHOTONS if key in content["sensor"]]
    values: dict[str, float] = {
        "focal_length_mm": 1e3 * sensor.f,
        "f_number": sensor.f / sensor.D,
        "pitch_um": 1e6 * sensor.p_x,
        "wavelength_um": 1e6 * wavelength,
        "exposure_ms": 1e3 * sensor.int_time,
        "quantum_efficiency": _mean_efficiency(sensor, str(path)),
        "dark_noise_electrons": sensor.read_noise,
        "dark_current_electrons_per_s": sensor.dark_current,
        "frames_integrated": sensor.frame_stacks,
    }
    if sensor.max_n is not None:
        values["full_well_electrons"] = sensor.max_n
        if sensor.bit_depth is not None and sensor.bit_depth <= 32.0:
            # Its step of quantisation is max_n / 2**bits electrons.
            bits = round(sensor.bit_depth)
            values |= {"bits": bits, "system_gain_dn_per_electron": 2**bits / sensor.max_n}
    tables: dict[str, dict[str, float]] = {"optics": {"obscuration_ratio": sensor.eta}}
    if sensor.w_x is not None:
        tables["detector"] = {"width_um": 1e6 * sensor.w_x}
    # Smear along y is as hard as along x: the triangle points in four directions.
    smear = max(abs(sensor.da_x), abs(sensor.da_y)) * sensor.int_time
    jitter = math.hypot(sensor.s_x, sensor.s_y) / math.sqrt(2.0)
    if smear or jitter:
        tables["motion"] = {"smear_mrad": 1e3 * smear, "jitter_sigma_mrad": 1e3 * jitter}
    if (scenario := parts.get("scenario")) is not None and (air := _turbulence(scenario)):
        tables["turbulence"] = air
    return PybsmSensor(sensor.name, _six_digits(values), {k: _six_digits(v) for k, v in tables.items()}, left_out)


def _six_digits(values: dict[str, float]) -> dict[str, float]:
    return {name: value if isinstance(value, int) else float(f"{value:.6g}") for name, value in values.items()}


def _mean_efficiency(sensor: _Sensor, where: str) -> float:
    """Return the mean of the quantum efficiency over the band."""
    if sensor.qe is None:
        return 1.0
    wavelengths = sensor.qe_wavelengths or sensor.opt_trans_wavelengths
    if len(sensor.qe) != len(wavelengths):
        raise SettingsError(
            f"{where}: sensor: qe: found {len(sensor.qe)} values, expected one for each of {len(wavelengths)} "
            "wavelengths"
        )
    band = np.linspace(min(sensor.opt_trans_wavelengths), max(sensor.opt_trans_wavelengths), NODES)
    order = np.argsort(wavelengths)
    return float(np.interp(band, np.take(wavelengths, order), np.take(sensor.qe, order)).mean())


def _turbulence(scenario: _Scenario) -> dict[str, float]:
    """Return the constant Cn² with the same r₀ as the path from the ground: (8/3) ∫ Cn²(u) u^(5/3) du, with u
    from 0 at the scene to 1 at the sensor; nothing for a path of no length. The
    profile over height is that of Hufnagel and Valley (Roggemann & Welsh 1996, Imaging Through Turbulence).
    """
    length = math.hypot(scenario.altitude, scenario.ground_range)
    if length == 0.0:
        return {}
    u = np.linspace(0.0, 1.0, NODES)
    height = np.maximum(scenario.altitude * u - length**2 * u * (1.0 - u) / (2.0 * EARTH_RADIUS_M), 0.0)
    of_wind = 5.94e-53 * (scenario.ha_wind_speed / 27.0) ** 2 * height**10 * np.exp(-height / 1000.0)
    profile = of_wind + 2.7e-16 * np.exp(-height / 1500.0) + scenario.cn2_at_1m * np.exp(-height / 100.0)
    return {"cn2_m23": float(8.0 / 3.0 * np.trapezoid(profile * u ** (5.0 / 3.0), u)), "path_km": length / 1e3}
