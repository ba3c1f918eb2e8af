"""Tables of a result, used for the terminal, the page and the CSV files."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from todframes.results.data import DatasetRecord, Efficiency, Fit, Group, Record
from todframes.results.table import EXACT, Column, Table, field_text
from todframes.results.wording import (
    SIZE_DIGITS,
    column_heading,
    group_phrase,
    level_heading,
    path_name,
    threshold_heading,
    unit_of,
)
from todframes.stimulus import ORIENTATIONS

if TYPE_CHECKING:
    from todframes.results.result import Result

THRESHOLD_COLUMNS = (
    Column(key="threshold_ci95", header="95 % interval", interval="threshold_ci95", in_summary=True),
    Column(key="threshold_numerical_error", header="numerical error", sign="± ", digits=1),
    Column(key="threshold_displacement_error", header="displacement error", sign="± ", digits=2, rank=2),
    Column(key="delta_t_mk", header="ΔT (mK)"),
    Column(key="n_trials", header="trials", rank=1, in_summary=True),
    Column(key="status", is_key=True, in_summary=True),
    Column(key="points_threshold", header="from points", is_detail=True, rank=2),
    Column(key="p_correct", in_file_only=True),
    Column(key="curve", is_detail=True, rank=2),
    Column(key="alpha", header="α", digits=3, is_detail=True),
    Column(key="beta", header="β", digits=3, is_detail=True),
    Column(key="gamma", in_file_only=True),
    Column(key="delta", header="δ", digits=3, is_detail=True),
    Column(key="p_correct_error_bound", in_file_only=True),
    Column(key="background_luminance_cd_m2", header="background (cd/m²)", is_detail=True, rank=2),
)

RATE_COLUMNS = {"gamma": "guess_rate", "delta": "lapse_rate"}
"""Attributes of a fit whose columns have the names of the keys in JSON."""

CONDITION = Column(key="condition", is_name=True, wraps=True)

TAKEN = {"threshold", "level", *(column.key for column in THRESHOLD_COLUMNS)}
"""Column names in use; a group column with one of these names is renamed."""


def group_columns(names: Iterable[str], taken: Collection[str] = TAKEN) -> list[Column]:
    """Return the columns of groups, from the names of those of a dataset."""
    return [
        CONDITION
        if name == CONDITION.key and name not in taken
        else Column(
            key=group_key(name, taken),
            header=column_heading(name),
            digits=SIZE_DIGITS if unit_of(name) else EXACT,
            is_name=True,
        )
        for name in names
    ]


def group_key(name: str, taken: Collection[str] = TAKEN) -> str:
    """Return the key of a column of groups in a table that has others."""
    return f"group {name}" if name in taken else name


def group_record(group: Group, taken: Collection[str] = TAKEN) -> Record:
    """Return the values of a group by the keys of its columns."""
    return {group_key(name, taken): value for name, value in group.items()}


def thresholds(fits: Sequence[Fit]) -> Table:
    """Make the table of thresholds, a row each; columns without any value are left out."""
    computed = not any(fit.n_trials for fit in fits)
    names = [
        "threshold",
        *(column.key for column in THRESHOLD_COLUMNS if column.key != "n_trials" or not computed),
    ]
    records = [
        group_record(fit.group) | {name: getattr(fit, RATE_COLUMNS.get(name, name)) for name in names}
        for fit in fits
    ]
    groups = group_columns(fits[0].group if fits else ())
    heading = Column(key="threshold", header=threshold_heading(fits[0].level) if fits else "")
    title = f"Thresholds at {f'{100 * fits[0].p_correct:g}' if fits else '?'} % correct"
    table = Table.of(title, "thresholds.csv", [*groups, heading, *THRESHOLD_COLUMNS], records)
    always = ["threshold", *(column.key for column in groups), *([] if computed else ["threshold_ci95"])]
    return table.without_empty_columns(*always)


def points(fits: Sequence[Fit]) -> Table | None:
    """Make the table of the points of each curve, a row for each level; None if there are no points."""
    records = [
        group_record(fit.group) | {"level": point.level, "n_trials": point.n_trials, "p_correct": point.p_correct}
        for fit in fits
        for point in fit.points
    ]
    if not records:
        return None
    computed = not any(record["n_trials"] for record in records)
    columns = [
        *group_columns(fits[0].group),
        Column(key="level", header=level_heading(fits[0].level), digits=4 if computed else EXACT),
        Column(key="n_trials", header="trials", in_file_only=computed),
        Column(key="p_correct", header="proportion correct"),
    ]
    return Table.of("Points of the psychometric functions", "points.csv", columns, records)


def efficiencies(of_pairs: Sequence[Efficiency]) -> Table:
    """Make the table of efficiencies, a row for each group and each other observer."""
    taken = {"relative_to", "threshold", "efficiency", "efficiency_ci95"}
    records = [
        {name: getattr(pair, name) for name in taken} | group_record(pair.group, taken) for pair in of_pairs
    ]
    columns = [
        Column(key="relative_to", is_name=True, wraps=True),
        *group_columns(of_pairs[0].group, taken),
        Column(key="threshold", header="its threshold"),
        Column(key="efficiency", digits=3),
        Column(key="efficiency_ci95", header="95 % interval", interval="efficiency", digits=3),
    ]
    return Table.of("Efficiency", "efficiency.csv", columns, records)


def answers(fits: Sequence[Fit]) -> Table | None:
    """Make the table of answers in the strongest trials of groups without a threshold; None if there are none."""
    records = [
        group_record(fit.group)
        | {"from_level": fit.answers_from_level, "shown": shown.value, "n_answers": round(sum(row))}
        | {
            f"answered_{orientation.value}": 100.0 * n / sum(row)
            for orientation, n in zip(ORIENTATIONS, row, strict=True)
        }
        for fit in fits
        for shown, row in zip(ORIENTATIONS, fit.answers or (), strict=False)
        if sum(row)
    ]
    if not records:
        return None
    columns = [
        *group_columns(fits[0].group),
        Column(key="from_level", header=f"from {level_heading(fits[0].level)}", digits=EXACT),
        Column(key="shown"),
        *(
            Column(key=f"answered_{orientation.value}", header=f"{orientation.value} (%)", decimals=0)
            for orientation in ORIENTATIONS
        ),
        Column(key="n_answers", header="trials", rank=1),
    ]
    return Table.of("Answers by orientation shown", "answers.csv", columns, records)


def plan(fits: Sequence[Fit], steps_of_all: tuple[Record, ...]) -> Table:
    """Make the table of the steps that were computed or left out, for each threshold if each has a plan."""
    plans = [(group_phrase(fit.group), fit.plan) for fit in fits if fit.plan] or [("", steps_of_all)]
    records = [
        {"group": group or None}
        | {key: value for key, value in step.items() if key != "kept" and not (step.get("kept") and key in UNUSED)}
        | {"kept": "kept" if step.get("kept") else "left out"}
        for group, steps in plans
        for step in steps
    ]
    columns = [
        Column(key="group", is_name=True),
        Column(key="stage"),
        Column(key="kept", header="is"),
        Column(key="why", wraps=True),
        Column(key="bound", header="bound on P", digits=2, none=""),
        Column(key="saves_s", header="saves (s)", digits=2, none="", rank=1),
    ]
    return Table.of("Plan", "plan.csv", columns, records).without_empty_columns("stage")


LONGEST_LIST = 16
"""Largest number of values of a setting that are shown."""

UNUSED = ("bound", "saves_s")
"""Keys of a plan's step that have no meaning if the step is kept."""


