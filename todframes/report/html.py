"""Conversion of a result to one self-contained HTML page with text, figures, pictures and tables.

The page is made from the result alone, so the same result gives the same bytes.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING
from urllib.parse import quote

from todframes.base._typing import Json
from todframes.report import calibration, tables
from todframes.report.data import DatasetRecord, Example, Record, ResultData, Thumbnail, each_observer
from todframes.report.figure_style import style
from todframes.report.figures import ReportFigure, pictures
from todframes.report.summary import cautions, remarks, verdict
from todframes.report.svg import inline_svg
from todframes.report.table import HIDDEN, Table, markup
from todframes.report.wording import group_phrase, level_name, plain, warning_text

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.figure import Figure


MOST_FIGURES = 12

TITLES = {
    "score": "TOD thresholds of display frames",
    "curve": "TOD curve of a sensor",
    "naked-eye": "Thresholds of the naked eye",
    "fit": "Fitted psychometric functions",
    "compare": "Enhancements compared",
    "accuracy": "Error against run time",
    "calibrate": "Internal noise of people",
}


def page(result: ResultData) -> str:
    """Return the HTML page of a result."""
    content = {
        "title": TITLES[result.command],
        "about": _about(result),
        "warnings": [warning_text(warning.group, warning.message) for warning in result.warnings],
        "verdict": [*verdict(result), *cautions(result)],
        "figures": figure_items(pictures(result)),
        "tables_shown": _tables(result),
        "examples": _examples([one for one in result.examples or () if not _is_whole(one)]),
        "without": _examples([one for one in result.examples or () if _is_whole(one)]),
        "remarks": [f"Run time {plain(result.run_time_s)} s."] * (result.run_time_s is not None) + remarks(result),
        "details": _details(result),
        "version": result.version,
        "can_be_made_again": True,
    }
    return render(content)


def render(content: Json) -> str:
    """Return the page of some content: the values that the template `report.html.j2` names."""
    return _environment().get_template("report.html.j2").render(content)


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("todframes.report"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: _shown(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _shown(text: str) -> str:
    return HIDDEN.sub("\ufffd", text)


def _about(result: ResultData) -> str:
    """Return the name of the dataset or sensor that the result is about."""
    sensor = result.settings.get("sensor")
    name = sensor.get("name") if isinstance(sensor, dict) else None
    return str(result.dataset_path or name or "")


def figure_items(drawn: Sequence[ReportFigure]) -> list[Json]:
    """List figures for the page, up to `MOST_FIGURES`."""
    with style():
        return [
            {
                "svg": inline_svg(one.figure(), name=f"figure-{number}", label=_shown(f"{one.title}. {one.note}")),
                "title": one.title,
                "note": one.note,
            }
            for number, one in enumerate(drawn[:MOST_FIGURES], 1)
        ]


def _tables(result: ResultData) -> list[Json]:
    """List the tables under the figures: those of the terminal, then more, which the reader opens."""
    if result.persons:
        folded = tables.points(result)
        items = [table_item(one) for one in calibration.all_tables(result)]
        return [*items, *([] if folded is None else [table_item(folded, folded=True)])]
    found = []
    answers = tables.answers(result)
    if result.algorithms:
        measures = tables.measures(result.algorithms)
        found += [table_item(tables.ratios(one, observer)) for observer, one in each_observer(result)]
        found.append(table_item(measures.without_details()))
        found += [table_item(replace(measures, title="Details of the algorithms"), folded=True)]
        responses = tables.contrast_responses(result.algorithms)
        found += [table_item(responses, folded=True)] if responses is not None else []
    elif result.thresholds:
        found.append(table_item(tables.thresholds(result).without_details()))
    found += [table_item(answers)] if answers is not None else []
    if result.thresholds:
        found.append(table_item(tables.thresholds(result, "Details of the thresholds"), folded=True))
    points = tables.points(result)
    found += [table_item(points, folded=True)] if points is not None else []
    for scene in result.scenes:
        found += [table_item(one, folded=bool(n)) for n, one in enumerate(tables.scene_tables(scene))]
    return found


def table_item(table: Table, *, folded: bool = False) -> Json:
    """Return a table for the page, with its CSV; the reader opens it if it is `folded`."""
    return {"table": table, "csv": "data:text/csv;charset=utf-8," + quote(table.csv()), "folded": folded}


def _examples(examples: Sequence[Example]) -> list[Json]:
    """List the examples by group, with a row of pictures for each algorithm."""
    groups: dict[str, Json] = {}
    for one in examples:
        label = group_phrase(one.group)
        groups.setdefault(label, {"label": label, "rows": []})["rows"].append(
            {"algorithm": one.algorithm or "", "about": _about_example(one), "tiles": [*map(_tile, one.pictures)]}
        )
    return list(groups.values())


def _is_whole(one: Example) -> bool:
    """Return whether an example is a whole frame, of a group without a threshold."""
    return any(picture.name == "whole" for picture in one.pictures)


def _about_example(one: Example) -> str:
    parts = [
        f"apex {one.orientation}" if one.orientation else "",
        f"{level_name(one.level)} {plain(one.strength)}" if one.strength is not None else "",
        f"P(correct) {plain(one.p_correct, 2)}" if one.p_correct is not None else "",
        f"{plain(one.width_mrad)} mrad wide" if one.width_mrad is not None else "",
        f"mean of {one.n_frames} frames" if (one.n_frames or 1) > 1 else "",
        f"scene {one.scene}" if one.scene else "",
        one.frame or "",
    ]
    return ", ".join(part for part in parts if part)


def _tile(picture: Thumbnail) -> Json:
    scale = ""
    if picture.scale is not None and picture.name == "display":
        scale = f"white: {plain(1.0 + picture.scale)} × background"
    elif picture.scale is not None and picture.black is not None:
        scale = f"black: {plain(1.0 + picture.black)}, white: {plain(1.0 + picture.scale)} × background"
    elif picture.scale is not None:
        scale = f"white: {plain(picture.scale, 2)}"
    names = {"display": "as displayed", "retina": "on the retina", "whole": "whole frame"}
    return {
        "source": "data:image/png;base64," + base64.b64encode(picture.png).decode(),
        "width": int.from_bytes(picture.png[16:20]),
        "height": int.from_bytes(picture.png[20:24]),
        "name": names.get(picture.name, picture.name),
        "scale": scale,
        "large": picture.name in ("display", "whole"),
    }


def _details(result: ResultData) -> list[Json]:
    """List the tables about how the result was made; the reader opens those that are `folded`."""
    records: list[tuple[str, str, Sequence[Record], bool]] = [
        ("Frames left out", "skipped.csv", result.skipped, False),
        ("Positions found", "located.csv", result.located or (), True),
    ]
    found = [
        table_item(tables.records_table(caption, file, rows), folded=folded)
        for caption, file, rows, folded in records
        if rows
    ]
    found += (
        [table_item(tables.plan(result), folded=True)]
        if result.plan or any(fit.plan for fit in result.fits)
        else []
    )
    if isinstance(result.dataset, DatasetRecord):
        found.append(table_item(tables.dataset(result.dataset), folded=True))
    return [*found, table_item(tables.settings(result), folded=True)]


def notebook_html(result: ResultData) -> str:
    """Return the self-contained HTML that a notebook shows for a result: sentences, table and first figure."""
    table = tables.ratios(result.algorithms) if result.algorithms else tables.thresholds(result)
    drawn = [(one.figure, f"{one.title}. {one.note}") for one in pictures(result)[:1]]
    return notebook_page(verdict(result), table.without_details(), drawn)


def notebook_page(
    sentences: Sequence[str], table: Table, figures: Sequence[tuple[Callable[[], Figure], str]]
) -> str:
    """Return self-contained HTML of sentences, a table and figures, each with a label."""
    text = "".join(f"<p>{markup(sentence)}</p>" for sentence in sentences)
    content = table.html()
    # Names inside a drawing are valid in the whole notebook, so another result must have other names.
    name = f"tod-{zlib.crc32((text + content).encode()):08x}"
    with style():
        svg = "".join(inline_svg(figure(), name=name, label=_shown(label)) for figure, label in figures)
    paper = "--paper: var(--jp-layout-color0, Canvas); max-width: 40rem"
    return f'<div style="{paper}">{text}{content}{svg}</div>'
