"""The Python calls behind the commands: TOD curves, datasets and transfer functions of a sensor."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from sensor_sim.sensor import Sensor, load_sensor
from todframes.api import described
from todframes.errors import SettingsError
from todframes.observers.interface import Observer
from todframes.psychometrics.fit import FitSettings
from todframes.report.data import Fit, FitPoint
from todframes.report.result import Result
from todframes.scoring.error_budget import PlanName, Step, plan_object

if TYPE_CHECKING:
    from sensor_sim.mtf_report import SensorMtf
    from sensor_sim.simulation import FrameFormat, Written
    from todframes.jobs.work import Engine


def curve(
    sensor: Sensor | Path | str,
    *,
    size_detectors: Sequence[float],
    observer: str | Observer = "pyramid",
    p_correct: float = 0.75,
    tolerance: float = 2e-3,
    plan: PlanName = "needed",
    seed: int = 1,
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
        Leave out the computations that the sensor does not need, or leave out none.
    seed : int
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
    started = time.perf_counter()
    from sensor_sim.curve_plan import plan_curve
    from sensor_sim.noise import delta_t_as_printed_mk, delta_t_mk
    from sensor_sim.predict import FoldedChain, predict_threshold

    judge, settings = described(observer)
    FitSettings(p_correct=p_correct)  # checks it
    sensor = sensor if isinstance(sensor, Sensor) else load_sensor(sensor)
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
        phases = Step("phases", True, f"{found.n_phases} trials, as the tolerance takes")
        warm = warm_as_printed = None
        if snr is not None and sensor.noise.netd_mk is not None:
            warm, warm_as_printed = (
                float(convert(snr, noise=sensor.noise)) for convert in (delta_t_mk, delta_t_as_printed_mk)
            )
        fits.append(
            Fit(
                group={"size_detectors": size},
                level="snr",
                status=found.status,
                threshold=snr,
                threshold_numerical_error=found.numerical_error,
                p_correct=p_correct,
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


def simulate(
    sensor: Sensor | Path | str,
    *,
    size_detectors: Sequence[float],
    snr: Sequence[float],
    out: Path | str,
    trials: int = 40,
    seed: int = 1,
    frame_format: FrameFormat = "exr",
    allow_clipping: bool = False,
    overwrite: bool = False,
    stages: bool = False,
    workers: int = 1,
    cluster: str | Engine | None = None,
    restart: bool = False,
    keep_store: bool = False,
    tell: Callable[[str], None] | None = None,
    progress: Callable[[int], None] | None = None,
) -> Written:
    """Make a dataset of display frames that `todframes.score` reads, as `sensor-sim simulate` does.

    Parameters
    ----------
    sensor : Sensor or path
        Settings of the sensor, or the path of its SENSOR.toml.
    size_detectors : sequence of float
        Sizes √(area) in detector pitches.
    snr : sequence of float
        Signals of a large triangle divided by the standard deviation of the noise of a sample.
    out : path
        Folder to make.
    trials : int
        Frames of each size and SNR.
    seed : int
        Seed of all random draws.
    frame_format : {"exr", "png"}
        Half-float EXR in cd/m², or 16-bit PNG.
    allow_clipping : bool
        Let PNG clip more than 1 % of the pixels.
    overwrite : bool
        Replace `out` if it exists.
    stages : bool
        Also write the stages of a trial with the highest SNR as pictures.
    workers : int
        Threads that draw frames.
    cluster : str, optional
        Address of a Dask scheduler, "tcp://…", or "local:N" for N processes; they draw instead.
    restart : bool
        Begin anew even if an earlier call with the same `out` was interrupted.
    keep_store : bool
        Keep the list of the frames that are finished after the dataset is whole.
    tell : function of a text, optional
        Called with a remark if an earlier call has finished some of the frames.
    progress : function of an int, optional
        Called with the number of frames that were just done.

    Returns
    -------
    Written
        Number of frames, `n_frames`, and `clipped_share` of the pixels.

    Raises
    ------
    SettingsError
        If a setting is invalid, or too many pixels would be clipped.
    OutputError
        If the place cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import sensor_sim as ss
    >>> out = tempfile.mkdtemp()
    >>> camera = "sample_frames/staring_camera.toml"
    >>> ss.simulate(camera, size_detectors=[4], snr=[2, 8], trials=4, out=out).n_frames
    8
    """
    from sensor_sim.simulation import plan_trials, write_dataset
    from todframes.jobs.engine import open_engine
    from todframes.jobs.store import Store
    from todframes.output import Going, new_folder, store_folder

    sensor = sensor if isinstance(sensor, Sensor) else load_sensor(sensor)
    planned = plan_trials([float(one) for one in size_detectors], [float(one) for one in snr], trials)
    going = Going(restart=restart, keep=keep_store)
    with (
        open_engine(cluster, workers) as engine,
        new_folder(str(out), overwrite=overwrite, going=going) as folder,
        closing(Store(store_folder(folder), str(out), tell)) as store,
    ):
        written = write_dataset(
            folder,
            sensor,
            planned,
            seed=seed,
            frame_format=frame_format,
            allow_clipping=allow_clipping,
            engine=engine,
            store=store,
            progress=progress,
        )
        if stages:
            from sensor_sim.pictures import write_stages

            # The picture shows the trial with the most visible triangle.
            clearest = max(planned, key=lambda trial: (trial.snr, trial.size_detectors))
            write_stages(folder / "stages", sensor, clearest, seed=seed)
    return written


def mtf(sensor: Sensor | Path | str) -> SensorMtf:
    """Compute the modulation transfer of every stage along x, before and after sampling, as `sensor-sim mtf` does.

    Parameters
    ----------
    sensor : Sensor or path
        Settings of the sensor, or the path of its SENSOR.toml.

    Returns
    -------
    SensorMtf
        `frequency_cyc_per_mrad` and `mtf`, a list for each stage; `plot()` draws them.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> transfer = ss.mtf("sample_frames/staring_camera.toml")
    >>> round(transfer.nyquist_cyc_per_mrad, 2), [*transfer.mtf][:2]
    (7.34, ['diffraction', 'optics_blur'])
    """
    from sensor_sim.mtf_report import sensor_mtf

    return sensor_mtf(sensor if isinstance(sensor, Sensor) else load_sensor(sensor))
