"""Calls as their sources describe them, options that several commands share, and the settings that these give.

Of a source only the head of the call is compiled, and nothing is imported: importing a call loads NumPy, and
`--help` has no use for it.
"""

from __future__ import annotations

import ast
import builtins
import os
import re
from collections.abc import Mapping, Sequence
from functools import cache
from glob import glob
from importlib.util import find_spec
from inspect import Parameter, cleandoc, signature
from itertools import takewhile
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

import click

from todframes import parameters
from todframes.base.errors import SettingsError
from todframes.parameters import CliFormat

if TYPE_CHECKING:
    from todframes.observers.interface import Observer
    from todframes.psychometrics.fit import FitSettings


REQUIRED = Parameter.empty
"""Default of a parameter that has none."""


class Value(NamedTuple):
    """Value of a parameter as a command line writes it. It is a bool, int, float, str or Path (`kind`); several of
    these in one text (`is_list`, perhaps of fixed length) or in repeated options; or a mapping with keys of the
    kind `key`.
    """

    kind: type
    form: CliFormat = CliFormat()
    choices: tuple[Any, ...] = ()
    is_list: bool = False
    is_repeated: bool = False
    length: int | None = None
    key: Value | None = None


class Argument(NamedTuple):
    """An argument of a call. `default_text` has the default in words, if its value is None. `*name` is starred."""

    name: str
    annotation: Any
    default: Any
    text: str
    default_text: str
    where: str
    is_starred: bool = False

    @property
    def value(self) -> Value:
        """Return how a command line writes the value; TypeError if its kind is only one of Python, or its default
        cannot be read.
        """
        value = _value(self.annotation)
        if isinstance(self.default, type) and issubclass(self.default, _OfPython):
            raise TypeError(f"{self.where}: expected a literal, or a constant of the same module, as the default")
        if value is None:
            raise TypeError(f"{self.where}: a command line has no form for {self.annotation}")
        return value._replace(is_repeated=True) if self.is_starred else value


class Call(NamedTuple):
    """Description of a call: the paragraphs above its parameters, and these by name."""

    paragraphs: tuple[str, ...]
    parameters: dict[str, Argument]


class _OfPython:
    """Any kind of value that a command line cannot write."""

    def __class_getitem__(cls, item: object) -> type:
        return cls


class _Names(dict[str, Any]):
    """Names in a signature: those of Python and of `parameters`, and constants of the source; others are only of
    Python.
    """

    def __init__(self, source: str) -> None:
        self.source = source

    def __missing__(self, name: str) -> Any:
        if hasattr(builtins, name):
            raise KeyError(name)
        if hasattr(parameters, name):
            return getattr(parameters, name)
        if name.isupper() and (found := re.search(rf"^{name} = ([-\d(\"'].*)$", self.source, re.MULTILINE)):
            return ast.literal_eval(found[1])
        return type(name, (_OfPython,), {})


@cache
def read_call(call: str) -> Call:
    """Return the description of a call, "module:function"."""
    module, _, name = call.partition(":")
    names = _Names(_source(module))
    # To compile whole modules would take longer than everything else that `--help` does.
    head = re.search(rf'^def {name}\(.*?\n    """.*?"""', names.source, re.DOTALL | re.MULTILINE)
    exec(compile("" if head is None else head[0], call, "exec", dont_inherit=True), {}, names)
    function = names[name]
    lines = cleandoc(function.__doc__ or "").splitlines()
    texts = _texts(lines)
    described = {}
    for parameter in signature(function).parameters.values():
        is_starred = parameter.kind is parameter.VAR_POSITIONAL
        text, _, default_text = texts.get("*" * is_starred + parameter.name, "").partition(" Default: ")
        described[parameter.name] = Argument(
            name=parameter.name,
            annotation=parameter.annotation,
            default=parameter.default,
            text=text,
            default_text=default_text.removesuffix("."),
            where=f"{call}: {parameter.name}",
            is_starred=is_starred,
        )
    above = "\n".join(takewhile(lambda line: line != "Parameters", lines))
    return Call(
        tuple(" ".join(paragraph.split()) for paragraph in above.split("\n\n") if paragraph.strip()), described
    )


@cache
def _source(module: str) -> str:
    loader: Any = getattr(find_spec(module), "loader", None)
    source: str = loader.get_source(module)
    return source


def _texts(lines: Sequence[str]) -> dict[str, str]:
    """Return the first paragraph of each parameter in a numpydoc docstring; further ones are for Python alone."""
    if "Parameters" not in lines:
        return {}
    section = lines[lines.index("Parameters") + 2 :]
    end = next((number for number, line in enumerate(section) if re.fullmatch("-{3,}", line)), len(section) + 1)
    texts: dict[str, str] = {}
    names: list[str] = []
    is_first = True
    for line in section[: end - 1]:
        if line and not line.startswith(" "):
            names, is_first = line.partition(" : ")[0].split(", "), True
            texts |= dict.fromkeys(names, "")
        elif not line:
            is_first = is_first and not (names and texts[names[0]])
        elif is_first:
            texts |= {name: f"{texts[name]} {line.strip()}".strip() for name in names}
    return texts


