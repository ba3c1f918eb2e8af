"""The fixtures of the browser's tests notice a page that misbehaves."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from browser import Server, serving, watched

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server of one page that asks for nothing."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "quiet.html").write_text('<!DOCTYPE html><link rel="icon" href="data:,"><p>quiet', encoding="utf-8")
    program = (
        "import http.server, sys\n"
        "server = http.server.ThreadingHTTPServer(('127.0.0.1', 0), http.server.SimpleHTTPRequestHandler)\n"
        "print(f'http://127.0.0.1:{server.server_port}/', flush=True)\n"
        "server.serve_forever()\n"
    )
    (folder / "files.py").write_text(program, encoding="utf-8")
    with serving("files", cwd=folder) as server:
        yield server


def test_a_quiet_page_passes(files: Server, open_page) -> None:
    page = open_page(f"{files.url}quiet.html", width=390, height=844)
    assert page.evaluate("[innerWidth, location.origin]") == [390, files.origin]


@pytest.mark.parametrize(
    ("script", "complaint"),
    [
        ("console.error('trouble')", "error: trouble"),
        ("console.warn('doubt')", "warning: doubt"),
        ("setTimeout(() => { throw Error('uncaught'); })", "uncaught"),
        ("fetch('missing.txt').then((answer) => answer.text())", "status of 404"),
    ],
)
def test_what_the_console_shows_fails_the_test(browser, files: Server, script: str, complaint: str) -> None:
    with pytest.raises(AssertionError, match=f"the console shows.*{complaint}"):  # noqa: SIM117
        with watched(browser, f"{files.url}quiet.html") as page:
            page.evaluate(
                f"async () => {{ await ({script}); await new Promise((done) => setTimeout(done, 50)); }}"
            )
    with watched(browser, f"{files.url}quiet.html", expected_console=[complaint]) as page:
        page.evaluate(f"async () => {{ await ({script}); }}")


def test_a_request_elsewhere_fails_the_test(browser, files: Server) -> None:
    elsewhere = "http://127.0.0.1:9/x.png"
    expected = ["ERR_UNSAFE_PORT", "ERR_CONNECTION_REFUSED"]
    with pytest.raises(AssertionError, match=f"asked elsewhere: .'{elsewhere}'"):  # noqa: SIM117
        with watched(browser, f"{files.url}quiet.html", expected_console=expected) as page:
            page.evaluate(
                f"new Promise((done) => {{ const i = new Image(); i.onerror = done; i.src = '{elsewhere}'; }})"
            )
