"""The call `acquisition_range`: how far a person with a sensor can do a task."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.safe_text import in_utf8
from todframes.base.seeds import Rng, seed_of
from todframes.field.atmosphere import Atmosphere, find_atmosphere
from todframes.field.target import Target, chosen_target
from todframes.parameters import Cycles, CyclesPerSize, GroupValues, NamedFile, Seconds, Seed, TargetFactors
from todframes.results.result import Result, repeatable
from todframes.results.thresholds import Thresholds

if TYPE_CHECKING:
    from todframes.field.range_result import FieldRange
    from todframes.field.threshold_curve import RangeWarning, ThresholdCurve

TABLE_SUFFIX = ".csv"
"""End of the names of tables; any other path is that of a result."""


@repeatable
def acquisition_range(
    result: Result[Any] | Path | str,
    *,
    target: Target | NamedFile,
    atmosphere: Atmosphere | NamedFile,
    k: TargetFactors | float | Mapping[str, float] | None = None,
    cycles: Cycles | float | Mapping[str, float] | None = None,
    cycles_per_size: CyclesPerSize | None = None,
    search_time_s: Seconds | None = None,
    group: GroupValues | None = None,
    magnification: float | None = None,
    rng: Seed | Rng = 1,
) -> Result[FieldRange]:
    """Compute how far a person with a sensor can do a task, from a measured curve, and how sure that is.

    Parameters
    ----------
    result : Result or path
        result.json of `score`, `fit` or `sensor-sim curve`, or its folder, with thresholds over sizes (a TOD); or
        a table of a TOD, MRTD or MRC: a CSV file with a column size_mrad, frequency_cyc_per_mrad or
        frequency_cyc_per_deg, one of delta_t_k, delta_t_mk, contrast, mrtd_k, mrtd_mk and mrc, and, if they are
        known, ci95_low and ci95_high.

        A `Result` is taken as well.
    target : Target or path
        Target: a TOML file, or nato, nato_daylight, person or r46.

        A `Target` is taken as well.
    atmosphere : Atmosphere or path
        Air: a TOML file, or visible, swir, mwir or lwir with _23km or _5km behind, which are examples.

        An `Atmosphere` is taken as well.
    k : float, sequence of float, or mapping of str to float, optional
        For a TOD: a task is done if a triangle of size / K is judged, in place of the target's own K.

        A mapping has a K for each task.
    cycles : str, float or mapping of str to float, optional
        N50 in line pairs on the target in place of the target's own: stanag, johnson, or numbers.

        A mapping has a number for each task.
    cycles_per_size : float, optional
        Convert a TOD to line pairs: bars with this number of cycles in √(area) of a triangle are as hard.
    search_time_s : float, optional
        Time in s that the observer may search. Default: that of the target, or without limit.
    group : mapping, optional
        The curve of the result, if it has several: the value of a column that distinguishes it, such as
        algorithm=clahe.
    magnification : float, optional
        Angle on the display over the angle in the field, for sizes as displayed. Default: 1.
    rng : int, SeedSequence or Generator
        Seed of the curves that are drawn from the errors.

    Returns
    -------
    Result
        `numbers.ranges` has a record for each task and probability.

    Raises
    ------
    DataError
        If the result or table cannot be used.
    SettingsError
        If a setting is invalid, or target and air are not of the curve's kind.

    Examples
    --------
    >>> import tempfile, pathlib
    >>> import todframes as tod
    >>> table = pathlib.Path(tempfile.mkdtemp()) / "mrtd.csv"
    >>> text = "frequency_cyc_per_mrad,mrtd_k\\n1,0.054\\n3,0.4\\n5,2.97\\n"
    >>> _ = table.write_text(text)
    >>> found = tod.acquisition_range(table, target="nato", atmosphere=tod.Atmosphere(extinction_per_km=0.2))
    >>> [(one.task, round(one.range_km, 1)) for one in found.numbers.ranges if one.probability == 0.5]
    [('detection', 7.3), ('recognition', 3.1), ('identification', 1.6)]
    """
    started, seed = time.perf_counter(), seed_of(rng)
    if magnification is not None and not (math.isfinite(magnification) and magnification > 0.0):
        raise SettingsError(f"{argument.magnification}: found {magnification!r}, expected a number > 0")
    from todframes.field.acquisition import acquire
    from todframes.field.range_result import range_result

    aim = chosen_target(target, k=k, cycles=cycles, cycles_per_size=cycles_per_size, search_time_s=search_time_s)
    air = find_atmosphere(atmosphere)
    curve, warnings = _curve(result, aim, group, magnification)
    _check_used(curve, k=k, cycles=cycles, cycles_per_size=cycles_per_size)
    acquired = acquire(curve, aim, air, rng=np.random.default_rng(seed))
    facts = (*warnings, *_warnings(curve, air))
    return range_result(acquired, facts, seed=seed, started=started)


def _curve(
    result: Result[Any] | Path | str, aim: Target, group: Mapping[str, str] | None, magnification: float | None
) -> tuple[ThresholdCurve, tuple[RangeWarning, ...]]:
    from todframes.field.measured_curve import measured_curve
    from todframes.field.threshold_curve import read_curve
    from todframes.results.result import load_result

    of_result: dict[str, Any] = {"quantity": aim.quantity, "group": group, "magnification": magnification}
    if isinstance(result, Result):
        return measured_curve(_thresholds(result, "the result"), "the result", **of_result)
    where = in_utf8(str(result))
    if where.endswith(TABLE_SUFFIX):
        if group or magnification is not None:
            raise DataError(
                f"{where}: is a table of one curve in the field, expected no group and no magnification"
            )
        return read_curve(Path(result)), ()
    return measured_curve(_thresholds(load_result(result), where), where, **of_result)


def _thresholds(result: Result[Any], where: str) -> Thresholds:
    """Return the thresholds of a result; raise DataError if it has none."""
    if not isinstance(result.data, Thresholds):
        hint = "; its thresholds are in mrtd.csv, which `todframes range` reads" * (result.command == "mrtd")
        raise DataError(f"{where}: command: found {result.command!r}, expected one that gives thresholds{hint}")
    return result.data


def _check_used(curve: ThresholdCurve, **criteria: object) -> None:
    """Raise SettingsError if a criterion is given that the road does not use."""
    is_triangle, converts = curve.pattern == "triangle", criteria["cycles_per_size"] is not None
    unused = {
        "k": (not is_triangle, "of bars"),
        "cycles_per_size": (not is_triangle, "of bars"),
        "cycles": (is_triangle and not converts, f"of triangles, without {argument.cycles_per_size}"),
    }
    for name, (is_unused, pattern) in unused.items():
        if is_unused and criteria[name] is not None:
            where = getattr(argument, name)
            raise SettingsError(f"{where}: is given but not used: {curve.name} is a curve {pattern}")


def _warnings(curve: ThresholdCurve, air: Atmosphere) -> tuple[RangeWarning, ...]:
    from todframes.field.threshold_curve import RangeWarning

    found = []
    if not curve.is_rising:
        message = (
            "the curve falls somewhere towards finer detail; each threshold counts as at least that of all "
            "coarser detail"
        )
        found.append(RangeWarning(code="curve_not_rising", message=message))
    if air.varies_unseen and air.band_um is not None:
        low, high = air.band_um
        message = (
            f"one extinction for all ranges in {low:g} to {high:g} µm is wrong by up to a factor of 5 between 1 "
            "and 20 km; give a table of transmission over range"
        )
        found.append(RangeWarning(code="one_extinction", message=message))
    return tuple(found)
