"""Table class with five forms of output: terminal, CSV, Markdown, HTML and pandas DataFrame."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import islice
from typing import TYPE_CHECKING, Any, Literal, overload

import msgspec

from todframes.base.safe_text import csv_text, visible
from todframes.results.wording import interval_phrase, plain, value_text

if TYPE_CHECKING:
    from pandas import DataFrame
    from rich.console import Group


BLOCK = 4096
"""Number of rows of a long table that are made, and written, at a time."""

LONGEST_TABLE = 200
"""Largest number of rows in the HTML form; the CSV has all rows."""

EXACT = 15
"""Number of digits of a number that is shown unrounded."""

MOST_COLUMNS = 10
"""Largest number of columns that the HTML form shows side by side on a page of middling width."""

LEAST_TEXT_WIDTH = 16
"""Least width, in letters, to which a column of long names is wrapped in the terminal."""

LEAST_WORD_WIDTH = 10
"""The same of other texts: "difference" and "open above" fit."""

HIDDEN = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]")
"""Pattern of characters that HTML does not allow or that change the direction of the text beside them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """A column of a table: its key in the records and in CSV, and how its values look on screen.

    `header` is by default the key in words. Numbers have `digits` significant digits, or `decimals` after the
    point, and `sign` in front; `none` stands for a missing value. `interval` is the prefix of the two CSV names of
    a column of pairs. A terminal too narrow for all columns drops the highest `rank` first, but never rank 0; it
    shows a column that `is_detail` only if asked for details, and one that is `in_file_only` not at all. Long
    texts are wrapped in a column that `wraps`. If the flag with the key `bound_if` is set in a record, the number
    is an upper bound, with "<". A column that `is_key` has keys such as never_reached, whose words are apart on
    screen; one that `is_name` identifies rows: it is shown with the details, too, and as first column a repeated
    value once. One that is `in_summary` is in tables of several results, too.
    """

    key: str
    header: str = ""
    digits: int = 4
    decimals: int | None = None
    sign: str = ""
    none: str = "–"
    interval: str = ""
    rank: int = 0
    in_file_only: bool = False
    is_detail: bool = False
    wraps: bool = False
    bound_if: str = ""
    is_key: bool = False
    is_name: bool = False
    in_summary: bool = False

    @property
    def heading(self) -> str:
        """The heading on screen."""
        return self.header or self.key.replace("_", " ")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the column, or of its two ends, in CSV."""
        return (f"{self.interval}_low", f"{self.interval}_high") if self.interval else (self.key,)

    def text(self, value: Any) -> str:
        """Return a value as text for a reader."""
        match value:
            case None:
                return self.none
            case bool():
                return "yes" if value else "no"
            case float() if self.decimals is not None:
                return f"{value:.{self.decimals}f}"
            case float() if self.is_name or self.digits == EXACT:
                return value_text(value, self.digits)
            case float():
                return self.sign + plain(value, self.digits)
            case tuple() if self.interval:
                return interval_phrase(value, self.digits)
            case str() | int():
                return str(value).replace("_", " ") if self.is_key else str(value)
            case _:
                return msgspec.json.encode(value).decode()


class LongRecords(Sequence[Mapping[str, Any]]):
    """Records that are made from columns, block by block, each time they are read: not all are in memory at once.
    `kinds` has the type of each column's values: str, bool, int or float. `n` is the number of records, and
    `blocks` returns an iterator over mappings of all keys, in the order of `kinds`, to lists of values.
    """

    def __init__(
        self, kinds: Mapping[str, type], n: int, blocks: Callable[[], Iterator[Mapping[str, Sequence[Any]]]]
    ) -> None:
        self.kinds = kinds
        self.blocks = blocks
        self._n = n

    def __len__(self) -> int:
        return self._n

    def __iter__(self) -> Iterator[Mapping[str, Any]]:
        for block in self.blocks():
            for values in zip(*block.values(), strict=True):
                yield dict(zip(block, values, strict=True))

    @overload
    def __getitem__(self, index: int) -> Mapping[str, Any]: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Mapping[str, Any], ...]: ...
    def __getitem__(self, index: int | slice) -> Mapping[str, Any] | tuple[Mapping[str, Any], ...]:
        rows = range(self._n)[index]
        if isinstance(rows, int):
            return next(islice(self, rows, None))
        records = list(islice(self, max(rows, default=-1) + 1))
        return tuple(records[row] for row in rows)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sequence):
            return NotImplemented
        return len(self) == len(other) and all(left == right for left, right in zip(self, other, strict=True))


@dataclass(frozen=True, slots=True)
class Table:
    """Columns and records with a title; `file` is the name of the CSV file.

    A folded table is not printed, and closed on the page. An extra one is printed with `--verbose` only.
    """

    title: str
    file: str
    columns: tuple[Column, ...]
    records: Sequence[Mapping[str, Any]]
    is_folded: bool = False
    is_extra: bool = False

    @classmethod
    def of(
        cls, title: str, file: str, columns: Iterable[Column | str], records: Iterable[Mapping[str, Any]]
    ) -> Table:
        """Return a table; a column given as text is its key, with all else by default."""
        made = (Column(key=column) if isinstance(column, str) else column for column in columns)
        return cls(title, file, tuple(made), records if isinstance(records, LongRecords) else tuple(records))

    def folded(self) -> Table:
        """Return the table as a folded one."""
        return replace(self, is_folded=True)

    def extra(self) -> Table:
        """Return the table as an extra one."""
        return replace(self, is_extra=True)

    @property
    def has_details(self) -> bool:
        """Whether a column is a detail."""
        return any(column.is_detail for column in self.columns)

    def without_empty_columns(self, *but: str) -> Table:
        """Return the table without the columns in which no record has a value; columns named in `but` are kept."""
        used = {key for record in self.records for key, value in record.items() if value is not None}
        return replace(
            self, columns=tuple(column for column in self.columns if column.key in used or column.key in but)
        )

    def without_details(self) -> Table:
        """Return the table with details in its file only, as a terminal shows it by default."""
        columns = (
            replace(column, in_file_only=column.in_file_only or column.is_detail) for column in self.columns
        )
        return replace(self, columns=tuple(columns))

    def _shown(self) -> list[Column]:
        """Return the columns for a reader: not those whose cells would all be empty."""
        filled = {key for record in self.records for key, value in record.items() if value is not None}
        return [
            column for column in self.columns if not column.in_file_only and (column.none or column.key in filled)
        ]

    def is_numeric(self, column: Column) -> bool:
        """Return whether the values of a column are numbers or intervals."""
        values = (record.get(column.key) for record in self.records)
        return all(
            value is None or (isinstance(value, int | float | tuple) and not isinstance(value, bool))
            for value in values
        )

    def rows(self, columns: Sequence[Column]) -> list[list[str]]:
        """Return the cells of some columns as text for a reader, row by row."""
        return [
            ["< " * bool(record.get(column.bound_if)) + column.text(record.get(column.key)) for column in columns]
            for record in self.records
        ]

    def csv(self) -> str:
        """Return all columns as CSV; numbers have all their digits, and no text is a formula."""
        return "".join(self.csv_parts())

    def csv_parts(self) -> Iterator[str]:
        """Yield the CSV in parts, the rows of long records in blocks."""
        yield csv_text([[name for column in self.columns for name in column.names]])
        if isinstance(self.records, LongRecords):
            kinds = {column.key: self.records.kinds[column.key] for column in self.columns}
            for block in self.records.blocks():
                columns = (_fields(block[key], kind) for key, kind in kinds.items())
                yield csv_text(zip(*columns, strict=True))
        else:
            yield csv_text(
                [field_text(value) for column in self.columns for value in _ends(column, record)]
                for record in self.records
            )

    def markdown(self) -> str:
        """Return the shown columns as a table in GitHub's Markdown."""
        shown = self._shown()
        rule = ["---:" if self.is_numeric(column) else "---" for column in shown]
        lines = [[column.heading for column in shown], rule, *self.rows(shown)]
        return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)

    @property
    def n_rows_hidden(self) -> int:
        """Number of rows that the HTML form leaves out."""
        return max(0, len(self.records) - LONGEST_TABLE)

    def html(self, caption_id: str = "") -> str:
        """Return the shown columns of the first rows as an HTML `table` element; its caption has the given id."""
        shown = self._shown()
        kinds = [' class="number"' if self.is_numeric(column) else "" for column in shown]
        heads = "".join(
            f'<th scope="col"{kind}>{markup(column.heading)}</th>'
            for column, kind in zip(shown, kinds, strict=True)
        )
        body = []
        for row in replace(self, records=self.records[:LONGEST_TABLE]).rows(shown):
            first, *others = (
                f' data-label="{markup(column.heading)}"{kind}>{breakable(markup(text))}'
                for column, kind, text in zip(shown, kinds, row, strict=True)
            )
            cells = "".join(f"<td{cell}</td>" for cell in others)
            body.append(f'<tr><th scope="row"{first}</th>{cells}</tr>')
        lines = "\n".join(body)
        mark = f' id="{caption_id}"' if caption_id else ""
        wide = ' class="wide"' if len(shown) > MOST_COLUMNS else ""
        head = f"<table{wide}>\n<caption{mark}>{markup(self.title)}</caption>\n<thead><tr>{heads}</tr></thead>"
        return f"{head}\n<tbody>\n{lines}\n</tbody>\n</table>"

    def to_dataframe(self) -> DataFrame:
        """Return all columns as a pandas DataFrame; an interval becomes two columns.

        Raises
        ------
        ImportError
            If pandas is not installed.
        """
        try:
            from pandas import DataFrame
        except ImportError as error:
            raise ImportError("a DataFrame needs pandas, which is not installed: pip install pandas") from error
        names = [name for column in self.columns for name in column.names]
        rows = [[value for column in self.columns for value in _ends(column, record)] for record in self.records]
        return DataFrame(rows, columns=names)

    def terminal(self, width: int, *, details: bool = False) -> Group:
        """Lay out title and table for a terminal of `width` letters, to be printed on a console as wide.

        A narrow one shows fewer columns, but no number is cut or broken. With `details`, the columns that identify
        rows and those that are details stand in place of the others.
        """
        from rich.box import SIMPLE_HEAD
        from rich.console import Group
        from rich.table import Table as RichTable
        from rich.text import Text

        shown = [column for column in self._shown() if column.is_name or column.is_detail == details]
        while True:
            rows = [list(map(visible, row)) for row in self.rows(shown)]
            cells = list(zip(*rows, strict=True)) or [()] * len(shown)
            least, most = zip(*map(_widths, shown, cells), strict=True)
            # Each column has two letters of padding; one letter is between columns and one at each end.
            room = width - sum(least) - 3 * len(shown) - 1
            rank = max(column.rank for column in shown)
            if room >= 0 or not rank:
                break
            shown = [column for column in shown if column.rank < rank]
        # Cells are Text, not str: names are data, and rich would read brackets in them as markup.
        table = RichTable(box=SIMPLE_HEAD)
        # Short columns get their full width first; then long texts, the longest before the others.
        widths = [
            max(letters + min(room, 0), min(letters, LEAST_WORD_WIDTH)) if column.wraps else letters
            for column, letters in zip(shown, least, strict=True)
        ]
        for place in sorted(range(len(shown)), key=lambda k: (1, -most[k]) if shown[k].wraps else (0, most[k])):
            more = max(min(most[place] - least[place], room), 0)
            widths[place] += more
            room -= more
        for column, letters in zip(shown, widths, strict=True):
            side: Literal["left", "right"] = "right" if self.is_numeric(column) else "left"
            table.add_column(
                Text(visible(column.heading)), justify=side, vertical="top", width=letters, overflow="fold"
            )
        before = None
        for first, *others in rows:
            # A name that equals that of the row above is not written again.
            repeated = shown[0].is_name and first == before
            row = zip(["" if repeated else first, *others], widths, strict=True)
            table.add_row(*(Text(_broken(cell, letters)) for cell, letters in row))
            before = first
        return Group(Text(visible(self.title), style="bold"), table)


