"""Parts of all pages: files from a fixed list, calls with JSON in both directions, errors of one line."""

from __future__ import annotations

import asyncio
import gzip
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import suppress
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import TypeVar

import msgspec
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import Lifespan, Receive, Scope, Send

from todframes.base.errors import SettingsError, TodframesError, in_command
from todframes.base.safe_text import visible

SHARED_FILES = ("base.css", "server.js", "icon.svg", "uplot/uPlot.iife.min.js", "uplot/uPlot.min.css")
"""Files of the folder `static` that all pages may load, as `/static/NAME`."""

CONTENT_TYPES = {
    "css": "text/css; charset=utf-8",
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}

JSON = "application/json"

LEAST_COMPRESSED_BYTES = 4096

T = TypeVar("T")


class EmptyRequest(msgspec.Struct):
    """A request without values: its path is all that it needs."""


def page(folder: Traversable, calls: Sequence[Route], lifespan: Lifespan[Starlette] | None = None) -> Starlette:
    """Return an app that serves the files of a folder and answers calls.

    The files are read now: the path of a request is compared with their names, and never looked up on the disk.

    Parameters
    ----------
    folder : Traversable
        Folder of a package. Its `index.html` is `/`, and the other files are `/static/NAME`.
    calls : sequence of Route
        Usually of `call`.
    lifespan : function, optional
        Makes the context in which the server runs.
    """
    shared = files("todframes.web") / "static"
    routes = [_file(f"/static/{name.rpartition('/')[2]}", shared / name) for name in SHARED_FILES]
    for file in folder.iterdir():
        if file.name.rpartition(".")[2] in CONTENT_TYPES:
            routes.append(_file("/" if file.name == "index.html" else f"/static/{file.name}", file))
    app = Starlette(
        routes=[*routes, *calls],
        lifespan=lifespan,
        exception_handlers={TodframesError: error_answer},
    )
    app.router.redirect_slashes = False
    return app


def _file(path: str, file: Traversable) -> Route:
    content, media_type = file.read_bytes(), CONTENT_TYPES[file.name.rpartition(".")[2]]

    async def endpoint(request: Request) -> Response:
        return _answer(request, content, media_type)

    return Route(path, endpoint)


def _answer(request: Request, content: bytes, media_type: str) -> Response:
    """Return an answer, compressed if it is long and the browser accepts that."""
    if len(content) < LEAST_COMPRESSED_BYTES or "gzip" not in request.headers.get("accept-encoding", ""):
        return Response(content, media_type=media_type)
    small = gzip.compress(content, compresslevel=1, mtime=0)
    return Response(small, media_type=media_type, headers={"Content-Encoding": "gzip"})


def call(path: str, kind: type[T], function: Callable[[T], object]) -> Route:
    """Return the route of a POST whose JSON body is checked against a type, and whose answer is JSON.

    The function runs in a thread. The answer to a `TodframesError` that it raises is that of `error_answer`.
    """
    decoder = msgspec.json.Decoder(kind)

    async def endpoint(request: Request) -> Response:
        asked = _decoded(decoder, await request.body())
        found = await run_in_threadpool(function, asked)
        return _answer(request, json_bytes(found), JSON)

    return Route(path, endpoint, methods=["POST"])


def stream(
    path: str, kind: type[T], function: Callable[[T, Callable[[], bool]], Iterator[object]], executor: Executor
) -> Route:
    """Return the route of a POST whose answer has a line of JSON for each item of an iterator, sent at once.

    Parameters
    ----------
    path : str
    kind : type
        Type of the JSON body.
    function : function
        Takes the body and a function that returns whether the client is still connected; returns the iterator. It
        is called in the event loop, and must not take long.
    executor : Executor
        Computes the items of a request one after the other, in one thread.

    Errors before the first item are answered as by `call`; one that comes later is a line of its own.
    """
    decoder = msgspec.json.Decoder(kind)

    class Stream:
        """An ASGI app, as the response begins only with the first line, and the client may leave before."""

        async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
            asked = _decoded(decoder, await Request(scope, receive).body())
            is_gone = threading.Event()
            watch = asyncio.create_task(_set_when_gone(receive, is_gone))
            try:
                items = function(asked, lambda: not is_gone.is_set())
                await _send_lines(items, executor, send)
            finally:
                is_gone.set()
                watch.cancel()

    return Route(path, Stream(), methods=["POST"])


def _decoded(decoder: msgspec.json.Decoder[T], body: bytes) -> T:
    """Return what the body of a request holds; raise SettingsError if it is not of the decoder's type."""
    try:
        return decoder.decode(body)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise SettingsError(f"the request is not valid: {error}") from None
    except RecursionError:
        raise SettingsError("the request is not valid: nested too deep") from None


async def _set_when_gone(receive: Receive, is_gone: threading.Event) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
    is_gone.set()


async def _send_lines(items: Iterator[object], executor: Executor, send: Send) -> None:
    loop, found = asyncio.get_running_loop(), asyncio.Queue[bytes | None]()

    def work() -> None:
        try:
            for item in items:
                put(json_bytes(item) + b"\n")
        finally:
            put(None)

    def put(line: bytes | None) -> None:
        with suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(found.put_nowait, line)

    async def send_line(line: bytes, *, more: bool = True) -> None:
        await send({"type": "http.response.body", "body": line, "more_body": more})

    computed = loop.run_in_executor(executor, work)
    line = await found.get()
    if line is None:
        await computed  # raises what came before the first line
    headers = [(b"content-type", b"application/x-ndjson")]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    while line is not None:
        await send_line(line)
        line = await found.get()
    try:
        await computed
    except TodframesError as error:
        await send_line(json_bytes(error_of(error)) + b"\n")
    await send_line(b"", more=False)


def json_bytes(value: object) -> bytes:
    """Return a value as JSON; numbers that are not finite become null."""
    return msgspec.json.encode(value)


def error_of(error: Exception) -> dict[str, str | None]:
    """Return the line of an error, and the key of SENSOR.toml that it names, such as "optics.aperture_mm"."""
    with in_command(is_on_page=True):
        line = visible(str(error))
    found = re.search(r"\[(\w+)\]: (\w+)(?:: | is missing)", line) or re.match(r"(\w+)\.(\w+): found ", line)
    return {"error": line, "key": f"{found[1]}.{found[2]}" if found else None}


def error_answer(_: Request, error: Exception) -> Response:
    """Return status 422 and `error_of` the error."""
    return Response(json_bytes(error_of(error)), 422, media_type=JSON)
