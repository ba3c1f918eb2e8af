"""What users write, as values: text files, TOML tables to frozen dataclasses, fields of CSV files."""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import msgspec

from todframes.errors import DataError, SettingsError

T = TypeVar("T")


def read_text(path: Path) -> str:
    """Content of a UTF-8 text file, with or without a byte-order mark.

    Raises
    ------
    DataError
        If it cannot be read or is not UTF-8.
    """
    try:
        return path.read_bytes().decode("utf-8-sig")
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 (byte {error.start})") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None


def read_toml(path: Path) -> dict[str, Any]:
    """Content of a TOML file.

    Raises
    ------
    DataError
        If it cannot be read.
    SettingsError
        If it is not TOML.
    """
    try:
        return tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{path}: not valid TOML: {error}") from None


def check_keys(found: Iterable[str], known: Iterable[str], where: str) -> None:
    """Refuse unknown keys.

    Raises
    ------
    SettingsError
        For the first key that is not known, naming the nearest that is.
    """
    known = list(known)
    for key in found:
        if key not in known:
            nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
            hint = f"; the nearest valid one is {nearest[0]!r}" if nearest else ""
            raise SettingsError(f"{where}: unknown key {key!r}{hint}")


def from_table(table: Mapping[str, Any], kind: type[T], where: str) -> T:
    """A frozen dataclass from a table of plain values.

    Parameters
    ----------
    table : mapping
        Values by field name.
    kind : type
        A dataclass that checks its own values.
    where : str
        File and table, or option; every message begins with it.

    Raises
    ------
    SettingsError
        If a key is unknown or missing, or a value is of the wrong type or refused by the dataclass.
    """
    all_fields = fields(kind)  # type: ignore[arg-type]
    check_keys(table, [field.name for field in all_fields], where)
    types = get_type_hints(kind)
    values = {}
    for field in all_fields:
        if field.name in table:
            values[field.name] = _convert(table[field.name], types[field.name], f"{where}: {field.name}")
        elif field.default is MISSING and field.default_factory is MISSING:
            raise SettingsError(f"{where}: {field.name} is missing")
    try:
        return kind(**values)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from None


def _convert(value: object, kind: Any, where: str) -> object:
    if not isinstance(value, bool | int | float | str | list | dict):
        return value  # made by the caller
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        problem = str(error).split(" - at ")[0].replace("`", "")
        raise SettingsError(f"{where}: found {value!r} ({problem[0].lower()}{problem[1:]})") from None


def number(text: str, where: str, *, positive: bool = False) -> float:
    """A finite number from a field of a CSV file.

    Raises
    ------
    DataError
        If it is not one, or not above zero where it must be; `where` names file, line and column.
    """
    text = text.strip()
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (positive and value <= 0):
        raise DataError(f"{where}: found {text!r}, expected a finite number{' > 0' if positive else ''}")
    return value


def number_or_text(text: str) -> float | str:
    """A group's value: a number if it reads as a finite one."""
    try:
        value = float(text)
    except ValueError:
        return text.strip()
    return value if math.isfinite(value) else text.strip()
