"""Settings of a sensor, checked when they are made, and the reader of `SENSOR.toml`."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from msgspec import Meta

from sensor_sim.chain.measured import MeasuredMtf, MeasuredPsf, read_measured_mtf, read_measured_psf
from todframes.base.errors import SettingsError, TodframesError
from todframes.base.reading import (
    check_values,
    checked,
    convert,
    descriptions,
    documented,
    from_table,
    read_toml,
    toml_literal,
    toml_text,
    without_schema,
)
from todframes.display.display import LARGEST, BlurPixels, OptionalPositive, Positive
from todframes.display.display import SensorDisplay as SensorDisplay  # ss.SensorDisplay

SCHEMA = 1

BESIDE_DIFFRACTION = ("blur_sigma_mrad", "obscuration_ratio", "defocus_waves")
"""Keys of the model of the optics that a measured MTF or PSF replaces; without effect at 0."""

MOST_FRAMES = 10_000
"""Largest number of frames that the eye averages; frames of the eye's 0.1 s are far fewer."""

SAME_RATIO = 1e-5
"""Relative difference by which parts of a noise may be larger than all of it: files have six digits."""

Distribution = Literal["uniform", "gaussian"]
NotNegative = Annotated[float, Meta(ge=0.0, le=LARGEST)]
Share = Annotated[float, Meta(ge=1e-6, le=1.0)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]


@documented
@dataclass(frozen=True, slots=True, kw_only=True)
class Optics:
    """A circular aperture with a Gaussian blur on top of its diffraction, or measured optics."""

    aperture_mm: Annotated[
        OptionalPositive, Meta(description="Diameter of the circular aperture. In its place: `f_number`.")
    ] = None
    wavelength_um: Annotated[
        OptionalPositive, Meta(description="Wavelength of the diffraction, and of the light.")
    ] = None
    blur_sigma_mrad: Annotated[
        NotNegative,
        Meta(description="Standard deviation of a Gaussian blur on top of the diffraction, never a 1/e width."),
    ] = 0.0
    f_number: Annotated[OptionalPositive, Meta(description="Focal length over the diameter of the aperture.")] = (
        None
    )
    focal_length_mm: Annotated[OptionalPositive, Meta(description="Turns lengths on the chip into angles.")] = None
    transmission: Annotated[
        Share, Meta(description="Share of the light that the lens passes; for photons only.")
    ] = 1.0
    obscuration_ratio: Annotated[
        float, Meta(ge=0.0, le=0.99, description="Diameter of a central obscuration over that of the aperture.")
    ] = 0.0
    defocus_waves: Annotated[
        float, Meta(ge=0.0, le=20.0, description="Wavefront error of defocus at the rim, in wavelengths.")
    ] = 0.0
    mtf: Annotated[
        MeasuredMtf | None, Meta(description="Table of a measured MTF, in place of the model of the optics.")
    ] = None
    mtf_includes_detector: Annotated[
        bool,
        Meta(description="Whether that MTF holds the width of the detectors too, as that of a whole camera does."),
    ] = False
    psf: Annotated[
        MeasuredPsf | None, Meta(description="Image of a point, in place of the model of the optics.")
    ] = None
    psf_pitch_um: Annotated[
        OptionalPositive, Meta(description="Distance of the samples of that image on the chip.")
    ] = None
    psf_pitch_mrad: Annotated[OptionalPositive, Meta(description="Or their distance as an angle.")] = None

    def __post_init__(self) -> None:
        check_values(self)
        self._check_measured()
        if self.f_number is not None:
            if self.focal_length_mm is None:
                raise SettingsError("focal_length_mm is missing: the aperture is focal_length_mm / f_number")
            convert(self.focal_length_mm / self.f_number, Positive, "aperture_mm")
        elif self.aperture_mm is None and self.is_modelled:
            raise SettingsError("aperture_mm is missing")
        if self.wavelength_um is None and self.is_modelled:
            raise SettingsError("wavelength_um is missing")

    def _check_measured(self) -> None:
        given = [name for name in ("mtf", "psf") if getattr(self, name) is not None]
        if given:
            others = [name for name in BESIDE_DIFFRACTION if getattr(self, name) != 0.0]
            if len(given + others) > 1:
                raise SettingsError(f"found {' and '.join(given + others)}, expected one: a measured one has all")
        pitches = [pitch for pitch in (self.psf_pitch_um, self.psf_pitch_mrad) if pitch is not None]
        if len(pitches) != (self.psf is not None):
            raise SettingsError(
                "psf: expected it with psf_pitch_um or psf_pitch_mrad, the distance of its samples"
            )
        if self.mtf_includes_detector and self.mtf is None:
            raise SettingsError("mtf_includes_detector: found true without mtf, expected a measured one")

    @property
    def is_modelled(self) -> bool:
        """Whether the transfer is that of a model, and not measured."""
        return self.mtf is None and self.psf is None


