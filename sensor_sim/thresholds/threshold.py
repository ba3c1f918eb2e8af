"""The threshold of a sensor at one size: the one way from settings to a number, for curves, sweeps and limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from sensor_sim.chain.camera import Camera
from sensor_sim.chain.photons import frame_noise_dn, rounding_terms
from sensor_sim.thresholds.curve_plan import plan_curve
from sensor_sim.thresholds.predict import FoldedChain, PredictedThreshold, predict_threshold
from sensor_sim.thresholds.sharing import NO_CACHE, Caches
from todframes.observers.interface import Observer
from todframes.parameters import PlanName
from todframes.results.data import ResultWarning
from todframes.results.wording import plain

LEAST_NOISE_DN, LEAST_DISTORTION = 0.5, 0.02
"""Noise of a frame, in digital numbers, that averages the steps of rounding out, and change of small contrasts
from which rounding is reported: a noise of 0.48."""


class Computed(NamedTuple):
    """A threshold, and the chain that it was computed with."""

    found: PredictedThreshold
    chain: FoldedChain


def threshold_at(
    camera: Camera,
    observer: Observer,
    size_detectors: float,
    *,
    p_correct: float,
    tolerance: float,
    seed: int,
    plan: PlanName = "needed",
    shared: Caches = NO_CACHE,
    **search: Any,
) -> Computed:
    """Compute the threshold of a size in detectors; `search` is for `predicted_on_lattices`. SettingsError if the
    observer is not linear, or the size or field is out of range.
    """
    steps = plan_curve(
        camera, observer, size_detectors, name=plan, tolerance=tolerance, p_correct=p_correct, shared=shared
    )
    chain = FoldedChain(camera, observer, size_detectors, steps)
    found = predict_threshold(chain, p_correct=p_correct, tolerance=tolerance, seed=seed, **search)
    return Computed(found, chain)


def coarse_rounding(cameras: Sequence[Camera]) -> tuple[ResultWarning, ...]:
    """Return a warning for each camera and light whose noise does not average out the steps of its numbers."""
    warnings = []
    for camera in cameras:
        if camera.photons is None or not rounding_terms(camera).size:
            continue
        noise, gain = frame_noise_dn(camera), camera.photons.system_gain_dn_per_electron or 0.0
        distortion = min(2.0 * math.exp(-2.0 * (math.pi * noise) ** 2), 1.0)
        if distortion < LEAST_DISTORTION:
            continue
        number = gain * (camera.background_electrons + camera.photons.dark_electrons)
        message = (
            f"the noise of a frame is {plain(noise, 2)} digital numbers: rounding changes small contrasts by up "
            f"to {100.0 * distortion:.2g} %, depending on where the background lies between two numbers. "
            f"Thresholds hold for a background {number:.2f} numbers above a whole black level, which no camera "
            "keeps; take a mode with more bits or gain, or more light"
        )
        warnings.append(
            ResultWarning(code="coarse_rounding", message=message, found=noise, expected=LEAST_NOISE_DN)
        )
    return tuple(warnings)
