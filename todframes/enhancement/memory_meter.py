"""Memory that an algorithm needs for a frame: the growth of this process while it works."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

_STATUS, _PEAK = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class MemoryMeter:
    """Meter of the memory of an algorithm on its first frames, by Linux's record of the process's peak.

    A frame during which Python modules are loaded does not count, so libraries that an algorithm loads late are
    left out. Memory that the algorithm keeps from frame to frame counts at the first of them.
    """

    def __init__(self) -> None:
        self._left = 3  # frames of each algorithm and process: a measurement takes a millisecond
        self._largest_mb: float | None = None

    def measured(self, work: Callable[[], T]) -> tuple[T, float | None]:
        """Return the result of a function, and the most memory in MB by which the process grew in a call so far.

        It is None as long as modules were loaded in all calls, and where the system does not report it.
        """
        before = _beginning() if self._left else None
        if before is None:
            return work(), self._largest_mb
        n_modules = len(sys.modules)
        result = work()
        after = _status_kb("VmHWM")
        if after is None or len(sys.modules) != n_modules:
            return result, self._largest_mb
        self._left -= 1
        self._largest_mb = max(self._largest_mb or 0.0, (after - before) / 1024.0)
        return result, self._largest_mb


def _beginning() -> int | None:
    """Give free memory back to the system, forget the peak so far, and return the memory in use in kB."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)  # else memory that is free in the process would hide growth
        _PEAK.write_text("5", encoding="ascii")
        return _status_kb("VmRSS")
    return None


def _status_kb(name: str) -> int | None:
    """Return a number of kB from the process's status; None if the system has none."""
    with suppress(OSError, ValueError):
        for line in _STATUS.read_text(encoding="ascii", errors="replace").splitlines():
            if line.startswith(f"{name}:"):
                return int(line.split()[1])
    return None
