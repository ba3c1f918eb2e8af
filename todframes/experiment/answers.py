"""The files of people's answers: trials that are appended one by one, and the sidecar of each session.

    ANSWERS/data/subject-ID_session-1_data.csv     a row a trial
    ANSWERS/data/subject-ID_session-1_data.json    the session: monitor, consent, dataset, design, software
    ANSWERS/dataset_description.json               the folder, as Psych-DS 1.5 asks for it

A row is on the disk before the next trial is shown. If a killed server or a full disk leaves a part of a line,
that part is cut off when the session continues.
"""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, Self, get_args

import msgspec
from msgspec import Meta

from todframes.base._typing import Json
from todframes.base.errors import DataError, OutputError, SettingsError, argument
from todframes.base.output import locked, write_file
from todframes.base.reading import MAX_CSV_MB, Positive, check_values, number_or_text, read_file
from todframes.base.safe_text import csv_text, without_quote
from todframes.experiment.monitor import Monitor
from todframes.frames.trials import Group
from todframes.parameters import Method
from todframes.psychometrics.fit import COUNT_COLUMNS
from todframes.stimulus import Orientation

SCHEMA = 1
"""Version of the format of the sidecar."""

MAX_SIDECAR_MB = 4
"""Largest size of a sidecar that is read, in units of 2**20 bytes."""

Phase = Literal["practice", "main"]

Whole = Annotated[int, Meta(ge=0)]

Flag = Literal["hidden", "unfocused", "too_fast"]
"""Reason for which an answer says nothing about what the person saw: the page was hidden or had lost the focus
during the trial, or the response came earlier than `LEAST_RESPONSE_MS`."""

LEAST_RESPONSE_MS = 150.0
"""Least response time of an answer to the picture. People need some 200 ms to press one of two keys (Luce 1986);
an earlier response began before the picture."""

NO_RESPONSE = "none"
"""Response of a trial whose time limit passed."""

SAME_PITCH = 0.005
"""Relative difference of two pitches of a pixel in mrad that a ruler cannot resolve."""

SHARED = ("frame", "orientation", "size_mrad")
"""Columns whose values are those of the manifest, so that the level or `group_by` may name them."""

DESCRIPTION_FILE = "dataset_description.json"

PRIVATE = 0o700
"""Permissions of the folders of answers: only their owner can read them."""

