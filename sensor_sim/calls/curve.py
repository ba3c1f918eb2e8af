"""The call `curve`: the TOD curve of a sensor, without drawing frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

from sensor_sim.chain.sensor import Sensor, sensor_of
from todframes.base.errors import SettingsError
from todframes.base.seeds import Rng, seed_of
from todframes.observers.interface import Observer, described
from todframes.psychometrics.fit import FitSettings
from todframes.report.data import Fit, FitPoint
from todframes.report.result import Result
from todframes.scoring.error_budget import PlanName, Step, plan_object


def curve(
    sensor: Sensor | Path | str,
    *,
    size_detectors: Sequence[float],
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
        Thresholds in SNR, and in mK where the sensor's NETD is known.

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
    from sensor_sim.thresholds.predict import FoldedChain, predict_threshold

    judge, settings = described(observer)
    FitSettings(p_correct=p_correct)  # checks it
    sensor = sensor_of(sensor)
    sizes = [float(size) for size in size_detectors]
    if len(set(sizes)) < len(sizes):
        shown = ",".join(f"{size:g}" for size in sizes)
        raise SettingsError(f"size_detectors: found a value twice in {shown!r}, expected each once")
    fits = []
    for size in sizes:
        started_size = time.perf_counter()
        steps = plan_curve(sensor, judge, size, name=plan, tolerance=tolerance, p_correct=p_correct)
        chain = FoldedChain(sensor, judge, size, steps)
        found = predict_threshold(chain, p_correct=p_correct, tolerance=tolerance, seed=seed)
        snr = found.threshold
        phases = Step("phases", True, f"{found.n_phases} trials, chosen to meet the tolerance")
        warm = warm_as_printed = None
        if snr is not None and sensor.noise.netd_mk is not None:
            warm, warm_as_printed = (
                float(convert(snr, noise=sensor.noise)) for convert in (delta_t_mk, delta_t_as_printed_mk)
            )
        fits.append(
            Fit.of_computed(
                {"size_detectors": size},
                "snr",
                p_correct,
                found,
                points=tuple(FitPoint(level, 0, p) for level, p in found.points),
                n_phases=found.n_phases,
                p_correct_error_bound=chain.non_gaussian_bound(),
                p_correct_left_out_bound=steps.bound,
                plan=tuple(plan_object((*steps.steps, phases), chain.drawing_s / steps.unit_s)),
                delta_t_mk=warm,
                delta_t_as_printed_mk=warm_as_printed,
                run_time_s=round(time.perf_counter() - started_size, 4),
            )
        )
        if progress is not None:
            progress(1)
    more = {}
    if examples:
        from sensor_sim.pictures import threshold_examples

        more["examples"] = threshold_examples(sensor, judge, fits, seed=seed)
    settings |= {"p_correct": p_correct, "sensor": asdict(sensor), "tolerance": tolerance, "plan": plan}
    return Result.made("curve", started, settings=settings, seed=seed, fits=tuple(fits), **more)
