"""Monitors that show trials to people: the luminance of their codes, and the visual angle of a pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import numpy as np
from msgspec import Meta

from todframes.base._typing import FloatArray
from todframes.base.errors import SettingsError
from todframes.base.reading import Positive, check_values

N_CODES = 256
"""Number of code values of a monitor: 8 bits a channel."""

READING_EXPONENT = 2.2
"""Exponent of the scale in which luminance is interpolated between readings: there it is almost straight."""

LARGEST_CD_M2, SMALLEST_RISE_CD_M2 = 1e5, 1e-6
"""Largest luminance of a monitor, and smallest difference of two readings that a photometer resolves."""

PITCH_RATIOS = (0.5, 2.0)
"""Range of the visual angle of a pixel over that of the dataset's display; beyond it the test would not be the
same."""

RANGES = {"pixel_pitch_mm": (0.02, 2.0), "viewing_distance_mm": (50.0, 50_000.0)}
"""Pixel pitches of real monitors, and viewing distances of people; other values are mistakes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration:
    """Measures of a monitor, as a person made them at the page. All pixels are those of the device. Readings of a
    photometer, pairs of code value and luminance in cd/m², count if they are given; else the exponent `gamma`.
    `device_pixel_ratio` is in device pixels per pixel of the page.
    """

    device_pixel_ratio: float
    pixel_pitch_mm: float
    viewing_distance_mm: float
    gamma: float | None = None
    photometer: tuple[tuple[float, float], ...] | None = None
    screen_px: tuple[int, int]
    viewport_px: tuple[int, int]


