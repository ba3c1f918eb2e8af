"""Tables of a result for the terminal, for the page and as CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import msgspec

from todframes._typing import Json
from todframes.enhancement.compare import AlgorithmResult
from todframes.report.result import Algorithm, Fit, Record, Result, SceneResult
from todframes.report.wording import interval, interval_phrase, level_name, number, plain, value_text
from todframes.safe_text import csv_text, visible
from todframes.scoring.score import ScoredDataset
from todframes.stimulus import ORIENTATIONS

if TYPE_CHECKING:
    from rich.table import Table as RichTable
    from rich.text import Text


def scores_csv(scored: ScoredDataset, group_by: Sequence[str], level: str) -> bytes:
    """A row a trial: what was shown, the four scores, the probability of each answer, the answer."""
    shown = list(dict.fromkeys(["orientation", "size_mrad", "polarity", level, *group_by]))
    header = (
        ["trial", "n_frames", *shown, "displacement_x_samples", "displacement_y_samples"]
        + [f"score_{orientation}" for orientation in ORIENTATIONS]
        + [f"p_{orientation}" for orientation in ORIENTATIONS]
        + ["answer", "p_correct"]
    )
    rows: list[list[object]] = [[*header]]
    for place, trial in enumerate(scored.trials):
        values: dict[str, object] = dict(zip(group_by, trial.group, strict=True))
        values |= {
            "orientation": trial.orientation.value,
            "size_mrad": trial.stimulus.size_mrad,
            "polarity": trial.stimulus.polarity,
            level: trial.level,
        }
        numbers = [*scored.displacement_samples[place], *scored.scores[place], *scored.probabilities[place]]
        rows.append(
            [trial.name, len(trial.frames), *(values[name] for name in shown)]
            + ["" if number != number else repr(float(number)) for number in numbers]
            + [ORIENTATIONS[scored.answers[place]].value, repr(float(scored.p_correct[place]))]
        )
    return csv_text(rows).encode()


def new_table(title: str, headers: Iterable[str], left: Container[int] = ()) -> RichTable:
    """A table for the terminal without rows yet; columns are justified to the right but for those at `left`."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table as RichTable

    table = RichTable(
        title=_shown(title) if title else None, title_justify="left", title_style="bold", box=SIMPLE_HEAD
    )
    for place, header in enumerate(headers):
        table.add_column(_shown(header), justify="left" if place in left else "right", no_wrap=True)
    return table


def add_row(table: RichTable, cells: Iterable[str]) -> None:
    """A row more."""
    table.add_row(*map(_shown, cells))


def _shown(text: str) -> Text:
    """Text as rich shows it: str, with names that are data in it, it would search for markup."""
    from rich.text import Text

    return Text(visible(text))


def threshold_table(result: Json, title: str) -> RichTable:
    """The thresholds of a result as a table for the terminal."""
    fits = result["fits"]
    names = list(fits[0]["group"]) if fits else []
    level = fits[0]["level"] if fits else "level"
    numerical = any("threshold_numerical_error" in fit for fit in fits)
    warm = any("delta_t_mk" in fit for fit in fits)
    timed = any("run_time_s" in fit for fit in fits)
    displaced = any(fit.get("threshold_displacement_error") is not None for fit in fits)
    headers = [*names, f"threshold {level}", "numerical error" if numerical else "95 % interval", "status"]
    headers += (["ΔT (mK)"] if warm else []) + ([] if numerical else ["α", "β", "δ", "trials"])
    headers += (["displacement error"] if displaced else []) + (["time (s)"] if timed else [])
    table = new_table(title, headers, left={len(names) + 2})
    for fit in fits:
        cells = [f"{value:.15g}" if isinstance(value, float) else str(value) for value in fit["group"].values()]
        cells.append(number(fit["threshold"]))
        if numerical:
            error = fit["threshold_numerical_error"]
            cells += ["–" if error is None else f"± {error:.1g}", fit["status"]]
            cells += [number(fit["delta_t_mk"])] if warm else []
        else:
            cells += [interval(fit["threshold_ci95"]), fit["status"]]
            cells += [number(fit[name], 3) for name in ("alpha", "beta", "delta")] + [str(fit["n_trials"])]
        cells += [f"± {number(fit['threshold_displacement_error'], 2)}"] if displaced else []
        cells += [number(fit["run_time_s"], 2)] if timed else []
        add_row(table, cells)
    return table


