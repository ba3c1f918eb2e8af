"""The call `new_sensor`: a SENSOR.toml in which every key is explained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from sensor_sim.chain.sensor import (
    Detector,
    Noise,
    Optics,
    PhotonNoise,
    Scene,
    Sensor,
    SensorDisplay,
    explained_toml,
)
from todframes.base.errors import SettingsError, argument
from todframes.parameters import CameraFile, Preset

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

EXPOSURE_MS = 10.0
"""Exposure if neither the file nor the user has one."""

DISPLAY = SensorDisplay(
    pixels_per_detector=1, pixel_pitch_mm=0.2909, viewing_distance_mm=1000.0, background_luminance_cd_m2=50.0
)
"""Display that the file begins with: `import` shows a pixel of a recording at the same angle, one arcmin."""


def new_sensor(
    *,
    emva: CameraFile | None = None,
    thermal: bool = False,
    preset: Preset | None = None,
    focal_length_mm: float,
    f_number: float | None = None,
    pitch_um: float | None = None,
    netd_mk: float | None = None,
    wavelength_um: float | None = None,
    exposure_ms: float | None = None,
    luminance: float = 100.0,
    name: str | None = None,
) -> str:
    """Return a SENSOR.toml in which every key is explained.

    It is for a camera with results of EMVA 1288, a thermal camera, or one from public figures.

    Parameters
    ----------
    emva : path, optional
        Results of EMVA 1288 (XML), from which a camera that counts photons takes its noise.
    thermal : bool
        Describe a thermal camera, by its NETD.
    preset : {"emva_basler", "boson"}, optional
        A camera from public figures, whose source stands in the file; other values that are given replace its own.
    focal_length_mm : float
        Focal length of the lens in mm.
    f_number : float, optional
        f-number of the lens.
    pitch_um : float, optional
        From one detector to the next on the chip in µm.
    netd_mk : float, optional
        NETD of a thermal camera in mK.
    wavelength_um : float, optional
        Wavelength in µm. Default: 0.55, thermal 10.
    exposure_ms : float, optional
        Exposure in ms. Default: that of the results, or 10.
    luminance : float
        Luminance of the background in cd/m², for a camera that counts photons.
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
        If the XML cannot be read.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> text = ss.new_sensor(thermal=True, netd_mk=50, pitch_um=12, f_number=1.0, focal_length_mm=35)
    >>> text.splitlines()[0]
    'schema = 1'
    """
    if sum((emva is not None, thermal, preset is not None)) != 1:
        raise SettingsError(f"new: expected one of {argument.emva}, {argument.thermal} and {argument.preset}")
    source = ""
    of_file: dict[str, Any] = {}
    if preset is not None:
        if preset not in PRESETS:
            raise SettingsError(f"preset: found {preset!r}, expected one of {', '.join(PRESETS)}")
        source, of_file = PRESETS[preset]
    elif emva is not None:
        from todframes.camera.emva_xml import read_emva_xml

        of_file = {key: number for key, number in read_emva_xml(Path(emva)).items() if key != "model"}
        source = f"results of EMVA 1288 in {Path(emva).name}"
    given = {"f_number": f_number, "pitch_um": pitch_um, "netd_mk": netd_mk, "exposure_ms": exposure_ms}
    values = of_file | {key: float(number) for key, number in given.items() if number is not None}
    is_thermal = thermal or preset == "boson"
    needed = ("f_number", "pitch_um", "netd_mk") if is_thermal else ("f_number", "pitch_um", "quantum_efficiency")
    for key in needed:
        if key not in values:
            how = f"give {getattr(argument, key)}" if key in given else "the results do not have it"
            raise SettingsError(f"{key} is missing: {how}")
    optics = Optics(
        f_number=values.pop("f_number"),
        focal_length_mm=focal_length_mm,
        wavelength_um=(THERMAL_UM if is_thermal else VISIBLE_UM) if wavelength_um is None else wavelength_um,
    )
    detector = Detector(pitch_um=values.pop("pitch_um"))
    parts: dict[str, Any]
    if is_thermal:
        netd = Noise(distribution="gaussian", netd_mk=values.pop("netd_mk"), couple_netd=True)
        parts = {"noise": netd}
    else:
        photons: Any = {"exposure_ms": EXPOSURE_MS} | values
        photons.pop("netd_mk", None)
        parts = {"photons": PhotonNoise(**photons), "scene": Scene(luminance_cd_m2=luminance)}
    kind = "thermal camera" if is_thermal else "camera"
    sensor = Sensor(
        name=name or f"{preset or kind}, {detector.pitch_um:g} µm, {focal_length_mm:g} mm",
        optics=optics,
        detector=detector,
        display=DISPLAY,
        **parts,
    )
    return explained_toml(sensor, source=source)
