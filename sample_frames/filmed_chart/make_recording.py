"""Makes the chart of this folder and films it again: python sample_frames/filmed_chart/make_recording.py [FOLDER].

The camera is the simulated one of tests/camera/independent_camera.py, which shares no code with the package.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

import todframes as tod

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests" / "camera"))

from independent_camera import Camera, Chart, looking_at  # noqa: E402

WIDTH, HEIGHT = 312, 176
FRAMES_PER_PAGE = 3
FEWEST_BYTES = [
    cv2.IMWRITE_PNG_COMPRESSION,
    9,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY,
]  # for noise, where nothing repeats
SHARE_OF_PAGE_BEFORE = 0.4  # in the first frame of a page: the monitor changes while the camera exposes


def main(folder: Path) -> None:
    """Write chart.toml and the frames of the recording."""
    with tempfile.TemporaryDirectory() as made:
        tod.chart(
            "screen",
            out=Path(made) / "chart",
            distance_m=10.0,
            sizes_mrad=[0.6, 1.0, 2.0],
            contrasts=[0.05, 0.1, 0.2, 0.4, 0.8],
            repeats=1,
            pixel_pitch_mm=0.277,
            page_duration_s=0.15,
            markers="corners",
        )
        chart = Chart.read(Path(made) / "chart")
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(chart.folder / "chart.toml", folder)
        shutil.rmtree(folder / "recording", ignore_errors=True)
        (folder / "recording").mkdir()
        for number, frame in enumerate(film(chart)):
            assert cv2.imwrite(str(folder / "recording" / f"{number:04d}.png"), frame, FEWEST_BYTES)


def film(chart: Chart) -> list[np.ndarray]:
    """Film all pages, by hand: the camera is turned by 0.4°, and the monitor is seen at 1° and 1.5°."""
    camera = Camera(
        width=WIDTH,
        height=HEIGHT,
        blur_sigma_px=0.6,
        vignetting=0.1,
        electrons_at_white=80_000.0,
        gamma=2.4,
        bits=8,
    )
    scale = 0.97 * HEIGHT / chart.shape[0]
    view = looking_at(chart, width=WIDTH, height=HEIGHT, scale=scale, turn_deg=0.4, tilt_deg=1.0, pan_deg=-1.5)
    rng = np.random.default_rng(13)
    frames, before = [], None
    for page in range(len(chart)):
        image = camera.image(chart.light(page), view)
        for number in range(FRAMES_PER_PAGE):
            share = SHARE_OF_PAGE_BEFORE if number == 0 and before is not None else 0.0
            exposed = image if before is None else (1.0 - share) * image + share * before
            frames.append(camera.expose(exposed, rng))
        before = image
    return frames


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else HERE)
