"""Latency of the explorer's curves without the browser: for each parameter, the first and the refined answer.

    python tests/benchmarks/live_curves.py [MOVES] [--accuracy SENSORS | --range | --optics]

A parameter moves as under a finger: each step a little further, 20 % to each side and back. Computing is the CPU
time of the slower of two processes; waiting is the time until the answer is there, in which other work of the
machine counts. With `--accuracy`, first answers for sensors at random are held against refined ones. With
`--range`, the CPU time of an update with a target is compared with that without; with `--optics`, that of a
measured MTF and of photons with that of the closed form.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from todframes.cli.console import keep_libraries_to_one_thread

keep_libraries_to_one_thread()  # before NumPy is imported, here and in the processes

import numpy as np  # noqa: E402

from sensor_sim.chain.measured import MeasuredMtf  # noqa: E402
from sensor_sim.chain.sensor import (  # noqa: E402
    Detector,
    Noise,
    Optics,
    PhotonNoise,
    Scene,
    Sensor,
    SensorDisplay,
    load_sensor,
)
from sensor_sim.chain.transfer import band_limit_cyc_per_mrad, optics_mtf  # noqa: E402
from sensor_sim.explorer.live import LiveCurves, divided  # noqa: E402
from sensor_sim.explorer.ranges import ThresholdSent, range_answer, range_from  # noqa: E402
from sensor_sim.explorer.routes import RANGE_POINTS  # noqa: E402
from sensor_sim.explorer.scaled import unit_of  # noqa: E402
from sensor_sim.explorer.threshold_engine import Request, ThresholdEngine  # noqa: E402
from sensor_sim.sweeps.ranges import Aim  # noqa: E402
from sensor_sim.thresholds.predict import PredictedThreshold  # noqa: E402
from todframes.base.errors import DataError  # noqa: E402
from todframes.field.atmosphere import find_atmosphere  # noqa: E402
from todframes.field.target import find_target  # noqa: E402
from todframes.observers.pyramid import PyramidObserver  # noqa: E402

SIZES = (2.0, 3.0, 4.0, 6.0, 8.0)
TOLERANCES = (0.03, 0.002)
SAMPLES = Path(__file__).parents[2] / "sample_frames"
WELL_SAMPLED = Sensor(
    optics=Optics(aperture_mm=50.0, wavelength_um=10.0, blur_sigma_mrad=0.1),
    detector=Detector(pitch_mrad=0.1, width_mrad=0.1),
    noise=Noise(distribution="gaussian"),
    display=SensorDisplay(
        pixels_per_detector=3,
        pixel_pitch_mm=0.25,
        viewing_distance_mm=1500.0,
        background_luminance_cd_m2=50.0,
        blur_sigma_px=0.8,
        gain=1.5,
    ),
)
SENSORS = {
    "star-like": load_sensor(SAMPLES / "star_like.toml"),
    "staring camera": load_sensor(SAMPLES / "staring_camera.toml"),
    "well sampled": WELL_SAMPLED,
}

Move = Callable[[Sensor, float], tuple[Sensor, float]]
"""Takes a sensor and a factor near 1; returns the sensor and the internal noise."""


def _moved(table: str, key: str) -> Move:
    def move(sensor: Sensor, factor: float) -> tuple[Sensor, float]:
        of_table: Any = getattr(sensor, table)
        value = getattr(of_table, key)
        value = factor * value if value else factor - 0.79  # from 0 on, where there was none
        return replace(sensor, **{table: replace(of_table, **{key: value})}), 0.5

    return move


def _coarser(sensor: Sensor, factor: float) -> tuple[Sensor, float]:
    detector = sensor.detector
    detector = Detector(pitch_mrad=factor * detector.pitch_mrad, width_mrad=factor * detector.width_mrad)
    return replace(sensor, detector=detector), 0.5


def _narrower(sensor: Sensor, factor: float) -> tuple[Sensor, float]:
    width = sensor.detector.width_mrad * (0.75 + 0.2 * factor)
    return replace(sensor, detector=replace(sensor.detector, width_mrad=width)), 0.5


MOVES: dict[str, Move] = {
    "optics.aperture_mm": _moved("optics", "aperture_mm"),
    "optics.blur_sigma_mrad": _moved("optics", "blur_sigma_mrad"),
    "detector.pitch_mrad": _coarser,
    "detector.width_mrad": _narrower,
    "noise.netd_mk": lambda sensor, factor: (
        replace(sensor, noise=replace(sensor.noise, netd_mk=16.0 * factor)),
        0.5,
    ),
    "electronics.blur_sigma_px": _moved("electronics", "blur_sigma_px"),
    "display.blur_sigma_px": _moved("display", "blur_sigma_px"),
    "display.viewing_distance_mm": _moved("display", "viewing_distance_mm"),
    "display.gain": _moved("display", "gain"),
    "observer.internal_noise": lambda sensor, factor: (sensor, 0.5 * factor),
}


class Times(NamedTuple):
    """Times in seconds of the first answers, and of the refined one after the last move."""

    first: list[float]
    refined: float

    def __str__(self) -> str:
        """Return median and 95th percentile in milliseconds, and the refined answer's time in seconds."""
        median, most = np.quantile(self.first, [0.5, 0.95]) * 1e3
        return f"{median:7.0f} {most:7.0f} {self.refined:8.2f}"


