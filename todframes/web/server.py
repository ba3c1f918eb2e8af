"""A local server, from the address that it prints to the signal that ends it."""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import secrets
import socket
import threading
import webbrowser
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

import uvicorn
from starlette.applications import Starlette
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol, RequestResponseCycle
from uvicorn.server import ServerState

from todframes.base import signals
from todframes.base.errors import SettingsError, argument
from todframes.web.guard import LONGEST_HEADERS_BYTES, guarded

MOST_CONNECTIONS = 64
"""Largest number of open connections; a further one ends the one that has waited longest without a request."""

LONGEST_WAIT_S = 10
"""Longest time without a whole request after which a connection is closed."""

LOOK_S = 1.0
"""Interval at which a connection is checked."""

FAREWELL_S = 0.5
"""Time within which unfinished answers must end when the server ends."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Launch:
    """Place where a server listens, and whether the browser is opened there.

    Attributes
    ----------
    host : str
        Address or name of one interface of this machine.
    port : int
        0: a free one is chosen.
    open_browser : bool
    """

    host: str = "127.0.0.1"
    port: int = 0
    open_browser: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.port <= 65535:
            raise SettingsError(f"{argument.port}: found {self.port}, expected a whole number from 0 to 65535")


def serve(
    app: Starlette, launch: Launch, *, tell: Callable[[str], None], warn: Callable[[str], None] | None = None
) -> None:
    """Serve a page to this machine's browser until Ctrl-C, a request to terminate, or the end of the terminal.

    Parameters
    ----------
    app : Starlette
        The page; it is put behind `guarded`. Its lifespan is the time in which the server listens.
    launch : Launch
    tell : function of a text
        Called once with the address, token included, when the server listens.
    warn : function of a text, optional
        Called with a remark if other machines can reach the server.

    Raises
    ------
    SettingsError
        If the host is not one address of this machine, or the port is in use.
    """
    with open_listener(launch) as listener:
        address, port = listener.getsockname()[:2]
        origin = origin_of(launch.host, port)
        if warn is not None and not ipaddress.ip_address(address).is_loopback:
            warn(f"note: other machines can reach {origin}, and others in the network can read what is sent")
        token = secrets.token_urlsafe(32)
        url = f"{origin}/?token={token}"

        async def run() -> None:
            loop, ended = asyncio.get_running_loop(), asyncio.Event()

            def end(*_: object) -> None:
                loop.call_soon_threadsafe(ended.set)

            with signals.handled(end):
                guard = guarded(app, origin=origin, token=token)
                async with app.router.lifespan_context(app), listening(guard, listener):
                    tell(url)
                    if launch.open_browser:
                        threading.Thread(target=open_browser_at, args=[url], daemon=True).start()
                    await ended.wait()

        asyncio.run(run())


@asynccontextmanager
async def listening(app: ASGIApp, listener: socket.socket) -> AsyncIterator[None]:
    """Answer requests while the block runs; after it, end answers that take longer than `FAREWELL_S`."""
    # uvicorn reports as errors what our code does wrong, and answers that are cut off at the end; those are meant.
    log = logging.getLogger("uvicorn.error")
    log.setLevel(logging.ERROR)
    config = uvicorn.Config(
        app,
        ws="none",
        lifespan="off",
        interface="asgi3",
        log_config=None,
        timeout_keep_alive=LONGEST_WAIT_S,
        h11_max_incomplete_event_size=LONGEST_HEADERS_BYTES,
    )
    state = ServerState()
    loop = asyncio.get_running_loop()
    server = await loop.create_server(lambda: _Connection(config, state, {}), sock=listener, backlog=1024)
    try:
        yield
    finally:
        server.close()
        log.setLevel(logging.CRITICAL)
        for connection in list(state.connections):
            connection.shutdown()
        await _finished(state.tasks)
        for connection in list(state.connections):
            connection.transport.abort()
        await asyncio.sleep(0)  # in which they are closed
        await _finished(state.tasks)


async def _finished(tasks: set[asyncio.Task[None]]) -> None:
    if tasks:
        await asyncio.wait(set(tasks), timeout=FAREWELL_S)


class _Connection(H11Protocol):
    """A connection that is closed if no whole request comes for long, or if there are too many others."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.access_log = False  # it would hold the token
        self._waiting_since, self._answered = self.loop.time(), self.cycle
        self._look_again()
        others = [one for one in self.connections if isinstance(one, _Connection) and one is not self]
        others = [one for one in others if not one.transport.is_closing()]
        if len(others) >= MOST_CONNECTIONS and (waiting := [one for one in others if one.waits]):
            min(waiting, key=lambda one: one._waiting_since).transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self._next_look.cancel()
        super().connection_lost(exc)

    @property
    def waits(self) -> bool:
        """True if no request is being answered."""
        cycle: RequestResponseCycle | None = self.cycle  # None before the first request
        return cycle is None or cycle.response_complete

    def _look_again(self) -> None:
        """Note whether a request has come since the last look, and close the connection if none has for long."""
        now = self.loop.time()
        if not self.waits or self.cycle is not self._answered:
            self._waiting_since, self._answered = now, self.cycle
        if now - self._waiting_since > LONGEST_WAIT_S:
            self.transport.abort()
        self._next_look = self.loop.call_later(LOOK_S, self._look_again)


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


def open_listener(launch: Launch) -> socket.socket:
    """Return a socket that listens.

    Raises
    ------
    SettingsError
        If the host is unknown, not of this machine, or stands for all addresses; or if the port is in use.
    """
    host, port = launch.host, launch.port
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError):
        raise SettingsError(
            f"{argument.host}: found {host!r}, expected the address or name of this machine"
        ) from None
    if ipaddress.ip_address(address[0]).is_unspecified:
        raise SettingsError(
            f"{argument.host}: found {host!r}, expected one address: requests that name another host are refused; "
            "give the address by which the browser's machine reaches this one"
        )
    try:
        listener = socket.create_server(address[:2], family=family)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            problem = (
                f"{argument.port}: found {port}, which is in use on {host}; choose another, or leave it out "
                "for a free one"
            )
        elif error.errno == errno.EADDRNOTAVAIL:
            problem = f"{argument.host}: found {host!r}, expected an address of this machine"
        else:
            problem = f"{argument.port}: cannot listen on {host}, port {port} ({error.strerror})"
        raise SettingsError(problem) from None
    # Or each answer waits 40 ms for the acknowledgement of its headers. Connections inherit it; asyncio sets it
    # only where the socket names its protocol.
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener
