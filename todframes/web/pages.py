"""Parts of all pages: their files, calls with JSON in both directions, errors of one line."""

from __future__ import annotations

import asyncio
import re
import threading
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from functools import partial
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import TypeVar

import msgspec
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route
from starlette.types import Lifespan

from todframes.base.errors import SettingsError, TodframesError
from todframes.base.safe_text import visible

CONTENT_TYPES = {
    "css": "text/css; charset=utf-8",
    "html": "text/html; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}

MOST_BODY_BYTES = 2**20
"""Largest body of a request."""

LEAST_COMPRESSED_BYTES = 4096

T = TypeVar("T")


class EmptyRequest(msgspec.Struct):
    """A request without values: its path is all that it needs."""


def page(folder: Traversable, calls: Sequence[Route], lifespan: Lifespan[Starlette] | None = None) -> Starlette:
    """Return an app that serves the files of a package's folder, those that all pages share, and calls.
    `index.html` is `/`, and the other files are `/static/NAME`. The files are read now: the path of a request is
    compared with their names, and never looked up on the disk. `lifespan` makes the context in which the server
    runs.
    """
    shared = files("todframes.web") / "static"
    routes = list(calls)
    for file in (*shared.iterdir(), *(shared / "uplot").iterdir(), *folder.iterdir()):
        if (media_type := CONTENT_TYPES.get(file.name.rpartition(".")[2])) is not None:
            path = "/" if file.name == "index.html" else f"/static/{file.name}"
            routes.append(Route(path, partial(_file, file.read_bytes(), media_type)))
    compression = Middleware(GZipMiddleware, minimum_size=LEAST_COMPRESSED_BYTES, compresslevel=1)
    handlers = {
        TodframesError: error_answer,
        ClientDisconnect: lambda *_: Response(status_code=400),  # in place of a traceback in the terminal
    }
    return Starlette(routes=routes, middleware=[compression], lifespan=lifespan, exception_handlers=handlers)


async def _file(content: bytes, media_type: str, _: Request) -> Response:
    return Response(content, media_type=media_type)


def call(path: str, kind: type[T], function: Callable[[T], object]) -> Route:
    """Return the route of a POST whose JSON body is checked against a type, and whose answer is JSON. The function
    runs in a thread. The answer to a `TodframesError` that it raises is that of `error_answer`.
    """
    decoder = msgspec.json.Decoder(kind)

    async def endpoint(request: Request) -> Response:
        asked = await _decoded(request, decoder)
        return json_answer(await run_in_threadpool(function, asked))

    return Route(path, endpoint, methods=["POST"])


def stream(path: str, kind: type[T], function: Callable[[T, Callable[[], bool]], Iterator[object]]) -> Route:
    """Return the route of a POST whose answer has a line of JSON for each item of an iterator, sent at once. The
    function takes the body, checked against a type, and a function that returns whether the client is still
    connected. It is called in the event loop, and must not take long; the items are computed in one thread. Errors
    of the function are answered as by `call`; one that an item raises is a line of its own.
    """
    decoder = msgspec.json.Decoder(kind)

    async def endpoint(request: Request) -> Response:
        asked = await _decoded(request, decoder)
        is_gone = threading.Event()
        lines = _lines(function(asked, lambda: not is_gone.is_set()), is_gone)
        # With an encoding of its own it is not compressed, which would hold lines back.
        headers = {"Content-Encoding": "identity"}
        return StreamingResponse(lines, media_type="application/x-ndjson", headers=headers)

    return Route(path, endpoint, methods=["POST"])


async def _lines(items: Iterator[object], is_gone: threading.Event) -> AsyncIterator[bytes]:
    """Yield a line of JSON for each item; set the event when nobody asks for further lines."""
    loop, computed = asyncio.get_running_loop(), asyncio.Queue[object]()

    def put(item: object) -> None:
        loop.call_soon_threadsafe(computed.put_nowait, item)

    def compute() -> None:
        try:
            for item in items:
                put(item)
        except TodframesError as error:
            put(error_of(error))
        finally:
            put(None)

    computing = loop.run_in_executor(None, compute)
    try:
        while (item := await computed.get()) is not None:
            yield msgspec.json.encode(item) + b"\n"
        await computing  # raises a defect
    finally:
        is_gone.set()


async def _decoded(request: Request, decoder: msgspec.json.Decoder[T]) -> T:
    """Return what the body of a request holds. Raises SettingsError if it is not of the decoder's type;
    HTTPException if it is too large.
    """
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > MOST_BODY_BYTES:
            raise HTTPException(413, f"The body is too large; expected at most {MOST_BODY_BYTES} bytes.")
    try:
        return decoder.decode(body)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise SettingsError(f"the request is not valid: {error}") from None
    except RecursionError:
        raise SettingsError("the request is not valid: nested too deep") from None


def json_answer(value: object, status: int = 200) -> Response:
    """Return an answer in JSON; numbers that are not finite become null."""
    return Response(msgspec.json.encode(value), status, media_type="application/json")


def error_of(error: Exception) -> dict[str, str | None]:
    """Return the line of an error, and the key of SENSOR.toml that it names, such as "optics.aperture_mm"."""
    line = visible(str(error))
    found = re.search(r"\[(\w+)\]: (\w+)(?:: | is missing)", line) or re.match(r"(\w+)\.(\w+): found ", line)
    return {"error": line, "key": f"{found[1]}.{found[2]}" if found else None}


def error_answer(_: Request, error: Exception) -> Response:
    """Return status 422 and `error_of` the error."""
    return json_answer(error_of(error), 422)