def factors(n_moves: int) -> list[float]:
    """Return where a parameter goes under a finger: up, down and back, never twice to the same place."""
    return [1.0 + 0.2 * math.sin(phase) for phase in np.linspace(0.1, 2.0 * math.pi - 0.05, n_moves).tolist()]


def computing(sensor: Sensor, move: Move, n_moves: int) -> Times:
    """Measure CPU times, in this process, as if two did their part each."""
    parts = divided(SIZES, 2)
    engines = [ThresholdEngine(lambda: None) for _ in parts]

    def spent(moved: Sensor, noise: float, *, refine: bool) -> float:
        longest = 0.0
        for engine, sizes in zip(engines, parts, strict=True):
            started = time.process_time()
            request = Request(1, moved, unit_of(PyramidObserver(internal_noise=noise)), sizes, 0.75, TOLERANCES)
            for number, answer in enumerate(engine.answers(request), 1):
                if number == len(sizes) and (not refine or answer.is_refined):
                    break
            longest = max(longest, time.process_time() - started)
        return longest

    spent(sensor, 0.5, refine=True)
    first = [spent(*move(sensor, factor), refine=False) for factor in factors(n_moves)]
    return Times(first, spent(*move(sensor, 1.21), refine=True))


def waiting(live: LiveCurves, sensor: Sensor, move: Move, n_moves: int) -> Times:
    """Measure the times until answers are there."""

    def curves(moved: Sensor, noise: float) -> Iterator[float]:
        started = time.perf_counter()
        observer = PyramidObserver(internal_noise=noise)
        for _ in live.curves(moved, observer, SIZES, tolerances=TOLERANCES, is_wanted=lambda: True):
            yield time.perf_counter() - started

    list(curves(sensor, 0.5))
    first = []
    for factor in factors(n_moves):
        answers = curves(*move(sensor, factor))
        first.append(next(answers))
        answers.close()  # type: ignore[attr-defined]
        time.sleep(0.02)  # the next event is not at once
    return Times(first, list(curves(*move(sensor, 1.21)))[-1])


def latency(n_moves: int) -> None:
    """Print the table of latencies."""
    live = LiveCurves()
    try:
        print(f"{'':46}   computing, one of two             waiting")
        print(f"{'sensor, parameter moved':46}{2 * '     ms    95 % refined s  '}")
        for name, sensor in SENSORS.items():
            for key, move in MOVES.items():
                both = computing(sensor, move, n_moves), waiting(live, sensor, move, n_moves)
                print(f"{name + ', ' + key:46} {both[0]}   {both[1]}", flush=True)
    finally:
        live.close()


def spent(request: Request, engine: ThresholdEngine) -> tuple[float, float, list[Any]]:
    """Return the CPU times of the estimates and of all answers to a request, and the last answers by size."""
    started, found = time.process_time(), {}
    first = math.nan
    for number, answer in enumerate(engine.answers(request), 1):
        found[answer.index] = answer
        if number == len(request.sizes):
            first = time.process_time() - started
    return first, time.process_time() - started, [found[place] for place in sorted(found)]


