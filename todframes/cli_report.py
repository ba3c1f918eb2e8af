"""The command that makes a report again from its result."""

from __future__ import annotations

from pathlib import Path

import click


@click.command("report")
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.json")
@click.option(
    "-o",
    "--out",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="HTML file.  [default: report.html beside RESULT.json]",
)
def report(*, result: Path, out: Path | None) -> None:
    """Make report.html again from RESULT.json, what a command wrote with -o or printed with --json.

    One page with nothing else to load, the same bytes from the same result.
    """
    from todframes.errors import OutputError
    from todframes.html_report import page
    from todframes.report import write_file
    from todframes.result import load_result

    made = page(load_result(result))
    out = out if out is not None else result.with_name("report.html")
    if out.exists() and out.samefile(result):
        raise OutputError(f"{out}: is the result itself, expected another name")
    write_file(out, made)
    click.echo(f"written: {out}")
