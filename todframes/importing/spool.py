"""A list on disk, for what is kept of each frame until the end of a recording."""

from __future__ import annotations

import pickle
import tempfile
import weakref
from array import array
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Generic, TypeVar

from todframes.base.errors import OutputError

T = TypeVar("T")


class Spool(Generic[T]):
    """Objects in the order in which they were added, in a file without a name that ends with this object.

    Memory grows by 8 bytes for each object. Every access makes a new copy, so changes of an object are not kept.
    """

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        self._starts = array("Q")
        self._size = 0
        self._at_end = True

    def append(self, item: T) -> None:
        """Add an object; raise OutputError if the folder for temporary files is full."""
        packed = pickle.dumps(item, pickle.HIGHEST_PROTOCOL)
        with _one_line():
            if not self._at_end:
                self._file.seek(self._size)
            self._file.write(packed)
        self._at_end = True
        self._starts.append(self._size)
        self._size += len(packed)

    def __len__(self) -> int:
        return len(self._starts)

    def __getitem__(self, place: int) -> T:
        if not 0 <= place < len(self):
            raise IndexError(place)
        with _one_line():  # what is buffered is written first
            self._file.seek(self._starts[place])
        self._at_end = False
        item: T = pickle.load(self._file)
        return item

    def __iter__(self) -> Iterator[T]:
        return (self[place] for place in range(len(self)))


@contextmanager
def _one_line() -> Iterator[None]:
    """Raise OutputError for an OSError of the file."""
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{tempfile.gettempdir()}: cannot be written ({error.strerror}); import keeps some 1 kB a frame there "
            "while it runs"
        ) from None
