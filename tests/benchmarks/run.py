"""Runs the benchmarks of this folder and prints a table: what was measured, how much, what was asked."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

from todframes.cli.console import keep_libraries_to_one_thread

HERE = Path(__file__).parent


def main(names: list[str]) -> None:
    """Run the named ones, or all."""
    keep_libraries_to_one_thread()
    sys.path.insert(0, str(HERE))
    for path in sorted(HERE.glob("bench_*.py")):
        if not names or path.stem.removeprefix("bench_") in names:
            for row in importlib.import_module(path.stem).rows():
                print(f"{row.name:<76} {row.measured:>8.3g}   asked {row.asked}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
