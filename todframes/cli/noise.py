"""The command `noise`: three-dimensional noise of a recording, and noise as EMVA 1288 defines it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from todframes.base.errors import SettingsError
from todframes.cli.console import print_content, print_end, print_table, progress, staged
from todframes.cli.options import (
    BOX,
    NUMBERS,
    box,
    json_option,
    max_frame_option,
    quiet_option,
    rate_option,
    strict_option,
)

if TYPE_CHECKING:
    from todframes.report.emva_report import EmvaResult
    from todframes.report.noise_report import NoiseResult


@click.command()
@click.argument("recording", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "-o", "--out", metavar="OUT", help="Folder for result.json, tables, a picture and sensor_noise.toml."
)
@click.option(
    "--dark",
    multiple=True,
    type=click.Path(path_type=Path),
    help="A recording of dark frames: EMVA 1288, each RECORDING being a bright stack; repeatable, one for all or "
    "one for each in the same order.",
)
@click.option(
    "--emva",
    type=click.Path(path_type=Path),
    metavar="DESCRIPTOR",
    help="Descriptor file of an EMVA 1288 measurement, in place of RECORDING.",
)
@click.option(
    "--exposure-ms", type=NUMBERS, help="With --dark: exposure of each bright stack, for the dark current."
)
@click.option(
    "--photons",
    type=NUMBERS,
    help="With --dark: photons of a pixel in each bright stack, for the quantum efficiency.",
)
@click.option(
    "--bits", type=int, help="With --dark: number of bits of a pixel's value.  [default: from the files]"
)
@click.option("--region", type=BOX, help="Left column, top row, width and height.  [default: all]")
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
@click.option("--signal", type=NUMBERS, help="Differences of the values; prints their signal-to-noise ratios.")
@click.option(
    "--mk-per-count",
    type=float,
    metavar="MK",
    help="Temperature difference in mK for one count.  [default: from the constants of a radiometric file]",
)
@rate_option
@max_frame_option
@click.option("--sensor", is_flag=True, help="Print the table [noise] of a SENSOR.toml and nothing else.")
@strict_option
@json_option
@quiet_option
def noise(
    *,
    recording: tuple[Path, ...],
    out: str | None,
    dark: tuple[Path, ...],
    emva: Path | None,
    exposure_ms: list[float] | None,
    photons: list[float] | None,
    bits: int | None,
    region: tuple[int, int, int, int] | None,
    patches: tuple[str, ...],
    chart: Path | None,
    signal: list[float] | None,
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

    With --dark or --emva it is that of EMVA 1288: gain, dark noise, nonuniformities and saturation of a linear
    camera, from bright and dark frames.

    Without -o nothing is written.
    """
    if sensor and as_json:
        raise SettingsError("noise: found --sensor and --json, expected one of them")
    import todframes as tod

    is_emva = emva is not None or bool(dark)
    _check_used(
        is_emva=is_emva,
        of_emva={"--exposure-ms": exposure_ms, "--photons": photons, "--bits": bits},
        of_others={
            "--patch": patches or None,
            "--signal": signal,
            "--mk-per-count": mk_per_count,
            "--frames-per-second": frames_per_second,
        },
    )
    if not recording and not is_emva:
        raise SettingsError("noise: found no RECORDING, expected one, or --emva DESCRIPTOR")
    result: NoiseResult | EmvaResult
    with staged(out) as place:
        with progress("reading", None, quiet=quiet) as advance:
            if is_emva:
                result = tod.emva_noise(
                    emva,
                    bright=recording,
                    dark=dark,
                    exposure_ms=exposure_ms or (),
                    photons=photons or (),
                    bits=bits,
                    region=region,
                    chart=chart,
                    max_frame_mb=max_frame_mb,
                    progress=advance,
                )
            else:
                result = tod.noise(
                    recording,
                    region=region,
                    patches=dict(map(_patch, patches)),
                    chart=chart,
                    signal=signal or (),
                    mk_per_count=mk_per_count,
                    frames_per_second=frames_per_second,
                    max_frame_mb=max_frame_mb,
                    progress=advance,
                )
        content = result.sensor_toml() if sensor else result.to_json() if as_json else None
        place.write(result.files)
    if content is not None:
        print_content(content, result.warnings, quiet=quiet, strict=strict)
        return
    for table in (result.table(), *result.more_tables()):
        print_table(table)
    print_end(result.sentences(), result.warnings, out=out, strict=strict, is_timed=False)


def _check_used(*, is_emva: bool, of_emva: dict[str, object], of_others: dict[str, object]) -> None:
    """Raise SettingsError if an option of one kind of measurement is given with the other."""
    for option, value in (of_others if is_emva else of_emva).items():
        if value is not None:
            other = "is not used with EMVA 1288" if is_emva else "needs --dark, the dark frames"
            raise SettingsError(f"{option}: {other}")


def _patch(text: str) -> tuple[tuple[int, int, int, int], float]:
    place, _, level = text.partition("=")
    try:
        return box(place, "--patch"), float(level)
    except (ValueError, SettingsError):
        raise SettingsError(
            f"--patch: found {text!r}, expected X,Y,W,H=LEVEL: four whole numbers and one"
        ) from None
