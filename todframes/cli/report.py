"""The command `report`."""

from __future__ import annotations

from pathlib import Path

import click

from todframes.base.errors import DataError
from todframes.cli.console import echo


@click.command("report")
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.json")
@click.option("-o", "--out", metavar="FILE", help="HTML file.  [default: report.html beside RESULT.json]")
@click.option("--title", default="", metavar="TEXT", help="Text below the title.  [default: name of the dataset]")
def report_command(*, result: Path, out: str | None, title: str) -> None:
    """Make report.html again from RESULT.json, which a command wrote with -o or printed with --json.

    One page with nothing else to load; the same bytes from the same result.
    """
    from todframes.base.output import write_file
    from todframes.results.data import read_bytes
    from todframes.results.result import read_result

    try:
        read = read_result(read_bytes(result), str(result))
        made = read.to_html(title).encode()
    except RecursionError:
        raise DataError(f"{result}: nested too deep, expected the result of a command") from None
    path = Path(out) if out is not None else result.with_name(read.data.page_file)
    write_file(path, made, not_over=result)
    echo(f"written: {path}")
