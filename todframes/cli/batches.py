"""A command on several datasets or results: each has its own folder; one table has all rows."""

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
    noun: str,
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

    if as_json:
        raise SettingsError(f"--json: found several {noun}s, expected one; -o writes the result.json of each")
    if out is not None:
        Path(out).mkdir(exist_ok=True)
    names = [name.replace("/", "_") for name in names_of_paths(datasets)]
    records: list[dict[str, Any]] = []
    columns: dict[str, Column] = {noun: Column(key=noun, is_name=True, wraps=True)}
    failed = []

    def take(name: str, result: Any) -> None:
        table: Table = result.summary_table()
        names = [column.key for column in table.columns]
        # Names of groups come first, also where only later results have them.
        merged = {column.key: column for column in (*columns.values(), *table.columns)}
        columns.clear()
        columns.update({key: merged[key] for key in sorted(merged, key=lambda key: not merged[key].is_name)})
        records.extend({noun: name} | {key: row.get(key) for key in names} for row in table.records)

    for number, (name, dataset) in enumerate(zip(names, datasets, strict=True), 1):
        if not quiet:
            say(f"{number} of {len(datasets)}: {dataset}")
        folder = None if out is None else str(Path(out) / name)
        try:
            run(dataset, folder, lambda result, name=name: take(name, result))  # type: ignore[misc]
        except TodframesError as error:
            failed.append(name)
            records.append({noun: name, "status": "failed", "error": str(error)})
    errors = Column(key="error", in_file_only=True)
    shown = [*columns.values(), *([] if "status" in columns else [Column(key="status")]), errors]
    table = Table.of(f"All {noun}s", SUMMARY_FILE, shown, records).without_empty_columns()
    print_table(table)
    for record in records:
        if "error" in record:
            echo(f"{record[noun]} failed: {record['error']}")
    if out is not None:
        write_file(Path(out) / SUMMARY_FILE, table.csv().encode())
        echo(f"written: {out}")
    if failed:
        raise DataError(f"{len(failed)} of {len(datasets)} {noun}s could not be used: {', '.join(failed)}")
