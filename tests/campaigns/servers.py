"""The campaign of misbehaving servers: endless, slow, compressed, cut and moved answers to `validate` and `score`.

Every case ends in the result of the same dataset in a folder or in one clear line, within limits of time and
memory, and nothing of what the server says, or what a neighbour of it keeps, is in the output.
"""

from __future__ import annotations

import gzip
import itertools
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote

SECRET = "word-of-the-neighbour"
LONGEST_S = 360.0
MOST_MB = {"dataset.toml": 320, "manifest.csv": 640, "frame": 1000}
"""Largest memory of a command, by the file that the server misbehaves about."""
ZEROS = bytes(2**20)
DEFECT = re.compile(r"\((Type|Key|Attribute|Index|Name)Error")
"""Pattern of a message about an exception that no server should be able to cause."""
RIGHT, REFUSED = "right", "refused"


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


# Too much -------------------------------------------------------------------------------------------------------


def endless_chunks(asked: Asked) -> None:
    asked.send(CHUNKED)
    asked.endless(chunk(ZEROS))


def endless_text(asked: Asked) -> None:
    """A beginning that could be read, and rows without end."""
    asked.send(CHUNKED, body=chunk(asked.content))
    asked.endless(chunk(b"# more\n" * 10_000))


def endless_until_close(asked: Asked) -> None:
    asked.send(CLOSE)
    asked.endless(ZEROS)


def ten_gigabytes(asked: Asked) -> None:
    asked.send("Content-Length: 10000000000")
    asked.endless(ZEROS)


def gzip_bomb(asked: Asked, encoding: str = "gzip") -> None:
    asked.send("Content-Encoding: " + encoding, length(BOMB), body=BOMB)


def gzip_bomb_in_chunks(asked: Asked) -> None:
    asked.send("Content-Encoding: gzip", CHUNKED, body=chunk(BOMB) + b"0\r\n\r\n")


def gzip_bomb_twice(asked: Asked) -> None:
    twice = gzip.compress(BOMB)
    asked.send("Content-Encoding: gzip, gzip", length(twice), body=twice)


def endless_gzip(asked: Asked) -> None:
    asked.send("Content-Encoding: gzip", CHUNKED)
    squeezed = zlib.compressobj(1, wbits=31)
    while not asked.server.closing.is_set():
        if piece := squeezed.compress(ZEROS):
            asked.connection.sendall(chunk(piece))


def gzip_with_a_tail(asked: Asked) -> None:
    asked.send("Content-Encoding: gzip", CHUNKED, body=chunk(gzip.compress(asked.content)))
    asked.endless(chunk(ZEROS))


def endless_empty_gzip(asked: Asked) -> None:
    """Blocks of gzip without content."""
    asked.send("Content-Encoding: gzip", CHUNKED, body=chunk(b"\x1f\x8b\x08\0\0\0\0\0\0\xff"))
    asked.endless(chunk(b"\0\0\0\xff\xff" * 200_000))


def endless_headers(asked: Asked) -> None:
    asked.connection.sendall(b"HTTP/1.1 200 OK\r\n")
    for number in itertools.count():
        asked.connection.sendall(b"X-%d: %s\r\n" % (number, b"a" * 1000))


def endless_header(asked: Asked) -> None:
    asked.connection.sendall(b"HTTP/1.1 200 OK\r\nX: ")
    asked.endless(b"a" * 65536)


def endless_status(asked: Asked) -> None:
    asked.connection.sendall(b"HTTP/1.1 200 ")
    asked.endless(SECRET.encode() * 1000)


def endless_trailers(asked: Asked) -> None:
    asked.send(CHUNKED, body=chunk(asked.content) + b"0\r\n")
    asked.endless(b"X: " + b"a" * 1000 + b"\r\n")


def endless_chunk_extension(asked: Asked) -> None:
    asked.send(CHUNKED, body=b"10;a=")
    asked.endless(b"a" * 65536)


def endless_continue(asked: Asked) -> None:
    asked.endless(b"HTTP/1.1 100 Continue\r\n\r\n" * 100)


def endless_error(asked: Asked) -> None:
    asked.send(CHUNKED, status="500 Internal Server Error")
    asked.endless(chunk(SECRET.encode() * 10_000))


# Too slow -------------------------------------------------------------------------------------------------------


def slow_body(asked: Asked) -> None:
    asked.send(length(asked.content))
    for byte in asked.content:
        asked.connection.sendall(bytes([byte]))
        if asked.server.closing.wait(5.0):
            return


