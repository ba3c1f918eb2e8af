"""The call `curve`: the TOD curve of a sensor, without drawing frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from sensor_sim.chain.sensor import Scene, Sensor, sensor_of, sensor_settings
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import distinct_numbers
from todframes.base.seeds import Rng, seed_of
from todframes.observers.interface import Observer, described
from todframes.psychometrics.fit import FitSettings
from todframes.report.data import Fit, FitPoint
from todframes.report.result import Result
from todframes.scoring.error_budget import PlanName, Step, plan_object

LEFT_OUT_GROWS = 4.0
"""Factor by which a plan's bound may grow at other lights; with several lights, a plan leaves out less."""


def curve(
    sensor: Sensor | Path | str,
    *,
    size_detectors: Sequence[float],
    luminance_cd_m2: Sequence[float] = (),
    observer: str | Observer = "pyramid",
    p_correct: float = 0.75,
    places: int = 1,
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
    places : int
        Number of places, far apart, at which the triangle may be; 1: its place is known.
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
    from sensor_sim.thresholds.curve_plan import plan_curve
    from sensor_sim.thresholds.predict import AtLight, FoldedChain, predict_each, predict_threshold

    sensor = sensor_of(sensor)
    if places != 1:
        from sensor_sim.thresholds.places import UnknownPlaceChain, check_places, predict_at_unknown_place

        check_places(sensor, places)
    background = sensor.display.background_luminance_cd_m2
    judge, settings = described(observer, lambda: background)
    FitSettings(p_correct=p_correct)  # checks it
    sizes = distinct_numbers(argument.size_detectors, size_detectors)
    luminances = distinct_numbers(argument.luminance_cd_m2, luminance_cd_m2) if len(luminance_cd_m2) else []
    scenes = _scenes(sensor, luminances)
    of_scenes: list[list[Fit]] = [[] for _ in scenes or (None,)]
    for size in sizes:
        started_size = time.perf_counter()

        def chain_at(scene: Scene | None, size: float = size) -> FoldedChain:
            at_light = replace(sensor, scene=scene)
            steps = plan_curve(
                at_light,
                judge,
                size,
                name=plan,
                tolerance=tolerance / (1.0 if len(scenes) < 2 else LEFT_OUT_GROWS),
                p_correct=p_correct,
            )
            return FoldedChain(at_light, judge, size, steps)

        if scenes:
            thresholds = predict_each(chain_at, scenes, p_correct=p_correct, tolerance=tolerance, seed=seed)
        else:
            chain = chain_at(None)
            if places > 1:
                known, chain = chain, UnknownPlaceChain(sensor, judge, size, places)
                found = predict_at_unknown_place(chain, known, p_correct=p_correct, tolerance=tolerance, seed=seed)
            else:
                found = predict_threshold(chain, p_correct=p_correct, tolerance=tolerance, seed=seed)
            thresholds = [AtLight(found, chain, chain.plan.bound)]
        for (found, at_light, bound), fits_of_scene in zip(thresholds, of_scenes, strict=True):
            steps = at_light.plan
            group: dict[str, float | str] = {"size_detectors": size}
            if luminances and at_light.sensor.scene is not None:
                group = {"luminance_cd_m2": at_light.sensor.scene.background_cd_m2, **group}
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
                p_correct_error_bound=at_light.non_gaussian_bound(found.threshold),
                p_correct_left_out_bound=bound,
                plan=tuple(plan_object((*steps.steps, phases), at_light.drawing_s / steps.unit_s)),
                delta_t_mk=warm,
                delta_t_as_printed_mk=warm_as_printed,
                run_time_s=round((time.perf_counter() - started_size) / len(thresholds), 4),
            )
            fits_of_scene.append(fit)
        if progress is not None:
            progress(1)
    fits = [fit for fits_of_scene in of_scenes for fit in fits_of_scene]
    more = {}
    if examples:
        from sensor_sim.pictures import threshold_examples

        more["examples"] = threshold_examples(sensor, judge, fits, seed=seed)
    settings |= {"p_correct": p_correct, "sensor": sensor_settings(sensor), "tolerance": tolerance, "plan": plan}
    settings |= {"places": places} if places > 1 else {}
    return Result.made("curve", started, settings=settings, seed=seed, fits=tuple(fits), **more)


def _scenes(sensor: Sensor, luminances_cd_m2: Sequence[float]) -> list[Scene]:
    """Return the lights of a camera that counts photons: its own, or some luminances; none for other sensors.

    Raises
    ------
    SettingsError
        If there are luminances for a sensor that does not count photons.
    """
    if sensor.scene is None:
        if luminances_cd_m2:
            needed = 'found for a sensor without [noise] model = "photon", expected none'
            raise SettingsError(f"{argument.luminance_cd_m2}: {needed}")
        return []
    return [sensor.scene.at(luminance) for luminance in luminances_cd_m2] or [sensor.scene]
