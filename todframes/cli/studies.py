"""Commands that study the package itself; `todframes.cli` adds them to the others."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

import click

from todframes.cli.console import echo, print_table, progress, say
from todframes.cli.options import json_option, seed_option
from todframes.errors import DataError, SettingsError

RECORDED = "recorded"
"""The scene that takes a dataset."""


@click.command()
@json_option
@click.option("--markdown", "as_markdown", is_flag=True, help="Print the page docs/stability.md.")
@click.option("--quiet", is_flag=True, help="No progress on standard error.")
def stability(*, as_json: bool, as_markdown: bool, quiet: bool) -> None:
    """Try extreme inputs: what is expected and from where, what came, digits kept.

    Ends with status 1 if a case keeps fewer digits than it must.
    """
    start = time.perf_counter()
    if as_json and as_markdown:
        raise SettingsError("stability: found --json and --markdown, expected one of them")
    from todframes.report import convert as report
    from todframes.studies.stability.case import (
        case_object,
        find_cases,
        markdown,
        outcome_table,
        run_case,
        shortfall,
    )

    cases = find_cases()
    outcomes = []
    with progress("trying", len(cases), quiet=quiet) as advance:
        for case in cases:
            outcomes.append(run_case(case))
            advance(1)
    run_time_s = time.perf_counter() - start
    if as_json:
        tried = [case_object(outcome) for outcome in outcomes]
        result = report.result_object(
            "stability", settings={}, seed=None, fits=[], skipped=[], cases=tried, run_time_s=run_time_s
        )
        click.echo(report.encode(result), nl=False)
    elif as_markdown:
        click.echo(markdown(outcomes), nl=False)
    else:
        print_table(outcome_table(outcomes))
        echo(f"{len(outcomes)} cases, {run_time_s:.2f} s")
    if (short := shortfall(outcomes)) is not None:
        raise DataError(short)


@click.command()
@click.option(
    "--scene", "names", multiple=True, metavar="NAME", help="A scene by name; repeatable.  [default: all]"
)
@click.option("--dataset", type=click.Path(path_type=Path), help="Frames for the scene `recorded`.")
@click.option(
    "--time",
    "seconds",
    type=float,
    default=10.0,
    show_default=True,
    metavar="SECONDS",
    help="CPU time for the estimators of a scene. More shows smaller errors.",
)
@seed_option
@click.option(
    "-o", "--out", metavar="OUT", help="Folder for accuracy.json, report.html, accuracy.md and pictures."
)
@json_option
@click.option("--quiet", is_flag=True, help="No progress and no remarks on standard error.")
def accuracy(
    *,
    names: tuple[str, ...],
    dataset: Path | None,
    seconds: float,
    seed: int,
    out: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure error against run time of several ways to compute a threshold.

    Each scene is computed by the paper's literal Monte Carlo, by cheaper ones and in closed form, with more and
    more trials, and held against a converged value. Without -o nothing is written.
    """
    start = time.perf_counter()
    from functools import partial

    from todframes import output
    from todframes.report import convert as report
    from todframes.studies.accuracy import report as accuracy_report
    from todframes.studies.accuracy.estimators import StudyScene, find_scenes
    from todframes.studies.accuracy.measure import measure
    from todframes.studies.accuracy.recorded import recorded

    makers = find_scenes(names)
    if dataset is not None:
        if RECORDED not in makers:
            raise SettingsError(f"--dataset: found scenes {', '.join(names)}, expected {RECORDED} among them")
        makers[RECORDED] = partial(recorded, dataset)
    scenes: list[StudyScene] = []
    for name, make in makers.items():
        try:
            scenes.append(make())
        except DataError as error:
            if names or dataset is not None:
                raise
            if not quiet:
                say(f"left out: {name}: {error}")
    with ExitStack() as stack:
        staging = stack.enter_context(output.output_folder(out)) if out is not None else None
        measured = []
        with progress("measuring", len(scenes), quiet=quiet) as advance:
            for scene in scenes:
                measured.append(measure(scene, seconds=seconds, seed=seed))
                advance(1)
        result = report.result_object(
            "accuracy",
            settings={"seconds": seconds, "dataset": None if dataset is None else str(dataset)},
            seed=seed,
            fits=[],
            skipped=[],
            scenes=[accuracy_report.scene_object(one) for one in measured],
            run_time_s=time.perf_counter() - start,
        )
        if staging is not None:
            from todframes.report.html import report_html

            output.write_files(staging, accuracy_report.files(result) | {"report.html": report_html(result)})
    if as_json:
        click.echo(report.encode(result), nl=False)
        return
    for one in result["scenes"]:
        for table in accuracy_report.tables(one):
            print_table(table)
    echo(accuracy_report.NOTE, f"{result['run_time_s']:.0f} s")
    if out is not None:
        echo(f"written: {out}")