@documented
@dataclass(frozen=True, slots=True, kw_only=True)
class Detector:
    """A square grid of square detectors."""

    pitch_mrad: Annotated[OptionalPositive, Meta(description="Distance from one detector to the next.")] = None
    width_mrad: Annotated[
        OptionalPositive, Meta(description="Side of the active area: pitch times the root of the fill factor.")
    ] = None
    pitch_um: Annotated[
        OptionalPositive, Meta(description="Distance from one detector to the next on the chip.")
    ] = None
    width_um: Annotated[OptionalPositive, Meta(description="Side of the active area; without it, the pitch.")] = (
        None
    )

    def __post_init__(self) -> None:
        check_values(self)
        unit = "um" if self.pitch_um is not None else "mrad"
        pitch, width = (getattr(self, f"{name}_{unit}") for name in ("pitch", "width"))
        if unit == "mrad":
            if self.width_um is not None:
                raise SettingsError("pitch_um is missing: width_um is a width on the chip")
            for name, value in (("pitch_mrad", pitch), ("width_mrad", width)):
                if value is None:
                    raise SettingsError(f"{name} is missing")
        if width is not None and width > pitch:
            raise SettingsError(f"width_{unit}: found {width!r}, expected at most pitch_{unit} ({pitch!r})")


@documented
@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Detector noise of zero mean: of each detector by itself, and of what rows and columns have in common.

    If the file has no such table, the noise is the uniform one of the paper, new in each frame, with one frame
    integrated.
    """

    distribution: Annotated[Distribution, Meta(description="Uniform or gaussian.")] = "uniform"
    netd_mk: Annotated[
        OptionalPositive,
        Meta(description="Noise-equivalent temperature difference of one frame. None: no ΔT is reported."),
    ] = None
    fixed_pattern_ratio: Annotated[NotNegative, Meta(description="Static over dynamic standard deviation.")] = 0.0
    frames_integrated: Annotated[int, Meta(ge=1, le=MOST_FRAMES, description="Frames that the eye averages.")] = 1
    row_noise_ratio: Annotated[
        Fraction, Meta(description="Deviation that a row shares, new in each frame, over the dynamic deviation.")
    ] = 0.0
    column_noise_ratio: Annotated[Fraction, Meta(description="The same of columns.")] = 0.0
    row_pattern_ratio: Annotated[
        NotNegative, Meta(description="Deviation that a row shares in all frames, over the dynamic deviation.")
    ] = 0.0
    column_pattern_ratio: Annotated[NotNegative, Meta(description="The same of columns.")] = 0.0
    couple_netd: Annotated[
        bool, Meta(description="The NETD follows f-number² / area of a detector where they are varied.")
    ] = False

    def __post_init__(self) -> None:
        check_values(self)
        for kind, whole, of_what in (
            ("noise", 1.0, "1, the dynamic noise that they are parts of"),
            ("pattern", self.fixed_pattern_ratio, "fixed_pattern_ratio, of which they are parts"),
        ):
            names = [f"{line}_{kind}_ratio" for line in ("row", "column")]
            lines = math.hypot(*(getattr(self, name) for name in names))
            if lines > whole * (1.0 + SAME_RATIO):
                raise SettingsError(
                    f"{', '.join(names)}: found {lines:.6g} as the root of the sum of their squares, expected at "
                    f"most {of_what}"
                )
        if self.couple_netd and self.netd_mk is None:
            raise SettingsError("couple_netd: needs netd_mk, which is missing")


@documented
@dataclass(frozen=True, slots=True, kw_only=True)
class PhotonNoise:
    """Noise of a camera that counts photons, in the words of EMVA 1288. The level is then the contrast."""

    quantum_efficiency: Annotated[
        Share | None,
        Meta(description="Electrons for each photon on the area of a pixel, its insensitive part included."),
    ] = None
    system_gain_dn_per_electron: Annotated[
        OptionalPositive, Meta(description="K: digital numbers for each electron. None: nothing is rounded.")
    ] = None
    dark_noise_electrons: Annotated[NotNegative, Meta(description="Standard deviation of a frame in the dark.")]
    dark_current_electrons_per_s: Annotated[NotNegative, Meta(description="At the temperature of use.")] = 0.0
    dsnu_electrons: Annotated[
        NotNegative, Meta(description="Standard deviation of the fixed pattern in the dark.")
    ] = 0.0
    prnu_percent: Annotated[
        float, Meta(ge=0.0, le=100.0, description="Standard deviation of the responses of the pixels.")
    ] = 0.0
    full_well_electrons: Annotated[
        OptionalPositive, Meta(description="Electrons at which a pixel saturates. None: never.")
    ] = None
    bits: Annotated[
        Annotated[int, Meta(ge=1, le=32)] | None,
        Meta(description="Bits of the converter, whose largest number is 2**bits − 1. None: no end."),
    ] = None
    exposure_ms: Annotated[Positive, Meta(description="Exposure of a frame.")]
    row_noise_electrons: Annotated[
        NotNegative, Meta(description="Noise that the pixels of a row share, new in each frame.")
    ] = 0.0
    column_noise_electrons: Annotated[
        NotNegative, Meta(description="Noise that the pixels of a column share, new in each frame.")
    ] = 0.0
    row_pattern_electrons: Annotated[
        NotNegative, Meta(description="Noise that the pixels of a row share in all frames.")
    ] = 0.0
    column_pattern_electrons: Annotated[
        NotNegative, Meta(description="Noise that the pixels of a column share in all frames.")
    ] = 0.0
    frames_integrated: Annotated[int, Meta(ge=1, le=MOST_FRAMES, description="Frames that the eye averages.")] = 1

    def __post_init__(self) -> None:
        check_values(self)
        if self.bits is not None and self.system_gain_dn_per_electron is None:
            raise SettingsError("system_gain_dn_per_electron is missing: bits need it")

    @property
    def dark_electrons(self) -> float:
        """Mean number of electrons of the dark current in an exposure."""
        return self.dark_current_electrons_per_s * self.exposure_ms / 1000.0

    @property
    def saturation_electrons(self) -> float:
        """Electrons at which the pixel or its converter saturates; infinity if neither does."""
        of_pixel = math.inf if self.full_well_electrons is None else self.full_well_electrons
        if self.bits is None or self.system_gain_dn_per_electron is None:
            return of_pixel
        of_converter: float = (2**self.bits - 1) / self.system_gain_dn_per_electron
        return min(of_pixel, of_converter)


@documented
@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """The light of the background in front of a camera that counts photons."""

    luminance_cd_m2: Annotated[
        OptionalPositive, Meta(description="Light of the background. In its place: illuminance · reflectance / π.")
    ] = None
    illuminance_lx: Annotated[OptionalPositive, Meta(description="Illuminance of a matt background.")] = None
    reflectance: Annotated[Share | None, Meta(description="Share of the light that this background reflects.")] = (
        None
    )
    photons_per_lux_s_um2: Annotated[
        OptionalPositive,
        Meta(description="Photons of a lux; without it, those of monochromatic light of the wavelength."),
    ] = None
    background_electrons: Annotated[
        OptionalPositive,
        Meta(description="Measured, of the background in a pixel and exposure, in place of lens and QE."),
    ] = None

    def __post_init__(self) -> None:
        check_values(self)
        by_light = (self.illuminance_lx, self.reflectance)
        if self.luminance_cd_m2 is not None and by_light != (None, None):
            raise SettingsError(
                "found luminance_cd_m2 and also illuminance_lx or reflectance, expected one of the two ways"
            )
        if self.luminance_cd_m2 is None and None in by_light and self.background_electrons is None:
            raise SettingsError("luminance_cd_m2 is missing; expected it, or illuminance_lx and reflectance")

    @property
    def background_cd_m2(self) -> float:
        """Luminance of the background; SettingsError if the scene has its electrons alone."""
        if self.luminance_cd_m2 is not None:
            return self.luminance_cd_m2
        if self.illuminance_lx is None or self.reflectance is None:
            raise SettingsError(
                "scene.luminance_cd_m2 is missing: background_electrons alone do not say how bright it is"
            )
        return float(self.illuminance_lx * self.reflectance / math.pi)

    def at(self, luminance_cd_m2: float) -> Scene:
        """Return the scene at another luminance, with electrons in proportion; SettingsError if it has none."""
        electrons = self.background_electrons
        if electrons is not None:
            electrons *= luminance_cd_m2 / self.background_cd_m2
        return replace(
            self,
            luminance_cd_m2=luminance_cd_m2,
            illuminance_lx=None,
            reflectance=None,
            background_electrons=electrons,
        )


@documented
@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Motion of the camera during the exposure of a frame."""

    smear_mrad: Annotated[
        NotNegative, Meta(description="Length of an even motion along x during an exposure.")
    ] = 0.0
    jitter_sigma_mrad: Annotated[
        NotNegative, Meta(description="Standard deviation of a random motion, the same along x and y.")
    ] = 0.0

    def __post_init__(self) -> None:
        check_values(self)