def _value(kind: Any) -> Value | None:
    """Return how a command line writes a kind of value: the first of a union's that it can write, None if none."""
    if get_origin(kind) in (Union, UnionType):
        values = [value for value in map(_value, get_args(kind)) if value is not None]
        return min(values, key=_order, default=None)
    if get_origin(kind) is Annotated:
        base, form = get_args(kind)
        inner = _value(base)
        is_list = inner is not None and (inner.is_list or bool(form.separator))
        return inner and inner._replace(form=form, is_list=is_list, is_repeated=inner.is_repeated and not is_list)
    if get_origin(kind) is Literal:
        return Value(type(get_args(kind)[0]), choices=get_args(kind))
    if get_origin(kind) is Sequence:
        inner = _value(get_args(kind)[0])
        return inner and inner._replace(is_repeated=True)
    if get_origin(kind) is tuple:
        inner = _value(get_args(kind)[0])
        return inner and inner._replace(is_list=True, length=len(get_args(kind)))
    if get_origin(kind) is Mapping:
        key, inner = map(_value, get_args(kind))
        return inner and inner._replace(is_repeated=True, key=key)
    if kind is Path or get_origin(kind) is os.PathLike:
        return Value(Path)
    return Value(kind) if kind in (bool, int, float, str) else None


def _order(value: Value) -> int:
    """Return the rank of a value in a union: forms, choices, sequences, paths, and other texts and numbers."""
    ranks = (
        value.form != CliFormat(),
        bool(value.choices),
        value.is_repeated,
        value.kind is Path,
        value.kind is not bool,
    )
    return ranks.index(True) if True in ranks else len(ranks)


LOCATE = ("group", "each")
"""Values of `--locate`; without a value it has the first."""

SUMMARY_FILE, SUMMARY_PAGE = "summary.csv", "summary.html"
"""Table and page of a batch, beside the folders of all."""


def expanded(_: click.Context, __: click.Parameter, paths: tuple[str, ...]) -> tuple[str, ...]:
    """Return paths, with the matches in place of a pattern that a shell has left as it is, and without the summary
    of a batch, which a pattern of its folders matches, too.
    """
    found: list[str] = []
    for path in paths:
        matches = [] if Path(path).exists() else glob(path)  # noqa: PTH207
        if matches:
            from todframes.recordings.recording import natural_order

            matches = list(map(str, natural_order(map(Path, matches))))
        found += matches or [path]
    others = [path for path in found if Path(path).name not in (SUMMARY_FILE, SUMMARY_PAGE)]
    return tuple(others or found)


def parts(text: str, option: str, value: Value) -> Sequence[Any]:
    """Return the values in a text with separators between them; SettingsError if a part is not of the kind, or
    there is another number of them.
    """
    kind, form = value.kind, value.form
    try:
        values = [kind(part) for part in text.split(form.separator)]
    except ValueError:
        values = []
    if not values or value.length not in (None, len(values)):
        noun = "whole numbers" if kind is int else "numbers"
        how = "with commas between them" if value.length is None else f"as {form.metavar}"
        raise SettingsError(f"{option}: found {text!r}, expected {noun} {how}")
    return tuple(values) if value.length else values


class Assigned(click.ParamType):  # type: ignore[type-arg]  # click 8.2 takes none
    """Type of an option KEY=VALUE, which gives a pair."""

    def __init__(self, value: Value) -> None:
        self.name, self.value = value.form.metavar, value

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ARG002
        """Return the key and the value in the text."""
        assert param is not None and self.value.key is not None
        name, (key, equals, text) = param.opts[0], value.partition("=")
        try:
            if not (key.strip() and equals):
                raise ValueError
            of_list = self.value.key.is_list
            return parts(key, name, self.value.key) if of_list else key.strip(), self.value.kind(text.strip())
        except ValueError:
            raise SettingsError(f"{name}: found {value!r}, expected {self.name}") from None


class Separated(click.ParamType):  # type: ignore[type-arg]  # click 8.2 takes none
    """Type of an option that holds several values in one text."""

    def __init__(self, value: Value) -> None:
        self.name, self.value = value.form.metavar, value

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:  # noqa: ARG002
        """Return the values in the text."""
        assert param is not None
        return parts(value, param.opts[0], self.value)


P_CORRECT = click.Option(
    ["--p-correct", "p_correct"],
    type=float,
    metavar="P",
    help="Raw proportion correct at threshold.  [default: 0.75]",
)

SETTINGS = click.Option(
    ["--set", "assignments"],
    multiple=True,
    metavar="NAME=VALUE",
    help="Any setting by name, such as kernel_a=0.4; repeatable. All are in docs/explanation/model.md and "
    "docs/explanation/observers.md.",
)

