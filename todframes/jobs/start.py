"""Start of other processes, which import nothing from the current folder, and leave Ctrl-C to this one."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker

from todframes.base.errors import SettingsError

THREADS_ENVIRONMENT = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "OPENCV_FOR_THREADS_NUM",
        "OPENIMAGEIO_THREADS",
    ),
    "1",
)
"""Environment in which native libraries use one thread, as processes share the processors."""

ENVIRONMENT = THREADS_ENVIRONMENT | {"PYTHONSAFEPATH": "1"}
"""Environment of new processes, which do not search the current folder."""

_lock = threading.RLock()
"""Lock held while the environment of this process is that of a new one."""


@contextmanager
def starting_processes() -> Iterator[None]:
    """Keep the current folder off the import path of processes that the block starts, and Ctrl-C from them. Python
    starts them by `python -c`, which searches the current folder first; SettingsError if this process ignores the
    environment, and others would. New processes inherit the mask of signals of the thread that starts them.
    """
    if sys.flags.ignore_environment and not sys.flags.safe_path:
        raise SettingsError(
            "workers: found python -E, whose processes search the current folder; expected python -I"
        )
    with _lock, environment_kept(ENVIRONMENT):
        os.environ.update(ENVIRONMENT)
        resource_tracker.ensure_running()  # it would lift the mask
        mask = getattr(signal, "pthread_sigmask", lambda *_: None)
        before = mask(getattr(signal, "SIG_BLOCK", 0), {signal.SIGINT})
        try:
            yield
        finally:
            mask(getattr(signal, "SIG_SETMASK", 0), before)


@contextmanager
def environment_kept(names: Iterable[str]) -> Iterator[None]:
    """Restore variables of the environment at the end of the block."""
    before = {name: os.environ.get(name) for name in names}
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
