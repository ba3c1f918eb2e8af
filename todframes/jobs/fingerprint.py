"""Fingerprints of values and of code: bytes that stand for all that a finished result depends on."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import sys
from collections.abc import Iterator, Mapping
from enum import Enum
from functools import cache
from pathlib import Path
from types import FunctionType, MethodType
from typing import Any

import numpy as np

PACKAGES = ("numpy", "scipy", "opencv-contrib-python-headless", "OpenImageIO", "scikit-image")
"""Packages whose versions may change the last digits of a result."""


def fingerprint(*values: object) -> bytes:
    """Return a hash, 32 bytes, of values and of all that they hold, and of the code of this package. Classes and
    functions count by name and by their code, see `code_fingerprint`, which raises TypeError if that is in no
    file.
    """
    digest = hashlib.sha256(code_fingerprint(__name__))
    for part in _parts(values):
        digest.update(part)
    return digest.digest()


def _parts(value: object) -> Iterator[bytes]:
    """Yield a value as bytes, each part with its kind and length, so that no two values give the same."""
    match value:
        case None | bool() | int() | str() | bytes() | Path():
            text = value if isinstance(value, bytes) else str(value).encode(errors="surrogatepass")
            yield f"{type(value).__name__} {len(text)} ".encode() + text
        case float():
            yield b"float " + value.hex().encode()
        case Enum():
            yield from _parts((type(value).__name__, value.value))
        case np.ndarray():
            yield f"array {value.dtype.str} {value.shape} ".encode() + np.ascontiguousarray(value).tobytes()
        case np.generic():
            yield from _parts(value.item())
        case type() | FunctionType():
            yield f"code {value.__module__}:{value.__qualname__} ".encode() + code_fingerprint(value.__module__)
        case MethodType():
            yield from _parts((value.__func__, value.__self__))
        case Mapping():
            yield f"mapping {len(value)} ".encode()
            for key in sorted(value, key=repr):
                yield from _parts(key)
                yield from _parts(value[key])
        case tuple() | list() | set() | frozenset():
            items = sorted(value, key=repr) if isinstance(value, set | frozenset) else value
            yield f"sequence {len(items)} ".encode()
            for item in items:
                yield from _parts(item)
        case _:
            yield from _parts(type(value))
            yield from _parts(_attributes(value))


def _attributes(value: Any) -> dict[str, object]:
    """Return the attributes of an object; for an observer its settings, which determine everything else."""
    if dataclasses.is_dataclass(value):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    settings = getattr(value, "settings", None)
    return {"settings": settings} if dataclasses.is_dataclass(settings) else vars(value)


@cache
def code_fingerprint(module: str) -> bytes:
    """Return a hash of a module's code: of all Python files of its package, or of its file if it is in none;
    TypeError if it is in no file. For this package the versions of the libraries count too. Modules that a module
    imports from other packages do not count.
    """
    top = module.partition(".")[0]
    digest = hashlib.sha256()
    file = getattr(sys.modules.get(top), "__file__", None)
    if file is None or not Path(file).is_file():
        raise TypeError(f"the code of {module} is in no file")
    files = sorted(Path(file).parent.rglob("*.py")) if Path(file).name == "__init__.py" else [Path(file)]
    if top == __name__.partition(".")[0]:
        digest.update(repr([(name, importlib.metadata.version(name)) for name in PACKAGES]).encode())
    for path in files:
        digest.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.digest()
