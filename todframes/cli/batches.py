"""A command on several datasets: each has its own folder of results; one table has a row for each threshold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from glob import glob
from pathlib import Path
from typing import Any

from todframes.base.errors import DataError, SettingsError, TodframesError
from todframes.cli.console import echo, print_table, say

SUMMARY_FILE = "summary.csv"


def expanded(paths: Sequence[str]) -> list[str]:
    """Return paths, with the sorted matches in place of a pattern that a shell has left as it is."""
    found = ([path] if Path(path).exists() else sorted(glob(path)) or [path] for path in paths)  # noqa: PTH207
    return [match for matches in found for match in matches]


def run_each(
    run: Callable[[str, str | None, Callable[[Any], None]], None],
    datasets: Sequence[str],
    out: str | None,
    *,
    as_json: bool,
    quiet: bool,
) -> None:
    """Run a command on each dataset, with a function of the dataset, the folder for its files and of another one
    that takes its result; then print one table. One that fails is a row with its error.

    DataError if one has failed; all others are there.
    """
    from todframes.base.output import write_file
    from todframes.comparison.conditions import names_of_paths
    from todframes.results.table import Column, Table
    from todframes.results.tables import THRESHOLD_COLUMNS, group_columns, group_record

    if as_json:
        raise SettingsError("--json: found several datasets, expected one; -o writes the result.json of each")
    if out is not None:
        Path(out).mkdir(exist_ok=True)
    names = [name.replace("/", "_") for name in names_of_paths(datasets)]
    records: list[dict[str, Any]] = []
    groups: dict[str, None] = {}
    failed = []

    def take(name: str, result: Any) -> None:
        for fit in result.thresholds:
            groups.update(dict.fromkeys(fit.group))
            own = {"threshold": fit.threshold, "threshold_ci95": fit.threshold_ci95}
            own |= {"n_trials": fit.n_trials, "status": fit.status, "n_warnings": len(result.warnings)}
            records.append({"dataset": name, "level": fit.level} | group_record(fit.group) | own)

    for number, (name, dataset) in enumerate(zip(names, datasets, strict=True), 1):
        if not quiet:
            say(f"{number} of {len(datasets)}: {dataset}")
        folder = None if out is None else str(Path(out) / name)
        try:
            run(dataset, folder, lambda result, name=name: take(name, result))  # type: ignore[misc]
        except TodframesError as error:
            failed.append(name)
            records.append({"dataset": name, "error": str(error)})
    shown = [column for column in THRESHOLD_COLUMNS if column.key in ("threshold_ci95", "n_trials", "status")]
    columns = [
        Column(key="dataset", is_name=True, wraps=True),
        *group_columns(groups),
        Column(key="level", rank=2),
        Column(key="threshold"),
        *shown,
        Column(key="n_warnings", header="warnings", none="", rank=1),
        Column(key="error", none="", wraps=True),
    ]
    table = Table.of("Thresholds of all datasets", SUMMARY_FILE, columns, records).without_empty_columns()
    print_table(table)
    if out is not None:
        write_file(Path(out) / SUMMARY_FILE, table.csv().encode())
        echo(f"written: {out}")
    if failed:
        raise DataError(f"{len(failed)} of {len(datasets)} datasets could not be used: {', '.join(failed)}")