def with_range(n_moves: int) -> None:
    """Print the CPU time of an update with a target, over that without; moves of the two alternate."""
    aim = Aim(replace(find_target("nato"), k={"seen": 8.0}), find_atmosphere("lwir_23km"))
    print(f"{'':16} estimate ms  refined ms    with points: estimate  refined    range ms")
    for name, sensor in SENSORS.items():
        sensor = replace(sensor, noise=replace(sensor.noise, netd_mk=30.0))
        engines = ThresholdEngine(lambda: None), ThresholdEngine(lambda: None)
        times, ranges = [], []
        sizes = tuple(enumerate(SIZES[2:]))
        for place, factor in enumerate(factors(n_moves)):
            moved = _moved("optics", "aperture_mm")(sensor, factor)[0]
            unit, of_move = unit_of(PyramidObserver()), {}
            for which in (0, 1) if place % 2 else (1, 0):
                request = Request(1, moved, unit, sizes, 0.75, TOLERANCES, "snr", which * RANGE_POINTS)
                of_move[which] = spent(request, engines[which])
            times.append([*of_move[0][:2], *of_move[1][:2]])
            sent = [_sent(one.threshold, one.slope) for one in of_move[1][2]]
            started = time.process_time()
            with suppress(DataError):
                range_answer(range_from(aim, moved, sent, 0.75))
            ranges.append(time.process_time() - started)
        without_first, without, first, refined = np.median(np.array(times)[1:], axis=0) * 1e3
        print(
            f"{name:16} {without_first:11.0f} {without:11.0f} {first / without_first:22.2f} ×"
            f"{refined / without:8.2f} × {np.median(ranges) * 1e3:11.1f}",
            flush=True,
        )


def _sent(found: PredictedThreshold, slope: float) -> ThresholdSent:
    return ThresholdSent(
        found.size_detectors,
        found.status,
        found.threshold,
        found.numerical_error,
        list(found.points),
        slope if slope > 0.0 else None,
    )


def of_optics(n_moves: int) -> None:
    """Print the CPU time of an update with a measured MTF, and with photons, over that of the closed form."""
    print(f"{'':16} estimate ms  refined ms    measured MTF: estimate  refined    photons: estimate  refined s")
    for name, sensor in SENSORS.items():
        engines = [ThresholdEngine(lambda: None) for _ in range(3)]
        sizes, times = tuple(enumerate(SIZES)), []
        for factor in factors(n_moves):
            moved = _moved("optics", "aperture_mm")(sensor, factor)[0]
            variants = (moved, _as_measured(moved), _with_photons(moved))
            requests = [Request(1, one, unit_of(PyramidObserver()), sizes, 0.75, TOLERANCES) for one in variants]
            of_move = [spent(*one)[:2] for one in zip(requests, engines, strict=True)]
            times.append([value for pair in of_move for value in pair])
        first, refined, *others = np.median(np.array(times)[1:], axis=0)
        print(
            f"{name:16} {first * 1e3:11.0f} {refined * 1e3:11.0f} {others[0] / first:23.2f} ×"
            f"{others[1] / refined:8.2f} × {others[2] / first:18.2f} × {others[3]:9.2f}",
            flush=True,
        )


def _as_measured(sensor: Sensor) -> Sensor:
    """Return a sensor whose optics are a table of 200 frequencies of their own MTF."""
    optics = sensor.optics
    frequency = np.linspace(0.0, band_limit_cyc_per_mrad(optics), 200)
    values = tuple(np.clip(optics_mtf(frequency, optics=optics), 0.0, 1.0).tolist())
    table = MeasuredMtf(
        file="mtf.csv",
        unit="cyc_per_mrad",
        frequency=tuple(frequency.tolist()),
        tangential=values,
        sagittal=values,
    )
    return replace(sensor, optics=replace(optics, blur_sigma_mrad=0.0, mtf=table))


