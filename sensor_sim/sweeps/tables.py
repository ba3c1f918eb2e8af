"""The numbers of a sweep as columns, tables and sentences: acuity of each design, trade-off front, problems."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sensor_sim.sweeps.designs import FILL_FACTOR, NAME_COLUMN, NETD, PITCHES, WIDTHS
from sensor_sim.sweeps.ranges import Aim, DesignRange
from sensor_sim.sweeps.work import Swept
from todframes import __version__
from todframes.base._typing import FloatArray, Json
from todframes.base.errors import SettingsError, argument
from todframes.base.reading import check_keys, check_positive
from todframes.field.target import Quantity
from todframes.psychometrics.threshold_search import IMPOSSIBLE
from todframes.results.advice import MISSED
from todframes.results.data import json_file
from todframes.results.table import BLOCK, Column, LongRecords, Table
from todframes.results.wording import count, level_name, listed, plain, unknown_place

if TYPE_CHECKING:
    from pandas import DataFrame

BY_SIZE = ("threshold_snr", "threshold_contrast", "delta_t_mk")
"""Columns with a separate value for each size."""

OF_ACUITY = ("acuity_detectors", "acuity_mrad")

OF_RANGE = "range_km"

OF_ETENDUE = ("optics.aperture_mm", "optics.f_number", *WIDTHS, FILL_FACTOR)
"""Keys that change the light on a detector, besides the pitch if the fill factor is kept."""

ROWS_SHOWN = 20
"""Largest number of designs in the table for the terminal and the page."""

CRITERION_UNITS = {
    "threshold_snr": "",
    "threshold_contrast": "",
    "delta_t_mk": "mK",
    "acuity_detectors": "detectors",
    "acuity_mrad": "mrad",
    OF_RANGE: "km",
}


class Criterion(NamedTuple):
    """Signal of a large triangle for the acuity: an SNR (`level` "snr") or a ΔT in mK ("delta_t_mk")."""

    level: str
    value: float

    @classmethod
    def of(cls, snr: float | None, delta_t_mk: float | None, *, has_netd: bool) -> Criterion | None:
        """Return the criterion that one of the two values names; None if both are None.

        Raises
        ------
        SettingsError
            If both are given, a value is no number > 0, or NETD is not known for the one in mK.
        """
        given = {"snr": snr, "delta_t_mk": delta_t_mk}
        found = [cls(level, value) for level, value in given.items() if value is not None]
        if not found:
            return None
        if len(found) > 1:
            raise SettingsError("acuity: found an SNR and a ΔT, expected one of them")
        level, value = found[0]
        check_positive(f"acuity_{level}", value)
        if level == "delta_t_mk" and not has_netd:
            raise SettingsError("acuity_delta_t_mk: needs noise.netd_mk of the sensor")
        return found[0]


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
    """Interpolate the size at which thresholds fall to a criterion, by a straight line between logarithms.

    Parameters
    ----------
    size_detectors, threshold, error : ndarray, shape (sizes,)
        Sizes with their thresholds and numerical errors; NaN if there is none.
    status : sequence of str
        Status of each threshold.
    criterion : float
        > 0, in the unit of the thresholds.

    Returns
    -------
    Acuity
        Its error is that of the two thresholds beside the crossing, as if both deviate to the same side. It does
        not contain the difference of the curve from a straight line.
    """
    order = np.argsort(size_detectors)
    size, value, spread = size_detectors[order], threshold[order], error[order]
    # Where a threshold is never reached none is low enough, and where it is always exceeded any is.
    for place, of_size in enumerate(status[k] for k in order):
        if of_size != "ok":
            value[place] = {"never_reached": math.inf, "always_exceeded": 0.0}.get(of_size, math.nan)
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
    found = math.exp(x[0] + share * (x[1] - x[0]))
    change = abs(slope) * ((1.0 - share) * spread[0] + share * spread[1])
    return Acuity("ok", found, found * float(change))


def front(costs: FloatArray) -> NDArray[np.bool_]:
    """Return which rows are on the trade-off front: no other is as low in all columns and lower in one.

    Parameters
    ----------
    costs : ndarray, shape (n, columns)
        To be minimised; a row with a NaN is not on the front.

    Returns
    -------
    ndarray of bool, shape (n,)
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


class Objective(NamedTuple):
    """Column that is best at one end; `sign` is 1 if it is to be low and −1 if it is to be high."""

    column: str
    sign: int


