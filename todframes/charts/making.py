"""Making of charts of any kind, as `todframes chart` does."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

from todframes.base.errors import SettingsError, argument
from todframes.base.output import new_folder
from todframes.base.reading import checked, from_table
from todframes.base.seeds import Rng, seed_of
from todframes.charts.design import Design
from todframes.charts.layout import CHART_FILE, Chart, Screen
from todframes.charts.print import Paper, make_print_chart, make_thermal_chart
from todframes.charts.screen import make_screen_chart
from todframes.display.display import Display, LuminanceTable, find_display
from todframes.parameters import (
    Bits,
    CandelaPerM2,
    ChartFolder,
    ChartKind,
    Count,
    DisplayName,
    Exponent,
    MarkerPlaces,
    Metres,
    Millimetres,
    MonitorEotf,
    NamedTable,
    Numbers,
    Polarity,
    Progress,
    Reflectance,
    Seconds,
    Seed,
    WholeNumber,
)
from todframes.results.tables import Column, Table
from todframes.results.wording import count
from todframes.stimulus import SIDE_PER_SIZE

DEFAULT_CONTRASTS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)

DEFAULT_LEVELS: dict[ChartKind, tuple[float, ...]] = {
    "screen": DEFAULT_CONTRASTS,
    "print": DEFAULT_CONTRASTS,
    "thermal": (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0),
}
"""Contrasts, or temperature differences in K, if none are asked for."""

BACKGROUND_SHARE = 0.25
"""Background of a monitor relative to white if none is asked for; contrasts reach from -1 to 3."""

SETTINGS: dict[ChartKind, set[str]] = {
    "screen": {field.name for field in fields(Screen)}
    | {"display", "contrasts", "marker_mm", "markers", "camera_page"},
    "print": {field.name for field in fields(Paper)} | {"contrasts"},
    "thermal": {"plate_mm", "delta_t_k"},
}
"""Names of the settings of each kind."""

SCREEN_DEFAULTS = {"width_px": 1920, "height_px": 1080, "page_duration_s": 1.0, "white_luminance_cd_m2": 100.0}
"""Settings of a monitor that need not be given."""


@checked
def chart(
    kind: ChartKind,
    *,
    out: ChartFolder,
    distance_m: Metres,
    sizes_mrad: Numbers,
    contrasts: Numbers | None = None,
    delta_t_k: Numbers | None = None,
    repeats: Count = 2,
    rng: Seed | Rng = 1,
    polarity: Polarity = 1,
    name: str = "TOD chart",
    marker_mm: Millimetres | None = None,
    markers: MarkerPlaces | None = None,
    camera_page: bool | None = None,
    width_px: WholeNumber | None = None,
    height_px: WholeNumber | None = None,
    display: DisplayName | None = None,
    pixel_pitch_mm: Millimetres | None = None,
    bits: Bits | None = None,
    eotf: MonitorEotf | Literal["lut"] | None = None,
    gamma: Exponent | None = None,
    lut: LuminanceTable | None = None,
    white_luminance_cd_m2: CandelaPerM2 | None = None,
    black_luminance_cd_m2: CandelaPerM2 | None = None,
    background_luminance_cd_m2: CandelaPerM2 | None = None,
    page_duration_s: Seconds | None = None,
    paper_width_mm: Millimetres | None = None,
    paper_height_mm: Millimetres | None = None,
    margin_mm: Millimetres | None = None,
    reflectances: NamedTable | None = None,
    paper_reflectance: Reflectance | None = None,
    black_reflectance: Reflectance | None = None,
    background_reflectance: Reflectance | None = None,
    plate_mm: Millimetres | None = None,
    progress: Progress | None = None,
) -> Chart:
    """Make a chart to record with a camera: triangles of given sizes and contrasts.

    The folder gets chart.toml, which says where everything is on the pages, for `todframes import`. For a screen
    it also gets an image for each page, and play.html, which shows them full-screen in a browser; for print
    chart.pdf, and an SVG file for each sheet; for thermal drawings of the plates, and schedule.csv with the
    settings to record.

    Parameters
    ----------
    kind : {"screen", "print", "thermal"}
        What shows the chart: a monitor, paper, or plates with holes in front of a black body.
    out : path
        Folder to make, new or empty.
    distance_m : float
        From the camera to the chart in m.
    sizes_mrad : sequence of float
        Sizes √(area) of the triangles, as angles at the camera in mrad.
    contrasts : sequence of float, optional
        Screen, print: Weber contrasts, without sign. Default: 0.02,0.05,0.1,0.2,0.4,0.8.
    delta_t_k : sequence of float, optional
        Thermal: temperature differences in K, without sign. Default: 0.02,0.05,0.1,0.2,0.5,1,2.
    repeats : int
        Times that each triangle is shown in each orientation, each time in another random order.
    rng : int, SeedSequence or Generator
        Seed of the order.
    polarity : {1, -1}
        Triangles brighter (warmer), 1, or darker (colder), -1, than their background.
    name : str
        Title of the chart.
    marker_mm : float, optional
        Screen, print: side of the markers.
    markers : {"borders", "corners"}, optional
        Screen, print: markers along the borders, by which `todframes import` solves a lens, or in the corners
        alone. Default: borders.
    camera_page : bool, optional
        Screen, print: a first page with slanted edges and a grey wedge, from which `todframes mtf` and `todframes
        noise` measure the camera in the same film.
    width_px : int, optional
        Screen: pixels in a row of the monitor. Default: 1920.
    height_px : int, optional
        Screen: rows of the monitor. Default: 1080.
    display : str, optional
        Screen: monitor as in dataset.toml: its luminances, and its pixel pitch if that is in mm.
    pixel_pitch_mm : float, optional
        Screen: from pixel to pixel. Default: that of `display`; required without one.
    bits : {8, 10}, optional
        Screen: bits of a code value, up to the panel. Default: 8.
    eotf : {"linear", "srgb", "bt1886", "gamma"}, optional
        Screen: luminance by code value, as in dataset.toml. Default: srgb.
    gamma : float, optional
        Screen: exponent for an `eotf` of gamma.
    lut : LuminanceTable, optional
        Screen: luminance of each code value, for an `eotf` of "lut".
    white_luminance_cd_m2 : float, optional
        Screen: luminance of white. Default: 100.
    black_luminance_cd_m2 : float, optional
        Screen: luminance of black. Default: 0.
    background_luminance_cd_m2 : float, optional
        Screen: luminance around the triangles. Default: a quarter of white.
    page_duration_s : float, optional
        Screen: time of each page. Default: 1.
    paper_width_mm : float, optional
        Print: width of a sheet. Default: 420.
    paper_height_mm : float, optional
        Print: height of a sheet. Default: 297.
    margin_mm : float, optional
        Print: border that stays white. Default: 10.
    reflectances : path, optional
        Print: CSV file with code_value (0 to 255) and reflectance, measured on a print. Default: sRGB greys.
    paper_reflectance : float, optional
        Print: reflectance of the paper. Default: 0.85.
    black_reflectance : float, optional
        Print: reflectance of black. Default: 0.04.
    background_reflectance : float, optional
        Print: reflectance around the triangles. Default: 0.3.
    plate_mm : float, optional
        Thermal: side of the plates. Default: five sizes of the largest.
    progress : function of two ints, optional
        Called with the number of pages that are done, and of all.

    Returns
    -------
    Chart
        Pages and triangles, with the contrasts that they really have.

    Raises
    ------
    SettingsError
        If a setting is invalid, or the chart cannot show a size or a contrast.
    OutputError
        If the place cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import todframes as tod
    >>> monitor = {"width_px": 640, "height_px": 480, "pixel_pitch_mm": 0.25}
    >>> place = tempfile.mkdtemp()
    >>> made = tod.chart("screen", out=place, distance_m=10, sizes_mrad=[1], contrasts=[0.2], repeats=1, **monitor)
    >>> len(made.pages), made.pages[0].triangles[0].contrast
    (4, 0.201414)
    """
    asked = dict(locals())
    known = set().union(*SETTINGS.values())
    settings = {name: value for name, value in asked.items() if name in known and value is not None}
    for setting in settings:
        others = [other for other in SETTINGS if setting in SETTINGS[other] and setting not in SETTINGS[kind]]
        if others:
            raise SettingsError(
                f"{setting}: is given, but a {kind} chart has none; it is for {' and '.join(others)}"
            )
    levels = settings.pop("delta_t_k" if kind == "thermal" else "contrasts", DEFAULT_LEVELS[kind])
    design = from_table(
        {
            "distance_m": distance_m,
            "sizes_mrad": list(sizes_mrad),
            "levels": list(levels),
            "repeats": repeats,
            "seed": seed_of(rng),
            "polarity": polarity,
            "name": name,
        },
        Design,
        "chart",
    )
    with new_folder(str(out), last=CHART_FILE) as folder:
        if kind == "print":
            return make_print_chart(design, from_table(settings, Paper, kind), folder, progress)
        if kind == "thermal":
            return make_thermal_chart(design, plate_mm, folder, progress)
        return _screen(design, settings, folder, progress)


def _screen(design: Design, settings: Mapping[str, Any], folder: Path, progress: Progress | None) -> Chart:
    table = dict(settings)
    display = table.pop("display", None)
    if display is not None:
        table = _of_display(str(display)) | table
    table = SCREEN_DEFAULTS | table
    layout = {
        "marker_mm": table.pop("marker_mm", None),
        "markers": table.pop("markers", "borders"),
        "camera_page": table.pop("camera_page", False),
    }
    table.setdefault("background_luminance_cd_m2", BACKGROUND_SHARE * table["white_luminance_cd_m2"])
    return make_screen_chart(design, from_table(table, Screen, "screen"), folder, progress, **layout)


def _of_display(name: str) -> dict[str, Any]:
    """Return the settings of a monitor that a display of `find_display` gives."""
    described = find_display(name)
    if described.of_signals is not None:
        raise SettingsError(
            f"{argument.display}: found the display of a sensor's signals, expected a monitor that shows the chart"
        )
    display = described.display
    shared = {field.name for field in fields(Screen)} - {"background_luminance_cd_m2"}
    values = {name: getattr(display, name) for name in shared & {field.name for field in fields(Display)}}
    if display.lut is not None:
        values["white_luminance_cd_m2"] = float(display.lut.luminance_cd_m2[-1])
        values["black_luminance_cd_m2"] = float(display.lut.luminance_cd_m2[0])
    return {name: value for name, value in values.items() if value is not None}


SHOWN_TOLERANCE = 1e-3
"""Largest relative difference of a contrast from the one asked for that the table does not show."""


def chart_table(chart: Chart) -> Table:
    """Return a table with a row for each size and level of a chart."""
    records: dict[tuple[float, float], dict[str, Any]] = {}
    for page in chart.pages:
        for triangle in page.triangles:
            record = {"size_mrad": triangle.size_mrad, "size_mm": triangle.size_mm, chart.level: triangle.strength}
            asked = triangle.contrast_asked
            if asked is not None and not math.isclose(asked, triangle.strength, rel_tol=SHOWN_TOLERANCE):
                record["contrast_asked"] = asked
            if chart.screen is not None:
                record |= {
                    "size_px": triangle.size_mm / chart.screen.pixel_pitch_mm,
                    "dithered": triangle.dithered,
                }
            if chart.kind == "thermal":
                record["side_mm"] = SIDE_PER_SIZE * triangle.size_mm
            record["triangles"] = 0
            records.setdefault((triangle.size_mrad, triangle.strength), record)["triangles"] += 1
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


def chart_remarks(chart: Chart) -> list[str]:
    """Return sentences about a chart for the terminal."""
    triangles = [triangle for page in chart.pages for triangle in page.triangles]
    if chart.screen is not None:
        minutes = len(chart.pages) * chart.screen.page_duration_s / 60.0
        remarks = [f"play.html shows the pages in {minutes:.1f} minutes."]
        if any(triangle.dithered for triangle in triangles):
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
            "Print chart.pdf at 100 %, without fitting to the page, and check the ruler. Without "
            f"{argument.reflectances}, contrasts are nominal: measure the grey patches and make the chart again."
        ]
    return ["Record the settings of schedule.csv in its order, and fill in file, start_s and end_s."]
