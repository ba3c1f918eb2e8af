"""The errors that this package raises on purpose; any other exception is a defect.

Each message is one line that names the file, row or key, what was found and what was expected.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from todframes.base.safe_text import in_utf8, without_secrets

_ARGUMENT = re.compile("\x1a([a-z0-9_]+)\x1a")
"""Pattern of an argument in the text of an error."""
_FLAGS = {
    "boxes": "--box",
    "integration_time_s": "--integration-time",
    "luminance_cd_m2": "--luminance",
    "dither": "--no-dither",
    "time_limit_s": "--time-limit",
    "motion_mrad_per_s": "--motion",
    "patches": "--patch",
    "pattern": "--from",
    "rng": "--seed",
    "search_time_s": "--search-time",
    "value_range": "--range",
    "warm_up_frames": "--warm-up",
}
"""Options of the command line whose names are not those of the arguments."""
_is_command: ContextVar[bool] = ContextVar("is_command", default=False)


class _Arguments:
    """Names of the arguments of calls, for the messages of errors: `argument.max_frame_mb`.

    A message shows the name that its reader knows: that of the argument, or of the option of the command.
    """

    def __getattr__(self, name: str) -> str:
        return f"\x1a{name}\x1a"


argument = _Arguments()


def flag_of(name: str) -> str:
    """Return the option of the command line for an argument of a call."""
    return _FLAGS.get(name, "--" + name.replace("_", "-"))


@contextmanager
def in_command(*, is_on_page: bool = False) -> Iterator[None]:
    """Let texts name the options of the command line for the time of a `with` statement.

    On a page that a command serves, they name the arguments, which its fields have as well.
    """
    before = _is_command.set(not is_on_page)
    try:
        yield
    finally:
        _is_command.reset(before)


def for_reader(text: str) -> str:
    """Return a text with names as its reader knows them: options in a command, arguments in a call."""
    return _ARGUMENT.sub(lambda found: flag_of(found[1]) if _is_command.get() else found[1], text)


class TodframesError(Exception):
    """Base class of all errors that a user can cause and correct; `exit_status` is the status of the command.

    A URL in the message is shown without a user name, password, parameter or query: they may be secrets.
    Names that are not UTF-8 are escaped, because results keep messages.
    """

    exit_status = 1

    def __init__(self, message: str) -> None:
        super().__init__(in_utf8(without_secrets(message)))

    def __str__(self) -> str:
        return for_reader(self.marked)

    @property
    def marked(self) -> str:
        """The message for another error of this package; arguments in it get the name that its reader knows."""
        return str(self.args[0])


class DataError(TodframesError, ValueError):
    """Error for a file, row or pixel that is invalid."""


class FrameError(DataError):
    """Error for a frame that cannot be used: `path` is its `Location`, and `problem` is the reason, without the
    path."""

    def __init__(self, path: Any, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = Path(path) if isinstance(path, str) else path
        self._marked_problem = problem

    @property
    def problem(self) -> str:
        """The problem, without the path."""
        return for_reader(self._marked_problem)

    def __reduce__(self) -> tuple[type, tuple[Any, str]]:
        return type(self), (self.path, self._marked_problem)


class RemoteError(TodframesError, ConnectionError):
    """Error for a dataset behind a URL that cannot be reached or may not be read; no further frame is tried."""


class SettingsError(TodframesError, ValueError):
    """Error for a setting, option or argument that is invalid."""

    exit_status = 2


class OutputError(TodframesError, OSError):
    """Error for results that cannot be written to the place that was asked for."""

    exit_status = 2


class ClusterError(TodframesError, OSError):
    """Error for a cluster that cannot be reached, cannot do the work, or is gone."""

    exit_status = 2
