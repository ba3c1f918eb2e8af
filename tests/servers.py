"""A web server that misbehaves about one file: endless, slow, compressed, cut and moved answers."""

from __future__ import annotations

import socket
import threading
import zlib
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

SECRET = "word-of-the-neighbour"
LONGEST_S = 360.0  # of a silent connection
ZEROS = bytes(2**20)
BOMB = b""
NEIGHBOUR_PORT = 0


class Asked(NamedTuple):
    """A request: the connection, the server, and the file that is asked for."""

    connection: socket.socket
    server: Server
    content: bytes

    def send(self, *lines: str, body: bytes = b"", status: str = "200 OK") -> None:
        """Send an answer: its status, header lines and body."""
        head = "\r\n".join([f"HTTP/1.1 {status}", *lines, "", ""])
        self.connection.sendall(head.encode() + body)

    def endless(self, piece: bytes, pause_s: float = 0.0) -> None:
        """Send a piece again and again, until the client has gone."""
        while not self.server.closing.wait(pause_s) if pause_s else not self.server.closing.is_set():
            self.connection.sendall(piece)

    def hold(self) -> None:
        """Keep the connection open, and silent."""
        self.connection.settimeout(LONGEST_S)
        with suppress(TimeoutError):
            self.connection.recv(1)


Answer = Callable[[Asked], None]


class Server:
    """A web server of a folder that misbehaves about one file.

    Parameters
    ----------
    folder : Path
        Folder that it serves below its name, so that a path-style client of S3 finds a bucket.
    target : str
        End of the name of the file that it misbehaves about.
    answer : function of Asked
        How it answers requests for this file.
    """

    def __init__(self, folder: Path, target: str, answer: Answer) -> None:
        self.folder, self.target, self.answer = folder, target, answer
        self.closing = threading.Event()
        self.asked: list[str] = []
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self._threads = [threading.Thread(target=self._accept)]
        self._open: set[socket.socket] = set()

    def __enter__(self) -> Server:
        self._threads[0].start()
        return self

    def __exit__(self, *_: object) -> None:
        self.closing.set()
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        for connection in list(self._open):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._listening.accept()
                self._open.add(connection)
                self._threads.append(threading.Thread(target=self._serve, args=(connection,)))
                self._threads[-1].start()

    def _serve(self, connection: socket.socket) -> None:
        with suppress(OSError), connection:
            while request := _request(connection):
                method, name = request
                self.asked.append(f"{method} {name}")
                path = self.folder / name.lstrip("/").partition("?")[0]
                asked = Asked(connection, self, path.read_bytes() if path.is_file() else b"")
                if "list-type" in name:
                    asked.send("Content-Length: 0", status="403 Forbidden")  # each frame is then asked for
                elif path.name.endswith(self.target):
                    self.answer(asked)
                    if self.answer not in KEPT_OPEN:
                        break
                elif asked.content:
                    body = asked.content if method == "GET" else b""
                    asked.send(f"Content-Length: {len(asked.content)}", 'ETag: "1"', body=body)
                else:
                    asked.send("Content-Length: 0", status="404 Not Found")
        self._open.discard(connection)


def _request(connection: socket.socket) -> tuple[str, str] | None:
    """Return method and path of the next request; None at the end."""
    head = b""
    while b"\r\n\r\n" not in head:
        piece = connection.recv(65536)
        if not piece:
            return None
        head += piece
    method, name, _ = head.decode("latin-1").split(" ", 2)
    return method, unquote(name)


def chunk(data: bytes) -> bytes:
    """Return a chunk of an answer that comes in chunks."""
    return b"%x\r\n%s\r\n" % (len(data), data)


def bomb(size_mb: int) -> bytes:
    """Return gzip of so many MB of zeros."""
    squeezed = zlib.compressobj(9, wbits=31)
    return b"".join([*(squeezed.compress(ZEROS) for _ in range(size_mb)), squeezed.flush()])


def length(data: bytes) -> str:
    """Return the header line of a length."""
    return f"Content-Length: {len(data)}"


CHUNKED = "Transfer-Encoding: chunked"
CLOSE = "Connection: close"


