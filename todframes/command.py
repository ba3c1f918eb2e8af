"""What the commands share: options, settings from all the places they come from, progress, results."""

from __future__ import annotations

import io
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from todframes import signals
from todframes.errors import SettingsError, TodframesError
from todframes.safe_text import visible

if TYPE_CHECKING:
    from rich.table import Table

    from todframes.psychometric import FitSettings
    from todframes.readout import Observer
    from todframes.report import Json

F = TypeVar("F", bound=Callable[..., Any])

STDOUT, STDERR = 1, 2

LONGEST_REMARK = 8000
"""Characters of a line on standard error; of longer ones the two ends are shown."""
MOST_ALIKE = 10
"""Problems of a kind that are told."""


def options(*decorators: Callable[[F], F]) -> Callable[[F], F]:
    """Several options as one decorator, in the order in which `--help` shows them."""

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
    "--set",
    "assignments",
    multiple=True,
    metavar="NAME=VALUE",
    help="Any setting by name, such as kernel_a=0.4; repeatable. All are in docs/model.md and docs/observers.md.",
)
observer_options = options(
    click.option(
        "--observer",
        "observer_name",
        default="pyramid",
        show_default=True,
        help="Observer, by name: pyramid, informative, oriented or one's own.",
    ),
    click.option(
        "--internal-noise", type=float, metavar="N", help="Full width of each neuron's noise.  [default: 0.5]"
    ),
    p_correct_option,
    set_option,
    click.option("--observer-settings", type=click.Path(path_type=Path), help="TOML file with settings."),
)


decisions_option = click.option(
    "--decisions",
    type=click.Choice(["expected", "sampled"]),
    default="expected",
    show_default=True,
    help="Each frame's probability of a correct answer, or one answer drawn a trial.",
)
running_options = options(
    click.option(
        "--on-error",
        type=click.Choice(["stop", "skip"]),
        default="stop",
        show_default=True,
        help="At a frame or row that cannot be used: end, or go on and list it.",
    ),
    click.option(
        "--workers", type=click.IntRange(1), default=1, show_default=True, help="Threads that read and score."
    ),
)
quiet_option = click.option("--quiet", is_flag=True, help="No progress and no remarks on standard error.")
plan_options = options(
    click.option(
        "--plan",
        "plan_name",
        type=click.Choice(["needed", "full"]),
        default="needed",
        show_default=True,
        help="Leave out what the scene does not need, or nothing.",
    ),
    click.option("--explain", is_flag=True, help="Print what was kept and left out, why, and what that changes."),
)


def make_observer(
    observer_name: str,
    internal_noise: float | None,
    p_correct: float | None,
    assignments: Sequence[str],
    observer_settings: Path | None,
    *,
    fitted: bool = True,
) -> tuple[Observer, FitSettings, Json]:
    """Observer, fit settings and both as JSON, from `observer_options`.

    An option of its own goes before `--set`, and that before the file. Where nothing is `fitted`, the criterion is
    the only setting of the fit.

    Raises
    ------
    SettingsError
        If there is no such observer or setting, or a value is refused.
    """
    from dataclasses import asdict, fields

    from todframes.psychometric import FitSettings
    from todframes.readout import find_observer
    from todframes.settings import check_keys, from_table, read_toml

    where, table = "settings", {}
    if observer_settings is not None:
        where, table = str(observer_settings), read_toml(observer_settings)
    table |= assigned(assignments)
    for name, value in (("internal_noise", internal_noise), ("p_correct", p_correct)):
        if value is not None:
            table[name] = value
    if {"internal_noise", "internal_noise_sd"} <= table.keys():
        raise SettingsError(f"{where}: found internal_noise and internal_noise_sd, expected one of them")
    kind = find_observer(observer_name)
    of_observer = [field.name for field in fields(kind.settings_type)]
    of_fit = [field.name for field in fields(FitSettings) if fitted or field.name == "p_correct"]
    check_keys(table, of_observer + of_fit, where)
    settings = from_table({k: v for k, v in table.items() if k in of_observer}, kind.settings_type, where)
    fit_settings = from_table({k: v for k, v in table.items() if k in of_fit}, FitSettings, where)
    described = {"observer": observer_name, **asdict(settings)}
    described |= {name: value for name, value in asdict(fit_settings).items() if name in of_fit}
    return kind(settings), fit_settings, described


def assigned(assignments: Sequence[str]) -> dict[str, Any]:
    """Values of `--set NAME=VALUE`: read as TOML where they are, as text where not.

    Raises
    ------
    SettingsError
        If an assignment has no name or no equals sign.
    """
    from todframes.settings import toml_value

    table: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name.strip():
            raise SettingsError(f"--set: found {assignment!r}, expected NAME=VALUE")
        try:
            table[name.strip()] = toml_value(text)
        except ValueError:
            raise SettingsError(f"--set: found {assignment!r}, expected one NAME=VALUE") from None
    return table


