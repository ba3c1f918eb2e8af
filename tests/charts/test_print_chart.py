"""Charts on paper and thermal plates: lengths, greys and places read from the files, by code of its own."""

from __future__ import annotations

import re
import zlib
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
from conftest import error_line

import todframes as tod
from todframes.base.errors import SettingsError
from todframes.charts import print as print_chart
from todframes.charts.layout import Chart, Triangle, page_of, read_chart
from todframes.importing.schedule import read_schedule

MM_PER_POINT = 25.4 / 72.0
SVG = "{http://www.w3.org/2000/svg}"
CONTRASTS = [0.05, 0.8]
TURNS = {"up": 0, "right": 90, "down": 180, "left": 270}


def corners_mm(one: Triangle) -> np.ndarray:
    side = one.size_mm * np.sqrt(4.0 / np.sqrt(3.0))
    angles = np.radians(np.array([0.0, 120.0, 240.0]) + TURNS[one.orientation])
    radius = side / np.sqrt(3.0)
    return np.column_stack([one.x_mm + radius * np.sin(angles), one.y_mm - radius * np.cos(angles)])


def same_triangle(found: np.ndarray, one: Triangle, tolerance_mm: float) -> bool:
    distances = np.linalg.norm(found[:, None] - corners_mm(one)[None], axis=2)
    return bool(distances.min(axis=1).max() < tolerance_mm)


def polygons(path: Path) -> list[tuple[np.ndarray, str]]:
    """Corners in mm and fill of each polygon of an SVG file whose user unit is a millimetre."""
    root = ElementTree.parse(path).getroot()
    size = root.get("width"), root.get("height")
    assert root.get("viewBox") == f"0 0 {size[0].removesuffix('mm')} {size[1].removesuffix('mm')}"
    return [
        (np.array([pair.split(",") for pair in one.get("points").split()], float), one.get("fill"))
        for one in root.iter(f"{SVG}polygon")
    ]


def pdf_paths(content: bytes) -> tuple[list[tuple[float, ...]], list[list[np.ndarray]]]:
    """Sizes of a PDF's pages in mm, and the corners of the paths of each page, in mm from its top left corner."""
    boxes = [
        tuple(float(number) * MM_PER_POINT for number in found.split())
        for found in re.findall(rb"/MediaBox \[([^\]]*)\]", content)
    ]
    pages = []
    for stream in re.findall(rb"stream\r?\n(.*?)\r?\nendstream", content, re.DOTALL):
        try:
            text = zlib.decompress(stream).decode("latin-1")
        except zlib.error:
            continue
        if text.startswith("/DeviceRGB"):  # else it is a letter of a font
            paths = re.findall(r"((?:[-\d.]+ [-\d.]+ [ml]\n)+)h", text)
            points = ([line.split()[:2] for line in path.splitlines()] for path in paths)
            pages.append([np.array(one, float) * MM_PER_POINT for one in points])
    height = boxes[0][3]
    return boxes, [[np.column_stack([path[:, 0], height - path[:, 1]]) for path in page] for page in pages]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, Chart]:
    folder = tmp_path_factory.mktemp("chart") / "made"
    asked = {"distance_m": 10, "sizes_mrad": [1, 2], "contrasts": CONTRASTS, "repeats": 2, "name": "no $^{ TeX"}
    return folder, tod.chart("print", out=folder, paper_width_mm=400, paper_height_mm=280, **asked)


