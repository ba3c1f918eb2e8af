"""The page of the experiment as a simulated person goes through it, in a browser of `browser.py`."""

from __future__ import annotations

import csv
import json
import socket
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from browser import serving, wait_until

CODE = 186
"""Code value that the person matches with the half-tone: as bright as half of white."""
KEYS = {"up": "ArrowUp", "right": "ArrowRight", "down": "ArrowDown", "left": "ArrowLeft"}
# A page asks again each second, until its server is back: that one has another token.
UNREACHABLE = ["net::ERR_", "status of 403"]
NEXT = """async () => {
  const begin = performance.now();
  for (; performance.now() < begin + 30000; await new Promise((done) => setTimeout(done))) {
    const found = document.querySelector("#stage[data-trial], #pause:not([hidden]), #done:not([hidden])");
    if (found) return found.dataset.trial ?? found.id;
  }
}"""
# The next triangle of the check may point the same way.
NEXT_TRIANGLE = """void (window.nextTriangle = new Promise((done) => new MutationObserver(() => done())
  .observe(document.getElementById("check-triangle"), { attributes: true })))"""
# A person needs the pauses between trials, and the time to read "Correct"; this one does not.
HURRY = "const wait = setTimeout; window.setTimeout = (call, time) => wait(call, time < 1000 ? 0 : time);"


def experiment(dataset: Path, answers: Path, *options: object) -> Any:
    return serving("todframes", "experiment", dataset, "-o", answers, "--no-browser", *map(str, options))


def measure_monitor(page: Any, *, drag_px: int | None = None, photometer: bool = False) -> None:
    """Go through the screens of the monitor, by keyboard or with a pointer, the instructions and the check."""
    page.wait_for_selector("#size:not([hidden])")
    edge = page.locator("#card-edge")
    if drag_px is None:
        edge.focus()
        page.keyboard.press("PageUp")
        page.keyboard.press("ArrowLeft")
    else:
        box = edge.bounding_box()
        page.mouse.move(box["x"] + box["width"] - 1, box["y"] + 20)
        page.mouse.down()
        page.mouse.move(page.locator("#card").bounding_box()["x"] + drag_px, box["y"] + 40)
        page.mouse.up()
    for screen in ("size", "distance", "gamma", *(["photometer"] * photometer), "instructions"):
        page.wait_for_selector(f"#{screen}:not([hidden])")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        if screen == "gamma":
            page.fill("#gamma-code", str(CODE))
            half_tone = pixels_of(page, "#half-tone", screenshot(page))
            assert (half_tone[::2, 0] == 0).all() and (half_tone[1::2, 0] == 255).all()
            assert half_tone[120, 120] == CODE
        if screen == "photometer":
            read_photometer(page)
        page.click(f"#{screen} {'.more' if screen == 'gamma' and photometer else '.next'}")
    understand(page)


def understand(page: Any) -> None:
    """Answer the four triangles of the check, the second one wrongly at first."""
    page.wait_for_selector("#check:not([hidden])")
    directions = []
    for number in range(6):
        direction = page.get_attribute("#check-triangle", "data-direction")
        directions.append(direction)
        if number == 1:
            wrong = next(one for one in KEYS if one != direction)
            page.evaluate(NEXT_TRIANGLE)
            page.click(f"#check [data-response={wrong}]")
            wait_until(page, f"document.getElementById('check-said').textContent.includes('points {direction}')")
            page.evaluate("window.nextTriangle")
        else:
            page.keyboard.press(KEYS[direction])
            is_next = f"document.getElementById('check-triangle').dataset.direction !== '{direction}'"
            wait_until(page, is_next if number < 5 else "document.getElementById('check').hidden")
    assert sorted(directions[2:]) == sorted(KEYS)
    page.wait_for_selector("#check", state="hidden")


def read_photometer(page: Any) -> None:
    """Type readings of a monitor with a gamma of 2.2 and 100 cd/m², after a slip that the server refuses."""
    for code in (0, 64, 160, 255):
        field = page.locator(f"[data-code='{code}']")
        field.focus()
        assert (pixels_of(page, "#patch", screenshot(page)) == code).all()
        field.fill(str(100.0 * (code / 255) ** 2.2 if code < 255 else 1.0))
    page.click("#photometer .next")
    page.wait_for_selector("#monitor-error:has-text('luminance to rise with the code')")
    page.locator("[data-code='255']").fill("100")


def trial_shown(page: Any) -> int:
    """Wait for a trial, past pauses; return its number, or 0 at the end."""
    while (found := page.evaluate(NEXT)) == "pause":
        page.keyboard.press("Enter")
    assert found, "neither a trial nor the end came"
    return 0 if found == "done" else int(found)


def saved_rows(answers: Path) -> list[dict[str, str]]:
    (path,) = (answers / "data").glob("*.csv")
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def sidecar(answers: Path) -> dict[str, Any]:
    (path,) = (answers / "data").glob("*.json")
    return json.loads(path.read_text(encoding="utf-8"))


def screenshot(page: Any) -> np.ndarray:
    """Return the grey values of the window as it is on the screen; of coloured pixels, the green ones."""
    return cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[..., 1]


def pixels_of(page: Any, selector: str, screen: np.ndarray) -> np.ndarray:
    """Return the part of a screenshot that an element covers; a view."""
    box = page.locator(selector).bounding_box()
    rows, columns = (slice(round(box[at]), round(box[at] + box[n])) for at, n in (("y", "height"), ("x", "width")))
    return screen[rows, columns]


def shown_on_screen(page: Any) -> np.ndarray:
    """Return the pixels of the stimulus; around it the window is of the background's code."""
    screen = screenshot(page)
    stimulus = pixels_of(page, "#stimulus", screen)
    found = stimulus.copy()
    stimulus[:] = CODE
    assert (screen[: int(page.locator("#progress").bounding_box()["y"])] == CODE).all()
    return found


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]
