"""Fixtures for pages in a real browser: Chromium driven by Playwright, and commands that serve pages.

`conftest.py` loads this module as a plugin, so that `browser` and `open_page` are there for every test;
`serving`, `watched` and `wait_until` are imported from `browser`. Tests skip without Playwright or Chromium.

Playwright's event loop runs in the main thread as long as the browser does, that is for one module: a test of
such a module cannot call `asyncio.run`.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SECONDS_TO_LISTEN = 60.0
"""Longest wait for the line with the URL: a machine that runs other tests beside takes a while to import SciPy."""

SECONDS_TO_END = 20.0

OpenPage = Callable[..., "Page"]


@dataclass(frozen=True)
class Server:
    """A command that serves pages, and the URL that it has printed, token included."""

    url: str
    process: subprocess.Popen[str]

    @property
    def origin(self) -> str:
        return origin_of(self.url)


def origin_of(url: str) -> str:
    """Return scheme, host and port of a URL, as a page's `location.origin` is."""
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc}"


@contextmanager
def serving(*arguments: str | Path, cwd: Path | None = None) -> Iterator[Server]:
    """Run `python -m ARGUMENTS` until the block ends, and wait for the line with its URL.

    If the command ends or is silent instead, the AssertionError has what it wrote to standard error.
    """
    command = [sys.executable, "-m", *map(str, arguments)]
    with (
        tempfile.TemporaryFile("w+", encoding="utf-8") as errors,
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, cwd=cwd) as process,
    ):
        silence = threading.Timer(SECONDS_TO_LISTEN, process.kill)
        silence.start()
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            silence.cancel()
            found = re.search(r"http://\S+", line)
            if found is None:
                process.kill()
                process.wait()
                errors.seek(0)
                raise AssertionError(f"expected a line with a URL, found {line!r} and {errors.read()!r}")
            yield Server(found[0], process)
        finally:
            silence.cancel()
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(SECONDS_TO_END)
                except subprocess.TimeoutExpired:
                    process.kill()


@contextmanager
def watched(
    browser: Browser,
    url: str,
    *,
    width: int = 1280,
    height: int = 900,
    expected_console: Sequence[str] = (),
    script: str = "",
    **context: Any,
) -> Iterator[Page]:
    """Open a URL, token included, in a context of its own, and check at the end that the page has behaved.

    AssertionError if the console had a warning or error other than the patterns of `expected_console`, the page
    threw one, or it asked another origin than that of the URL for anything. Chromium itself reports answers such
    as "status of 422". `script` is run before the page's own; `context` are further options of
    `Browser.new_context`.
    """
    console: list[str] = []
    elsewhere: list[str] = []
    origin = origin_of(url)

    def heard(kind: str, text: str) -> None:
        line = f"{kind}: {text}"
        if kind in ("error", "warning") and not any(re.search(one, line) for one in expected_console):
            console.append(line)

    def asked(address: str) -> None:
        if not address.startswith((f"{origin}/", "data:", f"blob:{origin}/")):
            elsewhere.append(address)

    visit = browser.new_context(viewport={"width": width, "height": height}, **context)
    try:
        visit.on("request", lambda request: asked(request.url))
        visit.on("console", lambda message: heard(message.type, message.text))
        visit.on("weberror", lambda error: heard("error", str(error.error)))
        visit.add_init_script(script)
        page = visit.new_page()
        page.on("websocket", lambda socket: asked(socket.url.replace("ws://", "http://", 1)))
        page.goto(url)
        yield page
        page.evaluate("0")  # what the page has done until now is reported before this answer
    finally:
        visit.close()
    assert not console, f"the console shows {console}"
    assert not elsewhere, f"the page asked elsewhere: {elsewhere}"


def wait_until(page: Page, expression: str, arg: Any = None, *, seconds: float = 60.0) -> Any:
    """Wait until a JavaScript expression or function is true, and return its value.

    `Page.wait_for_function` evaluates texts within the page, which a strict Content-Security-Policy forbids.
    """
    end = time.monotonic() + seconds
    while not (found := page.evaluate(expression, arg)):
        assert time.monotonic() < end, f"{seconds:g} s have passed, and it is not true: {expression} {arg or ''}"
        page.wait_for_timeout(10)
    return found


@contextmanager
def chromium() -> Iterator[Browser]:
    """Run the installed Chromium without a window; skip the test where there is none."""
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="pages are driven by Playwright, of the group dev"
    )
    found = [path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))]
    if not found:
        pytest.skip("no Chromium is installed")
    with playwright.sync_playwright() as play:
        launched = play.chromium.launch(executable_path=found[0], args=["--no-sandbox"])
        yield launched
        launched.close()


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Installed Chromium without a window, one for all tests of a module."""
    with chromium() as launched:
        yield launched


@pytest.fixture
def open_page(browser: Browser) -> Iterator[OpenPage]:
    """Function that opens a URL with the arguments of `watched`; the test fails if a page misbehaves."""
    with ExitStack() as visits:
        yield lambda url, **options: visits.enter_context(watched(browser, url, **options))
