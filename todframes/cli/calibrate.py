"""The command `calibrate`: the internal noise that explains the answers of people."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from todframes.base.locations import Location
from todframes.cli.console import print_content, print_end, print_table, progress, say, staged
from todframes.cli.options import (
    dataset_argument,
    json_option,
    make_observers,
    max_frame_option,
    observer_option,
    observer_settings_option,
    on_error_option,
    p_correct_option,
    quiet_option,
    seed_option,
    set_option,
    strict_option,
    workers_option,
)


@click.command()
@click.argument("answers", type=click.Path(path_type=Path))
@dataset_argument
@click.option(
    "-o",
    "--out",
    metavar="OUT",
    help="Folder for result.json, report.html, tables, a figure and observer.toml, the settings for score.",
)
@click.option(
    "--free",
    multiple=True,
    type=click.Choice(["lapse", "blur"]),
    help="Fit the rate of lapses or the blur of the templates, too; repeatable.",
)
@click.option("--subject", "subjects", multiple=True, metavar="ID", help="A person; repeatable.  [default: all]")
@click.option(
    "--include-flagged",
    is_flag=True,
    help="Count answers within 150 ms, or while the page was hidden or had lost the focus.",
)
@observer_option
@p_correct_option
@set_option
@observer_settings_option
@seed_option
@on_error_option
@max_frame_option
@workers_option
@strict_option
@json_option
@quiet_option
def calibrate(
    *,
    answers: Path,
    dataset: Location,
    out: str | None,
    strict: bool,
    as_json: bool,
    quiet: bool,
    **asked: Any,
) -> None:
    """Fit the observer's internal noise to the ANSWERS of people to the frames of DATASET.

    ANSWERS is a folder of todframes experiment. With several observers, --observer pyramid,csf, the first lines
    say which explains each person better. Without -o nothing is written.
    """
    asked["internal_noise"] = None  # it is fitted
    observers, fit = make_observers(asked)
    import todframes as tod
    from todframes.experiment.answers import read_answers
    from todframes.frames.dataset import load_dataset
    from todframes.report import calibration
    from todframes.report.summary import verdict

    data = load_dataset(dataset, max_frame_mb=asked.pop("max_frame_mb"))
    sessions = read_answers(answers, include_flagged=asked["include_flagged"])
    n_trials = sum(
        len(one.main_rows()) for one in sessions if not asked["subjects"] or one.subject in asked["subjects"]
    )
    with staged(out) as place:
        with progress("scoring", n_trials * len(observers), quiet=quiet) as advance:
            result = tod.calibrate(data, answers, observer=observers, fit=fit, progress=advance, **asked)
        place.write(result.files)
    if not quiet:
        for one in result.skipped:
            say(f"skipped: {one['error']}")
    if as_json:
        print_content(result.to_json(), result.warnings, quiet=quiet, strict=strict)
        return
    for table in calibration.all_tables(result):
        print_table(table)
    print_end(verdict(result), result.warnings, out=out, strict=strict)
