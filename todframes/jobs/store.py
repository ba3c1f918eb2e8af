"""The store of finished results: a file that grows by whole records and survives a run that is killed."""

from __future__ import annotations

import hashlib
import io
import os
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from todframes.base import signals
from todframes.base.errors import OutputError
from todframes.base.output import locked

FILE = "results.store"
"""Name of the store in a folder of the user's."""

MAGIC = b"todframes store 2\n"
"""First bytes of a store; a file with other first bytes is replaced."""

HEAD = struct.Struct("<II16s")
"""Before each key and result: their lengths in bytes, and the checksum of lengths, key and result."""

READ_AT_ONCE = 2**20


class Store:
    """Finished results by key, in a file that one process writes at a time; messages call it `name`. When `add`
    has returned, its results survive the end of the process, however it ends; after a power failure the last
    additions may be missing. A record whose checksum is wrong, and all behind it, is cut off when the file is
    opened. The checksum is no signature: whoever can write the file can write results into it. `tell` gets a
    remark if results of an earlier run are found; `n_used` of these this run has used.
    """

    def __init__(self, path: Path, name: str, tell: Callable[[str], None] | None = None) -> None:
        self.path, self.name = path, name
        self.n_used = 0
        self._tell = tell
        self._file: io.FileIO | None = None
        self._size = 0
        self._places: dict[int, int] = {}  # of records, by the hash of the key: there may be millions

    @property
    def is_begun(self) -> bool:
        """True if the store holds results, or is about to."""
        return self._file is not None or self.path.exists()

    def begin(self) -> None:
        """Open the file and make it if there is none; one that is damaged is used up to the damage. OutputError if
        it cannot be written, or another process is writing it.
        """
        if self._file is not None:
            return
        with self._as_output_error():
            self.path.parent.mkdir(mode=0o700, exist_ok=True)
            self.path.touch(mode=0o600)
            file = io.FileIO(self.path, "r+")
            try:
                locked(file.fileno())
                self._read(file)
            except BaseException:
                file.close()
                raise
            self._file = file
        self._note()

    def get(self, key: bytes) -> bytes | None:
        """Return the result that was added last under a key; None if there is none."""
        self.begin()
        assert self._file is not None
        start = self._places.get(hash(key))
        if start is None:
            return None
        with self._as_output_error():
            self._file.seek(start)
            n_key, n_result, checksum = HEAD.unpack(self._file.read(HEAD.size).ljust(HEAD.size))
            if n_key != len(key):  # it may have been damaged since it was read
                return None
            content = self._file.read(n_key + n_result)
        is_good = content[:n_key] == key and _checksum(n_key, n_result, content) == checksum
        return content[n_key:] if is_good else None

    def add(self, results: Sequence[tuple[bytes, bytes]]) -> None:
        """Write results by key, all or none; OutputError if they cannot be written."""
        if not results:
            return
        self.begin()
        assert self._file is not None
        left = b"".join(_record(key, result) for key, result in results)
        with self._as_output_error():
            try:
                self._file.seek(self._size)
                while left:  # a disk that is filled up takes a part, and fails at the next
                    left = left[self._file.write(left) :]
            except BaseException:
                self._file.truncate(self._size)
                raise
        for key, result in results:
            self._found(key, HEAD.size + len(key) + len(result))
        self._note()

    def forget(self) -> None:
        """Remove all results, if there are any."""
        if self.is_begun:
            self.begin()
            assert self._file is not None
            with self._as_output_error():
                self._file.truncate(0)
                self._file.seek(0)
                self._read(self._file)

    def __len__(self) -> int:
        """Return the number of results."""
        if self.is_begun:
            self.begin()
        return len(self._places)

    def tell(self, text: str) -> None:
        """Pass on a remark about results that were found, but only the first one."""
        if self._tell is not None:
            self._tell(text)
        self._tell = None

    def close(self) -> None:
        """Close the file, and remove it if it holds no result; the next use opens it again."""
        if self._file is not None:
            self._file.close()
            self._file = None
            if not self._places:
                with suppress(OSError):
                    self.path.unlink()

    def _note(self) -> None:
        """Let a message at the end name the place, if it has results."""
        if self._places and self.name not in signals.kept:
            signals.kept.append(self.name)

    def _read(self, file: io.FileIO) -> None:
        """Find the records of the file, and cut off everything behind the last good one."""
        self._places.clear()
        content = io.BufferedReader(file, READ_AT_ONCE)
        n_bytes = os.fstat(file.fileno()).st_size
        self._size = len(MAGIC) if content.read(len(MAGIC)) == MAGIC else 0
        while self._size and len(head := content.read(HEAD.size)) == HEAD.size:
            n_key, n_result, checksum = HEAD.unpack(head)
            size = HEAD.size + n_key + n_result
            if self._size + size > n_bytes:
                break
            both = content.read(n_key + n_result)
            if _checksum(n_key, n_result, both) != checksum:
                break
            self._found(both[:n_key], size)
        content.detach()
        file.truncate(self._size)
        if not self._size:
            file.seek(0)
            self._size = file.write(MAGIC)

    def _found(self, key: bytes, size: int) -> None:
        """Enter a record of this size, which is the file's last."""
        self._places[hash(key)] = self._size
        self._size += size

    @contextmanager
    def _as_output_error(self) -> Iterator[None]:
        try:
            yield
        except BlockingIOError:
            raise OutputError(
                f"{self.name}: finished results cannot be kept there (another run is writing them)"
            ) from None
        except OSError as error:
            raise OutputError(
                f"{self.name}: finished results cannot be kept there ({error.strerror or error})"
            ) from None


def _record(key: bytes, result: bytes) -> bytes:
    content = key + result
    return HEAD.pack(len(key), len(result), _checksum(len(key), len(result), content)) + content


def _checksum(n_key: int, n_result: int, content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=16, salt=struct.pack("<II", n_key, n_result)).digest()
