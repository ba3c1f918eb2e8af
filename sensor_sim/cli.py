"""The commands of the sensor model; the only place that takes a user's paths and prints."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from todframes import __version__
from todframes.cli.console import (
    Commands,
    echo,
    keep_libraries_to_one_thread,
    print_result,
    print_table,
    progress,
    run,
    say,
)
from todframes.cli.options import json_option, make_observer, numbers, observer_options, plan_options, seed_option
from todframes.errors import SettingsError

if TYPE_CHECKING:
    from todframes._typing import Json


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
@click.option("--stages", is_flag=True, help="Also write the stages of the first trial as pictures.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Threads that draw frames.")
@click.option("--quiet", is_flag=True, help="No progress and no remarks on standard error.")
def simulate(
    *,
    sensor: Path,
    sizes: str,
    snrs: str,
    trials: int,
    seed: int,
    out: str,
    frame_format: Any,
    allow_clipping: bool,
    overwrite: bool,
    stages: bool,
    workers: int,
    quiet: bool,
) -> None:
    """Make a dataset of display frames that `todframes score` reads."""
    from sensor_sim.sensor import load_sensor
    from sensor_sim.simulate import plan_trials, write_dataset
    from todframes.output import new_folder

    settings = load_sensor(sensor)
    planned = plan_trials(numbers(sizes, "--size-detectors"), numbers(snrs, "--snr"), trials)
    with (
        new_folder(out, overwrite=overwrite) as folder,
        progress("simulating", len(planned), quiet=quiet) as advance,
    ):
        written = write_dataset(
            folder,
            settings,
            planned,
            seed=seed,
            frame_format=frame_format,
            allow_clipping=allow_clipping,
            workers=workers,
            progress=advance,
        )
        if stages:
            from sensor_sim.pictures import write_stages

            write_stages(folder / "stages", settings, planned[0], seed=seed)
    if written.clipped_share and not quiet:
        say(f"note: {100 * written.clipped_share:.2g} % of the pixels were clipped")
    echo(f"{out}: {written.n_frames} frames")


@cli.command()
@sensor_argument
@sizes_option
@observer_options
@click.option(
    "--tolerance", type=float, default=2e-3, show_default=True, help="Relative error of the thresholds to reach."
)
@plan_options
@seed_option
@click.option("-o", "--out", metavar="OUT", help="Folder for result.json, report.html and plots.")
@json_option
@click.option("--quiet", is_flag=True, help="No progress on standard error.")
def curve(
    *,
    sensor: Path,
    sizes: str,
    tolerance: float,
    plan_name: Any,
    explain: bool,
    seed: int,
    out: str | None,
    as_json: bool,
    quiet: bool,
    **observer_arguments: Any,
) -> None:
    """The TOD curve of a sensor, with no frame drawn: threshold SNR, and temperature where NETD is given."""
    start = time.perf_counter()
    observer, fit_settings, described = make_observer(**observer_arguments, fitted=False)
    from dataclasses import asdict

    from sensor_sim.curve_plan import plan_curve
    from sensor_sim.noise import delta_t_mk
    from sensor_sim.predict import FoldedChain, predict_threshold
    from sensor_sim.sensor import load_sensor
    from todframes import output
    from todframes.report import convert as report
    from todframes.scoring.error_budget import Step, plan_object

    settings = load_sensor(sensor)
    p_correct = fit_settings.p_correct
    fits: list[Json] = []
    wanted = numbers(sizes, "--size-detectors")
    if len(set(wanted)) < len(wanted):
        raise SettingsError(f"--size-detectors: found a value twice in {sizes!r}, expected each once")
    with _staging(out) as staging:
        with progress("computing", len(wanted), quiet=quiet) as advance:
            for size in wanted:
                started = time.perf_counter()
                plan = plan_curve(
                    settings, observer, size, name=plan_name, tolerance=tolerance, p_correct=p_correct
                )
                chain = FoldedChain(settings, observer, size, plan)
                found = predict_threshold(chain, p_correct=p_correct, tolerance=tolerance, seed=seed)
                snr = found.threshold
                one = report.computed_threshold_object(
                    {"size_detectors": size}, "snr", p_correct, found.status, snr, found.numerical_error
                )
                one["points"] = [{"level": x, "n_trials": 0, "p_correct": p} for x, p in found.points]
                one |= {"n_phases": found.n_phases, "p_correct_error_bound": chain.non_gaussian_bound()}
                phases = Step("phases", True, f"{found.n_phases} trials, as the tolerance takes")
                one |= {
                    "plan": plan_object((*plan.steps, phases), chain.drawing_s / plan.unit_s),
                    "p_correct_left_out_bound": plan.bound,
                }
                one["run_time_s"] = round(time.perf_counter() - started, 4)
                if settings.noise.netd_mk is not None:
                    one["delta_t_mk"] = None if snr is None else float(delta_t_mk(snr, noise=settings.noise))
                fits.append(one)
                advance(1)
        more: Json = {}
        if staging is not None:
            from sensor_sim.pictures import threshold_examples

            more["examples"] = threshold_examples(settings, observer, fits, seed=seed)
        result = report.result_object(
            "curve",
            settings=described | {"sensor": asdict(settings), "tolerance": tolerance, "plan": plan_name},
            seed=seed,
            fits=fits,
            skipped=[],
            **more,
            run_time_s=time.perf_counter() - start,
        )
        if staging is not None:
            from todframes.report.figures import plots
            from todframes.report.html import report_html

            files = {**plots(result), "report.html": report_html(result), "result.json": report.encode(result)}
            output.write_files(staging, files)
    print_result(result, f"{settings.name}: TOD curve", as_json=as_json, explain=explain)
    if not as_json:
        echo(*report.closing_line(result).splitlines())
        if out is not None:
            echo(f"written: {out}")


@contextmanager
def _staging(out: str | None) -> Iterator[Path | None]:
    from todframes.output import output_folder

    if out is None:
        yield None
        return
    with output_folder(out) as folder:
        yield folder


@cli.command()
@sensor_argument
@click.option("-o", "--out", metavar="OUT", help="Folder for mtf.csv and mtf.png.")
@json_option
def mtf(*, sensor: Path, out: str | None, as_json: bool) -> None:
    """Modulation transfer of every stage along x, before and after sampling."""
    from sensor_sim.mtf_report import mtf_files, mtf_object, mtf_table
    from sensor_sim.sensor import load_sensor
    from todframes import output
    from todframes.report import convert as report

    settings = load_sensor(sensor)
    result = mtf_object(settings)
    with _staging(out) as staging:
        if staging is not None:
            output.write_files(staging, mtf_files(result))
    if as_json:
        click.echo(report.encode(result), nl=False)
        return
    print_table(mtf_table(result))
    if out is not None:
        echo(f"written: {out}")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and end the process: status 0 done, 1 bad data, 2 bad usage or settings."""
    keep_libraries_to_one_thread()
    sys.exit(run(cli, arguments))
