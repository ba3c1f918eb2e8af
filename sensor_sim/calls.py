"""The Python calls behind the commands: TOD curves, datasets and transfer functions of a sensor."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from sensor_sim.chain.sensor import Sensor, load_sensor
from todframes.base.errors import SettingsError
from todframes.base.seeds import Rng, seed_of
from todframes.calls.shared import described
from todframes.observers.interface import Observer
from todframes.psychometrics.fit import FitSettings
from todframes.report.data import Fit, FitPoint
from todframes.report.result import Result
from todframes.scoring.error_budget import PlanName, Step, plan_object

if TYPE_CHECKING:
    from sensor_sim.chain.simulation import FrameFormat, Written
    from sensor_sim.mtf_report import SensorMtf
    from sensor_sim.sweeps.designs import Designs
    from sensor_sim.sweeps.result import SweepResult
    from todframes.jobs.store import Store
    from todframes.jobs.work import Engine


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
        Leave out the computations that the sensor does not need, or leave out none.
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


def sweep(
    sensor: Sensor | Path | str,
    *,
    size_detectors: Sequence[float],
    vary: Mapping[str, str | Sequence[float]] | None = None,
    design: Path | str | Sequence[Mapping[str, float]] | Designs | None = None,
    sample: int | None = None,
    keep_fill_factor: bool = False,
    couple_netd: bool = False,
    minimise: Sequence[str] = (),
    maximise: Sequence[str] = (),
    acuity_snr: float | None = None,
    acuity_delta_t_mk: float | None = None,
    observer: str | Observer = "pyramid",
    p_correct: float = 0.75,
    tolerance: float = 2e-3,
    plan: PlanName = "needed",
    rng: Rng = 1,
    workers: int = 1,
    cluster: str | Engine | None = None,
    store: Store | None = None,
    progress: Callable[[int], None] | None = None,
) -> SweepResult:
    """Compute the thresholds of many designs of a sensor, as `sensor-sim sweep` does.

    The numbers of each design are those that `curve` gives for it alone. What designs share is computed once.

    Parameters
    ----------
    sensor : Sensor or path
        Settings that all designs share but for the varied ones, or the path of a SENSOR.toml.
    size_detectors : sequence of float
        Sizes √(area) in detector pitches, without repetitions; the first is the one that tables are ordered by.
    vary : mapping
        For each key, such as "optics.aperture_mm" or "observer.internal_noise", its values, or a text
        "FROM:TO:N" or "FROM:TO:N:log". All combinations are computed. With `sample`, texts "FROM:TO" or
        "FROM:TO:log".
    design : path, or sequence of mappings
        CSV file with a column for each key and a row for each design, or a mapping of values for each design.
    sample : int
        Number of designs of a Latin hypercube over the ranges of `vary`.
    keep_fill_factor : bool
        Whether the detectors' width follows a varied pitch.
    couple_netd : bool
        Whether the sensor's NETD follows aperture and detectors: NETD ∝ (f-number)² / (area of a detector).
    minimise, maximise : sequence of str
        Columns that are best when low or high, for the trade-off front: varied keys, "delta_t_mk",
        "threshold_snr", "acuity_mrad", "acuity_detectors". The first orders the designs.
    acuity_snr, acuity_delta_t_mk : float, optional
        Signal of a large triangle for which the smallest visible size is interpolated, as an SNR or in mK.
    observer, p_correct, tolerance, plan, rng
        As for `curve`; the seed is also that of `sample`.
    workers : int
        Processes to compute in. A script then calls this below `if __name__ == "__main__":`.
    cluster : str or Engine, optional
        Address of a Dask scheduler or "local:N", instead of `workers`.
    store : Store, optional
        Thresholds that an earlier run has computed; this one adds its own.
    progress : function of an int, optional
        Called with the number of designs × sizes that were just done.

    Returns
    -------
    SweepResult
        A row for each design and size by `table()` or `to_dataframe()`; `plot_map()`, `plot_front()`, `save()`.

    Raises
    ------
    SettingsError
        If a setting, key or range is invalid, or the observer is not linear.
    DataError
        If a file of designs is invalid.

    Examples
    --------
    >>> import sensor_sim as ss
    >>> camera = "sample_frames/staring_camera.toml"
    >>> vary = {"optics.aperture_mm": "110:220:2", "noise.netd_mk": [16, 32]}
    >>> result = ss.sweep(camera, size_detectors=[6], vary=vary, tolerance=0.1)
    >>> [round(row["delta_t_mk"]) for row in result.records()]
    [12, 25, 10, 21]
    """
    started, seed = time.perf_counter(), seed_of(rng)
    from sensor_sim.sweeps.designs import Base, check_coupling, make_designs
    from sensor_sim.sweeps.result import SweepResult
    from sensor_sim.sweeps.tables import Criterion, objectives
    from sensor_sim.sweeps.work import SweepWork, Variants, check_sweep, run_sweep
    from todframes.jobs.engine import open_engine

    judge, settings = described(observer)
    sensor = sensor if isinstance(sensor, Sensor) else load_sensor(sensor)
    sizes = [float(size) for size in size_detectors]
    check_sweep(sensor, judge, sizes, p_correct=p_correct, tolerance=tolerance)
    observers = Variants.of(judge)
    base = Base(sensor, observers.settings, keep_fill_factor, couple_netd)
    designs = make_designs(base, vary=vary, design=design, sample=sample, seed=seed)
    if couple_netd:
        check_coupling(sensor, designs.keys)
    has_netd = sensor.noise.netd_mk is not None or "noise.netd_mk" in designs.keys
    criterion = Criterion.of(acuity_snr, acuity_delta_t_mk, has_netd=has_netd)
    goals = objectives(minimise, maximise, designs.keys, has_netd=has_netd, has_acuity=criterion is not None)
    work = SweepWork(observers=observers, p_correct=p_correct, tolerance=tolerance, seed=seed, plan=plan)
    with open_engine(cluster, workers) as engine:
        swept = run_sweep(base, designs, sizes, work, engine, store=store, progress=progress)
    settings |= {
        "p_correct": p_correct,
        "size_detectors": sizes,
        "vary": {key: one if isinstance(one, str) else list(one) for key, one in (vary or {}).items()},
        "design": str(design) if isinstance(design, Path | str) else None,
        "sample": sample,
        "keep_fill_factor": keep_fill_factor,
        "couple_netd": couple_netd,
        "minimise": [one.column for one in goals if one.sign > 0],
        "maximise": [one.column for one in goals if one.sign < 0],
        "acuity_snr": acuity_snr,
        "acuity_delta_t_mk": acuity_delta_t_mk,
        "sensor": asdict(sensor),
        "tolerance": tolerance,
        "plan": plan,
    }
    return SweepResult(
        swept=swept,
        objectives=goals,
        criterion=criterion,
        whole_keys=tuple(key for key in designs.keys if base.keys[key]),
        settings=settings,
        seed=seed,
        from_store=0 if store is None else store.n_used,
        run_time_s=round(time.perf_counter() - started, 4),
    )


def simulate(
    sensor: Sensor | Path | str,
    *,
    size_detectors: Sequence[float],
    snr: Sequence[float],
    out: Path | str,
    trials: int = 40,
    rng: Rng = 1,
    frame_format: FrameFormat = "exr",
    allow_clipping: bool = False,
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
        Folder to make, new or empty.
    trials : int
        Frames of each size and SNR.
    rng : int, SeedSequence or Generator
        Seed of all random draws.
    frame_format : {"exr", "png"}
        Half-float EXR in cd/m², or 16-bit PNG.
    allow_clipping : bool
        Let PNG clip more than 1 % of the pixels.
    stages : bool
        Also write the stages of a trial with the highest SNR as pictures.
    workers : int
        Processes that draw frames. With more than one, a script calls this below `if __name__ == "__main__":`,
        because they import the script.
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
    seed = seed_of(rng)
    from sensor_sim.chain.simulation import plan_trials, write_dataset
    from todframes.base.output import Going, new_folder, store_path
    from todframes.jobs.engine import open_engine
    from todframes.jobs.store import Store

    sensor = sensor if isinstance(sensor, Sensor) else load_sensor(sensor)
    planned = plan_trials([float(one) for one in size_detectors], [float(one) for one in snr], trials)
    going = Going(restart=restart, keep=keep_store)
    with (
        open_engine(cluster, workers) as engine,
        new_folder(str(out), going=going) as folder,
        closing(Store(store_path(folder), str(out), tell)) as store,
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


def explore(
    sensor: Sensor | Path | str,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    open_browser: bool = True,
    tell: Callable[[str], None] = print,
    warn: Callable[[str], None] | None = None,
) -> None:
    """Serve a page on which a sensor's parameters move, and its TOD curve with them, as `sensor-sim explore` does.

    The call returns when Ctrl-C is pressed, or the process is asked to end.

    Parameters
    ----------
    sensor : Sensor or path
        Settings to begin with, or the path of a SENSOR.toml.
    host, port : str, int
        Address or name of this machine to listen at; port 0 is a free one.
    open_browser : bool
        Whether to open the page in the browser.
    tell : function of a text
        Called with the address of the page when the server listens; only who knows it gets the page.
    warn : function of a text, optional
        Called with a remark if other machines can reach the server.

    Raises
    ------
    SettingsError
        If a setting is invalid, the server cannot listen there, or Starlette or uvicorn is not installed.
    """
    from todframes.web import check_installed

    sensor = sensor if isinstance(sensor, Sensor) else load_sensor(sensor)
    check_installed("explore")
    from sensor_sim.explorer.routes import Explorer
    from todframes.web.server import Launch, serve

    launch = Launch(host=host, port=port, open_browser=open_browser)
    serve(Explorer(sensor).app(), launch, tell=tell, warn=warn)
