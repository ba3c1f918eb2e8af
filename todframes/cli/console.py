"""Output to the terminal: progress, remarks, tables, errors; and the exit status of a command."""

from __future__ import annotations

import io
import os
import re
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from typing import TYPE_CHECKING, Any

import click

from todframes.base import signals
from todframes.base.errors import DataError, TodframesError, in_command
from todframes.base.safe_text import visible

if TYPE_CHECKING:
    from todframes.parameters import Progress
    from todframes.results.data import ResultWarning
    from todframes.results.result import Result
    from todframes.results.tables import Table


STDOUT, STDERR = 1, 2

LONGEST_REMARK = 8000
"""Largest number of characters of a line on standard error; of longer lines the two ends are shown."""

MOST_ALIKE = 10
"""Largest number of problems of one kind that are printed."""

WHOLE = 10_000
"""Width of a line, in letters, if standard output is not a terminal."""

Write = Callable[[Callable[[], Mapping[str, bytes]]], None]
"""Function that writes what another function makes: files by name."""


@contextmanager
def staged(out: str | None, asked: dict[str, Any] | None = None, *, quiet: bool = False) -> Iterator[Write]:
    """Reserve the folder `out` before the work; what is written appears there if the block ends well. With the
    arguments that are asked of a call, the run goes on where an earlier one ended: `restart` and `keep_store` are
    removed from them, and `store` is set.
    """
    keep = {} if asked is None else {name: asked.pop(name, False) for name in ("restart", "keep_store")}
    if out is None:
        yield lambda _: None
        return
    from todframes.base.output import output_folder, write_files

    if asked is None:
        with output_folder(out) as folder:
            yield lambda make: write_files(folder, make())
        return
    from todframes.jobs.run import resumable_output

    output = resumable_output(output_folder, out, **keep, tell=None if quiet else say)
    with output as (folder, asked["store"]):
        yield lambda make: write_files(folder, make())


@contextmanager
def opened_engine(asked: dict[str, Any], *, quiet: bool) -> Iterator[None]:
    """Open the engine of `--cluster` and `--workers`, and print the address of its dashboard. `cluster` is
    replaced by the engine in `asked`.
    """
    from todframes.jobs.run import open_engine

    with open_engine(asked.get("cluster"), asked.get("workers", 1)) as engine:
        if engine.dashboard is not None and not quiet:
            say(f"dashboard: {engine.dashboard}")
        asked["cluster"] = engine
        yield


def print_result(
    result: Result,
    title: str = "",
    *,
    as_json: bool = False,
    verbose: bool = False,
    explain: bool = False,
    out: str | None = None,
    quiet: bool = False,
    strict: bool = False,
    is_timed: bool = True,
) -> None:
    """Show a result as one JSON object or as its tables, sentences and warnings; remarks go to standard error.
    `title` is a line above the tables, `verbose` adds details, and `explain` the plan. DataError if `strict` and
    there are warnings; everything is shown before.
    """
    for note in () if quiet else result.notes():
        say(note)
    if as_json:
        print_content(result.to_json(), result.warnings, quiet=quiet, strict=strict)
        return
    if title:
        echo(*title.split("\n"))
    if explain:
        print_table(result.plan_table())  # type: ignore[attr-defined]  # those with the option have it
    for table in result.tables():
        if not table.is_folded and (verbose or not table.is_extra):
            print_table(table)
        if verbose:
            print_table(table, details=True)
    sentences = result.advice() if result.has_findings_in_table else result.sentences()
    sentences += result.remarks() if verbose else []
    print_sentences([*sentences, *warning_lines(result.warnings)])
    if is_timed:
        echo(f"{time.perf_counter() - signals.STARTED_S:.2f} s")  # the time that people have waited
    if out is not None:
        echo(f"written: {out}")
    check_strict(result.warnings, strict)


def print_content(
    content: bytes | str, warnings: Sequence[ResultWarning] = (), *, quiet: bool = False, strict: bool = False
) -> None:
    """Print what a program reads, JSON or TOML, on standard output, and the warnings on standard error. DataError
    as in `print_result`.
    """
    for line in () if quiet else warning_lines(warnings):
        say(line)
    click.echo(content, nl=False)
    check_strict(warnings, strict)


def print_sentences(sentences: Iterable[str]) -> None:
    """Print sentences on standard output, each wrapped to the width of the terminal."""
    for sentence in sentences:
        echo(*textwrap.wrap(visible(sentence), terminal_width()))


def warning_lines(warnings: Sequence[ResultWarning]) -> Iterator[str]:
    """Yield a line for each warning, but only for the first groups of those with the same code, and a count."""
    from todframes.results.data import warning_texts

    yield from (f"warning: {text}" for text in warning_texts(warnings))


def check_strict(warnings: Sequence[ResultWarning], strict: bool) -> None:
    """Raise DataError if there are warnings and they count as errors."""
    if strict and warnings:
        from todframes.results.wording import count

        codes = ", ".join(dict.fromkeys(warning.code for warning in warnings))
        raise DataError(
            f"--strict: found {count(len(warnings), 'warning')} ({codes}), expected none; all output is written"
        )


