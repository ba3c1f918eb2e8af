"""The command `experiment`, which serves a page on which a person does the test."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import click

from todframes.base.locations import Location
from todframes.cli.console import echo, progress, say
from todframes.cli.options import dataset_argument, launch_options, max_frame_option


@click.command()
@dataset_argument
@click.option("-o", "--out", "answers", required=True, metavar="ANSWERS", help="Folder for the answers of people.")
@click.option(
    "--subject",
    metavar="ID",
    help="Anonymous id of the person: letters and digits.  [default: that of the only session that is not "
    "finished, or a random one]",
)
@click.option(
    "--method",
    type=click.Choice(["constant", "quest"]),
    help="Show the trials of DATASET in random order, or let QUEST+ choose the level.  [default: constant]",
)
@click.option("--trials", type=int, metavar="N", help="Trials that count.  [default: all; for quest 60 a group]")
@click.option("--practice", type=int, metavar="N", help="Trials with feedback before the test.  [default: 8]")
@click.option(
    "--practice-correct",
    type=float,
    metavar="SHARE",
    help="Share of the practice that has to be correct; else it is repeated.  [default: 0.75]",
)
@click.option("--break-every", type=int, metavar="N", help="Trials between breaks; 0: none.  [default: 60]")
@click.option(
    "--time-limit", "time_limit_s", type=float, metavar="S", help="Time to answer in s.  [default: none]"
)
@click.option(
    "--consent",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Text to which the person has to agree.  [default: a text of this package]",
)
@click.option("--contact", metavar="TEXT", help="Name and address for questions and withdrawal.")
@click.option("--background", type=float, help="Luminance of the background over that of white.  [default: 0.5]")
@click.option(
    "--no-dither",
    "dither",
    flag_value=False,
    type=bool,
    default=None,
    help="Show the nearest code value, not pixels of two of them whose mean is right.",
)
@click.option(
    "--include-flagged",
    is_flag=True,
    default=None,
    help="Count answers within 150 ms, or while the page was hidden or had lost the focus, as all others.",
)
@click.option("--seed", "rng", type=int, help="Seed of the order.  [default: a random one]")
@max_frame_option
@launch_options
def experiment(
    *,
    dataset: Location,
    answers: str,
    subject: str | None,
    consent: Path | None,
    host: str,
    port: int,
    no_browser: bool,
    max_frame_mb: int,
    **asked: Any,
) -> None:
    """Open a page in the browser on which a person says where the triangles of DATASET point.

    Each answer is on the disk before the next triangle is shown. The same command goes on with a session that is
    not finished. Ctrl-C ends the server.
    """
    from todframes.frames.dataset import load_dataset
    from todframes.web import calls as api

    data = load_dataset(dataset, max_frame_mb=max_frame_mb)
    with ExitStack() as reading:
        advance = reading.enter_context(progress("reading", None))

        def tell(address: str) -> None:
            reading.close()
            echo(address)

        found = api.run_experiment(
            data,
            answers,
            subject=subject,
            **asked,
            consent=consent,
            host=host,
            port=port,
            open_browser=not no_browser,
            tell=tell,
            warn=say,
            progress=advance,
        )
    rest = "" if found.n_answered == found.n_trials else "; the same command goes on"
    flagged = f", {found.n_flagged} with a flag" if found.n_flagged else ""
    echo(f"{answers}: subject {found.subject}, {found.n_answered} of {found.n_trials} trials{flagged}{rest}")
