"""Planned against full thresholds of random scenes: whether the stated bounds hold, and what planning saves.

    python tests/benchmarks/plan_scenes.py [N]

prints a line a scene and a summary. Two things are held against what is stated. At the same places of the triangle
P(correct) must always differ by less than the plan's bound. The thresholds have places of their own; they may be
farther apart than their 95 % intervals in one scene in twenty.

A full plan begins with many places; `alike` is the time of one that begins with as few as the planned one.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace

import numpy as np

from sensor_sim.chain.sensor import Detector, Electronics, Noise, Optics, Sensor, SensorDisplay
from sensor_sim.thresholds.curve_plan import PLACES, plan_curve
from sensor_sim.thresholds.predict import FoldedChain, PredictedThreshold, predict_threshold
from todframes.observers.pyramid import PyramidObserver, PyramidSettings
from todframes.parameters import PlanName

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
    sensor: Sensor, observer: PyramidObserver, size: float, name: PlanName, **changed: int
) -> tuple[PredictedThreshold, FoldedChain, float]:
    """A threshold with a plan of this name, its chain, and its processor time in seconds."""
    observer = PyramidObserver(observer.settings)  # which remembers nothing
    started = time.process_time()
    plan = replace(plan_curve(sensor, observer, size, name=name, tolerance=TOLERANCE), **changed)
    chain = FoldedChain(sensor, observer, size, plan)
    found = predict_threshold(chain, tolerance=TOLERANCE)
    return found, chain, time.process_time() - started


def change_at_the_same_places(planned: FoldedChain, full: FoldedChain, snr: float) -> float:
    """By how much P(correct) differs, for one orientation on one lattice."""
    p = [chain.proportion_correct(chain.phases(3, np.random.default_rng(1))[:1], snr) for chain in (planned, full)]
    return abs(p[0] - p[1])


def main(n_scenes: int) -> None:
    """Run some scenes; exit status 1 if a change of P(correct) is beyond its bound."""
    rng = np.random.default_rng(1)
    ratios, alike, beyond_bound, beyond_interval, n_found = [], [], 0, 0, 0
    for number in range(n_scenes):
        sensor, observer, size = scene(rng)
        planned, planned_chain, planned_s = threshold(sensor, observer, size, "needed")
        full, full_chain, full_s = threshold(sensor, observer, size, "full")
        *_, alike_s = threshold(sensor, observer, size, "full", places=PLACES)
        ratios.append(full_s / planned_s)
        alike.append(alike_s / planned_s)
        snr = planned.threshold if planned.threshold is not None else math.inf
        change, bound = change_at_the_same_places(planned_chain, full_chain, snr), planned_chain.plan.bound
        beyond_bound += change > bound
        line = f"{number:4d}  size {size:5.2f}  {planned.status:16s} {ratios[-1]:6.2f} ×, alike {alike[-1]:5.2f} ×"
        line += f"  P {change:.1e}, bound {bound:.1e}{'  BEYOND' if change > bound else ''}"
        if planned.threshold is not None and full.threshold is not None:
            n_found += 1
            assert planned.numerical_error is not None and full.numerical_error is not None
            difference = abs(planned.threshold - full.threshold) / full.threshold
            interval = (planned.numerical_error + full.numerical_error) / full.threshold
            beyond_interval += difference > interval
            line += f"  threshold {difference:.1e}, interval {interval:.1e}"
            line += "  beyond" if difference > interval else ""
        elif planned.status != full.status:
            beyond_bound += 1
            line += f"  full: {full.status}  BEYOND"
        print(line, flush=True)
    print(
        f"{n_scenes} scenes: P beyond its bound in {beyond_bound}; {n_found} with a threshold, beyond the "
        f"intervals in {beyond_interval}; full ÷ planned: median {np.median(ratios):.2f}, "
        f"least {min(ratios):.2f}; alike: median {np.median(alike):.2f}, least {min(alike):.2f}, "
        f"slower in {np.mean(np.less(alike, 1)):.1%}"
    )
    sys.exit(beyond_bound > 0)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
