"""The command `new`, which makes a folder of frames a dataset."""

from __future__ import annotations

from pathlib import Path

import click

from todframes.cli.console import echo, say
from todframes.cli.options import display_option, folder_argument

FILES_SHOWN = 3
"""Number of files that do not match whose names are printed."""


@click.command()
@folder_argument
@click.option(
    "--from",
    "pattern",
    required=True,
    metavar="PATTERN",
    help="Path of the frames relative to DATASET, with the columns of the manifest in braces, as in "
    "'frames/s{size_mrad}_c{contrast}_{orientation}_{n}.png'. * stands for any text.",
)
@display_option
@click.option(
    "--level",
    default="contrast",
    show_default=True,
    metavar="COLUMN",
    help="Column with the stimulus strength.",
)
def new(*, dataset: Path, pattern: str, display: str, level: str) -> None:
    """Make a folder of frames, DATASET, a dataset: write its manifest.csv and dataset.toml from file names.

    size_mrad is √(area) as displayed, in mrad at the eye, and orientation one of up, right, down, left, or its
    first letter. Numbers may be written 0.05, 0,05 or 0p05.
    """
    from todframes.importing.file_names import new_dataset
    from todframes.report.wording import count

    found = new_dataset(dataset, pattern, display=display, level=level)
    if found.unmatched:
        names = ", ".join(found.unmatched[:FILES_SHOWN]) + (", …" if len(found.unmatched) > FILES_SHOWN else "")
        say(f"note: {count(len(found.unmatched), 'file')} beside the frames without a match, left out: {names}")
    echo(f"written: {dataset / 'dataset.toml'}, and {dataset / 'manifest.csv'}: {count(found.n_frames, 'frame')}")
    echo(f"The display is {display}. Check frames, sizes and display: todframes validate {dataset}")
