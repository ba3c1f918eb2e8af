"""The commands of the sensor model; only this module takes a user's paths and prints."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from todframes import __version__
from todframes.base.errors import SettingsError
from todframes.cli.console import (
    Commands,
    echo,
    finish,
    keep_libraries_to_one_thread,
    long_run,
    opened_engine,
    print_content,
    print_end,
    print_table,
    progress,
    run,
    say,
    staged,
)
from todframes.cli.options import (
    LIMITS,
    NUMBERS,
    json_option,
    launch_options,
    make_observer,
    observer_options,
    options,
    places_option,
    plan_option,
    quiet_option,
    result_options,
    run_options,
    seed_option,
    tolerance_option,
    turns_option,
    workers_option,
)

sensor_argument = click.argument("sensor", type=click.Path(path_type=Path), metavar="SENSOR.toml")

sizes_option = click.option(
    "--size-detectors", type=NUMBERS, required=True, help="Sizes √(area) in detector pitches."
)

aim_options = options(
    click.option("--target", metavar="NAME|FILE", help="Give the range of this target, as for `todframes range`."),
    click.option("--atmosphere", metavar="NAME|FILE", help="Air to the target."),
    click.option("--k", type=float, metavar="K", help="The target is seen if a triangle of size / K is."),
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
@click.option("--snr", type=NUMBERS, default=[], help="Signals of a large triangle over noise SD.")
@click.option(
    "--contrast", type=NUMBERS, default=[], help="Contrasts in place of --snr, for a camera that counts photons."
)
@click.option(
    "--trials", type=click.IntRange(1), default=40, show_default=True, help="Frames of each size and level."
)
@click.option(
    "--motion",
    "motion_mrad_per_s",
    type=float,
    metavar="MRAD_PER_S",
    help="Make each trial a clip of single frames in which the triangle moves this fast, in a random direction.",
)
@click.option(
    "--warm-up",
    "warm_up_frames",
    type=click.IntRange(0),
    default=0,
    metavar="N",
    help="Frames of the clip before each trial, which are not judged.  [default: none]",
)
@seed_option
@click.option("-o", "--out", required=True, metavar="DATASET", help="Folder to make, new or empty.")
@click.option("--format", "frame_format", type=click.Choice(["exr", "png"]), default="exr", show_default=True)
@click.option("--allow-clipping", is_flag=True, help="Let PNG clip more than 1 % of the pixels.")
@click.option(
    "--stages", is_flag=True, help="Also write the stages of a trial with the highest level as pictures."
)
@click.option(
    "--background",
    multiple=True,
    metavar="FOLDER|FILE",
    help="Images of scenes behind the triangles; repeatable. skimage: photographs that scikit-image ships.",
)
@click.option(
    "--background-pixels",
    type=float,
    default=2.0,
    show_default=True,
    metavar="N",
    help="Pixels of these images along a detector.",
)
@click.option(
    "--background-range",
    type=LIMITS,
    help="Values of these images for black and white; values between are proportional to light.  [default: sRGB]",
)
@turns_option
@workers_option
@run_options
@quiet_option
def simulate(
    *,
    sensor: Path,
    size_detectors: list[float],
    snr: list[float],
    contrast: list[float],
    trials: int,
    background: tuple[str, ...],
    out: str,
    quiet: bool,
    **asked: Any,
) -> None:
    """Make a dataset of display frames that `todframes score` reads."""
    import sensor_sim as ss
    from todframes.report.wording import count

    tell = None if quiet else say
    with (
        opened_engine(asked, quiet=quiet),
        progress("simulating", len(size_detectors) * len(snr + contrast) * trials, quiet=quiet) as advance,
    ):
        written = ss.simulate(
            sensor,
            size_detectors=size_detectors,
            snr=snr,
            contrast=contrast,
            trials=trials,
            background=background or None,
            out=out,
            tell=tell,
            progress=advance,
            **asked,
        )
    if written.clipped_share and not quiet:
        say(f"note: {100 * written.clipped_share:.2g} % of the pixels were clipped")
    with_scenes = f" with {count(written.n_scenes, 'scene')}" if written.n_scenes else ""
    echo(f"{out}: {count(written.n_frames, 'frame')}{with_scenes}")


@cli.command()
@sensor_argument
@sizes_option
@click.option(
    "--luminance",
    "luminance_cd_m2",
    type=NUMBERS,
    default=[],
    help="A curve for each of these luminances of the background in cd/m², for a camera that counts photons.",
)
@places_option
@observer_options
@tolerance_option(2e-3, "Relative error of the thresholds to reach.")
@plan_option
@seed_option
@click.option("-o", "--out", metavar="OUT", help="Folder for result.json, report.html and plots.")
@result_options
def curve(*, sensor: Path, size_detectors: list[float], out: str | None, quiet: bool, **asked: Any) -> None:
    """Compute the TOD curve of a sensor, with no frame drawn.

    Thresholds are SNR, and temperature where NETD is given. Those of a camera that counts photons are contrasts.
    """
    shown = {name: asked.pop(name) for name in ("as_json", "verbose", "explain")}
    observer, fit = make_observer(asked, fitted=False)
    import sensor_sim as ss
    from sensor_sim.chain.sensor import load_sensor

    settings = load_sensor(sensor)
    with staged(out) as place:
        with progress("computing", len(size_detectors), quiet=quiet) as advance:
            result = ss.curve(
                settings,
                size_detectors=size_detectors,
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
@sizes_option
@click.option(
    "--vary",
    "ranges",
    multiple=True,
    metavar="KEY=FROM:TO:N[:log]",
    help="Values of a number in SENSOR.toml (optics.aperture_mm) or of the observer (observer.internal_noise); "
    "repeatable, for all combinations.",
)
@click.option(
    "--design",
    type=click.Path(path_type=Path),
    metavar="DESIGNS.csv",
    help="Designs from a file instead: a column for each key, a row for each design.",
)
@click.option(
    "--sample",
    type=click.IntRange(1),
    metavar="N",
    help="N designs that cover the ranges of --vary KEY=FROM:TO[:log] evenly (Latin hypercube).",
)
@click.option("--keep-fill-factor", is_flag=True, help="Let the detectors' width follow a varied pitch.")
@click.option(
    "--couple-netd",
    is_flag=True,
    help="Let the NETD follow aperture and detectors: NETD ∝ f-number² / area of a detector.",
)
@click.option(
    "--minimise",
    metavar="COLUMN[,…]",
    help="Columns to be low for the trade-off front: varied keys, delta_t_mk, threshold_snr, "
    "threshold_contrast, acuity_mrad, acuity_detectors, range_km.  "
    "[default: delta_t_mk; with --target, range_km is high]",
)
@click.option("--maximise", metavar="COLUMN[,…]", help="Columns to be high for the trade-off front.")
@click.option("--acuity-snr", type=float, metavar="R", help="Give the smallest size visible at this SNR.")
@click.option("--acuity-delta-t-mk", type=float, metavar="T", help="Give the smallest size visible at this ΔT.")
@aim_options
@places_option
@observer_options
@tolerance_option(2e-3, "Relative error of the thresholds to reach.")
@plan_option
@seed_option
@workers_option
@click.option(
    "-o", "--out", metavar="OUT", help="Folder for sweep.csv, sweep.parquet, result.json, report.html and plots."
)
@run_options
@json_option
@quiet_option
def sweep(
    *,
    sensor: Path,
    size_detectors: list[float],
    ranges: tuple[str, ...],
    design: Path | None,
    sample: int | None,
    minimise: str | None,
    maximise: str | None,
    out: str | None,
    as_json: bool,
    quiet: bool,
    **asked: Any,
) -> None:
    """Compute the thresholds of many designs of a sensor, and which are the best trade-offs.

    A design differs from SENSOR.toml in the values of some keys. An impossible design gets a status and the
    reason; the others are computed.
    """
    observer, fit = make_observer(asked, fitted=False)
    import sensor_sim as ss
    from sensor_sim.chain.sensor import load_sensor
    from sensor_sim.sweeps.designs import Base, make_designs
    from sensor_sim.sweeps.work import Variants

    settings = load_sensor(sensor)
    base = Base(settings, Variants.of(observer).settings, asked["keep_fill_factor"])
    vary = _assigned_ranges(ranges)
    designs = make_designs(base, vary=vary, design=design, sample=sample, seed=asked["rng"])
    with long_run(out, asked, quiet=quiet) as place:
        with progress("sweeping", len(designs.values) * len(size_detectors), quiet=quiet) as advance:
            result = ss.sweep(
                settings,
                size_detectors=size_detectors,
                vary=vary if design is None else None,
                design=designs if design is not None else None,
                sample=sample,
                minimise=minimise.split(",") if minimise else (),
                maximise=maximise.split(",") if maximise else (),
                observer=observer,
                p_correct=fit.p_correct,
                progress=advance,
                **asked,
            )
        place.write(result.files)
    if as_json:
        print_content(result.to_json())
        return
    print_table(result.best())
    problems = result.problems()
    if problems is not None:
        print_table(problems)
    print_end(result.sentences(), out=out)


def _assigned_ranges(ranges: tuple[str, ...]) -> dict[str, str]:
    """Return the texts of `--vary KEY=FROM:TO:N` by key.

    Raises
    ------
    SettingsError
        If one has no key or no equals sign, or a key is there twice.
    """
    found: dict[str, str] = {}
    for text in ranges:
        key, equals, values = (part.strip() for part in text.partition("="))
        if not (key and equals):
            raise SettingsError(f"--vary: found {text!r}, expected KEY=FROM:TO:N")
        if key in found:
            raise SettingsError(f"--vary: found {key} twice, expected each key once")
        found[key] = values
    return found


@cli.command()
@sensor_argument
@click.option("-o", "--out", metavar="OUT", help="Folder for mtf.csv and mtf.png.")
@json_option
def mtf(*, sensor: Path, out: str | None, as_json: bool) -> None:
    """Compute the modulation transfer of every stage along x, before and after sampling."""
    import sensor_sim as ss
    from sensor_sim.mtf_report import TABLE_STEP

    transfer = ss.mtf(sensor)
    with staged(out) as place:
        place.write(transfer.files)
    if as_json:
        print_content(transfer.to_json())
        return
    print_table(transfer.table(TABLE_STEP))
    print_end([], out=out, is_timed=False)


@cli.command()
@sensor_argument
@click.option(
    "--frequency-nyquist",
    "frequencies",
    type=NUMBERS,
    help="Frequencies of the bars in units of Nyquist.  [default: 0.3 to 1.4]",
)
@click.option(
    "--size-detectors",
    "sizes",
    type=NUMBERS,
    help="Sizes √(area) of the triangles in detector pitches.  [default: 3,4,5,6,8]",
)
@click.option(
    "--against",
    type=click.Choice(["square", "background"]),
    default="square",
    show_default=True,
    help="Display without bars: a uniform square of their mean, or nothing.",
)
@click.option(
    "--direction",
    type=click.Choice(["upright", "lying"]),
    default="upright",
    show_default=True,
    help="Direction of the bars.",
)
@click.option(
    "--lloyd-snr",
    type=float,
    default=2.25,
    show_default=True,
    metavar="R",
    help="Threshold SNR of a bar in Lloyd's form.",
)
@click.option(
    "--ttp-delta-t-k", type=float, default=2.0, show_default=True, metavar="K", help="ΔT of the target of TTP."
)
@click.option(
    "--ttp-width-deg",
    type=float,
    default=15.0,
    show_default=True,
    metavar="W",
    help="Width of the field of TTP at the eye, in degrees.",
)
@observer_options
@tolerance_option(2e-3, "Relative error of the thresholds to reach.")
@seed_option
@click.option("-o", "--out", metavar="OUT", help="Folder for mrtd.csv, mrtd.png, result.json and other tables.")
@json_option
@quiet_option
def mrtd(
    *,
    sensor: Path,
    frequencies: list[float] | None,
    sizes: list[float] | None,
    out: str | None,
    as_json: bool,
    quiet: bool,
    **asked: Any,
) -> None:
    """Compute the thresholds of four bars (MRTD) beside the TOD, with no frame drawn.

    The model observer of the TOD judges them up to Nyquist and beyond: as a mean over the places of the bars on
    the detectors, and at the best place. Lloyd's form and TTP stand beside it. `todframes range` reads
    mrtd.csv.
    """
    observer, fit = make_observer(asked, fitted=False)
    import sensor_sim as ss
    from sensor_sim.calls.mrtd import FREQUENCIES_NYQUIST, SIZES_DETECTORS
    from sensor_sim.chain.sensor import load_sensor

    settings = load_sensor(sensor)
    of_nyquist, triangles = frequencies or FREQUENCIES_NYQUIST, sizes or SIZES_DETECTORS
    with staged(out) as place:
        with progress("computing", len(of_nyquist) + len(triangles), quiet=quiet) as advance:
            found = ss.mrtd(
                settings,
                frequency_nyquist=of_nyquist,
                size_detectors=triangles,
                observer=observer,
                p_correct=fit.p_correct,
                progress=advance,
                **asked,
            )
        place.write(found.files)
    if as_json:
        print_content(found.to_json())
        return
    print_table(found.table())
    print_table(found.tod_table())
    print_end(found.sentences(), out=out)


@cli.command()
@sensor_argument
@aim_options
@observer_options
@launch_options
def explore(*, sensor: Path, no_browser: bool, **asked: Any) -> None:
    """Open a page in the browser on which the sensor's parameters move, and its TOD curve with them.

    A server on this machine computes the numbers, and sends nothing elsewhere. Ctrl-C ends it.
    """
    observer, fit = make_observer(asked, fitted=False)
    import sensor_sim as ss

    ss.explore(
        sensor,
        observer=observer,
        p_correct=fit.p_correct,
        open_browser=not no_browser,
        tell=echo,
        warn=say,
        **asked,
    )


@cli.command()
@click.option("--emva", type=click.Path(path_type=Path), metavar="CAMERA.xml", help="Results of EMVA 1288.")
@click.option("--thermal", is_flag=True, help="A thermal camera, described by its NETD.")
@click.option("--preset", type=click.Choice(["emva_basler", "boson"]), help="A camera from public figures.")
@click.option("--focal-length-mm", type=float, required=True, help="Focal length of the lens.")
@click.option("--f-number", type=float, help="f-number of the lens.")
@click.option("--pitch-um", type=float, help="From one detector to the next on the chip.")
@click.option("--netd-mk", type=float, help="NETD of a thermal camera.")
@click.option("--wavelength-um", type=float, help="Wavelength.  [default: 0.55, thermal 10]")
@click.option("--exposure-ms", type=float, help="Exposure.  [default: that of the results, or 10]")
@click.option(
    "--luminance", type=float, default=100.0, show_default=True, help="Luminance of the background in cd/m²."
)
@click.option("--name", help="Name of the sensor.")
@click.option("-o", "--out", type=click.Path(path_type=Path), metavar="SENSOR.toml", help="File to write instead.")
def new(*, out: Path | None, **asked: Any) -> None:
    """Print a SENSOR.toml in which every key is explained.

    It is for a camera with results of EMVA 1288, a thermal camera, or one from public figures.
    """
    import sensor_sim as ss

    text = ss.new_sensor(**asked)
    if out is None:
        click.echo(text, nl=False)
        return
    from todframes.base.output import write_file

    write_file(out, text.encode())
    echo(f"written: {out}")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and end the process: status 0 done, 1 bad data, 2 bad usage or settings."""
    keep_libraries_to_one_thread()
    sys.exit(run(cli, arguments))
