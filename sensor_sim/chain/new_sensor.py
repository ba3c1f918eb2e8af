"""The call `new_sensor`: a SENSOR.toml in which every key is explained."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

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
from todframes.base.reading import checked
from todframes.display.display import SensorDisplay
from todframes.parameters import CameraFile, Preset, PybsmFile, Rate
from todframes.recordings.recording import check_rate, frames_integrated

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
        from sensor_sim.chain.pybsm import read_pybsm
        from todframes.field.atmosphere import LEAST_THERMAL_UM

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
