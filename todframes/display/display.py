"""Displays: code values to luminance and contrast, the viewing geometry, and their descriptions in files.

A file has the table [display] of a dataset, `title` and `source`; the background is the surround of the triangle
unless it says otherwise. A SENSOR.toml describes the display of a camera's signals: how large its samples are
shown, how bright, and with which gain.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import (
    SETTINGS_SUFFIX,
    check_keys,
    check_values,
    convert,
    documented,
    from_table,
    path_inside,
    read_described,
    read_numbers,
    read_toml,
    settings_path,
    table_beside,
)
from todframes.base.safe_text import csv_text

INTEGRATION_TIME_S = 0.1
"""Time in which the eye integrates what a display shows. Hogervorst et al. 2001, section 4."""

SCHEMA = 1
"""Version of the format of display files that this package reads."""

LUT_FILE = "lut.csv"
"""Name that a display's table of luminances gets in a dataset."""

SENSOR_TABLES = {"optics", "detector"}
"""Tables of a SENSOR.toml that a display's file has not."""

FOLDER = Path(__file__).with_name("displays")

Eotf = Literal["linear", "srgb", "bt1886", "gamma", "lut"]

BackgroundRule = Literal["surround", "border", "frame_mean", "column"]

REC_709_LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear red, green and blue in the luminance, of ITU-R BT.709."""

PITCH_RANGE_MRAD = (1e-6, 1e6)
"""Smallest and largest pixel pitch accepted; others are a mistake in the input and might overflow."""

LARGEST = 1e12
"""Largest length, angle, luminance or gain; beyond it, and below 1/LARGEST, a value is taken for a mistake."""

MAX_PIXELS = 1000
"""Largest width of a detector or a standard deviation of the blur, in display pixels."""

Luminance = Annotated[float, Meta(gt=0.0, le=LARGEST)]
Positive = Annotated[float, Meta(ge=1.0 / LARGEST, le=LARGEST)]
OptionalPositive = Positive | None
BlurPixels = Annotated[float, Meta(ge=0.0, le=MAX_PIXELS)]

PITCH_TOLERANCE = 1e-3
"""Largest relative difference between two pitches that count as equal when both are given."""


@dataclass(frozen=True, slots=True, eq=False)
class LuminanceTable:
    """The measured luminance in cd/m² of a display by code value, which rises within [0, 1]; interpolated
    linearly.
    """

    code_value: FloatArray
    luminance_cd_m2: FloatArray

    def __post_init__(self) -> None:
        code, luminance = self.code_value, self.luminance_cd_m2
        if code.size < 2 or not (np.diff(code) > 0.0).all():
            raise SettingsError("lut: expected two rows or more, whose code_value rises from row to row")
        if code[0] < 0.0 or code[-1] > 1.0:
            raise SettingsError(
                f"lut: code_value runs from {code[0]:g} to {code[-1]:g}, expected 0 to 1 "
                "(integers divided by full scale)"
            )
        if not (luminance.min() >= 0.0 and luminance.max() <= LARGEST):
            raise SettingsError(
                f"lut: luminance_cd_m2 runs from {luminance.min():g} to {luminance.max():g}, expected 0 to "
                f"{LARGEST:g}"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Display:
    """A display: its conversion of code values to luminance and its viewing geometry.

    Attributes
    ----------
    eotf : {"linear", "srgb", "bt1886", "gamma", "lut"}
        Electro-optical transfer function.
    white_luminance_cd_m2, black_luminance_cd_m2 : float
        Luminance of code values 1 and 0; not used with "lut", whose luminances are absolute.
    pixel_pitch_mrad : float or None
        Visual angle of one pixel; or `pixel_pitch_mm` and `viewing_distance_mm`.
    background_luminance_cd_m2 : float or {"surround", "border", "frame_mean", "column"}
        Luminance that contrast refers to: a smooth surface fitted around the triangle (recommended); a number; the
        mean over the outermost ring of pixels or over the whole frame; or the manifest's column of this name.
    gamma : float or None
        Exponent for "gamma".
    lut : LuminanceTable or None
        Table for "lut".
    gain : float or None
        Display contrast of a signal of 1, if code values are signals, as with the display in a SENSOR.toml: code
        value 0 has the background's luminance, and 1 exceeds it by the gain. It follows from black and white.

    Raises
    ------
    SettingsError
        If a value is out of range, missing, or contradicts another.

    Examples
    --------
    >>> import todframes as tod
    >>> display = tod.Display(
    ...     eotf="srgb",
    ...     white_luminance_cd_m2=120.0,
    ...     pixel_pitch_mm=0.25,
    ...     viewing_distance_mm=1000.0,
    ...     background_luminance_cd_m2="surround",
    ... )
    >>> round(display.pitch_mrad, 6)
    0.25
    """

    eotf: Eotf
    background_luminance_cd_m2: Annotated[float, Meta(gt=0.0)] | BackgroundRule
    white_luminance_cd_m2: Luminance = 1.0
    black_luminance_cd_m2: Annotated[float, Meta(ge=0.0)] = 0.0
    pixel_pitch_mrad: OptionalPositive = None
    pixel_pitch_mm: OptionalPositive = None
    viewing_distance_mm: OptionalPositive = None
    gamma: OptionalPositive = None
    lut: LuminanceTable | None = None
    gain: OptionalPositive = None

    def __post_init__(self) -> None:
        check_values(self)
        if not self.black_luminance_cd_m2 < self.white_luminance_cd_m2:
            raise SettingsError(
                f"black_luminance_cd_m2: found {self.black_luminance_cd_m2!r}, expected less than "
                f"white_luminance_cd_m2 ({self.white_luminance_cd_m2!r})"
            )
        for name in ("gamma", "lut"):
            if (self.eotf == name) != (getattr(self, name) is not None):
                wanted = "is missing" if self.eotf == name else "is given but not used"
                raise SettingsError(f'{name}: {wanted} with eotf = "{self.eotf}"')
        if self.gain is not None:
            of_gain = self.black_luminance_cd_m2 * (1.0 + self.gain)
            if self.eotf != "linear" or not math.isclose(of_gain, self.white_luminance_cd_m2, rel_tol=1e-6):
                raise SettingsError(
                    f'gain: found {self.gain!r}, expected it with eotf = "linear" and white_luminance_cd_m2 = '
                    f"black_luminance_cd_m2 · (1 + gain), {of_gain:g} here"
                )
        lengths = (self.pixel_pitch_mm, self.viewing_distance_mm)
        if lengths.count(None) == 1:
            raise SettingsError("pixel_pitch_mm and viewing_distance_mm: found one of them, expected both or none")
        if self.pixel_pitch_mrad is None and None in lengths:
            raise SettingsError(
                "pixel_pitch_mrad: is missing, expected it or both of pixel_pitch_mm and viewing_distance_mm"
            )
        if self.pixel_pitch_mm is not None and self.viewing_distance_mm is not None:
            other = pitch_mrad(self.pixel_pitch_mm, self.viewing_distance_mm)
            if not math.isclose(other, self.pitch_mrad, rel_tol=PITCH_TOLERANCE):
                raise SettingsError(
                    f"pixel_pitch_mrad: found {self.pixel_pitch_mrad:g}, but pixel_pitch_mm and "
                    f"viewing_distance_mm give {other:g}; expected one of the two or equal values"
                )
        low, high = PITCH_RANGE_MRAD
        if not low <= self.pitch_mrad <= high:
            name = "pixel_pitch_mm" if self.pixel_pitch_mrad is None else "pixel_pitch_mrad"
            raise SettingsError(f"{name}: found a pitch of {self.pitch_mrad:g} mrad, expected {low:g} to {high:g}")

    @property
    def pitch_mrad(self) -> float:
        """Visual angle of one pixel in mrad, as given or from pixel pitch and viewing distance."""
        if self.pixel_pitch_mrad is not None:
            return self.pixel_pitch_mrad
        assert self.pixel_pitch_mm is not None and self.viewing_distance_mm is not None  # are checked
        return pitch_mrad(self.pixel_pitch_mm, self.viewing_distance_mm)

    def luminance(self, code_value: NDArray[np.floating]) -> FloatArray:
        """Compute the luminance of code values.

        Parameters
        ----------
        code_value : ndarray, shape (rows, columns, channels)
            One channel, or red, green and blue. Integer code values are divided by their full scale.

        Returns
        -------
        ndarray, shape (rows, columns)
            Luminance in cd/m². Three channels are linearised, then weighted as in Rec. 709.

        Raises
        ------
        DataError
            If a code value lies outside the range of the transfer function.
        """
        light = self._light(code_value.astype(np.float64))
        if light.shape[-1] == 1:
            return light[..., 0]
        return np.asarray(light @ REC_709_LUMINANCE_WEIGHTS)

    def _light(self, code: FloatArray) -> FloatArray:
        white, black = self.white_luminance_cd_m2, self.black_luminance_cd_m2
        if self.eotf == "linear":
            return black + (white - black) * code
        low, high = 0.0, 1.0
        if self.lut is not None:
            low, high = float(self.lut.code_value[0]), float(self.lut.code_value[-1])
        if code.size and (code.min() < low or code.max() > high):
            raise DataError(
                f"code values run from {code.min():g} to {code.max():g}, "
                f'expected {low:g} to {high:g} with eotf = "{self.eotf}"'
            )
        if self.lut is not None:
            return np.interp(code, self.lut.code_value, self.lut.luminance_cd_m2)
        if self.eotf == "bt1886":
            white_root, black_root = white ** (1 / 2.4), black ** (1 / 2.4)
            return np.asarray((black_root + (white_root - black_root) * code) ** 2.4)  # ITU-R BT.1886, Annex 1
        linear = srgb_to_linear(code) if self.gamma is None else code**self.gamma
        return np.asarray(black + (white - black) * linear)


def pitch_mrad(pixel_pitch_mm: float, viewing_distance_mm: float) -> float:
    """Return the visual angle of a pixel."""
    return 2000.0 * math.atan(pixel_pitch_mm / 2.0 / viewing_distance_mm)


def srgb_to_linear(code_value: FloatArray) -> FloatArray:
    """Compute the relative luminance in [0, 1] of sRGB code values in [0, 1], of any shape (IEC 61966-2-1)."""
    return np.where(code_value <= 0.04045, code_value / 12.92, ((code_value + 0.055) / 1.055) ** 2.4)


def border_values(pixels: NDArray[Any], *, top: bool = True, bottom: bool = True) -> NDArray[Any]:
    """Return the pixels, (n,) or (n, channels), of a band of whole rows that lie on the border of the frame. `top`
    and `bottom` state whether the band's first row is the frame's first, and its last row the frame's last.
    """
    ends = pixels[:, [0, -1]] if pixels.shape[1] > 1 else pixels
    first = pixels[0] if top or (bottom and len(pixels) == 1) else ends[0]
    last = [pixels[-1] if bottom else ends[-1]] if len(pixels) > 1 else []
    return np.concatenate([first, ends[1:-1].reshape(-1, *pixels.shape[2:]), *last])


def weber_contrast(luminance: FloatArray, background_luminance_cd_m2: float) -> FloatArray:
    """Compute the signed contrast L / L_background − 1; DataError if the background is not a positive number."""
    check_background(background_luminance_cd_m2)
    return luminance / background_luminance_cd_m2 - 1.0


def check_background(luminance_cd_m2: float) -> None:
    """Raise DataError if the luminance of a background is not a positive number."""
    if not (math.isfinite(luminance_cd_m2) and luminance_cd_m2 > 0):
        raise DataError(f"background luminance is {luminance_cd_m2:g} cd/m², expected > 0")


@documented
@dataclass(frozen=True, slots=True, kw_only=True)
class SensorDisplay:
    """The display of a sensor's samples, and its viewing distance."""

    pixels_per_detector: Annotated[
        int, Meta(ge=1, le=MAX_PIXELS, description="Display pixels along each side of a displayed detector.")
    ]
    pixel_pitch_mm: Annotated[Positive, Meta(description="Distance from one display pixel to the next.")]
    viewing_distance_mm: Annotated[Positive, Meta(description="Distance from the eye to the display.")]
    background_luminance_cd_m2: Annotated[Positive, Meta(description="Luminance where there is no signal.")]
    blur_sigma_px: Annotated[BlurPixels, Meta(description="Gaussian spot of the display in its pixels.")] = 0.0
    gain: Annotated[Positive, Meta(description="Display contrast per unit of signal.")] = 1.0

    def __post_init__(self) -> None:
        check_values(self)

    @property
    def pixel_pitch_mrad(self) -> float:
        """Visual angle of one display pixel."""
        return pitch_mrad(self.pixel_pitch_mm, self.viewing_distance_mm)

    @property
    def detector_pitch_mrad(self) -> float:
        """Visual angle of one detector as displayed."""
        return self.pixels_per_detector * self.pixel_pitch_mrad


