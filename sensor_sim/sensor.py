"""A sensor's settings, checked once, and `SENSOR.toml`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from todframes.config import check_keys, from_table, read_toml
from todframes.errors import SettingsError

SCHEMA = 1


SMALLEST, LARGEST = 1e-12, 1e12
"""Of all lengths, angles, luminances and gains: beyond is a slip of the pen."""


MAX_PIXELS = 1000
"""Most display pixels a detector or a standard deviation of the blur may be wide."""


Distribution = Literal["uniform", "gaussian"]


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

    aperture_mm: float
    wavelength_um: float
    blur_sigma_mrad: float = 0.0

    def __post_init__(self) -> None:
        _check_positive(self, "aperture_mm", "wavelength_um")
        _check_not_negative(self, "blur_sigma_mrad")

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
        From one detector to the next, > 0.
    width_mrad : float
        Side of the active area, > 0 and at most the pitch: pitch × √(fill factor).

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    pitch_mrad: float
    width_mrad: float

    def __post_init__(self) -> None:
        _check_positive(self, "pitch_mrad", "width_mrad")
        if self.width_mrad > self.pitch_mrad:
            raise SettingsError(
                f"width_mrad: found {self.width_mrad!r}, expected at most pitch_mrad ({self.pitch_mrad!r})"
            )

    @property
    def nyquist_cyc_per_mrad(self) -> float:
        """Half of the sampling frequency."""
        return 0.5 / self.pitch_mrad

    @property
    def fill_factor(self) -> float:
        """Active share of the area."""
        return (self.width_mrad / self.pitch_mrad) ** 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Detector noise of zero mean, independent from detector to detector.

    Without the table: the uniform noise of the paper, new in each frame, one frame at a time.

    Attributes
    ----------
    distribution : {"uniform", "gaussian"}
    netd_mk : float or None
        Noise-equivalent temperature difference, > 0. None: no temperatures are reported.
    fixed_pattern_ratio : float
        Static over dynamic standard deviation, >= 0.
    frames_integrated : int
        Frames that the observer's eye averages, >= 1.

    Raises
    ------
    SettingsError
        If a value is out of its range.
    """

    distribution: Distribution = "uniform"
    netd_mk: float | None = None
    fixed_pattern_ratio: float = 0.0
    frames_integrated: int = 1

    def __post_init__(self) -> None:
        if self.distribution not in get_args(Distribution):
            raise SettingsError(
                f"distribution: found {self.distribution!r}, expected one of {', '.join(get_args(Distribution))}"
            )
        if self.netd_mk is not None:
            _check_positive(self, "netd_mk")
        _check_not_negative(self, "fixed_pattern_ratio")
        _check_count(self, "frames_integrated")


@dataclass(frozen=True, slots=True, kw_only=True)
class Electronics:
    """Gaussian blur of the electronics, its standard deviation in display pixels; without the table, none.

    Attributes
    ----------
    blur_sigma_px : float
        In [0, 1000].

    Raises
    ------
    SettingsError
        If the value is out of its range.
    """

    blur_sigma_px: float = 0.0

    def __post_init__(self) -> None:
        _check_not_negative(self, "blur_sigma_px", at_most=MAX_PIXELS)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorDisplay:
    """How detector samples are shown, and from where they are looked at.

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

    pixels_per_detector: int
    pixel_pitch_mm: float
    viewing_distance_mm: float
    background_luminance_cd_m2: float
    blur_sigma_px: float = 0.0
    gain: float = 1.0

    def __post_init__(self) -> None:
        _check_count(self, "pixels_per_detector", at_most=MAX_PIXELS)
        _check_positive(self, "pixel_pitch_mm", "viewing_distance_mm", "background_luminance_cd_m2", "gain")
        _check_not_negative(self, "blur_sigma_px", at_most=MAX_PIXELS)

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
    """Everything between the scene and the eye."""

    optics: Optics
    detector: Detector
    display: SensorDisplay
    noise: Noise = field(default_factory=Noise)
    electronics: Electronics = field(default_factory=Electronics)
    name: str = "unnamed"

    @property
    def magnification(self) -> float:
        """Visual angle on the display over angle in the scene."""
        return self.display.detector_pitch_mrad / self.detector.pitch_mrad


_TABLES = {
    "optics": Optics,
    "detector": Detector,
    "noise": Noise,
    "electronics": Electronics,
    "display": SensorDisplay,
}


_REQUIRED_TABLES = ("optics", "detector", "display")


def load_sensor(path: Path | str) -> Sensor:
    """Read and check `SENSOR.toml`.

    Raises
    ------
    SettingsError
        If it cannot be read or is not TOML, or a table or key is unknown, missing or out of its range; the
        message names the file, table and key, what was found and what was expected.
    """
    content = read_toml(Path(path))
    check_keys(content, ["schema", "name", *_TABLES], str(path))
    schema = content.get("schema")
    if schema != SCHEMA or isinstance(schema, bool):
        found = "nothing" if schema is None else repr(schema)
        raise SettingsError(f"{path}: schema: found {found}, expected {SCHEMA}")
    name = content.get("name", "unnamed")
    if not isinstance(name, str):
        raise SettingsError(f"{path}: name: found {name!r}, expected a text")
    parts: dict[str, Any] = {}
    for table, kind in _TABLES.items():
        if table in content:
            if not isinstance(content[table], dict):
                raise SettingsError(f"{path}: {table}: found {content[table]!r}, expected a table [{table}]")
            parts[table] = from_table(content[table], kind, f"{path}: [{table}]")
        elif table in _REQUIRED_TABLES:
            raise SettingsError(f"{path}: table [{table}] is missing")
    return Sensor(name=name, **parts)


def _check_positive(settings: object, *names: str) -> None:
    for name in names:
        value = getattr(settings, name)
        if not SMALLEST <= value <= LARGEST:
            raise SettingsError(
                f"{name}: found {value!r}, expected a finite number > 0, from {SMALLEST:g} to {LARGEST:g}"
            )


def _check_not_negative(settings: object, name: str, *, at_most: float | None = None) -> None:
    value = getattr(settings, name)
    at_most = LARGEST if at_most is None else at_most
    if not 0.0 <= value <= at_most:
        raise SettingsError(f"{name}: found {value!r}, expected a finite number >= 0 and <= {at_most:g}")


def _check_count(settings: object, name: str, *, at_most: float = math.inf) -> None:
    value = getattr(settings, name)
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= at_most:
        limit = f" and <= {at_most:g}" if at_most < math.inf else ""
        raise SettingsError(f"{name}: found {value!r}, expected a whole number >= 1{limit}")
