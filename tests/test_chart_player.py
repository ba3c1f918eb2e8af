"""Charts in a browser: the player shows the code values of the pages, each for its time; sheets have true size.

Chromium is driven over its debugging pipe. Skipped where there is no Chromium.
"""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import todframes as tod

pytestmark = pytest.mark.slow

WIDTH, HEIGHT = 800, 600


class Browser:
    """A page in Chromium on a monitor of its own."""

    def __init__(self, program: str, folder: Path, *options: str) -> None:
        ours, its = os.pipe(), os.pipe()
        quiet = f"--headless --no-sandbox --disable-gpu --no-first-run --user-data-dir={folder}"
        exchange = (
            f"import os, sys; os.dup2({ours[0]}, 3); os.dup2({its[1]}, 4); os.execv(sys.argv[1], sys.argv[1:])"
        )
        self.process = subprocess.Popen(
            [sys.executable, "-c", exchange, program, *quiet.split(), *options, "--remote-debugging-pipe"],
            pass_fds=(ours[0], its[1]),
            stderr=subprocess.DEVNULL,
        )
        os.close(ours[0])
        os.close(its[1])
        self.to, self.back = ours[1], its[0]
        self.number, self.rest, self.session = 0, b"", None
        self.events: list[dict[str, Any]] = []
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self.number += 1
        message = {"id": self.number, "method": method, "params": parameters}
        if self.session is not None:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        while True:
            while b"\0" not in self.rest:
                assert select.select([self.back], [], [], 30.0)[0], f"no answer to {method}"
                self.rest += os.read(self.back, 1 << 20)
            text, _, self.rest = self.rest.partition(b"\0")
            answer = json.loads(text)
            if answer.get("id") == self.number:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def open(self, page: Path) -> None:
        self.call("Page.navigate", url=page.as_uri())
        self.until("document.readyState === 'complete' && typeof check === 'function'")

    def value(self, expression: str) -> Any:
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, userGesture=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, expression: str, most_s: float = 20.0) -> None:
        end = time.monotonic() + most_s
        while not self.value(expression):
            assert time.monotonic() < end, expression
            time.sleep(0.02)

    def press(self, key: str, code: str) -> None:
        text = {"text": key} if len(key) == 1 else {}
        codes = {"Space": 32, "Escape": 27, "ArrowRight": 39}
        for kind in ("keyDown", "keyUp"):
            self.call(
                "Input.dispatchKeyEvent", type=kind, key=key, code=code, windowsVirtualKeyCode=codes[code], **text
            )

    def picture(self) -> np.ndarray:
        made = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(made, np.uint8), cv2.IMREAD_COLOR)

    def problems(self) -> list[dict[str, Any]]:
        bad = ("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled")
        return [one for one in self.events if one["method"] in bad]

    def requests(self) -> list[str]:
        sent = [one for one in self.events if one["method"] == "Network.requestWillBeSent"]
        return [one["params"]["request"]["url"] for one in sent]

    def end(self) -> None:
        os.close(self.to)
        os.close(self.back)
        self.process.terminate()
        self.process.wait(20)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Any]:
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium")
    started = []

    def start(*options: str) -> Browser:
        started.append(Browser(program, tmp_path / f"profile_{len(started)}", *options))
        return started[-1]

    yield start
    for one in started:
        one.end()


