"""A web server that counts its requests, and misbehaves: endless, slow, compressed, cut and moved answers."""

from __future__ import annotations

import socket
import threading
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

SECRET = "word-of-the-neighbour"
LONGEST_S = 360.0  # of a silent connection
ZEROS = bytes(2**20)
BOMB = b""
NEIGHBOUR_PORT = 0


class Asked(NamedTuple):
    """A request: the connection, the server, the request's head, and the file that is asked for."""

    connection: socket.socket
    server: Server
    head: str
    content: bytes

    def send(self, *lines: str, body: bytes = b"", status: str = "200 OK") -> None:
        head = "\r\n".join([f"HTTP/1.1 {status}", *lines, "", ""])
        self.connection.sendall(head.encode() + body)

    def send_whole(self) -> None:
        """Send the file with its length and tag, as a good server does; a request of its head gets no more."""
        tag = [f"ETag: {self.server.tag.format(hash(self.content))}"] if self.server.tag else []
        body = b"" if self.head.startswith("HEAD") else self.content
        self.send(length(self.content), *tag, body=body)

    def endless(self, piece: bytes, pause_s: float = 0.0) -> None:
        """Send a piece again and again, until the client has gone."""
        while not self.server.closing.wait(pause_s) if pause_s else not self.server.closing.is_set():
            self.connection.sendall(piece)


Answer = Callable[[Asked], object]
"""Function that answers a request; the connection is kept if it returns something true."""


class Server:
    """A web server of a folder, below its name, so that a path-style client of S3 finds a bucket.

    `failing` are the answers to the next requests for files whose names end so; `asked` counts requests by their
    method and name.
    """

    def __init__(
        self, folder: Path, failing: Mapping[str, Iterable[Answer]] | None = None, host: str = "127.0.0.1"
    ) -> None:
        self.folder, self.tag = folder, '"{}"'
        self.failing = {name: iter(answers) for name, answers in (failing or {}).items()}
        self.closing = threading.Event()
        self.asked: Counter[tuple[str, str]] = Counter()
        self.n_connections = 0
        self._listening = socket.create_server(
            (host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
        self.port = self._listening.getsockname()[1]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{self.port}"
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
                self.n_connections += 1
                self._open.add(connection)
                self._threads.append(threading.Thread(target=self._serve, args=(connection,)))
                self._threads[-1].start()

    def _serve(self, connection: socket.socket) -> None:
        with suppress(OSError), connection:
            while head := _request(connection):
                method, address, _ = head.split(" ", 2)
                address, _, query = address.partition("?")
                name = unquote(address).lstrip("/")
                self.asked[method, name] += 1
                path = self.folder / name
                asked = Asked(connection, self, head, path.read_bytes() if path.is_file() else b"")
                failing = (answers for end, answers in self.failing.items() if str(path).endswith(end))
                if "list-type" in query:
                    status(asked, "403 Forbidden")  # each frame is then asked for
                elif answer := next(next(failing, iter(())), None):
                    if not answer(asked):
                        break
                elif asked.content:
                    asked.send_whole()
                else:
                    status(asked, "404 Not Found")
        self._open.discard(connection)


def _request(connection: socket.socket) -> str:
    """Return the head of the next request; nothing at the end."""
    head = b""
    while b"\r\n\r\n" not in head:
        piece = connection.recv(65536)
        if not piece:
            return ""
        head += piece
    return head.decode("latin-1")


def chunk(data: bytes) -> bytes:
    return b"%x\r\n%s\r\n" % (len(data), data)


def bomb(size_mb: int) -> bytes:
    """Return gzip of so many MB of zeros."""
    squeezed = zlib.compressobj(9, wbits=31)
    return b"".join([*(squeezed.compress(ZEROS) for _ in range(size_mb)), squeezed.flush()])


def length(data: bytes) -> str:
    return f"Content-Length: {len(data)}"


CHUNKED = "Transfer-Encoding: chunked"
CLOSE = "Connection: close"


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


def status(asked: Asked, line: str) -> bool:
    """An error as S3 words it; its message repeats what the client said of itself."""
    code = {"403": "AccessDenied", "404": "NoSuchKey"}.get(line[:3], "InternalError")
    (said, *_) = [one for one in asked.head.splitlines() if one.startswith("Authorization")] or ["nobody"]
    words = f"<Error><Code>{code}</Code><Message>denied to {said} {SECRET}</Message></Error>".encode()
    asked.send(length(words), body=b"" if asked.head.startswith("HEAD") else words, status=line)
    return True


def cut(asked: Asked) -> None:
    """The first half of what the length says."""
    asked.send(length(asked.content), body=asked.content[: len(asked.content) // 2])


def silent(asked: Asked) -> None:
    asked.connection.settimeout(LONGEST_S)
    with suppress(TimeoutError):
        asked.connection.recv(1)


def moved(asked: Asked, place: str) -> None:
    """Send elsewhere; PORT is that of `NEIGHBOUR_PORT`, and OWN this server's."""
    place = place.replace("PORT", str(NEIGHBOUR_PORT)).replace("OWN", str(asked.server.port))
    asked.send(f"Location: {place}", "Content-Length: 0", status="302 Found")


def moved_here(asked: Asked) -> bool:
    """Send to the same file on the same server, once."""
    if sum(n for (_, name), n in asked.server.asked.items() if "manifest.csv" in name) % 2:
        asked.send("Location: ?again", "Content-Length: 0", status="307 Temporary Redirect")
    else:
        asked.send(length(asked.content), body=asked.content)
    return True
