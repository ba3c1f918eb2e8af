"""Repeating a result from what its call was given."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from inspect import signature
from typing import Any

import msgspec

from todframes.base.errors import DataError
from todframes.parameters import ResultFile
from todframes.results.result import KINDS, NOT_WRITTEN, Result, load_result

OF_TIME = {"settings", "run_time_s", "saves_s", "cpu_s", "cpu_ms_per_frame", "memory_mb", "from_store", "examples"}
"""Keys that differ from run to run, or that are not computed again."""


def rerun(result: Result[Any] | ResultFile) -> dict[str, tuple[Any, Any]]:
    """Repeat the call of a result with all that it was given, and compare the numbers.

    Paths are those that the call was given: run it in the same folder. What a result names is not trusted: code of
    your own and networks are not run, and URLs are not opened.

    Parameters
    ----------
    result : Result or path
        A result, or its folder.

    Returns
    -------
    dict
        Values before and now by their key in JSON, where they are not the same; empty if all numbers are.

    Raises
    ------
    DataError
        If an input is gone, was in memory or behind a URL, an algorithm or observer is no registered one, or the
        result is of an earlier version.

    Examples
    --------
    >>> import todframes as tod
    >>> tod.rerun(tod.naked_eye(size_mrad=1.0))
    {}
    """
    before = result if isinstance(result, Result) else load_result(result)
    if not before.call:
        raise DataError(f"{before.command}: the result does not hold what its call was given; run it again")
    module, _, name = KINDS[before.command].call.partition(":")
    call = getattr(import_module(module), name)
    known = signature(call).parameters
    given = {key: _read(key, value) for key, value in before.call.items() if key in known}
    if "examples" in known:
        given["examples"] = False
    old, new = (dict(_leaves(msgspec.to_builtins(result.data))) for result in (before, call(**given)))
    keys = [key for key in old | new if old.get(key) != new.get(key)]
    return {key: (old.get(key), new.get(key)) for key in keys}


def _read(name: str, value: Any) -> Any:
    """Return the value of a parameter that `_written` has written."""
    if isinstance(value, str) and value.startswith(NOT_WRITTEN):
        raise DataError(f"{name}: was {value.removeprefix(NOT_WRITTEN)}, which a result does not hold; call again")
    if isinstance(value, str) and "://" in value:
        raise DataError(f"{name}: {value} is a URL, which is not opened for a result; call again")
    if name in ("observer", "relative_to"):
        return [_observer(item) for item in value] if isinstance(value, list) else _observer(value)
    if name == "enhance":
        from todframes.base.user_code import registered

        for algorithm in [value] if isinstance(value, str) else value:
            if algorithm.partition(":")[0] not in registered("todframes.enhancements"):
                raise DataError(
                    f"{name}: {algorithm} is code of your own or a network, which a result does not run"
                )
    if name == "fit" and value is not None:
        from todframes.psychometrics.fit import FitSettings

        return FitSettings(**value)
    if name == "patches" and value is not None:
        return {tuple(box): level for box, level in value}
    if isinstance(value, list):
        return tuple(_read(f"{name}[{number}]", item) for number, item in enumerate(value))
    return value


def _observer(value: Any) -> Any:
    """Return an observer by the name or the settings that a result has."""
    name, settings = (value, None) if isinstance(value, str) else (value["observer"], value)
    if any(":" in part for part in name.split(",")):
        raise DataError(
            f"observer: {name} is code of your own or a network, which a result does not run; call again"
        )
    if settings is None:
        return name
    from todframes.observers.interface import find_observer

    kind: Any = find_observer(name)
    return kind(kind.settings_type(**{key: setting for key, setting in settings.items() if key != "observer"}))


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield each number and text of a result with its key in JSON, but for what differs from run to run."""
    if isinstance(value, Mapping | list | tuple):
        items = value.items() if isinstance(value, Mapping) else ((f"[{n}]", item) for n, item in enumerate(value))
        for name, item in items:
            if name not in OF_TIME:
                yield from _leaves(
                    item, f"{key}{name}" if str(name).startswith("[") else f"{key}.{name}".strip(".")
                )
    else:
        yield key, value
