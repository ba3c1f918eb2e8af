"""Escaping of text that comes from data, so that it is harmless on a terminal and in a spreadsheet."""

from __future__ import annotations

import csv
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
    return "".join(character if character.isprintable() else ascii(character)[1:-1] for character in text)


def one_line(text: str) -> str:
    """Return a text for a comment of one line: without line breaks and characters that are not printable."""
    return "".join(filter(str.isprintable, " ".join(text.split())))


def visible_json(text: str) -> str:
    """Return JSON in which characters that a terminal would obey are escaped; its values are the same."""
    return _UNESCAPED_BY_JSON.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Return rows as CSV; a text that a spreadsheet would compute as a formula gets `'` in front."""
    # The writer quotes what its line ends are made of; a carriage return that is not quoted would begin a row.
    writer = csv.writer(_Echo(), lineterminator="\r\n")
    lines = (writer.writerow(map(_no_formula, row)) for row in rows)
    return "\n".join([*(line.removesuffix("\r\n") for line in lines), ""])


class _Echo:
    """File whose `write` returns the text, as `writerow` then does."""

    def write(self, text: str) -> str:
        return text


def _no_formula(value: object) -> object:
    if not isinstance(value, str) or not value.startswith(FORMULA_STARTS):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def without_quote(text: str) -> str:
    """Return a text without the mark that `csv_text` puts before texts that a spreadsheet would compute."""
    return text[1:] if text.startswith("'") and text[1:].startswith(FORMULA_STARTS) else text


def in_utf8(text: str) -> str:
    r"""Return a text in which what UTF-8 cannot encode is escaped: a byte of a file name becomes `\udce9`."""
    return text.encode(errors="backslashreplace").decode()
