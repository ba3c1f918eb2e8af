"""Finished rows of a run, from which the same command goes on after the run has failed or was killed."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from todframes.base import signals
from todframes.base.errors import OutputError
from todframes.base.output import locked

ENDING = ".rows"


class Rows:
    """Finished results in a folder: a text file for each work, whose name is the hash of all that the results of
    the work depend on. A line is the hash of an item and its result; it survives the end of the process. `tell`
    gets one remark about what an earlier run has left, `n_used` is the number of results that this run has taken
    from there, and messages call the folder `name`.
    """

    def __init__(self, folder: Path, name: str, tell: Callable[[str], None] | None = None) -> None:
        self.folder, self.name, self.n_used = folder, name, 0
        self._tell = tell

    def forget(self) -> None:
        """Remove all rows."""
        for path in self._files():
            path.unlink()
        with suppress(OSError):  # there is none, or another's file lies in it
            self.folder.rmdir()
        if self.name in signals.kept:
            signals.kept.remove(self.name)

    def tell(self, text: str) -> None:
        """Pass on a remark, but only the first one."""
        if self._tell is not None:
            self._tell(text)
        self._tell = None

    @contextmanager
    def of_work(self, identity: bytes) -> Iterator[tuple[dict[str, bytes], Callable[[str, bytes], None]]]:
        """Open the rows of a work; yields those that are there, by the hash of their item, and the function that
        adds one. Raises OutputError if they cannot be written, or another process is writing them.
        """
        path = self.folder / (identity.hex()[:32] + ENDING)
        file: io.FileIO | None = None
        lines: list[bytes] = []

        def opened() -> io.FileIO:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            opened = stack.enter_context(io.FileIO(path, "a+"))
            locked(opened.fileno())
            return opened

        with ExitStack() as stack:
            if path.exists():
                with self._as_output_error():
                    file = opened()
                    file.seek(0)
                    lines = file.readall().splitlines(keepends=True)
                    while lines and not lines[-1].endswith(b"\n"):  # it was being written as the process ended
                        lines.pop()
                    file.truncate(sum(map(len, lines)))
            elif self._files():
                self.tell("what an earlier run has finished is of other settings or versions; beginning anew")
            kept = dict(self._parsed(line) for line in lines)
            self._note(bool(kept))

            def add(item: str, result: bytes) -> None:
                nonlocal file
                left = f"{item} {base64.b64encode(result).decode()}\n".encode()
                with self._as_output_error():
                    file = file or opened()
                    while left:  # a disk that is filled up takes a part, and fails at the next
                        left = left[file.write(left) :]
                self._note(True)

            yield kept, add

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

    def _files(self) -> list[Path]:
        return list(self.folder.glob("*" + ENDING))

    def _note(self, has_rows: bool) -> None:
        """Let a message at the end name the place, if it has results."""
        if has_rows and self.name not in signals.kept:
            signals.kept.append(self.name)

    def _parsed(self, line: bytes) -> tuple[str, bytes]:
        item, _, result = line.rstrip(b"\n").partition(b" ")
        try:
            return item.decode("ascii"), base64.b64decode(result, validate=True)
        except ValueError:
            return "", b""
