"""Algorithms by their names: registered ones, which are listed, functions of a module, networks in files."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from todframes.base.errors import SettingsError
from todframes.base.reading import Positive, WarmUpFrames, check_keys, checked, convert
from todframes.base.user_code import import_named, in_words, registered
from todframes.enhancement.algorithm import Enhancement, values_of
from todframes.results.data import Record
from todframes.results.tables import Column, Table

NETWORK = "onnx"
"""Name before that of a file that holds a neural network."""

ENTRY_POINT_GROUP = "todframes.enhancements"
"""Entry-point group in which packages register algorithms."""


@checked
def find_enhancement(spec: str | Callable[..., Any]) -> Enhancement:
    """Return the algorithm with a given name, or one that calls a given function.

    Parameters
    ----------
    spec : str or function
        Either a text: the name of an entry point of the group `todframes.enhancements`, `module:function`, or
        `onnx:FILE`; each may be followed by `:parameter=value,…`. `module:function` runs the module, which may lie
        in the current folder; `onnx:FILE` reads and tries the neural network of a file. Or a function of an image
        and keyword parameters, or a `functools.partial` of one; its parameters have their default values.

    Returns
    -------
    Enhancement

    Raises
    ------
    SettingsError
        If the name is unknown, the module cannot be imported, or a parameter is unknown, missing or out of range.
    DataError
        If the file of a network cannot be used.

    Examples
    --------
    >>> import todframes as tod
    >>> tod.find_enhancement("gaussian:sigma=1.5").values
    {'sigma': 1.5}
    """
    if isinstance(spec, str):
        head, _, rest = spec.partition(":")
        if head == NETWORK:
            return _network(rest, spec)
        function_name, _, assignments = ("", "", rest) if "=" in rest.partition(":")[0] else rest.partition(":")
        name, text, where = f"{head}:{function_name}" if function_name else head, spec, f"enhance {spec!r}"
        function = import_named(head, function_name, where) if function_name else _registered(head, where)
    else:
        function, named, assignments = spec, getattr(spec, "func", spec), ""
        name = text = f"{named.__module__}:{getattr(named, '__qualname__', type(named).__name__)}"
        where = f"enhance {name!r}"
    if not callable(function):
        raise SettingsError(f"{where}: found {type(function).__name__}, expected a function of an image")
    try:
        signature = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):
        raise SettingsError(
            f"{where}: its parameters cannot be read; expected a function written in Python"
        ) from None
    if not signature or signature[0].kind is signature[0].KEYWORD_ONLY:
        raise SettingsError(f"{where}: takes no image; expected function(image, **parameters)")
    algorithm = Enhancement(name, text, function)
    algorithm = replace(algorithm, values=values_of(algorithm, assignments, where))
    for declared, kind in (("magnification", Positive), ("warm_up_frames", WarmUpFrames)):
        named = getattr(algorithm.declaration, declared)
        if isinstance(named, str):
            convert(algorithm.values.get(named), kind, f"{where}: {declared} {named!r}")
    return algorithm


def enhancement_names() -> list[str]:
    """Return the names of the registered algorithms; those of this package come first."""
    found = registered(ENTRY_POINT_GROUP)
    return sorted(found, key=lambda name: (not found[name].value.startswith("todframes."), name))


def _registered(name: str, where: str) -> Any:
    found = registered(ENTRY_POINT_GROUP)
    if name not in found:
        check_keys([name], found, f"{where}: expected a registered name or module:function")
    try:
        return found[name].load()
    except (Exception, SystemExit) as error:
        raise SettingsError(f"{where}: {found[name].value} cannot be loaded ({in_words(error)})") from None


def _network(rest: str, spec: str) -> Enhancement:
    """Return the algorithm of the neural network in a file: `FILE` or `FILE:parameter=value,…`."""
    from todframes.enhancement.network import read_network, settings_beside, tried

    before, _, after = rest.rpartition(":")
    file, assignments = (before, after) if before and "=" in after else (rest, "")
    path, where = Path(file), f"enhance {spec!r}"
    if not file:
        raise SettingsError(f"{where}: expected {NETWORK}:FILE, with the file of a network")
    if before and file == rest and not path.exists() and Path(before).exists():
        raise SettingsError(f"{where}: found {after or 'nothing'} behind {before}:, expected parameter=value")
    network = read_network(path)
    found = Enhancement(path.name, spec, network.enhanced)
    beside = settings_beside(path, {parameter.name: parameter.kind for parameter in found.parameters})
    network, values = tried(network, values_of(found, assignments, where, beside), path, where)
    return replace(found, function=network.enhanced, values=values)


def plain_value(value: object) -> object:
    """Return a parameter's value as a JSON value, or as a text if JSON has no such value."""
    if isinstance(value, Mapping):
        return {str(name): plain_value(part) for name, part in value.items()}
    return value if value is None or isinstance(value, bool | int | float | str) else repr(value)


def enhancement_record(algorithm: Enhancement) -> Record:
    """Return the description of a registered algorithm, as `todframes enhancements --json` prints it."""
    return {
        "name": algorithm.name,
        "what": algorithm.what,
        "domain": algorithm.declaration.domain,
        "changes_pitch": algorithm.declaration.magnification != 1.0,
        "clip": algorithm.declaration.clip,
        "library": algorithm.declaration.library,
        "parameters": [
            {
                "name": parameter.name,
                "default": plain_value(parameter.default),
                "unit": (parameter.meta.extra or {}).get("unit") or None,
                "range": None if parameter.meta.ge is None else [parameter.meta.ge, parameter.meta.le],
                "choices": list(parameter.choices) or None,
                "what": parameter.meta.description or None,
            }
            for parameter in algorithm.parameters
        ],
    }


def enhancements_table(listed: Sequence[Record]) -> Table:
    """Make the table of registered algorithms, with a row for each parameter below its algorithm."""
    records: list[Record] = []
    for each in listed:
        takes = (
            each["domain"].replace("_", " ") + "s" * (each["domain"] == "code_value") + ", clips" * each["clip"]
        )
        records.append({"name": each["name"], "what": each["what"], "takes": takes, "from": each["library"]})
        for parameter in each["parameters"]:
            default, ends = parameter["default"], parameter["range"] or ()
            shown = f"{default:g}" if isinstance(default, float) else str(default)
            span = ", ".join(map(str, parameter["choices"] or ())) or " – ".join(f"{end:g}" for end in ends)
            records.append(
                {
                    "name": f"  {parameter['name']}",
                    "what": parameter["what"],
                    "default": " ".join(filter(None, (shown, parameter["unit"]))),
                    "range": span,
                }
            )
    columns = [
        Column(key="name"),
        Column(key="what", header="what it does; what a parameter is", none="", wraps=True),
        Column(key="default", none=""),
        Column(key="range", none="", wraps=True, rank=1),
        Column(key="takes", none="", rank=2),
        Column(key="from", none="", rank=3),
    ]
    return Table.of("Enhancement algorithms", "enhancements.csv", columns, records)