def test_sheets_have_the_lengths_and_greys_that_are_stated(made) -> None:
    folder, chart = made
    assert read_chart(folder) == chart
    boxes, pages = pdf_paths((folder / "chart.pdf").read_bytes())
    assert len(boxes) == len(pages) == len(chart.pages)
    # Matplotlib writes six digits.
    assert np.allclose(boxes, [0.0, 0.0, 400.0, 280.0], atol=1e-3)
    for page, paths in zip(chart.pages, pages, strict=True):
        assert len({one.size_mrad for one in page.triangles}) == 1
        root = ElementTree.parse(folder / page.file).getroot()
        assert (root.get("width"), root.get("height")) == ("400mm", "280mm")
        drawn = polygons(folder / page.file)
        background = reflectance(drawn[0][1])
        of_pdf = [one[:3] for one in paths if len(one) == 3]
        triangles = [(path, fill) for path, fill in drawn if len(path) == 3]
        assert len(of_pdf) == len(triangles) == len(page.triangles)
        for one in page.triangles:
            assert sum(same_triangle(path, one, 1e-3) for path in of_pdf) == 1
            (fill,) = [fill for path, fill in triangles if same_triangle(path, one, 1e-3)]
            assert reflectance(fill) / background - 1.0 == pytest.approx(one.contrast, rel=1e-5)
            # Half a step of a code value is 1.2 % of the background here.
            assert one.contrast == pytest.approx(one.contrast_asked or one.contrast, abs=0.013)
            # Neighbours stay out of its field also when blurred, or larger by perspective.
            middle, square = np.array([one.x_mm, one.y_mm]), one.size_mm * np.array([[-1, -1], [1, 1]])
            field, wide = middle + 2.5 * square, middle + 2.9 * square
            grey = drawn[0][0]  # An SVG has five decimals.
            assert (field[0] >= grey.min(axis=0) - 1e-5).all() and (field[1] <= grey.max(axis=0) + 1e-5).all()
            for other in page.triangles:
                inside = (corners_mm(other) > wide[0]) & (corners_mm(other) < wide[1])
                assert inside.all(axis=1).any() == (other is one)
        for patch in page.patches:
            at = [fill for path, fill in drawn if np.allclose(path.mean(axis=0), [patch.x_mm, patch.y_mm])]
            assert reflectance(at[0]) == pytest.approx(patch.reflectance, rel=1e-5)
    shown = Counter(
        (one.size_mrad, one.contrast, one.orientation) for page in chart.pages for one in page.triangles
    )
    assert len(shown) == 2 * len(CONTRASTS) * 4 and set(shown.values()) == {2}
    assert max(len(page.triangles) for page in chart.pages) > 1


def reflectance(fill: str) -> float:
    """Default paper, 0.85, and black, 0.04, with sRGB between them."""
    code = int(re.fullmatch(r"rgb\((\d+),\1,\1\)", fill)[1]) / 255.0
    return 0.04 + 0.81 * (code / 12.92 if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4)


PARTS = {
    # margin 10, a marker of 8 % of 280 mm, 22.4, of 7 modules of 3.2; bands of 9 modules, 28.8, and 2 beside each.
    # The ruler may reach to two thirds of the way between markers, 24.4 + 2/3 * 351.2, less half a band and 2.
    (400, 280): (
        (28.8, 10, 40.8, 380, 198.4),
        [(40.8, 142.8), (216.4, 142.8)],
        [(40.8, 200), (273.6, 85.6)],
        [(200, 24.4), (257.2, 255.6)],
    ),
    # Modules of 2: 19 + 2/3 * 112 - 11 leaves 52.67 from 30 on for a ruler of 50, beside which the marker stands.
    (150, 90, 14): ((18, 10, 30, 130, 30), [(30, 34), (86, 34)], [(30, 50), (102, 18)], [(75, 19), (91, 71)]),
    # 60 are too few for a ruler and a marker, and 50 are enough for a ruler.
    (120, 61, 14): ((18, 10, 30, 100, 1), [(30, 60)], [(30, 60)], []),
    (110, 90, 14): ((18, 10, 30, 90, 30), [(30, 50)], [(30, 50)], []),
}


@pytest.mark.parametrize("paper", PARTS)
def test_the_parts_of_a_sheet(paper) -> None:
    asked = dict(zip(("paper_width_mm", "paper_height_mm", "marker_mm"), paper, strict=False))
    sheet = print_chart._sheet(print_chart.Paper(**asked))
    field, above, below, borders = PARTS[paper]
    found = (sheet.band_mm, sheet.left_mm, sheet.top_mm, sheet.width_mm, sheet.height_mm)
    assert found == pytest.approx(field)
    assert np.allclose(sheet.above_mm, above) and np.allclose(sheet.below_mm, below)
    assert [(one.x_mm, one.y_mm) for one in sheet.markers.borders] == [pytest.approx(one) for one in borders]
    assert sheet.ruler_mm == (200 if paper == (400, 280) else 50)


def test_markers_name_the_sheet(made) -> None:
    folder, chart = made
    px_per_mm = 5
    for page in (chart.pages[0], chart.pages[-1]):
        image = np.full((280 * px_per_mm, 400 * px_per_mm), 255, np.uint8)
        drawn = polygons(folder / page.file)
        for path, fill in drawn:
            if fill != "none":
                cv2.fillPoly(image, [np.rint(path * px_per_mm).astype(np.int32)], int(fill[4:].split(",")[0]))
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000))
        found, ids, _ = detector.detectMarkers(image)
        of_corner = {int(one) % 4: (int(one), corners[0]) for one, corners in zip(ids.ravel(), found, strict=True)}
        assert page_of([of_corner[k][0] for k in range(4)]) == (page.number, chart.key)
        centres = np.array([of_corner[k][1].mean(axis=0) for k in range(4)]) / px_per_mm
        # Corners are found to whole pixels, two of which may be wrong by rounding.
        assert np.abs(centres - chart.markers.centres_mm).max() < 2.0 / px_per_mm