def numbers(text: str, option: str) -> list[float]:
    """Numbers with commas between them.

    Raises
    ------
    SettingsError
        If they are not.
    """
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise SettingsError(f"{option}: found {text!r}, expected numbers with commas between them") from None


def print_result(result: Json, title: str, *, as_json: bool, explain: bool = False) -> None:
    """A result on standard output: one JSON object, or a table, and the plan if it is to be explained."""
    from todframes import report, tables

    if as_json:
        click.echo(report.encode(result), nl=False)
        return
    if explain:
        print_table(tables.plan_table(result))
    print_table(tables.threshold_table(result, title))


def print_table(table: Table) -> None:
    """A table on standard output, on one line a row however wide."""
    from rich.console import Console

    # A table that is wider than the terminal is better than one whose numbers are cut.
    needed = Console(width=1000).measure(table).maximum
    Console(width=max(Console().width, needed), markup=False).print(table)


def echo(*lines: str) -> None:
    """Lines on standard output, with escapes for characters that a terminal would obey."""
    for line in lines:
        click.echo(visible(line))


def say(text: str) -> None:
    """A remark, one line on standard error, with escapes for characters that a terminal would obey."""
    line = visible(" ".join(text.split()))
    if len(line) > LONGEST_REMARK:
        line = f"{line[: LONGEST_REMARK // 2]} […] {line[-LONGEST_REMARK // 2 :]}"
    click.echo(line, err=True)


@contextmanager
def prints_go_to_stderr() -> Iterator[None]:
    """Send what a user's code prints in the block to standard error: standard output is for the result alone.

    All threads are affected, and what native libraries print as well.
    """
    stdout = sys.stdout
    stdout.flush()
    kept = os.dup(STDOUT)
    try:
        os.dup2(STDERR, STDOUT)
        with redirect_stdout(sys.stderr):
            yield
    finally:
        stdout.flush()  # of code that has kept `sys.stdout` for itself
        os.dup2(kept, STDOUT)
        os.close(kept)


class ProblemLines:
    """Problems on standard error, one line each; of those alike the first few, and how many more there are."""

    def __init__(self) -> None:
        self.count = 0
        self._alike: dict[str, tuple[str, int]] = {}

    def add(self, problem: str, *, kind: str | None = None) -> None:
        """Tell a problem. Alike are those whose `kind`, by default the problem, differs in numbers alone."""
        self.count += 1
        kind = re.sub(r"\b[0-9a-f]{64}\b|[0-9][0-9.]*", "#", problem if kind is None else kind)
        first, count = self._alike.get(kind, (problem, 0))
        self._alike[kind] = first, count + 1
        if count < MOST_ALIKE:
            say(f"error: {problem}")

    def close(self) -> None:
        """Tell how many were not told."""
        for first, count in self._alike.values():
            if count > MOST_ALIKE:
                say(f"error: … and {count - MOST_ALIKE} more like it: {first}")


@contextmanager
def progress(task: str, total: int, *, quiet: bool = False) -> Iterator[Callable[[int], None]]:
    """A progress bar on standard error, on a terminal only; yields what takes the number of things done."""
    if quiet or not sys.stderr.isatty():
        yield lambda _: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        running = bar.add_task(task, total=total)
        yield lambda done: bar.advance(running, done)


def keep_libraries_to_one_thread() -> None:
    """For BLAS and OpenCV, unless they are loaded already or the environment says otherwise.

    Our matrices and images are so small that their threads gain nothing: they wait for each other, and fight the
    reading threads for processors.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(name, "1")


def run(command: click.Command, arguments: Sequence[str] | None) -> int:
    """Run a command line; its exit status: 0 done, 1 bad data, 2 bad usage or settings.

    Every failure that a user can cause is one line on standard error.
    """
    signals.written.clear()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal or file whose encoding has no α
    try:
        status = command.main(arguments, standalone_mode=False)
        sys.stdout.flush()
        return status if isinstance(status, int) else 0
    except TodframesError as error:
        return _fail(str(error), error.exit_status)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message(), err=True)
        return 2
    except click.ClickException as error:
        return _fail(error.format_message(), 2)
    except (Interruption, click.Abort, KeyboardInterrupt):
        return _fail(signals.interruption_message(), signals.INTERRUPTED)
    except MemoryError:
        return _fail("out of memory", 1)
    except OSError as error:
        # What is still in the buffer would fail again when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _fail(f"cannot write to standard output ({error.strerror})", 1)


def _fail(message: str, status: int) -> int:
    with suppress(OSError):  # the terminal may be gone
        say("error: " + message)
    return status


class Interruption(Exception):  # noqa: N818 - it is no error
    """Ctrl-C or a request to end, on its way out through everything that cleans up."""


class Commands(click.Group):
    """A group whose commands end by `Interruption`; click itself would print an empty line at Ctrl-C."""

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that the context names."""
        try:
            with signals.raised():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            raise Interruption from None