@pytest.fixture(scope="module")
def chart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sixteen pages of 0.3 s."""
    folder = tmp_path_factory.mktemp("chart") / "made"
    monitor = {"width_px": WIDTH, "height_px": HEIGHT, "pixel_pitch_mm": 0.25, "page_duration_s": 0.3}
    tod.chart("screen", out=folder, distance_m=10, sizes_mrad=[1, 2], contrasts=[0.004, 0.8], repeats=1, **monitor)
    return folder


def page_pixels(chart: Path, number: int) -> np.ndarray:
    return cv2.imread(str(chart / "pages" / f"{number:04d}.png"), -1)


SCREEN = (f"--screen-info={{{WIDTH}x{HEIGHT}}}", f"--window-size={WIDTH},{HEIGHT}")


def test_it_shows_the_pages_pixel_for_pixel_each_for_its_time(chart: Path, browser) -> None:
    page = browser(*SCREEN)
    page.open(chart / "play.html")
    assert not page.value("start.disabled")
    page.press(" ", "Space")
    page.until("stage.classList.contains('on') && shown === 0")
    assert page.value("[innerWidth, innerHeight]") == [WIDTH, HEIGHT]
    for number in range(3):
        page.until(f"shown === {number}")
        shown = page.picture()
        for channel in range(3):
            assert np.array_equal(shown[..., channel], page_pixels(chart, number))
        page.press("ArrowRight", "ArrowRight")
    page.value(
        "window.seen = []; const inner = show; show = (number) => { const before = shown; inner(number);"
        " if (shown !== before) seen.push([shown, performance.now()]); }"
    )
    page.press(" ", "Space")
    page.until("!stage.classList.contains('on')")
    seen = page.value("seen")
    assert [number for number, _ in seen][-12:] == list(range(4, 16))
    times = np.array([at for _, at in seen[-12:]])
    # Pages change with the browser's frames, of 17 ms, late by one or two on a busy machine, but never run late.
    late = times - times[0] - 300.0 * np.arange(12)
    assert np.abs(late - np.median(late)).max() < 100.0
    assert "left them out" in page.value("element('report').textContent")
    assert page.problems() == []
    assert [url for url in page.requests() if not url.startswith("blob:")] == [(chart / "play.html").as_uri()]


def test_space_pauses_and_escape_ends(chart: Path, browser) -> None:
    page = browser(*SCREEN)
    page.open(chart / "play.html")
    page.press(" ", "Space")
    page.until("shown === 0")
    page.press(" ", "Space")
    page.until("shown >= 1")
    page.press(" ", "Space")
    at = page.value("shown")
    time.sleep(0.7)
    assert page.value("shown") == at
    page.press(" ", "Space")
    page.until(f"shown > {at}")
    page.press("Escape", "Escape")
    page.until("!stage.classList.contains('on') && !panel.hidden")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((f"--screen-info={{{WIDTH}x{HEIGHT} devicePixelRatio=1.25}}",), "takes 1.25 pixels of the monitor"),
        (
            ("--screen-info={1024x768}",),
            "This monitor has 1024 × 768 pixels, but the chart was made for 800 × 600",
        ),
    ],
)
def test_it_refuses_a_monitor_that_would_resample(chart: Path, browser, options, message: str) -> None:
    page = browser(*options)
    page.open(chart / "play.html")
    assert page.value("start.disabled")
    assert message in page.value("element('notes').textContent")
    page.press(" ", "Space")
    time.sleep(0.5)
    assert not page.value("stage.classList.contains('on')")


@pytest.mark.parametrize("width", [1280, 390])
def test_its_panel_fits_a_desk_and_a_phone(chart: Path, browser, width: int) -> None:
    page = browser(f"--window-size={width},900")
    page.open(chart / "play.html")
    page.call(
        "Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width < 500
    )
    assert page.value("innerWidth") == width
    assert page.value("document.documentElement.scrollWidth") <= width


def test_a_sheet_has_its_true_size(tmp_path: Path, browser) -> None:
    """A browser has 96 pixels an inch."""
    asked = {"distance_m": 10, "sizes_mrad": [3], "contrasts": [0.8], "repeats": 1}
    chart = tod.chart("print", out=tmp_path / "c", **asked)
    mm_per_px = 25.4 / 96.0
    page = browser()
    width, height = (round(side / mm_per_px) for side in (chart.page_width_mm, chart.page_height_mm))
    page.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
    page.call("Page.navigate", url=(tmp_path / "c" / chart.pages[0].file).as_uri())
    page.until("document.readyState === 'complete' && document.documentElement.tagName === 'svg'")
    grey = cv2.cvtColor(page.picture(), cv2.COLOR_BGR2GRAY)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000))
    found, ids, _ = detector.detectMarkers(grey)
    centres = {int(one) % 4: corners[0].mean(axis=0) for one, corners in zip(ids.ravel(), found, strict=True)}
    shown_mm = np.array([centres[k] + 0.5 for k in range(4)]) * mm_per_px
    assert np.abs(shown_mm - chart.markers.centres_mm).max() < mm_per_px
    for one in chart.pages[0].triangles:
        y, x = (np.mgrid[:height, :width] + 0.5) * mm_per_px
        near = np.maximum(np.abs(x - one.x_mm), np.abs(y - one.y_mm)) < 1.1 * one.size_mm
        excess = np.where(near, grey.astype(float) - np.median(grey[near]), 0.0)
        share = excess / excess.max()
        # The browser places edges to a fraction of a pixel, of which √(area) has 113.
        assert np.sqrt(share.sum()) * mm_per_px == pytest.approx(one.size_mm, rel=0.01)
        centroid = [(share * place).sum() / share.sum() for place in (x, y)]
        assert centroid == pytest.approx([one.x_mm, one.y_mm], abs=mm_per_px / 2.0)