def plan_table(result: Json) -> RichTable:
    """What was kept and left out for each threshold of a result, as a table for the terminal."""
    table = new_table("Plan", ("group", "stage", "", "why", "bound on P", "saves (s)"), left=range(4))
    plans = [(fit["group"], fit["plan"]) for fit in result["fits"] if "plan" in fit]
    for group, plan in plans or [({}, result["plan"])]:
        label = ", ".join(f"{name} {value}" for name, value in group.items())
        for step in plan:
            kept, bound = step["kept"], step["bound"]
            numbers = ["", ""] if kept else [number(bound, 2) if bound else "0", number(step["saves_s"], 2)]
            add_row(table, [label, step["stage"], "kept" if kept else "left out", step["why"], *numbers])
            label = ""
    return table


CSV_COLUMNS = (
    *("status", "threshold", "threshold_low", "threshold_high", "ratio", "ratio_low", "ratio_high", "p_value"),
    *("p_value_holm", "verdict", "psnr_db", "ssim", "n_clipped", "cpu_s"),
)


def ratio_rows(algorithms: Sequence[Json]) -> list[Json]:
    """A row for each algorithm and group, and for each algorithm's groups together if there are several."""
    rows = []
    for one in algorithms:
        ratios = one["ratios"] or [{}] * len(one["fits"])
        for fit, ratio in zip(one["fits"], ratios, strict=True):
            rows.append({"algorithm": one["name"], "group": fit["group"], "fit": fit, **ratio})
        if one["overall"]:
            rows.append(
                {
                    "algorithm": one["name"],
                    "group": dict.fromkeys(one["fits"][0]["group"], "all"),
                    **one["overall"],
                }
            )
    return rows


def compare_csv(algorithms: Sequence[Json]) -> bytes:
    """A row for each algorithm and group: threshold, ratio, verdict, and the usual measures."""
    groups = list(algorithms[0]["fits"][0]["group"])
    rows: list[list[object]] = [["algorithm", "spec", *groups, *CSV_COLUMNS]]
    of_algorithm = {one["name"]: one for one in algorithms}
    for row in ratio_rows(algorithms):
        fit, one = row.get("fit", {}), of_algorithm[row["algorithm"]]
        values = [fit.get("status"), fit.get("threshold"), *(fit.get("threshold_ci95") or (None, None))]
        values += [row.get("ratio"), *(row.get("ratio_ci95") or (None, None))]
        values += [row.get("p_value"), row.get("p_value_holm"), row.get("verdict")]
        values += [one["psnr_db"], one["ssim"], one["n_clipped"], one["cpu_s"]]
        rows.append([row["algorithm"], one["spec"], *row["group"].values(), *values])
    return csv_text(rows).encode()


def compare_scores_csv(results: Sequence[AlgorithmResult], group_by: Sequence[str], level: str) -> bytes:
    """A row for each algorithm and trial, as in the `scores.csv` of `score` with the algorithm before it."""
    table: list[list[str]] = []
    for place, one in enumerate(results):
        header, *rows = csv.reader(io.StringIO(scores_csv(one.scored, group_by, level).decode(), newline=""))
        if place == 0:
            table.append(["algorithm", *header])
        table += ([one.enhancement.spec, *row] for row in rows)
    return csv_text(table).encode()


def ratio_table(algorithms: Sequence[Json], title: str) -> RichTable:
    """Thresholds and their ratios as a table for the terminal."""
    groups = list(algorithms[0]["fits"][0]["group"])
    level = algorithms[0]["fits"][0]["level"]
    headers = ["algorithm", *groups, f"threshold {level}", "ratio", "95 % interval", "p (Holm)", "verdict"]
    table = new_table(title, headers, left={0, len(headers) - 1})
    last = None
    for row in ratio_rows(algorithms):
        fit = row.get("fit")
        threshold = (
            "" if fit is None else number(fit["threshold"]) if fit["threshold"] is not None else fit["status"]
        )
        cells = [
            row["algorithm"] if row["algorithm"] != last else "",
            *map(value_text, row["group"].values()),
            threshold,
        ]
        p_value = row.get("p_value_holm")
        if "ratio" in row:
            cells += [number(row["ratio"]), interval(row["ratio_ci95"]), f"{p_value:.2g}", row["verdict"]]
        else:
            cells += ["1", "", "", "reference"]
        last = row["algorithm"]
        add_row(table, cells)
    return table


