"""Pages of the commands and of the keys of results, written before the site is built."""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Collection, Iterable, Mapping, Sequence
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from typing import Any

import click
import msgspec
from numpydoc.docscrape import NumpyDocString

import sensor_sim
import todframes
from sensor_sim.cli import COMMANDS as SENSOR_SIM
from sensor_sim.cli import cli as sensor_sim_cli
from todframes.cli.main import COMMANDS as TODFRAMES
from todframes.cli.main import cli as todframes_cli
from todframes.cli.runner import Commands
from todframes.results.result import RESULT_TYPES, Result

REFERENCE = Path(__file__).parent / "reference"
FOLDER = "commands"
PROGRAMS: dict[str, Commands] = {"todframes": todframes_cli, "sensor-sim": sensor_sim_cli}  # type: ignore[dict-item]
TABLES = {"todframes": TODFRAMES, "sensor-sim": SENSOR_SIM}
PACKAGES = {"todframes": todframes, "sensor-sim": sensor_sim}
RESULTS = {"sensor-sim mtf": ("sensor-mtf",), "todframes noise": ("noise", "emva")}
"""Names of the results of a command, where they are not its own."""

JSON_TYPES = {str: "text", bool: "true or false", int: "whole number", float: "number", bytes: "text", Any: "any"}

RECORD = msgspec.Struct

SCORER = """// Search shows pages that do one thing first, and lists of options, keys and functions last.
var Scorer = {
  score: ([page, , , , score]) =>
    /^(how_to|tutorials)/.test(page) ? 3 * score : /^reference/.test(page) ? score / 4 : score,
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
"""


def pages() -> dict[str, str]:
    """Return the text of each page by its path in `docs/reference`: commands, their list, and the keys."""
    made: dict[str, str] = {}
    for program, group in PROGRAMS.items():
        rows = []
        for name, command in commands_of(group).items():
            made[f"{FOLDER}/{program}-{name}.md"] = command_page(program, name, command)
            summary, _, _ = (command.help or "").partition("\n\n")
            rows.append(f"| [`{program} {name}`]({FOLDER}/{program}-{name}.md) | {in_markdown(summary)} |")
        made[f"{FOLDER}/{program}.inc"] = "\n".join(["| command | |", "|---|---|", *rows, ""])
    return made | {f"{FOLDER}/keys.inc": keys_page(), f"{FOLDER}/scorer.js": SCORER}


def commands_of(group: Commands) -> dict[str, click.Command]:
    """Return the commands of a program by name."""
    context = click.Context(group)
    found = ((name, group.get_command(context, name)) for name in group.list_commands(context))
    return {name: command for name, command in found if command is not None}


def command_page(program: str, name: str, command: click.Command) -> str:
    """Return the page of a command: sentences, options, keys of its JSON, and where it is used."""
    context = click.Context(command, info_name=f"{program} {name}", help_option_names=["-h", "--help"])
    usage = " ".join(command.collect_usage_pieces(context))
    lines = [f"# {program} {name}", "", f"```text\n{program} {name} {usage}\n```", ""]
    lines += [in_markdown(command.help or "", ".."), ""]
    if users := pages_that_use(f"{program} {name}"):
        lines += [f"Examples: {', '.join(f'[](../../{page})' for page in users)}.", ""]
    lines += ["## Options", ""]
    for parameter in command.params:
        record = parameter.get_help_record(context)
        if record is not None and isinstance(parameter, click.Option):
            lines += [f"`{record[0]}`", f": {in_markdown(record[1], '..')}", ""]
    results = [one for one in RESULTS.get(f"{program} {name}", (name,)) if one in RESULT_TYPES]
    has_json = any(parameter.name == "json" for parameter in command.params)
    lines += ["## See also", ""]
    if results and has_json:
        keys = " and ".join(f"[{one}](../json.md#{_anchor(RESULT_TYPES[one].result_type)})" for one in results)
        lines.append(f"- Keys of the JSON: {keys}")
    for call in calls_of(program, name):
        lines.append(f"- In Python: {{py:func}}`{call}`")
    lines.append("- Common to all commands: [where results go, exit status, limits](../commands.md)")
    return "\n".join([*lines, ""])


def calls_of(program: str, name: str) -> list[str]:
    """Return the public names of the calls that a command is made of."""
    command = TABLES[program].get(name)
    calls = () if command is None else (command.call, command.also)
    package = PACKAGES[program]
    functions = [one.partition(":")[2] for one in calls if one]
    return [f"{package.__name__}.{one}" for one in functions if one in package.__all__]


def pages_that_use(words: str) -> list[str]:
    """Return the pages of `docs` whose examples have a command."""
    start = re.compile(rf"^{re.escape(words)} ", re.MULTILINE)
    found = []
    for file in sorted(REFERENCE.parent.glob("[!_]*/*.md")):
        blocks = re.findall(r"^```(?:sh|console)[^\n]*\n(.*?)^```$", file.read_text("utf-8"), re.M | re.S)
        if any(start.search(block) for block in blocks):
            found.append(file.relative_to(REFERENCE.parent).as_posix())
    return found


