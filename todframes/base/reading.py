"""Readers of the files that users write: text, TOML tables as frozen dataclasses, fields of CSV files."""

from __future__ import annotations

import csv
import difflib
import inspect
import io
import math
import os
import re
import stat
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Collection, Generator, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache, wraps
from numbers import Integral, Real
from operator import ge, gt, le, lt
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    BinaryIO,
    Literal,
    NamedTuple,
    ParamSpec,
    TypeGuard,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec

from todframes.base.errors import DataError, SettingsError, argument

T = TypeVar("T")
P = ParamSpec("P")

MAX_TOML_MB, MAX_CSV_MB = 1, 256
"""Largest sizes of TOML and CSV files that are read, in units of 2**20 bytes."""
MAX_ROWS = 100_000
"""Largest number of rows of a CSV file that is not a manifest."""
MAX_NESTING, MAX_DOTS = 16, 500
COLUMNS_SHOWN = 20
LONGEST_SHOWN = 100
"""Number of characters of a key or a value that messages show. Unknown keys are compared with valid ones by them
alone: the time grows with their square."""
MOST_WARM_UP = 10_000
"""Largest number of frames before a trial that are written, or that an algorithm takes: it holds them together."""
MOST_TRIALS = 1_000_000
"""Largest number of trials of a dataset that a command makes; all are planned in memory."""
LATEST_S = 1e12
"""Largest time in seconds, before or after 0, of a frame: 30,000 years."""

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
WarmUpFrames = Annotated[int, msgspec.Meta(ge=0, le=MOST_WARM_UP)]

WORDS = {bool: "true or false", str: "text", Path: "a path", os.PathLike: "a path", Callable: "a function"}
"""Types in messages."""

SETTINGS_SUFFIX = ".toml"
"""End of the names of files of settings; any other text is the name of a file of the package."""


def read_file(path: Path, *, most_mb: int) -> bytes:
    """Return the bytes of a file. Pipes and devices are refused: reading them may never end. DataError if it
    cannot be read, or is longer than `most_mb` · 2**20 bytes.
    """
    with _opened(path, most_mb) as file:
        content = file.read(most_mb * 2**20 + 1)
        _check_length(path, len(content), most_mb)
    return content


def _check_length(path: Path, n_bytes: int, most_mb: int) -> None:
    if n_bytes > most_mb * 2**20:
        raise DataError(f"{path}: is longer than {most_mb} MB, the limit for such files")


@contextmanager
def _opened(path: Path, most_mb: int) -> Iterator[BinaryIO]:
    """Open a file for reading; see `read_file` for the errors."""
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise DataError(f"{path}: is a folder, expected a file")
        if not stat.S_ISREG(status.st_mode):
            raise DataError(
                f"{path}: is a pipe or device, expected a file; save what comes from it to a file first"
            )
        _check_length(path, status.st_size, most_mb)
        with path.open("rb") as file:
            yield file
    except DataError:
        raise
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:  # a NUL in the name
        raise DataError(f"{str(path)!r}: cannot be read ({error})") from None


def path_inside(folder: str, name: str, where: str, real_folders: dict[str, str] | None = None) -> str:
    """Return the full path of a file that a file of the user names, with symbolic links resolved. DataError if it
    is not in `folder`, a real path: an error message might show its content. `real_folders` caches resolved
    folders: without it a million rows would take a minute.
    """
    if not name or "\0" in name:
        raise DataError(f"{where}: found {name!r}, expected a path")
    real_folders = {} if real_folders is None else real_folders
    parent, last = os.path.split(name)  # pathlib is slow
    if parent not in real_folders:
        # Path.resolve would raise for a link that leads to itself.
        real_folders[parent] = os.path.realpath(os.path.join(folder, parent))  # noqa: PTH118
    full = os.path.join(real_folders[parent], last)  # noqa: PTH118
    if last in ("", os.curdir, os.pardir) or os.path.islink(full):  # noqa: PTH114
        full = os.path.realpath(full)
    if not f"{full}{os.sep}".startswith(folder.rstrip(os.sep) + os.sep):
        raise DataError(
            f"{where} {name} lies outside of the dataset: it is {full}, expected a file in {folder}; copy it there"
        )
    return full


