"""The call `sweep`: the thresholds of many designs of a sensor."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass, replace
from itertools import chain
from pathlib import Path

from sensor_sim.chain.sensor import Sensor, sensor_of, sensor_settings
from sensor_sim.chain.vary import NETD, holds_netd
from sensor_sim.sweeps.designs import Base, SweepWork, Swept, check_sweep, make_designs, run_sweep
from sensor_sim.sweeps.goals import OF_ACUITY, OF_RANGE, chosen_aim, columns_of, objectives
from sensor_sim.sweeps.result import Sweep
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_positive, checked
from todframes.base.seeds import Rng, seed_of
from todframes.field.atmosphere import Atmosphere
from todframes.field.target import Target
from todframes.jobs.rows import Rows
from todframes.jobs.run import opened_run
from todframes.jobs.work import Engine
from todframes.observers.interface import Observer, adapted, resolve_observer
from todframes.parameters import (
    Cluster,
    Columns,
    Count,
    DesignFile,
    MilliKelvin,
    NamedFile,
    Numbers,
    ObserverName,
    PlanName,
    Probability,
    Progress,
    Ranges,
    Seed,
    SensorFile,
    SignalToNoise,
    TargetFactor,
    Tolerance,
)
from todframes.results.advice import MISSED
from todframes.results.data import Record, ResultWarning, as_read
from todframes.results.wording import count


@checked
def sweep(
    sensor: Sensor | SensorFile,
    *,
    size_detectors: Numbers,
    vary: Ranges | Mapping[str, str | Sequence[float]] | None = None,
    design: DesignFile | Sequence[Mapping[str, float]] | None = None,
    sample: Count | None = None,
    keep_fill_factor: bool = False,
    couple_netd: bool = False,
    minimise: Columns = (),
    maximise: Columns = (),
    acuity_snr: SignalToNoise | None = None,
    acuity_delta_t_mk: MilliKelvin | None = None,
    target: Target | NamedFile | None = None,
    atmosphere: Atmosphere | NamedFile | None = None,
    k: TargetFactor | None = None,
    observer: ObserverName | Observer = "pyramid",
    p_correct: Probability = 0.75,
    tolerance: Tolerance = 2e-3,
    plan: PlanName = "needed",
    rng: Seed | Rng = 1,
    workers: Count = 1,
    cluster: Cluster | Engine | None = None,
    store: Rows | Path | str | None = None,
    progress: Progress | None = None,
) -> Sweep:
    """Compute the thresholds of many designs of a sensor, and which are the best trade-offs.

    A design differs from the sensor's file in the values of some keys. An impossible design gets a status and the
    reason; the others are computed.

    Parameters
    ----------
    sensor : Sensor or path
        File with all that the designs have in common.
    size_detectors : sequence of float
        Sizes √(area) in detector pitches, each once; tables are ordered by the first one.
    vary : mapping
        Values of a number in SENSOR.toml (optics.aperture_mm) or of the observer (observer.internal_noise); all
        combinations of several are computed. With `sample`, the form is FROM:TO or FROM:TO:log.

        A sequence of values is taken as well.
    design : path, or sequence of mappings
        Designs from a CSV file instead: a column for each key, a row for each design.

        A mapping of values for each design is taken as well.
    sample : int
        Number of designs that cover the ranges of `vary` evenly (Latin hypercube).
    keep_fill_factor : bool
        Let the detectors' width follow a varied pitch.
    couple_netd : bool
        Let the NETD follow aperture and detectors: NETD ∝ f-number² / area of a detector.
    minimise : sequence of str
        Columns to be low for the trade-off front: varied keys, delta_t_mk, threshold_snr, threshold_contrast,
        acuity_mrad, acuity_detectors, range_km. The first orders the designs. Default: delta_t_mk; with `target`,
        range_km is high.
    maximise : sequence of str
        Columns to be high for the trade-off front.
    acuity_snr : float, optional
        Give the smallest size visible at this SNR of a large triangle.
    acuity_delta_t_mk : float, optional
        Give the smallest size visible at this ΔT of a large triangle, in mK.
    target : Target or path, optional
        Give the range of this target in the field, for its first task, as `todframes range` does.
    atmosphere : Atmosphere or path, optional
        Air to the target, which a target needs.
    k : float, optional
        The target is seen if a triangle of size / K is, in place of the target's own K.
    observer : str or Observer
        Observer by name: pyramid, informative, csf or another that is registered; or MODULE:CLASS, a class of your
        own, whose code is run. It must be linear.
    p_correct : float
        Raw proportion correct at threshold.
    tolerance : float
        Relative error of the thresholds to reach.
    plan : {"needed", "full"}
        Leave out what the sensor does not need, or nothing.
    rng : int, SeedSequence or Generator
        Seed of all random draws, also of `sample`.
    workers : int
        Processes that share the work.
    cluster : str or Engine, optional
        Work on a Dask cluster: the address of its scheduler, tcp://….
    store : path, optional
        Folder for finished thresholds, so that an interrupted run can be continued.
    progress : function of two ints, optional
        Called with the number of thresholds that are done, and of all.

    Returns
    -------
    Result
        A row for each design and size by `records()` or `to_dataframe()`; `plot_map()`, `plot_front()`, `save()`.

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
    judge, settings = resolve_observer(observer)
    sensor = sensor_of(sensor)
    if couple_netd and sensor.noise.netd_mk is None:
        raise SettingsError(f"{argument.couple_netd}: needs {NETD} of the sensor")
    sizes = [float(size) for size in size_detectors]
    seen = adapted(judge, lambda: sensor.display.background_luminance_cd_m2)
    check_sweep(sensor, seen, sizes, p_correct=p_correct, tolerance=tolerance)
    own_settings = getattr(judge, "settings", None)
    varied = own_settings if is_dataclass(own_settings) else None
    coupled = replace(sensor, noise=replace(sensor.noise, couple_netd=True)) if couple_netd else sensor
    base = Base(coupled, varied, keep_fill_factor)
    designs = make_designs(base, vary=vary, design=design, sample=sample, seed=seed)
    if couple_netd and NETD in designs.keys:
        raise SettingsError(
            f"{argument.couple_netd}: found {NETD} among the keys, expected it to follow aperture and detectors"
        )
    base.check_moves(designs)
    couple_netd = base.sensor.noise.couple_netd and NETD not in designs.keys
    has_netd = sensor.noise.netd_mk is not None or NETD in designs.keys
    acuities = {"acuity_snr": acuity_snr, "acuity_delta_t_mk": acuity_delta_t_mk}
    given = {name: value for name, value in acuities.items() if value is not None}
    if len(given) > 1:
        raise SettingsError("acuity: found an SNR and a ΔT, expected one of them")
    if given and sensor.level != "snr":
        raise SettingsError("acuity: found an SNR or a ΔT for a camera that counts photons, expected none")
    for name, value in given.items():
        check_positive(name, value)
    if acuity_delta_t_mk is not None and not has_netd:
        raise SettingsError("acuity_delta_t_mk: needs noise.netd_mk of the sensor")
    target_in_air = chosen_aim(target, atmosphere, k)
    if target_in_air is not None:
        if sensor.level == "snr" and not has_netd:
            raise SettingsError(f"{argument.target}: needs noise.netd_mk of the sensor")
        target_in_air.check(p_correct, quantity="delta_t_k" if sensor.level == "snr" else "contrast")
    needs = {} if has_netd else {"delta_t_mk": f"{NETD} of the sensor"}
    needs |= {} if given else dict.fromkeys(OF_ACUITY, "an SNR or ΔT for the acuity")
    needs |= {} if target_in_air is not None else {OF_RANGE: "a target and an atmosphere"}
    goals = objectives(minimise, maximise, designs.keys, level=sensor.level, needs=needs)
    work = SweepWork(observer=judge, p_correct=p_correct, tolerance=tolerance, seed=seed, plan=plan)
    with opened_run(workers, cluster, store, progress) as run:
        swept = run_sweep(base, designs, sizes, work, run)
    settings |= {
        "p_correct": p_correct,
        "size_detectors": sizes,
        "vary": {key: values if isinstance(values, str) else list(values) for key, values in (vary or {}).items()},
        "design": str(design) if isinstance(design, Path | str) else None,
        "sample": sample,
        "keep_fill_factor": keep_fill_factor,
        "couple_netd": couple_netd,
        "minimise": [name for name, sign in goals.items() if sign > 0],
        "maximise": [name for name, sign in goals.items() if sign < 0],
        **acuities,
        "target": None if target_in_air is None else asdict(target_in_air.target),
        "atmosphere": None if target_in_air is None else asdict(target_in_air.atmosphere),
        "sensor": sensor_settings(sensor),
        "tolerance": tolerance,
        "plan": plan,
    }
    columns = columns_of(
        designs,
        swept,
        goals,
        sizes=sizes,
        level=sensor.level,
        **acuities,
        target_in_air=target_in_air,
        p_correct=p_correct,
        couple_netd=couple_netd,
        whole_keys=[key for key in designs.keys if base.keys[key]],
    )
    return Sweep.made(
        "sweep",
        started,
        seed=seed,
        warnings=missed_tolerance(swept, tolerance),
        settings=as_read(settings, Record),
        columns=columns,
        keys=designs.keys,
        n_designs=len(designs.values),
        n_computed=swept.n_computed,
        from_store=run.n_from_store,
        holds_netd=NETD not in designs.keys
        and any(not isinstance(each, str) and holds_netd(coupled, each[0]) for each in swept.made),
    )


def missed_tolerance(swept: Swept, tolerance: float) -> tuple[ResultWarning, ...]:
    """Return a warning if the numerical error of thresholds misses the tolerance."""
    known = chain.from_iterable(swept.thresholds)
    shares = [(each.numerical_error or 0.0) / each.threshold for each in known if each.threshold]
    missed = [share for share in shares if share > MISSED * tolerance]
    if not missed:
        return ()
    largest = max(missed)
    message = (
        f"{count(len(missed), 'threshold')} {'misses' if len(missed) == 1 else 'miss'} the tolerance of "
        f"{100 * tolerance:g} %: the numerical error is up to {100 * largest:.2g} %; larger sizes "
        "have smaller errors"
    )
    return (ResultWarning(code="numerical_error", message=message, found=largest, expected=tolerance),)
