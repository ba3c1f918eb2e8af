"""A command, or a worker of Dask, that writes into a log what it does: a line for each item when it is done.

    python logged.py todframes score DATASET -o OUT
    dask worker ADDRESS --preload logged.py

The environment says how: `CAMPAIGN_LOG`, the log; `CAMPAIGN_ITEM_S`, the time that each item takes in addition.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any


def log_items() -> None:
    """Have the items of all work logged by their keys, and the windows of an import by their names."""
    from sensor_sim.frames.dataset import SimulationWork
    from sensor_sim.sweeps.work import SweepWork
    from todframes.importing import windows
    from todframes.scoring.work import TrialWork

    log = os.open(os.environ["CAMPAIGN_LOG"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    item_s, write_window = float(os.environ.get("CAMPAIGN_ITEM_S", "0")), windows.write_window

    def logged(function_of: Callable[[Any], Callable[[Any], Any]]) -> Callable[[Any], Callable[[Any], Any]]:
        def function(work: Any) -> Callable[[Any], Any]:
            inner = function_of(work)

            def do(item: Any) -> Any:
                time.sleep(item_s)
                result = inner(item)
                os.write(log, f"{work.item_identity(item)}\n".encode())
                return result

            return do

        return function

    def write(path: Any, *window: Any, clip: bool) -> Any:
        time.sleep(item_s)
        written = write_window(path, *window, clip=clip)
        os.write(log, f"{path.parent.name}/{path.name}\n".encode())
        return written

    for work in (SimulationWork, SweepWork, TrialWork):
        work.function = logged(work.function)  # type: ignore[method-assign]
    windows.write_window = write


def dask_setup(_: object) -> None:
    """Prepare a worker; Dask calls this."""
    log_items()


if __name__ == "__main__":
    sys.argv = sys.argv[1:]
    module = import_module(f"{sys.argv[0]}.__main__")
    log_items()
    module.main()
elif __name__ == "__mp_main__":  # a process of `--workers`
    log_items()
