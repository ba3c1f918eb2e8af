"""The errors that this package raises on purpose; any other exception is a defect.

Each message is one line that names the file, row or key, what was found and what was expected.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from todframes.base.safe_text import in_utf8

_FLAGS = {
    "answers": "--out",
    "boxes": "--box",
    "descriptor": "--emva",
    "integration_time_s": "--integration-time",
    "kind": "--for",
    "luminance_cd_m2": "--luminance",
    "dither": "--no-dither",
    "frame_format": "--format",
    "open_browser": "--no-browser",
    "subjects": "--subject",
    "time_limit_s": "--time-limit",
    "motion_mrad_per_s": "--motion",
    "patches": "--patch",
    "pattern": "--from",
    "pybsm": "--from",
    "rng": "--seed",
    "search_time_s": "--search-time",
    "value_range": "--range",
    "warm_up_frames": "--warm-up",
}
"""Options of the command line whose names are not those of the arguments."""
_is_command: ContextVar[bool] = ContextVar("is_command", default=False)


class _Arguments:
    """Names of the arguments of calls, for messages: `argument.max_frame_mb` is "max_frame_mb" in a call, and
    "--max-frame-mb" in a command."""

    def __getattr__(self, name: str) -> str:
        return flag_of(name) if is_in_command() else name


argument = _Arguments()


def flag_of(name: str) -> str:
    """Return the option of the command line for an argument of a call."""
    return _FLAGS.get(name, "--" + name.replace("_", "-"))


def is_in_command() -> bool:
    """Return whether messages name the options of the command line."""
    return _is_command.get()


@contextmanager
def in_command(is_command: bool = True) -> Iterator[None]:
    """Let messages name options for the time of a `with` statement, or arguments if this is no command. The fields
    of a page that a command serves have the names of arguments.
    """
    before = _is_command.set(is_command)
    try:
        yield
    finally:
        _is_command.reset(before)


class TodframesError(Exception):
    """Base class of all errors that a user can cause and correct; `exit_status` is the status of the command.

    Names that are not UTF-8 are escaped, because results keep messages.

    Examples
    --------
    >>> import todframes as tod
    >>> try:
    ...     tod.load_dataset("nowhere")
    ... except tod.TodframesError as error:
    ...     print(type(error).__name__)
    DataError
    """

    exit_status = 1

    def __init__(self, message: str) -> None:
        super().__init__(in_utf8(message))


class DataError(TodframesError, ValueError):
    """Error for a file, row or pixel that is invalid."""


class FrameError(DataError):
    """Error for a frame that cannot be used: `path` is where it is, `problem` the reason without the path."""

    def __init__(self, path: Any, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = Path(path) if isinstance(path, str) else path
        self.problem = problem

    def __reduce__(self) -> tuple[type, tuple[Any, str]]:
        return type(self), (self.path, self.problem)


@contextmanager
def of_frame(path: Any) -> Iterator[None]:
    """Raise FrameError, which names the frame, in place of other DataErrors in a block."""
    try:
        yield
    except FrameError:
        raise
    except DataError as error:
        raise FrameError(path, str(error)) from None


class SettingsError(TodframesError, ValueError):
    """Error for a setting, option or argument that is invalid."""

    exit_status = 2


class OutputError(TodframesError, OSError):
    """Error for results that cannot be written to the place that was asked for."""

    exit_status = 2


class ClusterError(TodframesError, OSError):
    """Error for a cluster that cannot be reached, cannot do the work, or is gone."""

    exit_status = 2
