"""Enhancement algorithms as users name them: registered ones, own functions, and values of their parameters."""

from __future__ import annotations

import importlib
import inspect
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_type_hints

from todframes.enhancement import DECLARATION, Declaration, Enhancement, Parameter
from todframes.errors import SettingsError
from todframes.settings import check_keys, convert, toml_value

ENTRY_POINT_GROUP = "todframes.enhancements"


def find_enhancement(spec: str) -> Enhancement:
    """An algorithm as users name it.

    Parameters
    ----------
    spec : str
        `name`, that of an entry point of the group `todframes.enhancements`, or `module:function`; either may be
        followed by `:parameter=value,…`.

    Raises
    ------
    SettingsError
        If there is none of this name or it cannot be imported, or a parameter is unknown, missing or out of range.
    """
    head, _, rest = spec.partition(":")
    function_name, _, assignments = ("", "", rest) if "=" in rest.partition(":")[0] else rest.partition(":")
    where = f"enhance {spec!r}"
    function = _imported(head, function_name, where) if function_name else _registered(head, where)
    found = _described(f"{head}:{function_name}" if function_name else head, spec, function, where)
    return replace(found, values=_values(found, assignments, where))


def enhancement_names() -> list[str]:
    """Names of the registered algorithms, those of this package first."""
    from importlib.metadata import entry_points

    found = {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP)}
    return sorted(found, key=lambda name: (not found[name].value.startswith("todframes."), name))


def _registered(name: str, where: str) -> Callable[..., Any]:
    from importlib.metadata import entry_points

    found = {entry.name: entry for entry in entry_points(group=ENTRY_POINT_GROUP)}
    if name not in found:
        check_keys([name], found, f"{where}: expected a registered name or module:function")
    try:
        return _function(found[name].load(), where)
    except (Exception, SystemExit) as error:
        raise SettingsError(f"{where}: {found[name].value} cannot be loaded ({_reason(error)})") from None


def _imported(module: str, function: str, where: str) -> Callable[..., Any]:
    try:
        found: Any = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # whatever a user's module does when it is imported
        raise SettingsError(f"{where}: module {module!r} cannot be imported ({_reason(error)})") from None
    if not hasattr(found, function):
        names = [name for name, value in vars(found).items() if inspect.isfunction(value)]
        check_keys([function], names, f"{where}: {module}")
    return _function(getattr(found, function), where)


def _reason(error: BaseException) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _function(found: Any, where: str) -> Callable[..., Any]:
    if not callable(found):
        raise SettingsError(f"{where}: found {type(found).__name__}, expected a function of an image")
    return found  # type: ignore[no-any-return]


def _described(name: str, spec: str, function: Callable[..., Any], where: str) -> Enhancement:
    """An algorithm without values yet, from its function's signature."""
    try:
        signature = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        raise SettingsError(
            f"{where}: its parameters cannot be read; expected a function written in Python"
        ) from None
    if not signature or signature[0].kind is signature[0].KEYWORD_ONLY:
        raise SettingsError(f"{where}: takes no image; expected function(image, **parameters)")
    try:
        kinds = get_type_hints(function, include_extras=True)
    except Exception:  # names that exist for type checkers only
        kinds = {}
    named = [one for one in signature[1:] if one.kind in (one.KEYWORD_ONLY, one.POSITIONAL_OR_KEYWORD)]
    return Enhancement(
        name=name,
        spec=spec,
        function=function,
        declaration=getattr(function, DECLARATION, Declaration()),
        parameters=tuple(
            Parameter(one.name, kinds.get(one.name, _kind_of(one.default)), one.default) for one in named
        ),
        any_parameter=any(one.kind is one.VAR_KEYWORD for one in signature),
    )


def _kind_of(default: object) -> Any:
    """The type of a parameter that has no annotation."""
    if isinstance(default, bool | str):
        return type(default)
    return float if isinstance(default, int | float) else Any


def _values(algorithm: Enhancement, assignments: str, where: str) -> dict[str, Any]:
    """All parameters: the values assigned, `name=value` with commas between them, and the others' defaults."""
    known = {one.name: one for one in algorithm.parameters}
    assigned: dict[str, Any] = {}
    for assignment in filter(None, assignments.split(",")):
        name, equals, text = (part.strip() for part in assignment.partition("="))
        if not equals or not name or not text:
            raise SettingsError(f"{where}: found {assignment!r}, expected parameter=value")
        if name in assigned:
            raise SettingsError(f"{where}: found {name} twice, expected it once")
        if not algorithm.any_parameter:
            check_keys([name], known, where)
        try:
            value = toml_value(text)
        except ValueError:
            raise SettingsError(f"{where}: found {assignment!r}, expected parameter=value") from None
        assigned[name] = convert(value, known[name].kind, f"{where}: {name}") if name in known else value
    for name, one in known.items():
        if one.default is inspect.Parameter.empty and name not in assigned:
            raise SettingsError(f"{where}: parameter {name!r} is missing")
    values = {name: one.default for name, one in known.items()} | assigned
    magnification = algorithm.declaration.magnification
    if isinstance(magnification, str):
        found = values.get(magnification)
        if not (isinstance(found, int | float) and 0 < found < math.inf):
            raise SettingsError(
                f"{where}: magnification {magnification!r}: found {found!r}, expected a number > 0"
            )
    return values
