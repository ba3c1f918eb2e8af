"""The explorer's page in a browser.

Skipped where there is no Chromium or no Playwright. Every page that these tests open fails its test if the console
shows an error, or if it asks another origin for anything.
"""

from __future__ import annotations

import csv
import io
import json
import math
import random
import re
import shlex
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec
import pytest
from browser import OpenPage, Server, serving, wait_until

from sensor_sim import new_sensor
from sensor_sim.chain.sensor import load_sensor
from sensor_sim.cli import cli
from sensor_sim.explorer.routes import TrialAsked
from todframes.cli.console import run
from todframes.web.server import open_listener

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

Error = pytest.importorskip("playwright.sync_api").Error

pytestmark = pytest.mark.slow

SAMPLES = Path(__file__).parents[2] / "sample_frames"
STAR_LIKE = SAMPLES / "star_like.toml"
SECONDS = 60_000
"""Longest wait, in milliseconds: a refined curve takes two seconds on a quiet machine."""

REFUSED = ["status of 422"]
"""Chromium's own remark about an answer that refuses a sensor."""

SCRIPT = "<img src=x onerror=\"document.title='taken'\"><script>document.title='taken'</script>"
WIDTHS = (390, 1280)
IS_DRAWN = "(({ asked, sequence }) => asked === sequence)(document.querySelector('#curve').dataset)"
"""Whether the curve that is drawn is that of the present state."""

FITS = """(width) => [innerWidth, document.documentElement.scrollWidth].every((one) => one === width) &&
  [...document.querySelectorAll(".chart")].filter((one) => one.checkVisibility())
    .every((one) => one.clientWidth === one.querySelector("canvas").clientWidth)"""
"""Whether the page is as wide as the window, and each chart as its place, which follows in a later frame."""

PAPERS: dict[Literal["light", "dark"], str] = {"light": "rgb(255, 255, 255)", "dark": "rgb(20, 23, 27)"}
IMPOSSIBLE = (
    ("detector.width_mrad", "0.9", "Found 0.9, expected at most pitch_mrad"),
    ("p_correct", "0.2", "Found 0.2"),
    ("sizes_detectors", "2, two", "Expected 1 to 12 sizes above 0"),
    ("optics.aperture_mm", "1e309", "Found 1e309, which is too large"),
    ("optics.wavelength_um", "red", "Found “red”, expected a number."),
    ("noise.frames_integrated", "1.5", "expected a whole number"),
    ("optics.aperture_mm", "0.5", "passes nothing of a triangle to such detectors"),
    ("sizes_detectors", "4, 300", "Found 300, expected at most 255"),
    ("sizes_detectors", "100", "mrad at the eye, expected at most"),
)
VISIBLE = "visible camera, 3.45 µm, f/4"
STAGES = ["a_input", "b_optics", "c_detector_response", "d_samples", "e_noise", "f_hold", "g_display"]