def boxes_of_text(path: Path) -> list[np.ndarray]:
    """Corners (left, top) and (right, bottom) of each line of text, with letters 0.55 heights wide."""
    boxes = []
    for text in ElementTree.parse(path).getroot().iter(f"{SVG}text"):
        x, y, height = (float(text.get(name)) for name in ("x", "y", "font-size"))
        width = 0.55 * height * len(text.text)
        left = x - (width / 2.0 if text.get("text-anchor") == "middle" else 0.0)
        boxes.append(np.array([[left, y - height], [left + width, y]]))
    return boxes


def test_texts_stand_below_their_patches_and_in_the_band(made) -> None:
    folder, chart = made
    page = chart.pages[0]
    words = [one.text for one in ElementTree.parse(folder / page.file).getroot().iter(f"{SVG}text")]
    assert words[:12] == [str(code) for code in (154, *np.linspace(0, 255, 11).round().astype(int))]
    assert " ".join(words[12:]) == (
        "200 mm from the first to the last mark. Print at 100 %, without fitting to the page. "
        f"no $^{{ TeX, key {chart.key}: sheet 1 of {len(chart.pages)}, for a distance of 10 m; 1 mrad = 10 mm "
        "Contrasts of 8-bit greys: 0.012 to 1.8, nominal. Numbers at the patches are code values; measure the "
        "patches."
    )
    text = np.array(boxes_of_text(folder / page.file))
    for box, patch in zip(text[:12], page.patches, strict=True):
        assert box.mean(axis=0)[0] == pytest.approx(patch.x_mm)
        assert 0.0 < box[0, 1] - patch.y_mm - patch.height_mm / 2.0 < 1.0
    # Right of the marker beside the ruler; 0.95 of the height is tried next, so that little of the room is left.
    (left, top), (right, bottom) = text[12:].min(axis=(0, 1)), text[12:].max(axis=(0, 1))
    assert (left, top) == pytest.approx((273.6, 241.2)) and right < 359.2 and 0.8 * 27.8 < bottom - top < 27.8


def test_measured_reflectances(tmp_path: Path) -> None:
    table = tmp_path / "measured.csv"
    paper = print_chart.Paper(reflectances=str(table))
    table.write_text("code_value,reflectance\n0,0.1\n100,0.2\n255,0.82\n", encoding="utf-8")
    assert paper.reflectance_of_code()[[0, 50, 125, 255]] == pytest.approx([0.1, 0.15, 0.3, 0.82])
    for text, message in (
        ("code_value,reflectance\n0,0.1\n255,0.1\n", "with rising code_value and reflectance"),
        ("code_value,reflectance\n0,0.1\n200,0.2\n", "found no row for 0 or none for 255"),
        ("code_value,reflectance\n0,x\n", "line 2: reflectance: found 'x'"),
        ("code,reflectance\n", "column 'code_value' is missing"),
    ):
        table.write_text(text, encoding="utf-8")
        with pytest.raises(SettingsError, match=message):
            paper.reflectance_of_code()


DIM = "--background-reflectance=0.045"
REFUSED = {
    # By sRGB, codes 17 to 19 reflect 0.04454, 0.04490 and 0.04527, and 0.04 is 0.109 less.
    ("print", DIM + " --contrasts=18"): "found 18, expected 0.0084 to 17.9, which the paper's greys have",
    ("print", DIM + " --contrasts=0.2 --polarity=-1"): "--contrasts: found -0.2, expected 0.008 to 0.109, which",
    ("print", "--contrasts=0.1,0.101"): "printed grey (code value 162); expected --contrasts at least 0.012 apart",
    ("print", "--sizes-mrad=8"): "needs 400 mm; the paper has 211.9 mm; expected at most 4.24 mrad, larger paper",
    ("print", "--sizes-mrad=0.1"): "1 mm, in which the printer's dots show; expected at least 2 mm (0.2 mrad)",
    ("print", "--paper=A9"): "--paper: found 'A9', expected A4, A3, A2, A1, A0, or WIDTH,HEIGHT",
    ("print", "--paper=60,60"): "found 60 × 60, too small for markers of 4.8 mm and margins of 10 mm",
    ("print", "--background-reflectance=0.9"): "which is black or paper; expected a value between 0.04 and 0.85",
    ("thermal", "--sizes-mrad=0.05"): "0.5 mm, whose corners cannot be cut; expected at least 1 mm (0.1 mrad)",
    ("thermal", "--plate-mm=10"): "found 10, expected at least 50: five sizes of the largest triangle (10 mm)",
    ("thermal", "--contrasts=0.1"): "--contrasts: is given, but a thermal chart has none; it is for screen and",
}