DESCRIPTIONS: Mapping[str, tuple[str, str | None]] = {
    "trial": ("Number of the trial in its session, from 1; practice trials count", None),
    "phase": ("practice: with feedback, does not count; main: without", None),
    "frame": ("Path of the trial's first frame in the dataset that was shown", None),
    "sha256": ("SHA-256 of the file of the frame; of several frames, of the lines of their checksums", None),
    "orientation": ("Where the apex of the triangle points: up, right, down or left", None),
    "response": ("What the person said; none: the time limit passed", None),
    "correct": ("1 if the response is the orientation, otherwise 0", None),
    "response_time_ms": ("Time from the picture to the response, as the browser measured it", "ms"),
    "flag": (
        "hidden, unfocused: the page was not seen, or had lost the focus, during the trial; too_fast: the "
        "response came within 150 ms; empty: none of them. Flagged answers do not count",
        None,
    ),
    "size_mrad": (
        "Square root of the triangle's area on the dataset's display; at the person's eye it is this times the "
        "monitor's pixel_pitch_mrad (sidecar) over the dataset's",
        "mrad",
    ),
    "dither_seed": ("Place of the dither pattern; with the frame and the monitor it gives each pixel", None),
    "clipped_px": ("Number of pixels that the monitor could not show", None),
    "shown_at": ("Time at which the page asked for the trial, ISO 8601, UTC", None),
}
"""Descriptions and units of the columns of a data file. Behind the flag come the level and the columns of
`group_by`; `size_mrad` is not repeated if it is one of them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Consent:
    """The text that a person agreed to, and the time, ISO 8601."""

    text: str
    agreed_at: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ShownDataset:
    """The dataset that a session shows: its place, and the properties that a session depends on."""

    path: str
    manifest_sha256: str
    pixel_pitch_mrad: float
    level: str
    group_by: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionRecord:
    """The sidecar of a session; `run_experiment` describes its settings. `stopped_at` is the time at which the
    person ended the session, ISO 8601.
    """

    schema: int = SCHEMA
    subject: str
    session: int = 1
    started: str
    software: Mapping[str, str]
    consent: Consent | None = None
    dataset: ShownDataset
    method: Method = "constant"
    seed: Annotated[int, Meta(ge=0, le=2**32 - 1)]
    trials: Annotated[int, Meta(ge=1, le=1_000_000)]
    practice: Annotated[int, Meta(ge=0, le=1000)] = 8
    practice_correct: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.75  # guesses give 6 of 8 after some 500 trials
    break_every: Annotated[int, Meta(ge=0, le=1_000_000)] = 60
    time_limit_s: Annotated[float, Meta(ge=0.2, le=3600)] | None = None
    background: Annotated[float, Meta(ge=0.01, le=0.99)] = 0.5
    dither: bool = True
    include_flagged: bool = False
    monitor: Monitor | None = None
    stopped_at: str | None = None

    def __post_init__(self) -> None:
        check_values(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrialRow:
    """A trial that a person has answered: a row of the data file, whose columns `DESCRIPTIONS` explains.
    `response` is None if the time limit passed. `size_mrad` is the size in the manifest; at the eye it is larger
    by the ratio of the monitor's pixel pitch to the dataset's. `dither_seed` is that of `monitor.shown_codes`.
    """

    number: Whole
    phase: Phase
    frame: str
    sha256: str
    orientation: Orientation
    response: Orientation | None
    response_time_ms: Annotated[float, Meta(ge=0.0, le=1e9)]
    flag: Flag | None = None
    level: Positive
    group: Group
    size_mrad: Positive
    dither_seed: Whole
    clipped_px: Whole
    shown_at: str

    @property
    def is_correct(self) -> bool:
        """True if the response was right."""
        return self.response is self.orientation


@dataclass(frozen=True, slots=True)
class Session:
    """A session that has begun: its monitor is calibrated. `path` is its data file, `rows` are in order. With
    `include_flagged`, flagged answers count as all others do.
    """

    path: Path
    record: SessionRecord
    monitor: Monitor
    rows: tuple[TrialRow, ...]
    include_flagged: bool = False

    @property
    def subject(self) -> str:
        """Anonymous id of the person."""
        return self.record.subject

    def main_rows(self) -> tuple[TrialRow, ...]:
        """Return the rows that count: those of the main phase with a response and, as a rule, without a flag."""
        return counted_rows(self.rows, include_flagged=self.include_flagged)


def counted_rows(rows: Iterable[TrialRow], *, include_flagged: bool) -> tuple[TrialRow, ...]:
    """Return the rows that count: main trials with a response, those with a flag only if they are included."""
    return tuple(
        row
        for row in rows
        if row.phase == "main" and row.response is not None and (include_flagged or row.flag is None)
    )


def flagged(rows: Iterable[TrialRow]) -> dict[Flag, int]:
    """Return the number of main trials with each flag that occurs, in the order of `Flag`."""
    flags = Counter(row.flag for row in rows if row.phase == "main")
    return {flag: flags[flag] for flag in get_args(Flag) if flags[flag]}


def columns(level: str, group_by: tuple[str, ...]) -> tuple[str, ...]:
    """Return the columns of a data file."""
    varied = (level, *group_by)
    for name in varied:
        is_count = name in COUNT_COLUMNS and name in group_by
        if is_count or (name in DESCRIPTIONS and name not in SHARED):
            raise SettingsError(
                f"level, group_by: found {name!r}, which is a column of the answers; rename it in the manifest"
            )
    n_before = list(DESCRIPTIONS).index("flag") + 1
    return tuple(dict.fromkeys([*list(DESCRIPTIONS)[:n_before], *varied, *DESCRIPTIONS]))


def data_path(folder: Path, subject: str) -> Path:
    """Return the data file of a subject's session."""
    return folder / "data" / f"subject-{subject}_session-1_data.csv"


