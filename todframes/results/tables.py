"""Tables for the terminal, CSV, Markdown, HTML and pandas, and those of a result."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from todframes.base.safe_text import csv_text, visible
from todframes.results.wording import (
    SIZE_DIGITS,
    column_heading,
    group_phrase,
    interval_phrase,
    level_heading,
    path_name,
    plain,
    threshold_heading,
    unit_of,
    value_text,
)
from todframes.stimulus import ORIENTATIONS

if TYPE_CHECKING:
    import rich.console
    from pandas import DataFrame

    from todframes.results.data import DatasetRecord, Efficiency, Fit, Group, Record
    from todframes.results.result import Result


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
        return cls(title, file, tuple(made), tuple(records))

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
        names = [name for column in self.columns for name in column.names]
        rows = (
            [field_text(value) for column in self.columns for value in _ends(column, record)]
            for record in self.records
        )
        return csv_text([names, *rows])

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

    def terminal(self, width: int, *, details: bool = False) -> rich.console.Group:
        """Lay out title and table for a terminal of `width` letters, to be printed on a console as wide.

        A narrow one shows fewer columns, but no number is cut or broken. With `details`, the columns that identify
        rows and those that are details stand in place of the others.
        """
        import rich.console
        from rich.box import SIMPLE_HEAD
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
        return rich.console.Group(Text(visible(self.title), style="bold"), table)


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


def field_text(value: object) -> str:
    """Return a value as a CSV field: all digits of a number, nothing for None and NaN."""
    if value is None or value != value:
        return ""
    if isinstance(value, str):
        return value
    return repr(value) if isinstance(value, float) else msgspec.json.encode(value).decode()


THRESHOLD_COLUMNS = (
    Column(key="threshold_ci95", header="95 % interval", interval="threshold_ci95", in_summary=True),
    Column(key="threshold_numerical_error", header="numerical error", sign="± ", digits=1),
    Column(key="threshold_displacement_error", header="displacement error", sign="± ", digits=2, rank=2),
    Column(key="delta_t_mk", header="ΔT (mK)"),
    Column(key="n_trials", header="trials", rank=1, in_summary=True),
    Column(key="status", is_key=True, in_summary=True),
    Column(key="points_threshold", header="from points", is_detail=True, rank=2),
    Column(key="p_correct", in_file_only=True),
    Column(key="curve", is_detail=True, rank=2),
    Column(key="alpha", header="α", digits=3, is_detail=True),
    Column(key="beta", header="β", digits=3, is_detail=True),
    Column(key="gamma", in_file_only=True),
    Column(key="delta", header="δ", digits=3, is_detail=True),
    Column(key="p_correct_error_bound", in_file_only=True),
    Column(key="background_luminance_cd_m2", header="background (cd/m²)", is_detail=True, rank=2),
)

RATE_COLUMNS = {"gamma": "guess_rate", "delta": "lapse_rate"}
"""Attributes of a fit whose columns have the names of the keys in JSON."""

CONDITION = Column(key="condition", is_name=True, wraps=True)

TAKEN = {"threshold", "level", *(column.key for column in THRESHOLD_COLUMNS)}
"""Column names in use; a group column with one of these names is renamed."""


def group_columns(names: Iterable[str], taken: Collection[str] = TAKEN) -> list[Column]:
    """Return the columns of groups, from the names of those of a dataset."""
    return [
        CONDITION
        if name == CONDITION.key and name not in taken
        else Column(
            key=group_key(name, taken),
            header=column_heading(name),
            digits=SIZE_DIGITS if unit_of(name) else EXACT,
            is_name=True,
        )
        for name in names
    ]


def group_key(name: str, taken: Collection[str] = TAKEN) -> str:
    """Return the key of a column of groups in a table that has others."""
    return f"group {name}" if name in taken else name


def group_record(group: Group, taken: Collection[str] = TAKEN) -> Record:
    """Return the values of a group by the keys of its columns."""
    return {group_key(name, taken): value for name, value in group.items()}


def thresholds(fits: Sequence[Fit]) -> Table:
    """Make the table of thresholds, a row each; columns without any value are left out."""
    computed = not any(fit.n_trials for fit in fits)
    names = [
        "threshold",
        *(column.key for column in THRESHOLD_COLUMNS if column.key != "n_trials" or not computed),
    ]
    records = [
        group_record(fit.group) | {name: getattr(fit, RATE_COLUMNS.get(name, name)) for name in names}
        for fit in fits
    ]
    groups = group_columns(fits[0].group if fits else ())
    heading = Column(key="threshold", header=threshold_heading(fits[0].level) if fits else "")
    title = f"Thresholds at {f'{100 * fits[0].p_correct:g}' if fits else '?'} % correct"
    table = Table.of(title, "thresholds.csv", [*groups, heading, *THRESHOLD_COLUMNS], records)
    always = ["threshold", *(column.key for column in groups), *([] if computed else ["threshold_ci95"])]
    return table.without_empty_columns(*always)


def points(fits: Sequence[Fit]) -> Table | None:
    """Make the table of the points of each curve, a row for each level; None if there are no points."""
    records = [
        group_record(fit.group) | {"level": point.level, "n_trials": point.n_trials, "p_correct": point.p_correct}
        for fit in fits
        for point in fit.points
    ]
    if not records:
        return None
    computed = not any(record["n_trials"] for record in records)
    columns = [
        *group_columns(fits[0].group),
        Column(key="level", header=level_heading(fits[0].level), digits=4 if computed else EXACT),
        Column(key="n_trials", header="trials", in_file_only=computed),
        Column(key="p_correct", header="proportion correct"),
    ]
    return Table.of("Points of the psychometric functions", "points.csv", columns, records)


def efficiencies(of_pairs: Sequence[Efficiency]) -> Table:
    """Make the table of efficiencies, a row for each group and each other observer."""
    taken = {"relative_to", "threshold", "efficiency", "efficiency_ci95"}
    records = [
        {name: getattr(pair, name) for name in taken} | group_record(pair.group, taken) for pair in of_pairs
    ]
    columns = [
        Column(key="relative_to", is_name=True, wraps=True),
        *group_columns(of_pairs[0].group, taken),
        Column(key="threshold", header="its threshold"),
        Column(key="efficiency", digits=3),
        Column(key="efficiency_ci95", header="95 % interval", interval="efficiency", digits=3),
    ]
    return Table.of("Efficiency", "efficiency.csv", columns, records)


def answers(fits: Sequence[Fit]) -> Table | None:
    """Make the table of answers in the strongest trials of groups without a threshold; None if there are none."""
    records = [
        group_record(fit.group)
        | {"from_level": fit.answers_from_level, "shown": shown.value, "n_answers": round(sum(row))}
        | {
            f"answered_{orientation.value}": 100.0 * n / sum(row)
            for orientation, n in zip(ORIENTATIONS, row, strict=True)
        }
        for fit in fits
        for shown, row in zip(ORIENTATIONS, fit.answers or (), strict=False)
        if sum(row)
    ]
    if not records:
        return None
    columns = [
        *group_columns(fits[0].group),
        Column(key="from_level", header=f"from {level_heading(fits[0].level)}", digits=EXACT),
        Column(key="shown"),
        *(
            Column(key=f"answered_{orientation.value}", header=f"{orientation.value} (%)", decimals=0)
            for orientation in ORIENTATIONS
        ),
        Column(key="n_answers", header="trials", rank=1),
    ]
    return Table.of("Answers by orientation shown", "answers.csv", columns, records)


def plan(fits: Sequence[Fit], steps_of_all: tuple[Record, ...]) -> Table:
    """Make the table of the steps that were computed or left out, for each threshold if each has a plan."""
    plans = [(group_phrase(fit.group), fit.plan) for fit in fits if fit.plan] or [("", steps_of_all)]
    records = [
        {"group": group or None}
        | {key: value for key, value in step.items() if key != "kept" and not (step.get("kept") and key in UNUSED)}
        | {"kept": "kept" if step.get("kept") else "left out"}
        for group, steps in plans
        for step in steps
    ]
    columns = [
        Column(key="group", is_name=True),
        Column(key="stage"),
        Column(key="kept", header="is"),
        Column(key="why", wraps=True),
        Column(key="bound", header="bound on P", digits=2, none=""),
        Column(key="saves_s", header="saves (s)", digits=2, none="", rank=1),
    ]
    return Table.of("Plan", "plan.csv", columns, records).without_empty_columns("stage")


LONGEST_LIST = 16
"""Largest number of values of a setting that are shown."""

UNUSED = ("bound", "saves_s")
"""Keys of a plan's step that have no meaning if the step is kept."""


