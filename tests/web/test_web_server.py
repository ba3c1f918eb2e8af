"""The local server refuses what does not come from its own page, and stays there for those that do."""

from __future__ import annotations

import http.client
import json
import re
import socket
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import msgspec
import pytest

from todframes.base.errors import DataError, SettingsError, argument, in_command
from todframes.web import check_installed, server
from todframes.web.server import (
    MOST_BODY_BYTES,
    RESPONSE_HEADERS,
    PageServer,
    call,
    guarded,
    open_listener,
    origin_of,
    page,
    serve,
    stream,
)

TOKEN = "the-token-of-this-run"
JSON = {"Content-Type": "application/json"}
PATIENCE_S = 5.0


class Named(msgspec.Struct):
    name: str


@dataclass
class Running:
    """A server of this process, and the events by which a test follows what it computes."""

    port: int
    address: str = "127.0.0.1"
    server: PageServer = field(init=False)
    begun: threading.Event = field(default_factory=threading.Event)
    left: threading.Event = field(default_factory=threading.Event)

    @property
    def origin(self) -> str:
        return origin_of(self.address, self.port)

    @property
    def host(self) -> str:
        return self.origin.removeprefix("http://")

    def ask(
        self, method: str, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None
    ) -> tuple[int, http.client.HTTPMessage, bytes]:
        """Return status, headers and body of an answer; with the token unless headers are given."""
        connection = http.client.HTTPConnection(self.address, self.port, timeout=PATIENCE_S)
        has_host = headers is not None and "Host" in headers
        connection.putrequest(method, path, skip_host=has_host, skip_accept_encoding=True)
        for name, value in ({"X-Token": TOKEN} | JSON if headers is None else headers).items():
            connection.putheader(name, value)
        if body is not None:
            connection.putheader("Content-Length", str(len(body)))
        connection.endheaders(body)
        with connection.getresponse() as answer:
            found = answer.status, answer.headers, answer.read()
        connection.close()
        return found

    def raw(self, request: bytes) -> bytes:
        """Return all that the server sends for some bytes, until it closes the connection."""
        with socket.create_connection(("127.0.0.1", self.port), PATIENCE_S) as plug:
            plug.sendall(request)
            return b"".join(iter(lambda: plug.recv(65536), b""))


def app_of(running: Running) -> object:
    def greet(asked: Named) -> dict[str, str]:
        if asked.name == "nobody":
            raise DataError("[greeting]: name: found 'nobody', expected \x1b[31msomebody")
        return {"hello": asked.name}

    def count(asked: Named, is_connected: Callable[[], bool]) -> Iterator[int]:
        if asked.name == "nobody":
            raise DataError("found nobody")

        def numbers() -> Iterator[int]:
            yield 1
            running.begun.set()
            if asked.name == "error":
                raise DataError("found no more")
            while asked.name == "endless" and is_connected():
                time.sleep(0.002)
            running.left.set()
            yield 2

        return numbers()

    calls = [call("/api/greet", Named, greet), stream("/api/count", Named, count)]
    return page(files("todframes.web") / "static", calls)


@contextmanager
def running_server(address: str = "127.0.0.1") -> Iterator[Running]:
    with open_listener(address) as listener:
        running = Running(listener.getsockname()[1], address)
        running.server = PageServer(guarded(app_of(running), origin=running.origin, token=TOKEN))
        thread = threading.Thread(target=running.server.run, args=[[listener]])
        thread.start()
        try:
            yield running
        finally:
            running.server.should_exit = True
            thread.join(PATIENCE_S)


@pytest.fixture(scope="module")
def running() -> Iterator[Running]:
    with running_server() as one:
        yield one


def body_of(name: str) -> bytes:
    return json.dumps({"name": name}).encode()