def sidecar_path(data: Path) -> Path:
    """Return the sidecar of a data file."""
    return data.with_suffix(".json")


def read_answers(folder: Path | str, *, include_flagged: bool = False) -> list[Session]:
    """Read the sessions of a folder of answers that have a row, ordered by their names."""
    folder = Path(folder)
    sessions = []
    for path, record in read_records(folder):
        rows = read_rows(path, record.dataset)
        if record.monitor is not None and rows:
            sessions.append(Session(path, record, record.monitor, rows, include_flagged))
    if not sessions:
        raise DataError(
            f"{folder}: no answers; expected data/subject-*_session-*_data.csv of todframes experiment"
        )
    return sessions


def read_records(folder: Path) -> list[tuple[Path, SessionRecord]]:
    """Read the sidecars of a folder of answers, ordered by their names, each with the path of its data file."""
    sidecars = sorted((folder / "data").glob("subject-*_session-*_data.json"))
    return [(path.with_suffix(".csv"), read_sidecar(path)) for path in sidecars]


def read_sidecar(path: Path) -> SessionRecord:
    """Read the sidecar of a session; DataError if it cannot be read, or is not a sidecar."""
    record = read_record(path)
    if sidecar_path(data_path(path.parent.parent, record.subject)) != path:
        raise DataError(f"{path}: subject: found {record.subject!r}, expected that of the file's name")
    return record


