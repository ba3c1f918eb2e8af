"""The guard before a page: it admits small requests of the page itself only, and restricts what the answers may
load."""

from __future__ import annotations

import asyncio
import hmac
from collections.abc import Iterable, Mapping
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

MOST_BODY_BYTES = 2**20
"""Largest body of a request."""

MOST_READ_BYTES = 8 * MOST_BODY_BYTES
"""Largest body that is read to its end before it is refused: a browser that is still sending would not see the
answer."""

LONGEST_HEADERS_BYTES = 2**14
"""Largest size of the first line and the headers of a request."""

LONGEST_BODY_S = 10.0
"""Longest time in which the body of a request must have arrived."""

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


class Refusal(Exception):  # noqa: N818 - it is an answer
    """A request that is not passed on: its status, and one line that says why."""

    def __init__(self, status: int, line: str) -> None:
        super().__init__(line)
        self.status, self.line = status, line


def guarded(app: ASGIApp, *, origin: str, token: str) -> ASGIApp:
    """Return an app that passes on only the requests of its own page.

    A request is refused if it names another host: a site whose name leads to this machine would be taken for the
    page. It is refused if it comes from another origin; if it does not bring the token, in the cookie that the
    first visit sets or in the header `X-Token`; or if its body is too large or too slow. A POST has to be JSON
    and, unless it has `X-Token`, to name its origin, so that no form of another site can send it.

    Parameters
    ----------
    app : ASGI app
    origin : str
        Scheme, host and port at which the server listens. For 127.0.0.1, the name localhost is right, too.
    token : str
        Secret of this run. `GET /?token=…` sets the cookie and redirects to `/`.
    """
    address = urlsplit(origin)
    hosts = {address.netloc, address.netloc.removesuffix(":80")}
    if address.hostname == "127.0.0.1":
        hosts |= {host.replace("127.0.0.1", "localhost") for host in hosts}
    # Cookies are shared by all ports of a host; two pages at a time have two cookies.
    cookie = f"todframes-{address.port or 80}"

    async def guard(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        headers, send = Headers(scope=scope), _fenced(send)
        try:
            _check_length(scope)
            _check_source(headers, hosts)
            if (given := _query_token(scope)) is not None:
                _check_token([given], token)
                visit = {"Location": "/", "Set-Cookie": f"{cookie}={token}; HttpOnly; SameSite=Strict; Path=/"}
                await _answer(send, 303, "", visit)
                return
            by_header = headers.getlist("x-token")
            _check_token(by_header or _cookies(headers, cookie), token)
            if scope["method"] not in ("GET", "HEAD"):
                _check_sender(headers, is_known=bool(by_header))
            body = await _body(headers, receive)
        except Refusal as refusal:
            # The rest of the request, if there is any, is not read.
            await _answer(send, refusal.status, refusal.line, {"Connection": "close"})
            return
        await app(scope, _replayed(body, receive), send)

    return guard


def _check_length(scope: Scope) -> None:
    """Raise Refusal if the headers are too long; what comes in one piece has passed the server's own limit."""
    parts = [scope["raw_path"], scope["query_string"], *(part for pair in scope["headers"] for part in pair)]
    if sum(map(len, parts)) > LONGEST_HEADERS_BYTES:
        raise Refusal(431, f"The headers are too long; expected at most {LONGEST_HEADERS_BYTES} bytes.")


def _check_source(headers: Headers, hosts: Iterable[str]) -> None:
    """Raise Refusal if the request names another host, or comes from a page of another origin."""
    host = headers.getlist("host")
    if len(host) != 1 or host[0].lower() not in hosts:
        raise Refusal(403, "This is not the host that this server listens for; open the address that it printed.")
    if any(origin.lower() != f"http://{host[0].lower()}" for origin in headers.getlist("origin")):
        raise Refusal(403, "Pages of other sites may not use this server.")
    if any(site not in ("same-origin", "none") for site in headers.getlist("sec-fetch-site")):
        raise Refusal(403, "Pages of other sites may not use this server; open the address that it printed.")


def _check_token(given: Iterable[str], token: str) -> None:
    """Raise Refusal unless one of the texts is the token; the time does not show how much of it is right."""
    if not any(hmac.compare_digest(one.encode(), token.encode()) for one in given):
        raise Refusal(403, "The token is missing or wrong; open the address that the command has printed.")


def _check_sender(headers: Headers, *, is_known: bool) -> None:
    """Raise Refusal unless the body is JSON, and the sender is known: a form of another site can do neither."""
    if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise Refusal(415, "Expected a body of the type application/json.")
    if not (is_known or "origin" in headers or "sec-fetch-site" in headers):
        raise Refusal(403, "The request does not name its origin.")


def _query_token(scope: Scope) -> str | None:
    """Return the token that the address of a first visit holds; None if it holds none."""
    if scope["method"] != "GET" or scope["path"] != "/":
        return None
    found = dict(parse_qsl(scope["query_string"].decode("latin-1")))
    return found.get("token")


def _cookies(headers: Headers, name: str) -> list[str]:
    found = []
    for line in headers.getlist("cookie"):
        try:
            cookies = SimpleCookie(line)
        except CookieError:
            continue
        if name in cookies:
            found.append(cookies[name].value)
    return found


async def _body(headers: Headers, receive: Receive) -> bytes:
    """Return the whole body of a request.

    Raises
    ------
    Refusal
        If it takes too long or is too large.
    """
    too_large = Refusal(413, f"The body is too large; expected at most {MOST_BODY_BYTES} bytes.")
    length = headers.get("content-length", "0")
    if not length.isdecimal() or int(length[:20]) > MOST_READ_BYTES:
        raise too_large
    body, n_read = bytearray(), 0
    try:
        async with asyncio.timeout(LONGEST_BODY_S):
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    raise Refusal(400, "The connection ended before the request did.")
                part, is_last = message.get("body", b""), not message.get("more_body", False)
                n_read += len(part)
                if n_read <= MOST_BODY_BYTES:
                    body += part
                elif is_last or n_read > MOST_READ_BYTES:
                    raise too_large
                if is_last:
                    return bytes(body)
    except TimeoutError:
        raise Refusal(408, f"The request took longer than {LONGEST_BODY_S:g} s.") from None


def _replayed(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that gives the body first, and then what the connection gives."""
    waiting: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return waiting.pop() if waiting else await receive()

    return replay


def _fenced(send: Send) -> Send:
    """Return a `send` that adds `RESPONSE_HEADERS` to every answer."""

    async def fence(message: Message) -> None:
        if message["type"] == "http.response.start":
            MutableHeaders(scope=message).update(RESPONSE_HEADERS)
        await send(message)

    return fence


async def _answer(send: Send, status: int, line: str, headers: Mapping[str, str]) -> None:
    response = PlainTextResponse(f"{line}\n" if line else "", status, headers)
    await send({"type": "http.response.start", "status": status, "headers": response.raw_headers})
    await send({"type": "http.response.body", "body": response.body})