REFUSED = {
    "another host": ({"Host": "evil.example"}, 403),
    "a name that leads to this machine": ({"Host": "127.0.0.1.evil.example"}, 403),
    "another port": ({"Host": "127.0.0.1:1"}, 403),
    "another origin": ({"Origin": "http://evil.example"}, 403),
    "the same host as an origin of another scheme": ({"Origin": "https://127.0.0.1:{port}"}, 403),
    "another site": ({"Sec-Fetch-Site": "cross-site"}, 403),
    "no token": ({"X-Token": None}, 403),
    "the first part of the token": ({"X-Token": TOKEN[:-1]}, 403),
    "the token and more": ({"X-Token": TOKEN + "x"}, 403),
    "a token with letters beyond ASCII": ({"X-Token": "\xe9"}, 403),
    "a cookie of another page": ({"X-Token": None, "Cookie": f"todframes-1={TOKEN}"}, 403),
    "a form": ({"Content-Type": "application/x-www-form-urlencoded"}, 415),
    "plain text, which another site may send unasked": ({"Content-Type": "text/plain"}, 415),
}


@pytest.mark.parametrize(("changed", "status"), REFUSED.values(), ids=REFUSED)
def test_requests_that_do_not_come_from_the_page_are_refused(running, changed, status):
    headers = {"Host": running.host, "X-Token": TOKEN, **JSON}
    assert running.ask("POST", "/api/greet", body_of("you"), headers)[0] == 200
    for name, value in changed.items():
        headers[name] = value and value.replace("{port}", str(running.port))
    headers = {name: value for name, value in headers.items() if value is not None}
    found, answer, body = running.ask("POST", "/api/greet", body_of("you"), headers)
    assert found == status
    assert body.count(b"\n") == 1 and b"you" not in body
    assert "access-control-allow-origin" not in answer


def test_two_hosts_and_none_are_refused(running):
    for hosts in (f"Host: {running.host}\r\nHost: evil.example\r\n", ""):
        answer = running.raw(f"GET / HTTP/1.1\r\n{hosts}X-Token: {TOKEN}\r\nConnection: close\r\n\r\n".encode())
        assert answer.startswith(b"HTTP/1.1 400")
    answer = running.raw(f"GET / HTTP/1.0\r\nX-Token: {TOKEN}\r\n\r\n".encode())
    assert answer.startswith(b"HTTP/1.1 403")


def test_a_first_visit_gets_a_cookie_that_only_this_page_has(running, caplog):
    status, answer, body = running.ask("GET", f"/?token={TOKEN}", headers={"Host": running.host})
    assert (status, answer["location"], body) == (303, "/", b"")
    assert TOKEN not in caplog.text
    cookie, *attributes = answer["set-cookie"].split("; ")
    assert {"HttpOnly", "SameSite=strict"} <= set(attributes)
    of_page = {"Host": running.host, "Cookie": f"other=1; {cookie}"}
    assert running.ask("GET", "/static/server.js", headers=of_page)[0] == 200
    posted = {**of_page, **JSON, "Origin": running.origin}
    assert running.ask("POST", "/api/greet", body_of("you"), posted)[2] == b'{"hello":"you"}'
    localhost = of_page | {"Host": f"localhost:{running.port}"}
    assert running.ask("GET", "/static/server.js", headers=localhost)[0] == 200


@pytest.mark.parametrize("token", ["", TOKEN[:-1], TOKEN + "x", f"wrong&token={TOKEN}x"])
def test_a_first_visit_with_a_wrong_token_gets_no_cookie(running, token):
    status, answer, _ = running.ask("GET", f"/?token={token}", headers={"Host": running.host})
    assert (status, answer["set-cookie"]) == (403, None)


PATHS = [
    "/../pyproject.toml",
    "/static/%2e%2e/pages.py",
    "/static/%252e%252e/pages.py",
    "//etc/passwd",
    "/static/uplot/LICENSE",
    "/static/base.css%00.html",
    "/%c0%ae%c0%ae/pages.py",
    "http://127.0.0.1/static/base.css",
]


@pytest.mark.parametrize("path", PATHS)
def test_only_listed_files_are_served(running, path):
    request = f"GET {path} HTTP/1.1\r\nHost: {running.host}\r\nX-Token: {TOKEN}\r\nConnection: close\r\n\r\n"
    assert running.raw(request.encode()).startswith(b"HTTP/1.1 404")


