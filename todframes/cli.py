"""The commands; the only place that takes a user's paths and prints.

What a command needs is imported when it runs: `--help` answers before numpy is loaded.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from todframes import __version__
from todframes.errors import DataError, SettingsError, TodframesError

if TYPE_CHECKING:
    from todframes.psychometric import FitSettings
    from todframes.readout import Observer
    from todframes.report import Json

F = TypeVar("F", bound=Callable[..., Any])

INTERRUPTED = 130


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="todframes")
def cli() -> None:
    """How small or faint may a triangle get before a display chain hides where it points?

    Shows display frames (EXR, PNG) of the Triangle Orientation Discrimination test to a model observer and tells
    the thresholds. Angles are in mrad, luminance in cd/m², contrast is Weber contrast.
    """


def _options(*decorators: Callable[[F], F]) -> Callable[[F], F]:
    def decorate(function: F) -> F:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return decorate


json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON object on standard output.")
p_correct_option = click.option(
    "--p-correct", type=float, metavar="P", help="Raw proportion correct at threshold.  [default: 0.75]"
)
seed_option = click.option(
    "--seed", type=click.IntRange(0), default=1, show_default=True, help="Seed of all random draws."
)
set_option = click.option(
    "--set", "assignments", multiple=True, metavar="NAME=VALUE", help="Any setting by name; repeatable."
)
observer_options = _options(
    click.option("--observer", "observer_name", default="pyramid", show_default=True, help="Observer, by name."),
    click.option(
        "--internal-noise", type=float, metavar="N", help="Full width of each neuron's noise.  [default: 0.5]"
    ),
    p_correct_option,
    set_option,
    click.option("--observer-settings", type=click.Path(path_type=Path), help="TOML file with settings."),
)


@cli.command()
@click.argument("dataset", type=click.Path(path_type=Path))
@click.option("-o", "--out", type=click.Path(path_type=Path), help="Folder for scores.csv, result.json and plots.")
@observer_options
@click.option(
    "--decisions",
    type=click.Choice(["expected", "sampled"]),
    default="expected",
    show_default=True,
    help="Each frame's probability of a correct answer, or one answer drawn a frame.",
)
@seed_option
@click.option("--locate", is_flag=True, help="Find the triangle's position where the manifest has none.")
@click.option("--on-error", type=click.Choice(["stop", "skip"]), default="stop", show_default=True)
@click.option(
    "--workers", type=click.IntRange(1), default=1, show_default=True, help="Threads that read and score."
)
@json_option
@click.option("--quiet", is_flag=True, help="No progress and no remarks on standard error.")
def score(
    dataset: Path,
    out: Path | None,
    decisions: str,
    seed: int,
    locate: bool,
    on_error: str,
    workers: int,
    as_json: bool,
    quiet: bool,
    **observer_options: Any,
) -> None:
    """Score the display frames of DATASET and fit its thresholds.

    DATASET is a folder with dataset.toml, manifest.csv and frames. Without -o nothing is written.
    """
    from contextlib import ExitStack, nullcontext

    start = time.perf_counter()
    observer, fit_settings, settings = _observer(**observer_options)
    from todframes import report
    from todframes.dataset import load_dataset
    from todframes.locating import locate_triangles
    from todframes.scoring import score_dataset

    skip = on_error == "skip"
    with ExitStack() as stack:
        data = load_dataset(dataset)
        staging = stack.enter_context(report.output_folder(out)) if out is not None else None
        say = _silent if quiet else _say
        more: Json = {}
        if locate:
            with _progress("locating", len(data.trials), quiet) as advance:
                data, locations = locate_triangles(data, skip_bad_frames=skip, progress=advance)
            names = data.experiment.group_by
            more["located"] = [
                {
                    "group": dict(zip(names, place.group, strict=True)),
                    **dict(zip(place._fields[1:], place[1:], strict=True)),
                }
                for place in locations
            ]
            for place in more["located"]:
                say(
                    f"located: {report.group_label(place['group']) or 'all trials'}: x_px {place['x_px']:.2f}, "
                    f"y_px {place['y_px']:.2f} (± {place['standard_error_px']:.1g} px)"
                )
            if not locations:
                say("located: nothing, the manifest has all positions")
        with _progress("scoring", len(data.trials), quiet) as advance:
            scored = score_dataset(
                data,
                observer,
                decisions="sampled" if decisions == "sampled" else "expected",
                seed=seed,
                fit_settings=fit_settings,
                skip_bad_frames=skip,
                workers=workers,
                progress=advance,
            )
        names = data.experiment.group_by
        fits = [
            report.fit_object(dict(zip(names, one.group, strict=True)), data.experiment.level, one.fit)
            | {"p_correct_error_bound": one.non_gaussian_bound}
            for one in scored.fits
        ]
        result = report.result_object(
            "score",
            settings=settings | {"decisions": decisions},
            seed=seed,
            fits=fits,
            skipped=[{"frame": one.frame, "error": one.error} for one in scored.skipped],
            negative_luminance_pixels=scored.n_negative,
            **more,
            run_time_s=time.perf_counter() - start,
        )
        if staging is not None:
            scores = report.scores_csv(scored, names, data.experiment.level)
            pictures = report.plots(result)
            report.write_all(
                staging, [("scores.csv", scores), *pictures.items(), ("result.json", report.encode(result))]
            )
    for one in scored.skipped:
        say(f"skipped: {one.error}")
    if scored.n_negative:
        say(f"note: {scored.n_negative} pixels have a luminance below zero")
    _print_result(result, as_json, f"{dataset}: {len(scored.trials)} trials", report)
    if not as_json:
        bound = max(one.non_gaussian_bound for one in scored.fits)
        click.echo(
            f"{result['run_time_s']:.2f} s; P(correct) is exact to {bound:.1g} "
            "(summed internal noise taken as Gaussian)"
            if bound
            else f"{result['run_time_s']:.2f} s"
        )
        if out is not None:
            click.echo(f"written: {out}")
    del nullcontext


@cli.command("naked-eye")
@click.option("--contrast", type=float, help="Weber contrast; the threshold is then a size: the acuity.")
@click.option("--size-mrad", metavar="S[,S…]", help="Sizes; the threshold is then a contrast for each.")
@observer_options
@json_option
def naked_eye(contrast: float | None, size_mrad: str | None, as_json: bool, **observer_options: Any) -> None:
    """Thresholds of the observer without any display in between."""
    start = time.perf_counter()
    if (contrast is None) == (size_mrad is None):
        raise SettingsError("naked-eye: expected one of --contrast and --size-mrad")
    observer, fit_settings, settings = _observer(**observer_options)
    from todframes import report
    from todframes.naked_eye import acuity, contrast_threshold

    p_correct = fit_settings.p_correct
    if contrast is not None:
        level = "size_mrad"
        found = [({"contrast": contrast}, acuity(observer, contrast=contrast, p_correct=p_correct))]
    else:
        level = "contrast"
        sizes = _numbers(size_mrad or "", "--size-mrad")
        found = [
            ({"size_mrad": size}, contrast_threshold(observer, size_mrad=size, p_correct=p_correct))
            for size in sizes
        ]
    fits = [
        {
            "group": group,
            "level": level,
            "status": one.status,
            "threshold": one.threshold,
            "threshold_ci95": None,
            "threshold_numerical_error": one.numerical_error,
            "p_correct": p_correct,
            "alpha": None,
            "beta": None,
            "gamma": 0.25,
            "delta": 0.0,
            "n_trials": 0,
            "points": [],
        }
        for group, one in found
    ]
    result = report.result_object(
        "naked-eye", settings=settings, seed=None, fits=fits, skipped=[], run_time_s=time.perf_counter() - start
    )
    _print_result(result, as_json, "Naked eye", report)


@cli.command()
@click.argument("counts", type=click.Path(path_type=Path))
@p_correct_option
@set_option
@seed_option
@json_option
def fit(counts: Path, p_correct: float | None, assignments: Sequence[str], seed: int, as_json: bool) -> None:
    """Fit psychometric functions to COUNTS, a CSV file.

    Its columns are level, n_correct, n_trials and, if there are any more, those name groups: one curve each.
    """
    start = time.perf_counter()
    table = _assigned(assignments)
    if p_correct is not None:
        table["p_correct"] = p_correct
    from dataclasses import asdict

    import numpy as np

    from todframes import report
    from todframes.counts import read_counts
    from todframes.psychometric import FitSettings, fit_counts
    from todframes.settings import from_table

    fit_settings = from_table(table, FitSettings, "settings")
    fits = []
    for number, (group, rows) in enumerate(read_counts(counts)):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
        try:
            one = fit_counts(rows[:, 0], rows[:, 1], rows[:, 2], settings=fit_settings, rng=rng)
        except DataError as error:
            raise DataError(f"{counts}: {error}") from None
        fits.append(report.fit_object(group, "level", one))
    result = report.result_object(
        "fit",
        settings=asdict(fit_settings),
        seed=seed,
        fits=fits,
        skipped=[],
        run_time_s=time.perf_counter() - start,
    )
    _print_result(result, as_json, str(counts), report)


@cli.command()
@click.argument("dataset", type=click.Path(path_type=Path))
def validate(dataset: Path) -> None:
    """Check every file and row of DATASET without scoring; each problem is one line."""
    from todframes.dataset import load_dataset
    from todframes.viewing import frame_problems

    data = load_dataset(dataset)
    n_problems = 0
    for row in data.bad_rows:
        n_problems += 1
        _say(f"error: {row.error}")
    with _progress("checking", len(data.trials), quiet=False) as advance:
        for trial in data.trials:
            for problem in frame_problems(data, trial):
                n_problems += 1
                _say(f"error: {problem}")
            advance(1)
    n_frames = sum(len(trial.frames) for trial in data.trials)
    if n_problems:
        raise DataError(f"{dataset}: {n_problems} problem{'s' * (n_problems > 1)} found")
    click.echo(f"{dataset}: {n_frames} frames in {len(data.trials)} trials, all good")


def _observer(
    observer_name: str,
    internal_noise: float | None,
    p_correct: float | None,
    assignments: Sequence[str],
    observer_settings: Path | None,
) -> tuple[Observer, FitSettings, Json]:
    """Observer and fit settings from all the places where they can be given; the command line goes first."""
    from dataclasses import asdict, fields

    from todframes.psychometric import FitSettings
    from todframes.readout import find_observer
    from todframes.settings import check_keys, from_table, read_toml

    where = "settings"
    table: dict[str, Any] = {}
    if observer_settings is not None:
        table, where = read_toml(observer_settings), str(observer_settings)
    table |= _assigned(assignments)
    for name, value in (("internal_noise", internal_noise), ("p_correct", p_correct)):
        if value is not None:
            table[name] = value
    kind = find_observer(observer_name)
    of_observer = [field.name for field in fields(kind.settings_type)]
    of_fit = [field.name for field in fields(FitSettings)]
    check_keys(table, of_observer + of_fit, where)
    settings = from_table({k: v for k, v in table.items() if k in of_observer}, kind.settings_type, where)
    fit_settings = from_table({k: v for k, v in table.items() if k in of_fit}, FitSettings, where)
    described = {"observer": observer_name, **asdict(settings), **asdict(fit_settings)}
    return kind(settings), fit_settings, described


def _assigned(assignments: Sequence[str]) -> dict[str, Any]:
    """Values of `--set NAME=VALUE`: as TOML if they are, as text if not."""
    import tomllib

    table: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name:
            raise SettingsError(f"--set: found {assignment!r}, expected NAME=VALUE")
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = text.strip()
        table[name.strip()] = value
    return table


def _numbers(text: str, option: str) -> list[float]:
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise SettingsError(f"{option}: found {text!r}, expected numbers with commas between") from None


def _print_result(result: Json, as_json: bool, title: str, report: Any) -> None:
    if as_json:
        click.echo(report.encode(result), nl=False)
        return
    from rich.console import Console

    Console(soft_wrap=True).print(report.threshold_table(result, title))


def _say(text: str) -> None:
    click.echo(text, err=True)


def _silent(text: str) -> None:
    del text


@contextmanager
def _progress(task: str, total: int, quiet: bool) -> Iterator[Callable[[int], None]]:
    """A progress bar on standard error, on a terminal only."""
    if quiet or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        running = bar.add_task(task, total=total)
        yield lambda done: bar.advance(running, done)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process: 0 done, 1 bad data, 2 bad usage or settings."""
    # Small matrix products gain nothing from BLAS threads, which fight the reading threads for processors.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        status = cli.main(arguments, standalone_mode=False)
    except TodframesError as error:
        _fail(str(error), error.exit_status)
    except click.ClickException as error:
        _fail(error.format_message(), 2)
    except (click.Abort, KeyboardInterrupt):
        _fail("interrupted, nothing was written", INTERRUPTED)
    sys.exit(status if isinstance(status, int) else 0)


def _fail(message: str, status: int) -> None:
    click.echo("error: " + " ".join(message.split()), err=True)
    sys.exit(status)