def measures_table(algorithms: Sequence[Json]) -> RichTable:
    """PSNR and SSIM beside the observer's verdict as a table for the terminal."""
    headers = ["algorithm", "PSNR (dB)", "SSIM", "the observer says", ""]
    table = new_table("Beside the usual measures", headers, left={0, 3, 4})
    for one in algorithms:
        names = " and ".join(name.upper() for name in one["disagrees"])
        verb = "disagree" if len(one["disagrees"]) > 1 else "disagrees"
        cells = [one["name"], number(one["psnr_db"]), number(one["ssim"]), one["verdict"] or "reference"]
        add_row(table, [*cells, f"{names} {verb}" if names else ""])
    return table


def enhancements_table(algorithms: Sequence[Json]) -> RichTable:
    """Algorithms, each with its parameters below it, for the terminal; from what `enhancements` prints."""
    headers = ["name", "what it does; what a parameter is", "default", "range", "takes", "from"]
    table = new_table("Enhancement algorithms", headers, left={0, 1, 4, 5})
    for one in algorithms:
        add_row(
            table,
            [
                one["name"],
                one["what"],
                "",
                "",
                one["domain"].replace("_", " ") + "s" * (one["domain"] == "code_value"),
                one["library"],
            ],
        )
        for parameter in one["parameters"]:
            default, unit = parameter["default"], parameter["unit"]
            shown = f"{default:g}" if isinstance(default, float) else str(default)
            span = parameter["choices"] or [f"{end:g}" for end in parameter["range"] or ()]
            joined = (", " if parameter["choices"] else " – ").join(map(str, span))
            cells = [
                f"  {parameter['name']}",
                parameter["what"] or "",
                shown + (f" {unit}" if unit else ""),
                joined,
            ]
            add_row(table, [*cells, "", ""])
    return table


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
    """Rows of cells under headers.

    `numeric` tells which columns hold numbers, `n_rows_hidden` how many rows are not shown, `csv` is a data URI of
    all rows under the name `file`.
    """

    caption: str
    headers: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    numeric: tuple[bool, ...]
    file: str
    csv: str
    n_rows_hidden: int


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
        n_rows_hidden=max(0, len(records) - LONGEST_TABLE),
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
        return interval_phrase(value)
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


Runs = dict[str, list[tuple[float, float]]]


def scene_runs(scene: SceneResult) -> Runs:
    """CPU time and relative error of the threshold at each budget of each estimator; both above 0."""
    runs = {
        one.title: [
            (float(point["cpu_s"]), float(point["threshold_error"]))
            for point in one.points
            if _is_positive(point.get("cpu_s")) and _is_positive(point.get("threshold_error"))
        ]
        for one in scene.estimators
    }
    return {title: pairs for title, pairs in runs.items() if pairs}


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and value > 0


def scene_tables(scene: SceneResult, number: int) -> list[Table]:
    """Estimators first; then what they take at some errors, all budgets, and what changing one thing does."""
    estimators: list[Record] = [
        {
            "estimator": one.title,
            "set_up_cpu_s": one.set_up_cpu_s,
            "slope": one.slope,
            "slope_standard_error": one.slope_standard_error,
        }
        for one in scene.estimators
    ]
    parts = {
        "estimators": estimators,
        "CPU time at some errors": [
            {"estimator": one.title} | at for one in scene.estimators for at in one.cpu_s_at
        ],
        "budgets": [{"estimator": one.title} | point for one in scene.estimators for point in one.points],
        "one thing changed": scene.variants,
    }
    return [
        records_table(f"{scene.heading}: {what}", f"scene_{number}_{part}.csv", rows)
        for part, (what, rows) in enumerate(parts.items(), 1)
        if rows
    ]