def test_the_shared_files_are_those_of_the_package(running):
    folder = Path(server.__file__).parent / "static"
    for name in ("base.css", "server.js", "icon.svg", "uplot/uPlot.iife.min.js", "uplot/uPlot.min.css"):
        path = f"/static/{name.rpartition('/')[2]}"
        for asked in (path, path.replace("s", "%73").replace(".", "%2E")):  # percent-encoding is undone, once
            status, answer, body = running.ask("GET", asked)
            assert (status, body) == (200, (folder / name).read_bytes())
            assert answer["content-type"].startswith(("text/css", "text/javascript", "image/svg+xml"))
            assert running.ask("GET", asked, headers={"Host": running.host})[0] == 403


def test_every_answer_is_fenced_in(running):
    asked = {
        200: ("POST", "/api/greet", body_of("you"), None),
        303: ("GET", f"/?token={TOKEN}", None, {"Host": running.host}),
        403: ("GET", "/", None, {"Host": running.host}),
        404: ("GET", "/nothing", None, None),
        405: ("GET", "/api/greet", None, None),
        422: ("POST", "/api/greet", body_of("nobody"), None),
    }
    for status, request in asked.items():
        found, answer, _ = running.ask(*request)
        assert found == status
        assert {name: answer[name] for name in RESPONSE_HEADERS} == RESPONSE_HEADERS
        assert answer["server"] is None
    text = RESPONSE_HEADERS["Content-Security-Policy"]
    policy = dict(part.strip().split(" ", 1) for part in text.split(";"))
    assert policy["default-src"] == "'none'" and policy["script-src"] == "'self'"
    assert "unsafe" not in text and "*" not in text


def test_a_body_may_be_large_but_not_too_large(running):
    room = MOST_BODY_BYTES - len(body_of(""))
    status, _, body = running.ask("POST", "/api/greet", body_of("x" * room))
    assert (status, len(body)) == (200, MOST_BODY_BYTES - len(b'{"name": ""}') + len(b'{"hello":""}'))
    assert running.ask("POST", "/api/greet", body_of("x" * (room + 1)))[0] == 413


HEAD = "POST /api/greet HTTP/1.1\r\nHost: {host}\r\nX-Token: {token}\r\nContent-Type: application/json\r\n"


