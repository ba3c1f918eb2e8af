"""The commands; the only place that takes a user's paths and prints.

What a command needs is imported when it runs: `--help` answers before numpy is loaded.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from todframes import __version__, cli_compare, cli_studies
from todframes.cli_locating import locate_option, located
from todframes.cli_report import report as report_command
from todframes.command import (
    Commands,
    ProblemLines,
    decisions_option,
    echo,
    json_option,
    keep_libraries_to_one_thread,
    make_observer,
    numbers,
    observer_options,
    p_correct_option,
    plan_options,
    print_result,
    progress,
    quiet_option,
    run,
    running_options,
    say,
    seed_option,
    set_option,
)
from todframes.errors import DataError, SettingsError

if TYPE_CHECKING:
    from todframes.report import Json


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="todframes")
def cli() -> None:
    """How small or faint may a triangle get before a display chain hides where it points?

    Shows the display frames (EXR, PNG) of a Triangle Orientation Discrimination test to a model observer and tells
    the thresholds. Angles are in mrad, luminance in cd/m², contrast is Weber contrast.
    """


@cli.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option("-o", "--out", metavar="OUT", help="Folder for result.json, report.html, scores.csv and plots.")
@observer_options
@decisions_option
@click.option(
    "--tolerance",
    type=float,
    metavar="T",
    help="Relative error of the thresholds that displacing the retina may cause: each frame is seen with as many "
    "displacements as that takes.  [default: one each]",
)
@plan_options
@seed_option
@locate_option
@running_options
@json_option
@quiet_option
def score(
    *,
    dataset: Path,
    out: str | None,
    decisions: Any,
    tolerance: float | None,
    plan_name: Any,
    explain: bool,
    seed: int,
    locate: bool,
    on_error: str,
    workers: int,
    as_json: bool,
    quiet: bool,
    **observer_arguments: Any,
) -> None:
    """Score the display frames of DATASET and fit its thresholds.

    DATASET is a folder with dataset.toml, manifest.csv and frames. Without -o nothing is written.
    """
    start = time.perf_counter()
    observer, fit_settings, settings = make_observer(**observer_arguments)
    from todframes import output, plots, report
    from todframes.checksums import dataset_warnings
    from todframes.dataset import load_dataset
    from todframes.planning import plan_object
    from todframes.scoring import score_dataset

    skip = on_error == "skip"
    data = load_dataset(dataset)
    group_by, level = data.experiment.group_by, data.experiment.level
    with ExitStack() as stack:
        staging = stack.enter_context(output.output_folder(out)) if out is not None else None
        more: Json = {}
        if locate:
            data, more["located"] = located(data, centre=observer.centre, skip_bad_frames=skip, quiet=quiet)
        with progress("scoring", len(data.trials), quiet=quiet) as advance:
            scored = score_dataset(
                data,
                observer,
                decisions=decisions,
                seed=seed,
                fit_settings=fit_settings,
                tolerance=tolerance,
                plan_name=plan_name,
                skip_bad_frames=skip,
                workers=workers,
                progress=advance,
            )
        warnings = dataset_warnings(data, scored.trials)
        if staging is not None:
            from todframes.examples import examples

            more["examples"] = examples(data, scored, observer)
        result = report.result_object(
            "score",
            settings=settings | {"decisions": decisions, "tolerance": tolerance, "plan": plan_name},
            seed=seed,
            fits=[
                report.scored_fit_object(dict(zip(group_by, one.group, strict=True)), level, one)
                for one in scored.fits
            ],
            plan=plan_object(scored.plan, 1.0),
            dataset=str(dataset),
            skipped=[one._asdict() for one in scored.skipped],
            warnings=[one._asdict() for one in warnings],
            negative_luminance_pixels=scored.n_negative,
            **more,
            run_time_s=time.perf_counter() - start,
        )
        if staging is not None:
            from todframes.html_report import report_html

            output.write_files(
                staging,
                {
                    "scores.csv": report.scores_csv(scored, group_by, level),
                    **plots.plots(result),
                    "report.html": report_html(result),
                    "result.json": report.encode(result),
                },
            )
    if not quiet:
        for one in scored.skipped:
            say(f"skipped: {one.error}")
        if scored.n_negative:
            say(f"note: {scored.n_negative} of the display pixels read have a luminance below zero")
        for warning in warnings:
            say(f"warning: {warning.message}")
    print_result(result, f"{dataset}: {len(scored.trials)} trials", as_json=as_json, explain=explain)
    if not as_json:
        echo(*report.closing_line(result).splitlines())
        if out is not None:
            echo(f"written: {out}")


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
    from todframes import report
    from todframes.naked_eye import acuity, contrast_threshold

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

    from todframes import report
    from todframes.command import assigned
    from todframes.counts import read_counts
    from todframes.psychometric import FitSettings, fit_counts
    from todframes.settings import from_table

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
    from todframes.checksums import check_writable, dataset_warnings, write_sha256
    from todframes.dataset import load_dataset
    from todframes.frames import frame_sha256
    from todframes.viewing import frame_problems

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
cli.add_command(report_command)
cli.add_command(cli_compare.compare)
cli.add_command(cli_compare.enhancements)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process: status 0 done, 1 bad data, 2 bad usage or settings."""
    keep_libraries_to_one_thread()
    sys.exit(run(cli, arguments))