def slow_chunks(asked: Asked) -> None:
    asked.send(CHUNKED, body=chunk(asked.content))
    asked.endless(chunk(b"#"), pause_s=1.0)


def slow_headers(asked: Asked) -> None:
    asked.connection.sendall(b"HTTP/1.1 200 OK\r\nX: ")
    asked.endless(b"a", pause_s=2.0)


def silent(asked: Asked) -> None:
    asked.hold()


def silent_after_headers(asked: Asked) -> None:
    asked.send(length(asked.content))
    asked.hold()


def silent_half_way(asked: Asked) -> None:
    asked.send(length(asked.content), body=asked.content[: len(asked.content) // 2])
    asked.hold()


# Less or other than stated --------------------------------------------------------------------------------------


def shorter_length(asked: Asked) -> None:
    asked.send(f"Content-Length: {len(asked.content) - 30}", body=asked.content)


def longer_length(asked: Asked) -> None:
    asked.send(f"Content-Length: {len(asked.content) + 10}", body=asked.content)


def two_lengths(asked: Asked) -> None:
    asked.send(length(asked.content), "Content-Length: 20", body=asked.content)


def bad_length(asked: Asked, stated: str) -> None:
    asked.send(f"Content-Length: {stated}", body=asked.content)


def cut_without_length(asked: Asked) -> None:
    """The first half of the lines, as if they were all."""
    lines = asked.content.splitlines(keepends=True)
    asked.send(CLOSE, body=b"".join(lines[: max(len(lines) // 2, 1)]))


def cut_chunks(asked: Asked) -> None:
    lines = asked.content.splitlines(keepends=True)
    asked.send(CHUNKED, body=chunk(b"".join(lines[: max(len(lines) // 2, 1)])))


def bad_chunk(asked: Asked, size: bytes) -> None:
    asked.send(CHUNKED, body=size + b"\r\n" + asked.content)


def cut_gzip(asked: Asked) -> None:
    squeezed = gzip.compress(asked.content)
    squeezed = squeezed[: len(squeezed) // 2]
    asked.send("Content-Encoding: gzip", length(squeezed), body=squeezed)


def no_gzip(asked: Asked) -> None:
    asked.send("Content-Encoding: gzip", length(asked.content), body=asked.content)


def other_encoding(asked: Asked) -> None:
    squeezed = zlib.compress(asked.content)
    asked.send(f"Content-Encoding: {SECRET}", length(squeezed), body=squeezed)


def part(asked: Asked) -> None:
    """A status that says that more is to come."""
    half = asked.content[: len(asked.content) // 2]
    where = f"Content-Range: bytes 0-{len(half) - 1}/{len(asked.content)}"
    asked.send(where, length(half), body=half, status="206 Partial Content")


def status(asked: Asked, line: str, *more: str) -> None:
    words = f"{SECRET} {line}".encode()
    asked.send(length(words), *more, body=words, status=line)


def no_http(asked: Asked) -> None:
    asked.connection.sendall(f"{SECRET}\r\n\r\n".encode())


def closes(_: Asked) -> None:
    pass


# Elsewhere ------------------------------------------------------------------------------------------------------


def moved(asked: Asked, place: str, line: str = "302 Found") -> None:
    """Send elsewhere; PORT is the neighbour's, and OWN this server's."""
    place = place.replace("PORT", str(NEIGHBOUR.port)).replace("OWN", str(asked.server.port))
    asked.send(f"Location: {place}", "Content-Length: 0", status=line)


def moved_here(asked: Asked) -> None:
    """Send to the same file on the same server, once."""
    n = sum("manifest.csv" in one or "dataset.toml" in one or ".exr" in one for one in asked.server.asked)
    if n % 2:
        asked.send("Location: ?again", "Content-Length: 0", status="307 Temporary Redirect")
    else:
        asked.send(length(asked.content), body=asked.content)


# Whole, and of no stated length or compressed --------------------------------------------------------------------


def whole_chunks(asked: Asked) -> None:
    half = len(asked.content) // 2
    body = chunk(asked.content[:half]) + chunk(asked.content[half:]) + b"0\r\n\r\n"
    asked.send(CHUNKED, body=body)


def whole_gzip(asked: Asked) -> None:
    squeezed = gzip.compress(asked.content)
    asked.send("Content-Encoding: gzip", length(squeezed), body=squeezed)


class Case(NamedTuple):
    """A way to answer, and how the command must end."""

    answer: Answer
    expected: str = REFUSED


CASES = {
    "endless chunks": Case(endless_chunks),
    "endless text": Case(endless_text),
    "endless until it closes": Case(endless_until_close),
    "ten gigabytes": Case(ten_gigabytes),
    "gzip bomb": Case(gzip_bomb),
    "gzip bomb in chunks": Case(gzip_bomb_in_chunks),
    "gzip bomb called x-gzip": Case(partial(gzip_bomb, encoding="x-gzip")),
    "gzip bomb called deflate": Case(partial(gzip_bomb, encoding="deflate")),
    "gzip bomb twice": Case(gzip_bomb_twice),
    "endless gzip": Case(endless_gzip),
    "gzip with an endless tail": Case(gzip_with_a_tail),
    "endless gzip of nothing": Case(endless_empty_gzip),
    "endless headers": Case(endless_headers),
    "endless header": Case(endless_header),
    "endless status": Case(endless_status),
    "endless trailers": Case(endless_trailers),
    "endless chunk extension": Case(endless_chunk_extension),
    "endless continue": Case(endless_continue),
    "endless error": Case(endless_error),
    "a byte every 5 s": Case(slow_body),
    "a chunk every second": Case(slow_chunks),
    "a byte of a header every 2 s": Case(slow_headers),
    "silent": Case(silent),
    "silent after headers": Case(silent_after_headers),
    "silent half-way": Case(silent_half_way),
    "shorter length": Case(shorter_length),
    "longer length": Case(longer_length),
    "two lengths": Case(two_lengths),
    "negative length": Case(partial(bad_length, stated="-5")),
    "length that is a word": Case(partial(bad_length, stated=SECRET)),
    "length of 5000 digits": Case(partial(bad_length, stated="9" * 5000)),
    "cut without a length": Case(cut_without_length),
    "cut chunks": Case(cut_chunks),
    "chunk of a huge size": Case(partial(bad_chunk, size=b"FFFFFFFFFFFFFFFF")),
    "chunk of a size that is a word": Case(partial(bad_chunk, size=SECRET.encode())),
    "cut gzip": Case(cut_gzip),
    "text called gzip": Case(no_gzip),
    "unknown encoding": Case(other_encoding),
    "a part": Case(part),
    **{
        f"status {line}": Case(partial(status, line=line))
        for line in (
            *("204 No Content", "203 Non-Authoritative", "304 Not Modified", "400 Bad", f"401 {SECRET}"),
            *(f"403 {SECRET}", "404 Not Found", "416 Range", "429 Too Many", f"500 {SECRET}", "503 Busy", "999 X"),
        )
    },
    "no HTTP": Case(no_http),
    "closes at once": Case(closes),
    **{
        f"moved to {place}": Case(partial(moved, place=place))
        for place in (
            *(
                "http://127.0.0.1:PORT/secret.csv",
                "http://localhost:OWN/secret.csv",
                "//127.0.0.1:PORT/secret.csv",
            ),
            *("https://127.0.0.1:OWN/x", f"http://user:{SECRET}@127.0.0.1:PORT/x", "file:///etc/passwd"),
            *("http://[::1]:OWN/x", "", "http://[bad", "gopher://x", "?endless"),
        )
    },
    "moved for good to the neighbour": Case(
        partial(moved, place="http://127.0.0.1:PORT/secret.csv", line="308 Permanent Redirect")
    ),
    "moved on the same server": Case(moved_here, RIGHT),
    "whole chunks": Case(whole_chunks),
    "whole gzip": Case(whole_gzip),
}
KEPT_OPEN = (moved_here,)


def s3_error(asked: Asked) -> None:
    body = f"<Error><Code>{SECRET}</Code><Message>{SECRET}</Message></Error>".encode()
    asked.send(length(body), body=body, status="500 Internal Server Error")


S3_CASES = {
    name: CASES[name]
    for name in (
        *("endless chunks", "endless until it closes", "ten gigabytes", "endless headers"),
        *("a byte every 5 s", "a byte of a header every 2 s", "silent", "longer length", "cut without a length"),
        *("cut chunks", "closes at once", "no HTTP"),
    )
} | {"error with words": Case(s3_error)}


class Ended(NamedTuple):
    """The end of a command."""

    status: int
    out: str
    err: str
    time_s: float
    peak_mb: float


def score(place: str, **environment: str) -> Ended:
    """Score a dataset in a process of its own, and measure it; it is killed after twice the longest time."""
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        started = time.monotonic()
        command = [sys.executable, "-m", "todframes", "score", place, "--json", "--quiet"]
        process = subprocess.Popen(command, stdout=out, stderr=err, env=os.environ | environment)
        killer = threading.Timer(2 * LONGEST_S, process.kill)
        killer.start()
        _, ended, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(ended)
        killer.cancel()
        time_s = time.monotonic() - started
        out.seek(0)
        err.seek(0)
        return Ended(process.returncode, out.read(), err.read(), time_s, used.ru_maxrss / 1024)


def fault(ended: Ended, case: Case, target: str, right: str) -> str | None:
    """Return what is wrong with the end of a command; None if nothing is."""
    errors = [line for line in ended.err.splitlines() if not line.startswith(("note: ", "warning: "))]
    if SECRET in ended.out + ended.err:
        return f"a secret is shown: {ended.err!r}"
    if ended.time_s > LONGEST_S:
        return f"took {ended.time_s:.0f} s, expected at most {LONGEST_S:g}"
    if ended.peak_mb > MOST_MB[target]:
        return f"took {ended.peak_mb:.0f} MB, expected at most {MOST_MB[target]}"
    if case.expected == RIGHT:
        return (
            None if ended.status == 0 and numbers(ended.out) == right else f"status {ended.status}, {ended.err!r}"
        )
    if DEFECT.search(ended.err):
        return f"a defect: {ended.err!r}"
    is_clear = ended.status in (1, 2) and len(errors) == 1 and errors[0].startswith("error: ") and not ended.out
    return None if is_clear else f"status {ended.status}, {ended.out[-200:]!r}, {ended.err[-600:]!r}"


def numbers(text: str) -> str:
    """Return the numbers of a result, and what it was made from."""
    if not text:
        return text
    result = json.loads(text)
    fits = [[one[name] for name in ("group", "threshold", "threshold_ci95", "points")] for one in result["fits"]]
    return json.dumps([fits, result["skipped"], result["dataset"]["manifest_sha256"]])


def attempts() -> Iterator[tuple[str, str, Case, str]]:
    """Yield the scheme, name, case and target of all attempts."""
    for target in MOST_MB:
        yield from (("http", name, case, target) for name, case in CASES.items())
        yield from (("s3", name, case, target) for name, case in S3_CASES.items())


BOMB = b""
NEIGHBOUR: Server


def campaign(*, only: str = "", n_at_once: int = 4) -> tuple[int, list[str]]:
    """Run all attempts whose name has a text, or all. Returns their number and the faults."""
    import scenes

    global BOMB, NEIGHBOUR
    BOMB = bomb(4000)
    with tempfile.TemporaryDirectory() as folder:
        dataset = Path(folder) / "dataset"
        frames = scenes.write_dataset(dataset, contrasts=(0.05, 0.1, 0.2), repeats=1, noise=0.02)
        (Path(folder) / "secret.csv").write_text(f"{SECRET},{SECRET}\n{SECRET},1\n")
        right = numbers(score(str(dataset)).out)
        faults: list[str] = []

        def attempt(one: tuple[str, str, Case, str]) -> str:
            scheme, name, case, target = one
            file_name = frames[1].rpartition("/")[2] if target == "frame" else target
            with Server(Path(folder), file_name, case.answer) as server:
                place = "s3://dataset" if scheme == "s3" else f"http://127.0.0.1:{server.port}/dataset"
                keys = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": SECRET}
                environment = {**keys, "AWS_ENDPOINT_URL": f"http://127.0.0.1:{server.port}"}
                ended = score(place, **environment)
            found = fault(ended, case, target, right)
            if found:
                faults.append(f"{scheme}, {target}, {name}: {found}")
            how = f"{ended.time_s:.0f} s, {ended.peak_mb:.0f} MB, {ended.err.strip()[-160:]!r}"
            return f"{scheme}, {target}, {name}: {'FAULT ' + found if found else 'as it should'}, {how}"

        wanted = [one for one in attempts() if only in f"{one[0]}, {one[3]}, {one[1]}"]
        with Server(Path(folder), "none", closes) as NEIGHBOUR, ThreadPoolExecutor(n_at_once) as pool:
            for line in pool.map(attempt, wanted):
                print(line, flush=True)
    return len(wanted), faults
