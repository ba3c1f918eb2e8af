"""The call `sweep`: the thresholds of many designs of a sensor."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from sensor_sim.chain.sensor import Sensor, sensor_of, sensor_settings
from todframes.base.errors import SettingsError, argument
from todframes.base.seeds import Rng, seed_of
from todframes.observers.interface import Observer, adapted, described
from todframes.scoring.error_budget import PlanName

if TYPE_CHECKING:
    from sensor_sim.sweeps.designs import Designs
    from sensor_sim.sweeps.ranges import Aim
    from sensor_sim.sweeps.result import SweepResult
    from todframes.field.atmosphere import Atmosphere
    from todframes.field.target import Target
    from todframes.jobs.store import Store
    from todframes.jobs.work import Engine


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
    target: Target | Path | str | None = None,
    atmosphere: Atmosphere | Path | str | None = None,
    k: float | None = None,
    places: int = 1,
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

    The numbers of each design are those that `curve` gives for it alone. Parts that designs share are computed
    once.

    Parameters
    ----------
    sensor : Sensor or path
        Settings of all designs except the varied ones, or the path of a SENSOR.toml.
    size_detectors : sequence of float
        Sizes √(area) in detector pitches, without repetitions; tables are ordered by the first one.
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
        "threshold_snr", "acuity_mrad", "acuity_detectors", "range_km". The first orders the designs.
    acuity_snr, acuity_delta_t_mk : float, optional
        Signal of a large triangle for which the smallest visible size is interpolated, as an SNR or in mK.
    target : Target or path, optional
        Target in the field, as for `todframes.acquisition_range`: the range of its first task is given too.
    atmosphere : Atmosphere or path, optional
        Air to the target, which a target needs.
    k : float, optional
        In place of the target's k: the target is seen if a triangle of size / k is.
    places, observer, p_correct, tolerance, plan, rng
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
    from sensor_sim.sweeps.designs import NETD, Base, check_coupling, make_designs
    from sensor_sim.sweeps.result import SweepResult
    from sensor_sim.sweeps.tables import Criterion, objectives
    from sensor_sim.sweeps.work import SweepWork, Variants, check_sweep, run_sweep
    from sensor_sim.thresholds.places import check_places
    from todframes.jobs.engine import open_engine

    judge, settings = described(observer)
    sensor = sensor_of(sensor)
    sizes = [float(size) for size in size_detectors]
    seen = adapted(judge, lambda: sensor.display.background_luminance_cd_m2)
    check_places(sensor, places)
    check_sweep(sensor, seen, sizes, p_correct=p_correct, tolerance=tolerance)
    observers = Variants.of(judge)
    designs = make_designs(
        Base(sensor, observers.settings, keep_fill_factor), vary=vary, design=design, sample=sample, seed=seed
    )
    # A file states that its NETD follows the light; designs with NETDs of their own have these.
    couple_netd = couple_netd or (sensor.noise.couple_netd and NETD not in designs.keys)
    base = Base(sensor, observers.settings, keep_fill_factor, couple_netd)
    if couple_netd:
        check_coupling(sensor, designs.keys)
    if sensor.level != "snr" and (acuity_snr is not None or acuity_delta_t_mk is not None):
        raise SettingsError("acuity: found an SNR or a ΔT for a camera that counts photons, expected none")
    has_netd = sensor.noise.netd_mk is not None or "noise.netd_mk" in designs.keys
    criterion = Criterion.of(acuity_snr, acuity_delta_t_mk, has_netd=has_netd)
    aim = _aim(target, atmosphere, k, level=sensor.level, has_netd=has_netd, p_correct=p_correct)
    goals = objectives(
        minimise,
        maximise,
        designs.keys,
        has_netd=has_netd,
        has_acuity=criterion is not None,
        has_range=aim is not None,
        level=sensor.level,
    )
    work = SweepWork(
        observers=observers, p_correct=p_correct, tolerance=tolerance, seed=seed, plan=plan, places=places
    )
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
        "target": None if aim is None else asdict(aim.target),
        "atmosphere": None if aim is None else asdict(aim.atmosphere),
        "sensor": sensor_settings(sensor),
        "tolerance": tolerance,
        "plan": plan,
    }
    settings |= {"places": places} if places > 1 else {}
    return SweepResult(
        swept=swept,
        objectives=goals,
        criterion=criterion,
        aim=aim,
        whole_keys=tuple(key for key in designs.keys if base.keys[key]),
        settings=settings,
        seed=seed,
        from_store=0 if store is None else store.n_used,
        run_time_s=round(time.perf_counter() - started, 4),
    )


def _aim(
    target: Target | Path | str | None,
    atmosphere: Atmosphere | Path | str | None,
    k: float | None,
    *,
    level: str,
    has_netd: bool,
    p_correct: float,
) -> Aim | None:
    """Return the target and air of the range; None if there is no target.

    Raises
    ------
    SettingsError
        If one of them is missing or invalid, or the thresholds are SNRs and NETD is not known.
    """
    from sensor_sim.sweeps.ranges import chosen_aim

    aim = chosen_aim(target, atmosphere, k)
    if aim is None:
        return None
    if level == "snr" and not has_netd:
        raise SettingsError(f"{argument.target}: needs noise.netd_mk of the sensor")
    aim.check(p_correct, quantity="delta_t_k" if level == "snr" else "contrast")
    return aim
