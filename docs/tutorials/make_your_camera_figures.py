"""Makes the pictures of your_camera.md: python docs/tutorials/make_your_camera_figures.py [FOLDER].

Pictures go to FOLDER/your_camera; by default FOLDER is that of this script. The chart has the triangles of
the recording in sample_frames/filmed_chart, and more markers.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import cv2

import todframes as tod

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
SAMPLE = ROOT / "sample_frames" / "filmed_chart"
PAGE = 1
FRAMES_PER_PAGE = 3
CHART = {
    "distance_m": 10.0,
    "sizes_mrad": [0.6, 1.0, 2.0],
    "contrasts": [0.05, 0.1, 0.2, 0.4, 0.8],
    "repeats": 1,
    "pixel_pitch_mm": 0.277,
    "page_duration_s": 0.15,
}


def main(folder: Path) -> None:
    """Write a page of the chart, the frame that shows it, and the curve."""
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as made:
        chart = Path(made) / "chart"
        tod.chart("screen", out=chart, **CHART)
        page = cv2.imread(str(chart / "pages" / f"{PAGE:04d}.png"), cv2.IMREAD_GRAYSCALE)
        small = cv2.resize(page, (624, 351), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(folder / "page.png"), small)
        frame = SAMPLE / "recording" / f"{FRAMES_PER_PAGE * (PAGE + 1) - 1:04d}.png"
        large = cv2.resize(
            cv2.imread(str(frame), cv2.IMREAD_GRAYSCALE), (624, 352), interpolation=cv2.INTER_NEAREST
        )
        cv2.imwrite(str(folder / "frame.png"), large)
        dataset = tod.import_recordings(
            SAMPLE / "recording", out=Path(made) / "camera", chart=SAMPLE / "chart.toml", frames_per_second=20
        )
        tod.score(dataset.path).plot_tod().figure.savefig(folder / "tod_curve.png")


if __name__ == "__main__":
    main((Path(sys.argv[1]) if len(sys.argv) > 1 else HERE) / "your_camera")
