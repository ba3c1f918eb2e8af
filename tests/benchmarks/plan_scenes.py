"""Planned against full thresholds of random scenes: whether the stated bounds hold, and what planning saves.

    python tests/benchmarks/plan_scenes.py [N]

prints a line a scene and a summary. The two thresholds have displacements of their own, so they differ by the
error of both samples besides what the plan leaves out.
"""

from __future__ import annotations

import math
import sys
import time

import numpy as np

from sensor_sim.planning import plan_curve
from sensor_sim.predict import FoldedChain, PredictedThreshold, predict_threshold
from sensor_sim.sensor import Detector, Electronics, Noise, Optics, Sensor, SensorDisplay
from todframes.observer import PyramidObserver, PyramidSettings

TOLERANCE = 1e-2


def scene(rng: np.random.Generator) -> tuple[Sensor, PyramidObserver, float]:
    """A camera from sharp to blurred, from finely to coarsely shown, in weak to strong internal noise."""
    pitch = 0.1
    pixels = int(rng.integers(1, 12))
    display_mrad = math.exp(rng.uniform(math.log(0.5), math.log(4.0)))
    sensor = Sensor(
        optics=Optics(
            aperture_mm=math.exp(rng.uniform(math.log(0.3), math.log(15.0))) * 4.0 / pitch,
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
            gain=math.exp(rng.uniform(math.log(0.3), math.log(3.0))),
        ),
    )
    settings = PyramidSettings(
        internal_noise=math.exp(rng.uniform(math.log(0.05), math.log(1.0))),
        template_blur_samples=rng.uniform(0.5, 2.0),
        centre=str(rng.choice(["centroid", "bounding_box"])),  # type: ignore[arg-type]
    )
    return sensor, PyramidObserver(settings), math.exp(rng.uniform(math.log(3.0), math.log(7.0)))


def threshold(
    sensor: Sensor, observer: PyramidObserver, size: float, name: str
) -> tuple[PredictedThreshold, float]:
    """A threshold with a plan of this name, and its processor time in seconds."""
    started = time.process_time()
    plan = plan_curve(sensor, observer, size, name=name, tolerance=TOLERANCE)  # type: ignore[arg-type]
    found = predict_threshold(FoldedChain(sensor, observer, size, plan), tolerance=TOLERANCE)
    return found, time.process_time() - started


def main(n_scenes: int) -> None:
    """Run some scenes; exit status 1 if a difference is beyond its bound."""
    rng = np.random.default_rng(1)
    ratios, misses, n_found = [], 0, 0
    for number in range(n_scenes):
        sensor, observer, size = scene(rng)
        (planned, planned_s), (full, full_s) = (
            threshold(sensor, type(observer)(observer.settings), size, name) for name in ("needed", "full")
        )
        ratios.append(full_s / planned_s)
        line = f"{number:4d}  size {size:5.2f}  {planned.status:16s} {full_s / planned_s:6.2f} ×"
        if planned.threshold is not None and full.threshold is not None:
            n_found += 1
            assert planned.numerical_error is not None and full.numerical_error is not None
            difference = abs(planned.threshold - full.threshold) / full.threshold
            bound = (planned.numerical_error + full.numerical_error) / full.threshold
            misses += difference > bound
            line += f"  difference {difference:.1e}, bound {bound:.1e}{'  MISSED' if difference > bound else ''}"
        elif planned.status != full.status:
            misses += 1
            line += f"  full: {full.status}  MISSED"
        print(line, flush=True)
    print(
        f"{n_scenes} scenes, {n_found} with a threshold, {misses} beyond the bound; full ÷ planned time: "
        f"median {np.median(ratios):.2f}, least {min(ratios):.2f}"
    )
    sys.exit(misses > 0)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
