"""The command `chart`."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import click

from todframes.cli.console import echo, print_table, progress, terminal_width
from todframes.cli.options import numbers, quiet_option, seed_option

if TYPE_CHECKING:
    from todframes.recordings.chart_layout import Chart, ChartKind
    from todframes.report.table import Table

SCREEN = "screen: "
"""Start of the help of options that only a chart for a monitor has."""


SHOWN_TOLERANCE = 1e-3
"""Largest relative difference of a contrast from the one asked for that the table does not show."""


@click.command()
@click.option(
    "--for", "kind", type=click.Choice(["screen"]), required=True, help="What shows the chart to the camera."
)
@click.option("--distance-m", type=float, required=True, metavar="M", help="From the camera to the chart.")
@click.option(
    "--sizes-mrad",
    required=True,
    metavar="S[,S…]",
    help="Sizes √(area) of the triangles, as angles at the camera.",
)
@click.option("--contrasts", metavar="C[,C…]", help="Contrasts.  [default: 0.02,0.05,0.1,0.2,0.4,0.8]")
@click.option(
    "--repeats",
    type=click.IntRange(1),
    default=2,
    show_default=True,
    help="How often each triangle is shown in each orientation; each time in another random order.",
)
@click.option(
    "--polarity",
    type=click.Choice(["1", "-1"]),
    default="1",
    show_default=True,
    help="Triangles brighter (1) or darker (-1) than their background.",
)
@seed_option
@click.option("--name", default="TOD chart", show_default=True, help="Title of the chart.")
@click.option(
    "--width-px", type=int, metavar="N", help=SCREEN + "Pixels in a row of the monitor.  [default: 1920]"
)
@click.option("--height-px", type=int, metavar="N", help=SCREEN + "Rows of the monitor.  [default: 1080]")
@click.option("--pixel-pitch-mm", type=float, metavar="MM", help=SCREEN + "Distance from pixel to pixel.")
@click.option(
    "--bits",
    type=click.Choice(["8", "10"]),
    help=SCREEN + "Bits of a code value, from file to panel.  [default: 8]",
)
@click.option(
    "--eotf",
    type=click.Choice(["linear", "srgb", "bt1886", "gamma"]),
    help=SCREEN + "Luminance by code value, as in dataset.toml.  [default: srgb]",
)
@click.option("--gamma", type=float, metavar="G", help=SCREEN + "Exponent for --eotf gamma.")
@click.option(
    "--white-luminance-cd-m2", type=float, metavar="L", help=SCREEN + "Luminance of white.  [default: 100]"
)
@click.option(
    "--black-luminance-cd-m2", type=float, metavar="L", help=SCREEN + "Luminance of black.  [default: 0]"
)
@click.option(
    "--background-luminance-cd-m2",
    type=float,
    metavar="L",
    help=SCREEN + "Luminance around the triangles.  [default: a quarter of white]",
)
@click.option("--page-duration-s", type=float, metavar="S", help=SCREEN + "Time of each page.  [default: 1]")
@click.option("--marker-mm", type=float, metavar="MM", help="Side of the markers in the corners.")
@click.option("-o", "--out", required=True, metavar="CHART", help="Folder to make.")
@click.option("--overwrite", is_flag=True, help="Replace CHART if this command wrote all that is in it.")
@quiet_option
def chart(
    *, kind: ChartKind, out: str, sizes_mrad: str, contrasts: str | None, polarity: str, quiet: bool, **asked: Any
) -> None:
    """Make a chart to record with a camera: triangles of given sizes and contrasts.

    CHART gets chart.toml, which says what stands where, for `todframes import`. For a screen it also gets an image
    for each page, and play.html, which shows them full-screen in a browser.
    """
    from todframes.recordings import charts

    settings = {name: value for name, value in asked.items() if value is not None}
    if "bits" in settings:
        settings["bits"] = int(settings["bits"])
    sizes = numbers(sizes_mrad, "--sizes-mrad")
    levels = charts.CONTRASTS if contrasts is None else numbers(contrasts, "--contrasts")
    with progress("drawing", len(sizes) * len(levels) * 4 * settings["repeats"], quiet=quiet) as advance:
        made = charts.chart(
            kind,
            out=out,
            sizes_mrad=sizes,
            contrasts=levels,
            polarity=int(polarity),
            progress=advance,
            **settings,
        )
    print_table(_table(made))
    for sentence in _remarks(made):
        echo(*textwrap.wrap(sentence, terminal_width()))
    echo(f"written: {out}")


def _table(chart: Chart) -> Table:
    """Return a table with a row for each size and level of a chart."""
    from todframes.report.table import Column, Table

    records: dict[tuple[float, float], dict[str, Any]] = {}
    for page in chart.pages:
        for one in page.triangles:
            record = {"size_mrad": one.size_mrad, "size_mm": one.size_mm, chart.level: one.strength}
            asked = one.contrast_asked
            if asked is not None and not math.isclose(asked, one.strength, rel_tol=SHOWN_TOLERANCE):
                record["contrast_asked"] = asked
            record |= {"dithered": one.dithered, "triangles": 0}
            if chart.screen is not None:
                record["size_px"] = one.size_mm / chart.screen.pixel_pitch_mm
            records.setdefault((one.size_mrad, one.strength), record)["triangles"] += 1
    columns = (
        Column(key="size_mrad", header="size, mrad", is_name=True),
        Column(key="size_mm", header="size, mm"),
        Column(key="size_px", header="size, px"),
        Column(key="contrast"),
        Column(key="contrast_asked", header="asked for", none=""),
        Column(key="dithered"),
        Column(key="triangles"),
    )
    ordered = [records[key] for key in sorted(records, key=lambda key: (key[0], abs(key[1])))]
    return Table.of(
        f"{chart.name}: {len(chart.pages)} pages", "chart.csv", columns, ordered
    ).without_empty_columns()


def _remarks(chart: Chart) -> list[str]:
    """Return sentences about a chart for the terminal."""
    remarks = []
    triangles = [one for page in chart.pages for one in page.triangles]
    if any(one.dithered for one in triangles):
        remarks.append(
            "Dithered triangles mix pixels of two neighbouring code values, so that their mean luminance has the "
            "contrast that code values alone do not have. The camera must not see single pixels of the monitor."
        )
    if chart.screen is not None:
        minutes = len(chart.pages) * chart.screen.page_duration_s / 60.0
        remarks.append(f"play.html shows the pages in {minutes:.1f} minutes.")
        if chart.screen.bits > 8:
            remarks.append(
                "The PNG files have 16 bits: code value · 65535 / 1023. Most browsers show 8 bits only; use a "
                "program and a connection that keep 10 bits."
            )
    return remarks