@pytest.mark.parametrize(("kind", "option"), REFUSED)
def test_what_cannot_be_printed_or_cut_is_one_line(kind: str, option: str, tmp_path: Path, todframes) -> None:
    place = tmp_path / "chart"
    given = ["--distance-m=10", "--sizes-mrad=1", *option.split(), "-o", place]
    assert REFUSED[kind, option] in error_line(todframes("chart", f"--for={kind}", *given))
    assert not place.exists()


@pytest.fixture(scope="module")
def plates(tmp_path_factory) -> tuple[Path, Chart]:
    folder = tmp_path_factory.mktemp("thermal") / "made"
    asked = {"distance_m": 5, "sizes_mrad": [1, 4], "delta_t_k": [0.1, 0.5, 2], "repeats": 2, "polarity": -1}
    return folder, tod.chart("thermal", out=folder, **asked)


def test_plates_have_holes_of_the_right_size(plates) -> None:
    folder, chart = plates
    assert read_chart(folder) == chart
    boxes, pages = pdf_paths((folder / "plates.pdf").read_bytes())
    for place, size_mrad in enumerate((1, 4)):
        drawing = folder / "plates" / f"plate_{size_mrad}_mrad.svg"
        size_mm = 5.0 * size_mrad
        side = size_mm * np.sqrt(4.0 / np.sqrt(3.0))
        assert f"side {side:.3f} mm" in drawing.read_text(encoding="utf-8")
        # The first path of a PDF is the white page.
        for plate, hole in ([path for path, _ in polygons(drawing)][:2], pages[place][1:3]):
            assert np.allclose(np.ptp(plate, axis=0), chart.page_width_mm, atol=1e-3)
            hole = hole[:3]  # an outline ends where it began
            sides = np.linalg.norm(hole - np.roll(hole, 1, axis=0), axis=1)
            assert np.allclose(sides, side, atol=1e-3)
            assert np.allclose(hole.mean(axis=0), plate[:4].mean(axis=0), atol=1e-3)
        marks = [path.mean(axis=0) - plate[:4].mean(axis=0) for path, _ in polygons(drawing)[2:]]
        # Lines of 3 mm and 0.1 mm, beside the plate on all four sides.
        expected = [[0.05, -51.5], [-51.5, 0.05], [0.05, 51.5], [51.5, 0.05]]
        assert np.allclose(marks, expected, atol=1e-3)
        for one in boxes_of_text(drawing):
            assert one.min() >= 0.0 and one[1][0] < 140.0 and one[1][1] < 17.0  # above the mark over the plate
    assert chart.page_width_mm == 100.0
    assert np.allclose(boxes, [0, 0, 140, 140], atol=1e-3)


def test_settings_to_fill_in_are_balanced_and_change_the_plate_once(plates, tmp_path) -> None:
    folder, chart = plates
    header, *lines = (folder / "schedule.csv").read_text(encoding="utf-8").splitlines()
    assert header.startswith("file,start_s,end_s,")
    filled = [f"clip.mkv,{2 * k},{2 * k + 1}{line.removeprefix(',,')}" for k, line in enumerate(lines)]
    (tmp_path / "schedule.csv").write_text("\n".join([header, *filled]), encoding="utf-8")
    trials = read_schedule(tmp_path / "schedule.csv", level="delta_t_k")
    shown = [(one.size_mrad, one.polarity * one.level, one.orientation) for one in trials]
    in_chart = [page.triangles[0] for page in chart.pages]
    assert shown == [(one.size_mrad, one.delta_t_k, one.orientation) for one in in_chart]
    assert {level for _, level, _ in shown} == {-0.1, -0.5, -2.0}
    assert set(Counter(shown).values()) == {2} and len(set(shown)) == 24
    assert len({size for size, _, _ in shown[:24]}) == len({size for size, _, _ in shown[24:]}) == 1
    for first in range(0, 48, 4):  # the black body keeps its temperature for all four orientations
        assert len({level for _, level, _ in shown[first : first + 4]}) == 1
    for first in range(0, 48, 12):
        assert len(set(shown[first : first + 12])) == 12
