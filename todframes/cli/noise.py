"""The command `noise`: three-dimensional noise of a recording."""

from __future__ import annotations

import textwrap
from pathlib import Path

import click

from todframes.base.errors import SettingsError
from todframes.cli.console import (
    check_strict,
    echo,
    print_table,
    progress,
    say,
    staged,
    terminal_width,
    warning_lines,
)
from todframes.cli.options import box, json_option, max_frame_option, numbers, quiet_option, strict_option


@click.command()
@click.argument("recording", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o", "--out", metavar="OUT", help="Folder for result.json, noise.csv, noise.png and sensor_noise.toml."
)
@click.option("--region", metavar="X,Y,W,H", help="Left column, top row, width and height.  [default: all]")
@click.option(
    "--patch",
    "patches",
    multiple=True,
    metavar="X,Y,W,H=LEVEL",
    help="A uniform part of the frame and its luminance, reflectance or temperature, for the signal transfer; "
    "repeatable.",
)
@click.option(
    "--chart",
    type=click.Path(path_type=Path),
    metavar="CHART.toml",
    help="The chart that RECORDING shows: its patches are found by its markers, and the largest is the region.",
)
@click.option("--signal", metavar="S[,S…]", help="Differences of the values; prints their signal-to-noise ratios.")
@click.option(
    "--mk-per-count",
    type=float,
    metavar="MK",
    help="Temperature difference in mK for one count.  [default: from the constants of a radiometric file]",
)
@click.option(
    "--frames-per-second", type=float, metavar="F", help="Frame rate in place of what the files say, if they do."
)
@max_frame_option
@click.option("--sensor", is_flag=True, help="Print the table [noise] of a SENSOR.toml and nothing else.")
@strict_option
@json_option
@quiet_option
def noise(
    *,
    recording: tuple[Path, ...],
    out: str | None,
    region: str | None,
    patches: tuple[str, ...],
    chart: Path | None,
    signal: str | None,
    mk_per_count: float | None,
    frames_per_second: float | None,
    max_frame_mb: int,
    sensor: bool,
    strict: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure the noise of RECORDING, which shows a uniform scene that does not move.

    RECORDING is a video, a sequence of images or a folder of them, camera raw or thermal files, or an array.
    The noise is that of time, rows and columns (D'Agostino & Webb 1991), each part with a 95 % interval.

    Without -o nothing is written.
    """
    if sensor and as_json:
        raise SettingsError("noise: found --sensor and --json, expected one of them")
    import todframes as tod

    with staged(out) as place:
        with progress("reading", None, quiet=quiet) as advance:
            result = tod.noise(
                recording,
                region=None if region is None else box(region, "--region"),
                patches=dict(map(_patch, patches)),
                chart=chart,
                signal=() if signal is None else numbers(signal, "--signal"),
                mk_per_count=mk_per_count,
                frames_per_second=frames_per_second,
                max_frame_mb=max_frame_mb,
                progress=advance,
            )
        table = result.sensor_toml() if sensor else None
        place.write(result.files)
    warnings = result.warnings
    if table is not None or as_json:
        for line in warning_lines(warnings):
            say(line)
        click.echo(result.to_json() if table is None else table, nl=False)
        check_strict(warnings, strict)
        return
    print_table(result.table())
    for table_of in (result.snr_table(), result.patch_table()):
        if table_of is not None:
            print_table(table_of)
    for sentence in [*result.sentences(), *warning_lines(warnings)]:
        echo(*textwrap.wrap(sentence, terminal_width()))
    if out is not None:
        echo(f"written: {out}")
    check_strict(warnings, strict)


def _patch(text: str) -> tuple[tuple[int, int, int, int], float]:
    place, _, level = text.partition("=")
    try:
        return box(place, "--patch"), float(level)
    except (ValueError, SettingsError):
        raise SettingsError(
            f"--patch: found {text!r}, expected X,Y,W,H=LEVEL: four whole numbers and one"
        ) from None
