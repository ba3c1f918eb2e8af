"""Make the picture of the explorer for docs/explore.md: a page with a pinned curve, in Chromium.

python docs/make_explorer_picture.py [OUT.png] [WIDTH] [light|dark]
"""

from __future__ import annotations

import io
import sys
from pathlib import Path
from typing import Literal, cast

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests"))

from browser import serving, wait_until, watched  # noqa: E402
from PIL import Image  # noqa: E402
from playwright.sync_api import sync_playwright  # noqa: E402

CAMERA = HERE.parent / "sample_frames" / "star_like.toml"
COLOURS = 64
"""Number of colours of the picture: a third of the file's size."""

REFINED = (
    "(() => { const { asked, sequence, stage } = document.querySelector('#curve').dataset;"
    " return asked === sequence && stage === 'refined'; })()"
)


def main() -> None:
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
            picture = Image.open(io.BytesIO(page.screenshot(full_page=width != "1280"))).convert("RGB")
            picture.quantize(COLOURS, dither=Image.Dither.NONE).save(out, optimize=True)
        chromium.close()


if __name__ == "__main__":
    main()
