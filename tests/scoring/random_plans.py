"""Random cameras, for which plans are held against the bounds that they state."""

from __future__ import annotations

import math

import numpy as np

from sensor_sim.chain.sensor import Detector, Electronics, Noise, Optics, Sensor, SensorDisplay
from todframes.observers.pyramid import PyramidObserver, PyramidSettings

LEVELS = (0.4, 0.7, 1.0, 1.5, 2.5)
REPEATS = 2
BACKGROUND = 50.0


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def observer_at_random(rng: np.random.Generator) -> PyramidObserver:
    """In weak to strong internal noise, with more or less certain templates."""
    return PyramidObserver(
        PyramidSettings(
            internal_noise=log_uniform(rng, 0.05, 1.0),
            template_blur_samples=rng.uniform(0.5, 2.0),
            centre=str(rng.choice(["centroid", "bounding_box"])),  # type: ignore[arg-type]
        )
    )


def camera_at_random(rng: np.random.Generator) -> Sensor:
    """From sharp to blurred, from finely to coarsely shown."""
    pitch = 0.1
    pixels = int(rng.integers(1, 12))
    display_mrad = log_uniform(rng, 0.5, 4.0)
    return Sensor(
        optics=Optics(
            aperture_mm=log_uniform(rng, 0.3, 15.0) * 4.0 / pitch,
            wavelength_um=4.0,
            blur_sigma_mrad=pitch * rng.choice([0.0, rng.uniform(0.1, 1.0)]),
        ),
        detector=Detector(pitch_mrad=pitch, width_mrad=pitch * rng.uniform(0.3, 1.0)),
        noise=Noise(),
        electronics=Electronics(blur_sigma_px=float(rng.choice([0.0, 1.0]))),
        display=SensorDisplay(
            pixels_per_detector=pixels,
            pixel_pitch_mm=0.25,
            viewing_distance_mm=0.25 / (display_mrad / pixels) * 1000.0,
            background_luminance_cd_m2=50.0,
            blur_sigma_px=float(rng.choice([0.0, rng.uniform(0.3, 0.5) * pixels])),
            gain=log_uniform(rng, 0.3, 3.0),
        ),
    )
