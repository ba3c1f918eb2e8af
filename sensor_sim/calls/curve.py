"""The call `curve`: the TOD curve of a sensor, without drawing frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sensor_sim.chain.sensor import Sensor, sensor_of, sensor_settings
from todframes.base.errors import SettingsError
from todframes.base.seeds import Rng, seed_of
from todframes.observers.interface import Observer, described
from todframes.psychometrics.fit import FitSettings
from todframes.report.data import Fit, FitPoint
from todframes.report.result import Result
from todframes.scoring.error_budget import PlanName, Step, plan_object

SHARED_MB = 128
"""Largest size of the parts that the curves at several luminances share, in units of 2**20 bytes."""


def curve(
    sensor: Sensor | Path | str,
    *,
    size_detectors: Sequence[float],
    luminance_cd_m2: Sequence[float] = (),
    observer: str | Observer = "pyramid",
    p_correct: float = 0.75,
    tolerance: float = 2e-3,
    plan: PlanName = "needed",
    rng: Rng = 1,
    examples: bool = True,
    progress: Callable[[int], None] | None = None,
) -> Result:
    """Compute the TOD curve of a sensor without drawing frames, as `sensor-sim curve` does.

    Parameters
    ----------
    sensor : Sensor or path
        Settings of the sensor, or the path of its SENSOR.toml.
    size_detectors : sequence of float
        Sizes √(area) in detector pitches, without repetitions.
    luminance_cd_m2 : sequence of float
        For a camera that counts photons: luminances of the background in place of that of its scene, in cd/m²,
        without repetitions. There is a curve for each.
    observer : str or Observer
        Name of a registered observer, "module:Class", or an observer; it must be linear.
    p_correct : float
        Raw proportion correct at threshold.
    tolerance : float
        Relative error of the thresholds to reach.
    plan : {"needed", "full"}
        Leave out computations that the sensor does not need, or none.
    rng : int, SeedSequence or Generator
        Seed of the places of the triangle on the detectors.
    examples : bool
        Also draw a triangle at threshold, for the page.
    progress : function of an int, optional
        Called with the number of sizes that were just done.

    Returns
    -------
    todframes.Result
        Thresholds in SNR, and in mK where the sensor's NETD is known; those of a camera that counts photons are
        contrasts.

    Raises
    ------
    SettingsError
        If a setting is invalid, or the observer is not linear.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> result = ss.curve("sample_frames/staring_camera.toml", size_detectors=[4, 6], tolerance=0.02)
    >>> [round(one.threshold, 1) for one in result.thresholds]
    [3.2, 1.1]
    """
    started, seed = time.perf_counter(), seed_of(rng)
    from sensor_sim.chain.detector_noise import delta_t_as_printed_mk, delta_t_mk
    from sensor_sim.thresholds.curve_plan import plan_curve, plans_in_common
    from sensor_sim.thresholds.predict import FoldedChain, predict_each
    from sensor_sim.thresholds.sharing import NOTHING, Shared
    from todframes.stimulus import Stimulus

    judge, settings = described(observer)
    FitSettings(p_correct=p_correct)  # checks it
    sensor = sensor_of(sensor)
    sizes = _each_once(size_detectors, "size_detectors")
    lights = _lights(sensor, _each_once(luminance_cd_m2, "luminance_cd_m2"))
    of_lights: list[list[Fit]] = [[] for _ in lights]
    for size in sizes:
        started_size = time.perf_counter()
        shared = Shared.of(SHARED_MB * 2**20) if len(lights) > 1 else NOTHING
        plans = [
            plan_curve(light, judge, size, name=plan, tolerance=tolerance, p_correct=p_correct, shared=shared)
            for light in lights
        ]
        plans = plans_in_common(plans, Stimulus(size * sensor.display.detector_pitch_mrad))
        chains = [FoldedChain(light, judge, size, of_light) for light, of_light in zip(lights, plans, strict=True)]
        thresholds = predict_each(chains, p_correct=p_correct, tolerance=tolerance, seed=seed)
        for light, chain, found, of_light in zip(lights, chains, thresholds, of_lights, strict=True):
            steps = chain.plan
            group: dict[str, Any] = {"size_detectors": size}
            if len(lights) > 1 and light.scene is not None:
                group = {"luminance_cd_m2": light.scene.background_cd_m2} | group
            phases = Step("phases", True, f"{found.n_phases} trials, chosen to meet the tolerance")
            warm = warm_as_printed = None
            if found.threshold is not None and sensor.level == "snr" and sensor.noise.netd_mk is not None:
                warm, warm_as_printed = (
                    float(convert(found.threshold, noise=sensor.noise))
                    for convert in (delta_t_mk, delta_t_as_printed_mk)
                )
            fit = Fit.of_computed(
                group,
                sensor.level,
                p_correct,
                found,
                points=tuple(FitPoint(level, 0, p) for level, p in found.points),
                n_phases=found.n_phases,
                p_correct_error_bound=chain.non_gaussian_bound(found.threshold),
                p_correct_left_out_bound=steps.bound,
                plan=tuple(plan_object((*steps.steps, phases), chain.drawing_s / steps.unit_s)),
                delta_t_mk=warm,
                delta_t_as_printed_mk=warm_as_printed,
                run_time_s=round(time.perf_counter() - started_size, 4),
            )
            of_light.append(fit)
            started_size = time.perf_counter()
        if progress is not None:
            progress(1)
    fits = [fit for of_light in of_lights for fit in of_light]
    more = {}
    if examples:
        from sensor_sim.pictures import threshold_examples

        more["examples"] = threshold_examples(sensor, judge, fits, seed=seed)
    settings |= {"p_correct": p_correct, "sensor": sensor_settings(sensor), "tolerance": tolerance, "plan": plan}
    return Result.made("curve", started, settings=settings, seed=seed, fits=tuple(fits), **more)


def _each_once(values: Sequence[float], name: str) -> list[float]:
    """Return values as numbers.

    Raises
    ------
    SettingsError
        If a value is there twice.
    """
    numbers = [float(value) for value in values]
    if len(set(numbers)) < len(numbers):
        shown = ",".join(f"{value:g}" for value in numbers)
        raise SettingsError(f"{name}: found a value twice in {shown!r}, expected each once")
    return numbers


def _lights(sensor: Sensor, luminances_cd_m2: Sequence[float]) -> list[Sensor]:
    """Return the sensor at each of some luminances, or as it is if there are none.

    Raises
    ------
    SettingsError
        If the sensor does not count photons, or the background of a luminance saturates it.
    """
    if not luminances_cd_m2:
        return [sensor]
    if sensor.scene is None:
        needed = 'found for a sensor without [noise] model = "photon", expected none'
        raise SettingsError(f"luminance_cd_m2: {needed}")
    return [replace(sensor, scene=sensor.scene.at(luminance)) for luminance in luminances_cd_m2]
