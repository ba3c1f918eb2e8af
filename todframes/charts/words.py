"""A chart in words: the table of its triangles, and remarks on its use."""

from __future__ import annotations

import math
from typing import Any

from todframes.base.errors import argument
from todframes.charts.layout import Chart
from todframes.results.table import Column, Table
from todframes.results.wording import count
from todframes.stimulus import SIDE_PER_SIZE

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
