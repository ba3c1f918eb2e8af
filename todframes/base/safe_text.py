"""Escaping of text that comes from data, so that it is harmless on a terminal and in a spreadsheet."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable

FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")

_UNESCAPED_BY_JSON = re.compile(r"[\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
"""Pattern of control characters and of characters that change the direction of the text beside them."""


def visible(text: str) -> str:
    r"""Return a text in which every character that is not printable is escaped: an ESC becomes `\x1b`.

    Such characters move the cursor of a terminal, set its title or turn the direction of the text beside them.
    Line breaks are among them, so the result is one line.
    """
    if text.isprintable():
        return text
    return "".join(one if one.isprintable() else ascii(one)[1:-1] for one in text)


def one_line(text: str) -> str:
    """Return a text for a comment of one line: without line breaks and characters that are not printable."""
    return "".join(filter(str.isprintable, " ".join(text.split())))


def visible_json(text: str) -> str:
    """Return JSON in which characters that a terminal would obey are escaped; its values are the same."""
    return _UNESCAPED_BY_JSON.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def csv_text(rows: Iterable[Iterable[object]], *, as_it_is: bool = False) -> str:
    """Return rows as CSV; a text that a spreadsheet would compute as a formula gets `'` in front.

    Names of files in a manifest have to stay `as_it_is`.
    """
    # The writer quotes what its line ends are made of; a carriage return that is not quoted would begin a row.
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\r\n")
    lines = []
    for row in rows:
        writer.writerow(row if as_it_is else map(_no_formula, row))
        lines.append(text.getvalue().removesuffix("\r\n"))
        text.seek(0)
        text.truncate()
    return "\n".join([*lines, ""])


def _no_formula(value: object) -> object:
    if not isinstance(value, str) or not value.startswith(FORMULA_STARTS):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value