@documented
@dataclass(frozen=True, slots=True, kw_only=True)
class Turbulence:
    """Turbulence of the air between scene and camera, the same along the whole path."""

    cn2_m23: Annotated[
        float, Meta(ge=0.0, le=1e-9, description="Structure constant Cn² of the refractive index, in m^(−2/3).")
    ]
    path_km: Annotated[float, Meta(ge=1e-3, le=1e3, description="Length of the path from the scene.")]
    short_exposure_alpha: Annotated[
        Fraction, Meta(description="Fried's α: 0 is a long exposure; a short one has 0.5 (far field) to 1 (near).")
    ] = 0.0

    def __post_init__(self) -> None:
        check_values(self)


@documented
@dataclass(frozen=True, slots=True, kw_only=True)
class Electronics:
    """Gaussian blur of the electronics; if the file has no such table, there is none."""

    blur_sigma_px: Annotated[BlurPixels, Meta(description="Gaussian blur in display pixels.")] = 0.0

    def __post_init__(self) -> None:
        check_values(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensor:
    """All settings of the chain from the scene to the eye.

    Attributes
    ----------
    optics : Optics
    detector : Detector
    display : SensorDisplay
    noise : Noise
        Noise relative to the signal, for levels that are SNRs. Not used with `photons`.
    electronics : Electronics
    name : str
        Name of the sensor, for messages and titles.
    photons : PhotonNoise or None
        Noise of a camera that counts photons; levels are then contrasts at the light of the `scene`.
    scene : Scene or None
        Light of the background; needed with `photons`.
    motion : Motion or None
        Motion during an exposure. None: the camera is at rest.
    turbulence : Turbulence or None
        Turbulence of the air. None: the air is at rest.

    Raises
    ------
    SettingsError
        If a part lacks what another one needs. Each part checks its own values in the same way.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> sensor = ss.Sensor(
    ...     optics=ss.Optics(aperture_mm=50.0, wavelength_um=10.0),
    ...     detector=ss.Detector(pitch_mrad=0.2, width_mrad=0.18),
    ...     noise=ss.Noise(netd_mk=40.0),
    ...     display=ss.SensorDisplay(
    ...         pixels_per_detector=2,
    ...         pixel_pitch_mm=0.25,
    ...         viewing_distance_mm=500.0,
    ...         background_luminance_cd_m2=50.0,
    ...     ),
    ... )
    >>> ss.curve(sensor, size_detectors=[5]).thresholds[0].status
    'ok'
    """

    optics: Optics
    detector: Detector
    display: SensorDisplay
    noise: Noise = field(default_factory=Noise)
    electronics: Electronics = field(default_factory=Electronics)
    name: str = "unnamed"
    photons: PhotonNoise | None = None
    scene: Scene | None = None
    motion: Motion | None = None
    turbulence: Turbulence | None = None

    def __post_init__(self) -> None:
        check_values(self)
        if self.turbulence is not None and self.optics.wavelength_um is None:
            raise SettingsError("optics.wavelength_um is missing: turbulence depends on it")
        if self.turbulence is not None and self.turbulence.short_exposure_alpha and self.aperture_mm is None:
            raise SettingsError("optics.aperture_mm is missing: turbulence.short_exposure_alpha needs it")
        in_mm = self.optics.mtf is not None and self.optics.mtf.unit == "cyc_per_mm"
        for name, is_on_chip in (
            ("detector.pitch_um", self.detector.pitch_um is not None),
            ("mtf in cycles/mm", in_mm),
            ("psf_pitch_um", self.optics.psf_pitch_um is not None),
        ):
            if is_on_chip and self.optics.focal_length_mm is None:
                raise SettingsError(f"optics.focal_length_mm is missing: {name} needs it for its angle")
        for name in ("pitch_mrad", "width_mrad", "frequency_scale"):
            convert(getattr(self, name), Positive, name)
        if self.photons is None:
            if self.scene is not None:
                raise SettingsError('scene: found a table [scene], expected [noise] with model = "photon" too')
            return
        if self.scene is None:
            raise SettingsError('table [scene] is missing: [noise] with model = "photon" needs its light')
        if self.scene.background_electrons is not None:
            return
        if self.optics.focal_length_mm is None or self.aperture_mm is None:
            name = "aperture_mm" if self.aperture_mm is None else "focal_length_mm"
            raise SettingsError(f"optics.{name} is missing: light falls on a pixel by f-number and area")
        if self.optics.wavelength_um is None and self.scene.photons_per_lux_s_um2 is None:
            raise SettingsError("optics.wavelength_um is missing: it gives the photons of a lux")
        if self.photons.quantum_efficiency is None:
            raise SettingsError("noise.quantum_efficiency is missing: it turns photons into electrons")

    @property
    def frames_integrated(self) -> int:
        """Number of frames that the eye averages."""
        return self.noise.frames_integrated if self.photons is None else self.photons.frames_integrated

    @property
    def level(self) -> str:
        """Quantity that is the strength of a triangle: SNR, or the contrast for a camera that counts photons."""
        return "snr" if self.photons is None else "contrast"

    @property
    def aperture_mm(self) -> float | None:
        """Diameter of the aperture; None for measured optics without one."""
        optics = self.optics
        if optics.f_number is None or optics.focal_length_mm is None:
            return optics.aperture_mm
        return optics.focal_length_mm / optics.f_number

    @property
    def pitch_mrad(self) -> float:
        """Angle from one detector to the next."""
        return self._angle(self.detector.pitch_mrad, self.detector.pitch_um)

    @property
    def width_mrad(self) -> float:
        """Angle of the active width of a detector; the pitch, if there is only a pitch on the chip."""
        detector = self.detector
        return self._angle(detector.width_mrad, detector.width_um or detector.pitch_um)

    def _angle(self, angle_mrad: float | None, length_um: float | None) -> float:
        if self.detector.pitch_um is None or length_um is None or self.optics.focal_length_mm is None:
            assert angle_mrad is not None  # checked by `Detector`
            return angle_mrad
        return length_um / self.optics.focal_length_mm

    @property
    def frequency_scale(self) -> float:
        """Units of the measured MTF's frequencies, or cycles per sample of the PSF, in a cycle/mrad."""
        optics = self.optics
        if optics.psf is not None and optics.psf_pitch_mrad is not None:
            return optics.psf_pitch_mrad
        if optics.psf_pitch_um is not None and optics.focal_length_mm is not None:
            return optics.psf_pitch_um / optics.focal_length_mm
        if optics.mtf is not None and optics.mtf.unit == "cyc_per_mm" and optics.focal_length_mm is not None:
            return 1000.0 / optics.focal_length_mm
        return self.pitch_mrad if optics.mtf is not None and optics.mtf.unit == "cyc_per_pixel" else 1.0

    @property
    def magnification(self) -> float:
        """Visual angle on the display divided by angle in the scene."""
        return self.display.detector_pitch_mrad / self.pitch_mrad


TABLES = {
    "turbulence": Turbulence,
    "optics": Optics,
    "motion": Motion,
    "detector": Detector,
    "scene": Scene,
    "noise": Noise,
    "electronics": Electronics,
    "display": SensorDisplay,
}

NOISE_MODELS: dict[str, type] = {"photon": PhotonNoise}
"""Settings of the table [noise], by its key `model`; without this key they are those of `Noise`."""

_REQUIRED_TABLES = ("optics", "detector", "display")

_EITHER = (
    ("optics", "aperture_mm", "f_number"),
    ("detector", "pitch_mrad", "pitch_um"),
    ("detector", "pitch_mrad", "width_um"),
    ("detector", "width_mrad", "pitch_um"),
)
"""A table and two of its keys that set the same value."""


PRESETS = files("sensor_sim.chain").joinpath("presets")
"""Sensors that have names."""


@checked
def load_sensor(path: Path | str) -> Sensor:
    """Return the checked settings of a `SENSOR.toml`.

    Parameters
    ----------
    path : path or str
        The file, or the name of a preset such as "uncooled_lwir". Files that it names (`mtf`, `psf`) are read from
        its folder or below.

    Returns
    -------
    Sensor

    Raises
    ------
    SettingsError
        If it cannot be read or is not TOML, or a table or key is unknown, missing or out of its range; the
        message names the file, table and key, the value found and the values expected.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> ss.load_sensor("sample_frames/star_like.toml").pitch_mrad
    0.0681
    """
    file, where = Path(path), str(path)
    if not (file.suffix or file.exists()):
        presets = preset_files()
        if where not in presets:
            raise SettingsError(f"{where}: no such file, and not one of the presets {', '.join(presets)}")
        file = presets[where]
    return sensor_from(read_toml(file), where, folder=file.parent)


def preset_files() -> dict[str, Path]:
    """Return the files of the presets by their names."""
    paths = sorted(Path(str(file)) for file in PRESETS.iterdir())
    return {path.stem: path for path in paths if path.suffix == ".toml"}


def sensor_of(sensor: Sensor | Path | str) -> Sensor:
    """Return a sensor, read from its `SENSOR.toml` unless it is one; see `load_sensor`."""
    return sensor if isinstance(sensor, Sensor) else load_sensor(sensor)


def sensor_from(
    content: Mapping[str, Any],
    where: str,
    *,
    folder: Path | None = None,
    measured: Mapping[str, MeasuredMtf | MeasuredPsf] | None = None,
) -> Sensor:
    """Return the checked settings of the tables of a `SENSOR.toml`; the errors of `load_sensor` begin with
    `where`. Measured files lie in `folder`, or are among those `measured`, by their keys such as "mtf", that have
    been read; without a folder, no file is read.
    """
    content = without_schema(content, SCHEMA, ["name", *TABLES], where)
    tables = {
        name: convert(value, dict[str, Any], f"{where}: {name}")
        for name, value in content.items()
        if name in TABLES
    }
    for table, key, other in _EITHER:
        if {key, other} <= tables.get(table, {}).keys():
            raise SettingsError(f"{where}: [{table}]: found {key} and {other}, expected one of them")
    parts: dict[str, Any] = {}
    for table, values in tables.items():
        place = f"{where}: [{table}]"
        if table == "optics":
            parts[table] = from_table(_with_measured(values, place, folder, measured or {}), Optics, place)
        elif "model" in values and table == "noise":
            model = convert(values["model"], Literal[*NOISE_MODELS], f"{place}: model")
            others = {name: value for name, value in values.items() if name != "model"}
            parts["photons"] = from_table(others, NOISE_MODELS[model], place)
        else:
            parts[table] = from_table(values, TABLES[table], place)
    for table in _REQUIRED_TABLES:
        if table not in parts:
            raise SettingsError(f"{where}: table [{table}] is missing")
    return from_table({"name": content.get("name", "unnamed")} | parts, Sensor, where)


def _with_measured(
    table: Mapping[str, Any], where: str, folder: Path | None, measured: Mapping[str, MeasuredMtf | MeasuredPsf]
) -> dict[str, Any]:
    """Return the table [optics] with the content of the files that it names."""
    values = dict(table)
    for name, read in (("mtf", read_measured_mtf), ("psf", read_measured_psf)):
        file = values.get(name)
        if file is None:
            continue
        convert(file, str, f"{where}: {name}")
        if name in measured and measured[name].file == file:
            values[name] = measured[name]
            continue
        if folder is None:
            raise SettingsError(
                f"{where}: {name}: found {file!r}, a file that cannot be read from here; give the "
                "command the path of this SENSOR.toml"
            )
        try:
            values[name] = read(file, folder)
        except TodframesError as error:
            raise SettingsError(f"{where}: {error}") from None
    return values


def part_of(table: str, sensor: Sensor) -> str:
    """Return the name of the attribute of a sensor that holds the settings of a table."""
    return "photons" if table == "noise" and sensor.photons is not None else table


def used_keys(sensor: Sensor) -> dict[str, list[str]]:
    """Return the keys of each table that mean something for a sensor, without those that follow from others."""
    keys = {}
    for table in TABLES:
        part = getattr(sensor, part_of(table, sensor))
        if part is not None:
            follows = _derived_keys(part, sensor)
            keys[table] = [parameter.name for parameter in fields(part) if parameter.name not in follows]
    return keys


def _derived_keys(part: object, sensor: Sensor) -> tuple[str, ...]:
    """Return the names of a part's settings that follow from others of the sensor, or are of no use with them."""
    if isinstance(part, Optics):
        names = ["aperture_mm" if part.f_number is not None else "f_number"]
        light = sensor.scene
        has_no_light = light is None or light.background_electrons is not None
        names += ["transmission"] if has_no_light else []
        if not part.is_modelled:
            # Aperture and wavelength then matter only to light, the NETD that follows it, and turbulence.
            names += BESIDE_DIFFRACTION
            air = sensor.turbulence
            if has_no_light and not sensor.noise.couple_netd and not (air and air.short_exposure_alpha):
                names += ["aperture_mm", "f_number"]
            if air is None and (has_no_light or (light is not None and light.photons_per_lux_s_um2 is not None)):
                names.append("wavelength_um")
        return tuple(names)
    if isinstance(part, Detector):
        return ("pitch_mrad", "width_mrad") if part.pitch_um is not None else ("pitch_um", "width_um")
    if isinstance(part, Scene):
        if part.luminance_cd_m2 is None and part.illuminance_lx is None:
            return ("luminance_cd_m2", "illuminance_lx", "reflectance", "photons_per_lux_s_um2")
        of_light = ("illuminance_lx", "reflectance") if part.luminance_cd_m2 is not None else ("luminance_cd_m2",)
        return of_light if part.background_electrons is None else (*of_light, "photons_per_lux_s_um2")
    return ()


def sensor_tables(sensor: Sensor) -> dict[str, Any]:
    """Return the tables of a sensor as plain values, as a `SENSOR.toml` has them; unused keys are left out."""
    tables: dict[str, Any] = {}
    for table, names in used_keys(sensor).items():
        part = part_of(table, sensor)
        values = {name: _plain(getattr(getattr(sensor, part), name)) for name in names}
        defaults = {parameter.name: parameter.default for parameter in fields(getattr(sensor, part))}
        model = {"model": "photon"} if part == "photons" else {}
        # A NETD that is not known is null in results; other keys that say nothing are left out.
        tables[table] = model | {
            name: value
            for name, value in values.items()
            if (value is not None or name == "netd_mk") and not (name in _IDLE and value == defaults[name])
        }
    return tables


def sensor_settings(sensor: Sensor) -> dict[str, Any]:
    """Return the tables and the name of a sensor as plain values, in the order of its attributes, for results."""
    content = {"name": sensor.name} | sensor_tables(sensor)
    return {part.name: content[part.name] for part in fields(sensor) if part.name in content}


_IDLE = {
    *("transmission", "obscuration_ratio", "defocus_waves", "mtf_includes_detector", "couple_netd"),
    *(f"{line}_{kind}_ratio" for line in ("row", "column") for kind in ("noise", "pattern")),
}
"""Keys that are left out where they have their defaults, which change nothing."""


def _plain(value: Any) -> Any:
    """Return a setting as a `SENSOR.toml` has it: a file by its name."""
    return value.file if isinstance(value, MeasuredMtf | MeasuredPsf) else value


def sensor_toml(sensor: Sensor) -> str:
    """Return the text of a `SENSOR.toml` with all keys; every number keeps all its digits."""
    return toml_text({"schema": SCHEMA, "name": sensor.name} | sensor_tables(sensor))


EXPLAINED = {
    f"{table}.{name}": text.partition(". ")[0].rstrip(".")
    for table, settings in (*TABLES.items(), *(("noise", model) for model in NOISE_MODELS.values()))
    for name, text in descriptions(settings).items()
}
"""Each key of a SENSOR.toml in words."""


def explained_toml(sensor: Sensor, *, source: str = "") -> str:
    """Return the text of a `SENSOR.toml` with a comment at every key; keys without a value are comments."""
    lines = sensor_toml(sensor).splitlines()[:2]
    lines += [f"# {line}" for line in textwrap.wrap(f"Source: {source}", 100)] if source else []
    set_keys = sensor_tables(sensor)
    for table, names in used_keys(sensor).items():
        lines += ["", f"[{table}]"]
        values = set_keys[table]
        if "model" in values:
            lines.append(f"model = {toml_literal(values['model'])}  # in the words of EMVA 1288")
        for name in names:
            value = _plain(getattr(getattr(sensor, part_of(table, sensor)), name))
            text = f"{name} =" if value is None else f"{name} = {toml_literal(value)}"
            is_set = values.get(name) is not None
            explained = EXPLAINED.get(f"{table}.{name}", "")
            if explained[1:2].islower() and not explained.startswith(("Gaussian", "Fried")):
                explained = explained[0].lower() + explained[1:]
            lines.append(f"{'' if is_set else '# '}{text}  # {explained}")
    return "\n".join([*lines, ""])
