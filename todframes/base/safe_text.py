"""Escaping of text that comes from data, so that it is harmless on a terminal and in a spreadsheet; no secrets."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable

FORMULA_STARTS = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")

_UNESCAPED_BY_JSON = re.compile(r"[\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")
"""Pattern of control characters and of characters that change the direction of the text beside them."""
CONTAINER_BEFORE_AT = ("abfs", "abfss", "wasb", "wasbs")
"""Schemes whose URLs have a container where others have a user name: `abfs://box@account.dfs.core.windows.net`."""
_USER = re.compile(r"(?P<scheme>[A-Za-z][A-Za-z0-9+.-]+):(?P<slashes>//?)(?:[^\s/@]*:(?!\d+/)[^\s@]*|[^\s/@]*)@")
"""Pattern of the start of a URL with a user name, and perhaps a password; a `Path` of it has one slash."""
_QUERY = re.compile(r"((?:https?://|[A-Za-z][A-Za-z0-9+.-]+:/(?!/))[^\s?#;]*)[?#;]\S+")
"""Pattern of a URL with a parameter, query or fragment."""


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


def without_secrets(text: str) -> str:
    """Return a text in which URLs have no user name, password, parameter, query or fragment."""

    def without_user(match: re.Match[str]) -> str:
        is_container = match["scheme"].lower() in CONTAINER_BEFORE_AT
        return match[0] if is_container else f"{match['scheme']}:{match['slashes']}…@"

    return _QUERY.sub(r"\1…", _USER.sub(without_user, text)) if ":/" in text else text


def in_utf8(text: str) -> str:
    r"""Return a text in which what UTF-8 cannot encode is escaped: a byte of a file name becomes `\udce9`."""
    return text.encode(errors="backslashreplace").decode()
