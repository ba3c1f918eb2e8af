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

NO_KEY = "-"
"""Line for an item whose result is not kept."""


def log_items() -> None:
    """Have the items of all work logged by their keys, and the windows of an import by their names."""
    from todframes.importing import windows
    from todframes.jobs import run

    log = os.open(os.environ["CAMPAIGN_LOG"], os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    item_s = float(os.environ.get("CAMPAIGN_ITEM_S", "0"))
    function_of, write_window = run.Keyed.function, windows.write_window

    def function(keyed: Any) -> Callable[[Any], Any]:
        inner = function_of(keyed)
        if keyed.is_key_alone:
            return inner

        def do(item: Any) -> Any:
            time.sleep(item_s)
            result = inner(item)
            os.write(log, f"{NO_KEY if result[0] is None else result[0].hex()}\n".encode())
            return result

        return do

    def write(path: Any, *window: Any, clip: bool) -> Any:
        time.sleep(item_s)
        written = write_window(path, *window, clip=clip)
        os.write(log, f"{path.parent.name}/{path.name}\n".encode())
        return written

    run.Keyed.function = function
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
