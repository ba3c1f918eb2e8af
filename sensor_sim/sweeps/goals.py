"""Goals of a sweep: acuity, range and trade-off front of designs, as columns beside their thresholds."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensor_sim.chain.camera import Camera
from sensor_sim.chain.sensor import Sensor
from sensor_sim.sweeps.designs import NAME_COLUMN, Designs, Swept
from todframes.base._typing import FloatArray
from todframes.base.errors import DataError, SettingsError, argument
from todframes.base.reading import check_keys
from todframes.field.acquisition import TaskRange, first_range
from todframes.field.atmosphere import Atmosphere, find_atmosphere
from todframes.field.target import Quantity, Target, chosen_target
from todframes.field.threshold_curve import ThresholdCurve
from todframes.psychometrics.threshold_search import IMPOSSIBLE

BY_SIZE = ("threshold_snr", "threshold_contrast", "delta_t_mk")
"""Columns with a separate value for each size."""

OF_ACUITY = ("acuity_detectors", "acuity_mrad")

OF_RANGE = "range_km"

Columns = dict[str, list[Any]]

UNITS = {"cd_m2": "cd/m²", "mrad": "mrad", "mm": "mm", "um": "µm", "mk": "mK", "ms": "ms", "px": "px", "lx": "lx"}
UNITS |= {"km": "km", "detectors": "detectors"}
"""Units by the end of a key."""

WORDS = {"delta_t": "threshold ΔT", "threshold_snr": "threshold SNR", "netd": "NETD", "f_number": "f-number"}

SWEEP = "the sweep"
"""Name of the curves in messages."""


class Aim(NamedTuple):
    """The target and the air for which designs are compared."""

    target: Target
    atmosphere: Atmosphere

    def check(self, p_correct: float, *, quantity: Quantity = "delta_t_k", name: str = SWEEP) -> None:
        """Raise SettingsError if target or air cannot be used with a TOD in a quantity."""
        sizes = np.array([2.0, 1.0])
        first_range(
            ThresholdCurve.of_sizes(sizes, 2.0 / sizes, p_correct=p_correct, quantity=quantity, name=name), *self
        )

    def range_of(
        self,
        size_mrad: FloatArray,
        threshold: FloatArray,
        status: Sequence[str],
        p_correct: float,
        quantity: Quantity = "delta_t_k",
    ) -> TaskRange | None:
        """Return the range of a design from its thresholds, NaN where there is none, in any order of sizes; None
        for less than two thresholds.
        """
        known = np.flatnonzero(np.isfinite(threshold))
        known = known[np.argsort(-size_mrad[known])]
        own = {"p_correct": p_correct, "quantity": quantity, "name": SWEEP}
        unreached = size_mrad[np.asarray(status) == "never_reached"].tolist()
        try:
            curve = ThresholdCurve.of_sizes(size_mrad[known], threshold[known], unreached_mrad=unreached, **own)
            return first_range(curve, *self)
        except DataError:
            return None


def chosen_aim(
    target: Target | Path | str | None, atmosphere: Atmosphere | Path | str | None, k: float | None
) -> Aim | None:
    """Return the target and the air of these names or files; None if there is no target. SettingsError if one of
    them is missing or invalid.
    """
    if target is None:
        for name, value in ((argument.atmosphere, atmosphere), (argument.k, k)):
            if value is not None:
                raise SettingsError(f"{name}: is given but not used without {argument.target}")
        return None
    if atmosphere is None:
        raise SettingsError(f"{argument.atmosphere}: is missing, expected it beside {argument.target}")
    return Aim(chosen_target(target, k=k), find_atmosphere(atmosphere))


def in_words(key: str) -> tuple[str, str]:
    """Return the name and the unit of a key or column: ("aperture", "mm") for optics.aperture_mm."""
    name = key.rpartition(".")[2]
    ending = next((unit for unit in UNITS if name.endswith(f"_{unit}")), "")
    name = name.removesuffix(f"_{ending}").removesuffix("_sigma")
    return WORDS.get(name, name.replace("_", " ")), UNITS.get(ending, "")


def heading(key: str) -> str:
    """Return a key or column as a heading: "aperture (mm)"."""
    name, unit = in_words(key)
    return f"{name} ({unit})" if unit else name


def phrase(key: str, value: float) -> str:
    """Return a key or column with a value: "aperture 110 mm"."""
    name, unit = in_words(key)
    return f"{name} {value:.4g} {unit}".rstrip()


class Acuity(NamedTuple):
    """Smallest size whose threshold is at most the criterion, with the numerical error of its 95 % interval.
    `status` is "ok", "never_reached" if no size computed reaches the criterion, "always_exceeded" if the smallest
    one does, or "too_few_sizes" if there is no threshold beside the crossing. Only with "ok" is there a size.
    """

    status: str
    detectors: float = math.nan
    error: float = math.nan


def acuity(
    size_detectors: FloatArray, threshold: FloatArray, error: FloatArray, status: Sequence[str], criterion: float
) -> Acuity:
    """Interpolate the size at which thresholds fall to a criterion > 0, by a straight line between logarithms.
    Arrays have the shape (sizes,), with NaN where there is no threshold. The error is that of the two thresholds
    beside the crossing, as if both deviate to the same side, without the difference of the curve from a straight
    line.
    """
    order = np.argsort(size_detectors)
    size, value, spread = size_detectors[order], threshold[order], error[order]
    # Where a threshold is never reached none is low enough, and where it is always exceeded any is.
    for number, of_size in enumerate(status[k] for k in order):
        if of_size != "ok":
            value[number] = {"never_reached": math.inf, "always_exceeded": 0.0}.get(of_size, math.nan)
    reached = value <= criterion
    if not reached.any():
        return Acuity("too_few_sizes" if np.isnan(value).any() else "never_reached")
    first = int(np.argmax(reached))
    if first == 0:
        return Acuity("always_exceeded")
    x, y = np.log(size[first - 1 : first + 1]), value[first - 1 : first + 1]
    if not (np.isfinite(y).all() and y[1] > 0.0):
        return Acuity("too_few_sizes")
    y, spread = np.log(y), spread[first - 1 : first + 1] / y
    slope = (x[1] - x[0]) / (y[1] - y[0])
    share = (math.log(criterion) - y[0]) / (y[1] - y[0])
    detectors = math.exp(x[0] + share * (x[1] - x[0]))
    change = abs(slope) * ((1.0 - share) * spread[0] + share * spread[1])
    return Acuity("ok", detectors, detectors * float(change))


def front(costs: FloatArray) -> NDArray[np.bool_]:
    """Return which rows of costs, (n, columns), are on the trade-off front: no other is as low in all columns and
    lower in one. A row with a NaN is not on the front.
    """
    is_on = np.zeros(len(costs), dtype=bool)
    known = np.flatnonzero(np.isfinite(costs).all(axis=1))
    # A row can only be dominated by one that comes before it in this order, and then by one of the front.
    known = known[np.lexsort(costs[known].T[::-1])]
    best = np.empty((0, costs.shape[1]))
    for row in known:
        below = (best <= costs[row]).all(axis=1)
        if not (below & (best < costs[row]).any(axis=1)).any():
            is_on[row] = True
            best = np.vstack([best, costs[row]])
    return is_on


def objectives(
    minimise: Sequence[str],
    maximise: Sequence[str],
    keys: Sequence[str],
    *,
    level: str,
    needs: Mapping[str, str],
) -> dict[str, int]:
    """Return the columns of the trade-off front, 1 if one is to be low and −1 if high; without any, the range, ΔT,
    or if NETD is not known, the level. SettingsError if there is no such column, or it would be empty: `needs` has
    what such columns need.
    """
    if not (minimise or maximise):
        by_level = f"threshold_{level}" if "delta_t_mk" in needs else "delta_t_mk"
        return {by_level: 1} if OF_RANGE in needs else {OF_RANGE: -1}
    for where, names in ((argument.minimise, minimise), (argument.maximise, maximise)):
        check_keys(names, [f"threshold_{level}", "delta_t_mk", *OF_ACUITY, OF_RANGE, *keys], where)
        for name in (name for name in names if name in needs):
            raise SettingsError(f"{where}: found {name}, which needs {needs[name]}")
    goals = dict.fromkeys(minimise, 1) | dict.fromkeys(maximise, -1)
    if len(goals) < len(minimise) + len(maximise):
        raise SettingsError(f"{argument.minimise}, {argument.maximise}: found a column twice, expected each once")
    return goals


def columns_of(
    designs: Designs,
    swept: Swept,
    goals: Mapping[str, int],
    *,
    sizes: Sequence[float],
    level: str,
    acuity_snr: float | None,
    acuity_delta_t_mk: float | None,
    target_in_air: Aim | None,
    p_correct: float,
    couple_netd: bool,
    whole_keys: Sequence[str],
) -> Columns:
    """Return the table of a sweep by column: a value for each design and size, those of a design together; None
    where there is none. Thresholds are in SNR, or in contrast (`level`) for cameras that count photons. With
    `couple_netd` each design has its own NETD. The values of `whole_keys` are whole numbers.
    """

    def of_designs(value: Callable[[Sensor, Camera], float | None]) -> FloatArray:
        made = [None if isinstance(each, str) else value(*each[:2]) for each in swept.made]
        return np.array(made, np.float64)

    def of_thresholds(name: str) -> list[list[Any]]:
        return [[getattr(threshold, name) for threshold in row] for row in swept.thresholds]

    n_designs, size, status = len(designs.values), np.array(sizes), of_thresholds("status")
    pitch = of_designs(lambda _, camera: camera.pitch_mrad)
    mk_per_snr = of_designs(lambda _, camera: camera.mk_per_snr)
    threshold, error = (np.array(of_thresholds(name), np.float64) for name in ("threshold", "numerical_error"))
    delta_t_mk = threshold * mk_per_snr[:, None]
    columns: dict[str, Any] = {"design": range(1, n_designs + 1)}
    if designs.names is not None:
        columns[NAME_COLUMN] = designs.names
    for key, values in zip(designs.keys, designs.values.T, strict=True):
        columns[key] = [int(value) for value in values] if key in whole_keys else values
    if couple_netd:
        columns["netd_mk"] = of_designs(lambda sensor, _: sensor.noise.netd_mk)
    columns["size_detectors"] = np.broadcast_to(size, threshold.shape)
    columns |= {"size_scene_mrad": pitch[:, None] * size, "status": status}
    columns |= {f"threshold_{level}": threshold, f"threshold_{level}_error": error}
    if np.isfinite(mk_per_snr).any():
        columns |= {"delta_t_mk": delta_t_mk, "delta_t_mk_error": error * mk_per_snr[:, None]}
    at_snr = acuity_snr if acuity_delta_t_mk is None else acuity_delta_t_mk / mk_per_snr
    if at_snr is not None:
        acuities = [
            Acuity(IMPOSSIBLE) if math.isnan(own) else acuity(size, *of_design)
            for own, *of_design in zip(
                pitch, threshold, error, status, np.broadcast_to(at_snr, n_designs), strict=True
            )
        ]
        for name, values in (
            ("", np.array([acuity.detectors for acuity in acuities])),
            ("_error", np.array([acuity.error for acuity in acuities])),
        ):
            columns |= {f"acuity_detectors{name}": values, f"acuity_mrad{name}": values * pitch}
        columns["acuity_status"] = [acuity.status for acuity in acuities]
    if target_in_air is not None:
        quantity: Quantity = "delta_t_k" if level == "snr" else "contrast"
        in_quantity = delta_t_mk / 1000.0 if level == "snr" else threshold
        ranges = [
            None if math.isnan(own) else target_in_air.range_of(size * own, levels, each, p_correct, quantity)
            for own, levels, each in zip(pitch, in_quantity, status, strict=True)
        ]
        columns[OF_RANGE] = [reach and reach.range_km for reach in ranges]
        columns["range_at_least_km"] = [reach and reach.at_least_km for reach in ranges]
        missing = [IMPOSSIBLE if math.isnan(own) else "too_few_sizes" for own in pitch]
        columns["range_status"] = [
            reach.status if reach else why for reach, why in zip(ranges, missing, strict=True)
        ]
    columns["on_front"] = _on_front(columns, np.isfinite(threshold), goals)
    for name in ("n_phases", "reason"):
        columns[name] = [[value or None for value in row] for row in of_thresholds(name)]
    return {name: _of_rows(values, len(size)) for name, values in columns.items()}


def _on_front(columns: Columns, is_known: NDArray[np.bool_], goals: Mapping[str, int]) -> NDArray[np.bool_]:
    """Return which designs are on the trade-off front at each size: (designs, sizes)."""
    signed = [sign * np.asarray(columns[name], np.float64) for name, sign in goals.items()]
    costs = [np.broadcast_to(cost.reshape(len(cost), -1), is_known.shape) for cost in signed]
    compared = np.where(has_threshold(is_known, goals)[..., None], np.stack(costs, axis=2), np.nan)
    return np.stack([front(compared[:, number]) for number in range(is_known.shape[1])], axis=1)


def has_threshold(known: NDArray[np.bool_], goals: Iterable[str]) -> NDArray[np.bool_]:
    """Return which designs are compared at each size: those with a threshold there, or anywhere if no goal has a
    value for each size. Both have the shape (designs, sizes).
    """
    if any(name in BY_SIZE for name in goals):
        return known
    return np.broadcast_to(known.any(axis=1, keepdims=True), known.shape)


def _of_rows(values: Any, n_sizes: int) -> list[Any]:
    """Return values of designs, or of designs and sizes, as a column; NaN becomes None."""
    rows = values.tolist() if isinstance(values, np.ndarray) else list(values)
    of_rows = [value for row in rows for value in (row if isinstance(row, list | tuple) else [row] * n_sizes)]
    return [None if value != value else value for value in of_rows]