# Answers ---------------------------------------------------------------------------------------------------------


def endless_chunks(asked: Asked) -> None:
    asked.send(CHUNKED)
    asked.endless(chunk(ZEROS))


def endless_until_close(asked: Asked) -> None:
    asked.send(CLOSE)
    asked.endless(ZEROS)


def ten_gigabytes(asked: Asked) -> None:
    asked.send("Content-Length: 10000000000")
    asked.endless(ZEROS)


def gzip_bomb(asked: Asked, encoding: str = "gzip") -> None:
    asked.send("Content-Encoding: " + encoding, length(BOMB), body=BOMB)


def endless_trailers(asked: Asked) -> None:
    asked.send(CHUNKED, body=chunk(asked.content) + b"0\r\n")
    asked.endless(b"X: " + b"a" * 1000 + b"\r\n")


def endless_continue(asked: Asked) -> None:
    asked.endless(b"HTTP/1.1 100 Continue\r\n\r\n" * 100)


def slow_body(asked: Asked) -> None:
    asked.send(length(asked.content))
    for byte in asked.content:
        asked.connection.sendall(bytes([byte]))
        if asked.server.closing.wait(5.0):
            return


def slow_headers(asked: Asked) -> None:
    asked.connection.sendall(b"HTTP/1.1 200 OK\r\nX: ")
    asked.endless(b"a", pause_s=2.0)


def longer_length(asked: Asked) -> None:
    asked.send(f"Content-Length: {len(asked.content) + 10}", body=asked.content)


def cut_without_length(asked: Asked) -> None:
    """The first half of the lines, as if they were all."""
    lines = asked.content.splitlines(keepends=True)
    asked.send(CLOSE, body=b"".join(lines[: max(len(lines) // 2, 1)]))


def no_gzip(asked: Asked) -> None:
    asked.send("Content-Encoding: gzip", length(asked.content), body=asked.content)


def part(asked: Asked) -> None:
    """A status that says that more is to come."""
    half = asked.content[: len(asked.content) // 2]
    where = f"Content-Range: bytes 0-{len(half) - 1}/{len(asked.content)}"
    asked.send(where, length(half), body=half, status="206 Partial Content")


def status(asked: Asked, line: str) -> None:
    words = f"{SECRET} {line}".encode()
    asked.send(length(words), body=words, status=line)


def closes(_: Asked) -> None:
    pass


def moved(asked: Asked, place: str) -> None:
    """Send elsewhere; PORT is that of `NEIGHBOUR_PORT`, and OWN this server's."""
    place = place.replace("PORT", str(NEIGHBOUR_PORT)).replace("OWN", str(asked.server.port))
    asked.send(f"Location: {place}", "Content-Length: 0", status="302 Found")


def moved_here(asked: Asked) -> None:
    """Send to the same file on the same server, once."""
    n = sum("manifest.csv" in one for one in asked.server.asked)
    if n % 2:
        asked.send("Location: ?again", "Content-Length: 0", status="307 Temporary Redirect")
    else:
        asked.send(length(asked.content), body=asked.content)


ANSWERS: dict[str, Answer] = {
    "endless chunks": endless_chunks,
    "endless until it closes": endless_until_close,
    "ten gigabytes": ten_gigabytes,
    "gzip bomb": gzip_bomb,
    "gzip bomb called deflate": partial(gzip_bomb, encoding="deflate"),
    "endless trailers": endless_trailers,
    "endless continue": endless_continue,
    "a byte every 5 s": slow_body,
    "a byte of a header every 2 s": slow_headers,
    "cut without a length": cut_without_length,
    "longer length": longer_length,
    "text called gzip": no_gzip,
    "a part": part,
    "status 203 Non-Authoritative": partial(status, line="203 Non-Authoritative"),
    **{
        f"moved to {place}": partial(moved, place=place)
        for place in (
            *("http://127.0.0.1:PORT/secret.csv", "http://localhost:OWN/secret.csv"),
            *("https://127.0.0.1:OWN/x", "file:///etc/passwd", "?endless"),
        )
    },
}
KEPT_OPEN = (moved_here,)
