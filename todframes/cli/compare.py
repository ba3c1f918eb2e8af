"""The commands about enhancement: `compare` and `enhancements`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from todframes.cli.console import echo, locate_option, located, print_table, prints_go_to_stderr, progress, say
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
from todframes.errors import SettingsError


@click.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option(
    "--enhance",
    "specs",
    multiple=True,
    required=True,
    metavar="SPEC",
    help="Algorithm: NAME, MODULE:FUNCTION, or either with :PARAMETER=VALUE,… behind; repeatable.",
)
@click.option(
    "-o", "--out", metavar="OUT", help="Folder for result.json, report.html, compare.csv, scores.csv, compare.png."
)
@click.option(
    "--white", type=float, default=1.0, show_default=True, help="Code value that algorithms take as white."
)
@click.option("--allow-clipping", is_flag=True, help="Clip what algorithms take beyond the display's range.")
@observer_options
@decisions_option
@plan_options
@seed_option
@locate_option
@running_options
@json_option
@quiet_option
def compare(
    *,
    dataset: Path,
    specs: Sequence[str],
    out: str | None,
    white: float,
    allow_clipping: bool,
    decisions: Any,
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
    """Tell whether enhancement algorithms lower the thresholds of DATASET, by how much and how surely.

    Each is compared with the frames as they are, on the same frames and with the same random draws.
    `todframes enhancements` lists the algorithms that come along. Without -o nothing is written.
    """
    start = time.perf_counter()
    observer, fit_settings, settings = make_observer(**observer_arguments)
    from todframes import output
    from todframes.enhancement.algorithm import find_enhancement
    from todframes.enhancement.compare import compare_dataset
    from todframes.enhancement.enhanced_frame import Screen
    from todframes.frames.checksums import dataset_warnings
    from todframes.frames.dataset import load_dataset
    from todframes.report import convert as report
    from todframes.report.convert import algorithm_objects
    from todframes.report.figures import compare_plot
    from todframes.report.summary import verdict_sentences
    from todframes.report.tables import compare_csv, compare_scores_csv, measures_table, plan_table, ratio_table
    from todframes.scoring.error_budget import plan_object

    with prints_go_to_stderr():
        algorithms = [find_enhancement(spec) for spec in specs]
    skip = on_error == "skip"
    data = load_dataset(dataset)
    group_by, level = data.experiment.group_by, data.experiment.level
    screen = Screen(data.display, white, allow_clipping)
    with ExitStack() as stack:
        stack.enter_context(prints_go_to_stderr())
        staging = stack.enter_context(output.output_folder(out)) if out is not None else None
        more: dict[str, Any] = {}
        if locate:
            data, more["located"] = located(data, centre=observer.centre, skip_bad_frames=skip, quiet=quiet)
        with progress("comparing", len(data.trials), quiet=quiet) as advance:
            results = compare_dataset(
                data,
                observer,
                algorithms,
                decisions=decisions,
                seed=seed,
                fit_settings=fit_settings,
                screen=screen,
                plan_name=plan_name,
                skip_bad_frames=skip,
                workers=workers,
                progress=advance,
            )
        reference = results[0].scored
        warnings = dataset_warnings(data, reference.trials)
        objects = algorithm_objects(results, group_by, level)
        black, peak = screen.luminance_range
        if staging is not None:
            from todframes.report.examples import compare_examples

            more["examples"] = compare_examples(data, results, observer, screen)
        result = report.result_object(
            "compare",
            settings=settings
            | {"decisions": decisions, "plan": plan_name, "white": white, "allow_clipping": allow_clipping},
            seed=seed,
            fits=[],
            dataset=str(dataset),
            algorithms=objects,
            data_range_cd_m2=peak - black,
            verdict=verdict_sentences(objects, fit_settings.p_correct),
            plan=plan_object(reference.plan, 1.0),
            skipped=[one._asdict() for one in reference.skipped],
            warnings=[one._asdict() for one in warnings],
            negative_luminance_pixels=reference.n_negative,
            **more,
            run_time_s=time.perf_counter() - start,
        )
        if staging is not None:
            from todframes.report.html import report_html

            output.write_files(
                staging,
                {
                    "compare.csv": compare_csv(objects),
                    "scores.csv": compare_scores_csv(results, group_by, level),
                    "compare.png": compare_plot(objects),
                    "report.html": report_html(result),
                    "result.json": report.encode(result),
                },
            )
    if not quiet:
        for one in reference.skipped:
            say(f"skipped: {one.error}")
        for of_algorithm in objects:
            if of_algorithm["n_clipped"]:
                say(f"note: {of_algorithm['spec']}: {of_algorithm['n_clipped']} values were clipped")
        for warning in warnings:
            say(f"warning: {warning.message}")
    if as_json:
        click.echo(report.encode(result), nl=False)
        return
    if explain:
        print_table(plan_table(result))
    print_table(ratio_table(objects, f"{dataset}: {len(reference.trials)} trials"))
    if any(one["psnr_db"] is not None or one["ssim"] is not None for one in objects):
        print_table(measures_table(objects))
    for sentence in result["verdict"]:
        echo(sentence)
    echo(f"{result['run_time_s']:.2f} s")
    if out is not None:
        echo(f"written: {out}")


@click.command()
@json_option
def enhancements(*, as_json: bool) -> None:
    """List the enhancement algorithms that are registered, with their parameters."""
    from todframes import __version__
    from todframes.enhancement.algorithm import enhancement_names, find_enhancement
    from todframes.report import convert as report
    from todframes.report.convert import enhancement_object
    from todframes.report.tables import enhancements_table

    found = []
    for name in enhancement_names():
        try:
            with prints_go_to_stderr():
                found.append(find_enhancement(name))
        except SettingsError as error:  # of another package
            say(f"left out: {error}")
    objects = [enhancement_object(one) for one in found]
    if as_json:
        result = {
            "schema": report.SCHEMA,
            "command": "enhancements",
            "version": __version__,
            "enhancements": objects,
        }
        click.echo(report.encode(result), nl=False)
        return
    print_table(enhancements_table(objects))
