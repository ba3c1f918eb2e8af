"""The experiment in a browser: a simulated person answers every trial, pixels are exact, scaling is refused.

Skipped where there is no Chromium. The person is the paper's observer, run literally on the pixels of
the page: noise on every neuron, which `todframes calibrate` does not draw.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import OpenPage, wait_until
from experiment_page import (
    CODE,
    HURRY,
    KEYS,
    UNREACHABLE,
    experiment,
    free_port,
    measure_monitor,
    saved_rows,
    shown_on_screen,
    sidecar,
    trial_shown,
)

import todframes as tod
from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.observers.retina import resample

pytestmark = pytest.mark.slow

INTERNAL_NOISE = 0.35
GAMMA = np.log(0.5) / np.log(CODE / 255)
LUMINANCE = (np.arange(256) / 255) ** GAMMA
"""Luminance of each code value of the person's monitor, over that of white."""
CONTRAST = LUMINANCE / LUMINANCE[CODE] - 1.0


class Person:
    """The observer with internal noise 0.35, which looks at the canvas."""

    def __init__(self, page: Any, *, size_px: float, pixel_pitch_mrad: float) -> None:
        self.observer = tod.PyramidObserver(internal_noise=INTERNAL_NOISE)
        self.stimulus = tod.Stimulus(size_px * pixel_pitch_mrad)
        self.grid = self.observer.grid(self.stimulus)
        self.pixel_pitch_mrad = pixel_pitch_mrad
        self.page = page
        self.answers: dict[int, str] = {}

    def key(self, number: int) -> str:
        """Return the key that the person presses at a trial; the same one if it is shown again."""
        url = self.page.evaluate("document.getElementById('stimulus').toDataURL()")
        png = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
        codes = cv2.imdecode(png, cv2.IMREAD_GRAYSCALE)
        y, x = ((side - 1) / 2 for side in codes.shape)
        retina = resample(CONTRAST[codes], self.grid, x_px=x, y_px=y, pixel_pitch_mrad=self.pixel_pitch_mrad)
        answer = self.observer.respond(retina, self.stimulus, np.random.default_rng([15, number]))
        self.answers[number] = answer.value
        return KEYS[answer.value]


