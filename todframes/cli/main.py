"""The group of all commands of `todframes`, and its entry point.

A command is made when it is asked for, and NumPy is imported when it runs.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import click

from todframes import __version__
from todframes.cli.commands import COMMANDS
from todframes.cli.console import keep_libraries_to_one_thread, run
from todframes.cli.runner import Commands

OTHERS = {
    "accuracy": "todframes.cli.others:accuracy",
    "enhancements": "todframes.cli.others:enhancements",
    "report": "todframes.cli.others:report_command",
    "stability": "todframes.cli.others:stability",
}
"""Module and attribute of each command that is not made of a call."""


@click.group(
    cls=Commands,
    table=COMMANDS,
    modules=OTHERS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="todframes")
def cli() -> None:
    """How small or faint may a triangle get before a display chain hides where it points?

    Shows the display frames (EXR, PNG) of a Triangle Orientation Discrimination test to a model observer and
    reports the thresholds. Angles are in mrad, luminance in cd/m², contrast is Weber contrast.
    """


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and end the process: status 0 done, 1 bad data, 2 bad usage or settings."""
    keep_libraries_to_one_thread()
    sys.exit(run(cli, arguments))
