"""Conversion of a result to one self-contained HTML page with text, figures, pictures and tables.

The page is made from the result alone, so the same result gives the same bytes.
"""

from __future__ import annotations

import base64
import re
import zlib
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from html import escape
from typing import TYPE_CHECKING
from urllib.parse import quote

from todframes.base._typing import Json
from todframes.results import tables
from todframes.results.data import Example, Thumbnail, warning_texts
from todframes.results.figures import INK, PAPER, ReportFigure, style, svg_file
from todframes.results.tables import HIDDEN, Table, breakable, markup
from todframes.results.wording import group_phrase, level_name, listed, plain

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup
    from matplotlib.figure import Figure

    from todframes.results.result import Result

MOST_FIGURES = 12

# Replacements within tags, where matplotlib escapes "<" and ">"; texts between them stay as they are.
_IN_TAGS = (
    (re.compile(r"xlink:href="), "href="),
    (re.compile(r'(<g) id="[^"]*"'), r"\1"),  # numbers of the parts, which nothing refers to
    (re.compile(r"font: ([\d.]+px) [^;\"]*"), r"font-size: \1"),
    (re.compile(r"font-family:[^;\"]*; "), ""),
    (re.compile(re.escape(INK)), "currentColor"),
    (re.compile(re.escape(PAPER)), "var(--paper)"),
    (re.compile(r"(\d+\.\d\d)\d+"), r"\1"),  # a hundredth of a pixel
)
_TAG = re.compile(r"<[^>]*>")
_NOT_OF_PAGE = re.compile(r"\s*<(metadata|style)\b.*?</\1>", re.DOTALL)


