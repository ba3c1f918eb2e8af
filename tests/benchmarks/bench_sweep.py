"""Sweeps of a sensor against a curve for each design, in CPU time; and on two processes, in wall time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from timing import Row

from sensor_sim import curve, sweep
from sensor_sim.chain.sensor import load_sensor
from sensor_sim.sweeps.designs import Base, Designs, grid, latin_hypercube, with_settings
from todframes.observers.pyramid import PyramidObserver

SENSOR = Path(__file__).parents[2] / "sample_frames" / "staring_camera.toml"
SIZES = (4.0, 6.0, 8.0)
TOLERANCE = 1e-2
ALONE = 8
"""Designs whose curves are computed alone; they are drawn from all."""

APERTURES, BLURS, NETDS = "60:220:10", "0.5:3:10", "10:40:10"
OBSERVER = PyramidObserver()


def mixes() -> Iterator[tuple[str, Designs, str]]:
    """Yield a name, designs, and the ratio that is asked."""
    base = Base(load_sensor(SENSOR), OBSERVER.settings, keep_fill_factor=True)
    apertures, blurs = {"optics.aperture_mm": APERTURES}, {"display.blur_sigma_px": BLURS}
    yield (
        "1,000 designs: aperture × display blur × NETD",
        grid({**apertures, **blurs, "noise.netd_mk": NETDS}, base.keys),
        ">= 5",
    )
    yield "100 designs: aperture × display blur", grid({**apertures, **blurs}, base.keys), ""
    noises = {"observer.internal_noise": "0.1:1:10"}
    yield "100 designs: aperture × internal noise", grid({**apertures, **noises}, base.keys), ""
    everything = {
        "optics.aperture_mm": "60:220",
        "detector.pitch_mrad": "0.06:0.12",
        "display.blur_sigma_px": "0.5:3",
        "observer.internal_noise": "0.1:1",
    }
    yield "8 designs that share nothing", latin_hypercube(everything, base.keys, n=8, seed=1), ">= 1"


def alone_s(designs: Designs) -> float:
    """CPU time of a curve, the mean over some of the designs."""
    base = Base(load_sensor(SENSOR), OBSERVER.settings, keep_fill_factor=True)
    rows = np.random.default_rng(1).choice(len(designs.values), ALONE, replace=False)
    chosen = [base.design(dict(zip(designs.keys, designs.values[row].tolist(), strict=True))) for row in rows]
    started = time.process_time()
    for sensor, changes in chosen:
        observer = with_settings(OBSERVER, changes)
        curve(sensor, size_detectors=SIZES, observer=observer, tolerance=TOLERANCE, examples=False)
    return (time.process_time() - started) / ALONE


def rows() -> Iterator[Row]:
    """Measure."""
    curve(SENSOR, size_detectors=SIZES[:1], tolerance=0.1, examples=False)  # to import what is needed
    for name, designs, asked in mixes():
        one_s = alone_s(designs)
        started = time.process_time()
        sweep(SENSOR, size_detectors=SIZES, design=designs, keep_fill_factor=True, tolerance=TOLERANCE)
        shared_s = (time.process_time() - started) / len(designs.values)
        print(f"{name}: {one_s:.3g} s a design alone, {shared_s:.3g} s in a sweep", flush=True)
        yield Row(f"sweep, times faster than curves; {name}", one_s / shared_s, asked)
    designs = next(mixes())[1]
    designs = designs._replace(values=designs.values[::40])
    times = []
    for workers in (1, 2):
        started = time.perf_counter()
        sweep(SENSOR, size_detectors=SIZES, design=designs, workers=workers, tolerance=TOLERANCE)
        times.append(time.perf_counter() - started)
    yield Row("sweep on two processes, times faster than on one", times[0] / times[1], "")


if __name__ == "__main__":
    for row in rows():
        print(row)
