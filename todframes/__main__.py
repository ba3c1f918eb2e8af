"""Entry point of `todframes` and `python -m todframes`; it handles Ctrl-C before anything else is imported."""

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


def start() -> None:
    """Make Ctrl-C end the process with one line from here on, also while modules are imported."""
    try:
        from todframes.base.signals import end_at_once

        end_at_once()
        _open_closed_streams()
        os.environ["MPLBACKEND"] = "agg"  # commands show no windows, and matplotlib refuses an unknown name
        _import_matplotlib_elsewhere()
    except KeyboardInterrupt:
        os.write(2, b"error: interrupted, nothing was written\n")
        os._exit(130)


def _open_closed_streams() -> None:
    """Let closed standard streams lead nowhere; otherwise the next file that is opened would take their number. To
    print on standard output still fails: a result would be lost.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            number = os.open(os.devnull, os.O_RDONLY if name == "stdout" else os.O_RDWR)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, mode))


def _import_matplotlib_elsewhere() -> None:
    """Import matplotlib in another folder if the current one has settings, which matplotlib would read."""
    if os.path.lexists("matplotlibrc"):
        here = os.getcwd()  # noqa: PTH109
        os.chdir(os.path.dirname(__file__))  # noqa: PTH120
        try:
            import matplotlib  # noqa: F401
        finally:
            os.chdir(here)


def main() -> None:
    """Run the command line and end the process."""
    start()
    from todframes.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
