"""The errors that this package raises on purpose; any other exception is a defect.

Each message is one line that names the file, row or key, what was found and what was expected.
"""

from __future__ import annotations

from pathlib import Path

from todframes.base.locations import Location, in_utf8, without_secrets


class TodframesError(Exception):
    """Base class of all errors that a user can cause and correct; `exit_status` is the status of the command.

    A URL in the message is shown without a user name, password, parameter or query: they may be secrets.
    Names that are not UTF-8 are escaped, because results keep messages.
    """

    exit_status = 1

    def __init__(self, message: str) -> None:
        super().__init__(in_utf8(without_secrets(message)))


class DataError(TodframesError, ValueError):
    """Error for a file, row or pixel that is invalid."""


class FrameError(DataError):
    """Error for a frame that cannot be used; `path` names it and `problem` says why, without the path."""

    def __init__(self, path: Location | str, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = Path(path) if isinstance(path, str) else path
        self.problem = problem

    def __reduce__(self) -> tuple[type, tuple[Location, str]]:
        return type(self), (self.path, self.problem)


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
