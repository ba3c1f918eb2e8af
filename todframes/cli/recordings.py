"""The command `import`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import click

from todframes.base.errors import SettingsError
from todframes.cli.console import print_sentences, progress, say, warning_lines
from todframes.cli.options import (
    dataset_out_option,
    display_option,
    max_frame_option,
    quiet_option,
    range_option,
    rate_option,
    restart_options,
)

UNITS_S = {"": 1.0, "s": 1.0, "ms": 1e-3}
"""Units of a time on the command line, in seconds."""


@click.command("import")
@click.argument("recordings", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="RECORDING…")
@click.option("--chart", type=click.Path(path_type=Path), metavar="FILE", help="chart.toml of the recorded chart.")
@click.option(
    "--schedule",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="CSV file with what each part of the recordings shows, instead of a chart: columns file, start_s, end_s, "
    "orientation, size_mrad, the level; x_px, y_px if known.",
)
@dataset_out_option
@display_option
@click.option(
    "--integration-time",
    default="0.1 s",
    show_default=True,
    metavar="TIME",
    help="Time in which the observer averages frames, in s or ms; all: each clip is one trial.",
)
@click.option(
    "--steady",
    is_flag=True,
    help="Let windows follow the triangle by whole pixels, against shake that the camera in use does not have.",
)
@click.option(
    "--warm-up",
    "warm_up_frames",
    type=click.IntRange(0),
    default=0,
    metavar="N",
    help="Recorded frames before each run of trials, which are not judged: for filters of several frames.  "
    "[default: none]",
)
@range_option
@rate_option
@click.option(
    "--ifov-mrad",
    type=float,
    metavar="A",
    help="With --schedule: angle of a recorded pixel at the camera; size_mrad is then an angle there.",
)
@click.option(
    "--level",
    metavar="COLUMN",
    help="With --schedule: the stimulus strength.  [default: contrast]",
)
@max_frame_option
@restart_options
@quiet_option
def import_command(
    *,
    recordings: tuple[Path, ...],
    out: str,
    integration_time: str,
    frames_per_second: float | None,
    max_frame_mb: int,
    quiet: bool,
    **asked: Any,
) -> None:
    """Make a dataset from RECORDING…, which show a chart of `todframes chart`, or what a schedule says.

    Videos, image files and folders of them, camera raw, thermal and NumPy files. The markers of the chart show
    which page a frame shows and where its triangles are; windows are cut about them, with values untouched.
    `todframes score` reads the dataset; import.json in it lists what was found.
    """
    if (asked["chart"] is None) == (asked["schedule"] is None):
        raise SettingsError("import: expected one of --chart and --schedule, which says what is shown")
    time_s = seconds(integration_time)
    from todframes.importing.importing import import_recordings, open_for_import
    from todframes.report.data import ResultWarning
    from todframes.report.wording import count

    opened = open_for_import(
        recordings,
        asked["schedule"],
        level=asked["level"],
        frames_per_second=frames_per_second,
        max_frame_mb=max_frame_mb,
    )
    numbers = [one.n_frames for one in opened]
    total = None if None in numbers else sum(number or 0 for number in numbers)
    with progress("importing", total, quiet=quiet) as advance:
        done = import_recordings(
            opened,
            out=out,
            integration_time_s=time_s,
            tell=None if quiet else say,
            progress=advance,
            **asked,
        )
    if not quiet:
        for note in done.notes:
            say(f"note: {note}")
        for line in warning_lines([ResultWarning(**one._asdict()) for one in done.warnings]):
            say(line)
    sentence = (
        f"{out}: {done.n_frames} frames in {count(done.n_trials, 'trial')} from {count(done.n_clips, 'clip')}"
    )
    print_sentences([sentence])


def seconds(text: str) -> float | Literal["all"]:
    """Return a time in seconds from a text such as "0.1 s" or "100 ms"; "all" as it is.

    Raises
    ------
    SettingsError
        If it is none of these.
    """
    stripped = text.strip()
    if stripped == "all":
        return "all"
    number = stripped.rstrip("ms ")
    unit = stripped[len(number) :].strip()
    try:
        return float(number) * UNITS_S[unit]
    except (ValueError, KeyError):
        raise SettingsError(f"--integration-time: found {text!r}, expected a time such as 0.1 s, or all") from None
