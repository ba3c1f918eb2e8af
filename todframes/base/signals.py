"""Handlers of the signals that ask a run to end: Ctrl-C, a request to terminate, a lost connection.

This module is imported before all others, so it imports little itself.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]

STARTED_S = time.perf_counter()
"""Time at which the process began, as `time.perf_counter` counts."""

INTERRUPTED = 130
"""Exit status of an interrupted run."""

written: list[str] = []
"""Places that the present run has written; `output` adds to them, `interruption_message` names the last."""

kept: list[str] = []
"""Places where the present run has kept finished results until it is whole."""

unanswered: list[int] = []
"""Signals of the present run that were raised as KeyboardInterrupt."""


def interruption_message() -> str:
    """Return the message of an interrupted run: the last place it has written, or that nothing was written. A note
    about what is kept follows it.
    """
    if written:
        return f"interrupted, but {written[-1]} was written before"
    return "interrupted" if kept else "interrupted, nothing was written"


def end_at_once() -> None:
    """End the process with one line when a signal arrives, without cleaning up. This is for the time before a
    command runs: an exception would be shown as a traceback, or be raised in the middle of an import, where a C
    extension would print it and continue.
    """

    _handle(_end)


@contextmanager
def raised() -> Iterator[None]:
    """Raise KeyboardInterrupt in the main thread when a signal arrives. A library may lose the exception, so those
    who do the work raise it again while a signal is `unanswered`.
    """

    def interrupt(number: int, _: FrameType | None) -> None:
        unanswered.append(number)
        raise KeyboardInterrupt

    try:
        with handled(interrupt):
            yield
    finally:
        unanswered.clear()


@contextmanager
def handled(handler: Callable[..., None]) -> Iterator[None]:
    """Let a function handle the signals in the block. No effect outside the main thread, or on ignored signals."""
    before = _handle(handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _end(*_: object) -> None:
    os.write(2, f"error: {interruption_message()}\n".encode(errors="replace"))
    os._exit(INTERRUPTED)


def _handle(handler: Callable[..., None]) -> dict[int, Any]:
    """Install a handler for all signals that are not ignored (as by nohup). Returns the previous handlers."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    before = {number: signal.getsignal(number) for number in SIGNALS}
    before = {number: handler for number, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, handler)
    return before
