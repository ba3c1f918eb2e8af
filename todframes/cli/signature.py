"""Calls as their sources describe them: signature, kinds of values, and the sentences of the docstring.

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
from importlib.util import find_spec
from inspect import Parameter, cleandoc, signature
from itertools import takewhile
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from todframes import parameters
from todframes.parameters import CliFormat

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
