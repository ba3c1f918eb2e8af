"""A command on several datasets, recordings or results: each has its own folder; a table and a page have all."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

import click
from msgspec.structs import replace

from todframes.base.errors import DataError, SettingsError, TodframesError
from todframes.cli.console import print_result, say, staged
from todframes.cli.options import SUMMARY_FILE, SUMMARY_PAGE
from todframes.comparison.conditions import names_of_paths
from todframes.results.data import Fit
from todframes.results.figures import ReportFigure, tod_figures
from todframes.results.result import Result
from todframes.results.tables import Column, Table
from todframes.results.wording import size_column


class Batch(Result, frozen=True, kw_only=True):
    """The results of a command on several things, `noun`: rows of one table, and the thresholds among them."""

    noun: str
    n: int
    failed: dict[str, str]
    rows: Any
    fits: tuple[Fit, ...]

    json_file: ClassVar[str] = ""
    page_file: ClassVar[str] = SUMMARY_PAGE

    @property
    def title(self) -> str:
        """The title of the page."""
        return f"All {self.noun}s"

    def tables(self) -> list[Table]:
        """Return the table of all."""
        return [self.rows]

    def findings(self) -> list[str]:
        """Return how many have a result, and why others have none."""
        return [
            f"{self.n - len(self.failed)} of {self.n} {self.noun}s have a result.",
            *(f"{name} failed: {error}" for name, error in self.failed.items()),
        ]

    def figures(self) -> list[ReportFigure]:
        """Return the TOD curves of all in one figure, or in one for each kind of level and size."""
        alike = defaultdict(list)
        for fit in self.fits:
            alike[fit.level, size_column([fit])].append(fit)
        return [figure for fits in alike.values() for figure in tod_figures(fits, {})]


def run_each(
    run: Callable[[str, str | None, Callable[[Any], None]], None],
    paths: Sequence[str],
    out: str | None,
    *,
    noun: str,
    as_json: bool,
    quiet: bool,
) -> None:
    """Run a command on each path, with a function of the path, the folder for its files and of another one that
    takes its result; then print one table. One that fails is a row with its error.

    DataError if one has failed; all others are there. If all fail alike, it is their error: a setting is wrong.
    """
    if as_json:
        raise SettingsError(f"--json: found several {noun}s, expected one; -o writes the result.json of each")
    started, names = time.perf_counter(), names_of_paths(paths, "_")
    records: list[dict[str, Any]] = []
    columns: dict[str, Column] = {noun: Column(key=noun, is_name=True, wraps=True)}
    errors: dict[str, TodframesError] = {}
    fits: list[Fit] = []

    def take(name: str, result: Any) -> None:
        table: Table = result.summary_table()
        keys = [column.key for column in table.columns]
        # Names of groups come first, also where only later results have them.
        merged = {column.key: column for column in (*columns.values(), *table.columns)}
        columns.clear()
        columns.update({key: merged[key] for key in sorted(merged, key=lambda key: not merged[key].is_name)})
        records.extend({noun: name} | {key: row.get(key) for key in keys} for row in table.records)
        fits.extend(replace(fit, group={noun: name} | fit.group) for fit in getattr(result, "thresholds", ()))

    with staged(out) as write:
        for number, (name, path) in enumerate(zip(names, paths, strict=True), 1):
            if not quiet:
                say(f"{number} of {len(paths)}: {path}")
            folder = None if out is None else str(Path(out) / name)
            try:
                run(path, folder, lambda result, name=name: take(name, result))  # type: ignore[misc]
            except TodframesError as error:
                errors[name] = error
                records.append({noun: name, "status": "failed", "error": str(error)})
        failed = {name: str(error) for name, error in errors.items()}
        if len(failed) == len(paths) > 1 and len(set(failed.values())) == 1:
            raise errors[names[0]]
        columns.setdefault("status", Column(key="status"))
        columns["error"] = Column(key="error", in_file_only=True)
        batch = Batch.made(
            str(click.get_current_context().info_name),
            started,
            noun=noun,
            n=len(paths),
            failed=failed,
            rows=Table.of(f"All {noun}s", SUMMARY_FILE, columns.values(), records).without_empty_columns(),
            fits=tuple(fits),
        )
        write(lambda: {**batch.data_files(), SUMMARY_PAGE: batch.to_html(out or "").encode()})
    print_result(batch, out=out, is_timed=False)
    if failed:
        raise DataError(f"{len(failed)} of {len(paths)} {noun}s could not be used: {', '.join(failed)}")
