"""Make the pictures of the explorer for explore.md in Chromium: a page with a pinned curve, and ranges.

python docs/how_to/make_explorer_picture.py [OUT.png] [WIDTH] [light|dark]    # the page
python docs/how_to/make_explorer_picture.py --range [OUT.png]                 # probability against range
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from browser import serving, wait_until, watched  # noqa: E402
from PIL import Image  # noqa: E402
from playwright.sync_api import sync_playwright  # noqa: E402

from sensor_sim import new_sensor  # noqa: E402

if TYPE_CHECKING:
    from playwright.sync_api import FloatRect

CAMERA = ROOT / "sample_frames" / "star_like.toml"
COLOURS = 64
"""Number of colours of the picture: a third of the file's size."""

MARGIN_PX = 12
"""Empty border of the picture of ranges."""

SETTLED_MS = 3000
"""Time after which the ranges are those of the refined curve."""

REFINED = (
    "(() => { const { asked, sequence, stage } = document.querySelector('#curve').dataset;"
    " return asked === sequence && stage === 'refined'; })()"
)


def draw_page() -> None:
    """Draw the page with the sample sensor pinned, and half of its aperture."""
    out, width, scheme = (
        *sys.argv[1:],
        *[str(HERE / "explore" / "page.png"), "1280", "light"][len(sys.argv) - 1 :],
    )
    colours = cast("Literal['light', 'dark']", scheme)
    with sync_playwright() as play, serving("sensor_sim", "explore", CAMERA, "--no-browser") as server:
        chromium = play.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        with watched(chromium, server.url, width=int(width), height=880, color_scheme=colours) as page:
            wait_until(page, REFINED)
            page.click("#pin")
            page.fill("#field-optics-aperture_mm", "110")
            page.fill("#field-sizes_detectors", "3, 4, 5, 6, 8, 10")
            page.press("#field-sizes_detectors", "Tab")
            wait_until(page, REFINED)
            wait_until(page, "document.querySelectorAll('#stages canvas').length > 0")
            page.evaluate(
                "scrollTo(0, 0); document.querySelector('#controls').scrollTo(0, 0); document.activeElement.blur()"
            )
            save(page.screenshot(full_page=width != "1280"), out)
        chromium.close()


def draw_range() -> None:
    """Draw the section with the range of the page's camera, target and air."""
    out = sys.argv[2] if len(sys.argv) > 2 else HERE / "explore" / "range.png"
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
        camera = Path(folder) / "camera.toml"
        camera.write_text(new_sensor(preset="emva_basler", focal_length_mm=25, f_number=2.8, pitch_um=3.45))
        seen = ("--observer", "csf", "--target", "r46", "--atmosphere", "visible_23km", "--no-browser")
        with serving("sensor_sim", "explore", camera, *seen) as server:
            chromium = play.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
            with watched(chromium, server.url, width=1280, height=880, color_scheme="light") as page:
                wait_until(page, REFINED)
                wait_until(page, "document.querySelectorAll('#range-sentences li').length > 0")
                page.wait_for_timeout(SETTLED_MS)
                box = page.locator("#range").bounding_box()
                assert box is not None
                top, left = box["y"], box["x"] - MARGIN_PX
                width, height = box["width"] + 2 * MARGIN_PX, box["height"] + MARGIN_PX
                clip = cast("FloatRect", {"x": left, "y": top, "width": width, "height": height})
                save(page.screenshot(full_page=True, clip=clip), out)
            chromium.close()


def save(screenshot: bytes, out: str | Path) -> None:
    """Write a picture with few colours."""
    picture = Image.open(io.BytesIO(screenshot)).convert("RGB")
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(out, optimize=True)


if __name__ == "__main__":
    (draw_range if "--range" in sys.argv[1:2] else draw_page)()
