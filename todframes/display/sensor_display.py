"""The display in a SENSOR.toml: how large the samples of a camera are shown, how bright, and with which gain."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from msgspec import Meta

from todframes.base.errors import SettingsError
from todframes.base.reading import check_values, convert, documented, from_table
from todframes.display.display import Display, pitch_mrad

LARGEST = 1e12
"""Largest length, angle, luminance or gain; beyond it, and below 1/LARGEST, a value is taken for a mistake."""

MAX_PIXELS = 1000
"""Largest width of a detector or a standard deviation of the blur, in display pixels."""

Positive = Annotated[float, Meta(ge=1.0 / LARGEST, le=LARGEST)]
OptionalPositive = Annotated[float, Meta(ge=1.0 / LARGEST, le=LARGEST)] | None
BlurPixels = Annotated[float, Meta(ge=0.0, le=MAX_PIXELS)]


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


def read_signal_display(content: Mapping[str, Any], where: str) -> SignalDisplay:
    """Return the display in the content of a SENSOR.toml. SettingsError, which begins with `where`, if its table
    [display] is missing, or has a key or value that is refused.
    """
    tables = {
        name: convert(content.get(name, {}), dict[str, Any], f"{where}: {name}")
        for name in ("display", "noise", "electronics")
    }
    if not tables["display"]:
        raise SettingsError(f"{where}: table [display] is missing")
    of_sensor = from_table(tables["display"], SensorDisplay, f"{where}: [display]")
    noise = tables["noise"]
    blur = convert(tables["electronics"].get("blur_sigma_px", 0.0), BlurPixels, f"{where}: blur_sigma_px")
    return SignalDisplay(
        of_sensor=of_sensor,
        is_contrast=noise.get("model") == "photon",
        netd_mk=convert(noise.get("netd_mk"), OptionalPositive, f"{where}: [noise]: netd_mk"),
        blur_sigma_px=math.hypot(of_sensor.blur_sigma_px, blur),
    )
