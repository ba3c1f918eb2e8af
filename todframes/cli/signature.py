"""Calls as their sources describe them: signature, kinds of values, and the sentences of the docstring.

A source is parsed, not imported: importing a call loads NumPy, and `--help` has no use for it.
"""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.util import find_spec
from inspect import cleandoc
from itertools import takewhile
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from todframes import parameters
from todframes.parameters import CliFormat

REQUIRED = object()
"""Default of a parameter that has none."""

UNREAD = object()
"""Default that is neither a literal nor a constant of a module that is read."""

KINDS: dict[str, Any] = {"int": int, "float": float, "str": str, "bool": bool, "None": None, "tuple": tuple}
KINDS |= {"Any": Any, "Callable": Callable, "Literal": Literal, "Mapping": Mapping, "Path": Path}
KINDS |= {"Sequence": Sequence}
"""Kinds of values by their names in annotations, beside those of `parameters`."""


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
    """An argument of a call. `default_text` has the default in words, if its value is None."""

    name: str
    annotation: str
    default: Any
    text: str
    default_text: str
    where: str

    @property
    def value(self) -> Value:
        """Return how a command line writes the value; TypeError if its kind is only one of Python, or its default
        cannot be read.
        """
        value = _value(eval(compile(self.annotation, self.where, "eval"), {}, _Kinds()))
        if self.default is UNREAD:
            raise TypeError(f"{self.where}: expected a literal, or a constant of the same module, as the default")
        if value is None:
            raise TypeError(f"{self.where}: a command line has no form for {self.annotation}")
        return value


class Call(NamedTuple):
    """Description of a call: the paragraphs above its parameters, and these by name."""

    paragraphs: tuple[str, ...]
    parameters: dict[str, Argument]


class _OfPython:
    """Any kind of value that a command line cannot write."""

    def __class_getitem__(cls, item: object) -> type:
        return cls


class _Kinds(dict[str, Any]):
    """Kinds of values by their names in annotations; others are only of Python."""

    def __missing__(self, name: str) -> Any:
        return KINDS[name] if name in KINDS else getattr(parameters, name, _OfPython)


@cache
def read_call(call: str) -> Call:
    """Return the description of a call, "module:function"."""
    module, _, name = call.partition(":")
    source = _source(module)
    # To parse whole modules would take longer than everything else that `--help` does.
    head = re.search(rf'^def {name}\(.*?\n    """.*?"""', source, re.DOTALL | re.MULTILINE)
    (node,) = ast.parse("" if head is None else head[0]).body
    assert isinstance(node, ast.FunctionDef)
    lines = cleandoc(ast.get_docstring(node, clean=False) or "").splitlines()
    texts = _texts(lines)
    arguments = [*node.args.posonlyargs, *node.args.args]
    defaults: list[ast.expr | None] = [None] * (len(arguments) - len(node.args.defaults))
    with_defaults = [*zip(arguments, [*defaults, *node.args.defaults], strict=True)]
    with_defaults += zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
    described = {}
    for argument, default in with_defaults:
        text, _, default_text = texts.get(argument.arg, "").partition(" Default: ")
        described[argument.arg] = Argument(
            name=argument.arg,
            annotation=ast.unparse(argument.annotation or ast.Constant(None)),
            default=REQUIRED if default is None else _constant(default, source),
            text=text,
            default_text=default_text.removesuffix("."),
            where=f"{call}: {argument.arg}",
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


def _constant(node: ast.expr, source: str) -> Any:
    """Return the value of a default: a literal, or a constant of its module or of `parameters`."""
    if not isinstance(node, ast.Name):
        return ast.literal_eval(node)
    constant = re.search(rf"^{node.id} = ([-\d(\"'].*)$", source, re.MULTILINE)
    return getattr(parameters, node.id, UNREAD) if constant is None else ast.literal_eval(constant[1])


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
