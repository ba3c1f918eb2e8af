"""A command that writes into a log what it does: a line for each item when it is done.

    python logged.py todframes score DATASET -o OUT

The environment says how: `CAMPAIGN_LOG`, the log; `CAMPAIGN_ITEM_S`, the time that each item takes in addition.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple


class Logged(NamedTuple):
    """Work that logs each item when it is done."""

    work: Any
    log: str
    item_s: float

    def function(self) -> Callable[[Any], Any]:
        inner, log = self.work.function(), os.open(self.log, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)

        def do(item: Any) -> Any:
            time.sleep(self.item_s)
            result = inner(item)
            os.write(log, f"{self.work.item_identity(item)}\n".encode())
            return result

        return do

    def name(self, item: Any) -> str:
        return str(self.work.name(item))


def log_items() -> None:
    """Have the items of all work logged by their identities, and the windows of an import by their names."""
    from todframes.importing import windows
    from todframes.jobs import processes, work

    log, item_s = os.environ["CAMPAIGN_LOG"], float(os.environ.get("CAMPAIGN_ITEM_S", "0"))
    run, packed, write_window = work.LocalEngine.run, processes.ProcessEngine.packed, windows.write_window

    def write(path: Any, *window: Any, clip: bool) -> Any:
        time.sleep(item_s)
        written = write_window(path, *window, clip=clip)
        with Path(log).open("a", encoding="utf-8") as file:
            file.write(f"{path.parent.name}/{path.name}\n")
        return written

    # A class of the command's own module goes to other processes with its code.
    work.LocalEngine.run = lambda engine, own, items: run(engine, Logged(own, log, item_s), items)
    processes.ProcessEngine.packed = lambda engine, own: packed(engine, Logged(own, log, item_s))
    windows.write_window = write


if __name__ == "__main__":
    sys.argv = sys.argv[1:]
    module = import_module(f"{sys.argv[0]}.__main__")
    log_items()
    module.main()
