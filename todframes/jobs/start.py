"""Start of other processes, which import nothing from the current folder."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from todframes.errors import SettingsError

SAFE_PATH = "PYTHONSAFEPATH"

_lock = threading.RLock()
"""Lock held while the environment of this process is that of a new one."""


@contextmanager
def safe_path() -> Iterator[None]:
    """Keep the current folder off the import path of processes that are started in the block.

    Python starts processes by `python -c`, which searches the current folder first; a dataset of unknown origin
    may lie there. What starts first may be the resource tracker of `multiprocessing`, so this holds for the making
    of queues and shared memory, too.

    Raises
    ------
    SettingsError
        If this process ignores the environment, and others would.
    """
    if sys.flags.ignore_environment and not sys.flags.safe_path:
        raise SettingsError(
            "workers: found python -E, whose processes search the current folder; expected python -I"
        )
    with _lock:
        before = os.environ.get(SAFE_PATH)
        os.environ[SAFE_PATH] = "1"
        try:
            yield
        finally:
            os.environ.pop(SAFE_PATH, None)
            if before is not None:
                os.environ[SAFE_PATH] = before