def records_table(title: str, file: str, records: Sequence[Record]) -> Table:
    """Make a table of records whose keys are not known beforehand, with a column for each key."""
    return Table.of(title, file, dict.fromkeys(key for record in records for key in record), records)


def settings(result: Result) -> Table:
    """Make the table of a result's settings and versions; names of nested settings are joined with dots."""
    made: Record = {
        "command": result.command,
        "name": result.name or None,
        "seed": result.seed,
        "version": result.version,
        **_flat(result.versions, "versions."),
        "run_time_s": result.run_time_s,
    }
    made = {name: value for name, value in made.items() if value is not None}
    made |= _flat(result.settings, "settings.")
    # Values are texts, because this table shows all digits on screen too.
    return _names_and_values("Settings, seed and versions", "settings.csv", made)


def dataset(record: DatasetRecord) -> Table:
    """Make the table of a dataset's display, experiment and manifest; of long lists it has the two ends."""
    made = _flat(
        {
            "path": record.path,
            "manifest_sha256": record.manifest_sha256,
            "n_frames": record.n_frames,
            "display": record.display,
            "experiment": record.experiment,
        },
        "",
    )
    for name, value in made.items():
        if isinstance(value, list) and len(value) > LONGEST_LIST:
            made[name] = f"{len(value)} values from {field_text(value[0])} to {field_text(value[-1])}"
    return _names_and_values("Dataset and display", "dataset.csv", made)


def _names_and_values(title: str, file: str, values: Record) -> Table:
    """Make a table of names and values; of an absolute path it has the last part."""
    rows: list[Record] = [
        {"name": name, "value": field_text(_without_folders(value)) or None} for name, value in values.items()
    ]
    return Table.of(title, file, ["name", "value"], rows)


def _without_folders(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [*map(_without_folders, value)]
    return path_name(value) if isinstance(value, str) else value


def _flat(values: Record, prefix: str) -> Record:
    flat: Record = {}
    for name, value in values.items():
        flat |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return flat


TRIAL_KINDS = {
    **dict.fromkeys(("condition", "trial", "orientation", "answer"), str),
    **dict.fromkeys(("n_frames", "polarity"), int),
}
"""Columns of scored trials that are texts or whole numbers; the others are groups or numbers."""


def trial_kinds(names: Iterable[str], groups: Sequence[Group]) -> dict[str, type]:
    """Return the type of each column of scored trials; that of a group is a text if one of its values is."""
    texts = {name for group in groups for name, value in group.items() if isinstance(value, str)}
    kinds = TRIAL_KINDS | {name: float for group in groups for name in group} | dict.fromkeys(texts, str)
    return {name: kinds.get(name, float) for name in names}
