"""The errors this package raises on purpose; everything else is a defect.

Each message is one line that names the file, row or key, what was found and what was expected.
"""

from __future__ import annotations

from pathlib import Path


class TodframesError(Exception):
    """Base of all errors that a user can cause and mend; `exit_status` is the command line's."""

    exit_status = 1


class DataError(TodframesError, ValueError):
    """A file, row or pixel is not what it should be."""


class FrameError(DataError):
    """A frame cannot be used; `path` names it and `problem` says why, without the path."""

    def __init__(self, path: Path | str, problem: str) -> None:
        super().__init__(f"{path}: {problem}")
        self.path = Path(path)
        self.problem = problem


class SettingsError(TodframesError, ValueError):
    """A setting, option or argument is not what it should be."""

    exit_status = 2


class OutputError(TodframesError, OSError):
    """Results cannot be written where they were asked for."""

    exit_status = 2
