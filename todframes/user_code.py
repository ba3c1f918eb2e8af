"""Import of code that a user names on the command line as `module:name`.

It is the only code that a command runs from the current folder, where a dataset of unknown origin may lie.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

from todframes.config import check_keys
from todframes.errors import SettingsError


def import_named(module: str, name: str, where: str) -> Any:
    """Import a module, which runs its code, and return its attribute of the given name.

    The current folder is searched last, so that no file in it takes the place of an installed module.

    Raises
    ------
    SettingsError
        If the module cannot be imported or has no such attribute; the message begins with `where`.
    """
    try:
        if (here := os.getcwd()) not in sys.path and "" not in sys.path:  # noqa: PTH109 - a text, as the path has them
            sys.path.append(here)
        found: Any = importlib.import_module(module)
    except (Exception, SystemExit) as error:  # whatever a user's module does when it is imported
        raise SettingsError(f"{where}: module {module!r} cannot be imported ({in_words(error)})") from None
    if not hasattr(found, name):
        check_keys([name], [key for key, value in vars(found).items() if callable(value)], f"{where}: {module}")
    return getattr(found, name)


def in_words(error: BaseException) -> str:
    """Return the type and message of an exception from a user's code, in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}".removesuffix(": ")
