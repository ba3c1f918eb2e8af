"""Makes the pictures of the README, the site's first page and the tutorial.

python docs/tutorials/make_first_look_figures.py [FOLDER]

Pictures go to FOLDER/first_look, and that of the tutorial to FOLDER; by default FOLDER is that of this script. The
page of a report needs Chromium and Playwright; the film of a chart and its curve are those of your_camera.md. The
curve of the tutorial is what its code draws.
"""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
from contextlib import chdir
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

import todframes as tod

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
REPORT_PX = (1100, 960)
MARGIN_PX = 10
GAP_PX = 24
BROWSERS = ("chromium", "chromium-browser", "google-chrome")


def main(folder: Path) -> None:
    """Write the top of a report's page, a filmed chart beside its curve, and the curve of the tutorial."""
    folder = folder.absolute()
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as made, chdir(ROOT):  # the page has the path as it is given
        tod.score("sample_frames/naked_eye").save(Path(made) / "result")
        photograph(Path(made) / "result" / "report.html", folder / "report.png")
    frame, curve = (cv2.imread(str(HERE / "your_camera" / name)) for name in ("frame.png", "tod_curve.png"))
    height = frame.shape[0]
    width = round(curve.shape[1] * height / curve.shape[0])
    gap = np.full((height, GAP_PX, 3), 255, np.uint8)
    beside = cv2.resize(curve, (width, height), interpolation=cv2.INTER_AREA)
    write_png(folder / "camera.png", np.hstack([frame, gap, beside]))
    draw_tutorial(folder.parent / "tutorial.png")


def draw_tutorial(picture: Path) -> None:
    """Run the code of the tutorial, which saves a picture in the current folder."""
    code = re.findall(r"^```python\n(.*?)^```$", (HERE / "tutorial.md").read_text(), re.MULTILINE | re.DOTALL)
    with tempfile.TemporaryDirectory() as made, chdir(made):
        exec("\n".join(code), {})
        shutil.copy("tod_curve.png", picture)


def photograph(page: Path, picture: Path) -> None:
    """Write the upper part of a page, as a browser shows it, up to the end of its first table."""
    path = next(found for name in BROWSERS if (found := shutil.which(name)))
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=path, args=["--no-sandbox"])
        shown = browser.new_page(viewport=dict(zip(("width", "height"), REPORT_PX, strict=True)))
        shown.goto(page.as_uri())
        end = shown.locator("table").first.bounding_box()
        assert end is not None
        height = end["y"] + end["height"] + MARGIN_PX
        content = shown.screenshot(clip={"x": 0, "y": 0, "width": REPORT_PX[0], "height": height})
        browser.close()
    write_png(picture, cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR))


def write_png(path: Path, pixels: np.ndarray) -> None:
    """Write a PNG as small as OpenCV can."""
    cv2.imwrite(str(path), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main((Path(sys.argv[1]) if len(sys.argv) > 1 else HERE) / "first_look")
