"""Settings of a sensor, checked when they are made, and the reader of `SENSOR.toml`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from todframes.base.errors import SettingsError
from todframes.base.reading import check_keys, check_values, from_table, read_toml, toml_text

SCHEMA = 1

LARGEST = 1e12
"""Largest length, angle, luminance or gain; beyond it, and below 1/LARGEST, a value is taken for a mistake."""

MAX_PIXELS = 1000
"""Largest width of a detector or a standard deviation of the blur, in display pixels."""

Distribution = Literal["uniform", "gaussian"]
Positive = Annotated[float, Meta(ge=1.0 / LARGEST, le=LARGEST)]
NotNegative = Annotated[float, Meta(ge=0.0, le=LARGEST)]
BlurPixels = Annotated[float, Meta(ge=0.0, le=MAX_PIXELS)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Optics:
    """A circular aperture with a Gaussian blur on top of its diffraction.

    Attributes
    ----------
    aperture_mm, wavelength_um : float
        Both > 0.
    blur_sigma_mrad : float
        Standard deviation of the Gaussian, never a 1/e width; >= 0.

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    aperture_mm: Positive
    wavelength_um: Positive
    blur_sigma_mrad: NotNegative = 0.0

    def __post_init__(self) -> None:
        check_values(self)

    @property
    def cut_off_cyc_per_mrad(self) -> float:
        """Frequency at and beyond which the aperture passes nothing: 1 mm / 1 µm is 1 cycle/mrad."""
        return self.aperture_mm / self.wavelength_um


@dataclass(frozen=True, slots=True, kw_only=True)
class Detector:
    """A square grid of square detectors.

    Attributes
    ----------
    pitch_mrad : float
        Distance from one detector to the next, > 0.
    width_mrad : float
        Side of the active area, > 0 and at most the pitch: pitch × √(fill factor).

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    pitch_mrad: Positive
    width_mrad: Positive

    def __post_init__(self) -> None:
        check_values(self)
        if self.width_mrad > self.pitch_mrad:
            raise SettingsError(
                f"width_mrad: found {self.width_mrad!r}, expected at most pitch_mrad ({self.pitch_mrad!r})"
            )

    @property
    def nyquist_cyc_per_mrad(self) -> float:
        """Half of the sampling frequency."""
        return 0.5 / self.pitch_mrad


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Detector noise of zero mean, independent from detector to detector.

    If the file has no such table, the noise is the uniform one of the paper, new in each frame, with one frame
    integrated.

    Attributes
    ----------
    distribution : {"uniform", "gaussian"}
    netd_mk : float or None
        Noise-equivalent temperature difference, > 0. None: no temperatures are reported.
    fixed_pattern_ratio : float
        Static divided by dynamic standard deviation, >= 0.
    frames_integrated : int
        Frames that the observer's eye averages, >= 1.

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    distribution: Distribution = "uniform"
    netd_mk: Annotated[float | None, Meta(ge=1.0 / LARGEST, le=LARGEST)] = None
    fixed_pattern_ratio: NotNegative = 0.0
    frames_integrated: Annotated[int, Meta(ge=1)] = 1

    def __post_init__(self) -> None:
        check_values(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Electronics:
    """Gaussian blur of the electronics; if the file has no such table, there is none.

    Attributes
    ----------
    blur_sigma_px : float
        Standard deviation in display pixels, in [0, 1000].

    Raises
    ------
    SettingsError
        If the value is out of its range.
    """

    blur_sigma_px: BlurPixels = 0.0

    def __post_init__(self) -> None:
        check_values(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorDisplay:
    """The display of a sensor's samples, and its viewing distance.

    Attributes
    ----------
    pixels_per_detector : int
        Display pixels along each side of a detector, 1 to 1000.
    pixel_pitch_mm, viewing_distance_mm : float
        Both > 0.
    background_luminance_cd_m2 : float
        Luminance of a signal of zero, > 0.
    blur_sigma_px : float
        Standard deviation of the Gaussian display spot in display pixels, in [0, 1000].
    gain : float
        Display contrast per unit of signal, > 0.

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    pixels_per_detector: Annotated[int, Meta(ge=1, le=MAX_PIXELS)]
    pixel_pitch_mm: Positive
    viewing_distance_mm: Positive
    background_luminance_cd_m2: Positive
    blur_sigma_px: BlurPixels = 0.0
    gain: Positive = 1.0

    def __post_init__(self) -> None:
        check_values(self)

    @property
    def pixel_pitch_mrad(self) -> float:
        """Visual angle of one display pixel."""
        return 2000.0 * math.atan(self.pixel_pitch_mm / 2.0 / self.viewing_distance_mm)

    @property
    def detector_pitch_mrad(self) -> float:
        """Visual angle of one detector as displayed."""
        return self.pixels_per_detector * self.pixel_pitch_mrad


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """All settings of the chain from the scene to the eye."""

    optics: Optics
    detector: Detector
    display: SensorDisplay
    noise: Noise = field(default_factory=Noise)
    electronics: Electronics = field(default_factory=Electronics)
    name: str = "unnamed"

    @property
    def magnification(self) -> float:
        """Visual angle on the display divided by angle in the scene."""
        return self.display.detector_pitch_mrad / self.detector.pitch_mrad


TABLES = {
    "optics": Optics,
    "detector": Detector,
    "noise": Noise,
    "electronics": Electronics,
    "display": SensorDisplay,
}

_REQUIRED_TABLES = ("optics", "detector", "display")


def load_sensor(path: Path | str) -> Sensor:
    """Return the checked settings of a `SENSOR.toml`.

    Raises
    ------
    SettingsError
        If it cannot be read or is not TOML, or a table or key is unknown, missing or out of its range; the
        message names the file, table and key, the value found and the values expected.
    """
    return sensor_from(read_toml(Path(path)), str(path))


def sensor_of(sensor: Sensor | Path | str) -> Sensor:
    """Return a sensor, read from its `SENSOR.toml` unless it is one; see `load_sensor`."""
    return sensor if isinstance(sensor, Sensor) else load_sensor(sensor)


def sensor_from(content: Mapping[str, Any], where: str) -> Sensor:
    """Return the checked settings of the tables of a `SENSOR.toml`.

    Raises
    ------
    SettingsError
        If a table or key is unknown, missing or out of its range; the message begins with `where`.
    """
    check_keys(content, ["schema", "name", *TABLES], where)
    schema = content.get("schema")
    if schema != SCHEMA or isinstance(schema, bool):
        found = "nothing" if schema is None else repr(schema)
        raise SettingsError(f"{where}: schema: found {found}, expected {SCHEMA}")
    name = content.get("name", "unnamed")
    if not isinstance(name, str):
        raise SettingsError(f"{where}: name: found {name!r}, expected a text")
    parts: dict[str, Any] = {}
    for table, kind in TABLES.items():
        if table in content:
            if not isinstance(content[table], dict):
                raise SettingsError(f"{where}: {table}: found {content[table]!r}, expected a table [{table}]")
            parts[table] = from_table(content[table], kind, f"{where}: [{table}]")
        elif table in _REQUIRED_TABLES:
            raise SettingsError(f"{where}: table [{table}] is missing")
    return Sensor(name=name, **parts)


def sensor_toml(sensor: Sensor) -> str:
    """Return the text of a `SENSOR.toml` with all keys; every number keeps all its digits."""
    return toml_text(
        {"schema": SCHEMA, "name": sensor.name} | {one: asdict(getattr(sensor, one)) for one in TABLES}
    )
