"""Code of others: what installed packages register, and what a user names on the command line as `module:name`.

The latter is the only code that a command runs from the current folder, where a dataset of unknown origin may lie.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import TYPE_CHECKING, Any

from todframes.base.errors import SettingsError
from todframes.base.reading import check_keys

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint, EntryPoints


def registered(group: str) -> Mapping[str, EntryPoint]:
    """Return the entry points of a group of all installed packages by name. They are looked up once for a search
    path: the lookup reads the metadata of every package, in some 6 ms.
    """
    from importlib.metadata import entry_points

    return _found(group, entry_points, tuple(sys.path))


@lru_cache(maxsize=16)
def _found(
    group: str, entry_points: Callable[..., EntryPoints], _search_path: tuple[str, ...]
) -> Mapping[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=group)}


class _LastFinder:
    """Finder of modules in one folder, for the end of `sys.meta_path`. A folder on `sys.path` would also be
    searched for the metadata of packages, which register names. No module takes the name of one of the standard
    library, because some of those are missing on each platform.
    """

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the spec of a module that lies in the folder, or None."""
        if path is not None or name in sys.stdlib_module_names:
            return None
        return PathFinder.find_spec(name, [self.folder], target)


def search_last(folders: Iterable[str]) -> None:
    """Make this process search these folders for modules, after all others."""
    sys.meta_path += [_LastFinder(folder) for folder in folders if folder not in searched_last()]


def searched_last() -> list[str]:
    """Return the folders of `search_last`, which another process needs to import the same modules."""
    return [finder.folder for finder in sys.meta_path if isinstance(finder, _LastFinder)]


def import_named(module: str, name: str, where: str) -> Any:
    """Import a module, which runs its code, and return its attribute of the given name; SettingsError, which
    begins with `where`, if there is none. The current folder is searched last, so that no file in it takes the
    place of an installed module.
    """
    try:
        search_last([os.getcwd()])  # noqa: PTH109 - a text, as the finder has them
        named: Any = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # whatever a user's module does when it is imported
        raise SettingsError(f"{where}: module {module!r} cannot be imported ({in_words(error)})") from None
    if not hasattr(named, name):
        check_keys([name], [key for key, value in vars(named).items() if callable(value)], f"{where}: {module}")
    return getattr(named, name)


def in_words(error: BaseException) -> str:
    """Return the type and message of an exception from a user's code, in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")
