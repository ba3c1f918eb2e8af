"""Commands in copies of this process, because to start one and to import what a command needs takes longer."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import resource
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any

import logged

FORK = multiprocessing.get_context("fork")

DEFECT = 70
"""Status of a command that has raised something else than SystemExit."""

_numbers = itertools.count()


class Forked:
    """A command that runs in a copy of this process, with the environment of `logged` that is given.

    Parameters
    ----------
    arguments : sequence of str
        Package and arguments of the command.
    folder : Path
        Folder for its standard error.
    environment : dict of str to str
        Variables of the environment for `logged`.
    limit_bytes : int, optional
        Largest size of a file that it may write.
    """

    def __init__(
        self, arguments: Sequence[str], folder: Path, environment: dict[str, str], limit_bytes: int | None = None
    ) -> None:
        self._err = folder / f"stderr {next(_numbers)}"
        self._process = FORK.Process(target=_run, args=(arguments, self._err, environment, limit_bytes))
        self._process.start()

    @property
    def err(self) -> str:
        """What it has written to standard error."""
        return self._err.read_text(encoding="utf-8", errors="replace") if self._err.exists() else ""

    def poll(self) -> int | None:
        """Return its status if it has ended."""
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end, and return its status. Raises TimeoutExpired."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("a command", timeout or 0.0)
        return self._process.exitcode

    def kill(self) -> None:
        """Kill it."""
        self._process.kill()
        self._process.join()


def in_a_fork(function: Callable[..., Any], *arguments: Any, **more: Any) -> Any:
    """Return what a function returns in a copy of this process: this one is left without its threads."""
    receive, send = FORK.Pipe(duplex=False)

    def run() -> None:
        send.send(function(*arguments, **more))

    process = FORK.Process(target=run)
    process.start()
    send.close()
    try:
        return receive.recv()
    finally:
        process.join()


def import_all(arguments: Sequence[str]) -> None:
    """Import what a command imports, so that its copies need not."""
    for name in in_a_fork(_modules_of, arguments):
        with suppress(ImportError):
            import_module(name)


def _modules_of(arguments: Sequence[str]) -> list[str]:
    from todframes.cli.console import run
    from todframes.cli.main import cli

    for number in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), number)
    run(cli, [*arguments[1:]])
    return [name for name in sys.modules if not name.startswith("__")]


def _run(arguments: Sequence[str], err: Path, environment: dict[str, str], limit_bytes: int | None) -> None:
    for number, name in ((1, os.devnull), (2, str(err))):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT, 0o600), number)
    os.environ.update(environment)
    logged.log_items()
    if limit_bytes is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))
    sys.argv = list(arguments)
    status = DEFECT
    try:
        import_module(f"{arguments[0]}.__main__").main()
    except SystemExit as error:
        status = error.code if isinstance(error.code, int) else DEFECT
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)
