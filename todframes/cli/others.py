"""The commands that are not made of calls; `stability` and `accuracy` test the package itself."""

from __future__ import annotations

import time
from pathlib import Path

import click

from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import check_positive
from todframes.cli.console import echo, print_result, print_table, prints_go_to_stderr, progress, say, staged
from todframes.cli.runner import showing
from todframes.parameters import counted

RECORDED = "recorded"
"""Name of the scene that needs a dataset."""


@click.command(params=[*showing("json")])
def enhancements(*, json: bool) -> None:
    """List the enhancement algorithms that are registered, with their parameters."""
    import msgspec

    from todframes import __version__
    from todframes.enhancement.finding import (
        enhancement_names,
        enhancement_record,
        enhancements_table,
        find_enhancement,
    )
    from todframes.results.data import SCHEMA

    algorithms = []
    for name in enhancement_names():
        try:
            with prints_go_to_stderr():
                algorithms.append(find_enhancement(name))
        except SettingsError as error:  # raised by an algorithm of another package
            say(f"left out: {error}")
    listed = [enhancement_record(algorithm) for algorithm in algorithms]
    if not json:
        print_table(enhancements_table(listed))
        return
    result = {"schema": SCHEMA, "command": "enhancements", "version": __version__, "enhancements": listed}
    click.echo(msgspec.json.format(msgspec.json.encode(result), indent=2))


@click.command("report")
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT.json")
@click.option("-o", "--out", metavar="FILE", help="HTML file.  [default: report.html beside RESULT.json]")
@click.option("--title", default="", metavar="TEXT", help="Text below the title.  [default: name of the dataset]")
def report_command(*, result: Path, out: str | None, title: str) -> None:
    """Make report.html again from RESULT.json, which a command wrote with -o or printed with --json.

    One page with nothing else to load; the same bytes from the same result.
    """
    from todframes.base.output import write_file
    from todframes.base.reading import read_file
    from todframes.results.data import MAX_MB
    from todframes.results.result import read_result

    try:
        read = read_result(read_file(result, most_mb=MAX_MB), str(result))
        made = read.to_html(title).encode()
    except RecursionError:
        raise DataError(f"{result}: nested too deep, expected the result of a command") from None
    path = Path(out) if out is not None else result.with_name(read.page_file)
    write_file(path, made, not_over=result)
    echo(f"written: {path}")


@click.command(params=[*showing("json quiet")])
@click.option("--markdown", "as_markdown", is_flag=True, help="Print all cases as a page of Markdown.")
def stability(*, json: bool, as_markdown: bool, quiet: bool) -> None:
    """Try extreme inputs: the expected value and its source, the computed value, and the number of right digits.

    Ends with status 1 if a case keeps fewer digits than required.
    """
    start = time.perf_counter()
    if json and as_markdown:
        raise SettingsError("stability: found --json and --markdown, expected one of them")
    from todframes.studies.stability.cases import (
        Stability,
        find_cases,
        markdown,
        outcome_table,
        run_case,
        shortfall,
    )

    cases = find_cases()
    with progress("trying", quiet=quiet) as advance:
        outcomes = [run_case(case) for case in counted(cases, len(cases), advance)]
    if json:
        result = Stability.made("stability", start, cases=tuple(outcomes))
        click.echo(result.to_json(), nl=False)
    elif as_markdown:
        click.echo(markdown(outcomes), nl=False)
    else:
        print_table(outcome_table(outcomes))
        echo(f"{len(outcomes)} cases, {time.perf_counter() - start:.2f} s")
    if (short := shortfall(outcomes)) is not None:
        raise DataError(short)


@click.command(params=[*showing("json quiet")])
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
@click.option(
    "--seed", "rng", type=click.IntRange(0), default=1, show_default=True, help="Seed of all random draws."
)
@click.option("-o", "--out", metavar="OUT", help="Folder for accuracy.json, report.html, tables and pictures.")
def accuracy(
    *,
    names: tuple[str, ...],
    dataset: Path | None,
    seconds: float,
    rng: int,
    out: str | None,
    json: bool,
    quiet: bool,
) -> None:
    """Measure error against run time of several ways to compute a threshold.

    Each scene is computed by the paper's literal Monte Carlo, by expected decisions and in closed form, with more
    and more trials, and held against a converged value. Without -o nothing is written.
    """
    start = time.perf_counter()
    from functools import partial

    from todframes.studies.accuracy.measure import Accuracy, find_scenes, measure
    from todframes.studies.accuracy.retina import recorded

    check_positive("time", seconds)
    makers = find_scenes(names)
    if dataset is not None:
        if RECORDED not in makers:
            raise SettingsError(f"--dataset: found scenes {', '.join(names)}, expected {RECORDED} among them")
        makers[RECORDED] = partial(recorded, dataset)
    with staged(out) as write:
        scenes = []
        with progress("converging", quiet=quiet) as advance:
            for name, make in counted(makers.items(), len(makers), advance):
                try:
                    scenes.append(make())
                except DataError as error:
                    if names or dataset is not None:
                        raise
                    if not quiet:
                        say(f"left out: {name}: {error}")
        with progress("measuring", quiet=quiet) as advance:
            measured = [
                measure(scene, seconds=seconds, seed=rng) for scene in counted(scenes, len(scenes), advance)
            ]
        result = Accuracy.made(
            "accuracy",
            start,
            settings={"seconds": seconds, "dataset": None if dataset is None else str(dataset)},
            seed=rng,
            scenes=tuple(measured),
        )
        write(result.files)
    print_result(result, as_json=json, out=out, quiet=quiet)
