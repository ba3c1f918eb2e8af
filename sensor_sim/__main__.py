"""Entry point of `sensor-sim` and `python -m sensor_sim`; it handles Ctrl-C before anything else is imported."""

import os
import sys

# `python -m` puts the current folder first on the import path. A dataset of unknown origin may lie there, and its
# files must not be imported; so this comes before any other import.
if __name__ == "__main__" and not sys.flags.safe_path:
    try:
        here = os.getcwd()  # noqa: PTH109 - pathlib would be an import
    except FileNotFoundError:
        here = ""
    if sys.path[0] in ("", here):
        del sys.path[0]

from todframes.__main__ import start


def main() -> None:
    """Run the command line and end the process."""
    start()
    from sensor_sim.cli import main as run

    run()


if __name__ == "__main__":
    main()
