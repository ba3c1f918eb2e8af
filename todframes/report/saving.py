"""Saving of results: one class gives all of them their files and `save`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Protocol

import msgspec

from todframes.base.safe_text import visible_json


class HasFiles(Protocol):
    """Protocol of a result that gives the content of its files by name."""

    def files(self) -> Mapping[str, bytes | Iterable[bytes]]:
        """Return the content of all files by name, long ones in parts."""


class Saving:
    """Mixin that saves what `files` gives."""

    __slots__ = ()

    def save(self: HasFiles, folder: Path | str) -> None:
        """Write the files that the command writes with `-o`, each whole or not at all.

        Parameters
        ----------
        folder : path
            Folder, which is made if only its parent exists. Files of an earlier result are replaced.

        Raises
        ------
        OutputError
            If the place cannot be written.
        """
        from todframes.base.output import write_folder

        write_folder(folder, self.files())


def json_file(content: object) -> bytes:
    """Return a record as indented JSON; NaN becomes null.

    Characters that a terminal would obey are escaped; the values of the JSON are the same.
    """
    text = msgspec.json.format(msgspec.json.encode(content), indent=2).decode()
    return (visible_json(text) + "\n").encode()
