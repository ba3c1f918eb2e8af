"""Reading, measuring and importing a film of ten minutes against decoding it alone, and the memory of each."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from timing import Row, process

from todframes.charts.layout import CORNERS, Chart, Markers, Page, Point, Screen, Triangle, write_chart
from todframes.stimulus import ORIENTATIONS, coverage

N_FRAMES, ROWS, COLUMNS, RATE, FRAMES_PER_PAGE = 18_000, 512, 640, 30, 30
MODULE_PX, NOISE = 6, 0.01
"""The chart is seen pixel by pixel, since other geometries take as long; noise is what makes decoding slow."""

DECODE = """
import sys, av
with av.open(sys.argv[1]) as container:
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    print(sum(1 for _ in container.decode(stream)))
"""
READ = """
import sys
from todframes.recordings.opening import open_recordings
print(sum(int(frame.values[0, 0]) for one in open_recordings(sys.argv[1]) for frame in one.frames()))
"""
MEASURE = "import sys; import todframes as tod; tod.noise(sys.argv[1])"
IMPORT = (
    "import sys; import todframes as tod; tod.import_recordings(sys.argv[1], chart=sys.argv[2], out=sys.argv[3])"
)


def rows() -> list[Row]:
    """Wall times and memory of whole processes, one after the other."""
    with tempfile.TemporaryDirectory() as folder:
        video, chart, out = (Path(folder, name) for name in ("film.mkv", "chart.toml", "dataset"))
        layout = _chart(N_FRAMES // FRAMES_PER_PAGE)
        write_chart(chart, layout)
        _film(video, layout)
        decoding = process("-c", DECODE, str(video)).wall_s
        costs = {
            "reading": process("-c", READ, str(video)),
            "measuring the noise": process("-c", MEASURE, str(video)),
            "import": process("-c", IMPORT, str(video), str(chart), str(out)),
        }
    what = f"{N_FRAMES} frames of {COLUMNS} × {ROWS}, FFV1 gray16"
    speeds = [
        Row(f"decode ({decoding:.0f} s) ÷ {name} ({cost.wall_s:.0f} s): {what}", decoding / cost.wall_s, ">= 0.5")
        for name, cost in costs.items()
    ]
    return speeds + [Row(f"peak memory of {name} in MB", cost.peak_mb, "<= 400") for name, cost in costs.items()]


def _chart(n_pages: int) -> Chart:
    """Return a chart whose millimetres are pixels: pixel (c, r) is centred on (c + 0.5, r + 0.5) mm."""
    inset = 1.5 * 7 * MODULE_PX
    places = [(inset, inset), (COLUMNS - inset, inset), (COLUMNS - inset, ROWS - inset), (inset, ROWS - inset)]
    corners = {name: Point(x_mm=x, y_mm=y) for name, (x, y) in zip(CORNERS, places, strict=True)}
    pages = []
    for number in range(n_pages):
        shown = {"orientation": ORIENTATIONS[number % 4], "contrast": 0.1 * (1 + number // 4 % 5)}
        one = Triangle(size_mrad=2.0, size_mm=20.0, x_mm=320.0, y_mm=256.0, **shown)  # type: ignore[arg-type]
        pages.append(Page(number=number, file=f"{number}.png", triangles=(one,)))
    screen = Screen(
        width_px=COLUMNS, height_px=ROWS, pixel_pitch_mm=1.0, background_luminance_cd_m2=50.0, page_duration_s=1.0
    )
    return Chart(
        kind="screen",
        name="benchmark",
        distance_m=10.0,
        page_width_mm=float(COLUMNS),
        page_height_mm=float(ROWS),
        pages=tuple(pages),
        markers=Markers(side_mm=7.0 * MODULE_PX, **corners).with_borders(free_mm=120.0, step_mm=1.0),
        screen=screen,
    ).with_key()


def _film(path: Path, chart: Chart) -> None:
    import av

    rng = np.random.default_rng(1)
    grains = rng.standard_normal((8, ROWS, COLUMNS)).astype(np.float32) * NOISE
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=RATE)
        stream.pix_fmt, stream.width, stream.height = "gray16le", COLUMNS, ROWS
        for number in range(N_FRAMES):
            if number % FRAMES_PER_PAGE == 0:
                clean = _page(chart, number // FRAMES_PER_PAGE)
            noisy = clean + np.roll(grains[number % 8], int(rng.integers(ROWS)), axis=0)
            stored = np.rint(np.clip(noisy, 0, 1) * 65535).astype(np.uint16)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(stored, format="gray16le")))
        container.mux(stream.encode())


def _page(chart: Chart, number: int) -> np.ndarray:
    image = np.full((ROWS, COLUMNS), 0.5, np.float32)
    for bits, (x, y) in chart.drawn_markers(chart.pages[number]):
        shown = np.kron(np.pad(bits, 1, constant_values=True), np.ones((MODULE_PX, MODULE_PX)))
        top, left = round(y - len(shown) / 2), round(x - len(shown) / 2)
        image[top : top + len(shown), left : left + len(shown)] = 0.05 + 0.9 * shown
    one = chart.pages[number].triangles[0]
    covered = coverage((ROWS, COLUMNS), size_px=20.0, x_px=319.5, y_px=255.5, orientation=one.orientation)
    return image * (1.0 + one.contrast * covered.astype(np.float32))