def _with_photons(sensor: Sensor) -> Sensor:
    """Return a sensor that counts the photons of a dim scene, with the same angles."""
    optics = replace(sensor.optics, focal_length_mm=2.0 * sensor.optics.aperture_mm)
    photons = PhotonNoise(quantum_efficiency=0.6, dark_noise_electrons=5.0, exposure_ms=5.0, prnu_percent=0.5)
    scene = Scene(luminance_cd_m2=0.5, photons_per_lux_s_um2=4090.0)
    return replace(sensor, optics=optics, photons=photons, scene=scene)


def random_sensor(rng: np.random.Generator) -> tuple[Sensor, float]:
    """Draw a sensor about one of the three, and internal noise."""

    def factor(low: float = 0.5, high: float = 2.0) -> float:
        return float(np.exp(rng.uniform(math.log(low), math.log(high))))

    base = list(SENSORS.values())[rng.integers(len(SENSORS))]
    pitch = base.detector.pitch_mrad * factor()
    blurred = float(rng.integers(2))
    sensor = replace(
        base,
        optics=replace(
            base.optics,
            aperture_mm=base.optics.aperture_mm * factor(),
            blur_sigma_mrad=blurred * pitch * float(rng.uniform(0.0, 0.7)),
        ),
        detector=replace(base.detector, pitch_mrad=pitch, width_mrad=pitch * float(rng.uniform(0.4, 1.0))),
        electronics=replace(base.electronics, blur_sigma_px=float(rng.integers(2)) * float(rng.uniform(0.0, 3.0))),
        display=replace(
            base.display,
            pixels_per_detector=int(rng.integers(1, 9)),
            viewing_distance_mm=base.display.viewing_distance_mm * factor(),
            blur_sigma_px=float(rng.integers(2)) * float(rng.uniform(0.0, 3.0)),
            gain=base.display.gain * factor(),
        ),
    )
    return sensor, 0.5 * factor(0.2, 2.0)


def accuracy(n_sensors: int) -> None:
    """Print how first answers compare with refined ones: of sensors that are new, and after a move of 10 %."""
    rng = np.random.default_rng(1)
    found: dict[str, list[tuple[float, float, float]]] = {"new": [], "moved": []}
    keys = [key for key in MOVES if key not in {"noise.netd_mk", "observer.internal_noise"}]
    for _ in range(n_sensors):
        sensor, noise = random_sensor(rng)
        size, key = float(rng.choice(SIZES)), keys[rng.integers(len(keys))]
        engine, unit = ThresholdEngine(lambda: None), unit_of(PyramidObserver(internal_noise=noise))
        for kind, one in (("new", sensor), ("moved", MOVES[key](sensor, 1.1)[0])):
            request = Request(1, one, unit, ((0, size),), 0.75, TOLERANCES)
            first, *_, last = (answer.threshold for answer in engine.answers(request))
            if first.threshold and first.numerical_error and last.threshold and last.numerical_error:
                errors = np.array([first.threshold - last.threshold, first.numerical_error, last.numerical_error])
                found[kind].append(tuple(errors / last.threshold))
    for kind, of_kind in found.items():
        error, stated, refined = np.abs(np.array(of_kind)).T
        print(
            f"{kind}: {len(error)} thresholds; first answers within their 95 % half-widths "
            f"{np.mean(error <= stated):.1%}, within 3 % {np.mean(error <= 0.03):.1%}; error: median "
            f"{np.median(error):.2%}, 95 % {np.quantile(error, 0.95):.2%}, largest {error.max():.2%}; "
            f"stated: median {np.median(stated):.2%}, above 3 % in {np.mean(stated > 0.03):.1%}; "
            f"refined: above 0.2 % in {np.mean(refined > 0.002):.1%}, largest {refined.max():.2%}"
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("moves", nargs="?", type=int, default=40)
    parser.add_argument("--accuracy", type=int, default=0, metavar="SENSORS")
    parser.add_argument("--range", action="store_true")
    parser.add_argument("--optics", action="store_true")
    chosen = parser.parse_args()
    if chosen.accuracy:
        accuracy(chosen.accuracy)
    elif chosen.range:
        with_range(chosen.moves)
    elif chosen.optics:
        of_optics(chosen.moves)
    else:
        latency(chosen.moves)