def print_table(table: Table, *, details: bool = False) -> None:
    """Print a table on standard output, laid out for the width of the terminal; whole if it is not a terminal."""
    from rich.console import Console

    if details and not table.has_details:
        return
    laid_out = table.terminal(terminal_width(), details=details)
    # A table that is wider than the terminal is better than one whose numbers are cut.
    Console(width=WHOLE, markup=False).print(laid_out)


def echo(*lines: str) -> None:
    """Print lines on standard output, with escapes for characters that a terminal would obey."""
    for line in lines:
        click.echo(visible(line))


def terminal_width() -> int:
    """Return the number of letters in a line; `WHOLE` if standard output is not a terminal."""
    is_terminal = sys.stdout.isatty() or "COLUMNS" in os.environ
    return shutil.get_terminal_size().columns if is_terminal else WHOLE


def say(text: str) -> None:
    """Print a remark in one line on standard error, with escapes for characters that a terminal would obey."""
    line = visible(" ".join(text.split()))
    if len(line) > LONGEST_REMARK:
        line = f"{line[: LONGEST_REMARK // 2]} […] {line[-LONGEST_REMARK // 2 :]}"
    click.echo(line, err=True)


@contextmanager
def prints_go_to_stderr() -> Iterator[None]:
    """Redirect prints of a user's code in the block to standard error; standard output is for the result alone.
    All threads are affected, and the prints of native libraries too.
    """
    stdout = sys.stdout
    stdout.flush()
    kept = os.dup(STDOUT)
    try:
        os.dup2(STDERR, STDOUT)
        with redirect_stdout(sys.stderr):
            yield
    finally:
        stdout.flush()  # for code that holds its own reference to `sys.stdout`
        os.dup2(kept, STDOUT)
        os.close(kept)


class ProblemLines:
    """Printer of problems on standard error, one line each: the first few of each kind, then a count."""

    VARIABLE = re.compile(r"found '[^']*'|write \S+|\S*[/\\]\S*|\b[0-9a-f]{64}\b|[0-9][0-9.]*")
    """Pattern of the parts that differ among problems of one kind: values, paths, checksums and numbers."""

    def __init__(self) -> None:
        self.count = 0
        self._alike: dict[str, tuple[str, int]] = {}

    def add(self, problem: str, kind: str | None = None) -> None:
        """Print a problem. Those of one kind differ only in `VARIABLE` parts of `kind`, by default the problem."""
        self.count += 1
        kind = self.VARIABLE.sub("#", problem if kind is None else kind)
        first, count = self._alike.get(kind, (problem, 0))
        self._alike[kind] = first, count + 1
        if count < MOST_ALIKE:
            say(f"error: {problem}")

    def close(self) -> None:
        """Print the number of problems of each kind that were not printed."""
        for first, count in self._alike.values():
            if count > MOST_ALIKE:
                say(f"error: … and {count - MOST_ALIKE} more like it: {first}")


@contextmanager
def progress(task: str, *, quiet: bool = False) -> Iterator[Progress]:
    """Show a bar with the time left if standard error is a terminal. Yields the `progress` of a call."""
    if quiet or not sys.stderr.isatty():
        yield lambda *_: None
        return
    from rich import progress as bars
    from rich.console import Console

    named, done = (bars.TextColumn("{task.description}"), bars.BarColumn()), bars.MofNCompleteColumn()
    columns = (*named, done, bars.TimeRemainingColumn())
    with bars.Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        running = bar.add_task(task, total=None)
        yield lambda done, total: bar.update(running, completed=done, total=total)


def keep_libraries_to_one_thread() -> None:
    """Limit BLAS and OpenCV to one thread, unless they are loaded already or the environment sets a number. Our
    matrices and images are so small that more threads gain nothing: they wait for each other, and compete with
    other work for processors.
    """
    for name in ("OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
        os.environ.setdefault(name, "1")


@in_command()
def run(command: click.Command, arguments: Sequence[str] | None) -> int:
    """Run a command line. Returns the exit status: 0 done, 1 bad data, 2 bad usage or settings. Every failure that
    a user can cause is one line on standard error.
    """
    signals.written.clear()
    signals.kept.clear()
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
        if error.filename is not None or not _is_of_printing(error):
            return _fail(f"{error.filename or 'the system refused a call'}: {error.strerror or error}", 1)
        # The rest of the buffer would fail again when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _fail(f"cannot write to standard output ({error.strerror})", 1)


def _is_of_printing(error: OSError) -> bool:
    """Return whether an error was raised by a print of this module, click or rich."""
    step = error.__traceback__
    while step is not None and step.tb_next is not None:
        step = step.tb_next
    module = "" if step is None else str(step.tb_frame.f_globals.get("__name__"))
    return module == __name__ or module.split(".")[0] in ("click", "rich")


def _fail(message: str, status: int) -> int:
    with suppress(OSError):  # the terminal may be gone
        say("error: " + message)
        for folder in signals.kept if not signals.written else ():
            say(f"note: what is finished is kept in {folder}; the same command goes on where this one ended")
    return status


class Interruption(Exception):  # noqa: N818 - it is no error
    """Exception for Ctrl-C or a request to end, so that all clean-up runs."""
