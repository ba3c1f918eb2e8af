"""The report in a browser: no message on its console, no request, no sideways scrolling on a desk or a phone.

Skipped where there is no Chromium.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from edges import edge_image, gaussian

import todframes as tod
from todframes.cli.console import run
from todframes.cli.main import cli
from todframes.results.result import read_result

pytestmark = pytest.mark.slow

SAMPLES = Path(__file__).parents[2] / "sample_frames"
WIDTHS = (1280, 1100, 390)
MEASURE = """() => {
  const root = document.documentElement;
  for (const details of document.querySelectorAll("details")) details.open = true;
  const cut = [...document.querySelectorAll(".scroll")].map((one) => one.scrollWidth - one.clientWidth);
  return [innerWidth, Math.max(root.scrollWidth - root.clientWidth, ...cut), root.scrollHeight];
}"""


@pytest.fixture(scope="module")
def report_of_frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("result")
    assert run(cli, ["score", str(SAMPLES / "naked_eye"), "-o", str(out), "--quiet"]) == 0
    return out / "report.html"


@pytest.mark.parametrize("width", WIDTHS)
def test_report_of_frames_opens_quietly(open_page, report_of_frames: Path, width: int) -> None:
    page = open_page(report_of_frames.as_uri(), width=width)
    assert page.locator("footer").count() == 1


def test_no_page_scrolls_sideways(open_page, results, tmp_path: Path) -> None:
    """Nor one with names of thousands of letters; tables scroll in their own box."""
    results["endless names"] = json.loads(json.dumps(results["compare"]))
    for one in results["endless names"]["conditions"]:
        one["name"] += "x" * 3000
        one["spec"] = "y" * 3000
    results["endless names"] |= {"dataset": "z" * 3000, "settings": {"s" * 300: "t" * 3000}}
    pages = {name: read_result(json.dumps(one).encode(), "result").to_html() for name, one in results.items()}
    pages["mtf"] = tod.mtf(edge_image((72, 72), 6.0, gaussian(0.7)), boxes=[(0, 0, 72, 72)]).to_html()
    pages["wide"] = '<!DOCTYPE html><p style="width: 1300px">wide'
    for name, text in pages.items():
        path = tmp_path / f"{name}.html"
        path.write_text(text, encoding="utf-8")
        page = open_page(path.as_uri())
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 800})
            inner_width, beyond, height = page.evaluate(MEASURE)
            assert (inner_width, beyond > 0) == (width, name == "wide"), name
            assert height > 1000 or name in ("wide", "naked-eye")
