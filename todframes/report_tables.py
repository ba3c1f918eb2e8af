"""The tables of a report: cells for people, and the same rows with all digits as CSV."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

import msgspec

from todframes.result import Algorithm, Fit, Record, Result
from todframes.safe_text import csv_text
from todframes.verdict import interval, level_name, plain

LONGEST_TABLE = 200
"""Rows shown; the CSV has all of them."""

IN_FILE_ONLY = {"p_correct", "gamma", "p_correct_error_bound", "p_correct_left_out_bound"}
FIT_COLUMNS = {
    "status": "status",
    "threshold_numerical_error": "numerical error",
    "threshold_displacement_error": "displacement error",
    "delta_t_mk": "ΔT (mK)",
    "points_threshold": "from points",
    "p_correct": "p_correct",
    "alpha": "α",
    "beta": "β",
    "gamma": "gamma",
    "delta": "δ",
    "n_trials": "trials",
    "p_correct_error_bound": "p_correct_error_bound",
    "p_correct_left_out_bound": "p_correct_left_out_bound",
    "run_time_s": "time (s)",
}
RATIO_COLUMNS = {
    "ratio": "ratio",
    "ratio_ci95": "95 % interval",
    "p_value": "p",
    "p_value_holm": "p (Holm)",
    "verdict": "verdict",
}

MEASURE_COLUMNS = {
    "domain": "works on",
    "psnr_db": "PSNR (dB)",
    "psnr_change_db": "change (dB)",
    "ssim": "SSIM",
    "ssim_change": "change",
    "n_clipped": "values clipped",
    "cpu_s": "CPU time (s)",
}


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells under headers. `numeric` tells which columns hold numbers, `left_out` how many rows are not
    shown, `csv` is a data URI of all rows under the name `file`.
    """

    caption: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[bool, ...]
    file: str
    csv: str
    left_out: int


def table(
    caption: str,
    file: str,
    headers: Mapping[str, str],
    records: Sequence[Record],
    exact: Collection[str] = (),
    in_file_only: Collection[str] = (),
) -> Table:
    """A table of records.

    Parameters
    ----------
    headers : mapping
        What stands above each column, by the records' key; the CSV has the key. An interval, which is a pair, has
        two columns there: its key with `_low` and `_high`.
    exact : collection of str
        Keys of columns whose numbers are shown with all digits; others have four.
    in_file_only : collection of str
        Keys of columns that the CSV has and the page has not.
    """
    columns = {key: [record.get(key) for record in records] for key in headers if key not in in_file_only}
    shown = [[cell(value, 15 if key in exact else 4) for value in column] for key, column in columns.items()]
    return Table(
        caption=caption,
        headers=tuple(headers[key] for key in columns),
        rows=tuple(zip(*shown, strict=True))[:LONGEST_TABLE],
        numeric=tuple(all(_is_number(value) for value in column) for column in columns.values()),
        file=file,
        csv="data:text/csv;charset=utf-8," + quote(_csv(list(headers), records)),
        left_out=max(0, len(records) - LONGEST_TABLE),
    )


def _is_number(value: object) -> bool:
    return value is None or (isinstance(value, int | float | tuple) and not isinstance(value, bool))