def _widths(column: Column, cells: Iterable[str]) -> tuple[int, int]:
    """Return a column's least width, with header, long texts and open intervals wrapped, and its full width."""
    from rich.cells import cell_len

    cells = list(cells)
    header = max(map(cell_len, column.heading.split()), default=1)
    text_width = LEAST_TEXT_WIDTH if column.is_name else LEAST_WORD_WIDTH
    least = max(
        (
            min(cell_len(cell), text_width)
            if column.wraps or (column.interval and "," in cell)  # "from 0.2, open above"
            else cell_len(cell)
            for cell in cells
        ),
        default=0,
    )
    return max(least, header), max(max(map(cell_len, cells), default=0), cell_len(column.heading))


def _broken(cell: str, width: int) -> str:
    """Return a text in lines of `width` letters that end behind a space, an underscore or a slash."""
    lines = [""]
    for part in re.split(r"(?<=[ _/])", cell):
        if len(lines[-1]) + len(part.rstrip()) > width and lines[-1]:
            lines.append("")
        lines[-1] += part
    return "\n".join(line.rstrip() for line in lines)


def breakable(html: str) -> str:
    """Return HTML without tags in which a long name may break behind an underscore or a slash."""
    return re.sub(r"(?<=\w[_/])(?=\w)", "<wbr/>", html)


def markup(text: str) -> str:
    """Return a text escaped for HTML."""
    return escape(HIDDEN.sub("\ufffd", text))


def _ends(column: Column, record: Mapping[str, Any]) -> tuple[Any, ...]:
    value = record.get(column.key)
    return (value or (None, None)) if column.interval else (value,)


def _fields(values: Sequence[Any], kind: type) -> Sequence[object]:
    """Return the values of a column as CSV fields: what `field_text` gives, numbers still to be written."""
    if kind is float:
        return [None if value != value else value for value in values]
    return values if kind is int else [field_text(value) for value in values]


def field_text(value: object) -> str:
    """Return a value as a CSV field: all digits of a number, nothing for None and NaN."""
    if value is None or value != value:
        return ""
    if isinstance(value, str):
        return value
    return repr(value) if isinstance(value, float) else msgspec.json.encode(value).decode()
