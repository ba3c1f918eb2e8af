"""The commands; the only place that takes a user's paths and prints.

What a command needs is imported when it runs: `--help` answers before numpy is loaded.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from todframes import __version__
from todframes.cli import compare as cli_compare
from todframes.cli import studies as cli_studies
from todframes.cli.console import (
    Commands,
    ProblemLines,
    echo,
    keep_libraries_to_one_thread,
    print_result,
    progress,
    run,
    say,
)
from todframes.cli.options import (
    json_option,
    make_observer,
    numbers,
    observer_options,
    p_correct_option,
    seed_option,
    set_option,
)
from todframes.cli.score import score
from todframes.errors import DataError, SettingsError

if TYPE_CHECKING:
    pass


@click.command("report")
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.json")
@click.option("-o", "--out", metavar="FILE", help="HTML file.  [default: report.html beside RESULT.json]")
def report_command(*, result: Path, out: str | None) -> None:
    """Make report.html again from RESULT.json, which a command wrote with -o or printed with --json.

    One page with nothing else to load; the same bytes from the same result.
    """
    from todframes.output import write_file
    from todframes.report.html import page
    from todframes.report.result import load_result

    try:
        made = page(load_result(result))
    except RecursionError:
        raise DataError(f"{result}: nested too deep, expected the result of a command") from None
    path = Path(out) if out is not None else result.with_name("report.html")
    write_file(path, made, not_over=result)
    echo(f"written: {path}")


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="todframes")
def cli() -> None:
    """How small or faint may a triangle get before a display chain hides where it points?

    Shows the display frames (EXR, PNG) of a Triangle Orientation Discrimination test to a model observer and tells
    the thresholds. Angles are in mrad, luminance in cd/m², contrast is Weber contrast.
    """


@cli.command("naked-eye")
@click.option("--contrast", type=float, help="Weber contrast; the threshold is then a size: the acuity.")
@click.option("--size-mrad", metavar="S[,S…]", help="Sizes; the threshold is then a contrast for each.")
@observer_options
@json_option
def naked_eye(*, contrast: float | None, size_mrad: str | None, as_json: bool, **observer_arguments: Any) -> None:
    """Thresholds of the observer without any display in between."""
    start = time.perf_counter()
    if (contrast is None) == (size_mrad is None):
        raise SettingsError("naked-eye: expected one of --contrast and --size-mrad")
    observer, fit_settings, settings = make_observer(**observer_arguments, fitted=False)
    from todframes.report import convert as report
    from todframes.scoring.naked_eye import acuity, contrast_threshold

    p_correct = fit_settings.p_correct
    if contrast is not None:
        found = [("size_mrad", {"contrast": contrast}, acuity(observer, contrast=contrast, p_correct=p_correct))]
    else:
        found = [
            ("contrast", {"size_mrad": size}, contrast_threshold(observer, size_mrad=size, p_correct=p_correct))
            for size in numbers(size_mrad or "", "--size-mrad")
        ]
    result = report.result_object(
        "naked-eye",
        settings=settings,
        seed=None,
        fits=[report.computed_threshold_object(group, level, p_correct, *one) for level, group, one in found],
        skipped=[],
        run_time_s=time.perf_counter() - start,
    )
    print_result(result, "Naked eye", as_json=as_json)
    if not as_json:
        echo(*report.closing_line(result).splitlines())


@cli.command()
@click.argument("counts", type=click.Path(path_type=Path))
@p_correct_option
@set_option
@seed_option
@json_option
def fit(*, counts: Path, p_correct: float | None, assignments: Sequence[str], seed: int, as_json: bool) -> None:
    """Fit psychometric functions to COUNTS, a CSV file.

    Its columns are level, n_correct and n_trials; any other column names groups, with one curve each. Settings
    (--set) are guess_rate, lapse_rate, lapse_rate_max, p_correct and resamples.
    """
    start = time.perf_counter()
    from dataclasses import asdict

    import numpy as np

    from todframes.cli.options import assigned
    from todframes.config import from_table
    from todframes.psychometrics.counts import read_counts
    from todframes.psychometrics.fit import FitSettings, fit_counts
    from todframes.report import convert as report

    table = assigned(assignments) | ({} if p_correct is None else {"p_correct": p_correct})
    settings = from_table(table, FitSettings, "settings")
    fits = []
    for number, (group, rows) in enumerate(read_counts(counts)):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
        fits.append(report.fit_object(group, "level", fit_counts(*rows.T, settings=settings, rng=rng)))
    result = report.result_object(
        "fit", settings=asdict(settings), seed=seed, fits=fits, skipped=[], run_time_s=time.perf_counter() - start
    )
    print_result(result, str(counts), as_json=as_json)
    if not as_json:
        echo(*report.closing_line(result).splitlines())


@cli.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option(
    "--add-sha256",
    is_flag=True,
    help="If all is good, write the checksum of each frame that has none into manifest.csv.",
)
def validate(*, dataset: Path, add_sha256: bool) -> None:
    """Check every file and row of DATASET without scoring; each problem is one line."""
    from todframes.frames.checksums import check_writable, dataset_warnings, write_sha256
    from todframes.frames.contrast import frame_problems
    from todframes.frames.dataset import load_dataset
    from todframes.frames.files import frame_sha256

    data = load_dataset(dataset)
    if add_sha256:
        check_writable(data)
    sha256_of: dict[str, str] = {}
    problems = ProblemLines()
    for row in data.bad_rows:
        problems.add(row.error)
    with progress("checking", len(data.trials)) as advance:
        for trial in data.trials:
            for error in frame_problems(data, trial):
                problems.add(str(error), kind=error.problem)
            if add_sha256 and not problems.count:
                missing = [frame for frame in trial.frames if frame.sha256 is None]
                sha256_of |= {frame.path: frame_sha256(data.frame_path(frame)) for frame in missing}
            advance(1)
    problems.close()
    if problems.count:
        raise DataError(f"{dataset}: {problems.count} {'problems' if problems.count > 1 else 'problem'} found")
    n_frames = sum(len(trial.frames) for trial in data.trials)
    echo(f"{dataset}: {n_frames} frames in {len(data.trials)} trials, all good")
    if add_sha256:
        write_sha256(data, sha256_of)
        agree = n_frames - len(sha256_of)
        echo(f"{dataset / 'manifest.csv'}: sha256 of {len(sha256_of)} frames added; {agree} had one, and agree")
    else:
        for warning in dataset_warnings(data, data.trials):
            say(f"warning: {warning.message}")


cli.add_command(cli_studies.stability)


cli.add_command(cli_studies.accuracy)


cli.add_command(score)


cli.add_command(report_command)


cli.add_command(cli_compare.compare)


cli.add_command(cli_compare.enhancements)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process: status 0 done, 1 bad data, 2 bad usage or settings."""
    keep_libraries_to_one_thread()
    sys.exit(run(cli, arguments))
