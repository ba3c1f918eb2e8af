"""Random cameras and datasets, for which plans are held against the bounds that they state."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from conftest import DatasetFolder

from sensor_sim.chain.sensor import Detector, Electronics, Noise, Optics, Sensor, SensorDisplay
from todframes.frames.dataset import Dataset, load_dataset
from todframes.frames.files import write_frame
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.scoring.naked_eye import contrast_threshold
from todframes.stimulus import ORIENTATIONS, coverage

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


def dataset_at_random(folder: Path, observer: PyramidObserver, rng: np.random.Generator) -> Dataset:
    """One size at some contrasts about the naked eye's threshold.

    Frames are of all pitches, sizes and formats, from narrower than the retina to much wider, on uneven
    backgrounds, some noisy, some with something bright in a corner.
    """
    size_mrad, size_px = log_uniform(rng, 0.5, 12.0), log_uniform(rng, 3.0, 50.0)
    side = math.ceil(size_px * rng.uniform(2.2, 9.0))
    suffix = str(rng.choice(["png", "exr"]))
    sharp = contrast_threshold(observer, size_mrad=size_mrad).threshold or 0.5
    noise_sd = sharp * rng.choice([0.0, log_uniform(rng, 0.1, 3.0)])
    y, x = np.mgrid[:side, :side] / side - 0.5
    tilt, vignetting = rng.uniform(-0.3, 0.3, 2), rng.uniform(0.0, 0.4)
    uneven = tilt[0] * x + tilt[1] * y - vignetting * (x**2 + y**2)
    corner = (np.hypot(x - 0.42, y + 0.42) < 0.06) * rng.choice([0.0, 0.5])
    polarity = float(rng.choice([1.0, -1.0]))
    # Anywhere on the frame, not necessarily the same place in each.
    room = max(side / 2.0 - 1.1 * size_px, 0.0) * rng.choice([0.0, 1.0])
    (folder / "frames").mkdir()
    columns, rows = ("frame", "orientation", "size_mrad", "contrast", "polarity", "x_px", "y_px"), []
    for level in LEVELS:
        contrast = min(sharp * level * (1.0 + noise_sd / sharp), 0.9)
        for orientation in ORIENTATIONS:
            for repeat in range(REPEATS):
                x_px, y_px = ((side - 1) / 2.0 + rng.uniform(-room, room, 2)).tolist()
                triangle = coverage((side, side), size_px=size_px, x_px=x_px, y_px=y_px, orientation=orientation)
                seen = 1.0 + uneven + corner + polarity * contrast * triangle
                seen = np.maximum(seen + rng.normal(0.0, noise_sd, seen.shape), 0.0)
                name = f"frames/{level}_{orientation}_{repeat}.{suffix}"
                write_frame(folder / name, BACKGROUND * seen if suffix == "exr" else np.minimum(seen / 4.0, 1.0))
                shown = name, orientation.value, size_mrad, float(contrast), int(polarity), x_px, y_px
                rows.append(dict(zip(columns, map(str, shown), strict=True)))
    display = {
        "eotf": "linear",
        "white_luminance_cd_m2": 1.0 if suffix == "exr" else 4.0 * BACKGROUND,
        "pixel_pitch_mrad": size_mrad / size_px,
        "background_luminance_cd_m2": "border" if rng.choice(["border", "known"]) == "border" else BACKGROUND,
    }
    experiment = {"level": "contrast", "group_by": ["size_mrad"]}
    DatasetFolder(folder, {"schema": 1, "display": display, "experiment": experiment}, rows).save()
    return load_dataset(folder)