def read_record(path: Path) -> SessionRecord:
    """Read the record of a session, whatever the name of the file; DataError if it cannot be read."""
    content = read_file(path, most_mb=MAX_SIDECAR_MB)
    try:
        record = msgspec.json.decode(content, type=SessionRecord)
    except (msgspec.DecodeError, SettingsError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: not the sidecar of a session ({error})") from None
    if record.schema != SCHEMA:
        raise DataError(f"{path}: schema: found {record.schema}, expected {SCHEMA}")
    return record


def read_rows(path: Path, dataset: ShownDataset) -> tuple[TrialRow, ...]:
    """Read the rows of a data file; a last line that was torn is left out."""
    expected = columns(dataset.level, dataset.group_by)
    whole_lines = read_file(path, most_mb=MAX_CSV_MB).rpartition(b"\n")[0]
    try:
        # No field has a line break in it: `check_text` refuses them before a session begins.
        lines = list(csv.reader(whole_lines.decode().split("\n"), strict=True)) if whole_lines else []
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: not CSV of UTF-8 ({error})") from None
    if not lines:
        return ()
    names = tuple(without_quote(name) for name in lines[0])
    if names != expected:
        raise DataError(f"{path}: found the columns {', '.join(names)}, expected {', '.join(expected)}")
    made: list[TrialRow] = []
    for line, fields in enumerate(lines[1:], 2):
        where = f"{path}, line {line}"
        if len(fields) != len(expected):
            raise DataError(f"{where}: found {len(fields)} fields, expected {len(expected)} as in the header")
        made.append(row_of_texts(dict(zip(expected, fields, strict=True)), dataset, where))
        if made[-1].number != len(made):
            raise DataError(f"{where}: trial: found {made[-1].number}, expected {len(made)}, one more in each row")
    return tuple(made)


def check_text(text: str, where: str) -> None:
    """Raise DataError for a text of the manifest that a line of the data file cannot hold."""
    if len(text.splitlines()) > 1 or text.strip() != text:
        raise DataError(f"{where}: found {text!r}, expected a text without line breaks, or spaces at its ends")


def row_of_texts(texts: Mapping[str, str], dataset: ShownDataset, where: str) -> TrialRow:
    """Return the row that the fields of a line, by column, describe."""
    named: Json = {**texts, "number": texts["trial"], "level": texts[dataset.level], "group": ()}
    named |= {"frame": without_quote(texts["frame"]), "flag": texts["flag"] or None}
    named["response"] = None if texts["response"] == NO_RESPONSE else texts["response"]
    try:
        row = msgspec.convert(named, TrialRow, strict=False)
    except msgspec.ValidationError as error:
        raise DataError(f"{where}: {error}") from None
    if texts["correct"] != str(int(row.is_correct)):
        shown = f"the response was {texts['response']} to {row.orientation}"
        raise DataError(f"{where}: correct: found {texts['correct']}, but {shown}")
    return replace(row, group=tuple(number_or_text(without_quote(texts[name])) for name in dataset.group_by))


def flag_of(response_time_ms: float | None) -> Flag | None:
    """Return the flag that a response time alone gives; None is the time of a trial without a response."""
    return "too_fast" if response_time_ms is not None and response_time_ms < LEAST_RESPONSE_MS else None


def write_sidecar(path: Path, record: SessionRecord) -> None:
    """Write the sidecar of a session, whole or not at all; OutputError if it cannot be written."""
    content = msgspec.json.format(msgspec.json.encode(record), indent=2) + b"\n"
    write_file(path, content, is_private=True)


class AnswerFile:
    """The data file of a session, open for appending and locked: no other process can write it. Use it in a `with`
    statement; `begin` it before the first row. `rows` are those that are on the disk.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rows: list[TrialRow] = []
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o600)
        except OSError as error:
            raise OutputError(f"{path}: cannot be written ({error.strerror})") from None
        try:
            locked(self._file)
        except BlockingIOError:
            os.close(self._file)
            raise OutputError(
                f"{path}: another server is writing this session; end it, or take another {argument.subject}"
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self._file)

    def begin(self, dataset: ShownDataset) -> None:
        """Read the rows, and write the header of a new file."""
        self._dataset, self._columns = dataset, columns(dataset.level, dataset.group_by)
        self.rows = list(read_rows(self.path, dataset))
        self._size = self.path.read_bytes().rfind(b"\n") + 1
        if self._size == 0:
            self._append(csv_text([self._columns]).encode())

    def append(self, row: TrialRow) -> None:
        """Write a row to the disk. When this returns, the row is there; if it raises, the file is as before."""
        values = values_of_row(row, self._dataset)
        self._append(csv_text([[values[name] for name in self._columns]]).encode())
        self.rows.append(row)

    def _append(self, line: bytes) -> None:
        """Write a line behind the whole ones; what was torn is cut off."""
        try:
            os.ftruncate(self._file, self._size)
            os.lseek(self._file, self._size, os.SEEK_SET)
            left = line
            while left:  # a disk that is filled up takes a part, and fails at the next
                left = left[os.write(self._file, left) :]
            os.fsync(self._file)
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._file, self._size)
            raise OutputError(f"{self.path}: cannot be written ({error.strerror})") from None
        self._size += len(line)


def values_of_row(row: TrialRow, dataset: ShownDataset) -> dict[str, object]:
    """Return the values of a row by the columns of the data file."""
    return {
        **dict(zip(dataset.group_by, row.group, strict=True)),
        dataset.level: row.level,
        "trial": row.number,
        "phase": row.phase,
        "frame": row.frame,
        "sha256": row.sha256,
        "orientation": row.orientation.value,
        "response": NO_RESPONSE if row.response is None else row.response.value,
        "correct": int(row.is_correct),
        "response_time_ms": round(row.response_time_ms, 3),
        "flag": row.flag or "",
        "size_mrad": row.size_mrad,
        "dither_seed": row.dither_seed,
        "clipped_px": row.clipped_px,
        "shown_at": row.shown_at,
    }


def count_file(folder: Path, subject: str) -> Path:
    """Return the file of the counts of a subject, for `todframes fit`."""
    return folder / "counts" / f"subject-{subject}_counts.csv"


def write_counts(path: Path, record: SessionRecord, rows: Sequence[TrialRow]) -> None:
    """Write how often a person was right at each level of each group, for `todframes fit`. Trials of the main
    phase count that have a response and no flag, or any flag if the record includes them. If the visual angle of a
    pixel differed from that of the dataset's display by more than `SAME_PITCH`, `size_mrad` is the size at the
    eye. Raises OutputError if it cannot be written.
    """
    level, group_by = record.dataset.level, record.dataset.group_by
    ratio = 1.0 if record.monitor is None else record.monitor.pixel_pitch_mrad / record.dataset.pixel_pitch_mrad
    by_level: dict[tuple[Group, float], list[bool]] = {}
    for row in counted_rows(rows, include_flagged=record.include_flagged):
        by_level.setdefault((row.group, row.level), []).append(row.is_correct)
    lines: list[list[object]] = [[*COUNT_COLUMNS, *group_by]]
    for (group, x), answers in sorted(by_level.items(), key=lambda item: (_order(item[0][0]), item[0][1])):
        of_group = [at_eye(name, value, ratio) for name, value in zip(group_by, group, strict=True)]
        lines.append([at_eye(level, x, ratio), sum(answers), len(answers), *of_group])
    write_file(path, csv_text(lines).encode(), is_private=True)


def at_eye(name: str, value: float | str, ratio: float) -> float | str:
    """Return a value of a column as it is at the eye: `size_mrad` grows with the ratio of the pixels' pitches."""
    if name != "size_mrad" or isinstance(value, str) or abs(ratio - 1.0) <= SAME_PITCH:
        return value
    return float(f"{value * ratio:.6g}")


def _order(group: Group) -> tuple[tuple[bool, float, str], ...]:
    """Return a key that orders numbers before texts."""
    return tuple((True, 0.0, value) if isinstance(value, str) else (False, value, "") for value in group)


def check_subject(subject: str) -> None:
    """Raise SettingsError if a text is not the anonymous id of a person."""
    if not re.fullmatch("[A-Za-z0-9]{1,64}", subject):
        raise SettingsError(
            f"{argument.subject}: found {subject!r}, expected letters and digits, at most 64, and no name"
        )


def make_folders(folder: Path, shown: ShownDataset, software: Mapping[str, str]) -> None:
    """Make a folder of answers, which only its owner can read, with its description, JSON-LD with the terms of
    schema.org. Columns named by the dataset that have no description here are the level or one of the groups.
    """
    try:
        for made in (folder, folder / "data", folder / "counts"):
            made.mkdir(PRIVATE, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror})") from None
    others = {
        shown.level: ("Stimulus strength: the level of the dataset that was shown", None),
        **dict.fromkeys(shown.group_by, ("Group of the dataset that was shown: a curve each", None)),
    }
    variables = []
    for name in columns(shown.level, shown.group_by):
        text, unit = DESCRIPTIONS.get(name) or others[name]
        variables.append(
            {"@type": "PropertyValue", "name": name, "description": text} | ({"unitText": unit} if unit else {})
        )
    description: Json = {
        "@context": "https://schema.org/",
        "@type": "Dataset",
        "name": "Answers of people in a Triangle Orientation Discrimination test",
        "description": (
            "Trials of people who said where triangles point, a file a session. The file of the same name that "
            "ends in .json has the calibration of the monitor, the text of consent and the settings. People have "
            "anonymous ids."
        ),
        "schemaVersion": "Psych-DS 1.5.0",
        "variableMeasured": variables,
        "measurementTechnique": (
            "Four-alternative forced choice (Hogervorst, Bijl & Valeton 2001) on a calibrated monitor, with "
            + ", ".join(f"{name} {version}" for name, version in software.items())
        ),
    }
    content = msgspec.json.format(msgspec.json.encode(description), indent=2)
    write_file(folder / DESCRIPTION_FILE, content + b"\n", is_private=True)
