"""The ideal camera with the acuity of a sensor: square detectors side by side, without other blur and noise."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from msgspec import Struct

from sensor_sim.chain.camera import Camera, ModelledOptics
from sensor_sim.chain.detector_noise import NO_LINES
from sensor_sim.limits.crossing import Crossing, Try, find_crossing
from sensor_sim.thresholds.curve_plan import coarse_plan
from sensor_sim.thresholds.predict import FoldedChain
from todframes.base.errors import SettingsError
from todframes.observers.interface import Observer
from todframes.results.wording import plain
from todframes.scoring.error_budget import half_width_95

LARGEST_DETECTORS, OWN_DETECTORS, SMALLEST_DETECTORS = 32.0, 4.0, 0.5
"""Sizes of the triangle in detectors at the ends of the range that is tried, and the first one."""

WAVES = 0.02
"""Relative error because the proportion correct rises with the size in waves, as edges of the triangle pass those
of detectors: of eleven crossings ten are within 1 % of a line through nine sizes, and one within 3 %."""


class IdealCamera(Struct, frozen=True, kw_only=True):
    """The ideal camera with the acuity of a sensor, on the same display.

    Attributes
    ----------
    size_detectors, size_mrad : float
        Smallest size that is judged: without detector noise, or at contrast 1 in the light of the scene.
    ideal_pitch_mrad, ideal_pitch_error_mrad : float
        Pitch of the ideal camera with the acuity of the sensor, and half of its 95 % interval.
    effective_share : float
        Pitch of the sensor over that pitch: the effective pixels among its pixels, along a line.
    """

    size_detectors: float
    size_mrad: float
    ideal_pitch_mrad: float
    ideal_pitch_error_mrad: float
    effective_share: float

    def sentence(self) -> str:
        """Return the acuity and the ideal camera in words."""
        size = f"{plain(self.size_detectors, 3)} detectors or {plain(self.size_mrad, 3)} mrad"
        pitch = f"{plain(self.ideal_pitch_mrad, 3)} ± {plain(self.ideal_pitch_error_mrad, 1)} mrad"
        effective = f"100 pixels are {100.0 * self.effective_share:.0f} effective"
        return f"The acuity, {size}, is that of an ideal camera with a pitch of {pitch}: {effective}."


def idealised(camera: Camera) -> Camera:
    """Return the ideal camera of the same pitch and display."""
    pitch_mrad = camera.pitch_mrad
    optics = ModelledOptics(
        aperture_mm=1e4 / pitch_mrad, wavelength_um=1.0
    )  # passes 0.9995 of 3 cycles a detector
    without_noise = replace(camera, lines=NO_LINES, photons=None, background_electrons=0.0)
    return replace(
        without_noise, optics=optics, width_mrad=pitch_mrad, electronics_blur_px=0.0, motion=None, air=None
    )


def ideal_camera_of(camera: Camera, observer: Observer, *, p_correct: float, seed: int) -> IdealCamera | None:
    """Return the ideal camera with the acuity of a sensor; None if no size is judged. A display shows the
    detectors of all pitches at the same angle, so an ideal camera has the same acuity in detectors at any pitch:
    the pitch follows from the ratio.
    """
    cameras = camera, idealised(camera)
    try:
        own, ideal = (_acuity(each, observer, p_correct, seed) for each in cameras)
    except SettingsError:  # the first triangle that is tried is too large for the observer
        return None
    if own.value is None or ideal.value is None:
        return None
    errors = [(acuity.error or 0.0) / acuity.value for acuity in (own, ideal) if acuity.value is not None]
    pitch_mrad, share = camera.pitch_mrad, ideal.value / own.value
    return IdealCamera(
        size_detectors=own.value,
        size_mrad=own.value * pitch_mrad,
        ideal_pitch_mrad=pitch_mrad / share,
        ideal_pitch_error_mrad=math.hypot(*errors, WAVES, WAVES) * pitch_mrad / share,
        effective_share=share,
    )


def _acuity(camera: Camera, observer: Observer, p_correct: float, seed: int) -> Crossing:
    """Find the size in detectors at which a triangle is just judged, without noise or at contrast 1."""

    def at_size(size: float) -> Try:
        chain = FoldedChain(camera, observer, size, coarse_plan(camera, observer, size))
        level = chain.largest_level if camera.photons is None else min(1.0, chain.largest_level)
        replicates = chain.replicates(chain.lattices[1], seed)
        values = np.array([chain.proportion_correct(phases, level) for phases in replicates])
        return Try(size, p_correct - float(values.mean()), half_width_95(values), None)

    low, high = SMALLEST_DETECTORS, LARGEST_DETECTORS
    return find_crossing(at_size, OWN_DETECTORS, low=low, high=high, larger_is_better=True)