@pytest.mark.weekly
def test_person_whose_server_is_killed_twice(
    make_dataset: Any, open_page: OpenPage, tmp_path: Path, capsys: Any
) -> None:
    """240 trials: none is lost, none is twice, and what is calibrated from them is the person's internal noise."""
    # Levels from a half to three times the threshold of this noise, 0.043.
    levels = (0.02, 0.03, 0.045, 0.065, 0.09, 0.13)
    dataset = make_dataset(sizes_mrad=(3.0,), contrasts=levels, repeats=10, side_px=72)
    answers, port = tmp_path / "answers", free_port()
    (tmp_path / "consent.txt").write_text("I <b>agree</b>.\n\n<script>alert(1)</script>", encoding="utf-8")
    options = ("--subject", "p1", "--seed", 15, "--consent", tmp_path / "consent.txt", "--port", port)
    options += ("--include-flagged",)  # this person answers within milliseconds, and has seen the picture

    with experiment(dataset.path, answers, *options) as server:
        page = open_page(server.url, expected_console=UNREACHABLE)
        page.add_init_script(HURRY)
        page.reload()
        assert page.inner_text("#consent-text").split("\n\n") == ["I <b>agree</b>.", "<script>alert(1)</script>"]
        assert page.inner_text("#consent-subject") == "p1"
        page.click("#agree")
        measure_monitor(page)
        monitor = sidecar(answers)["monitor"]
        # A bank card is 85.6 mm wide; the page begins with 96 pixels to the inch, which are 324 for it.
        assert monitor["pixel_pitch_mm"] == pytest.approx(85.6 / (324 + 10 - 1))
        assert monitor["gamma"] == pytest.approx(GAMMA)
        assert monitor["background_code"] == CODE
        person = Person(page, size_px=3.0 / 0.25, pixel_pitch_mrad=monitor["pixel_pitch_mrad"])
        for expected in range(1, 100):
            assert trial_shown(page) == expected
            page.keyboard.press(person.key(expected))
        number = trial_shown(page)
        server.process.kill()
        server.process.wait()
        page.keyboard.press(person.key(number))
        page.wait_for_selector("#connection:has-text('does not answer')")

    with experiment(dataset.path, answers, *options) as server:
        # The page kept the answer that it could not send: the trial does not come again.
        page.goto(server.url)
        for expected in range(number + 1, 200):
            assert trial_shown(page) == expected
            page.keyboard.press(person.key(expected))
        page.keyboard.press(person.key(trial_shown(page)))
        server.process.kill()  # before or after this answer is saved

    with experiment(dataset.path, answers, *options) as server:
        page.goto(server.url)
        while number := trial_shown(page):
            page.keyboard.press(person.key(number))
        assert str(answers) in page.inner_text("#done")

    rows = saved_rows(answers)
    assert [int(row["trial"]) for row in rows] == list(range(1, 249))
    assert [row["phase"] for row in rows] == ["practice"] * 8 + ["main"] * 240
    assert sorted(row["frame"] for row in rows[8:]) == sorted(row["frame"] for row in dataset.rows)
    assert {int(row["trial"]): row["response"] for row in rows} == person.answers

    assert run(cli, ["calibrate", str(answers), str(dataset.path), "--include-flagged", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    low, high = found["persons"][0]["internal_noise_ci95"]
    assert low < INTERNAL_NOISE < high


def test_pixels_on_the_screen_are_those_of_the_frame(
    make_dataset: Any, open_page: OpenPage, tmp_path: Path
) -> None:
    """Without dither, each pixel has the code value whose luminance is nearest to that of the frame."""
    dataset = make_dataset(sizes_mrad=(6.0,), contrasts=(0.3, 0.7), side_px=101)
    answers = tmp_path / "answers"
    with experiment(dataset.path, answers, "--no-dither", "--practice", 0, "--trials", 2) as server:
        page = open_page(server.url, expected_console=["status of 422"])
        page.click("#agree")
        measure_monitor(page, drag_px=300, photometer=True)
        assert sidecar(answers)["monitor"]["pixel_pitch_mm"] == pytest.approx(85.6 / 300)
        assert trial_shown(page) == 1
        screens = [shown_on_screen(page)]

        # The zoom changes: an answer to what is shown then is not taken, and the trial comes again afterwards.
        zoom(page, 1.5)
        page.keyboard.press("ArrowUp")
        page.wait_for_selector("#stopped:not([hidden])")
        assert "takes 1.5 pixels of the monitor" in page.inner_text("#stopped-reason")
        zoom(page, 1.0)
        assert trial_shown(page) == 1
        assert saved_rows(answers) == []
        page.wait_for_timeout(200)
        page.click("#arrows [data-response=left]")

        assert trial_shown(page) == 2
        screens.append(shown_on_screen(page))
        page.wait_for_timeout(200)
        page.keyboard.press("ArrowUp")
        page.wait_for_selector("#done:not([hidden])")
    rows = saved_rows(answers)
    assert [row["response"] for row in rows] == ["left", "up"]
    # Readings of a power law are interpolated as one; 186 is the brightest code of at most half of white.
    contrast_of_code = (np.arange(256) / CODE) ** 2.2 - 1.0
    for row, stimulus in zip(rows, screens, strict=True):
        luminance = tod.read_frame(dataset.path / row["frame"]).stored[..., 0].astype(float)
        expected = np.abs(contrast_of_code - (luminance / 50.0 - 1.0)[..., None]).argmin(axis=-1)
        assert len(np.unique(expected)) > 20
        assert np.array_equal(stimulus, expected)


def test_contrast_below_a_code_step_on_a_narrow_page(
    make_dataset: Any, open_page: OpenPage, tmp_path: Path
) -> None:
    """With dither the mean contrast of a triangle is right. A browser that scales is refused."""
    dataset = make_dataset(sizes_mrad=(6.0,), contrasts=(0.004,), side_px=101)
    answers = tmp_path / "answers"
    phone = {"width": 390, "height": 844, "color_scheme": "dark"}
    with experiment(dataset.path, answers, "--practice", 0, "--trials", 1, "--time-limit", 2) as server:
        page = open_page(server.url, device_scale_factor=1.25, **phone)
        page.click("#agree")
        page.wait_for_selector("#stopped:not([hidden])")
        assert "takes 1.25 pixels of the monitor" in page.inner_text("#stopped-reason")
        assert "100 %" in page.inner_text("#stopped-remedy")

        page = open_page(server.url, **phone)
        measure_monitor(page)
        assert trial_shown(page) == 1
        stimulus = shown_on_screen(page)
        page.wait_for_selector("#done:not([hidden])")  # nobody answers
    (row,) = saved_rows(answers)
    assert (row["response"], row["correct"], float(row["response_time_ms"])) == ("none", "0", 2000.0)
    apex = tod.Orientation(row["orientation"])
    triangle = tod.coverage((101, 101), size_px=24.0, x_px=50.0, y_px=50.0, orientation=apex)
    assert set(np.unique(stimulus)) == {CODE, CODE + 1}
    assert np.average(CONTRAST[stimulus], weights=triangle) == pytest.approx(0.004, abs=5e-4)


def zoom(page: Any, ratio: float) -> None:
    """Change the device pixel ratio of an open page."""
    metrics = {"width": 1280, "height": 900, "deviceScaleFactor": ratio, "mobile": False}
    page.context.new_cdp_session(page).send("Emulation.setDeviceMetricsOverride", metrics)


WATCH = """
window.seen = { mark: null, said: [], isHasty: false };
document.addEventListener("DOMContentLoaded", () => {
  const [stage, canvas, feedback] = ["stage", "stimulus", "feedback"].map((id) => document.getElementById(id));
  new MutationObserver(() => {
    if (feedback.textContent) seen.said.push(feedback.textContent);
    if (!seen.mark && !stage.hidden && !canvas.hidden) {
      const middle = canvas.getContext("2d").getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data[0];
      seen.mark = [stage.dataset.trial ?? null, middle];
    }
    if (stage.dataset.trial === "1" && !seen.isHasty) {
      seen.isHasty = true;
      const key = new KeyboardEvent("keydown", { key: "ArrowLeft" });
      window.dispatchEvent(Object.defineProperty(key, "timeStamp", { value: 0 }));
    }
  }).observe(document.body, { attributes: true, childList: true, subtree: true });
});
"""
"""Note the mark and what is said, and answer the first trial at once: from outside, a busy machine is late."""


def test_person_who_is_too_fast_looks_away_and_stops(
    make_dataset: Any, open_page: OpenPage, tmp_path: Path
) -> None:
    """The page says what is wrong with an answer, shows the trial again, and can be left."""
    dataset = make_dataset(sizes_mrad=(6.0,), contrasts=(0.3, 0.7), side_px=101)
    answers = tmp_path / "answers"
    with experiment(dataset.path, answers, "--practice", 0, "--contact", "Jo, room 7") as server:
        page = open_page(server.url, script=WATCH)
        page.wait_for_selector("#consent-text:has-text('Jo, room 7')")
        page.click("#agree")
        measure_monitor(page)
        wait_until(page, "seen.said.some((text) => text.startsWith('Too fast'))")
        is_shown, middle = page.evaluate("seen.mark")
        assert is_shown is None and middle != CODE  # the mark, before the picture

        assert trial_shown(page) == 2
        page.evaluate("window.dispatchEvent(new Event('blur'))")
        page.wait_for_timeout(200)
        page.keyboard.press("ArrowLeft")
        wait_until(page, "seen.said.some((text) => text.startsWith('Another window was in front'))")

        assert trial_shown(page) == 3
        assert "of 10" in page.inner_text("#progress")  # 8, and 2 again
        page.keyboard.press("Escape")
        page.wait_for_selector("#leave:not([hidden])")
        page.keyboard.press("ArrowUp")  # no trial is shown
        page.keyboard.press("Enter")
        assert trial_shown(page) == 3
        page.click("#stop")
        page.click("#leave-now")
        page.wait_for_selector("#ended:not([hidden]) >> text=Jo, room 7")
        page.reload()
        page.wait_for_selector("#ended:not([hidden])")
    assert [(row["response"], row["flag"]) for row in saved_rows(answers)] == [
        ("left", "too_fast"),
        ("left", "unfocused"),
    ]
    assert sidecar(answers)["stopped_at"]


def test_practice_goes_on_where_it_was_left(make_dataset: Any, open_page: OpenPage, tmp_path: Path) -> None:
    """Neither instructions nor check come again after four of eight trials, or eight with too few correct."""
    dataset = make_dataset(sizes_mrad=(6.0,), contrasts=(0.3, 0.7), side_px=101)
    options = ("--include-flagged", "--practice-correct", 1, "--seed", 1)
    with experiment(dataset.path, tmp_path / "answers", *options) as server:
        page = open_page(server.url, script=HURRY)
        page.click("#agree")
        measure_monitor(page)
        for number in range(1, 9):
            assert trial_shown(page) == number
            page.keyboard.press("ArrowUp")
            if number == 4:
                assert trial_shown(page) == 5
                page.reload()
                page.wait_for_selector("#pause:not([hidden]) >> text=4 of 8 are done and saved")
        for _ in range(2):
            page.wait_for_selector("#pause:not([hidden]) >> text=of the last 8 were correct, and 8 are needed")
            page.reload()
        assert trial_shown(page) == 9
        assert "of the last 8 correct, 8 needed" in page.inner_text("#progress")


def test_frames_for_which_a_desk_is_too_short_are_explained_at_once(
    make_dataset: Any, open_page: OpenPage, tmp_path: Path
) -> None:
    """Pixels of 0.03 mrad are those of a desk's monitor from 8.8 m."""
    dataset = make_dataset(sizes_mrad=(0.5,), display={"pixel_pitch_mrad": 0.03}, contrasts=(0.3,))
    with experiment(dataset.path, tmp_path / "answers", "--practice", 0) as server:
        page = open_page(server.url)
        page.click("#agree")
        page.wait_for_selector("#size:not([hidden])")
        assert "Call the experimenter: a desk does not do" in page.inner_text("#size .reach")
        # 96 pixels to the inch: 25.4 / 96 mm over 0.03 mrad, shown with three digits.
        assert "from 8810 mm" in page.inner_text("#size .reach")