@dataclass(frozen=True, slots=True, kw_only=True)
class SignalDisplay:
    """The display in a SENSOR.toml, for frames whose values are signals.

    `is_contrast` states whether a signal of 1 is the contrast 1, as for a camera that counts photons; otherwise it
    is the signal of the triangle, whatever its strength. `netd_mk` is then the noise of a frame as a temperature
    difference, None if it is not known. `blur_sigma_px` is the blur of electronics and display together.
    """

    of_sensor: SensorDisplay
    is_contrast: bool
    netd_mk: float | None
    blur_sigma_px: float

    @classmethod
    def of(cls, content: Mapping[str, Any], where: str) -> SignalDisplay:
        """Return the display in the content of a SENSOR.toml. SettingsError, which begins with `where`, if its
        table [display] is missing, or has a key or value that is refused.
        """
        noise, electronics = (
            convert(content.get(name, {}), dict[str, Any], f"{where}: {name}") for name in ("noise", "electronics")
        )
        if "display" not in content:
            raise SettingsError(f"{where}: table [display] is missing")
        of_sensor = from_table(content["display"], SensorDisplay, f"{where}: [display]")
        blur = convert(electronics.get("blur_sigma_px", 0.0), BlurPixels, f"{where}: blur_sigma_px")
        return cls(
            of_sensor=of_sensor,
            is_contrast=noise.get("model") == "photon",
            netd_mk=convert(noise.get("netd_mk"), OptionalPositive, f"{where}: [noise]: netd_mk"),
            blur_sigma_px=math.hypot(of_sensor.blur_sigma_px, blur),
        )

    @property
    def display(self) -> Display:
        """The display of signals: 0 has the luminance of the background, and 1 exceeds it by the gain."""
        shown = self.of_sensor
        background = shown.background_luminance_cd_m2
        return Display(
            eotf="linear",
            white_luminance_cd_m2=background * (1.0 + shown.gain),
            black_luminance_cd_m2=background,
            pixel_pitch_mm=shown.pixel_pitch_mm,
            viewing_distance_mm=shown.viewing_distance_mm,
            # Noise may darken a place as much as black; light that falls off towards the corners is none of it.
            background_luminance_cd_m2="surround" if self.is_contrast else background,
            gain=shown.gain,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class DisplayDescription:
    """A display with its name and the source of its numbers. `of_signals` is what a SENSOR.toml says besides."""

    display: Display
    title: str = ""
    source: str = ""
    of_signals: SignalDisplay | None = None


def find_display(
    asked: Display | Path | str, *, where: str = "display", folder: Path | None = None
) -> DisplayDescription:
    """Return the display given, that of this package with a name, or that of a file that ends with ".toml", which
    is relative to `folder`, that of a dataset, and may not leave it. SettingsError, which begins with `where`, if
    there is none, or its file cannot be read or has a wrong value.
    """
    if isinstance(asked, Display):
        return DisplayDescription(display=asked)
    if folder is None or not str(asked).endswith(SETTINGS_SUFFIX):
        return read_display(settings_path(asked, FOLDER, where))
    try:
        path_inside(os.path.realpath(folder), str(asked), f"{where}:")
    except DataError as error:
        raise SettingsError(str(error)) from None
    return read_display(folder / asked)


def read_display(path: Path) -> DisplayDescription:
    """Return the display that a TOML file describes, a display's or a SENSOR.toml; the path of its LUT is relative
    to the file's folder. SettingsError if the file cannot be read or has a wrong value.
    """
    content = read_toml(path)
    if SENSOR_TABLES & content.keys():
        of_signals = SignalDisplay.of(content, str(path))
        title = f"that of the sensor {content.get('name', '')}".rstrip()
        return DisplayDescription(display=of_signals.display, title=title, of_signals=of_signals)
    table, texts = read_described(path, "display", SCHEMA)
    table = {"background_luminance_cd_m2": "surround"} | table
    display = display_of_table(table, f"{path}: [display]", path.parent)
    return DisplayDescription(display=display, title=texts["title"], source=texts["source"])


def display_of_table(table: Mapping[str, Any], where: str, folder: Path) -> Display:
    """Return the display that a table [display] describes. The path of a LUT is relative to `folder` and may not
    leave it. SettingsError, which begins with `where`, if a key is unknown or missing, a value is refused, or the
    LUT cannot be read.
    """
    check_keys(table, [field.name for field in fields(Display)], where)
    table, eotf = dict(table), table.get("eotf")
    if eotf == "lut":  # luminances of a table are absolute
        table.pop("white_luminance_cd_m2", None)
        table.pop("black_luminance_cd_m2", None)
    elif "white_luminance_cd_m2" not in table:
        raise SettingsError(f"{where}: white_luminance_cd_m2 is missing")
    if "lut" in table:
        if eotf != "lut":
            raise SettingsError(f"{where}: lut: is given but not used with eotf = {eotf!r}")
        table["lut"] = _read_lut(folder, table["lut"], f"{where}: lut")
    return from_table(table, Display, where)


def table_of_display(display: Display, folder: Path) -> dict[str, object]:
    """Return a display as the table [display] of a dataset; write its LUT, if it has one, into the folder."""
    values: dict[str, object] = {field.name: getattr(display, field.name) for field in fields(display)}
    if display.lut is not None:
        columns = display.lut.code_value.tolist(), display.lut.luminance_cd_m2.tolist()
        text = csv_text([("code_value", "luminance_cd_m2"), *zip(*columns, strict=True)])
        (folder / LUT_FILE).write_text(text, encoding="utf-8")
        values |= {"white_luminance_cd_m2": None, "black_luminance_cd_m2": None, "lut": LUT_FILE}
    return values


def _read_lut(folder: Path, name: object, where: str) -> LuminanceTable:
    with table_beside(name, folder, where) as path:
        values = read_numbers(path, ("code_value", "luminance_cd_m2"))
    code, luminance = np.array(values, dtype=np.float64).reshape(-1, 2).T
    try:
        return LuminanceTable(code, luminance)
    except SettingsError as error:
        raise SettingsError(f"{path}: {error}") from None


TILE = 64
"""Side of the pattern of thresholds in pixels; it repeats beyond."""

SAME_LUMINANCE = 1e-9
"""Relative difference to a code's luminance below which the two count as equal."""

TILE_SIGMA = 1.5
"""Standard deviation of the repulsion between pixels of the pattern, in pixels (Ulichney 1993)."""


@cache
def blue_noise() -> FloatArray:
    """Return thresholds in (0, 1), each once, shape (64, 64), whose lowest ones are spread evenly for any number.
    Each next threshold goes where the repulsion of all lower ones is least (void and cluster, Ulichney 1993), so
    the pattern has no coarse grain and no lines that could give moiré with a camera's pixels. Opposite edges fit
    together.
    """
    distance = np.minimum(np.arange(TILE), TILE - np.arange(TILE))
    bell = np.exp(-(distance**2) / (2.0 * TILE_SIGMA**2))
    repulsion = np.outer(bell, bell)
    # The first pixels have many equally good places; the noise decides among these alone.
    energy = 1e-6 * np.random.default_rng(0).random((TILE, TILE))
    thresholds = np.empty((TILE, TILE))
    for rank in range(TILE**2):
        row, column = divmod(int(np.argmin(energy)), TILE)
        thresholds[row, column] = (rank + 0.5) / TILE**2
        energy += np.roll(repulsion, (row, column), (0, 1))
        energy[row, column] = np.inf
    thresholds.flags.writeable = False
    return thresholds


def dithered(luminance: FloatArray, luminance_of_code: FloatArray) -> NDArray[np.uint16]:
    """Return code values whose luminances have the required sum, as exactly as code values allow: (rows, columns).
    `luminance_of_code` rises strictly, and `luminance` is within its range. Each pixel has one of the two code
    values on either side of its luminance, and that of its luminance if there is one. The sum over all pixels is
    off by at most half of a code step of one pixel.
    """
    index = np.searchsorted(luminance_of_code, luminance * (1.0 + SAME_LUMINANCE), side="right") - 1
    below = np.clip(index, 0, luminance_of_code.size - 2)
    step = luminance_of_code[below + 1] - luminance_of_code[below]
    share = (luminance - luminance_of_code[below]) / step
    rows, columns = luminance.shape
    tiles = np.tile(blue_noise(), (-(-rows // TILE), -(-columns // TILE)))[:rows, :columns]
    # A plain comparison, share > threshold, has the sum only on average; the first pixels by this order have it.
    between = np.flatnonzero(share > SAME_LUMINANCE)
    order = between[np.argsort((tiles - share).ravel()[between], kind="stable")]
    added = np.concatenate([[0.0], np.cumsum(step.ravel()[order])])
    n_raised = int(np.argmin(np.abs(added - np.sum(share * step))))
    code = below.astype(np.uint16)
    code.ravel()[order[:n_raised]] += 1
    return code
