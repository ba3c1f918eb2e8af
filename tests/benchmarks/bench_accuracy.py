"""Speed of the closed form at equal error, on the camera scenes, and how honest its own error is."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from timing import Row

from sensor_sim.chain.sensor import Detector, Optics, Sensor, SensorDisplay, load_sensor
from sensor_sim.studies.accuracy import external_noise, internal_noise, no_noise
from sensor_sim.thresholds.curve_plan import plan_curve
from sensor_sim.thresholds.predict import FoldedChain, predict_threshold
from todframes.observers.pyramid import PyramidObserver
from todframes.studies.accuracy.measure import measure

SECONDS = 60.0
SEEDS = 200
TOLERANCES = (2e-2, 5e-3, 2e-3)
STAR_LIKE = load_sensor(Path(__file__).parents[2] / "sample_frames" / "star_like.toml")
UNDER_SAMPLED = Sensor(
    optics=Optics(aperture_mm=100.0, wavelength_um=10.0),
    detector=Detector(pitch_mrad=0.2, width_mrad=0.2),
    display=SensorDisplay(
        pixels_per_detector=4,
        pixel_pitch_mm=0.25,
        viewing_distance_mm=1500.0,
        background_luminance_cd_m2=50.0,
        blur_sigma_px=1.0,
    ),
)
LOW_FILL_FACTOR = replace(
    UNDER_SAMPLED,
    optics=Optics(aperture_mm=200.0, wavelength_um=4.0, blur_sigma_mrad=0.01),
    detector=Detector(pitch_mrad=0.1, width_mrad=0.05),
    display=replace(UNDER_SAMPLED.display, pixels_per_detector=5, viewing_distance_mm=2000.0, blur_sigma_px=1.4),
)
COVERED = {
    "star-like": (STAR_LIKE, (5.0, 8.0)),
    "under-sampled": (UNDER_SAMPLED, (2.5, 3.0)),
    "low fill factor": (LOW_FILL_FACTOR, (3.0, 4.0)),
}


def coverage(sensor: Sensor, size: float) -> list[float]:
    """Share of the stated intervals that hold the converged threshold, for each tolerance."""
    observer = PyramidObserver()
    # The loosest plan that any of them might have, and the tightest for what they are held against.
    close, wide = (
        plan_curve(sensor, observer, size, tolerance=tolerance) for tolerance in (min(TOLERANCES), max(TOLERANCES))
    )
    deep = [
        predict_threshold(FoldedChain(sensor, observer, size, close), tolerance=1e-9, seed=SEEDS + k).threshold
        for k in range(8)
    ]
    converged = float(np.mean([threshold for threshold in deep if threshold is not None]))
    held = np.zeros(len(TOLERANCES))
    for seed in range(SEEDS):
        # Lattices that several tolerances come to are drawn once.
        chains = [FoldedChain(sensor, observer, size, plan) for plan in (wide, close)]
        for k, tolerance in enumerate(TOLERANCES):
            chain = chains[tolerance < max(TOLERANCES)]
            found = predict_threshold(chain, tolerance=tolerance, seed=seed)
            assert found.threshold is not None and found.numerical_error is not None
            held[k] += abs(found.threshold - converged) <= found.numerical_error
    return (held / SEEDS).tolist()


def rows() -> list[Row]:
    """Ratios at 1 % and 0.1 % for each scene, and the lowest coverage of each sensor."""
    found = []
    for make in (external_noise, internal_noise, no_noise):
        measured = measure(make(), seconds=SECONDS)
        for ratio, asked in zip(measured.ratios, (">= 1000", ">= 50000"), strict=True):
            name = f"{measured.name}: literal Monte Carlo ÷ closed form, CPU at {100.0 * ratio.error:g} %"
            found.append(Row(name + ", extrapolated" * ratio.extrapolated, ratio.ratio or math.nan, asked))
    for name, (sensor, sizes) in COVERED.items():
        lowest = min(share for size in sizes for share in coverage(sensor, size))
        found.append(Row(f"{name}: stated 95 % bound holds, {SEEDS} seeds, lowest of 6", lowest, ">= 0.93"))
    return found
