"""The call `new_sensor`: a SENSOR.toml in which every key is explained."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from msgspec import Meta

from sensor_sim.chain.sensor import (
    Detector,
    Motion,
    Noise,
    Optics,
    PhotonNoise,
    Scene,
    Sensor,
    Turbulence,
    explained_toml,
    load_sensor,
)
from sensor_sim.chain.vary import NETD, vary
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.reading import checked, convert, from_table, read_text
from todframes.display.display import SensorDisplay
from todframes.field.atmosphere import LEAST_THERMAL_UM
from todframes.parameters import CameraFile, Preset, PybsmFile, Rate
from todframes.recordings.recording import check_rate, frames_integrated

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


PRESETS: dict[str, tuple[str, dict[str, float]]] = {
    "emva_basler": (
        "EMVA 1288 reference data sets (github.com/EMVA1288/datasets), set 001, Basler AG 2011: QE 45.25 %, "
        "K 0.28006, dark noise 10.92, DSNU 0.5532, PRNU 0.4327 %, 12 bits; full well: saturation at 30,957 "
        "photons times QE",
        {
            "quantum_efficiency": 0.4525,
            "system_gain_dn_per_electron": 0.28006,
            "dark_noise_electrons": 10.92,
            "dsnu_electrons": 0.5532,
            "prnu_percent": 0.4327,
            "full_well_electrons": 14008.0,
            "bits": 12,
        },
    ),
    "boson": (
        "FLIR Boson datasheet 102-2013-40, release 340 (March 2021): thermal sensitivity below 40 mK at f/1.0, "
        "pixels of 12 µm, 7.5 to 13.5 µm",
        {"netd_mk": 40.0, "pitch_um": 12.0, "f_number": 1.0},
    ),
}
"""Source and settings of cameras from public figures."""

VISIBLE_UM, THERMAL_UM = 0.55, 10.0
"""Wavelengths of the diffraction if none is given: green light, and the middle of the long-wave infrared."""

NO_COUNTERPART = "# no counterpart here: "
"""Beginning of the comment that names keys of another program which a SENSOR.toml lacks."""

EXPOSURE_MS = 10.0
"""Exposure if neither the file nor the user has one."""

THERMAL_RATE_HZ = 60.0
"""Frame rate of thermal cameras if none is given."""

KEYS = {"f_number": "optics.f_number", "pitch_um": "detector.pitch_um", "netd_mk": NETD}
"""Keys of SENSOR.toml by arguments that replace those of a preset."""

DISPLAY = SensorDisplay(
    pixels_per_detector=1, pixel_pitch_mm=0.2909, viewing_distance_mm=1000.0, background_luminance_cd_m2=50.0
)
"""Display that the file begins with: `import` shows a pixel of a recording at the same angle, one arcmin."""


@checked
def new_sensor(
    *,
    emva: CameraFile | None = None,
    thermal: bool = False,
    preset: Preset | None = None,
    pybsm: PybsmFile | None = None,
    focal_length_mm: float | None = None,
    f_number: float | None = None,
    pitch_um: float | None = None,
    netd_mk: float | None = None,
    wavelength_um: float | None = None,
    exposure_ms: float | None = None,
    frames_per_second: Rate | None = None,
    luminance: float | None = None,
    name: str | None = None,
) -> str:
    """Return a SENSOR.toml in which every key is explained.

    It is for a camera with results of EMVA 1288, a thermal camera, one from public figures, or a sensor of pyBSM.

    Parameters
    ----------
    emva : path, optional
        result.json of `todframes noise --dark` or `--emva`, or its folder, from which a camera that counts photons
        takes its noise.
    thermal : bool
        Describe a thermal camera, by its NETD.
    preset : str, optional
        A camera from public figures, emva_basler or boson, whose source stands in the file; other values that are
        given replace its own, and its NETD follows f-number² / area of a detector. Or a whole sensor that `curve`
        knows by its name.
    pybsm : path, optional
        A sensor of pyBSM (JSON), with the turbulence of its scenario; other values that are given replace its own.
    focal_length_mm : float, optional
        Focal length of the lens in mm; not needed for a whole sensor, or one of pyBSM.
    f_number : float, optional
        f-number of the lens.
    pitch_um : float, optional
        From one detector to the next on the chip in µm.
    netd_mk : float, optional
        NETD of a thermal camera in mK.
    wavelength_um : float, optional
        Wavelength in µm. Default: that of the file, 0.55, or thermal 10.
    exposure_ms : float, optional
        Exposure in ms. Default: that of the results, or 10.
    frames_per_second : float, optional
        Frame rate; the eye averages the frames of 0.1 s. Default: thermal 60, else one frame is averaged.
    luminance : float, optional
        Luminance of the background in cd/m², for a camera that counts photons. Default: 100.
    name : str, optional
        Name of the sensor.

    Returns
    -------
    str
        Text of the file.

    Raises
    ------
    SettingsError
        If not exactly one kind of camera is asked for, or a value is missing.
    DataError
        If the result cannot be read, or is not of EMVA 1288.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> text = ss.new_sensor(thermal=True, netd_mk=50, pitch_um=12, f_number=1.0, focal_length_mm=35)
    >>> text.splitlines()[0]
    'schema = 1'
    """
    known = {"f_number": f_number, "pitch_um": pitch_um, "netd_mk": netd_mk, "exposure_ms": exposure_ms}
    known |= {"focal_length_mm": focal_length_mm, "wavelength_um": wavelength_um}
    if sum((emva is not None, thermal and pybsm is None, preset is not None, pybsm is not None)) != 1:
        ways = f"{argument.emva}, {argument.thermal}, {argument.preset} and {argument.pybsm}"
        raise SettingsError(f"new: expected one of {ways}")
    source, tables, left_out = "", dict[str, dict[str, Any]](), list[str]()
    of_file: dict[str, Any] = {}
    if preset is not None and preset not in PRESETS:
        if any(value is not None for value in (*known.values(), frames_per_second, luminance)):
            raise SettingsError(f"{argument.preset}: {preset} is a whole sensor, expected no values beside it")
        whole = load_sensor(preset)
        return explained_toml(replace(whole, name=name or whole.name))
    if preset is not None:
        source, of_file = PRESETS[preset]
    elif emva is not None:
        from todframes.camera.measure_emva import Emva
        from todframes.results.result import load_result

        result = load_result(emva)
        if not isinstance(result, Emva):
            raise DataError(
                f"{emva}: is no result of EMVA 1288, expected that of todframes noise --dark or --emva"
            )
        of_file = {key: number for key, number in result.noise.emva1288.noise_table().items() if key != "model"}
        source = f"results of EMVA 1288 in {Path(emva).name}"
    elif pybsm is not None:
        of_pybsm, of_file, tables, left_out = read_pybsm(pybsm)
        thermal = thermal or of_file["wavelength_um"] >= LEAST_THERMAL_UM
        source, name = f"{of_pybsm} of {Path(pybsm).name}, pyBSM", name or of_pybsm
    given = {key: float(number) for key, number in known.items() if number is not None}
    is_thermal = thermal or preset == "boson"
    values = given | of_file if preset == "boson" else of_file | given
    for key in ("focal_length_mm", "f_number", "pitch_um", "netd_mk" if is_thermal else "quantum_efficiency"):
        if key not in values:
            how = "the results do not have it" if key == "quantum_efficiency" else f"give {getattr(argument, key)}"
            raise SettingsError(f"{key} is missing: {how}")
    optics = Optics(
        f_number=values.pop("f_number"),
        focal_length_mm=values.pop("focal_length_mm"),
        wavelength_um=values.pop("wavelength_um", THERMAL_UM if is_thermal else VISIBLE_UM),
        **tables.get("optics", {}),
    )
    detector = Detector(pitch_um=values.pop("pitch_um"), **tables.get("detector", {}))
    parts: dict[str, Any] = {}
    rate = check_rate(THERMAL_RATE_HZ if is_thermal and frames_per_second is None else frames_per_second)
    averaged = {} if rate is None else {"frames_integrated": frames_integrated(rate)}
    for table, settings in (("motion", Motion), ("turbulence", Turbulence)):
        parts |= {table: settings(**tables[table])} if table in tables else {}
    if is_thermal:
        netd = Noise(distribution="gaussian", netd_mk=values.pop("netd_mk"), couple_netd=True, **averaged)
        parts["noise"] = netd
    else:
        photons: Any = {"exposure_ms": EXPOSURE_MS} | values | averaged
        photons.pop("netd_mk", None)
        scene = Scene(luminance_cd_m2=100.0 if luminance is None else luminance)
        parts |= {"photons": PhotonNoise(**photons), "scene": scene}
    sensor = Sensor(optics=optics, detector=detector, display=DISPLAY, **parts)
    if preset == "boson":
        sensor = vary(sensor, {KEYS[key]: number for key, number in given.items() if key in of_file})
        netd_mk = float(f"{sensor.noise.netd_mk:.6g}")
        sensor = replace(sensor, noise=replace(sensor.noise, netd_mk=netd_mk))
        if "netd_mk" not in given and netd_mk != of_file["netd_mk"]:
            source += f"; NETD {netd_mk:g} mK here, by f-number² / area of a detector"
    kind = "thermal camera" if is_thermal else "camera"
    default = f"{preset or kind}, {sensor.detector.pitch_um:g} µm, {sensor.optics.focal_length_mm:g} mm"
    text = explained_toml(replace(sensor, name=name or default), source=source)
    return text if not left_out else text.replace("\n\n", f"\n{NO_COUNTERPART}{', '.join(left_out)}\n\n", 1)
