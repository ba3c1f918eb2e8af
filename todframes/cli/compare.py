"""The commands about enhancement: `compare` and `enhancements`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import click

from todframes.base.errors import SettingsError
from todframes.base.locations import Location
from todframes.cli.console import finish, long_run, print_table, prints_go_to_stderr, progress, say
from todframes.cli.options import (
    PASSES,
    ScoringCommand,
    dataset_argument,
    json_option,
    make_observers,
    observer_options,
    result_options,
    run_options,
    scoring_options,
    strict_option,
)


@click.command(cls=ScoringCommand)
@dataset_argument
@click.option(
    "--enhance",
    "specs",
    multiple=True,
    required=True,
    metavar="SPEC",
    help="Algorithm: NAME, MODULE:FUNCTION (whose code is run), or onnx:FILE (a network, which is run), each "
    "also with :PARAMETER=VALUE,… behind; repeatable.",
)
@click.option(
    "-o",
    "--out",
    metavar="OUT",
    help="Folder for result.json, report.html, compare.csv, scores.csv, contrast_response.csv and pictures.",
)
@click.option(
    "--white", type=float, default=1.0, show_default=True, help="Code value that algorithms take as white."
)
@click.option("--allow-clipping", is_flag=True, help="Clip what algorithms take beyond the display's range.")
@observer_options
@scoring_options
@run_options
@result_options
@strict_option
def compare(*, dataset: Location, specs: Sequence[str], out: str | None, quiet: bool, **asked: Any) -> None:
    """Test whether enhancement algorithms lower the thresholds of DATASET, by how much and how surely.

    Each is compared with the frames as they are, on the same frames and with the same random draws. `todframes
    enhancements` lists the algorithms of the package. With several observers, --observer pyramid,csf, each gives a
    verdict, and the first lines say where they disagree. Without -o nothing is written.
    """
    shown = {name: asked.pop(name) for name in ("as_json", "verbose", "explain", "strict")}
    observers, fit = make_observers(asked)
    import todframes as tod
    from todframes.frames.dataset import load_dataset

    data = load_dataset(dataset, max_frame_mb=asked.pop("max_frame_mb"))
    with long_run(out, asked, quiet=quiet) as place, prints_go_to_stderr():
        with progress("comparing", len(data.trials) * PASSES[asked["locate"]], quiet=quiet) as advance:
            result = tod.compare(
                data, specs, observer=observers, fit=fit, examples=out is not None, progress=advance, **asked
            )
        place.write(result.files)
    n_trials = sum(one.n_trials for one in result.algorithms[0].fits)
    finish(result, f"{dataset}: {n_trials} trials", out=out, quiet=quiet, **shown)


@click.command()
@json_option
def enhancements(*, as_json: bool) -> None:
    """List the enhancement algorithms that are registered, with their parameters."""
    import msgspec

    from todframes import __version__
    from todframes.enhancement.finding import enhancement_names, find_enhancement
    from todframes.report.data import SCHEMA, enhancement_record
    from todframes.report.tables import enhancements as enhancements_table

    found = []
    for name in enhancement_names():
        try:
            with prints_go_to_stderr():
                found.append(find_enhancement(name))
        except SettingsError as error:  # raised by an algorithm of another package
            say(f"left out: {error}")
    listed = [enhancement_record(one) for one in found]
    if not as_json:
        print_table(enhancements_table(listed))
        return
    result = {"schema": SCHEMA, "command": "enhancements", "version": __version__, "enhancements": listed}
    click.echo(msgspec.json.format(msgspec.json.encode(result), indent=2))
