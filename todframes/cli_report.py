"""The command that makes a report again from its result."""

from __future__ import annotations

import tempfile
from pathlib import Path

import click

from todframes.command import echo
from todframes.errors import DataError, OutputError


@click.command("report")
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.json")
@click.option("-o", "--out", metavar="FILE", help="HTML file.  [default: report.html beside RESULT.json]")
def report(*, result: Path, out: str | None) -> None:
    """Make report.html again from RESULT.json, which a command wrote with -o or printed with --json.

    One page with nothing else to load; the same bytes from the same result.
    """
    from todframes.html_report import page
    from todframes.result import load_result

    try:
        made = page(load_result(result))
    except RecursionError:
        raise DataError(f"{result}: nested too deep, expected the result of a command") from None
    path = Path(out) if out is not None else result.with_name("report.html")
    _write(path, made, not_over=result)
    echo(f"written: {path}")


def _write(path: Path, content: bytes, *, not_over: Path) -> None:
    """Write a file whole or not at all, over an older one of its name.

    Raises
    ------
    OutputError
        If the place cannot be written, or is that of `not_over`.
    """
    from todframes.report import write_files

    try:
        if path.is_dir():
            raise OutputError(f"{path}: is a folder, expected the name of a file")
        if path.exists() and path.samefile(not_over):
            raise OutputError(f"{path}: is the result itself, expected another name")
        with tempfile.TemporaryDirectory(prefix=".todframes-", dir=path.absolute().parent) as folder:
            write_files(Path(folder), {"report.html": content})
            (Path(folder) / "report.html").replace(path)
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