def in_markdown(text: str, up: str = ".") -> str:
    """Return a text of `--help` as Markdown: options and commands as code, pages as links."""
    text = re.sub(r"\bdocs/(\w+/\w+\.md)", lambda page: f"[]({up}/../{page[1]})", text)
    parts = re.split(r"(`[^`]*`|\[\]\([^)]*\))", " ".join(text.split(" ")))
    for index in range(0, len(parts), 2):
        part = re.sub(r"(?<!\w)(--?[a-z][\w-]*)", r"`\1`", parts[index])
        parts[index] = part.replace("*", r"\*").replace("|", r"\|")
    return "".join(_linked(part, up) for part in parts)


def _linked(part: str, up: str) -> str:
    """Return the name of a command in backticks with a link to its page."""
    found = re.fullmatch(r"`(todframes|sensor-sim) ([a-z-]+)`", part)
    return f"[{part}]({up}/{FOLDER}/{found[1]}-{found[2]}.md)" if found else part


def keys_page() -> str:
    """Return the keys of all results: common ones, those of each kind, and those of the records in them."""
    commands: dict[type[Result], list[str]] = {}
    for name, kind in RESULT_TYPES.items():
        commands.setdefault(kind.result_type, []).append(f"`{name}`")
    lines = ["## Every result", "", *_table(Result)]
    records: dict[type[RECORD], None] = dict.fromkeys(_records(Result))
    for kind, names in commands.items():
        keys = _table(kind, Result.__struct_fields__)
        lines += [f"## {kind.__name__}", "", f"The result of {', '.join(names)}.", "", *keys]
        records |= dict.fromkeys(_records(kind))
    lines += ["## Records", ""]
    for record in sorted(records, key=lambda one: one.__name__):
        lines += [f"### {record.__name__}", "", *_sentences(record), "", *_table(record)]
    return "\n".join([*lines, ""])


def _table(record: type[RECORD], known: Collection[str] = ()) -> list[str]:
    described = descriptions(record)
    rows = []
    for field in msgspec.structs.fields(record):
        if field.name in known:
            continue
        key = field.encode_name
        rows.append(f"| `{key}` | {kind_in_words(field.type)} | {described.get(field.name, '')} |")
    return ["| key | kind | |", "|---|---|---|", *rows, ""]


def _sentences(record: type[RECORD]) -> list[str]:
    """Return the docstring of a record above its list of attributes."""
    text = NumpyDocString(_docstring(record))
    lines = [" ".join(text["Summary"]), "", *(line.strip() for line in text["Extended Summary"])]
    return [line.replace("None", "null") for line in lines]


def descriptions(record: type[RECORD]) -> dict[str, str]:
    """Return what the docstrings of a record and of its bases say of each attribute."""
    found: dict[str, str] = {}
    for base in reversed(record.__mro__):
        if base is not RECORD and issubclass(base, RECORD) and base.__doc__:
            for names, _, lines in NumpyDocString(_docstring(base))["Attributes"]:
                text = re.sub(r"\bNone\b", "null", " ".join(lines)).replace("|", r"\|").replace("*", r"\*")
                found |= dict.fromkeys(names.split(", "), text)
    return found


def _docstring(record: type[RECORD]) -> str:
    return cleandoc(record.__doc__ or "")


def _records(record: type[RECORD]) -> list[type[RECORD]]:
    """Return the records in a record, and in these."""
    found: dict[type[RECORD], None] = {}
    waiting = [record]
    while waiting:
        for field in msgspec.structs.fields(waiting.pop()):
            new = [one for one in _structs(field.type) if one not in found]
            found |= dict.fromkeys(new)
            waiting += new
    return list(found)


def _structs(kind: Any) -> Iterable[type[RECORD]]:
    if isinstance(kind, type) and issubclass(kind, RECORD):
        yield kind
    for one in typing.get_args(kind):
        yield from _structs(one)


def kind_in_words(kind: Any) -> str:
    """Return the type of a value in JSON, with links to records."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        return kind_in_words(inner[0])
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys("null" if one is type(None) else kind_in_words(one) for one in inner))
    if origin is typing.Literal:
        return ", ".join(f"`{one}`" for one in inner)
    if (origin is tuple and inner[-1:] == (Ellipsis,)) or (isinstance(origin, type) and issubclass(origin, list)):
        return f"list of {kind_in_words(inner[0])}"
    if origin is tuple:
        return f"[{', '.join(map(kind_in_words, inner))}]"
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return f"object of {kind_in_words(inner[1])}"
    if isinstance(origin, type) and issubclass(origin, Sequence):
        return f"list of {kind_in_words(inner[0])}"
    if isinstance(kind, type) and issubclass(kind, RECORD):
        return f"[{kind.__name__}](#{_anchor(kind)})"
    return JSON_TYPES.get(kind, "object")


def _anchor(record: type[RECORD]) -> str:
    return record.__name__.lower()


def write(*_: object) -> None:
    """Write the pages that have changed, and remove those of commands that are gone."""
    (REFERENCE / FOLDER).mkdir(exist_ok=True)
    made = pages()
    for old in (REFERENCE / FOLDER).iterdir():
        if f"{FOLDER}/{old.name}" not in made:
            old.unlink()
    for name, text in made.items():
        file = REFERENCE / name
        if not file.is_file() or file.read_text("utf-8") != text:
            file.write_text(text, encoding="utf-8")
    # Sphinx keeps the pages of public names that are gone, and then warns of them.
    for page in (REFERENCE / "generated").glob("*.rst"):
        package, _, name = page.stem.partition(".")
        if name and name not in import_module(package).__all__:
            page.unlink()


def setup(app: Any) -> None:
    """Let Sphinx write the pages before it looks for files."""
    app.connect("config-inited", write)
