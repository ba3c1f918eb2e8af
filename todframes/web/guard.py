"""The guard before a page: it admits requests of the page itself only, and restricts what the answers may load."""

from __future__ import annotations

import hmac
from urllib.parse import urlsplit

from starlette.datastructures import MutableHeaders
from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

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
