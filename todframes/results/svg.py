"""Conversion of a matplotlib figure to inline SVG: small, in the page's own colours, reproducible.

Ink becomes the page's text colour and paper its background, so a figure follows a dark page. Text stays text, in
the page's font.
"""

from __future__ import annotations

import re
from html import escape
from typing import TYPE_CHECKING

from todframes.results.figure_style import INK, PAPER, svg_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def inline_svg(figure: Figure, *, name: str, label: str) -> str:
    """Return the figure as an `svg` element for an HTML page; both are made inside `figure_style.style`.

    It is well-formed XML without document type, namespaces, style sheet or date; the same figure gives the same
    text. `name` is unique in the page: matplotlib derives the ids of clips and markers from it. `label` describes
    the figure for readers who do not see it.
    """
    import matplotlib as mpl

    for patch in (figure.patch, *(one.patch for axes in figure.axes for one in (axes, *axes.child_axes))):
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
