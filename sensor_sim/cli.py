"""The commands of the sensor model; only this module takes a user's paths and prints."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from todframes import __version__
from todframes.cli.console import (
    Commands,
    echo,
    finish,
    keep_libraries_to_one_thread,
    opened_engine,
    print_table,
    progress,
    run,
    say,
    staged,
)
from todframes.cli.options import (
    json_option,
    make_observer,
    numbers,
    observer_options,
    plan_option,
    quiet_option,
    result_options,
    run_options,
    seed_option,
    tolerance_option,
)

sensor_argument = click.argument("sensor", type=click.Path(path_type=Path), metavar="SENSOR.toml")


sizes_option = click.option(
    "--size-detectors", "sizes", required=True, metavar="S[,S…]", help="Sizes √(area) in detector pitches."
)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="sensor-sim")
def cli() -> None:
    """Display frames and TOD curves from a sensor's parameters, when there is no camera.

    SENSOR.toml holds optics, detector, noise, electronics and display.
    """


@cli.command()
@sensor_argument
@sizes_option
@click.option("--snr", "snrs", required=True, metavar="R[,R…]", help="Signal of a large triangle over noise SD.")
@click.option(
    "--trials", type=click.IntRange(1), default=40, show_default=True, help="Frames of each size and SNR."
)
@seed_option
@click.option("-o", "--out", required=True, metavar="DATASET", help="Folder to make.")
@click.option("--format", "frame_format", type=click.Choice(["exr", "png"]), default="exr", show_default=True)
@click.option("--allow-clipping", is_flag=True, help="Let PNG clip more than 1 % of the pixels.")
@click.option("--overwrite", is_flag=True, help="Replace DATASET if simulate wrote all that is in it.")
@click.option("--stages", is_flag=True, help="Also write the stages of a trial with the highest SNR as pictures.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Threads that draw frames.")
@run_options
@quiet_option
def simulate(*, sensor: Path, sizes: str, snrs: str, trials: int, out: str, quiet: bool, **asked: Any) -> None:
    """Make a dataset of display frames that `todframes score` reads."""
    from sensor_sim import api

    size_detectors, snr = numbers(sizes, "--size-detectors"), numbers(snrs, "--snr")
    tell = None if quiet else say
    with (
        opened_engine(asked, quiet=quiet),
        progress("simulating", len(size_detectors) * len(snr) * trials, quiet=quiet) as advance,
    ):
        written = api.simulate(
            sensor,
            size_detectors=size_detectors,
            snr=snr,
            trials=trials,
            out=out,
            tell=tell,
            progress=advance,
            **asked,
        )
    if written.clipped_share and not quiet:
        say(f"note: {100 * written.clipped_share:.2g} % of the pixels were clipped")
    echo(f"{out}: {written.n_frames} frames")


@cli.command()
@sensor_argument
@sizes_option
@observer_options
@tolerance_option(2e-3, "Relative error of the thresholds to reach.")
@plan_option
@seed_option
@click.option("-o", "--out", metavar="OUT", help="Folder for result.json, report.html and plots.")
@result_options
def curve(*, sensor: Path, sizes: str, out: str | None, quiet: bool, **asked: Any) -> None:
    """Compute the TOD curve of a sensor, with no frame drawn.

    Thresholds are SNR, and temperature where NETD is given.
    """
    shown = {name: asked.pop(name) for name in ("as_json", "verbose", "explain")}
    observer, fit = make_observer(asked, fitted=False)
    from sensor_sim import api
    from sensor_sim.sensor import load_sensor

    settings, wanted = load_sensor(sensor), numbers(sizes, "--size-detectors")
    with staged(out) as place:
        with progress("computing", len(wanted), quiet=quiet) as advance:
            result = api.curve(
                settings,
                size_detectors=wanted,
                observer=observer,
                p_correct=fit.p_correct,
                examples=out is not None,
                progress=advance,
                **asked,
            )
        place.write(result.files)
    finish(result, f"{settings.name}: TOD curve", out=out, quiet=quiet, **shown)


@cli.command()
@sensor_argument
@click.option("-o", "--out", metavar="OUT", help="Folder for mtf.csv and mtf.png.")
@json_option
def mtf(*, sensor: Path, out: str | None, as_json: bool) -> None:
    """Compute the modulation transfer of every stage along x, before and after sampling."""
    from sensor_sim import api
    from sensor_sim.mtf_report import TABLE_STEP

    transfer = api.mtf(sensor)
    with staged(out) as place:
        place.write(transfer.files)
    if as_json:
        click.echo(transfer.to_json(), nl=False)
        return
    print_table(transfer.table(TABLE_STEP))
    if out is not None:
        echo(f"written: {out}")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and end the process: status 0 done, 1 bad data, 2 bad usage or settings."""
    keep_libraries_to_one_thread()
    sys.exit(run(cli, arguments))
