"""The commands `validate` and `report`."""

from __future__ import annotations

from pathlib import Path

import click

from todframes.base.errors import DataError
from todframes.base.locations import Location
from todframes.cli.console import ProblemLines, check_strict, echo, progress, say, warning_lines
from todframes.cli.options import dataset_argument, json_option, max_frame_option, strict_option


@click.command()
@dataset_argument
@click.option(
    "--add-sha256",
    is_flag=True,
    help="If all is good, write the checksum of each frame that has none into manifest.csv.",
)
@max_frame_option
@strict_option
@json_option
def validate(*, dataset: Location, add_sha256: bool, max_frame_mb: int, strict: bool, as_json: bool) -> None:
    """Check every file and row of DATASET, and what its frames show, without scoring.

    Each problem and each warning is one line.
    """
    import todframes as tod
    from todframes.report.wording import count

    data = tod.load_dataset(dataset, max_frame_mb=max_frame_mb)
    n_missing = 0
    if add_sha256:
        n_missing = sum(frame.sha256 is None for trial in data.trials for frame in trial.frames)
        n_missing += sum(frame.sha256 is None for frame in data.trials.unjudged_frames())
    problems = ProblemLines()
    with progress("checking", len(data.trials)) as advance:
        result = tod.validate(data, add_sha256=add_sha256, problem=problems.add, progress=advance)
    problems.close()
    for line in warning_lines(result.warnings):
        say(line)
    if as_json:
        click.echo(result.to_json(), nl=False)
    if problems.count:
        raise DataError(f"{dataset}: {count(problems.count, 'problem')} found")
    if not as_json:
        n_frames = data.n_frames
        warnings = len(result.warnings)
        verdict = f"all readable; {count(warnings, 'warning')}" if warnings else "all good"
        n_others = data.trials.n_unjudged_frames
        others = f" and {count(n_others, 'other')} in their clips" if n_others else ""
        echo(f"{dataset}: {n_frames - n_others} frames in {len(data.trials)} trials{others}, {verdict}")
        if add_sha256:
            echo(
                f"{dataset / 'manifest.csv'}: sha256 of {n_missing} frames added; {n_frames - n_missing} had one, "
                "and agree"
            )
    check_strict(result.warnings, strict)


@click.command("report")
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.json")
@click.option("-o", "--out", metavar="FILE", help="HTML file.  [default: report.html beside RESULT.json]")
def report_command(*, result: Path, out: str | None) -> None:
    """Make report.html again from RESULT.json, which a command wrote with -o or printed with --json.

    One page with nothing else to load; the same bytes from the same result.
    """
    from todframes.base.output import write_file
    from todframes.report.data import read_bytes
    from todframes.report.result import read_result

    try:
        made = read_result(read_bytes(result), str(result)).to_html().encode()
    except RecursionError:
        raise DataError(f"{result}: nested too deep, expected the result of a command") from None
    path = Path(out) if out is not None else result.with_name("report.html")
    write_file(path, made, not_over=result)
    echo(f"written: {path}")