def page(result: Result, name: str) -> str:
    """Return the HTML page of a result, with a name below the title: the answer first, then how it was made."""
    made = result.tables()
    shown = [table for table in made if not table.is_folded]
    details = [
        replace(table, title=f"{table.title}: details", file="").folded() for table in shown if table.has_details
    ]
    folded = [*details, *(table for table in made if table.is_folded), tables.settings(result).folded()]
    examples: Sequence[Example] = getattr(result, "examples", None) or ()
    whole = [example for example in examples if any(picture.name == "whole" for picture in example.pictures)]
    drawn = figure_items(result.figures())
    closed = [item for item in drawn if item["is_folded"]] if not drawn or not drawn[0]["is_folded"] else []
    run_time = [] if result.run_time_s is None else [f"Run time {plain(result.run_time_s)} s."]
    content = {
        "title": result.title,
        "about": name,
        "named": name_html(name),
        "date": result.date,
        "verdict": [*map(sentence_html, result.sentences())],
        "warnings": [*map(sentence_html, warning_texts(result.warnings))],
        "figures": [item for item in drawn if item not in closed],
        "closed": closed,
        "of_closed": listed(dict.fromkeys(item["title"].partition(":")[0] for item in closed)) if closed else "",
        "tables_shown": [table_item(table.without_details()) for table in shown],
        "examples": _examples([example for example in examples if example not in whole]),
        "without": _examples(whole),
        "remarks": [*map(sentence_html, run_time + result.remarks())],
        "details": [*map(table_item, folded)],
        "version": result.version,
        "from_json": bool(result.json_file),
    }
    return _environment().get_template("report.html.j2").render(content)


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("todframes.results"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: _shown(value) if type(value) is str else value,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def sentence_html(text: str) -> Markup:
    """Return a sentence for a page; what stands between backticks is code, and no line begins with a %."""
    from markupsafe import Markup

    safe = str(name_html(text.replace(" %", "\N{NO-BREAK SPACE}%")))  # as markup, it would escape the tags
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", safe))


def name_html(text: str) -> Markup:
    """Return a name for a page, which breaks a line behind an underscore or a slash."""
    from markupsafe import Markup

    return Markup(breakable(markup(text)))


def _shown(text: str) -> str:
    return HIDDEN.sub("\ufffd", text)


def figure_items(drawn: Sequence[ReportFigure]) -> list[Json]:
    """List figures for the page, up to `MOST_FIGURES`."""
    with style():
        return [
            {
                "svg": inline_svg(
                    drawing.figure(), name=f"figure-{number}", label=_shown(f"{drawing.title}. {drawing.note}")
                ),
                "title": drawing.title,
                "note": sentence_html(drawing.note),
                "is_folded": drawing.is_folded,
            }
            for number, drawing in enumerate(drawn[:MOST_FIGURES], 1)
        ]


def table_item(table: Table) -> Json:
    """Return a table for the page, with its CSV; the reader opens it if it is folded."""
    return {"table": table, "csv": "data:text/csv;charset=utf-8," + quote(table.csv())}


def _examples(examples: Sequence[Example]) -> list[Json]:
    """List the examples by group, with a row of pictures for each condition."""
    groups: dict[str, Json] = {}
    for example in examples:
        label = group_phrase(example.group)
        groups.setdefault(label, {"label": label, "rows": []})["rows"].append(
            {
                "condition": name_html(example.condition or ""),
                "about": name_html(_about_example(example)),
                "tiles": [*map(_tile, example.pictures)],
            }
        )
    return list(groups.values())


def _about_example(example: Example) -> str:
    parts = [
        f"apex {example.orientation}" if example.orientation else "",
        f"{level_name(example.level)} {plain(example.strength)}" if example.strength is not None else "",
        f"P(correct) {plain(example.p_correct, 2)}" if example.p_correct is not None else "",
        f"{plain(example.width_mrad)} mrad wide" if example.width_mrad is not None else "",
        f"mean of {example.n_frames} frames" if (example.n_frames or 1) > 1 else "",
        f"scene {example.scene}" if example.scene else "",
        example.frame or "",
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


def notebook_page(sentences: Sequence[str], shown: Sequence[Table], figures: Sequence[ReportFigure]) -> str:
    """Return the self-contained HTML that a notebook shows: sentences, the first table and the first figure."""
    text = "".join(f"<p>{sentence_html(sentence)}</p>" for sentence in sentences)
    content = "".join(table.without_details().html() for table in shown[:1])
    # Names inside a drawing are valid in the whole notebook, so another result must have other names.
    name = f"tod-{zlib.crc32((text + content).encode()):08x}"
    with style():
        svg = "".join(
            inline_svg(first.figure(), name=name, label=_shown(f"{first.title}. {first.note}"))
            for first in figures[:1]
        )
    paper = "--paper: var(--jp-layout-color0, Canvas); max-width: 40rem"
    return f'<div style="{paper}">{text}{content}{svg}</div>'


def inline_svg(figure: Figure, *, name: str, label: str) -> str:
    """Return the figure as an `svg` element for an HTML page; both are made inside `figure_style.style`. Ink
    becomes the page's text colour and paper its background, so a figure follows a dark page. Text stays text, in
    the page's font. It is well-formed XML without document type, namespaces, style sheet or date; the same figure
    gives the same text. `name` is unique in the page: matplotlib derives the ids of clips and markers from it.
    `label` describes the figure for readers who do not see it.
    """
    import matplotlib as mpl

    for patch in (figure.patch, *(patched.patch for axes in figure.axes for patched in (axes, *axes.child_axes))):
        patch.set(facecolor="none", edgecolor="none")
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        _, _, drawing = svg_file(figure).decode().partition("<svg")
    head, _, body = drawing.partition(">")
    view = re.search(r'viewBox="[^"]*"', head)
    assert view is not None  # matplotlib writes one into each file
    body = _TAG.sub(_of_page, _NOT_OF_PAGE.sub("", body))
    return f'<svg {view[0]} role="img" aria-label="{escape(label)}">{body.strip()}'


def _of_page(tag: re.Match[str]) -> str:
    text = tag[0]
    for pattern, replacement in _IN_TAGS:
        text = pattern.sub(replacement, text)
    return text