@dataclass(frozen=True, eq=False, kw_only=True)
class SweepData:
    """Thresholds of many designs of a sensor, with methods that make tables and sentences of them.

    Attributes
    ----------
    swept : Swept
        The numbers, as arrays.
    objectives : tuple of Objective
        Columns of the trade-off front; the first one orders the designs.
    criterion : Criterion or None
        Signal for the acuity; None if none is asked for.
    aim : Aim or None
        Target and air of the range; None if none is asked for.
    whole_keys : tuple of str
        Varied keys whose values are whole numbers.
    settings : dict
        Settings of the sweep, its sensor and observer.
    seed : int
    from_store : int
        Number of thresholds that were not computed but found in the store of an earlier run.
    run_time_s : float
    """

    swept: Swept
    objectives: tuple[Objective, ...]
    criterion: Criterion | None
    aim: Aim | None
    whole_keys: tuple[str, ...]
    settings: Json
    seed: int
    from_store: int
    run_time_s: float

    def __repr__(self) -> str:
        return f"<Sweep: {' '.join(self.sentences())}>"

    @property
    def n_designs(self) -> int:
        """Number of designs, impossible ones included."""
        return len(self.swept.designs.values)

    @cached_property
    def acuities(self) -> list[Acuity] | None:
        """Acuity of each design; None if none is asked for."""
        if self.criterion is None:
            return None
        swept, in_mk = self.swept, self.criterion.level == "delta_t_mk"
        levels = self.criterion.value / (swept.mk_per_snr if in_mk else np.ones(self.n_designs))
        sizes = np.array(swept.size_detectors)
        return [
            Acuity(IMPOSSIBLE) if math.isnan(pitch) else acuity(sizes, *of_design)
            for pitch, *of_design in zip(
                swept.pitch_mrad, swept.threshold, swept.numerical_error, swept.status, levels, strict=True
            )
        ]

    @cached_property
    def ranges(self) -> list[DesignRange] | None:
        """Range of each design in the field; None if none is asked for."""
        if self.aim is None:
            return None
        swept, sizes, p_correct = self.swept, np.array(self.swept.size_detectors), self.settings["p_correct"]
        quantity: Quantity = "delta_t_k" if swept.level == "snr" else "contrast"
        thresholds = swept.delta_t_mk / 1000.0 if swept.level == "snr" else swept.threshold
        return [
            DesignRange(IMPOSSIBLE)
            if math.isnan(pitch)
            else self.aim.range_of(sizes * pitch, of_design, status, p_correct, quantity)
            for pitch, of_design, status in zip(swept.pitch_mrad, thresholds, swept.status, strict=True)
        ]

    def column(self, name: str, size: int) -> FloatArray:
        """Return the values of a column for each design, at one size by its place."""
        if name in BY_SIZE:
            values = self.swept.delta_t_mk if name == "delta_t_mk" else self.swept.threshold
            return np.asarray(values[:, size])
        if name in OF_ACUITY:
            detectors = np.array([one.detectors for one in self.acuities or ()])
            return detectors if name == OF_ACUITY[0] else detectors * self.swept.pitch_mrad
        if name == OF_RANGE:
            return np.array([one.range_km for one in self.ranges or ()])
        return self.swept.designs.values[:, self.swept.designs.keys.index(name)]

    @property
    def depends_on_size(self) -> bool:
        """Whether a column of the front has a value for each size; ranges and acuities have one a design."""
        return any(one.column in BY_SIZE for one in self.objectives)

    def has_threshold(self, size: int) -> NDArray[np.bool_]:
        """Return which designs are compared at a size, by its place: those with a threshold, there or anywhere."""
        known = np.isfinite(self.swept.threshold)
        return np.asarray(known[:, size] if self.depends_on_size else known.any(axis=1))

    @cached_property
    def on_front(self) -> NDArray[np.bool_]:
        """Mask of the designs on the trade-off front at each size: (designs, sizes)."""
        columns = []
        for size in range(len(self.swept.size_detectors)):
            costs = np.stack([one.sign * self.column(one.column, size) for one in self.objectives], axis=1)
            costs[~self.has_threshold(size)] = np.nan
            columns.append(front(costs))
        return np.stack(columns, axis=1)

    def records(self) -> Iterator[Json]:
        """Yield a record for each design and size, with the design's values in each."""
        swept, designs = self.swept, self.swept.designs
        has_netd = np.isfinite(swept.mk_per_snr).any()
        for row, values in enumerate(designs.values.tolist()):
            of_design: Json = {"design": row + 1}
            if designs.names is not None:
                of_design[NAME_COLUMN] = designs.names[row]
            of_design |= self._values(values)
            if self.settings["couple_netd"]:
                of_design["netd_mk"] = _known(swept.netd_mk[row])
            pitch = _known(swept.pitch_mrad[row])
            of_design_alone = self._acuity_record(row, pitch) | self._range_record(row)
            for place, size in enumerate(swept.size_detectors):
                threshold, error = swept.threshold[row, place], swept.numerical_error[row, place]
                mk = swept.mk_per_snr[row]
                in_mk = {"delta_t_mk": _known(threshold * mk), "delta_t_mk_error": _known(error * mk)}
                yield {
                    **of_design,
                    "size_detectors": size,
                    "size_scene_mrad": None if pitch is None else size * pitch,
                    "status": swept.status[row][place],
                    f"threshold_{swept.level}": _known(threshold),
                    f"threshold_{swept.level}_error": _known(error),
                    **(in_mk if has_netd else {}),
                    **of_design_alone,
                    "on_front": bool(self.on_front[row, place]),
                    "n_phases": int(swept.n_phases[row, place]) or None,
                    "reason": swept.reason[row][place] or None,
                }

    def _values(self, values: Sequence[float]) -> Json:
        """Return the values of a design by key, whole numbers as such."""
        found: Json = dict(zip(self.swept.designs.keys, values, strict=True))
        return found | {key: int(found[key]) for key in self.whole_keys}

    def _acuity_record(self, row: int, pitch: float | None) -> Json:
        if self.acuities is None:
            return {}
        found, scale = self.acuities[row], math.nan if pitch is None else pitch
        return {
            "acuity_detectors": _known(found.detectors),
            "acuity_detectors_error": _known(found.error),
            "acuity_mrad": _known(found.detectors * scale),
            "acuity_mrad_error": _known(found.error * scale),
            "acuity_status": found.status,
        }

    def _range_record(self, row: int) -> Json:
        if self.ranges is None:
            return {}
        status, range_km, at_least_km = self.ranges[row]
        values = {OF_RANGE: _known(range_km), "range_at_least_km": _known(at_least_km)}
        return values | {"range_status": status}

    def table(self) -> Table:
        """Return the table of all designs: a row for each design and size."""
        kinds = self._kinds()
        records = LongRecords(kinds, self.swept.threshold.size, self._blocks)
        return Table.of("All designs and sizes", "sweep.csv", kinds, records)

    def _kinds(self) -> dict[str, type]:
        """Return the type of each column."""
        texts = {NAME_COLUMN, "status", "acuity_status", "range_status", "reason"}
        whole = {"design", "n_phases", *self.whole_keys}
        return {
            key: str if key in texts else int if key in whole else bool if key == "on_front" else float
            for key in next(self.records())
        }

    def _blocks(self) -> Iterator[dict[str, list[Any]]]:
        """Yield the columns of some thousand records at a time."""
        records = self.records()
        while block := list(islice(records, BLOCK)):
            yield {key: [record[key] for record in block] for key in block[0]}

    def to_dataframe(self) -> DataFrame:
        """Return all designs as a pandas DataFrame with a row for each design and size.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        return self.table().to_dataframe()

    def best(self) -> Table | None:
        """Return the table of the designs on the trade-off front at the first size, or of the best ones, if any.

        Each design has one row, with its thresholds at all sizes.
        """
        swept, designs = self.swept, self.swept.designs
        first = self.objectives[0]
        cost = first.sign * self.column(first.column, 0)
        size = f" at {swept.size_detectors[0]:g} detectors" if self.depends_on_size else ""
        if len(self.objectives) > 1:
            rows = np.flatnonzero(self.on_front[:, 0])
            title = f"Trade-off front{size}"
        else:
            rows = np.flatnonzero(np.isfinite(cost) & self.has_threshold(0))
            title = f"Best designs{size}"
        rows = rows[np.argsort(cost[rows], kind="stable")]
        if not len(rows):
            return None
        if len(rows) > ROWS_SHOWN:
            title += f": the first {ROWS_SHOWN} of {len(rows)}"
        in_mk = np.isfinite(swept.mk_per_snr).any()
        shown, unit = (swept.delta_t_mk, "mK") if in_mk else (swept.threshold, level_name(swept.level))
        records = []
        for row in rows[:ROWS_SHOWN]:
            record: Json = {"design": int(row) + 1}
            if designs.names is not None:
                record[NAME_COLUMN] = designs.names[row]
            record |= self._values(designs.values[row].tolist())
            record |= {"netd_mk": _known(swept.netd_mk[row])} if self.settings["couple_netd"] else {}
            record |= {f"at_{place}": _known(value) for place, value in enumerate(shown[row])}
            record |= self._acuity_record(int(row), _known(swept.pitch_mrad[row])) | self._range_record(int(row))
            records.append(record)
        columns = [Column(key="design"), *([Column(key=NAME_COLUMN, rank=3)] if designs.names is not None else [])]
        # A narrow terminal first drops the larger sizes; what is varied stays.
        columns += [Column(key=key, header=_heading(key)) for key in designs.keys]
        columns += [Column(key="netd_mk", header="NETD mK")] if self.settings["couple_netd"] else []
        columns += [
            Column(key=f"at_{place}", header=f"{unit} at {of_size:g}", rank=min(place, 2))
            for place, of_size in enumerate(swept.size_detectors)
        ]
        if self.acuities is not None:
            columns += [Column(key=key, header=key.replace("_", " "), rank=1) for key in OF_ACUITY]
        if self.ranges is not None:
            columns += [Column(key=OF_RANGE, header="range km"), Column(key="range_status", rank=2)]
        return Table.of(title, "best.csv", columns, records)

    def problems(self) -> Table | None:
        """Return the table of statuses other than "ok" with their reasons, by frequency; None if all are "ok"."""
        found: Counter[tuple[str, str]] = Counter()
        first: dict[tuple[str, str], int] = {}
        for row, (of_status, of_reason) in enumerate(zip(self.swept.status, self.swept.reason, strict=True)):
            for pair in zip(of_status, of_reason, strict=True):
                if pair[0] != "ok":
                    found[pair] += 1
                    first.setdefault(pair, row + 1)
        if not found:
            return None
        records = [
            {"status": pair[0], "thresholds": number, "first_design": first[pair], "reason": pair[1] or None}
            for pair, number in found.most_common(ROWS_SHOWN)
        ]
        columns = [
            Column(key="status"),
            Column(key="thresholds"),
            Column(key="first_design"),
            Column(key="reason", wraps=True),
        ]
        table = Table.of("Designs and sizes without a threshold", "problems.csv", columns, records)
        return table.without_empty_columns()

    def sentences(self) -> list[str]:
        """Return the findings in words."""
        swept = self.swept
        known = np.isfinite(swept.threshold)
        sizes = count(len(swept.size_detectors), "size")
        found = [self._answer()]
        found.append(
            f"{count(self.n_designs, 'design')} at {sizes}: {int(known.sum())} of {known.size} thresholds found, "
            f"from {count(swept.n_computed, 'computation')}."
        )
        impossible = sum(one[0] == IMPOSSIBLE for one in swept.status)
        if impossible:
            first = next(row for row, one in enumerate(swept.status) if one[0] == IMPOSSIBLE)
            why = f"design {first + 1}: {swept.reason[first][0]}"
            found.append(f"{count(impossible, 'design')} cannot be made or computed; the first is {why}.")
        with np.errstate(invalid="ignore"):
            share = swept.numerical_error / swept.threshold
            missed = share > MISSED * self.settings["tolerance"]
        if missed.any():
            verb = "misses" if missed.sum() == 1 else "miss"
            found.append(
                f"{count(int(missed.sum()), 'threshold')} {verb} the tolerance of "
                f"{100 * self.settings['tolerance']:g} %: the numerical error is up to "
                f"{100 * share[missed].max():.2g} %. Larger sizes have smaller errors."
            )
        beyond = [one.at_least_km for one in self.ranges or () if math.isfinite(one.at_least_km)]
        if beyond:
            found.append(
                f"The range of {count(len(beyond), 'design')} is beyond the smallest size, at "
                f"{plain(max(beyond))} km or more; add smaller sizes."
            )
        if "places" in self.settings:
            found.append(unknown_place(self.settings["places"]))
        if len(self.objectives) > 1:
            names = listed(f"{'low' if one.sign > 0 else 'high'} {one.column}" for one in self.objectives)
            number = int(self.on_front[:, 0].sum())
            found.append(f"{count(number, 'design')} on the trade-off front of {names}.")
        if self._misses_coupling:
            text = "The NETD is the same for all apertures and detectors, so a smaller one costs no signal; with "
            found.append(f"{text}{argument.couple_netd} it follows f-number² / area.")
        return found

    def _answer(self) -> str:
        """Return the sentence about the design that is best by the first objective, or why there is none."""
        swept, (name, sign) = self.swept, self.objectives[0]
        column = self.column(name, 0)
        cost = np.where(self.has_threshold(0), sign * column, np.nan)
        if not np.isfinite(cost).any():
            return self._without_order()
        row = int(np.nanargmin(cost))
        values = zip(swept.designs.keys, swept.designs.values[row].tolist(), strict=True)
        of_design = ", ".join(f"{key} {value:.4g}" for key, value in values)
        value = f"{plain(float(column[row]))} {CRITERION_UNITS.get(name, '')}".rstrip()
        size = f" at {swept.size_detectors[0]:g} detectors" if self.depends_on_size else ""
        end = "Lowest" if sign > 0 else "Highest"
        return f"{end} {name}{size}: {value}, design {row + 1} ({of_design})."

    def _without_order(self) -> str:
        """Return the sentence about designs none of which has a value of the column that orders them."""
        swept, name = self.swept, self.objectives[0].column
        if not self.depends_on_size:
            return f"No design has a value of {name}, by which designs are ordered."
        seen = np.array(swept.size_detectors)[np.isfinite(swept.threshold).any(axis=0)].tolist()
        others = listed(f"{size:g}" for size in seen) if seen else ""
        advice = f"there is one at {others} detectors: name such a size first" if seen else "take larger sizes"
        text = f"No design has a value of {name} at {swept.size_detectors[0]:g} detectors, which orders designs"
        return f"{text}; {advice}."

    @property
    def _misses_coupling(self) -> bool:
        """True if the light on a detector differs between the designs, but not their NETD."""
        keys, width_follows = self.swept.designs.keys, self.settings["keep_fill_factor"]
        changes_light = {*OF_ETENDUE, *PITCHES} if width_follows or FILL_FACTOR in keys else {*OF_ETENDUE}
        has_netd = np.isfinite(self.swept.mk_per_snr).any()
        return bool(has_netd and not self.settings["couple_netd"] and NETD not in keys and changes_light & {*keys})

    def to_json(self) -> bytes:
        """Return one JSON object: settings, and a record for each design and size."""
        content = {
            "schema": 1,
            "command": "sweep",
            "version": __version__,
            "settings": self.settings,
            "seed": self.seed,
            "n_designs": self.n_designs,
            "n_computed": self.swept.n_computed,
            "from_store": self.from_store,
            "records": list(self.records()),
            "run_time_s": self.run_time_s,
        }
        return json_file(content)


def objectives(
    minimise: Sequence[str],
    maximise: Sequence[str],
    keys: Sequence[str],
    *,
    has_netd: bool,
    has_acuity: bool,
    has_range: bool,
    level: str = "snr",
) -> tuple[Objective, ...]:
    """Return the columns of the trade-off front; without any, the range, ΔT, or if NETD is not known, the level.

    Raises
    ------
    SettingsError
        If there is no such column, or it would be empty.
    """
    if not (minimise or maximise) and has_range:
        return (Objective(OF_RANGE, -1),)
    if not (minimise or maximise):
        return (Objective("delta_t_mk" if has_netd else f"threshold_{level}", 1),)
    for where, names in ((argument.minimise, minimise), (argument.maximise, maximise)):
        check_keys(names, [f"threshold_{level}", "delta_t_mk", *OF_ACUITY, OF_RANGE, *keys], where)
        if "delta_t_mk" in names and not has_netd:
            raise SettingsError(f"{where}: found delta_t_mk, which needs noise.netd_mk of the sensor")
        if set(names) & set(OF_ACUITY) and not has_acuity:
            raise SettingsError(f"{where}: found {names[0]}, which needs an SNR or ΔT for the acuity")
        if OF_RANGE in names and not has_range:
            raise SettingsError(f"{where}: found {OF_RANGE}, which needs a target and an atmosphere")
    found = (*(Objective(name, 1) for name in minimise), *(Objective(name, -1) for name in maximise))
    if len({one.column for one in found}) < len(found):
        raise SettingsError(f"{argument.minimise}, {argument.maximise}: found a column twice, expected each once")
    return found


def _known(value: Any) -> float | None:
    """Return a number, or None for NaN."""
    return None if value is None or math.isnan(value) else float(value)


def _heading(key: str) -> str:
    """Return a key as the heading of a column: in words, the table left out."""
    return key.partition(".")[2].replace("_", " ")
