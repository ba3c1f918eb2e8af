"""The store of finished results: an SQLite database that survives a run that is killed."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from todframes import signals
from todframes.errors import OutputError

FILE = "results.sqlite"
"""Name of the database in the store's folder."""


FORMAT = 1
"""Version of the tables; a store of another version is not read."""


class Store:
    """Finished results by key, in a folder that one process writes at a time.

    Nothing is written before `begin`. What `add` has returned from survives the end of the process, however it
    ends; after a power failure the last additions may be missing, but nothing is damaged.

    Parameters
    ----------
    folder : Path
        Folder of the store; it need not exist. Whoever makes the store holds a lock that keeps others out.
    name : str
        Name of the place in messages.
    tell : function of a text, optional
        Called with a remark if results of an earlier run are found.
    """

    def __init__(self, folder: Path, name: str, tell: Callable[[str], None] | None = None) -> None:
        self.folder, self.name = folder, name
        self._tell = tell
        self._database: sqlite3.Connection | None = None

    @property
    def is_begun(self) -> bool:
        """Whether the store holds results, or is about to."""
        return self._database is not None or (self.folder / FILE).exists()

    def begin(self) -> None:
        """Open the database and make it if there is none; one that is damaged or of another version is replaced.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        if self._database is not None:
            return
        with self._as_output_error():
            self.folder.mkdir(mode=0o700, exist_ok=True)
            try:
                self._database = self._opened()
            except sqlite3.DatabaseError as error:
                if isinstance(error, sqlite3.OperationalError):
                    raise
                self._remove_files()
                self._database = self._opened()
        signals.kept.append(self.name)

    def get(self, key: bytes) -> bytes | None:
        """Return the result under a key; None if there is none."""
        self.begin()
        assert self._database is not None
        with self._as_output_error():
            row = self._database.execute("SELECT result FROM results WHERE key = ?", (key,)).fetchone()
        return None if row is None else row[0]

    def add(self, results: Sequence[tuple[bytes, bytes]]) -> None:
        """Write results by key, all or none; without results nothing is done.

        Raises
        ------
        OutputError
            If they cannot be written.
        """
        if not results:
            return
        self.begin()
        assert self._database is not None
        with self._as_output_error():
            self._database.execute("BEGIN")
            try:
                self._database.executemany("INSERT OR REPLACE INTO results VALUES (?, ?)", results)
                self._database.execute("COMMIT")
            except BaseException:
                with suppress(sqlite3.Error):  # a full disk may have rolled it back already
                    self._database.execute("ROLLBACK")
                raise

    def __len__(self) -> int:
        if not self.is_begun:
            return 0
        self.begin()
        assert self._database is not None
        with self._as_output_error():
            return int(self._database.execute("SELECT count(*) FROM results").fetchone()[0])

    def tell(self, text: str) -> None:
        """Pass on a remark about results that were found, but only the first one."""
        if self._tell is not None:
            self._tell(text)
        self._tell = None

    def close(self) -> None:
        """Close the database; the next use opens it again."""
        if self._database is not None:
            with suppress(sqlite3.Error):  # on a full disk the log stays beside the database, which is as good
                self._database.close()
            self._database = None

    def _opened(self) -> sqlite3.Connection:
        database = sqlite3.connect(self.folder / FILE, timeout=0.1, isolation_level=None, check_same_thread=False)
        try:
            # With an exclusive lock the log needs no shared memory, so it also works on network file systems.
            for pragma in ("locking_mode = EXCLUSIVE", "journal_mode = WAL", "synchronous = NORMAL"):
                database.execute(f"PRAGMA {pragma}")
            (version,) = database.execute("PRAGMA user_version").fetchone()
            if version not in (0, FORMAT):
                raise sqlite3.DatabaseError(f"version {version}")
            database.execute("BEGIN IMMEDIATE")
            database.execute(
                "CREATE TABLE IF NOT EXISTS results (key BLOB PRIMARY KEY, result BLOB NOT NULL) WITHOUT ROWID"
            )
            database.execute(f"PRAGMA user_version = {FORMAT}")
            database.execute("COMMIT")
        except BaseException:
            database.close()
            raise
        return database

    def _remove_files(self) -> None:
        for path in self.folder.iterdir():
            path.unlink()

    @contextmanager
    def _as_output_error(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, OSError) as error:
            raise OutputError(f"{self.name}: finished results cannot be kept there ({error})") from None
