"""Charts for a monitor: what the written images hold, measured without the code that drew them."""

from __future__ import annotations

import base64
import json
import re
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import error_line

import todframes as tod
from todframes.base.errors import SettingsError
from todframes.charts.layout import Chart, page_of, read_chart
from todframes.display.display import TILE, LuminanceTable, blue_noise, dithered

PITCH_MM = 0.25
MONITOR = {"width_px": 640, "height_px": 481, "pixel_pitch_mm": PITCH_MM, "marker_mm": 17.5}
CONTRASTS = (0.004, 0.05, 0.8)
ARUCO = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)


def srgb(code: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1, white = 100 cd/m²."""
    return 100.0 * np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


@pytest.fixture(scope="module", params=[1, -1], ids=["bright", "dark"])
def made(request, tmp_path_factory) -> tuple[Path, Chart]:
    folder = tmp_path_factory.mktemp("chart") / "made"
    asked = {"distance_m": 10, "sizes_mrad": [1, 2], "contrasts": CONTRASTS, "polarity": request.param}
    asked["name"] = "a <chart>"
    return folder, tod.chart("screen", out=folder, repeats=2, **asked, **MONITOR)


def test_written_is_what_was_returned(made) -> None:
    folder, chart = made
    assert read_chart(folder) == chart
    assert sorted(path.name for path in folder.iterdir()) == ["chart.toml", "pages", "play.html"]
    files = sorted(path.relative_to(folder).as_posix() for path in (folder / "pages").iterdir())
    assert files == [page.file for page in chart.pages]
    player = (folder / "play.html").read_text(encoding="utf-8")
    assert player.startswith("<!DOCTYPE html>") and player.endswith("</html>\n") and "{{" not in player
    assert "<title>a &lt;chart&gt;" in player
    grey = "rgb(137, 137, 137)"  # of a quarter of white by sRGB
    settings = {"width_px": 640, "height_px": 481, "page_duration_s": 1.0, "bits": 8, "background": grey}
    assert json.dumps(settings) in player
    shown = re.findall(r'^"([\w+/=]+)",$', player, re.MULTILINE)
    assert [base64.b64decode(one) for one in shown] == [(folder / one).read_bytes() for one in files]


def test_all_triangles_equally_often_and_each_once_in_a_block(made) -> None:
    _, chart = made
    shown = [(one.size_mrad, one.contrast, one.orientation) for page in chart.pages for one in page.triangles]
    assert len(shown) == len(chart.pages) == 2 * len(CONTRASTS) * 4 * 2
    assert set(Counter(shown).values()) == {2}
    first, second = shown[:24], shown[24:]
    assert set(first) == set(second) and len(set(first)) == 24
    assert first != second


def test_markers_name_page_and_chart_and_stand_where_it_says(made) -> None:
    folder, chart = made
    for page in chart.pages[::7]:
        found, ids, _ = cv2.aruco.ArucoDetector(ARUCO).detectMarkers(cv2.imread(str(folder / page.file), -1))
        of_corner = {int(one) % 4: k for k, one in enumerate(ids.ravel())}
        assert page_of([int(ids.ravel()[of_corner[k]]) for k in range(4)]) == (page.number, chart.key)
        centres = np.array([found[of_corner[k]][0].mean(axis=0) for k in range(4)])
        # Corners are found to whole pixels, so a centre to half of one.
        assert np.abs((centres + 0.5) * PITCH_MM - chart.markers.centres_mm).max() <= 0.5 * PITCH_MM
    with pytest.raises(tod.DataError, match=r"found no frame of the page of .* with patches"):
        tod.noise(np.stack([cv2.imread(str(folder / page.file), -1)] * 2), chart=folder)


def test_markers_in_the_corners_alone_can_be_asked_for(tmp_path) -> None:
    chart = tod.chart("screen", out=tmp_path / "s", distance_m=5, sizes_mrad=[1], markers="corners", **MONITOR)
    paper = tod.chart(
        "print", out=tmp_path / "p", distance_m=5, sizes_mrad=[1], contrasts=[0.5], markers="corners"
    )
    assert not chart.markers.borders and not paper.markers.borders
    assert "borders" not in (tmp_path / "s" / "chart.toml").read_text()
    falling, short = (LuminanceTable(np.array(x), np.array(y)) for x, y in (([0, 1], [9, 5]), ([0.1, 1], [5, 9])))
    for asked, message in (
        ({"markers": "all"}, "markers: found 'all'"),
        ({"eotf": "gamma", "gamma": 1000.0}, "eotf: found luminances that do not rise with the code value"),
        ({"eotf": "lut", "lut": falling}, "lut: found luminances that do not rise with the code value"),
        ({"eotf": "lut", "lut": short}, r"lut: code_value runs from 0\.1 to 1, expected 0 to 1 for the pages"),
    ):
        with pytest.raises(SettingsError, match=message):
            tod.chart("screen", out=tmp_path / "t", **{"distance_m": 5, "sizes_mrad": [1], **MONITOR, **asked})


def test_triangles_have_the_contrast_place_and_orientation_that_the_chart_states(made) -> None:
    folder, chart = made
    background = chart.screen.background_luminance_cd_m2
    y, x = (np.mgrid[: MONITOR["height_px"], : MONITOR["width_px"]] + 0.5) * PITCH_MM
    for page in chart.pages[:24]:
        (triangle,) = page.triangles
        codes = cv2.imread(str(folder / page.file), -1)
        assert codes.dtype == np.uint8 and codes.shape == y.shape
        near = np.hypot(x - triangle.x_mm, y - triangle.y_mm) < 2.0 * triangle.size_mm
        excess = np.where(near, srgb(codes / 255.0) / background - 1.0, 0.0)
        area_px = (triangle.size_mm / PITCH_MM) ** 2
        step = 2.4 / codes[0, 0]  # relative; the steepest that a power of 2.4 may have
        # The sum is off by half a step of a pixel and differs as much among orientations; six digits are written.
        assert excess.sum() == pytest.approx(triangle.contrast * area_px, rel=1e-6, abs=step)
        assert triangle.contrast == pytest.approx(triangle.contrast_asked or triangle.contrast, rel=0.01)
        # A weak triangle has some hundred lit pixels. Were they at random, their centroid would be off by
        # 0.36 sizes / √100; their even spread leaves less.
        centroid = [float((place * excess).sum() / excess.sum()) for place in (x, y)]
        tolerance = (0.03 if triangle.dithered and abs(triangle.contrast) < 0.01 else 0.003) * triangle.size_mm
        assert centroid == pytest.approx([triangle.x_mm, triangle.y_mm], abs=tolerance)
        if abs(triangle.contrast) < 0.005:  # below a step of the code
            steps = codes[140:-140, 160:-160].astype(int) - codes[0, 0]
            assert triangle.dithered and {*steps.ravel().tolist()} == {0, chart.polarity}
        # The apex is twice as far from the centroid as the opposite side.
        rows, columns = np.nonzero(excess)
        reach = {
            "up": triangle.y_mm - y[rows.min(), 0],
            "down": y[rows.max(), 0] - triangle.y_mm,
            "left": triangle.x_mm - x[0, columns.min()],
            "right": x[0, columns.max()] - triangle.x_mm,
        }
        sizes = (2.0 / 3.0**0.75, 1.0 / 3.0**0.75, 3.0**-0.25)  # to the apex, the side, and half of the side
        assert reach[triangle.orientation] == pytest.approx(sizes[0] * triangle.size_mm, abs=8 * PITCH_MM)
        assert max(reach, key=reach.__getitem__) == triangle.orientation


def test_ten_bits_are_in_sixteen(tmp_path: Path) -> None:
    asked = {"distance_m": 10, "sizes_mrad": [2], "contrasts": [0.004], "repeats": 1}
    chart = tod.chart("screen", out=tmp_path / "c", bits=10, eotf="gamma", gamma=2.2, **asked, **MONITOR)
    stored = cv2.imread(str(tmp_path / "c" / "pages" / "0000.png"), -1)
    assert stored.dtype == np.uint16
    codes = stored * (1023 / 65535)
    assert np.abs(codes - np.rint(codes)).max() < 0.01
    assert set(np.unique(stored)) >= {0, 65535}
    background = round(codes[0, 0])
    assert chart.screen.background_luminance_cd_m2 == pytest.approx(100 * (background / 1023) ** 2.2)
    assert background == 545  # 1023 · 0.25^(1/2.2), rounded


def test_dither_keeps_the_sum() -> None:
    generator = np.random.default_rng(3)
    luminance_of_code = np.cumsum(generator.uniform(0.1, 2.0, 64))
    for low, high in ((luminance_of_code[0], luminance_of_code[-1]), (5.0, 5.5), (5.0, 5.0)):
        wanted = generator.uniform(low, high, (70, 90))
        codes = dithered(wanted, luminance_of_code)
        shown = luminance_of_code[codes]
        assert abs((shown - wanted).sum()) <= np.diff(luminance_of_code).max() / 2
        assert (np.abs(np.searchsorted(luminance_of_code, wanted) - codes) <= 1).all()
    codes = generator.integers(0, 64, (70, 90))
    assert (dithered(luminance_of_code[codes], luminance_of_code) == codes).all()


def test_a_blurred_dithered_triangle_is_the_ideal_one(tmp_path: Path) -> None:
    """Standard deviation of the difference inside the triangle, as a share of the contrast: charts.md."""
    asked = {"distance_m": 10, "sizes_mrad": [1], "contrasts": [0.005, 0.01, 0.03], "repeats": 1}
    chart = tod.chart("screen", out=tmp_path / "c", **asked, **MONITOR)
    most = {(0.005, 1.0): 0.13, (0.005, 2.0): 0.045, (0.01, 1.0): 0.075, (0.01, 2.0): 0.025}
    most |= {(0.03, 1.0): 0.035, (0.03, 2.0): 0.0125}
    box = np.s_[190:-190, 270:-270]
    for page in chart.pages:
        (triangle,) = page.triangles
        codes = cv2.imread(str(tmp_path / "c" / page.file), -1)[box]
        shape = {"orientation": triangle.orientation, "size_px": 40.0}
        middle = {"x_px": (codes.shape[1] - 1) / 2, "y_px": (codes.shape[0] - 1) / 2}
        covered = tod.coverage(codes.shape, **shape, **middle)
        ideal = triangle.contrast * covered
        excess = srgb(codes / 255.0) / chart.screen.background_luminance_cd_m2 - 1.0
        for blur_px in (1.0, 2.0):
            left = cv2.GaussianBlur(excess - ideal, (0, 0), blur_px)[covered > 0.0]
            asked_for = round(triangle.contrast_asked or triangle.contrast, 4)
            assert np.sqrt(np.mean(left**2)) < most[asked_for, blur_px] * triangle.contrast


def test_dither_has_no_coarse_grain() -> None:
    thresholds = blue_noise()
    assert np.array_equal(np.sort(thresholds, axis=None), (np.arange(TILE**2) + 0.5) / TILE**2)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(TILE), np.fft.fftfreq(TILE)))
    coarse = (frequency > 0) & (frequency < 0.1)
    for share in (0.1, 0.3, 0.5, 0.8):
        power = np.abs(np.fft.fft2(thresholds < share)) ** 2 / TILE**2
        # White noise would have share · (1 − share) at all frequencies.
        assert power[coarse].mean() < 0.1 * share * (1 - share)


def test_the_seed_gives_the_order(tmp_path: Path) -> None:
    texts = []
    for place, seed in enumerate((5, 5, 6)):
        asked = {"distance_m": 10, "sizes_mrad": [1], "contrasts": [0.2, 0.4], "repeats": 1, "rng": seed}
        tod.chart("screen", out=tmp_path / str(place), **asked, **MONITOR)
        texts.append((tmp_path / str(place) / "chart.toml").read_text(encoding="utf-8"))
    assert texts[0] == texts[1] != texts[2]


REFUSED = {
    # Markers of 63 pixels of 0.25 mm, 12.375 mm from the edges; their white border ends 57.5 mm from the middle.
    "--sizes-mrad=8": "8 mrad at 10 m are 80 mm, and with the background that the observer needs 400 mm; the page "
    "has 115 mm between its edges and markers; expected at most 2.3 mrad, or a smaller distance",
    "--sizes-mrad=0.1": "1 mm, 4 pixels of the monitor, whose edges are then too coarse; expected at least 2 mm",
    "--sizes-mrad=1,1": "--sizes-mrad: found 1.0, 1.0, expected each value once",
    "--sizes-mrad=": "--sizes-mrad: found '', expected numbers",
    "--contrasts=5": "--contrasts: found 5, expected 3 at most",
    "--contrasts=0.0001": "would raise 10 of the triangle's 1600 pixels by a code step, which are some dots "
    "and no triangle; expected a contrast of at least 0.00036",
    "--distance-m=0": "--distance-m: found 0.0, expected a number from 1e-06 to 1e+06",
    "--eotf=gamma": "--gamma: is missing",
    "--marker-mm=1": "--marker-mm: found 1, expected 3.5 (two pixels a module) to 24 (a fifth of the page)",
    "--background-luminance-cd-m2=100": "which is black or white; expected a luminance between 0 and 100",
    "--repeats=20000": "found 80000 triangles (sizes × levels × 4 orientations × repeats), expected at most 62500",
    "--plate-mm=9": "--plate-mm: is given, but a screen chart has none; it is for thermal",
    "--delta-t-k=1": "--delta-t-k: is given, but a screen chart has none; it is for thermal",
    "--name=a\nb": "--name: found 'a\\nb', expected a text of one line",
}


@pytest.mark.parametrize("more", [[], ["--display=reference_sdr"]])
def test_a_missing_pitch_is_told_by_its_option(more: list[str], tmp_path: Path, todframes) -> None:
    given = ["--distance-m=10", "--sizes-mrad=1", *more, "-o", tmp_path / "chart"]
    assert error_line(todframes("chart", "--for=screen", *given)) == "error: --pixel-pitch-mm is missing\n"


@pytest.mark.parametrize("option", REFUSED)
def test_what_a_monitor_cannot_show_is_one_line(option: str, tmp_path: Path, todframes) -> None:
    place = tmp_path / "chart"
    given = ["--distance-m=10", "--sizes-mrad=1", "--contrasts=0.2", "--pixel-pitch-mm=0.25"]
    given += ["--width-px=640", "--height-px=480", "--repeats=1"]
    error = error_line(todframes("chart", "--for=screen", *given, option, "-o", place))
    assert REFUSED[option] in error and error.startswith("error: ")
    assert not place.exists()


def test_a_measured_monitor(tmp_path: Path) -> None:
    """Luminances of a table, and a pitch, from a file; options given beside it come first."""
    (tmp_path / "lut.csv").write_text("code_value,luminance_cd_m2\n0,1\n0.5,21\n1,81\n", encoding="utf-8")
    (tmp_path / "monitor.toml").write_text(
        'schema = 1\n[display]\neotf = "lut"\nlut = "lut.csv"\npixel_pitch_mm = 0.5\nviewing_distance_mm = 600\n',
        encoding="utf-8",
    )
    asked = {"distance_m": 10, "sizes_mrad": [2], "contrasts": [0.5], "repeats": 1, "height_px": 480}
    asked |= {"width_px": 640, "display": tmp_path / "monitor.toml"}
    chart = tod.chart("screen", out=tmp_path / "c", **asked)
    assert (chart.screen.pixel_pitch_mm, chart.page_width_mm) == (0.5, 320.0)
    # A quarter of white is 20.25; code 123 has 1 + 40 · 123 / 255.
    assert chart.screen.background_luminance_cd_m2 == pytest.approx(1 + 40 * 123 / 255)
    assert np.array_equal(read_chart(tmp_path / "c").screen.lut.luminance_cd_m2, [1.0, 21.0, 81.0])
    other = tod.chart("screen", out=tmp_path / "d", pixel_pitch_mm=0.25, **asked)
    assert other.page_width_mm == 160.0