def cell(value: Any, digits: int = 4) -> str:
    """A value for a person."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return plain(value, digits) if digits < 15 else f"{value:.15g}"
    if isinstance(value, tuple):
        return interval(value)
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def _csv(keys: Sequence[str], records: Sequence[Record]) -> str:
    pairs = {key for key in keys if any(isinstance(record.get(key), tuple) for record in records)}
    rows: list[list[object]] = []
    rows.append([name for key in keys for name in ([f"{key}_low", f"{key}_high"] if key in pairs else [key])])
    for record in records:
        fields: list[object] = []
        for key in keys:
            value = record.get(key)
            fields += (value or (None, None)) if key in pairs else [value]
        rows.append([_field(value) for value in fields])
    return csv_text(rows)


def _field(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    return repr(value) if isinstance(value, float) else msgspec.json.encode(value).decode()


def records_table(caption: str, file: str, records: Sequence[Record]) -> Table:
    """A table of records whose keys are not known beforehand: as many columns as there are keys."""
    keys = dict.fromkeys(key for record in records for key in record)
    return table(caption, file, {key: key.replace("_", " ") for key in keys}, records)


def thresholds(result: Result) -> Table:
    """A row a threshold; a column only where some threshold has a value for it."""
    records = [_fit_record(fit, {}) for fit in result.fits]
    records += [_fit_record(fit, {"algorithm": one.name}) for one in result.algorithms for fit in one.fits]
    fits = [*result.fits, *(fit for one in result.algorithms for fit in one.fits)]
    names = list(fits[0].group)
    level = f"threshold {level_name(_heading(fits[0].level))}"
    headers = {"algorithm": "algorithm"} if result.algorithms else {}
    headers |= {_group_key(name): _heading(name) for name in names}
    headers |= {"threshold": level, "threshold_ci95": "95 % interval"} | FIT_COLUMNS
    computed = all(not record["n_trials"] for record in records)
    some = {key for record in records for key, value in record.items() if value is not None}
    some -= {"n_trials"} if computed else set()
    always = {"threshold"} if computed else {"threshold", "threshold_ci95"}
    headers = {key: header for key, header in headers.items() if key in some | always}
    caption = f"Thresholds at {100 * fits[0].p_correct:g} % correct"
    return table(caption, "thresholds.csv", headers, records, set(map(_group_key, names)), IN_FILE_ONLY)


def _heading(name: str) -> str:
    """What stands above a group column: "size (mrad)" for size_mrad."""
    return f"size ({name.removeprefix('size_')})" if name.startswith("size_") else name


def _group_key(name: str) -> str:
    """A group column whose name is that of another column gets one of its own."""
    taken = {"algorithm", "threshold", "threshold_ci95", "level", *FIT_COLUMNS, *RATIO_COLUMNS}
    return f"group {name}" if name in taken else name


def _fit_record(fit: Fit, more: Record) -> Record:
    record = {name: getattr(fit, name) for name in ("threshold", "threshold_ci95", *FIT_COLUMNS)}
    return more | {_group_key(name): value for name, value in fit.group.items()} | record


def points(result: Result) -> Table | None:
    """A row a level of each curve, if there are any."""
    sources = [({}, result.fits), *(({"algorithm": one.name}, one.fits) for one in result.algorithms)]
    records: list[Record] = [
        more
        | {_group_key(name): value for name, value in fit.group.items()}
        | {"level": point.level, "n_trials": point.n_trials, "p_correct": point.p_correct}
        for more, fits in sources
        for fit in fits
        for point in fit.points
    ]
    if not records:
        return None
    level = next(fit.level for _, fits in sources for fit in fits)
    names = {"level": level, "n_trials": "trials", "p_correct": "proportion correct"}
    computed = not any(record["n_trials"] for record in records)
    headers = {key: names.get(key, _heading(key)) for key in records[0]}
    found = {"p_correct", "level"} if computed else {"p_correct"}
    hidden = {"n_trials"} if computed else set()
    return table(
        "Points of the psychometric functions", "points.csv", headers, records, headers.keys() - found, hidden
    )


def ratios(algorithms: Sequence[Algorithm]) -> Table:
    """A row for each algorithm and group, and one for all groups together: threshold over the reference's."""
    records: list[Record] = []
    for algorithm in algorithms:
        for one in [*algorithm.ratios, *([algorithm.overall] if algorithm.overall else [])]:
            group = one.group or dict.fromkeys(algorithm.ratios[0].group if algorithm.ratios else (), "all")
            known = {name: getattr(one, name) for name in RATIO_COLUMNS}
            named = {_group_key(name): value for name, value in group.items()}
            records.append({"algorithm": algorithm.name, **named, **known})
    headers = {key: RATIO_COLUMNS.get(key, _heading(key)) for record in records for key in record}
    exact = [key for key in headers if key not in RATIO_COLUMNS]
    return table("Threshold over that of the reference", "ratios.csv", headers, records, exact)


def measures(algorithms: Sequence[Algorithm]) -> Table:
    """A row an algorithm: what it is, the usual measures of image quality, and what it costs."""
    records: list[Record] = [
        {
            "algorithm": one.name,
            "spec": one.spec,
            "parameters": ", ".join(f"{name} {_field(value)}" for name, value in one.parameters.items()) or None,
            **{name: getattr(one, name) for name in MEASURE_COLUMNS},
        }
        for one in algorithms
    ]
    columns = {"algorithm": "algorithm", "spec": "as asked for", "parameters": "parameters"} | MEASURE_COLUMNS
    some = {key for record in records for key, value in record.items() if value is not None}
    headers = {key: header for key, header in columns.items() if key in some}
    return table("Algorithms and the usual measures", "algorithms.csv", headers, records)


def settings(result: Result) -> Table:
    """Everything that the result says of how it was made, nested tables with dots between the names."""
    made: Record = {
        "command": result.command,
        "dataset": result.dataset,
        "seed": result.seed,
        "version": result.version,
        **_flat(result.versions, "versions."),
        "run_time_s": result.run_time_s,
    }
    made = {name: value for name, value in made.items() if value is not None} | _flat(result.settings, "settings.")
    # As texts, for here the table too shows all digits.
    rows: list[Record] = [{"name": name, "value": _field(value) or None} for name, value in made.items()]
    return table("Settings, seed and versions", "settings.csv", {"name": "name", "value": "value"}, rows)


def _flat(values: Record, prefix: str) -> Record:
    flat: Record = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat
