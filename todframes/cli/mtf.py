"""The command `mtf`: the MTF of a camera from slanted edges."""

from __future__ import annotations

from pathlib import Path

import click

from todframes.cli.console import print_content, print_end, print_table, progress, staged
from todframes.cli.options import BOX, json_option, max_frame_option, quiet_option, strict_option


@click.command()
@click.argument("recording", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "-o",
    "--out",
    metavar="OUT",
    help="Folder for report.html, result.json, mtf.csv, edges.csv, mtf.png and a text file of MTF Mapper's form.",
)
@click.option(
    "--box",
    "boxes",
    type=BOX,
    multiple=True,
    help="Left column, top row, width and height of a part of the frame with one edge; repeatable.  [default: "
    "edges are found]",
)
@click.option(
    "--chart",
    type=click.Path(path_type=Path),
    metavar="CHART.toml",
    help="The chart that RECORDING shows, made with --camera-page: edges are found by its markers, in the frames "
    "of that page.",
)
@click.option(
    "--display",
    metavar="NAME|FILE",
    help="Display whose transfer function RECORDING was encoded for: its luminance is measured.  [default: values "
    "are proportional to light]",
)
@max_frame_option
@strict_option
@json_option
@quiet_option
def mtf(
    *,
    recording: tuple[Path, ...],
    out: str | None,
    boxes: tuple[tuple[int, int, int, int], ...],
    chart: Path | None,
    display: str | None,
    max_frame_mb: int,
    strict: bool,
    as_json: bool,
    quiet: bool,
) -> None:
    """Measure the MTF across the slanted edges that RECORDING shows (e-SFR, ISO 12233), with a 95 % band.

    RECORDING is a video, a sequence of images or a folder of them, camera raw or thermal files, or an array; its
    frames are averaged. It may also be a table of an MTF to print, draw or convert: a CSV file, or a text file of
    MTF Mapper.

    Without -o nothing is written.
    """
    import todframes as tod

    with staged(out) as place:
        with progress("reading", None, quiet=quiet) as advance:
            result = tod.mtf(
                recording,
                boxes=boxes,
                chart=chart,
                display=display,
                max_frame_mb=max_frame_mb,
                progress=advance,
            )
        place.write(result.files)
    if as_json:
        print_content(result.to_json(), result.warnings, quiet=quiet, strict=strict)
        return
    print_table(result.short_table())
    edges = result.edge_table()
    if edges is not None:
        print_table(edges)
    print_end(result.sentences(), result.warnings, out=out, strict=strict, is_timed=False)