class ContrastRange(NamedTuple):
    """The contrasts of a trial: of its triangle's area, and those between which 99 % of its pixels lie."""

    frame: str
    low: float
    high: float
    triangle_low: float
    triangle_high: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Monitor:
    """A monitor with the distance of the person; the sidecar of the answers holds it. `background_code` is the
    code value of the page, and of contrast 0. Its luminance and that of code 0 are over that of white, and
    `background_luminance_cd_m2` is None if no photometer was read. `gamma` is the exponent from the half-tone
    match; `lut` has the readings of a photometer in place of it: code value, 0 to 255, and luminance in cd/m².
    With `dither`, luminances between two codes are shown by pixels of both. Sizes of screen and page are in device
    pixels.
    """

    pixel_pitch_mm: Positive
    viewing_distance_mm: Positive
    pixel_pitch_mrad: Positive
    background_code: Annotated[int, Meta(ge=1, le=N_CODES - 1)]
    background_relative: float
    background_luminance_cd_m2: float | None = None
    gamma: float | None = None
    lut: tuple[tuple[float, float], ...] | None = None
    black_relative: float = 0.0
    bits: Literal[8] = 8
    dither: bool = True
    device_pixel_ratio: float = 1.0
    screen_px: tuple[int, int] = (0, 0)
    viewport_px: tuple[int, int] = (0, 0)

    def __post_init__(self) -> None:
        check_values(self)
        # The luminance of the code is what counts; 1e-6 is what a file written with fewer digits may differ by.
        found = float(self.luminance_of_code()[self.background_code])
        if not math.isclose(found, self.background_relative, rel_tol=1e-6):
            raise SettingsError(
                f"background_relative: found {self.background_relative!r}, expected {found!r}, the luminance of "
                f"background_code {self.background_code}"
            )

    def luminance_of_code(self) -> FloatArray:
        """Return the luminance of the code values 0 to 255 over that of white, rising: shape (256,). Raises
        SettingsError if neither or both of `gamma` and `lut` are given, or they do not describe a monitor.
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

    def contrast_limits(self) -> tuple[float, float]:
        """Return the contrasts half of a code step beyond black and white; those between can be shown."""
        of_code = self.contrast_of_code()
        return float(1.5 * of_code[0] - 0.5 * of_code[1]), float(1.5 * of_code[-1] - 0.5 * of_code[-2])


def luminance_of_gamma(gamma: float) -> FloatArray:
    """Return (code / 255)^gamma for the code values 0 to 255. Raises SettingsError if the exponent is not that of
    a monitor.
    """
    if not 1.0 <= gamma <= 4.0:
        raise SettingsError(f"gamma: found {gamma!r}, expected 1 to 4; match the half-tone again")
    return np.asarray((np.arange(N_CODES) / (N_CODES - 1)) ** gamma)


def luminance_of_readings(lut: tuple[tuple[float, float], ...]) -> FloatArray:
    """Return the luminance of the code values 0 to 255 over that of white, from readings of a photometer. Between
    readings, luminance^(1/2.2) is interpolated linearly; readings are met exactly. Raises SettingsError if the
    readings do not begin at code 0 and end at 255, are fewer than 4, or do not rise.
    """
    codes, luminance_cd_m2 = np.array(sorted(lut), np.float64).reshape(-1, 2).T
    if codes.size < 4 or codes[0] != 0 or codes[-1] != N_CODES - 1:
        raise SettingsError(
            f"lut: found {codes.size} readings of the codes {', '.join(f'{code:g}' for code in codes[:4])} …, "
            f"expected at least 4, with those of 0 and {N_CODES - 1}"
        )
    if not ((luminance_cd_m2 >= 0) & (luminance_cd_m2 <= LARGEST_CD_M2)).all():
        raise SettingsError(f"lut: found a luminance beyond 0 to {LARGEST_CD_M2:g} cd/m²; read it again")
    rise = (np.diff(codes) > 0) & (np.diff(luminance_cd_m2) > SMALLEST_RISE_CD_M2)
    if not rise.all():
        at = int(np.argmin(rise))
        raise SettingsError(
            f"lut: found {luminance_cd_m2[at + 1]:g} cd/m² at code {codes[at + 1]:g} after "
            f"{luminance_cd_m2[at]:g} cd/m² at code {codes[at]:g}, expected luminance to rise with the code; read "
            "these codes again"
        )
    root = np.interp(np.arange(N_CODES), codes, luminance_cd_m2 ** (1.0 / READING_EXPONENT))
    return np.asarray((root / root[-1]) ** READING_EXPONENT)


def viewing_distance_mm(*, pixel_pitch_mm: float, pixel_pitch_mrad: float) -> float:
    """Return the distance from which a pixel has a visual angle; 2 atan(pitch / 2 distance)."""
    return pixel_pitch_mm / (2.0 * math.tan(pixel_pitch_mrad / 2000.0))


def calibrated(calibration: Calibration, *, background: float, dither: bool) -> Monitor:
    """Make the monitor of a person's measures. `background` is the largest luminance of the background over that
    of white: it becomes that of the next code below. Raises SettingsError if the browser resamples what it shows,
    because pixels of the page are not whole device pixels, or a measure is missing or cannot be right.
    """
    if calibration.device_pixel_ratio not in (1.0, 2.0, 3.0, 4.0):
        raise SettingsError(
            f"a pixel of the page is {calibration.device_pixel_ratio:.4g} pixels of the monitor, so the browser "
            "would resample the frames; set the zoom of the page to 100 % (Ctrl and 0), and the scale of the "
            "display to a whole number",
        )
    pitch, readings = calibration.pixel_pitch_mm, calibration.photometer
    for name, (low, high) in RANGES.items():
        if not low <= (value := getattr(calibration, name)) <= high:
            raise SettingsError(f"{name}: found {value:.4g} mm, expected {low:g} to {high:g} mm; measure again")
    gamma = None if readings else calibration.gamma
    if readings:
        luminance = luminance_of_readings(readings)
    elif gamma is not None:
        luminance = luminance_of_gamma(gamma)
    else:
        raise SettingsError("gamma, photometer: found none of them, expected one")
    background_code = int(np.searchsorted(luminance, background * (1.0 + 1e-9), side="right")) - 1
    if not 0 < background_code < N_CODES - 1:
        raise SettingsError(
            f"the background of {background:g} × white is not between the monitor's black ({luminance[0]:.2g} × "
            "white) and white; take another background",
        )
    relative = float(luminance[background_code])
    white_cd_m2 = max(cd_m2 for _, cd_m2 in readings) if readings else None
    return Monitor(
        pixel_pitch_mm=pitch,
        viewing_distance_mm=calibration.viewing_distance_mm,
        pixel_pitch_mrad=2000.0 * math.atan(pitch / calibration.viewing_distance_mm / 2.0),  # seen straight on
        background_code=background_code,
        background_relative=relative,
        background_luminance_cd_m2=None if white_cd_m2 is None else relative * white_cd_m2,
        gamma=gamma,
        lut=tuple(sorted(readings)) if readings else None,
        black_relative=float(luminance[0]),
        dither=dither,
        device_pixel_ratio=calibration.device_pixel_ratio,
        screen_px=calibration.screen_px,
        viewport_px=calibration.viewport_px,
    )


def check_shows(
    monitor: Monitor, *, frame_px: tuple[int, int], pixel_pitch_mrad: float, ranges: list[ContrastRange]
) -> None:
    """Raise SettingsError if a monitor cannot show trials: if the page has no room for `frame_px`, the largest
    width and height of a frame; if pixels are much larger or smaller at the eye than those of the dataset's
    display; or if a contrast of a triangle, or more than 1 % of the pixels of a trial, is beyond the monitor's
    range. `ranges` has the contrasts of each trial.
    """
    if any(frame > page for frame, page in zip(frame_px, monitor.viewport_px, strict=True)):
        raise SettingsError(
            "a frame has {} × {} pixels, the page has room for {} × {}; show the page on the full screen (F11), "
            "or take a larger monitor".format(*frame_px, *monitor.viewport_px),
        )
    ratio = monitor.pixel_pitch_mrad / pixel_pitch_mrad
    if not PITCH_RATIOS[0] <= ratio <= PITCH_RATIOS[1]:
        distance = viewing_distance_mm(pixel_pitch_mm=monitor.pixel_pitch_mm, pixel_pitch_mrad=pixel_pitch_mrad)
        raise SettingsError(
            f"a pixel has {monitor.pixel_pitch_mrad:.4g} mrad at the eye, {ratio:.3g} times that of the dataset "
            f"({pixel_pitch_mrad:.4g} mrad), expected {PITCH_RATIOS[0]:g} to {PITCH_RATIOS[1]:g} times; sit "
            f"{distance:.0f} mm from the screen",
        )
    of_code, (black, white) = monitor.contrast_of_code(), monitor.contrast_limits()
    for trial in ranges:
        low, high = min(trial.low, trial.triangle_low), max(trial.high, trial.triangle_high)
        shown = f"it shows {of_code[0]:.3g} to {of_code[-1]:.3g}"
        if low < black:
            raise SettingsError(
                f"the monitor cannot show the contrast {low:.3g} of {trial.frame}: {shown}; take frames with less "
                "contrast or noise",
            )
        if high > white:
            proposed = 0.99 / (1.0 + high)  # two digits, less 1 % for the step of the background
            digit = 10.0 ** (math.floor(math.log10(proposed)) - 1)
            raise SettingsError(
                f"the monitor cannot show the contrast {high:.3g} of {trial.frame}: {shown} on this background; "
                f"take a background of {math.floor(proposed / digit) * digit:.2g}",
            )
        step = of_code[monitor.background_code + 1] / 2.0
        if not monitor.dither and max(-low, high) < step:
            raise SettingsError(
                f"the contrast {max(-low, high):.2g} of {trial.frame} is below half of a code step, {step:.2g}: "
                "it would not be seen at all without dither",
            )
