"""The commands of the sensor model; only this module takes a user's paths and prints."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from todframes import __version__
from todframes.cli.console import echo, keep_libraries_to_one_thread, run, say
from todframes.cli.runner import Command, Commands


def _show_written(written: Any, given: dict[str, Any], shown: dict[str, Any]) -> None:
    from todframes.results.wording import count

    if written.clipped_share and not shown["quiet"]:
        say(f"note: {100 * written.clipped_share:.2g} % of the pixels were clipped")
    with_scenes = f" with {count(written.n_scenes, 'scene')}" if written.n_scenes else ""
    echo(f"{given['out']}: {count(written.n_frames, 'frame')}{with_scenes}")


def _show_sensor(text: str, given: dict[str, Any], _: dict[str, Any]) -> None:
    if "file" not in given:
        click.echo(text, nl=False)
        return
    from sensor_sim.chain.new_sensor import NO_COUNTERPART
    from todframes.base.output import write_file

    for line in text.splitlines():
        if line.startswith(NO_COUNTERPART):
            say(f"note: {line.removeprefix('# ')}")
    write_file(Path(given["file"]), text.encode())
    echo(f"written: {given['file']}")


COMMANDS = {
    "advise": Command(
        "sensor_sim.limits.advise:advise",
        arguments="sensor",
        showing="json quiet",
        files="result.json, report.html, advice.csv and advice.png",
        task="computing",
    ),
    "camera": Command(
        "sensor_sim.films.measured_camera:camera",
        arguments="recording",
        showing="json quiet strict",
        files="sensor.toml, result.json, report.html, tables and pictures",
        task="computing",
    ),
    "curve": Command(
        "sensor_sim.thresholds.curve:curve",
        arguments="sensor",
        showing="explain verbose json quiet",
        files="result.json, report.html and plots",
        task="computing",
        title=lambda result, given: "" if "limit" in given else f"{result.settings['sensor']['name']}: TOD curve",
        also="sensor_sim.limits.limit:limit",
        also_if="limit",
    ),
    "explore": Command(
        "sensor_sim.explorer.explore:explore", arguments="sensor", showing="", show=lambda *_: None
    ),
    "mrtd": Command(
        "sensor_sim.four_bars.mrtd:mrtd",
        arguments="sensor",
        showing="json quiet",
        files="result.json, report.html, mrtd.csv, mrtd.png and other tables",
        task="computing",
    ),
    "mtf": Command(
        "sensor_sim.chain.mtf:mtf",
        arguments="sensor",
        showing="json",
        files="mtf.json, mtf.html, mtf.csv and mtf.png",
        is_timed=False,
    ),
    "new": Command(
        "sensor_sim.chain.new_sensor:new_sensor",
        arguments="",
        showing="",
        show=_show_sensor,
        further=(
            click.Option(
                ["-o", "--out", "file"], type=click.Path(), metavar="SENSOR.toml", help="File to write instead."
            ),
        ),
    ),
    "simulate": Command(
        "sensor_sim.frames.simulate:simulate",
        arguments="sensor",
        showing="quiet",
        task="simulating",
        show=_show_written,
    ),
    "sweep": Command(
        "sensor_sim.sweeps.sweep:sweep",
        arguments="sensor",
        showing="json quiet",
        files="sweep.csv, result.json, report.html and plots",
        task="sweeping",
    ),
    "worth": Command(
        "sensor_sim.limits.worth:worth",
        arguments="result sensor",
        showing="json quiet",
        files="result.json, report.html, worth.csv and worth.png",
        task="computing",
        without="p_correct",
    ),
}
"""Commands that are made of calls, by name."""


@click.group(
    cls=Commands,
    table=COMMANDS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
@click.version_option(__version__, prog_name="sensor-sim")
def cli() -> None:
    """Display frames and TOD curves from a sensor's parameters, when there is no camera.

    SENSOR.toml holds optics, detector, noise, electronics and display.
    """


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and end the process: status 0 done, 1 bad data, 2 bad usage or settings."""
    keep_libraries_to_one_thread()
    sys.exit(run(cli, arguments))
