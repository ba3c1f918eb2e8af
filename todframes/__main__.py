"""The commands `todframes` and `python -m todframes`, ready for Ctrl-C before anything else is imported."""

import os


def start() -> None:
    """Make Ctrl-C end the process with one line from here on, also while modules are imported."""
    try:
        from todframes.signals import end_at_once

        end_at_once()
    except KeyboardInterrupt:
        os.write(2, b"error: interrupted, nothing was written\n")
        os._exit(130)


def main() -> None:
    """Run the command line and end the process."""
    start()
    from todframes.cli import main as run

    run()


if __name__ == "__main__":
    main()
