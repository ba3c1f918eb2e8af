"""The command `chart`."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any

import click

from todframes.base.errors import SettingsError
from todframes.cli.console import echo, print_sentences, print_table, progress
from todframes.cli.options import NUMBERS, numbers, quiet_option, seed_option

if TYPE_CHECKING:
    from todframes.charts.layout import Chart, ChartKind
    from todframes.report.table import Table

SCREEN, PRINT, THERMAL, SCREEN_PRINT = "Screen: ", "Print: ", "Thermal: ", "Screen, print: "
"""Starts of the help of options that only some kinds of charts have."""

LEVEL_OPTIONS = {"contrasts", "delta_t_k"}

PAPER_MM = {
    "A4": (297.0, 210.0),
    "A3": (420.0, 297.0),
    "A2": (594.0, 420.0),
    "A1": (841.0, 594.0),
    "A0": (1189.0, 841.0),
}
"""Width and height of sheets across (ISO 216)."""

SHOWN_TOLERANCE = 1e-3
"""Largest relative difference of a contrast from the one asked for that the table does not show."""


@click.command()
@click.option(
    "--for",
    "kind",
    type=click.Choice(["screen", "print", "thermal"]),
    required=True,
    help="What shows the chart: a monitor, paper, or plates with holes in front of a black body.",
)
@click.option("--distance-m", type=float, required=True, metavar="M", help="From the camera to the chart.")
@click.option(
    "--sizes-mrad", type=NUMBERS, required=True, help="Sizes √(area) of the triangles, as angles at the camera."
)
@click.option("--contrasts", type=NUMBERS, help=f"{SCREEN_PRINT}Contrasts.  [default: 0.02,0.05,0.1,0.2,0.4,0.8]")
@click.option(
    "--delta-t-k", type=NUMBERS, help=f"{THERMAL}Temperature differences.  [default: 0.02,0.05,0.1,0.2,0.5,1,2]"
)
@click.option(
    "--repeats",
    type=click.IntRange(1),
    default=2,
    show_default=True,
    help="Times that each triangle is shown in each orientation, each time in another random order.",
)
@click.option(
    "--polarity",
    type=click.Choice([1, -1]),
    default=1,
    show_default=True,
    help="Triangles brighter (warmer), 1, or darker (colder), -1, than their background.",
)
@seed_option
@click.option("--name", default="TOD chart", show_default=True, help="Title of the chart.")
@click.option("--marker-mm", type=float, metavar="MM", help=f"{SCREEN_PRINT}Side of the markers.")
@click.option(
    "--markers",
    type=click.Choice(["borders", "corners"]),
    help=f"{SCREEN_PRINT}Markers along the borders, by which `import` solves a lens, or in the corners alone.  "
    "[default: borders]",
)
@click.option(
    "--camera-page",
    is_flag=True,
    default=None,
    help=f"{SCREEN_PRINT}A first page with slanted edges and a grey wedge, from which `mtf` and `noise` measure "
    "the camera in the same film.",
)
@click.option(
    "--width-px", type=int, metavar="N", help=f"{SCREEN}Pixels in a row of the monitor.  [default: 1920]"
)
@click.option("--height-px", type=int, metavar="N", help=f"{SCREEN}Rows of the monitor.  [default: 1080]")
@click.option(
    "--display",
    metavar="NAME|FILE",
    help=f"{SCREEN}Monitor as in dataset.toml: its luminances, and its pixel pitch if that is in mm.",
)
@click.option(
    "--pixel-pitch-mm",
    type=float,
    metavar="MM",
    help=f"{SCREEN}From pixel to pixel.  [required without --display]",
)
@click.option(
    "--bits", type=click.Choice([8, 10]), help=f"{SCREEN}Bits of a code value, up to the panel.  [default: 8]"
)
@click.option(
    "--eotf",
    type=click.Choice(["linear", "srgb", "bt1886", "gamma"]),
    help=f"{SCREEN}Luminance by code value, as in dataset.toml.  [default: srgb]",
)
@click.option("--gamma", type=float, metavar="G", help=f"{SCREEN}Exponent for --eotf gamma.")
@click.option(
    "--white-luminance-cd-m2", type=float, metavar="L", help=f"{SCREEN}Luminance of white.  [default: 100]"
)
@click.option(
    "--black-luminance-cd-m2", type=float, metavar="L", help=f"{SCREEN}Luminance of black.  [default: 0]"
)
@click.option(
    "--background-luminance-cd-m2",
    type=float,
    metavar="L",
    help=f"{SCREEN}Luminance around the triangles.  [default: a quarter of white]",
)
@click.option("--page-duration-s", type=float, metavar="S", help=f"{SCREEN}Time of each page.  [default: 1]")
@click.option(
    "--paper",
    metavar="A4|A3|…|W,H",
    help=f"{PRINT}Size of a sheet in landscape format: A4 to A0, or width and height in mm.  [default: A3]",
)
@click.option("--margin-mm", type=float, metavar="MM", help=f"{PRINT}Border that stays white.  [default: 10]")
@click.option(
    "--reflectances",
    metavar="FILE",
    help=f"{PRINT}CSV with code_value (0 to 255) and reflectance, measured on a print.  [default: sRGB greys]",
)
@click.option(
    "--paper-reflectance", type=float, metavar="R", help=f"{PRINT}Reflectance of the paper.  [default: 0.85]"
)
@click.option(
    "--black-reflectance", type=float, metavar="R", help=f"{PRINT}Reflectance of black.  [default: 0.04]"
)
@click.option(
    "--background-reflectance",
    type=float,
    metavar="R",
    help=f"{PRINT}Reflectance around the triangles.  [default: 0.3]",
)
@click.option(
    "--plate-mm",
    type=float,
    metavar="MM",
    help=f"{THERMAL}Side of the plates.  [default: five sizes of the largest]",
)
@click.option("-o", "--out", required=True, metavar="CHART", help="Folder to make, new or empty.")
@quiet_option
def chart(
    *, kind: ChartKind, out: str, sizes_mrad: list[float], paper: str | None, quiet: bool, **asked: Any
) -> None:
    """Make a chart to record with a camera: triangles of given sizes and contrasts.

    CHART gets chart.toml, which says where everything is on the pages, for `todframes import`. For a screen it
    also gets an image for each page, and play.html, which shows them full-screen in a browser; for print
    chart.pdf, and an SVG file for each sheet; for thermal drawings of the plates, and schedule.csv with the
    settings to record.
    """
    from todframes.charts import making as charts
    from todframes.stimulus import ORIENTATIONS

    settings = {name: value for name, value in asked.items() if value is not None}
    if paper is not None:
        settings["paper_width_mm"], settings["paper_height_mm"] = _paper_mm(paper)
    levels = next((settings[name] for name in LEVEL_OPTIONS & settings.keys()), charts.DEFAULT_LEVELS[kind])
    n_triangles = len(sizes_mrad) * len(levels) * len(ORIENTATIONS) * settings["repeats"]
    with progress("drawing", n_triangles, quiet=quiet) as advance:
        try:
            made = charts.chart(kind, out=out, sizes_mrad=sizes_mrad, progress=advance, **settings)
        except SettingsError as error:
            raise SettingsError(_with_options(str(error))) from None
    print_table(_table(made))
    print_sentences(_remarks(made))
    echo(f"written: {out}")


def _with_options(message: str) -> str:
    """Return a message about settings with the options of this command in place of their names in Python."""
    options = {str(option.name): option.opts[0] for option in chart.params}
    subject, is_one, rest = re.sub(r"^(chart|screen|print|thermal): ", "", message).partition(":")
    named = {name: option for name, option in options.items() if "_" in name or name == "contrasts"}
    text = options.get(subject, subject) + is_one + rest
    return re.sub(rf"(?<![-\w])({'|'.join(named)})\b", lambda found: named[found[1]], text)


def _paper_mm(paper: str) -> tuple[float, float]:
    """Return width and height of a sheet, by name or as two numbers."""
    if paper.upper() in PAPER_MM:
        return PAPER_MM[paper.upper()]
    names = ", ".join(PAPER_MM)
    try:
        width_mm, height_mm = numbers(paper, "--paper")
    except (SettingsError, ValueError):
        raise SettingsError(f"--paper: found {paper!r}, expected {names}, or WIDTH,HEIGHT in mm") from None
    return width_mm, height_mm


def _table(chart: Chart) -> Table:
    """Return a table with a row for each size and level of a chart."""
    from todframes.report.table import Column, Table
    from todframes.report.wording import count
    from todframes.stimulus import SIDE_PER_SIZE

    records: dict[tuple[float, float], dict[str, Any]] = {}
    for page in chart.pages:
        for one in page.triangles:
            record = {"size_mrad": one.size_mrad, "size_mm": one.size_mm, chart.level: one.strength}
            asked = one.contrast_asked
            if asked is not None and not math.isclose(asked, one.strength, rel_tol=SHOWN_TOLERANCE):
                record["contrast_asked"] = asked
            if chart.screen is not None:
                record |= {"size_px": one.size_mm / chart.screen.pixel_pitch_mm, "dithered": one.dithered}
            if chart.kind == "thermal":
                record["side_mm"] = SIDE_PER_SIZE * one.size_mm
            record["triangles"] = 0
            records.setdefault((one.size_mrad, one.strength), record)["triangles"] += 1
    columns = (
        Column(key="size_mrad", header="size, mrad", is_name=True),
        Column(key="size_mm", header="size, mm"),
        Column(key="size_px", header="size, px"),
        Column(key="side_mm", header="side of the hole, mm"),
        Column(key="contrast"),
        Column(key="delta_t_k", header="ΔT, K"),
        Column(key="contrast_asked", header="asked for", none=""),
        Column(key="dithered"),
        Column(key="triangles"),
    )
    ordered = [records[key] for key in sorted(records, key=lambda key: (key[0], abs(key[1])))]
    pages = {"screen": "page", "print": "sheet", "thermal": "setting"}[chart.kind]
    title = f"{chart.name}: {count(len(chart.pages), pages)}"
    return Table.of(title, "chart.csv", columns, ordered).without_empty_columns()


def _remarks(chart: Chart) -> list[str]:
    """Return sentences about a chart for the terminal."""
    triangles = [one for page in chart.pages for one in page.triangles]
    if chart.screen is not None:
        minutes = len(chart.pages) * chart.screen.page_duration_s / 60.0
        remarks = [f"play.html shows the pages in {minutes:.1f} minutes."]
        if any(one.dithered for one in triangles):
            remarks.append(
                "Dithered triangles mix pixels of two neighbouring code values, so that their mean luminance has "
                "the contrast that no code value has. The camera must not resolve single pixels of the monitor."
            )
        if chart.screen.bits > 8:
            remarks.append(
                "The PNG files have 16 bits: code value · 65535 / 1023. Most browsers show 8 bits only; use a "
                "program and a connection that keep 10 bits."
            )
        return remarks
    if chart.kind == "print":
        return [
            "Print chart.pdf at 100 %, without fitting to the page, and check the ruler. Without --reflectances, "
            "contrasts are nominal: measure the grey patches and make the chart again."
        ]
    return ["Record the settings of schedule.csv in its order, and fill in file, start_s and end_s."]
