"""The command that makes a report again from its result."""

from __future__ import annotations

from pathlib import Path

import click

from todframes.command import echo
from todframes.errors import DataError


@click.command("report")
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.json")
@click.option("-o", "--out", metavar="FILE", help="HTML file.  [default: report.html beside RESULT.json]")
def report(*, result: Path, out: str | None) -> None:
    """Make report.html again from RESULT.json, which a command wrote with -o or printed with --json.

    One page with nothing else to load; the same bytes from the same result.
    """
    from todframes.html_report import page
    from todframes.output import write_file
    from todframes.result import load_result

    try:
        made = page(load_result(result))
    except RecursionError:
        raise DataError(f"{result}: nested too deep, expected the result of a command") from None
    path = Path(out) if out is not None else result.with_name("report.html")
    write_file(path, made, not_over=result)
    echo(f"written: {path}")