def read_text(path: Path, *, most_mb: int) -> str:
    """Return the text of a UTF-8 file, with or without a byte-order mark; DataError if it is not UTF-8."""
    try:
        return read_file(path, most_mb=most_mb).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 (byte {error.start})") from None


def _lines(path: Path, *, most_mb: int) -> Generator[str, None, None]:
    """Yield the lines of a UTF-8 file with their ends; the errors are those of `read_text`, some in the middle."""
    with _opened(path, most_mb) as file, io.TextIOWrapper(file, encoding="utf-8-sig", newline="") as text:
        try:
            yield from text
        except UnicodeDecodeError as error:
            byte = file.tell() - len(error.object) + error.start
            raise DataError(f"{path}: not UTF-8 (byte {byte})") from None


def read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a TOML file; SettingsError if it cannot be read or is not TOML."""
    try:
        text = read_text(path, most_mb=MAX_TOML_MB)
    except DataError as error:
        raise SettingsError(str(error)) from None
    return parse_toml(text, str(path))


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Return the content of a TOML text; SettingsError that begins with `where` if it is not TOML."""
    try:
        return _parsed_toml(text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{where}: not valid TOML: {error}") from None


def without_schema(content: Mapping[str, Any], schema: int, known: Iterable[str], where: str) -> dict[str, Any]:
    """Return the content of a file of settings without its key `schema`; SettingsError if it has another schema or
    a key that is not known.
    """
    check_keys(content, ["schema", *known], where)
    convert(content.get("schema"), Literal[schema], f"{where}: schema")
    return {key: value for key, value in content.items() if key != "schema"}


def toml_text(content: Mapping[str, Any], *, comment: str = "") -> str:
    """Return a file of settings as TOML: comment, values, tables; a number keeps all its digits. A value of None
    is left out. A list of tables above all tables is one table each; in a table it has a line for each. All other
    lists and tables are on one line.
    """
    lines = [f"# {line}" for line in comment.splitlines()]
    lines += _assignments({name: value for name, value in content.items() if not _is_tables(value)})
    for name, value in content.items():
        if _is_tables(value):
            header = f"[{name}]" if isinstance(value, Mapping) else f"[[{name}]]"
            for table in [value] if isinstance(value, Mapping) else value:
                lines += [*([""] if lines else []), header, *_assignments(table)]
    return "\n".join([*lines, ""])


def toml_literal(value: object) -> str:
    """Return a value as it is written in TOML, on one line."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            import json

            # A JSON string is a TOML string but for DEL, which TOML wants escaped.
            return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
        case Mapping():
            return "{" + ", ".join(_assignments(value)) + "}"
        case list() | tuple():
            return f"[{', '.join(map(toml_literal, value))}]"
    return repr(value)


def _assignments(table: Mapping[str, Any]) -> list[str]:
    lines: list[str] = []
    for name, value in table.items():
        if isinstance(value, list) and _is_tables(value):
            lines += [f"{name} = [", *(f"  {toml_literal(part)}," for part in value), "]"]
        elif value is not None:
            lines.append(f"{name} = {toml_literal(value)}")
    return lines


def _is_tables(value: object) -> bool:
    """Return whether a value is a table or a list of tables."""
    parts = value if isinstance(value, list) and value else [value]
    return all(isinstance(part, Mapping) for part in parts)


def toml_value(text: str) -> Any:
    """Return the TOML value that a text stands for, or the text itself if it is not TOML. Raises ValueError if the
    text is more than one value.
    """
    try:
        parsed = _parsed_toml(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text.strip()
    if list(parsed) != ["value"]:
        raise ValueError(text)
    return parsed["value"]


def _parsed_toml(text: str) -> dict[str, Any]:
    """Return the content of a TOML text. TOMLDecodeError also for integers beyond 64 bits and too deep nesting:
    without these checks Python would raise other errors, here or when a value is printed.
    """
    # The time for a key grows with the square of the number of its parts.
    for number_of_line, line in enumerate(text.split("\n"), 1):
        if line.count(".") > MAX_DOTS:
            raise tomllib.TOMLDecodeError(f"line {number_of_line} has more than {MAX_DOTS} dots")
    try:
        content = tomllib.loads(text)
    except RecursionError:
        raise tomllib.TOMLDecodeError("nested too deep") from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:
        raise tomllib.TOMLDecodeError("a whole number of too many digits") from None
    _check_toml(content, "")
    return content


def _check_toml(value: object, name: str, depth: int = 0) -> None:
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise tomllib.TOMLDecodeError(f"{name[1:]}: found a whole number of more than 64 bits")
    if isinstance(value, dict | list):
        if depth > MAX_NESTING:
            raise tomllib.TOMLDecodeError(f"nested more than {MAX_NESTING} deep")
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            _check_toml(inner, f"{name}.{key}", depth + 1)


def check_positive(name: str, value: float) -> None:
    """Raise SettingsError unless a value is a finite number above 0."""
    convert(value, Positive, name)


def check_time(where: str, time_s: float) -> float:
    """Return a time in seconds; raise DataError if it is so large that differences of times may overflow."""
    if not abs(time_s) <= LATEST_S:
        raise DataError(f"{where}: found {time_s:g} s, expected a time from {-LATEST_S:g} to {LATEST_S:g} s")
    return time_s


def check_whole(name: str, value: Any, least: int, most: int) -> None:
    """Raise SettingsError unless a value is a whole number in a range."""
    convert(value, Annotated[int, msgspec.Meta(ge=least, le=most)], name)


def distinct_numbers(name: str, values: Iterable[float]) -> list[float]:
    """Return values as numbers; raise SettingsError unless there are some, finite and above 0, and each once."""
    numbers: list[float] = [convert(item, Positive, name) for item in values]
    if not numbers:
        raise SettingsError(f"{name}: found no values, expected at least one")
    if len(set(numbers)) < len(numbers):
        shown = ", ".join(f"{number:g}" for number in numbers)
        raise SettingsError(f"{name}: found a value twice in {shown}, expected each once")
    return numbers


def check_keys(keys: Iterable[str], known: Iterable[str], where: str) -> None:
    """Raise SettingsError, which names the nearest known key, if a key is not known."""
    if problem := _unknown_key(keys, known):
        raise SettingsError(f"{where}: {problem}")


def _unknown_key(keys: Iterable[str], known: Iterable[str]) -> str:
    """Return the message about the first unknown key; "" if all are known."""
    known = {key.lower(): key for key in known}
    for key in keys:
        if key not in known.values():
            text = str(key)[:LONGEST_SHOWN].lower()
            # A name with letters behind it is nearer than one with as many of the letters.
            likeness = {name: difflib.SequenceMatcher(None, name, text).ratio() for name in known}
            nearest = max(known, key=lambda name: likeness[name] + 0.05 * text.startswith(name), default="")
            hint = f"; the nearest valid one is {known[nearest]!r}" if nearest else ""
            return f"unknown key {_shortened(str(key))!r}{hint}"
    return ""


def _shortened(text: str) -> str:
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]}…"


# Settings -----------------------------------------------------------------------------------------------------
#
# A dataclass states its settings by annotations: types, `Literal`, `msgspec.Meta` for ranges and lengths. Values
# from files, options and Python pass the same check, which returns them in the annotated type: whole numbers for
# `float` as floats, lists as tuples, tables as dataclasses.


class _RefusedError(Exception):
    """A value that its annotation refuses: why, and the keys that lead to it, such as `pages[2].file`."""

    def __init__(self, problem: str, keys: str = "") -> None:
        super().__init__(f"{keys.removeprefix('.')}: {problem}" if keys else problem)
        self.problem, self.keys = problem, keys


def check_values(settings: Any) -> None:
    """Check the values of a settings dataclass by its annotations; its `__post_init__` calls this. SettingsError
    if a field is of another type or out of its range.
    """
    kind: Any = type(settings)
    try:
        for field, hint in settings_of(kind):
            value = getattr(settings, field.name)
            if value is not field.default:
                checked = _inside(field.name, value, hint)
                if checked is not value:
                    object.__setattr__(settings, field.name, checked)
    except _RefusedError as error:
        raise SettingsError(str(error)) from None


def from_table(table: Mapping[str, Any], kind: type[T], where: str) -> T:
    """Return a dataclass made from a table of plain values by field name, as are tables in it. SettingsError,
    which begins with `where`, if a key is unknown or missing, or a value is refused.
    """
    try:
        made: T = _checked(table, kind)
    except _RefusedError as error:
        raise SettingsError(f"{where}: {error}") from None
    return made


def convert(value: object, kind: Any, where: str) -> Any:
    """Return a plain value in an annotated type: `float`, a Literal, `Annotated` with a range, …. SettingsError,
    which begins with `where`, if it is of another type or out of range.
    """
    try:
        return _checked(value, kind)
    except _RefusedError as error:
        raise SettingsError(f"{where}{error.keys}: {error.problem}") from None


def checked(call: Callable[P, T]) -> Callable[P, T]:
    """Decorate a call: its arguments are checked by its annotations, of which the options are made, too.
    SettingsError if one is of another type, none of the choices or out of range.
    """
    parameters = inspect.signature(call).parameters.values()
    names = [parameter.name for parameter in parameters]
    starred = next((one.name for one in parameters if one.kind is one.VAR_POSITIONAL), None)
    hints = cache(lambda: get_type_hints(call, include_extras=True))  # at the first call: imports stay quick

    def check(name: str, value: Any) -> Any:
        hint = hints().get(name, Any)
        takes_tables = any((get_origin(kind) or kind) in (Any, Mapping) for kind in kinds_of(hint))
        try:
            if isinstance(value, Mapping) and not takes_tables:
                raise _RefusedError("")
            return _checked(value, hint)
        except _RefusedError as error:
            problem = error.problem if error.keys else _refusal(value, hint, is_of_call=True)
            raise SettingsError(f"{getattr(argument, name)}{error.keys}: {problem}") from None

    @wraps(call)
    def called(*args: P.args, **kwargs: P.kwargs) -> T:
        if starred:  # before all other parameters
            positional = [check(starred, value) for value in args]
        else:
            positional = [*map(check, names, args), *args[len(names) :]]
        return call(*positional, **{name: check(name, value) for name, value in kwargs.items()})

    return called


@cache
def settings_of(kind: Any) -> list[tuple[Field[Any], Any]]:
    """Return the fields of a settings dataclass with their annotations."""
    hints = get_type_hints(kind, include_extras=True)
    return [(field, hints[field.name]) for field in fields(kind)]


def descriptions(settings: type) -> dict[str, str]:
    """Return what the annotations of some settings say about them, by name."""
    return {
        field.name: next(part.description for part in get_args(hint)[1:] if part.description)
        for field, hint in settings_of(settings)
    }


def documented(settings: type[T]) -> type[T]:
    """Decorate settings: their docstring lists them with the descriptions in their annotations."""
    attributes = [f"    {name}\n        {text}" for name, text in descriptions(settings).items()]
    heading = "    Attributes\n    ----------"
    settings.__doc__ = "\n".join([(settings.__doc__ or "").rstrip() + "\n", heading, *attributes, "    "])
    return settings


def _split(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return the type of an annotation and the parts in its brackets."""
    return get_origin(hint) or hint, get_args(hint)


def kinds_of(hint: Any) -> tuple[Any, ...]:
    """Return the types, and the values of a Literal, that an annotation names."""
    kind, parts = _split(hint)
    if kind is Annotated:
        return kinds_of(parts[0])
    if kind is Union or kind is UnionType:
        return tuple(kind for part in parts for kind in kinds_of(part))
    return parts if kind is Literal else (hint,)


def _choices(hint: Any) -> tuple[Any, ...]:
    """Return the values of a Literal or an enumeration; empty for other types."""
    if get_origin(hint) is Literal:
        return get_args(hint)
    return tuple(hint) if isinstance(hint, type) and issubclass(hint, Enum) else ()


def _checked(value: Any, hint: Any, limits: msgspec.Meta | None = None) -> Any:
    """Return a value in the type of an annotation; `limits` are those of the annotation around it."""
    kind, parts = _split(hint)
    if kind is Annotated:
        return _checked(value, parts[0], next((part for part in parts[1:] if hasattr(part, "ge")), limits))
    if kind is Union or kind is UnionType:
        return _of_any(value, hint)
    if kind is float or kind is int:
        numbers = Real if kind is float else Integral
        is_number = type(value) is kind or (isinstance(value, numbers) and not isinstance(value, bool))
        if is_number and _is_within(value, limits):
            return value if type(value) is kind else kind(value)
    elif kind is bool and str(getattr(value, "dtype", "")) == "bool" and value.ndim == 0:
        return bool(value)  # NumPy's
    elif choices := _choices(hint):
        for choice in choices:
            is_choice = isinstance(value, Hashable) and value == choice  # arrays compare value by value
            if is_choice and isinstance(value, bool) == isinstance(choice, bool):
                return choice
    elif kind is Any or not isinstance(kind, type) or kind.__module__.startswith("numpy._typing"):
        return value  # NumPy converts what is like an array
    elif parts and issubclass(kind, Mapping):
        if isinstance(value, Mapping):
            return {
                _inside(f".{key}", key, parts[0]): _inside(f".{key}", item, parts[1])
                for key, item in value.items()
            }
    elif parts and issubclass(kind, Sequence):
        least, most = _lengths(hint, limits)
        if _is_list(value) and least <= len(value) <= most:
            kinds = parts if least == most == len(parts) else (*parts[:1], Any)[:1] * len(value)
            items = enumerate(zip(value, kinds, strict=True))
            make = list if issubclass(kind, list) else tuple
            return make(_inside(f"[{number}]", item, of_one) for number, (item, of_one) in items)
    elif isinstance(value, kind):
        return value
    elif is_dataclass(kind) and isinstance(value, Mapping):
        return _made(value, kind)
    raise _RefusedError(_refusal(value, hint, limits))


def _is_list(value: object) -> TypeGuard[Collection[Any]]:
    """Return whether a value holds others in an order, as a list or an array does."""
    return (
        isinstance(value, Collection)
        and not isinstance(value, str | bytes | Mapping)
        and getattr(value, "ndim", 1) > 0
    )


def _refusal(value: object, hint: Any, limits: Any = None, *, is_of_call: bool = False) -> str:
    words = _words(hint, limits, is_of_call=is_of_call)
    return f"found {_shortened(repr(value))}, expected {words}{_advice(value, hint)}"


def _of_any(value: Any, hint: Any) -> Any:
    """Return a value in the first type of a union that takes it."""
    problems = []
    for kind in get_args(hint):
        if kind is NoneType:
            if value is None:
                return None
            continue
        try:
            return _checked(value, kind)
        except _RefusedError as error:
            problems.append(error)
    nearest = max(reversed(problems), key=lambda error: len(error.keys))
    if nearest.keys or len(problems) == 1:
        raise nearest
    raise _RefusedError(_refusal(value, hint))


def _inside(key: str, value: Any, hint: Any) -> Any:
    """Return a value of a table or list in the type of an annotation; an error names its key, too."""
    try:
        return _checked(value, hint)
    except _RefusedError as error:
        raise _RefusedError(error.problem, key + error.keys) from None


def _made(table: Mapping[str, Any], kind: Any) -> Any:
    """Return a dataclass made from a table."""
    settings = settings_of(kind)
    if problem := _unknown_key(table, [field.name for field, _ in settings]):
        raise _RefusedError(problem)
    values = {}
    for field, hint in settings:
        if field.name in table:
            values[field.name] = _inside(f".{field.name}", table[field.name], hint)
        elif field.default is MISSING and field.default_factory is MISSING:
            raise _RefusedError(f"{field.name} is missing")
    try:
        return kind(**values)
    except SettingsError as error:
        raise _RefusedError(str(error)) from None


def _is_within(value: float, limits: msgspec.Meta | None) -> bool:
    """Return whether a number is finite and within limits."""
    ends = limits and ((ge, limits.ge), (le, limits.le), (gt, limits.gt), (lt, limits.lt))
    is_inside = all(end is None or compare(value, end) for compare, end in ends or ())
    return abs(value) <= sys.float_info.max and is_inside


def _lengths(hint: Any, limits: msgspec.Meta | None) -> tuple[int, float]:
    """Return the smallest and largest number of values of a list or tuple."""
    parts = get_args(hint)
    if get_origin(hint) is tuple and Ellipsis not in parts:
        return len(parts), len(parts)
    least, most = getattr(limits, "min_length", None), getattr(limits, "max_length", None)
    return least or 0, math.inf if most is None else most


def _words(hint: Any, limits: msgspec.Meta | None, *, is_of_call: bool = False) -> str:
    """Return what an annotation expects, in words; a dataclass is a table in files, an object in calls."""
    kind, parts = _split(hint)
    if kind is Annotated:
        return _words(parts[0], parts[1], is_of_call=is_of_call)
    if kind is Union or kind is UnionType:
        return " or ".join(
            dict.fromkeys(_words(part, limits, is_of_call=is_of_call) for part in parts if part is not NoneType)
        )
    if choices := _choices(hint):
        return "one of " * (len(choices) > 1) + ", ".join(map(str, choices))
    if kind in WORDS:
        return WORDS[kind]
    if kind is float or kind is int:
        is_open = limits is None or limits.le is limits.lt is None
        noun = "a whole number" if kind is int else "a finite number" if is_open else "a number"
        if limits is None:
            return noun
        form = "g" if kind is float else ".0f"
        if limits.ge is not None and limits.le is not None:
            return f"{noun} from {limits.ge:{form}} to {limits.le:{form}}"
        ends = ((">=", limits.ge), (">", limits.gt), ("<=", limits.le), ("<", limits.lt))
        return noun + " and".join(f" {sign} {end:{form}}" for sign, end in ends if end is not None)
    if issubclass(kind, Sequence):
        least, most = _lengths(hint, limits)
        count = f"{least}" if least == most else f"at most {most}" if not least else f"{least} or more"
        return "a list" if (least, most) == (0, math.inf) else f"a list of {count} values"
    is_table = issubclass(kind, Mapping) or (is_dataclass(kind) and not is_of_call)
    return "a table" if is_table else kind.__name__


def _advice(value: Any, hint: Any) -> str:
    """Return what to write in place of a text, after a semicolon; "" if that is not clear."""
    kinds = (hint, *get_args(hint))
    is_number = any(kind in (int, float) for kind in kinds_of(hint))
    if isinstance(value, str) and is_number and isinstance(number_or_text(value), float):
        return f"; write {value} without quotation marks"
    choices = [str(choice) for kind in kinds for choice in _choices(kind)]
    return spelling_hint(value, choices) if isinstance(value, str) else ""


def spelling_hint(text: str, choices: Iterable[str]) -> str:
    """Return "; write srgb" for a text such as sRGB, whose letters and digits are those of a choice; else ""."""

    def letters(word: str) -> str:
        return re.sub("[^a-z0-9]", "", word.lower())

    meant = [choice for choice in choices if letters(choice) == letters(text)]
    return f"; write {meant[0]}" if meant else ""


def shipped_names(folder: Path) -> tuple[str, ...]:
    """Return the names of the files of settings in a folder of the package, in alphabetical order."""
    return tuple(sorted(path.stem for path in folder.glob(f"*{SETTINGS_SUFFIX}")))


def settings_path(name: Path | str, folder: Path, where: str) -> Path:
    """Return the path of a file of settings: the one named, or that of this name in a folder of the package.
    SettingsError, which names all files of the folder, if it has none of this name.
    """
    name = str(name)
    if name.endswith(SETTINGS_SUFFIX):
        return Path(name)
    names = shipped_names(folder)
    if name not in names:
        raise SettingsError(
            f"{where}: found {name!r}, expected the name of a file that ends with {SETTINGS_SUFFIX}, or one of "
            f"{', '.join(names)}{spelling_hint(name, names)}"
        )
    return folder / f"{name}{SETTINGS_SUFFIX}"


def read_described(path: Path, kind: str, schema: int) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the table `kind` of a file of settings, and the texts that describe it: `title` and `source`.
    SettingsError if the file cannot be read, has another schema, an unknown key or no such table.
    """
    content = without_schema(read_toml(path), schema, ["title", "source", kind], str(path))
    texts = {name: convert(content.get(name, ""), str, f"{path}: {name}") for name in ("title", "source")}
    table = content.get(kind)
    if not isinstance(table, dict):
        raise SettingsError(f"{path}: table [{kind}] is missing")
    return table, texts


class TableRow(NamedTuple):
    """A row of a CSV file: its place, file and line, and its texts by column. `problem` is a message if it has
    more or fewer fields than the header, else "".
    """

    where: str
    texts: Mapping[str, str]
    problem: str = ""

    def numbers(self, columns: Iterable[str], *, positive: bool = False) -> list[float]:
        """Return the numbers in some columns; DataError names the column whose text is no finite number, or not
        above 0 if they have to be `positive`."""
        return [number(self.texts[name], f"{self.where}: {name}", positive=positive) for name in columns]


def read_csv(path: Path, *, most_rows: int | None = MAX_ROWS) -> Iterator[TableRow]:
    """Yield the rows of a CSV file as they are read; first a row with all keys and empty values. DataError if the
    file cannot be read or is not CSV, two columns have the same name, or there are more rows than `most_rows`,
    empty lines included.
    """
    lines, name_of_file = _lines(path, most_mb=MAX_CSV_MB), str(path)
    reader = csv.reader(lines, strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        if len(header) == 1 and (other := re.search("[;\t]", header[0])):
            mark = "semicolons" if other[0] == ";" else "tabs"
            raise DataError(
                f"{path}: found {mark} between the columns ({_shortened(header[0])}), expected commas, and points "
                "in numbers; save it again as CSV with commas"
            )
        for name, count in Counter(header).items():
            if count > 1:
                raise DataError(f"{path}: found column {name!r} {count} times, expected once")
        yield TableRow(name_of_file, dict.fromkeys(header, ""))
        for n_rows, fields_found in enumerate(reader, 1):
            if most_rows is not None and n_rows > most_rows:
                raise DataError(f"{path}: found more than {most_rows} rows, expected at most that many")
            if not fields_found:
                continue  # an empty line
            where, problem = f"{name_of_file}, line {reader.line_num}", ""
            if len(fields_found) != len(header):
                problem = f"{where}: found {len(fields_found)} fields, expected {len(header)} as in the header"
            yield TableRow(where, dict(zip(header, fields_found, strict=False)), problem)
    except csv.Error as error:
        raise DataError(f"{path}, line {reader.line_num}: not valid CSV ({error})") from None
    finally:
        lines.close()


def read_table(path: Path, needed: Iterable[str] = ()) -> tuple[tuple[str, ...], Iterator[TableRow]]:
    """Return the columns of a CSV file, and its rows as they are read. DataError if `read_csv` raises it or a
    column is missing; on the way, if a row has more or fewer fields than the header.
    """
    rows = read_csv(path)
    header = next(rows).texts
    check_columns(header, needed, path)

    def checked() -> Iterator[TableRow]:
        for row in rows:
            if row.problem:
                raise DataError(row.problem)
            yield row

    return tuple(header), checked()


def read_numbers(path: Path, columns: Sequence[str]) -> list[list[float]]:
    """Return the numbers in the named columns of a CSV file, row by row; DataError as `read_table` raises it, or
    if a value is not a finite number.
    """
    _, rows = read_table(path, columns)
    return [row.numbers(columns) for row in rows]


@contextmanager
def table_beside(name: object, folder: Path, where: str) -> Iterator[Path]:
    """Yield the path of the CSV file that a file of settings in `folder` names. SettingsError if the name is no
    text, the file lies outside of the folder, or the block raises a DataError.
    """
    if not isinstance(name, str):
        raise SettingsError(f"{where}: found {name!r}, expected the name of a CSV file")
    try:
        path_inside(os.path.realpath(folder), name, where)
        yield folder / name
    except DataError as error:
        raise SettingsError(str(error)) from None


def check_columns(header: Iterable[str], needed: Iterable[str], path: Path) -> None:
    """Raise DataError if a CSV file lacks a column; the message says if it has one with other letters."""
    found = list(header)
    for name in needed:
        if name not in found:
            alike = [other for other in found if other.lower() == name.lower()]
            hint = f"; write {name}, not {alike[0]}" if alike else ""
            shown = ", ".join(map(_shortened, found[:COLUMNS_SHOWN])) or "none"
            more = f" and {len(found) - COLUMNS_SHOWN} more" if len(found) > COLUMNS_SHOWN else ""
            raise DataError(f"{path}: column {name!r} is missing; found {shown}{more}{hint}")


def number(text: str, where: str, *, positive: bool = False) -> float:
    """Return the finite number in a field of a CSV file; DataError if it is none, or not above zero but has to be
    `positive`. `where` names file, line and column.
    """
    text = text.strip()
    value = number_or_text(text)
    if isinstance(value, str) or (positive and value <= 0):
        hint = ", with a point, not a comma" if re.fullmatch(r"[+-]?[0-9]*,[0-9]+", text) else ""
        raise DataError(f"{where}: found {text!r}, expected a finite number{' > 0' if positive else ''}{hint}")
    return value


def number_or_text(text: str) -> float | str:
    """Return a group's value: a number if the text is a finite number, otherwise the text."""
    text = text.strip()
    try:
        value = math.nan if "_" in text else float(text)  # Python reads 1_0 as 10
    except ValueError:
        return text
    return value if math.isfinite(value) else text