@pytest.fixture(scope="module")
def server(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("explorer")
    with serving("sensor_sim", "explore", STAR_LIKE, "--no-browser", cwd=folder) as running:
        assert browser.is_connected()  # without a browser the server is not started
        yield running


@pytest.fixture
def explore(open_page: OpenPage, server: Server) -> Callable[..., Page]:
    """Function that opens the page, with the options of `watched`, and waits for an estimate."""

    def call(fragment: str = "", **options: Any) -> Page:
        page = open_page(server.url + fragment, **options)
        page.set_default_timeout(SECONDS)
        page.wait_for_selector("#curve[data-sequence]")
        return page

    return call


def painted(page: Page, action: Callable[[], Any], stage: str = "") -> None:
    """Do something that asks for curves, and wait for the one of the last request."""
    before = sequence(page)
    action()
    wait_until(
        page,
        "([before, stage]) => { const { sequence, stage: shown } = document.querySelector('#curve').dataset;"
        " return Number(sequence) > before && (!stage || shown === stage); }",
        [before, stage],
    )


def sequence(page: Page) -> int:
    return int(page.locator("#curve").get_attribute("data-sequence") or 0)


def type_value(page: Page, key: str, value: str) -> None:
    """Type a value into a number field, and leave it."""
    field = page.locator(field_of(key))
    field.fill(value)
    field.press("Tab")


def field_of(key: str) -> str:
    return f"#field-{key.replace('.', '-')}"


def slider_of(key: str) -> str:
    return f".field:has({field_of(key)}) input[type=range]"


def value_of(page: Page, key: str) -> str:
    return page.locator(field_of(key)).input_value()


class Shown(NamedTuple):
    """A number of the table, the half-width of its interval, and the largest error that rounding both made."""

    value: float
    error: float
    rounding: float


def table(page: Page, selector: str = "#curve-table") -> list[dict[str, str]]:
    """Return the rows of a table by the headers of its columns."""
    return page.locator(selector).evaluate(
        "(table) => { const texts = (row) => [...row.cells].map((cell) => cell.textContent);"
        " const headers = texts(table.tHead.rows[0]);"
        " return [...table.tBodies[0].rows].map((row) =>"
        " Object.fromEntries(texts(row).map((text, index) => [headers[index], text]))); }"
    )


def number(text: str) -> Shown:
    value, error = text.split(" ± ")
    unit = 10.0 ** -len(value.partition(".")[2])
    return Shown(float(value), float(error), unit)


def agree(one: Shown, other: Shown) -> bool:
    return abs(one.value - other.value) <= one.error + other.error + one.rounding + other.rounding


def test_numbers_are_those_of_the_copied_command(explore, tmp_path: Path, monkeypatch, capsys) -> None:
    """The saved file and the copied command give the thresholds of the page, within the errors of both."""
    page = explore(permissions=["clipboard-read", "clipboard-write"])
    for key, value in {"optics.aperture_mm": "150", "observer.internal_noise": "0.35", "p_correct": "0.7"}.items():
        type_value(page, key, value)
    painted(page, lambda: type_value(page, "sizes_detectors", "4 6"), "refined")
    name, content = downloaded(page, "#save")
    (tmp_path / name).write_bytes(content)
    page.click("#command")
    wait_until(page, "document.querySelector('#message').textContent.includes('copied')")
    program, *arguments = shlex.split(page.evaluate("navigator.clipboard.readText()"))
    assert program == "sensor-sim"
    monkeypatch.chdir(tmp_path)
    assert run(cli, [*arguments, "--json", "--tolerance", "0.005"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["settings"]["sensor"]["optics"]["aperture_mm"] == 150.0
    assert (result["settings"]["internal_noise"], result["settings"]["p_correct"]) == (0.35, 0.7)
    rows = table(page)
    assert [row["Size (detectors)"] for row in rows] == ["4", "6"]
    for row, fit in zip(rows, result["fits"], strict=True):
        in_mk = fit["delta_t_mk"] / fit["threshold"]
        for header, unit in (("SNR", 1.0), ("ΔT (mK)", in_mk)):
            of_command = Shown(fit["threshold"] * unit, fit["threshold_numerical_error"] * unit, 0.0)
            shown = number(row[header])
            assert agree(shown, of_command), (shown, of_command)
            # Half a percent is the 0.2 % asked for, rounded up to the one digit that the table has.
            assert shown.error <= 0.005 * shown.value


def test_the_curve_after_300_moves_is_that_of_the_last_state(explore) -> None:
    page = explore()
    painted(page, lambda: type_value(page, "sizes_detectors", "5, 8"))
    asked: list[dict[str, Any]] = []
    page.on("request", lambda one: asked.append(one.post_data_json) if one.url.endswith("/api/curve") else None)
    chance, sliders = random.Random(1), ["optics.aperture_mm", "detector.width_mrad", "observer.internal_noise"]

    def moves() -> None:
        for move in range(300):
            if move % 30 == 0:
                page.locator(slider_of(sliders[move // 30 % 3])).focus()
            page.keyboard.press("ArrowLeft" if chance.random() < 0.6 else "ArrowRight")

    painted(page, moves)
    values = [float(value_of(page, key)) for key in sliders]
    # The newest state waits until the one before has its estimate: only then it is asked for.
    wait_until(page, f"{IS_DRAWN} && document.querySelector('#curve').dataset.stage === 'refined'")
    tables = asked[-1]["sensor"] | {"observer": asked[-1]["observer"]}
    assert [float(tables[name][key]) for name, key in (one.split(".") for one in sliders)] == values
    assert asked[-1]["sequence"] == sequence(page)
    assert [one["sequence"] for one in asked] == sorted({one["sequence"] for one in asked})
    moved = table(page)
    wait_until(page, "location.hash.length > 1")
    page.reload()
    page.wait_for_selector(REFINED)
    fresh = table(page)
    assert [float(value_of(page, key)) for key in sliders] == values
    for one, other in zip(moved, fresh, strict=True):
        assert agree(number(one["SNR"]), number(other["SNR"])), (one, other)


def test_a_late_answer_is_dropped(explore) -> None:
    """The first request is answered only after the second, which was sent because the first took too long."""
    page = explore()
    held: list[Route] = []
    page.route("**/api/curve", lambda route: route.continue_() if held else held.append(route))
    page.locator(slider_of("optics.aperture_mm")).press("ArrowLeft")
    painted(page, lambda: page.keyboard.press("ArrowLeft"))
    late = held[0].request.post_data_json
    answer = {"sequence": late["sequence"], "stage": "refined", "is_last": True, "seconds": 1.0}
    row = {"size_detectors": 2.0, "size_mrad": 1.0, "size_mrad_eye": 1.0, "status": "ok", "snr": 999.0}
    row["snr_error"] = answer["tolerance"] = 0.002
    held[0].fulfill(body=json.dumps({**answer, "thresholds": [row], "limits": None}) + "\n")
    page.wait_for_timeout(200)
    assert (late["sequence"], len(table(page))) == (sequence(page) - 1, len(late["sizes_detectors"]))


def wait_for(page: Page, condition: Callable[[], bool]) -> None:
    end = time.monotonic() + SECONDS / 1000
    while not condition():
        assert time.monotonic() < end
        page.wait_for_timeout(10)


def line(page: Page) -> str:
    return page.locator("#status").inner_text()


REFINED = "#curve[data-stage=refined]"


def announced(page: Page) -> str:
    return page.locator("#announcement").text_content() or ""


def downloaded(page: Page, button: str) -> tuple[str, bytes]:
    """Return the name and the content of the file that a button saves."""
    with page.expect_download() as download:
        page.click(button)
    return download.value.suggested_filename, download.value.path().read_bytes()


def saved(page: Page) -> dict[str, Any]:
    """Return the tables of the file that *Save* writes."""
    return tomllib.loads(downloaded(page, "#save")[1].decode())


def test_the_line_and_the_numbers_belong_to_the_state_that_is_shown(explore) -> None:
    """Another field moves while the first request is on its way."""
    page = explore()
    page.wait_for_selector(REFINED)
    before = table(page)
    assert line(page).startswith("Refined") and announced(page)
    held: list[Route] = []
    page.route("**/api/curve", lambda route: held.append(route))

    def release() -> None:
        """Let all requests go that the page has not given up, and hold no more."""
        page.unroute("**/api/curve")
        for route in held:
            with suppress(Error):
                route.continue_()

    page.locator(slider_of("noise.frames_integrated")).press("ArrowRight")
    wait_for(page, lambda: len(held) >= 1)
    page.locator(slider_of("optics.blur_sigma_mrad")).press("ArrowRight")
    for _ in range(2):  # during the first request, and during that which takes its place
        assert (line(page), announced(page)) == ("Computing…", "")
        assert page.locator("#curve").get_attribute("aria-busy") == "true"
        assert table(page) == before
        assert "earlier sensor" in page.locator("#curve-table caption").text_content()
        wait_for(page, lambda: len(held) >= 2)
    page.wait_for_selector("#curve.stale")
    of_file = saved(page)
    assert (of_file["noise"]["frames_integrated"], of_file["optics"]["blur_sigma_mrad"]) == (7, 0.011)
    painted(page, release, "refined")
    assert held[-1].request.post_data_json["sensor"]["optics"] == of_file["optics"]
    assert (line(page)[:7], page.locator("#curve").get_attribute("aria-busy")) == ("Refined", "false")
    shown = table(page)
    assert shown != before
    heard = {size: float(snr) for size, snr in re.findall(r"([\d.]+) detectors: ([\d.]*\d)", announced(page))}
    assert {row["Size (detectors)"]: number(row["SNR"]).value for row in shown if "±" in row["SNR"]} == {
        size: pytest.approx(snr, rel=1e-3) for size, snr in heard.items()
    }
    assert "earlier sensor" not in page.locator("#curve-table caption").text_content()


@pytest.mark.weekly
def test_a_server_that_has_ended_is_noticed_without_an_action(open_page) -> None:
    """And one that takes its place is another: one line says so, at one place."""
    with open_listener() as listener:
        port = listener.getsockname()[1]
    gone = ["ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET", "ERR_INCOMPLETE", "status of 403"]
    ended, other = "The server has ended. Start the command again", "This page belongs to a server that has ended."
    with serving("sensor_sim", "explore", STAR_LIKE, "--no-browser", "--port", str(port)) as first:
        page = open_page(first.url, expected_console=gone)
        page.wait_for_selector("#curve[data-stage=refined]", timeout=SECONDS)
    wait_until(page, "(text) => document.querySelector('#server').textContent.startsWith(text)", ended)
    page.locator(slider_of("optics.aperture_mm")).press("ArrowLeft")
    wait_until(page, "document.querySelector('#status').textContent === 'Not computed'")
    assert page.locator("#message").text_content() == ""
    with serving("sensor_sim", "explore", STAR_LIKE, "--no-browser", "--port", str(port)) as second:
        wait_until(page, "(text) => document.querySelector('#server').textContent.startsWith(text)", other)
        assert ended not in page.locator("body").inner_text()
        tab = page.context.new_page()
        tab.goto(second.url)  # its visit gives the browser the token of the new server
        painted(page, lambda: wait_until(page, "document.querySelector('#server').textContent === ''"))


def test_undo_redo_and_reset_with_the_keyboard_alone(explore) -> None:
    page = explore()
    page.keyboard.press("Tab")
    for _ in range(60):
        if page.evaluate(f"document.activeElement.matches('{slider_of('optics.aperture_mm')}')"):
            break
        page.keyboard.press("Tab")
    painted(page, lambda: page.keyboard.press("ArrowRight"))
    assert float(value_of(page, "optics.aperture_mm")) > 220.0
    moved = value_of(page, "optics.aperture_mm")
    page.keyboard.press("Tab")
    page.keyboard.type("100")
    page.keyboard.press("Tab")
    assert value_of(page, "optics.aperture_mm") == "100"
    values = []
    for keys in ("Control+z", "Control+z", "Control+z", "Control+Shift+z", "Control+y", "Control+z"):
        page.keyboard.press(keys)
        values.append(value_of(page, "optics.aperture_mm"))
    assert values == [moved, "220", "220", moved, "100", moved]
    page.locator("#reset").press("Enter")
    assert value_of(page, "optics.aperture_mm") == "220"
    page.locator("#undo").press("Enter")
    assert value_of(page, "optics.aperture_mm") == moved


def test_a_link_holds_the_state(explore, server: Server) -> None:
    page = explore(permissions=["clipboard-read", "clipboard-write"])
    type_value(page, "sizes_detectors", "8")
    type_value(page, "display.gain", "0.7")
    painted(page, lambda: page.locator(field_of("noise.distribution")).select_option("gaussian"))
    type_value(page, "noise.netd_mk", "")
    page.locator("#name").fill("Ω & other names")
    page.locator("#name").press("Enter")
    page.locator("[name=unit][value=mrad] + span").click()
    page.locator("label:has(input[name=strength][value=contrast])").click()
    page.locator("#curve-table th", has_text="Contrast").wait_for(state="attached")
    assert "±" in table(page)[0]["Contrast"]
    page.click("#link")
    wait_until(page, "document.querySelector('#message').textContent.startsWith('Link copied. It opens while')")
    link = page.evaluate("navigator.clipboard.readText()")
    assert link.startswith(f"{server.origin}/#")  # and no token
    other = explore(link.removeprefix(f"{server.origin}/"))
    assert other.locator("#name").input_value() == "Ω & other names"
    keys = ("display.gain", "noise.distribution", "noise.netd_mk", "optics.aperture_mm", "sizes_detectors")
    assert [value_of(other, key) for key in keys] == ["0.7", "gaussian", "", "220", "8"]
    assert other.locator("[name=unit][value=mrad]").is_checked()
    assert other.locator("[name=strength][value=contrast]").is_checked()
    assert other.locator("[name=strength][value=delta_t_mk]").is_disabled()  # there is no NETD
    painted(other, lambda: type_value(other, "display.gain", "2"))
    wait_until(other, "(link) => location.href !== link", link)
    painted(other, lambda: other.evaluate("(link) => { location.href = link; }", link))
    assert value_of(other, "display.gain") == "0.7"


def drop(page: Page, name: str, text: str) -> None:
    """Drop a file on the page."""
    held = page.evaluate_handle(
        "([name, text]) => { const held = new DataTransfer(); held.items.add(new File([text], name));"
        " return held; }",
        [name, text],
    )
    page.dispatch_event("main", "dragover", {"dataTransfer": held})
    assert page.locator("#drop").is_visible()
    page.dispatch_event("main", "drop", {"dataTransfer": held})
    assert page.locator("#drop").is_hidden()


def test_a_dropped_file_is_opened_and_saved_again_and_a_damaged_or_late_one_leaves_the_state(
    explore, tmp_path: Path
) -> None:
    page = explore("#no-state", expected_console=REFUSED)
    assert "The link is damaged" in page.locator("#message").inner_text()
    text = (SAMPLES / "staring_camera.toml").read_text(encoding="utf-8").replace("220.0", "90.125")
    late: list[Route] = []
    page.route("**/api/parse", lambda route: late.append(route), times=1)
    drop(page, "late.toml", text)
    wait_for(page, lambda: bool(late))
    for damaged, complaint in (
        ("x" * 600_000, "drop a smaller file"),
        ("no TOML", "not valid TOML"),
        ("schema = 1\n[optics]\naperture = 3.0\n", "aperture_mm"),
    ):
        drop(page, "other.toml", damaged)
        wait_until(page, "(text) => document.querySelector('#message').textContent.includes(text)", complaint)
        assert "\n" not in page.locator("#message").inner_text()
        if late:
            with page.expect_response("**/api/parse"):
                late.pop().continue_()
    assert value_of(page, "optics.aperture_mm") == "220" and page.locator("#undo").is_disabled()
    painted(page, lambda: drop(page, "other.toml", text))
    assert value_of(page, "optics.aperture_mm") == "90.125"
    (tmp_path / "saved.toml").write_bytes(downloaded(page, "#save")[1])
    (tmp_path / "dropped.toml").write_text(text, encoding="utf-8")
    assert load_sensor(tmp_path / "saved.toml") == load_sensor(tmp_path / "dropped.toml")
    painted(page, lambda: page.click("#undo"))
    assert value_of(page, "optics.aperture_mm") == "220"
    page.set_input_files("#file", tmp_path / "dropped.toml")
    wait_until(page, "document.querySelector('#message').textContent === 'dropped.toml opened.'")
    assert value_of(page, "optics.aperture_mm") == "90.125"


def test_a_script_in_a_name_is_a_text(explore) -> None:
    page = explore()
    text = STAR_LIKE.read_text(encoding="utf-8").replace('"star-like"', json.dumps(SCRIPT))
    page.click("#pin")
    painted(page, lambda: drop(page, f"{SCRIPT}.toml", text))
    page.click("#pin")
    assert page.locator("#name").input_value() == SCRIPT
    painted(page, lambda: page.click("#undo"))
    assert SCRIPT in page.locator("#pins").inner_text()
    assert page.title() == "Sensor explorer" and page.locator("main img, main script").count() == 0


def test_nothing_scrolls_sideways(explore) -> None:
    """Neither on a desk nor on a phone, in light and dark, with all that can be opened open."""
    page = explore()
    page.click("#pin")
    painted(page, lambda: type_value(page, "display.gain", "0.7"))
    page.locator("#name").fill("x" * 200)
    page.wait_for_selector("#stages canvas")
    page.click("#reveal")
    page.wait_for_selector("[data-stage=a_input]")
    for details in page.locator("summary:visible").all():
        details.click()
    for width in WIDTHS:
        page.set_viewport_size({"width": width, "height": 844})
        for scheme, paper in PAPERS.items():
            page.emulate_media(color_scheme=scheme)
            wait_until(page, FITS, width)
            assert page.evaluate("getComputedStyle(document.documentElement).backgroundColor") == paper


def test_impossible_values_have_a_line_at_their_field(explore) -> None:
    page = explore(expected_console=REFUSED)
    before = len(table(page))
    for key, value, complaint in IMPOSSIBLE:
        field, line = page.locator(field_of(key)), page.locator(f"{field_of(key)}-error")
        good = field.input_value()
        type_value(page, key, value)
        line.wait_for(state="visible")
        assert complaint in line.inner_text()
        assert "\n" not in line.inner_text()
        assert field.get_attribute("aria-invalid") == "true"
        assert line.get_attribute("id") in (field.get_attribute("aria-describedby") or "")
        assert len(table(page)) == before  # the last good curve stays, greyed
        page.wait_for_selector("#curve.stale")
        assert float(page.evaluate("getComputedStyle(document.querySelector('#curve-chart')).opacity")) < 0.5
        type_value(page, key, good)
        line.wait_for(state="hidden")
        page.wait_for_selector("#curve:not(.stale)")
    type_value(page, "detector.width_mrad", "0.9")
    wait_until(page, "document.querySelector('#status').innerText.includes('last possible sensor')")
    painted(page, lambda: page.click("#undo"))
    assert page.locator("#curve.stale, [aria-invalid=true]").count() == 0


def test_an_impossible_sensor_has_no_curve_after_a_reload(explore) -> None:
    page = explore(expected_console=REFUSED)
    type_value(page, "detector.width_mrad", "0.9")
    page.wait_for_selector("#curve.stale")
    page.reload()
    wait_until(page, "document.querySelector('#status').innerText.endsWith('There is no curve yet.')")
    painted(page, lambda: type_value(page, "detector.width_mrad", "0.05"))


def test_a_page_in_dark_colours_is_printed_in_light_ones(explore) -> None:
    # This test reads the canvas often.
    page = explore(color_scheme="dark", expected_console=["willReadFrequently"])
    darkest = """() => {
      const canvas = document.querySelector("#curve-chart canvas");
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      let least = 255;
      for (let at = 0; at < data.length; at += 4) if (data[at + 3] === 255) least = Math.min(least, data[at]);
      return least;
    }"""
    # Of the red of opaque ink, labels have 87 in light colours, and nothing less than 100 in dark ones.
    assert page.evaluate(darkest) > 100
    page.emulate_media(color_scheme="dark", media="print")
    assert page.evaluate("getComputedStyle(document.documentElement).backgroundColor") == PAPERS["light"]
    wait_until(page, f"({darkest})() < 90")
    page.emulate_media(color_scheme="dark", media="screen")
    wait_until(page, f"({darkest})() > 100")


def test_pitch_width_netd_and_f_number_move_together_where_they_are_coupled(explore) -> None:
    page = explore()
    pitch, width, netd = "detector.pitch_mrad", "detector.width_mrad", "noise.netd_mk"
    note = page.locator("fieldset:has(#field-detector-pitch_mrad) .note")
    # 15 µm per 0.0681 mrad are 220 mm, the aperture; 4 µm · f/1 / 15 µm is 0.27.
    wait_for(page, lambda: note.inner_text() == "f/1, focal length 220 mm, λF/d 0.27")
    page.locator(field_of("noise.couple_netd")).check()
    for key, value, expected in (
        ("optics.aperture_mm", "55", "256"),
        (netd, "160", "160"),
        ("optics.aperture_mm", "220", "10"),
    ):
        type_value(page, key, value)
        wait_for(page, lambda expected=expected: value_of(page, netd) == expected)
    page.locator(field_of("keep_fill_factor")).check()
    type_value(page, pitch, "0.1362")
    wait_for(page, lambda: (value_of(page, width), value_of(page, netd)) == ("0.1362", "2.5"))
    assert saved(page)["noise"]["netd_mk"] == pytest.approx(2.5, rel=1e-12)
    page.reload()
    page.wait_for_selector(REFINED)
    assert page.locator(field_of("noise.couple_netd")).is_checked()
    for key in ("noise.couple_netd", "keep_fill_factor"):
        page.locator(field_of(key)).uncheck()
    type_value(page, "optics.aperture_mm", "110")
    assert value_of(page, netd) == "2.5"
    type_value(page, width, "0.13")
    assert value_of(page, pitch) == "0.1362"
    page.locator(field_of("keep_fill_factor")).check()
    type_value(page, width, "0.065")
    wait_for(page, lambda: value_of(page, pitch) == "0.0681")
    for way in ("ArrowRight", "ArrowLeft"):
        for _ in range(20):
            page.locator(slider_of(pitch)).press(way)
    wait_for(
        page,
        lambda: math.isclose(
            float(value_of(page, width)), float(value_of(page, pitch)) * 0.13 / 0.1362, rel_tol=1e-5
        ),
    )
    page.locator("#presets").select_option(label="uncooled LWIR, 12 µm, f/1")
    wait_for(page, lambda: note.inner_text() == "f/1, focal length 35 mm, λF/d 0.83")


def test_every_preset_begins_with_sizes_that_it_shows(explore) -> None:
    page = explore()
    for name in page.locator("#presets option").all_inner_texts()[1:]:
        painted(page, lambda name=name: page.locator("#presets").select_option(label=name))
        wait_until(page, IS_DRAWN)
        rows = table(page)
        assert len(rows) == 5 and all("±" in " ".join(row.values()) for row in rows), name
        assert value_of(page, "sizes_detectors") == ", ".join(row["Size (detectors)"] for row in rows)


def test_curves_are_marked_where_never_reached_pinned_with_ratios_and_saved_as_files(explore) -> None:
    page = explore(expected_console=["willReadFrequently"])  # this test reads the canvas twice
    # Pixels of the colour of warnings.
    marks = """() => {
      const canvas = document.querySelector("#curve-chart canvas");
      const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
      const colour = getComputedStyle(document.documentElement).getPropertyValue("--warning").trim();
      const red = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
      let found = 0;
      for (let at = 0; at < data.length; at += 4) found += red.every((one, k) => Math.abs(data[at + k] - one) < 9);
      return found;
    }"""
    assert page.evaluate(marks) == 0
    painted(page, lambda: type_value(page, "sizes_detectors", "2, 4, 8"), "refined")
    assert page.locator("#never").inner_text() == "× Never reached: 2 detectors"
    wait_until(page, f"({marks})() > 10")
    page.click("#pin")
    assert "1 — as now; thresholds 1 × those now" in page.locator("#pins").inner_text()
    before = table(page)
    painted(page, lambda: type_value(page, "optics.aperture_mm", "150"), "refined")
    now = table(page)
    ratios = [
        number(one["SNR"]).value / number(other["SNR"]).value
        for one, other in zip(before[1:], now[1:], strict=True)
    ]
    text = page.locator("#pins").inner_text()
    assert text.startswith("1 — optics: aperture 220 mm; thresholds ")
    found = [float(one) for one in re.findall(r"[\d.]+", text.partition("thresholds")[2])]
    wanted = [math.sqrt(math.prod(ratios)), min(ratios), max(ratios)]
    assert found[:3] == pytest.approx(wanted, rel=0.01)  # three digits, and the table is rounded
    for button, file, start in (
        ("#png", "tod_curve.png", b"\x89PNG"),
        ("#svg", "tod_curve.svg", b"<?xml"),
        ("#mtf-png", "mtf.png", b"\x89PNG"),
        ("#mtf-svg", "mtf.svg", b"<?xml"),
        ("#csv", "tod_curve.csv", b"curve"),
    ):
        name, content = downloaded(page, button)
        assert (name, content[: len(start)]) == (file, start)
    rows = list(csv.DictReader(io.StringIO(content.decode())))
    statuses = ["never_reached", "ok", "ok"]
    assert [(row["curve"], row["status"]) for row in rows] == [
        (curve, status) for curve in ("now", "1") for status in statuses
    ]
    shown = number(now[2]["SNR"])
    assert float(rows[2]["snr"]) == pytest.approx(shown.value, abs=shown.rounding)
    assert rows[0]["snr"] == "" and float(rows[2]["size_mrad"]) == pytest.approx(8 * 0.0681)
    page.locator("[name=unit][value=mrad] + span").click()
    assert page.locator("#never").inner_text() == "× Never reached: 0.1362 mrad"
    page.click("#pin")
    page.click("#pins li:first-child .remove")
    page.click("#pin")
    assert [one.partition(" ")[0] for one in page.locator("#pins li").all_inner_texts()] == ["1", "2"]
    address = page.evaluate("location.hash")
    type_value(page, "display.gain", "0.7")
    wait_until(page, "(address) => location.hash !== address", address)
    page.evaluate("(address) => history.replaceState(null, '', address)", address)
    page.reload()  # as if before the address had the last changes
    page.wait_for_selector(REFINED)
    assert [value_of(page, key) for key in ("optics.aperture_mm", "display.gain")] == ["150", "0.7"]
    assert page.locator("[name=unit][value=mrad]").is_checked()
    assert "display: gain 1" in page.locator("#pins").inner_text()
    for _ in range(2):
        page.locator("#pins .remove").first.click()
    page.reload()
    page.wait_for_selector(REFINED)
    assert page.locator("#pins li").count() == 0


def test_the_orientation_is_hidden_until_asked(explore) -> None:
    page = explore()
    asked: dict[str, Any] = {}
    page.on("request", lambda one: asked.update({one.url.rpartition("/")[2]: one.post_data_json}))
    stages = "[...document.querySelectorAll('#stages canvas')].map((one) => one.dataset.stage)"
    page.reload()  # the first trial may have been asked for before its request was listened to
    page.wait_for_selector("#stages canvas")
    assert page.evaluate(stages) == STAGES[-1:]
    assert "orientation" not in asked
    assert not re.search("points", page.locator("#trial").inner_text().replace("does the triangle point", ""))
    found = set()
    for _ in range(5):
        page.click("#answers [value=up]")
        page.wait_for_selector("[data-stage=a_input]")
        assert page.evaluate(stages) == STAGES
        verdict = page.locator("#verdict").inner_text()
        # A test of the server compares the pictures of a request with its orientation.
        assert asked["stages"] == asked["orientation"]
        shown = msgspec.convert(asked["orientation"], TrialAsked).trial().orientation.value
        assert verdict == ("Correct: it" if shown == "up" else "Wrong: it") + f" points {shown}."
        found.add(shown)
        page.click("#next-trial")
        page.wait_for_selector("#stages.alone")
        assert page.evaluate(stages) == STAGES[-1:]
        assert page.locator("#verdict").inner_text() == ""
    assert len(found) > 1


def test_the_first_page_is_small_and_has_names_tables_and_results_for_readers_of_screens(explore) -> None:
    page = explore()
    page.wait_for_selector(REFINED)
    page.wait_for_selector("#stages canvas")
    wait_until(page, "document.querySelector('#mtf-table').rows.length > 5")
    nameless = page.evaluate(
        "[...document.querySelectorAll('input, select, button')].filter((one) => !one.hidden && !(one.ariaLabel ||"
        " one.getAttribute('aria-labelledby') || one.textContent.trim() || one.labels?.length))"
        ".map((one) => one.id)"
    )
    assert nameless == []
    canvases = page.evaluate(
        "[...document.querySelectorAll('canvas')].map((one) => one.closest('[role=img]')?.ariaLabel.length > 10 &&"
        " one.closest('section').querySelector('details table caption').textContent.length > 10)"
    )
    assert canvases == [True, True, True]
    announced = page.locator("#announcement")
    assert announced.get_attribute("aria-live") == "polite"
    assert re.search(r"Threshold SNR at 4 detectors: .*; 8 detectors: \d", announced.text_content() or "")
    sizes = page.evaluate(
        "[...performance.getEntriesByType('navigation'), ...performance.getEntriesByType('resource')]"
        ".map((one) => [one.name.split('/').at(-1), one.transferSize])"
    )
    sizes = dict(reversed(sizes))  # the first of a name: the page asks again and again whether the server is there
    assert sizes.pop("curve") > 0  # it has a line for each estimate: a slow machine sends more of them
    assert {"explorer.js", "uPlot.iife.min.js", "start", "mtf"} <= sizes.keys()
    assert min(sizes.values()) > 0 and sum(sizes.values()) <= 140_000, sizes


def test_a_camera_that_counts_photons_has_its_own_sliders_and_its_range(open_page, tmp_path: Path) -> None:
    """From a file with a measured MTF: fields, levels, range, saved file and phone."""
    text = new_sensor(preset="emva_basler", focal_length_mm=25, f_number=2.8, pitch_um=3.45)
    text = text.replace("[optics]\n", '[optics]\nmtf = "mtf.csv"\n').replace("blur_sigma_mrad", "# blur")
    (tmp_path / "camera.toml").write_text(text, encoding="utf-8")
    (tmp_path / "mtf.csv").write_text("frequency_cyc_per_mm,mtf\n0,1\n100,0.6\n200,0.3\n400,0.02\n")
    options = ("--target", "r46", "--atmosphere", "visible_23km", "--observer", "csf", "--no-browser")
    with serving("sensor_sim", "explore", tmp_path / "camera.toml", *options) as server:
        page = open_page(server.url, expected_console=REFUSED)
        page.set_default_timeout(SECONDS)
        page.wait_for_selector("#range[data-stage=refined]")
        assert page.locator(field_of("optics.mtf")).inner_text() == "mtf.csv"
        for key in ("noise.bits", "scene.luminance_cd_m2", "observer.efficiency"):
            assert page.locator(field_of(key)).is_visible()
        for key in ("noise.netd_mk", "optics.blur_sigma_mrad", "optics.defocus_waves"):
            assert page.locator(field_of(key)).is_hidden()
        levels = page.locator("input[name=strength]:enabled").evaluate_all("(all) => all.map((one) => one.value)")
        assert levels == ["contrast"]
        before, sentence = table(page, "#range-table"), page.locator("#range-sentences").inner_text()
        assert before[1]["P(correct)"] == "0.75" and before[1]["Range"] in sentence
        assert page.locator("#range-announcement").text_content() in sentence
        sizes = value_of(page, "sizes_detectors")
        painted(page, lambda: type_value(page, "scene.luminance_cd_m2", "0.5"), "refined")
        wait_until(page, f"document.querySelector('#range-sentences').innerText !== {json.dumps(sentence)}")
        assert value_of(page, "sizes_detectors") == sizes
        type_value(page, "noise.full_well_electrons", "1")
        page.locator(f"{field_of('noise.full_well_electrons')}-error").wait_for(state="visible")
        assert line(page).startswith("Not possible")
        painted(page, lambda: page.click("#undo"), "refined")
        of_file = saved(page)
        assert (of_file["optics"]["mtf"], of_file["scene"]["luminance_cd_m2"]) == ("mtf.csv", 0.5)
        assert "mtf.csv beside it" in page.locator("#message").inner_text()
        assert downloaded(page, "#range-svg")[0] == "probability.svg"
        rows = list(csv.reader(downloaded(page, "#csv")[1].decode().splitlines()))
        assert len({len(row) for row in rows}) == 1 and len(rows) > 2
        page.set_viewport_size({"width": WIDTHS[0], "height": 844})
        wait_until(page, FITS, WIDTHS[0])
        assert page.locator("#range-chart").bounding_box()["width"] > 300
        # A sensor without NETD or photons has no range, and the page says why.
        painted(page, lambda: page.locator("#presets").select_option(label=VISIBLE), "refined")
        page.wait_for_selector("#range[data-stage=refused]")
        assert page.locator("#range-error").inner_text().startswith("No range. It follows from thresholds in ΔT")
        painted(page, lambda: page.click("#undo"))
        page.wait_for_selector("#range[data-stage=estimated], #range[data-stage=refined]")
        assert page.locator("#range-error").is_hidden()
        page.goto("about:blank")  # it would ask the server, which ends now
