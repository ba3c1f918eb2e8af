"""Displays: the conversion of code values to luminance and contrast, and the viewing geometry."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import check_values

INTEGRATION_TIME_S = 0.1
"""Time in which the eye integrates what a display shows. Hogervorst et al. 2001, section 4."""

Eotf = Literal["linear", "srgb", "bt1886", "gamma", "lut"]

BackgroundRule = Literal["surround", "border", "frame_mean", "column"]

REC_709_LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear red, green and blue in the luminance, of ITU-R BT.709."""

LARGEST_LUMINANCE_CD_M2 = 1e12
"""Largest luminance accepted, a thousand times that of the sun; a larger one is a mistake in the input."""

PITCH_RANGE_MRAD = (1e-6, 1e6)
"""Smallest and largest pixel pitch accepted; others are a mistake in the input and might overflow."""

Luminance = Annotated[float, Meta(gt=0.0, le=LARGEST_LUMINANCE_CD_M2)]

OptionalPositive = Annotated[float, Meta(gt=0.0)] | None

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
        if code.size < 2:
            raise SettingsError(f"lut: found {code.size} rows, expected at least 2")
        if not (np.isfinite(code).all() and np.isfinite(luminance).all()):
            raise SettingsError("lut: found a value that is not finite")
        if code.min() < 0.0 or code.max() > 1.0:
            raise SettingsError(
                f"lut: code_value runs from {code.min():g} to {code.max():g}, expected 0 to 1 "
                "(integers divided by full scale)"
            )
        if (np.diff(code) <= 0).any():
            raise SettingsError("lut: code_value does not rise from row to row")
        if luminance.min() < 0.0:
            raise SettingsError(f"lut: found luminance_cd_m2 {luminance.min():g}, expected >= 0")
        if luminance.max() > LARGEST_LUMINANCE_CD_M2:
            most = f"at most {LARGEST_LUMINANCE_CD_M2:g}"
            raise SettingsError(f"lut: found luminance_cd_m2 {luminance.max():g}, expected {most}")


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
        self._check_geometry()

    def _check_geometry(self) -> None:
        lengths = (self.pixel_pitch_mm, self.viewing_distance_mm)
        if self.pixel_pitch_mrad is None and None in lengths:
            raise SettingsError(
                "pixel_pitch_mrad: is missing, expected it or both of pixel_pitch_mm and viewing_distance_mm"
            )
        if lengths.count(None) == 1:
            raise SettingsError("pixel_pitch_mm and viewing_distance_mm: found one of them, expected both or none")
        if self.pixel_pitch_mrad is not None and None not in lengths:
            other = self._pitch_from_lengths()
            if abs(other - self.pixel_pitch_mrad) > PITCH_TOLERANCE * self.pixel_pitch_mrad:
                raise SettingsError(
                    f"pixel_pitch_mrad: found {self.pixel_pitch_mrad:g}, but pixel_pitch_mm and "
                    f"viewing_distance_mm give {other:g}; expected one of the two or equal values"
                )
        low, high = PITCH_RANGE_MRAD
        if not low <= self.pitch_mrad <= high:
            name = "pixel_pitch_mm" if self.pixel_pitch_mrad is None else "pixel_pitch_mrad"
            raise SettingsError(f"{name}: found a pitch of {self.pitch_mrad:g} mrad, expected {low:g} to {high:g}")

    def _pitch_from_lengths(self) -> float:
        assert self.pixel_pitch_mm is not None and self.viewing_distance_mm is not None
        return pitch_mrad(self.pixel_pitch_mm, self.viewing_distance_mm)

    @property
    def pitch_mrad(self) -> float:
        """Visual angle of one pixel in mrad, as given or from pixel pitch and viewing distance."""
        return self.pixel_pitch_mrad if self.pixel_pitch_mrad is not None else self._pitch_from_lengths()

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
            return bt1886_luminance(code, white_luminance_cd_m2=white, black_luminance_cd_m2=black)
        linear = srgb_to_linear(code) if self.gamma is None else code**self.gamma
        return np.asarray(black + (white - black) * linear)


def pitch_mrad(pixel_pitch_mm: float, viewing_distance_mm: float) -> float:
    """Return the visual angle of a pixel."""
    return 2000.0 * math.atan(pixel_pitch_mm / 2.0 / viewing_distance_mm)


def srgb_to_linear(code_value: FloatArray) -> FloatArray:
    """Compute the relative luminance in [0, 1] of sRGB code values in [0, 1], of any shape (IEC 61966-2-1)."""
    return np.where(code_value <= 0.04045, code_value / 12.92, ((code_value + 0.055) / 1.055) ** 2.4)


def bt1886_luminance(
    code_value: FloatArray, *, white_luminance_cd_m2: float, black_luminance_cd_m2: float
) -> FloatArray:
    """Compute the luminance in cd/m² of code values in [0, 1], of any shape, by ITU-R BT.1886, Annex 1."""
    white_root, black_root = white_luminance_cd_m2 ** (1 / 2.4), black_luminance_cd_m2 ** (1 / 2.4)
    return np.asarray((black_root + (white_root - black_root) * code_value) ** 2.4)


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
