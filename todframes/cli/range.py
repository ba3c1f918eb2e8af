"""The command `range`: how far a person with a sensor can do a task."""

from __future__ import annotations

from pathlib import Path

import click

from todframes.base.errors import SettingsError
from todframes.cli.console import print_content, print_end, print_table, staged
from todframes.cli.options import NUMBERS, json_option, numbers, seed_option, strict_option


@click.command("range")
@click.argument("result", type=click.Path(path_type=Path), metavar="RESULT")
@click.option(
    "--target", required=True, metavar="NAME|FILE", help="TARGET.toml; or nato, nato_daylight, person or r46."
)
@click.option(
    "--atmosphere",
    required=True,
    metavar="NAME|FILE",
    help="ATMOSPHERE.toml; or visible, swir, mwir or lwir with _23km or _5km, which are examples.",
)
@click.option(
    "-o",
    "--out",
    metavar="OUT",
    help="Folder for result.json, report.html, ranges.csv, probability.csv and plots.",
)
@click.option(
    "--k", type=NUMBERS, metavar="K[,K…]", help="For a TOD: the target is seen if a triangle of size / K is."
)
@click.option(
    "--cycles", metavar="NAME|N[,N…]", help="N50 in line pairs on the target: stanag, johnson, or your own."
)
@click.option(
    "--cycles-per-size",
    type=float,
    metavar="C",
    help="Convert a TOD to line pairs: C cycles in √area are as hard.",
)
@click.option(
    "--search-time", "search_time_s", type=float, metavar="S", help="Seconds that the observer may search."
)
@click.option(
    "--group",
    "groups",
    multiple=True,
    metavar="COLUMN=VALUE",
    help="The curve of RESULT, if it has several; repeatable.",
)
@click.option(
    "--magnification",
    type=float,
    metavar="M",
    help="Angle on the display over angle in the field, for sizes as displayed.  [default: 1]",
)
@seed_option
@click.option(
    "--verbose", is_flag=True, help="Also print what a tenth more of each factor gains, and the range against k."
)
@strict_option
@json_option
def range_command(
    *,
    result: Path,
    target: str,
    atmosphere: str,
    out: str | None,
    k: list[float] | None,
    cycles: str | None,
    cycles_per_size: float | None,
    search_time_s: float | None,
    groups: tuple[str, ...],
    magnification: float | None,
    rng: int,
    verbose: bool,
    strict: bool,
    as_json: bool,
) -> None:
    """Compute how far a person with the sensor of RESULT sees the target, and how sure that is.

    RESULT is result.json of `score`, `fit` or `sensor-sim curve`, or its folder; or a CSV table of a TOD, MRTD or
    MRC with units in its header. Without -o nothing is written.
    """
    import todframes as tod

    with staged(out) as place:
        found = tod.acquisition_range(
            result,
            target=target,
            atmosphere=atmosphere,
            k=None if k is None else {f"k {one:g}": one for one in k},
            cycles=None if cycles is None else _cycles(cycles),
            cycles_per_size=cycles_per_size,
            search_time_s=search_time_s,
            group=dict(map(_group, groups)),
            magnification=magnification,
            rng=rng,
        )
        place.write(found.files)
    if as_json:
        print_content(found.to_json(), found.warnings, strict=strict)
        return
    print_table(found.table())
    if verbose:
        print_table(found.table(), details=True)
        table = found.k_table()
        if table is not None:
            print_table(table)
    print_end(found.sentences(), found.warnings, out=out, strict=strict)


def _cycles(text: str) -> str | dict[str, float]:
    """Return the name of a criterion, or the N50 of a task for each number."""
    if not text[:1].isdigit():
        return text
    return {f"{one:g} line pairs": one for one in numbers(text, "--cycles")}


def _group(text: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals:
        raise SettingsError(f"--group: found {text!r}, expected COLUMN=VALUE")
    return name.strip(), value.strip()