def records_table(title: str, file: str, records: Sequence[Record]) -> Table:
    """Make a table of records whose keys are not known beforehand, with a column for each key."""
    return Table.of(title, file, dict.fromkeys(key for record in records for key in record), records)


def settings(result: Result) -> Table:
    """Make the table of a result's settings and versions; names of nested settings are joined with dots."""
    made: Record = {
        "command": result.command,
        "name": result.name or None,
        "seed": result.seed,
        "version": result.version,
        **_flat(result.versions, "versions."),
        "run_time_s": result.run_time_s,
    }
    made = {name: value for name, value in made.items() if value is not None}
    made |= _flat(result.settings, "settings.")
    # Values are texts, because this table shows all digits on screen too.
    return _names_and_values("Settings, seed and versions", "settings.csv", made)


def dataset(record: DatasetRecord) -> Table:
    """Make the table of a dataset's display, experiment and manifest; of long lists it has the two ends."""
    made = _flat(
        {
            "path": record.path,
            "manifest_sha256": record.manifest_sha256,
            "n_frames": record.n_frames,
            "display": record.display,
            "experiment": record.experiment,
        },
        "",
    )
    for name, value in made.items():
        if isinstance(value, list) and len(value) > LONGEST_LIST:
            made[name] = f"{len(value)} values from {field_text(value[0])} to {field_text(value[-1])}"
    return _names_and_values("Dataset and display", "dataset.csv", made)


def _names_and_values(title: str, file: str, values: Record) -> Table:
    """Make a table of names and values; of an absolute path it has the last part."""
    rows: list[Record] = [
        {"name": name, "value": field_text(_without_folders(value)) or None} for name, value in values.items()
    ]
    return Table.of(title, file, ["name", "value"], rows)


def _without_folders(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [*map(_without_folders, value)]
    return path_name(value) if isinstance(value, str) else value


def _flat(values: Record, prefix: str) -> Record:
    flat: Record = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


TRIAL_KINDS = {
    **dict.fromkeys(("condition", "trial", "orientation", "answer"), str),
    **dict.fromkeys(("n_frames", "polarity"), int),
}
"""Columns of scored trials that are texts or whole numbers; the others are groups or numbers."""


def trial_kinds(names: Iterable[str], groups: Sequence[Group]) -> dict[str, type]:
    """Return the type of each column of scored trials; that of a group is a text if one of its values is."""
    texts = {name for group in groups for name, value in group.items() if isinstance(value, str)}
    kinds = TRIAL_KINDS | {name: float for group in groups for name in group} | dict.fromkeys(texts, str)
    return {name: kinds.get(name, float) for name in names}