OBSERVER_OPTIONS = (
    click.Option(
        ["--internal-noise", "internal_noise"],
        type=float,
        metavar="N",
        help="Full width of each neuron's noise.  [default: 0.5]",
    ),
    P_CORRECT,
    SETTINGS,
    click.Option(
        ["--observer-settings", "observer_settings"],
        type=click.Path(),
        metavar="FILE|NAME",
        help="TOML file with settings, or a name of this package: modelfest is an eye for --observer pyramid.",
    ),
)
"""Options of each command with an observer, beside those of its call."""


class LocatingCommand(click.Command):
    """A command whose option `--locate` may be given without a value, also before the dataset."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse arguments after `--locate` was given its default value where it has none."""
        options = args[: args.index("--")] if "--" in args else args
        bare = {
            k
            for k, option in enumerate(options)
            if option == "--locate" and not set(args[k + 1 : k + 2]) & {*LOCATE}
        }
        given = [f"--locate={LOCATE[0]}" if k in bare else option for k, option in enumerate(args)]
        return super().parse_args(ctx, given)


def make_observers(
    asked: dict[str, Any], *, fitted: bool = True, several: bool = True
) -> tuple[list[Observer], FitSettings]:
    """Return the observers and the fit settings of `OBSERVER_OPTIONS`, which are removed from `asked`. A separate
    option takes precedence over `--set`, and `--set` over the file; with several observers, a setting goes to each
    that has it. If not `fitted`, the criterion is the only setting of the fit.
    """
    from dataclasses import fields

    from todframes.base.reading import check_keys, from_table, read_toml
    from todframes.cli.console import prints_go_to_stderr
    from todframes.observers.interface import observer_named, observers_with, setting_names, settings_file
    from todframes.psychometrics.fit import FitSettings

    names, path = asked.pop("observer"), asked.pop("observer_settings", None)
    names = names.split(",") if isinstance(names, str) else names
    if len(names) > 1 and not several:
        raise SettingsError(f"observer: found {','.join(names)!r}, expected a single one here")
    of_file = {} if path is None else read_toml(settings_file(path))
    table = of_file | _set(asked, "internal_noise", "p_correct")
    with prints_go_to_stderr():
        defaults = [observer_named(name) for name in names]
    of_observers = [setting_names(default.settings_type) for default in defaults]
    of_fit = [field.name for field in fields(FitSettings) if fitted or field.name == "p_correct"]
    known = list(dict.fromkeys([*sum(of_observers, []), *of_fit]))  # noqa: RUF017 - they are few

    def made(table: dict[str, Any], where: str) -> tuple[list[Observer], FitSettings]:
        if {"internal_noise", "internal_noise_sd"} <= table.keys():
            raise SettingsError(f"{where}: found internal_noise and internal_noise_sd, expected one of them")
        for key in table:
            if key not in known and (others := observers_with(key)):
                is_noise = key == "internal_noise" and "efficiency" in known
                instead = "; its noise follows from its efficiency" if is_noise else ""
                raise SettingsError(
                    f"{where}: {key} is a setting of {', '.join(others)}; {', '.join(names)} has none{instead}"
                )
        check_keys(table, known, where)
        observers = []
        for default, setting in zip(defaults, of_observers, strict=True):
            given = {k: v for k, v in table.items() if k in setting}
            read = from_table(given, default.settings_type, where)
            observers.append(type(default)(default.settings, **{k: getattr(read, k) for k in given}))
        return observers, from_table({k: v for k, v in table.items() if k in of_fit}, FitSettings, where)

    try:
        return made(table, "settings")
    except SettingsError:
        if path is not None:
            made(of_file, str(path))  # its own mistakes have its name
        raise


def make_fit(asked: dict[str, Any]) -> FitSettings:
    """Return the fit settings of `--p-correct` and `--set`, which are removed from `asked`."""
    from todframes.base.reading import from_table
    from todframes.psychometrics.fit import FitSettings

    return from_table(_set(asked, "p_correct"), FitSettings, "settings")


def _set(asked: dict[str, Any], *names: str) -> dict[str, Any]:
    """Return the values of `--set` and of separate options by name; separate options take precedence."""
    table = assigned(asked.pop("assignments", ()))
    return table | {name: value for name in names if (value := asked.pop(name, None)) is not None}


def assigned(assignments: Sequence[str]) -> dict[str, Any]:
    """Return the values of `--set NAME=VALUE` by name: TOML values, or texts if they are not TOML. SettingsError
    if an assignment has no name or no equals sign.
    """
    from todframes.base.reading import toml_value

    table: dict[str, Any] = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        if not equals or not name.strip():
            raise SettingsError(f"--set: found {assignment!r}, expected NAME=VALUE")
        try:
            value = toml_value(text)
        except ValueError:
            raise SettingsError(f"--set: found {assignment!r}, expected one NAME=VALUE") from None
        if isinstance(value, str) and text.lstrip().startswith("[") and text.count("[") == 1:
            raise SettingsError(f"--set: found {assignment!r}, expected a list as TOML has it: NAME=[0.5, 0.25]")
        table[name.strip()] = value
    return table
