"""The commands; the only place that takes a user's paths and prints.

What a command needs is imported when it runs: `--help` answers before numpy is loaded.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from todframes.cli.console import (
    echo,
    locate_option,
    located,
    print_result,
    progress,
    say,
)
from todframes.cli.options import (
    decisions_option,
    json_option,
    make_observer,
    observer_options,
    plan_options,
    quiet_option,
    running_options,
    seed_option,
)

if TYPE_CHECKING:
    from todframes._typing import Json


@click.command()
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
    from todframes import output
    from todframes.frames.checksums import dataset_warnings
    from todframes.frames.dataset import load_dataset
    from todframes.report import convert as report
    from todframes.report import figures as plots
    from todframes.scoring.error_budget import plan_object
    from todframes.scoring.score import score_dataset

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
            from todframes.report.examples import examples

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
            from todframes.report.html import report_html
            from todframes.report.tables import scores_csv

            output.write_files(
                staging,
                {
                    "scores.csv": scores_csv(scored, group_by, level),
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
