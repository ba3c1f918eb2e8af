"""Conversion of a matplotlib figure to inline SVG: small, in the page's own colours, reproducible.

Ink becomes the page's text colour and paper its background, so a figure follows a dark page. Text stays text, in
the page's font. Names used inside are made unique to the figure, for a page holds several.
"""

from __future__ import annotations

import io
import re
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from todframes.report.figure_style import INK, PAPER

if TYPE_CHECKING:
    from matplotlib.figure import Figure


PAGE_COLOURS = {INK: "currentColor", PAPER: "var(--paper)"}


_FONT = re.compile(r"font: ([\d.]+px) [^;]*|font-family:[^;]*; ")


_LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")


_REFERENCE = re.compile(r"url\(#([^)]*)\)")


def inline_svg(figure: Figure, *, name: str, label: str) -> str:
    """Return the figure as an `svg` element for an HTML page.

    Parameters
    ----------
    figure : matplotlib Figure
        Figure made inside `figure_style.style`; call this function inside it too.
    name : str
        Name of letters, digits and hyphens that is unique in the page. The names inside begin with it.
    label : str
        Description of the figure, for readers who do not see it.

    Returns
    -------
    str
        Well-formed XML without document type, namespaces, style sheet or date; the same figure gives the same
        text.
    """
    import matplotlib as mpl

    buffer = io.BytesIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    root = ElementTree.fromstring(buffer.getvalue())
    _tidy(root)
    used = {part[1:] for element in root.iter() for part in _references(element)}
    for element in root.iter():
        _rewrite(element, name, used)
    root.attrib = {"viewBox": root.attrib["viewBox"], "role": "img", "aria-label": label}
    return ElementTree.tostring(root, encoding="unicode")


def _tidy(element: ElementTree.Element) -> None:
    """Remove namespaces, metadata, and style sheets, which would apply to the whole page."""
    element.tag = element.tag.rpartition("}")[2]
    element.attrib = {key.rpartition("}")[2]: value for key, value in element.attrib.items()}
    element.tail = None
    if element.tag not in ("text", "tspan"):
        element.text = None
    for child in list(element):
        _tidy(child)
        empty = child.tag in ("defs", "g") and len(child) == 0
        if child.tag in ("metadata", "style") or empty:
            element.remove(child)


def _references(element: ElementTree.Element) -> list[str]:
    """Return the names of other elements that an element uses, each with a hash in front."""
    found = [f"#{name}" for value in element.attrib.values() for name in _REFERENCE.findall(value)]
    return found + [value for key, value in element.attrib.items() if key == "href" and value[0] == "#"]


def _rewrite(element: ElementTree.Element, prefix: str, used: set[str]) -> None:
    attributes = {}
    for key, value in element.attrib.items():
        if key == "id":
            if value in used:
                attributes[key] = f"{prefix}-{value}"
            continue
        if key == "href" and value[0] == "#":
            value = f"#{prefix}-{value[1:]}"
        elif key in ("style", "fill", "stroke"):
            for colour, of_page in PAGE_COLOURS.items():
                value = value.replace(colour, of_page)
            value = _FONT.sub(lambda found: f"font-size: {found[1]}" if found[1] else "", value)
        else:
            value = _LONG_NUMBER.sub(lambda found: f"{float(found[0]):.2f}", value)
        attributes[key] = _REFERENCE.sub(rf"url(#{prefix}-\1)", value)
    element.attrib = attributes
