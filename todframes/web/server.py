"""A local server: its pages, their calls with JSON in both directions, and the guard before them.

The guard admits requests of the page itself only, and restricts what the answers may load.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import re
import secrets
import socket
import threading
import webbrowser
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from functools import partial
from importlib.resources import files
from importlib.resources.abc import Traversable
from typing import TypeVar
from urllib.parse import urlsplit

import msgspec
import uvicorn
from anyio import to_thread
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Lifespan, Message, Receive, Scope, Send

from todframes.base import signals
from todframes.base.errors import SettingsError, TodframesError, argument, in_command
from todframes.base.safe_text import visible

RESPONSE_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Headers of every answer. With this policy a page loads its own files only, and runs no script written in it."""

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
    connected. It is called in the event loop, and must not take long; the items are computed in a thread. Errors
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
    end = object()
    try:
        while (item := await to_thread.run_sync(next, items, end, abandon_on_cancel=True)) is not end:
            yield msgspec.json.encode(item) + b"\n"
    except TodframesError as error:
        yield msgspec.json.encode(error_of(error)) + b"\n"
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


class PageServer(uvicorn.Server):
    """A server of uvicorn that prints nothing but defects; at its end, answers have a second to finish."""

    def __init__(self, app: ASGIApp) -> None:
        config = uvicorn.Config(
            app,
            http="h11",
            ws="none",
            lifespan="off",
            log_config=None,
            log_level="error",
            access_log=False,  # it would hold the token
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        super().__init__(config)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the server, without a message about answers that are cut off."""
        logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
        await super().shutdown(sockets)


def serve(
    app: Starlette,
    listener: socket.socket,
    *,
    host: str,
    open_browser: bool,
    tell: Callable[[str], None],
    warn: Callable[[str], None] | None = None,
) -> None:
    """Serve a page to this machine's browser until Ctrl-C, a request to terminate, or the end of the terminal. The
    page is put behind `guarded`; its lifespan is the time in which the server runs. The listener, of
    `open_listener`, is closed at the end. `host` is the address or name for the URL of the page, with which, token
    included, `tell` is called once; `warn` is called with a remark if other machines can reach the server.
    """
    address, port = listener.getsockname()[:2]
    origin = origin_of(host, port)
    if warn is not None and not ipaddress.ip_address(address).is_loopback:
        warn(f"note: other machines can reach {origin}, and others in the network can read what is sent")
    token = secrets.token_urlsafe(32)
    url = f"{origin}/?token={token}"
    server = PageServer(guarded(app, origin=origin, token=token))

    def end(*_: object) -> None:
        server.should_exit = True

    async def run() -> None:
        async with app.router.lifespan_context(app):
            tell(url)
            if open_browser:
                threading.Thread(target=open_browser_at, args=[url], daemon=True).start()
            await server.serve([listener])

    # uvicorn itself handles some of the signals, and passes them on here when it has ended.
    with listener, signals.handled(end), in_command(False):
        asyncio.run(run())


def open_browser_at(url: str) -> None:
    """Open the browser of the desktop; one that runs in the terminal would take the terminal."""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return
    if not isinstance(browser, webbrowser.GenericBrowser) or isinstance(browser, webbrowser.BackgroundBrowser):
        browser.open(url)


def origin_of(host: str, port: int) -> str:
    """Return scheme, host and port as they are written in a URL."""
    return f"http://{f'[{host}]' if ':' in host else host.lower()}:{port}"


def open_listener(host: str = "127.0.0.1", port: int = 0) -> socket.socket:
    """Return a socket that listens at an address or name of this machine; port 0 is a free one. Raises
    SettingsError if the host is not of this machine or stands for all addresses, or the port is in use.
    """
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        is_all = ipaddress.ip_address(address[0]).is_unspecified
        listener = None if is_all else socket.create_server(address[:2], family=family)
    except (OSError, UnicodeError) as error:
        raise SettingsError(
            f"cannot listen at {argument.host} {host!r}, {argument.port} {port} ({error}); expected an address or "
            "name of this machine, and a port that is free"
        ) from None
    if listener is None:
        raise SettingsError(
            f"{argument.host}: found {host!r}, expected one address: requests that name another host are refused; "
            "give the address by which the browser's machine reaches this one"
        )
    # Or each answer waits 40 ms for the acknowledgement of its headers. Connections inherit it; asyncio sets it
    # only where the socket names its protocol.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def guarded(app: ASGIApp, *, origin: str, token: str) -> ASGIApp:
    """Return an app that passes on only the requests of its own page.

    A request is refused if it names another host: a site whose name leads to this machine would be taken for the
    page. It is refused if it comes from another origin; or if it does not bring the token, the secret of this run,
    in the cookie that the first visit, `GET /?token=…`, sets or in the header `X-Token`. A POST has to be JSON,
    which no form of another site can send. `origin` is the scheme, host and port at which the server listens; for
    127.0.0.1, the name localhost is right, too.
    """
    address = urlsplit(origin)
    # Starlette's TrustedHostMiddleware does not check the port, and its older versions refuse IPv6.
    hosts = {address.netloc, address.netloc.removesuffix(":80")}
    if address.hostname == "127.0.0.1":
        hosts |= {host.replace("127.0.0.1", "localhost") for host in hosts}
    # Cookies are shared by all ports of a host; two pages at a time have two cookies.
    cookie = f"todframes-{address.port or 80}"

    def answered(request: Request) -> Response | None:
        """Return the answer to a refused request or to a first visit; None if the app has to answer."""
        headers = request.headers
        host = headers.get("host", "").lower()
        if host not in hosts:
            return _line(403, "This server listens for another host; open the address that it has printed.")
        own, site = f"http://{host}", headers.get("sec-fetch-site", "none")
        if headers.get("origin", own).lower() != own or site not in ("same-origin", "none"):
            return _line(403, "Other sites may not use this server; open the address that it has printed.")
        visit = request.query_params.get("token")
        given = visit or headers.get("x-token") or request.cookies.get(cookie, "")
        if not hmac.compare_digest(given.encode(), token.encode()):
            return _line(403, "The token is missing or wrong; open the address that this server has printed.")
        if visit:
            answer = RedirectResponse("/", 303)
            answer.set_cookie(cookie, token, httponly=True, samesite="strict")
            return answer
        kind = headers.get("content-type", "").partition(";")[0].strip().lower()
        if request.method not in ("GET", "HEAD") and kind != "application/json":
            return _line(415, "Expected a body of the type application/json.")
        return None

    async def guard(scope: Scope, receive: Receive, send: Send) -> None:
        async def fenced(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(RESPONSE_HEADERS)
            await send(message)

        await (answered(Request(scope)) or app)(scope, receive, fenced)

    return guard


def _line(status: int, text: str) -> Response:
    return PlainTextResponse(f"{text}\n", status)
