"""The report in a browser: no message on its console, no request, no sideways scrolling on a desk or a phone.

Skipped where there is no Chromium.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.results.result import read_result

pytestmark = pytest.mark.slow

SAMPLES = Path(__file__).parent.parent / "sample_frames"
WIDTHS = (1280, 1100, 390)
QUIET = (
    "--headless --no-sandbox --disable-gpu --disable-quic --disable-sync --no-first-run "
    "--disable-background-networking --disable-component-update"
)
BROWSER_ITSELF = "not an origin"
"""Who asks, in Chromium's log, where no page does."""
MEASURE = """
<!DOCTYPE html><html><body><script>
const pages = %s, widths = %s, found = {};
let waiting = 0;
for (const [name, text] of Object.entries(pages)) for (const width of widths) {
  const frame = document.createElement("iframe");
  frame.width = width; frame.height = 800; frame.style.border = 0; frame.srcdoc = text;
  waiting += 1;
  frame.onload = () => {
    const page = frame.contentDocument, root = page.documentElement;
    for (const details of page.querySelectorAll("details")) details.open = true;
    const cut = [...page.querySelectorAll(".scroll")].map((one) => one.scrollWidth - one.clientWidth);
    const beyond = Math.max(root.scrollWidth - root.clientWidth, ...cut);
    (found[name] ||= {})[width] = [frame.contentWindow.innerWidth, beyond, root.scrollHeight];
    frame.remove();
    waiting -= 1;
    if (!waiting) document.body.textContent = JSON.stringify(found);
  };
  document.body.append(frame);
}
</script></body></html>
"""


def report_html(result: dict[str, Any]) -> bytes:
    return read_result(json.dumps(result).encode(), "result").to_html().encode()


class Visit(NamedTuple):
    """What a browser did with a page: the document in the end, its console, and where the page made it ask."""

    document: str
    console: list[str]
    requests: list[str]


@pytest.fixture(scope="module")
def chromium() -> str:
    found = [path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))]
    if not found:
        pytest.skip("no Chromium is installed")
    return found[0]


@pytest.fixture
def visit(chromium: str, tmp_path: Path):
    """Opens a page in a new browser, as wide as told."""

    def call(page: Path, width: int = 1280) -> Visit:
        log = tmp_path / "requests.json"
        options = [*QUIET.split(), f"--user-data-dir={tmp_path / 'browser'}", f"--window-size={width},844"]
        options += ["--enable-logging=stderr", f"--log-net-log={log}", "--dump-dom"]
        done = subprocess.run(
            [chromium, *options, page.as_uri()], capture_output=True, text=True, timeout=120, check=True
        )
        shutil.rmtree(tmp_path / "browser")
        events = [event.get("params", {}) for event in json.loads(log.read_text(encoding="utf-8"))["events"]]
        asked = {one["url"] for one in events if one.get("initiator", BROWSER_ITSELF) != BROWSER_ITSELF}
        requests = sorted(url for url in asked if not url.startswith(("file:", "data:")))
        return Visit(done.stdout, re.findall(r":CONSOLE.*", done.stderr), requests)

    return call


def test_a_page_that_misbehaves_is_noticed(visit, tmp_path: Path) -> None:
    """What the other tests look for can be seen."""
    page = tmp_path / "page.html"
    page.write_text(
        '<!DOCTYPE html><img src="http://127.0.0.1:9/x.png"><script>console.error("trouble")</script>',
        encoding="utf-8",
    )
    found = visit(page)
    assert found.requests == ["http://127.0.0.1:9/x.png"]
    assert ['"trouble"' in line for line in found.console] == [True]


@pytest.fixture(scope="module")
def report_of_frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("result")
    assert run(cli, ["score", str(SAMPLES / "naked_eye"), "-o", str(out), "--quiet"]) == 0
    return out / "report.html"


@pytest.mark.parametrize("width", WIDTHS)
def test_report_of_frames_opens_quietly(visit, report_of_frames: Path, width: int) -> None:
    found = visit(report_of_frames, width)
    assert "</footer>" in found.document
    assert (found.console, found.requests) == ([], [])


def test_no_page_scrolls_sideways(visit, results, tmp_path: Path) -> None:
    """Nor one with names of thousands of letters; tables scroll in their own box."""
    results["endless names"] = json.loads(json.dumps(results["compare"]))
    for one in results["endless names"]["algorithms"]:
        one["name"] += "x" * 3000
        one["spec"] = "y" * 3000
    results["endless names"] |= {"dataset": "z" * 3000, "settings": {"s" * 300: "t" * 3000}}
    pages = {name: report_html(result).decode() for name, result in results.items()}
    pages["wide"] = '<!DOCTYPE html><p style="width: 1300px">wide'
    wrapper = tmp_path / "wrapper.html"
    # In JSON within a script nothing but </ could end the script.
    text = MEASURE % (json.dumps(pages).replace("</", "<\\/"), json.dumps(WIDTHS))
    wrapper.write_text(text, encoding="utf-8")
    found = visit(wrapper)
    (measured,) = re.findall(r"<body>(.*)</body>", found.document, re.DOTALL)
    sizes = json.loads(unescape(measured))
    assert sizes.keys() == pages.keys()
    for name, by_width in sizes.items():
        for width in WIDTHS:
            inner_width, beyond, height = by_width[str(width)]
            assert (inner_width, beyond > 0) == (width, name == "wide"), name
            assert height > 1000 or name in ("wide", "naked-eye")
    assert (found.console, found.requests) == ([], [])
