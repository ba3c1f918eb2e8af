"""Settings of the observer `informative` that describe a sensor and its display."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sensor_sim.chain.camera import resolve_without_light
from sensor_sim.chain.sensor import Sensor
from sensor_sim.chain.transfer import optics_otf
from todframes.base.reading import checked
from todframes.observers.hotelling import HotellingSettings


@checked
def matched_settings(sensor: Sensor, **others: Any) -> HotellingSettings:
    """Return the settings of the observer `informative` that describe a sensor and its display.

    The observer makes its templates from these settings. Optics are replaced by the Gaussian blur with the same
    transfer at the detectors' Nyquist frequency, or at half the optics' cut-off if that is lower.

    Parameters
    ----------
    sensor : Sensor
        The sensor to match.
    **others
        Any other settings, such as internal_noise. If `sample_noise_sd` is given, as the display's gain divided by
        a signal-to-noise ratio, the weights are ideal for that noise too.

    Returns
    -------
    HotellingSettings
        Settings for `HotellingObserver`.

    Raises
    ------
    SettingsError
        If a value is out of its range.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> import todframes as tod
    >>> sensor = ss.load_sensor("sample_frames/star_like.toml")
    >>> result = ss.curve(sensor, size_detectors=[5], observer=tod.HotellingObserver(ss.matched_settings(sensor)))
    """
    camera = resolve_without_light(sensor)
    optics = camera.optics
    as_seen = sensor.magnification
    frequency = min(camera.nyquist_cyc_per_mrad, optics.cut_off_cyc_per_mrad / 2.0)
    transfer = max(float(np.abs(optics_otf(frequency, 0.0, optics=optics))), 1e-300)
    return HotellingSettings(
        presample_blur_mrad=as_seen * math.sqrt(-math.log(transfer) / 2.0) / (math.pi * frequency),
        sample_width_mrad=as_seen * camera.width_mrad,
        sample_pitch_mrad=camera.shown_pitch_mrad,
        display_blur_mrad=sensor.display.pixel_pitch_mrad * math.hypot(*camera.blurs_px),
        **others,
    )
