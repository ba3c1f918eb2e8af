"""The scale on which a display of signals shows recordings: the values of no signal, and of a signal of 1."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice, pairwise
from typing import NamedTuple

import numpy as np

from todframes.base.errors import DataError, SettingsError, argument
from todframes.display.sensor_display import SignalDisplay
from todframes.recordings.recording import CodeRange, Recording, code_range
from todframes.stimulus import level_of

MOST_FRAMES = 200
"""Largest number of frames of a recording from which its background and noise are taken."""


class FilmLevels(NamedTuple):
    """The value of the background of a recording, and the noise of single frames at pairs of them."""

    background: float
    pair_noises: list[float]

    @classmethod
    def of(cls, recording: Recording) -> FilmLevels:
        """Measure the median of the frames, and the deviation of the difference of each frame from the last."""
        frames = [frame.values.astype(np.float32) for frame in islice(recording.frames(), MOST_FRAMES)]
        noises = [float(np.std(after - before)) / 2.0**0.5 for before, after in pairwise(frames)]
        background = float(np.mean([np.median(frame) for frame in frames]))
        return cls(background, [noise for noise in noises if noise > 0.0])  # others are the same frame twice


def signal_scales(
    recordings: Sequence[Recording], shown: SignalDisplay, level: str, value_range: tuple[float, float] | None
) -> tuple[list[CodeRange], str]:
    """Return the values of each recording for signals of 0 and 1, and a sentence about them.

    A signal of 1 is the background again above the value without light, which is the lower one of `value_range` or
    that of the recording: a contrast of 1. Of other sensors it is what a level of 1 causes, by the NETD and the
    noise of the film. That is the median over pairs of frames, as a page that changes is in few of them.
    SettingsError if the levels are none of the sensor, or a setting is missing; DataError if the film does not
    show its noise or background.
    """
    meaning, gain = level_of(level), shown.of_sensor.gain
    if meaning.quantity != ("contrast" if shown.is_contrast else "delta_t_k"):
        expected = "contrasts" if shown.is_contrast else "temperature differences, such as delta_t_k"
        raise SettingsError(
            f"{argument.display}: found levels in {level}, expected {expected}, as this sensor has; with a "
            f"schedule, {argument.level} names their column"
        )
    levels = [FilmLevels.of(recording) for recording in recordings]
    backgrounds = [of_film.background for of_film in levels]
    if shown.is_contrast:
        blacks = [code_range(recording, value_range).low for recording in recordings]
        for recording, black, background in zip(recordings, blacks, backgrounds, strict=True):
            if background <= black:
                raise DataError(
                    f"{recording.path}: the median is {background:g}, expected more than {black:g}, the value "
                    f"without light; {argument.value_range} LOW:HIGH gives another"
                )
        return [CodeRange(at, at + at - black) for at, black in zip(backgrounds, blacks, strict=True)], (
            f"display: a contrast of 1 is shown with {gain:g}; the background is {backgrounds[0]:.6g}, no light "
            f"{blacks[0]:g}"
        )
    if value_range is not None:
        raise SettingsError(
            f"{argument.value_range}: is given but not used with the display of this sensor, whose gain refers to "
            "the noise of the film"
        )
    if shown.netd_mk is None:
        raise SettingsError(
            f"{argument.display}: [noise]: netd_mk is missing, which turns the noise of the film into kelvins"
        )
    noises = [noise for of_film in levels for noise in of_film.pair_noises]
    if not noises:
        raise DataError(
            f"{recordings[0].path}: found no two frames that differ, expected several of a recording, whose noise "
            f"the gain of the display refers to; any other display takes {argument.value_range}"
        )
    noise = float(np.median(noises))
    per_kelvin = 1000.0 * noise / shown.netd_mk
    return [CodeRange(at, at + meaning.factor * per_kelvin) for at in backgrounds], (
        f"display: a triangle of any ΔT is shown with a contrast of {gain:g}; the background is "
        f"{backgrounds[0]:.6g}, the noise {noise:.4g}; 1 K is {per_kelvin:.4g} by the NETD of {shown.netd_mk:g} mK"
    )