def test_a_body_without_end_is_refused_as_soon_as_it_is_too_large(running):
    head = HEAD.format(host=running.host, token=TOKEN).encode() + b"Transfer-Encoding: chunked\r\n\r\n"
    chunk = b"10000\r\n" + b" " * 2**16 + b"\r\n"
    with socket.create_connection(("127.0.0.1", running.port), PATIENCE_S) as plug:
        plug.sendall(head + chunk * (MOST_BODY_BYTES // 2**16))
        plug.setblocking(False)
        with pytest.raises(BlockingIOError):
            plug.recv(1)  # so far it may go on
        plug.settimeout(PATIENCE_S)
        plug.sendall(b"1\r\n \r\n")  # there is no end, so nothing but the size can be the reason
        assert plug.recv(12) == b"HTTP/1.1 413"


def test_who_leaves_within_a_request_leaves_no_traceback(running, caplog):
    with socket.create_connection(("127.0.0.1", running.port), PATIENCE_S) as plug:
        plug.sendall((HEAD.format(host=running.host, token=TOKEN) + "Content-Length: 10\r\n\r\n{").encode())
    assert running.ask("POST", "/api/greet", body_of("you"))[0] == 200
    assert not caplog.records


def test_errors_are_one_line_with_the_key(running):
    status, _, body = running.ask("POST", "/api/greet", body_of("nobody"))
    line = "[greeting]: name: found 'nobody', expected \\x1b[31msomebody"
    assert (status, json.loads(body)) == (422, {"error": line, "key": "greeting.name"})
    for wrong in (b"", b"{", b'{"name": 1}', b"[" * 10**5, b'{"x":' + b"[" * 10**5, b'{"name": "\xff"}'):
        status, _, body = running.ask("POST", "/api/greet", wrong)
        assert status == 422
        assert json.loads(body)["error"].startswith("the request is not valid: ")


def lines_of(running: Running, name: str) -> tuple[int, list[object]]:
    status, _, body = running.ask("POST", "/api/count", body_of(name))
    return status, [json.loads(line) for line in body.splitlines()]


def test_lines_are_sent_one_by_one_and_errors_among_them(running):
    assert lines_of(running, "two") == (200, [1, 2])
    assert lines_of(running, "nobody") == (422, [{"error": "found nobody", "key": None}])
    assert lines_of(running, "error") == (200, [1, {"error": "found no more", "key": None}])


def test_who_leaves_ends_the_computing_and_others_are_answered_meanwhile(running):
    running.begun.clear()
    running.left.clear()
    connection = http.client.HTTPConnection("127.0.0.1", running.port, timeout=PATIENCE_S)
    headers = {"X-Token": TOKEN, **JSON, "Accept-Encoding": "gzip"}
    connection.request("POST", "/api/count", body_of("endless"), headers)
    answer = connection.getresponse()
    assert answer.readline() == b"1\n"  # sent, though the computing goes on
    assert running.begun.wait(PATIENCE_S)
    assert running.ask("POST", "/api/greet", body_of("you"))[0] == 200
    assert not running.left.is_set()
    answer.close()
    connection.close()
    assert running.left.wait(PATIENCE_S)


def test_the_end_does_not_wait_for_who_listens(caplog):
    with running_server() as one:
        one.server.config.timeout_graceful_shutdown = 0
        connection = http.client.HTTPConnection("127.0.0.1", one.port, timeout=PATIENCE_S)
        connection.request("POST", "/api/count", body_of("endless"), {"X-Token": TOKEN, **JSON})
        answer = connection.getresponse()
        assert one.begun.wait(PATIENCE_S)
    assert one.left.wait(PATIENCE_S)
    with answer, pytest.raises((ConnectionError, http.client.IncompleteRead)):
        answer.read()
    connection.close()
    assert not caplog.records


def test_a_port_in_use_and_hosts_that_are_no_address_of_this_machine_are_refused():
    with open_listener() as other:
        port = other.getsockname()[1]
        with pytest.raises(SettingsError, match=rf"^cannot listen at host '127.0.0.1', port {port} \(.* in use"):
            open_listener(port=port)
    for host, problem in {
        "no-such-host.invalid": r"\(.*expected an address or name of this machine",
        "0.0.0.0": "expected one address",
        "::": "expected one address",
        "192.0.2.1": r"\(.*expected an address or name of this machine",
    }.items():
        with pytest.raises(SettingsError, match=rf"'{re.escape(host)}'.*{problem}"):
            open_listener(host)


def test_addresses_of_the_newer_internet_protocol_are_listened_at():
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        pytest.skip("this machine has no IPv6")
    with running_server("::1") as one:
        assert one.origin == f"http://[::1]:{one.port}"
        posted = {"Host": one.host, "Origin": one.origin, "X-Token": TOKEN, **JSON}
        assert one.ask("POST", "/api/greet", body_of("you"), posted)[0] == 200
        assert one.ask("POST", "/api/greet", body_of("you"), posted | {"Host": "[::1]"})[0] == 403


class TerminalBrowser(webbrowser.GenericBrowser):
    def open(self, *_: object) -> None:
        raise AssertionError("it takes the terminal")


def test_the_browser_is_that_of_the_desktop(monkeypatch):
    opened: list[str] = []
    desktop = SimpleNamespace(open=opened.append)
    for browser in (desktop, TerminalBrowser("lynx"), webbrowser.Error("could not locate runnable browser")):
        monkeypatch.setattr(webbrowser, "get", Mock(side_effect=[browser]))
        server.open_browser_at("http://127.0.0.1:1/")
    assert opened == ["http://127.0.0.1:1/"]


def test_without_the_extra_there_is_one_line(monkeypatch):
    check_installed("explore")
    monkeypatch.setattr("todframes.web.find_spec", lambda name: None if name == "uvicorn" else name)
    with pytest.raises(SettingsError, match=r"^explore: needs the package uvicorn.*install 'todframes\[web\]'$"):
        check_installed("explore")


def test_the_page_of_a_command_names_its_fields() -> None:
    """It has no options."""

    def tell(_: str) -> None:
        raise SettingsError(f"{argument.size_detectors}: found 300")

    app = app_of(Running(1, "127.0.0.1"))
    with in_command(), open_listener("127.0.0.1") as listener:
        with pytest.raises(SettingsError, match=r"^size_detectors: found 300$"):
            serve(app, listener, host="127.0.0.1", open_browser=False, tell=tell)
        assert argument.size_detectors == "--size-detectors"
