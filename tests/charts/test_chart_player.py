"""Charts in a browser: the player shows the code values of the pages, each for its time.

Skipped where there is no Chromium.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from browser import wait_until

import todframes as tod

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 800, 600


class Seen(NamedTuple):
    """A page on a monitor of its own, what its console has said, and what it has asked for."""

    page: Any
    problems: list[str]
    requests: list[str]


@pytest.fixture
def see(browser) -> Iterator[Callable[..., Seen]]:
    """Function that opens a file on a monitor of a size and ratio."""
    visits = []

    def start(path: Path, width: int = WIDTH, height: int = HEIGHT, **context: Any) -> Seen:
        size = {"width": width, "height": height}
        visits.append(browser.new_context(viewport=size, screen=size, **context))
        page, problems, requests = visits[-1].new_page(), [], []
        page.on("console", lambda message: problems.append(message.text))
        page.on("pageerror", lambda error: problems.append(str(error)))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(path.as_uri())
        return Seen(page, problems, requests)

    yield start
    for one in visits:
        one.close()


def picture(page: Any) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)


@pytest.fixture(scope="module")
def chart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen pages of 0.3 s."""
    folder = tmp_path_factory.mktemp("chart") / "made"
    monitor = {"width_px": WIDTH, "height_px": HEIGHT, "pixel_pitch_mm": 0.25, "page_duration_s": 0.3}
    tod.chart("screen", out=folder, distance_m=10, sizes_mrad=[1, 2], contrasts=[0.004, 0.8], repeats=1, **monitor)
    return folder


def page_pixels(chart: Path, number: int) -> np.ndarray:
    return cv2.imread(str(chart / "pages" / f"{number:04d}.png"), -1)


def test_it_shows_the_pages_pixel_for_pixel_each_for_its_time(chart: Path, see) -> None:
    page, problems, requests = see(chart / "play.html")
    assert not page.evaluate("start.disabled")
    page.keyboard.press("Space")
    wait_until(page, "stage.classList.contains('on') && shown === 0")
    assert page.evaluate("[innerWidth, innerHeight]") == [WIDTH, HEIGHT]
    for number in range(3):
        wait_until(page, f"shown === {number}")
        shown = picture(page)
        for channel in range(3):
            assert np.array_equal(shown[..., channel], page_pixels(chart, number))
        page.keyboard.press("ArrowRight")
    page.evaluate(
        "window.seen = []; const inner = show; show = (number) => { const before = shown; inner(number);"
        " if (shown !== before) seen.push([shown, performance.now()]); }"
    )
    page.keyboard.press("Space")
    wait_until(page, "!stage.classList.contains('on')")
    seen = page.evaluate("seen")
    assert [number for number, _ in seen][-12:] == list(range(4, 16))
    times = np.array([at for _, at in seen[-12:]])
    # Pages change with the browser's frames, of 17 ms, late by one or two on a busy machine, but never run late.
    late = times - times[0] - 300.0 * np.arange(12)
    assert np.abs(late - np.median(late)).max() < 100.0
    assert "left them out" in page.evaluate("element('report').textContent")
    assert problems == []
    assert [url for url in requests if not url.startswith("blob:")] == [(chart / "play.html").as_uri()]


def test_space_pauses_and_escape_ends(chart: Path, see) -> None:
    page = see(chart / "play.html").page
    page.keyboard.press("Space")
    wait_until(page, "shown === 0")
    page.keyboard.press("Space")
    wait_until(page, "shown >= 1")
    page.keyboard.press("Space")
    at = page.evaluate("shown")
    time.sleep(0.7)
    assert page.evaluate("shown") == at
    page.keyboard.press("Space")
    wait_until(page, f"shown > {at}")
    page.keyboard.press("Escape")
    wait_until(page, "!stage.classList.contains('on') && !panel.hidden")


@pytest.mark.parametrize(
    ("screen", "message"),
    [
        ({"device_scale_factor": 1.25}, "takes 1.25 pixels of the monitor"),
        ({"width": 1024, "height": 768}, "has 1024 × 768 pixels, but the chart was made for 800 × 600"),
    ],
)
def test_it_refuses_a_monitor_that_would_resample(chart: Path, see, screen, message: str) -> None:
    page = see(chart / "play.html", **screen).page
    assert page.evaluate("start.disabled")
    assert message in page.evaluate("element('notes').textContent")
    page.keyboard.press("Space")
    time.sleep(0.5)
    assert not page.evaluate("stage.classList.contains('on')")
