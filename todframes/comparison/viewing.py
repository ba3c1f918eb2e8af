"""The viewing of frames behind thresholds: their display, and the frames that the eye averages."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from todframes.base.reading import from_table
from todframes.display.display import SensorDisplay
from todframes.results.data import Record
from todframes.results.wording import count, plain

SAME_ANGLE = 0.01
"""Relative difference of two angles that count as equal; it changes a threshold by as much at most."""


class Viewing(NamedTuple):
    """The display of a condition, in words, the visual angles of a pixel of it and of a value of the camera, and
    the number of frames that the eye averages. None: not known. `is_computed`: no frame is behind it.
    `magnification` is the visual angle of what is an angle of 1 at the camera.
    """

    display: str | None = None
    pixel_mrad: float | None = None
    value_mrad: float | None = None
    n_frames: int | None = None
    is_computed: bool = False
    magnification: float | None = None

    @classmethod
    def of_sensor(cls, sensor: Record) -> Viewing:
        """Return the viewing behind the curve of a sensor, from the tables of its SENSOR.toml."""
        display = from_table(sensor["display"], SensorDisplay, "display")
        n_frames = sensor.get("noise", {}).get("frames_integrated", 1)
        angles = display.pixel_pitch_mrad, display.detector_pitch_mrad
        return cls(_gain(display.gain), *angles, n_frames, is_computed=True)

    @classmethod
    def of_frames(cls, display: Record, level: str, frames_per_trial: float, *, is_film: bool) -> Viewing:
        """Return the viewing of a dataset, from its table [display]. Frames that `sensor-sim simulate` has drawn,
        and others that are no film, have the display's gain in their values, and a frame may be a mean of several.
        """
        pitch = display["pixel_pitch_mrad"]
        if not is_film:
            return cls(pixel_mrad=pitch)
        gain, eotf, black = display.get("gain"), display["eotf"], display.get("black_luminance_cd_m2", 0.0)
        if gain is None and level == "contrast" and (eotf, black) == ("linear", 0.0):
            gain = 1.0
        if gain is None:
            of_white = plain(100.0 * black / display.get("white_luminance_cd_m2", 1.0), 2)
            shown = "a measured display" if eotf == "lut" else f"{eotf} with black at {of_white} % of white"
        else:
            shown = _gain(gain)
        is_of_signals = display.get("gain") is not None
        return cls(shown, pitch, None if is_of_signals else pitch, round(frames_per_trial))

    def differences(self, other: Viewing) -> list[str]:
        """Return what differs from another, in phrases with both values, this one's first."""
        texts = []
        if None not in (self.display, other.display) and self.display != other.display:
            texts.append(f"{self.display} against {other.display}")
        name = "value_mrad" if None not in (self.value_mrad, other.value_mrad) else "pixel_mrad"
        angle, of_other = getattr(self, name), getattr(other, name)
        if None not in (angle, of_other) and abs(angle / of_other - 1.0) > SAME_ANGLE:
            texts.append(f"a pixel of {plain(angle)} against {plain(of_other)} mrad at the eye")
        is_beside_curve = self.is_computed != other.is_computed
        if is_beside_curve and None not in (self.n_frames, other.n_frames) and self.n_frames != other.n_frames:
            texts.append(f"{count(self.n_frames or 0, 'frame')} averaged by the eye against {other.n_frames}")
        return texts


NOT_KNOWN = Viewing()


def differences(viewings: Sequence[tuple[str, Viewing]]) -> list[str]:
    """Return a sentence for each condition that is not shown as the first, by names, with both values."""
    (reference, first), *others = viewings
    texts = []
    for name, viewing in others:
        if parts := viewing.differences(first):
            text = f"{name} is not shown as {reference}, which is part of the ratio: {'; '.join(parts)}"
            if viewing.is_computed != first.is_computed:
                text += ". `todframes import --display SENSOR.toml` shows a film as the curve of that sensor is"
            texts.append(text + ".")
    return texts


def _gain(gain: float) -> str:
    return f"a gain of {gain:g}"
