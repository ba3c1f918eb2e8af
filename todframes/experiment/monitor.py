"""Monitors that show trials to people: the luminance of their codes, and the visual angle of a pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from todframes._typing import FloatArray
from todframes.errors import SettingsError

N_CODES = 256
"""Number of code values of a monitor: 8 bits a channel."""


READING_EXPONENT = 2.2
"""Exponent of the scale in which luminance is interpolated between readings: there it is almost straight."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Monitor:
    """A monitor as a person sat at it; the sidecar of the answers holds it.

    Attributes
    ----------
    pixel_pitch_mm, viewing_distance_mm : float
        Distance of neighbouring pixels, and of the eye from the screen.
    pixel_pitch_mrad : float
        Visual angle of one pixel at the eye.
    background_code : int
        Code value of the background: that of the page, and of contrast 0.
    background_relative, black_relative : float
        Luminance of the background and of code 0 over that of white.
    background_luminance_cd_m2 : float or None
        Luminance of the background; None if no photometer was read.
    gamma : float or None
        Exponent from the half-tone match; None with `lut`.
    lut : tuple of (float, float), or None
        Readings of a photometer: code value, 0 to 255, and luminance in cd/m².
    bits : int
        Number of bits of a code value.
    dither : bool
        Whether luminances between two codes are shown by pixels of both.
    device_pixel_ratio : float
        Device pixels per pixel of the page, as the browser said.
    screen_px, viewport_px : (int, int)
        Width and height of the screen and of the page, in device pixels.

    Raises
    ------
    SettingsError
        If a value contradicts another or is out of range.
    """

    pixel_pitch_mm: float
    viewing_distance_mm: float
    pixel_pitch_mrad: float
    background_code: int
    background_relative: float
    background_luminance_cd_m2: float | None = None
    gamma: float | None = None
    lut: tuple[tuple[float, float], ...] | None = None
    black_relative: float = 0.0
    bits: int = 8
    dither: bool = True
    device_pixel_ratio: float = 1.0
    screen_px: tuple[int, int] = (0, 0)
    viewport_px: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        for name in ("pixel_pitch_mm", "viewing_distance_mm", "pixel_pitch_mrad"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise SettingsError(f"{name}: found {value!r}, expected a finite number > 0")
        if self.bits != 8:
            raise SettingsError(f"bits: found {self.bits!r}, expected 8")
        if not 0 < self.background_code < N_CODES:
            raise SettingsError(f"background_code: found {self.background_code!r}, expected 1 to {N_CODES - 1}")
        # The luminance of the code is what counts; 1e-6 is what a file written with fewer digits may differ by.
        found = float(self.luminance_of_code()[self.background_code])
        if not math.isclose(found, self.background_relative, rel_tol=1e-6):
            raise SettingsError(
                f"background_relative: found {self.background_relative!r}, expected {found!r}, the luminance of "
                f"background_code {self.background_code}"
            )

    def luminance_of_code(self) -> FloatArray:
        """Return the luminance of the code values 0 to 255 over that of white, rising: shape (256,).

        Raises
        ------
        SettingsError
            If neither or both of `gamma` and `lut` are given, or they do not describe a monitor.
        """
        if self.lut is not None and self.gamma is None:
            return luminance_of_readings(self.lut)
        if self.gamma is not None and self.lut is None:
            return luminance_of_gamma(self.gamma)
        raise SettingsError("gamma, lut: found both or none of them, expected one")

    def contrast_of_code(self) -> FloatArray:
        """Return the Weber contrast of the code values 0 to 255 against the background, rising: shape (256,)."""
        luminance = self.luminance_of_code()
        return np.asarray(luminance / luminance[self.background_code] - 1.0)


def luminance_of_gamma(gamma: float) -> FloatArray:
    """Return (code / 255)^gamma for the code values 0 to 255.

    Raises
    ------
    SettingsError
        If the exponent is not that of a monitor.
    """
    if not 1.0 <= gamma <= 4.0:
        raise SettingsError(f"gamma: found {gamma!r}, expected 1 to 4; match the half-tone again")
    return np.asarray((np.arange(N_CODES) / (N_CODES - 1)) ** gamma)


def luminance_of_readings(lut: tuple[tuple[float, float], ...]) -> FloatArray:
    """Return the luminance of the code values 0 to 255 over that of white, from readings of a photometer.

    Between readings, luminance^(1/2.2) is interpolated linearly; readings are met exactly.

    Raises
    ------
    SettingsError
        If the readings do not begin at code 0 and end at 255, are fewer than 4, or do not rise.
    """
    codes, luminance_cd_m2 = np.array(sorted(lut), np.float64).reshape(-1, 2).T
    if codes.size < 4 or codes[0] != 0 or codes[-1] != N_CODES - 1:
        raise SettingsError(
            f"lut: found {codes.size} readings of the codes {', '.join(f'{code:g}' for code in codes[:4])} …, "
            f"expected at least 4, with those of 0 and {N_CODES - 1}"
        )
    if not np.isfinite(luminance_cd_m2).all() or luminance_cd_m2[0] < 0:
        raise SettingsError("lut: found a luminance that is negative or no number, expected cd/m² >= 0")
    rise = (np.diff(codes) > 0) & (np.diff(luminance_cd_m2) > 0)
    if not rise.all():
        at = int(np.argmin(rise))
        raise SettingsError(
            f"lut: found {luminance_cd_m2[at + 1]:g} cd/m² at code {codes[at + 1]:g} after "
            f"{luminance_cd_m2[at]:g} cd/m² at code {codes[at]:g}, expected luminance to rise with the code; read "
            "these codes again"
        )
    root = np.interp(np.arange(N_CODES), codes, luminance_cd_m2 ** (1.0 / READING_EXPONENT))
    return np.asarray((root / root[-1]) ** READING_EXPONENT)
