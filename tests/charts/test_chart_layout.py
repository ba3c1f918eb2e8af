"""`chart.toml`: what is written is read again, and what cannot be true is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import todframes as tod
from todframes.base.errors import SettingsError
from todframes.charts import layout as markers
from todframes.charts.design import Design
from todframes.charts.layout import (
    Chart,
    Edge,
    Markers,
    Page,
    Patch,
    Point,
    Screen,
    Triangle,
    chart_toml,
    read_chart,
    write_chart,
)
from todframes.charts.making import chart_remarks, chart_table
from todframes.stimulus import Orientation

SCREEN = Screen(
    width_px=1920, height_px=1080, pixel_pitch_mm=0.25, background_luminance_cd_m2=25.0, page_duration_s=1.0
)
MARKERS = Markers(
    side_mm=40.0,
    top_left=Point(x_mm=30.0, y_mm=30.0),
    top_right=Point(x_mm=450.0, y_mm=30.0),
    bottom_right=Point(x_mm=450.0, y_mm=240.0),
    bottom_left=Point(x_mm=30.0, y_mm=240.0),
    borders=(Point(x_mm=170.0, y_mm=30.0), Point(x_mm=310.0, y_mm=240.0)),
)
TRIANGLE = Triangle(
    orientation=Orientation.UP, size_mrad=2.0, size_mm=20.0, contrast=0.1, x_mm=240.125, y_mm=135.0
)
CHART = Chart(
    kind="screen",
    name='a "name" \\ with\ttrouble\x7f',
    distance_m=10.0,
    page_width_mm=480.0,
    page_height_mm=270.0,
    pages=(
        Page(number=0, file="pages/0000.png", triangles=(TRIANGLE,)),
        Page(
            number=1,
            file="pages/0001.png",
            triangles=(replace(TRIANGLE, contrast=1.0 / 3.0, contrast_asked=0.3, dithered=True),),
            patches=(Patch(x_mm=1.0, y_mm=2.0, width_mm=3.0, height_mm=4.0, luminance_cd_m2=5.0),),
            borders=(1,),
        ),
    ),
    markers=MARKERS,
    screen=SCREEN,
)
THERMAL = replace(
    CHART,
    kind="thermal",
    screen=None,
    markers=None,
    polarity=-1,
    pages=(Page(number=0, triangles=(replace(TRIANGLE, contrast=None, delta_t_k=-0.25),)),),
)
ON_PAPER = {"kind": "print", "screen": None}
TEXT = chart_toml(CHART)


@pytest.mark.parametrize(
    "chart",
    [CHART, replace(CHART, seed=7, pages=CHART.pages[:1]).with_key(), THERMAL, replace(CHART, **ON_PAPER)],
    ids=["screen", "key", "thermal", "print"],
)
def test_what_is_written_is_read(chart: Chart, tmp_path: Path) -> None:
    write_chart(tmp_path / "chart.toml", chart)
    assert read_chart(tmp_path) == read_chart(tmp_path / "chart.toml") == chart


def test_a_chart_in_words() -> None:
    common = {"size_mrad": 2.0, "size_mm": 20.0, "size_px": 80.0}
    plain, dithered = CHART.pages
    large = replace(TRIANGLE, size_mrad=1.0, size_mm=10.0, contrast=0.8, contrast_asked=0.8007)
    triangles = (dithered.triangles[0], TRIANGLE, large, TRIANGLE)
    pages = tuple(replace(plain, number=k, triangles=(one,)) for k, one in enumerate(triangles))
    table = chart_table(replace(CHART, pages=pages))
    assert table.title == f"{CHART.name}: 4 pages"
    assert list(table.records) == [
        {"size_mrad": 1.0, "size_mm": 10.0, "size_px": 40.0, "contrast": 0.8, "dithered": False, "triangles": 1},
        common | {"contrast": 0.1, "dithered": False, "triangles": 2},
        common | {"contrast": 1 / 3, "contrast_asked": 0.3, "dithered": True, "triangles": 1},
    ]
    assert [one.key for one in table.columns if one.is_name] == ["size_mrad"]
    hole = {"size_mrad": 2.0, "size_mm": 20.0, "delta_t_k": -0.25, "triangles": 1}
    assert list(chart_table(THERMAL).records) == [hole | {"side_mm": pytest.approx(20 * 2 / 3**0.25)}]
    slow = replace(SCREEN, page_duration_s=90.0)
    remarks = chart_remarks(replace(CHART, screen=slow, pages=(plain, *pages[1:])))
    assert remarks == ["play.html shows the pages in 6.0 minutes."]
    shown = chart_remarks(replace(CHART, screen=replace(slow, bits=10)))
    remarks = (*shown, *chart_remarks(THERMAL), *chart_remarks(replace(CHART, **ON_PAPER)))
    starts = (
        "play.html shows the pages in 3.0 m",
        "Dithered tri",
        "The PNG",
        "Record the se",
        "Print chart.pdf at 1",
    )
    assert [one.startswith(start) for one, start in zip(remarks, starts, strict=True)] == [True] * 5


@pytest.mark.parametrize(("part", "name", "value"), [
    (MARKERS, "side_mm", 0.0),
    (TRIANGLE, "size_mm", 0.0),
    (Edge(x1_mm=0.0, y1_mm=0.0, x2_mm=1.0, y2_mm=0.0, free_mm=1.0), "free_mm", 0.0),
    (CHART.pages[0], "number", 62_500),
    (CHART, "key", 250),
    (Design(distance_m=1.0, sizes_mrad=(1.0,), levels=(1.0,)), "repeats", 0),
])  # fmt: skip
def test_each_part_checks_its_ranges(part: Any, name: str, value: float) -> None:
    with pytest.raises(SettingsError, match=f"{name}: found {value}"):
        replace(part, **{name: value})


def test_a_page_has_the_markers_that_it_names() -> None:
    camera = Page(number=1, file="a.png", edges=(Edge(x1_mm=0.0, y1_mm=0.0, x2_mm=9.0, y2_mm=2.0, free_mm=1.0),))
    chart = replace(CHART, pages=(CHART.pages[0], camera))
    assert (chart.has_camera_page, chart.level, THERMAL.level) == (True, "contrast", "delta_t_k")
    with pytest.raises(SettingsError, match=r"pages\[0\]: borders: found \(0,\), expected numbers below 0"):
        replace(THERMAL, pages=(replace(THERMAL.pages[0], borders=(0,)),))
    assert THERMAL.drawn_markers(THERMAL.pages[0]) == []
    number, centre = CHART.drawn_markers(CHART.pages[1])[4]
    assert centre.tolist() == [310.0, 240.0]
    np.testing.assert_array_equal(number, markers.page_markers(1, 0, n_borders=2)[5])


def test_key_depends_on_the_content_alone() -> None:
    keys = {replace(CHART, seed=seed).with_key().key for seed in range(30)}
    # 30 draws from 250 keys: fewer than 20 different ones have a chance below 1e-8.
    assert len(keys) >= 20
    assert CHART.with_key() == replace(CHART, key=17).with_key()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("schema = 1", "schema = 2", "schema: found 2, expected 1"),
        ('kind = "screen"', 'kind = "sreen"', "kind: found 'sreen', expected one of screen, print, thermal"),
        ('kind = "screen"', 'kind = "print"', r"\[screen\]: expected it with kind = .screen., and only there"),
        ('kind = "screen"', 'kindd = "screen"', "unknown key 'kindd'; the nearest valid one is 'kind'"),
        ("polarity = 1", "polarity = -1", r"pages\[0\]: found 0.1, expected the sign of polarity = -1"),
        ("distance_m = 10.0", "distance_m = 11.0", r"pages\[0\]: size_mm: found 20, but size_mrad and"),
        ("page_width_mm = 480.0", "page_width_mm = 400.0", "page_width_mm: found 400, but the pixels give 480"),
        ("number = 1", "number = 2", r"pages\[1\]: number: found 2, expected 1"),
        ("pages/0001.png", "../0001.png", r"pages\[1\]: file: found '../0001.png', expected a path inside"),
        ('file = "pages/0001.png"', "", r"pages\[1\]: file is missing"),
        (", contrast = 0.1}", "}", r"pages\[0\].triangles\[0\]: contrast and delta_t_k: found none, expected one"),
        ("contrast = 0.1}", "contrast = 0.0}", r"pages\[0\].triangles\[0\]: contrast or delta_t_k: found 0"),
        ("contrast = 0.1}", "contrst = 0.1}", r"triangles\[0\]: unknown key 'contrst'; the nearest valid one"),
        ('orientation = "up"', 'orientation = "top"', r"triangles\[0\].orientation: found 'top\'"),
        (
            "luminance_cd_m2 = 5.0}",
            "luminance_cd_m2 = 5.0, reflectance = 0.5}",
            "luminance_cd_m2: found both, exp",
        ),
        ("borders = [1]", "borders = [2]", r"pages\[1\]: borders: found \(2,\), expected numbers below 2"),
        ('eotf = "srgb"', 'eotf = "gamma"', "screen: gamma: is missing"),
        ('eotf = "srgb"', 'eotf = "lut"\nlut = [[0.0], [1.0]]', r"lut\[0\]: found \[0.0\], expected a list of"),
        (
            'eotf = "srgb"',
            'eotf = "lut"\nlut = [[0.0, 1.0], [0.0, 2.0]]',
            "lut: expected two rows or more, whose code_value rises",
        ),
        ("contrast = 0.1}", "delta_t_k = 0.1}", r'pages\[0\]: contrast is missing with kind = "screen"'),
        (TEXT[TEXT.index("[markers]") : TEXT.index("[[pages]]")], "", r"\[markers\]: expected it unless kind ="),
    ],
)
def test_a_wrong_chart_is_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    assert old in TEXT
    (tmp_path / "chart.toml").write_text(TEXT.replace(old, new), encoding="utf-8")
    with pytest.raises(SettingsError, match=message) as caught:
        read_chart(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / "chart.toml"))
    assert "\n" not in str(caught.value)


def test_no_chart_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"chart\.toml: no such file"):
        read_chart(tmp_path)
    write_chart(tmp_path / "chart.toml", THERMAL)
    with pytest.raises(SettingsError, match="has no markers; name its parts of the frame with boxes"):
        tod.mtf(np.zeros((9, 9)), chart=tmp_path)
    (tmp_path / "chart.toml").write_text("schema = 1\npages = 3\n", encoding="utf-8")
    with pytest.raises(SettingsError, match=r"(is missing|pages: found 3, expected a list)"):
        read_chart(tmp_path)
    many = tuple(Page(number=n, triangles=(TRIANGLE,) * 8, file="a" * 99) for n in range(2000))
    with pytest.raises(SettingsError, match=r"2000 pages.*longer than 1 MB"):
        write_chart(tmp_path / "long.toml", replace(CHART, pages=many))
    assert not (tmp_path / "long.toml").exists()


def test_ids_name_page_and_chart() -> None:
    pages = [0, 1, 249, 250, 251, 5000, 62_499]
    found = {(page, key): markers.marker_ids(page, key) for page in pages for key in (0, 137, 249)}
    assert len(set(found.values())) == len(found)
    for (page, key), ids in found.items():
        assert markers.page_of(ids) == (page, key)
        assert [one % 4 for one in ids] == [0, 1, 2, 3]
        assert min(ids) >= 0 and max(ids) < 1000


def test_ids_of_no_single_page() -> None:
    first, second = markers.marker_ids(7, 3), markers.marker_ids(8, 3)
    assert markers.page_of((first[0], first[1], second[2], first[3])) is None
    assert markers.page_of((first[1], first[0], *first[2:])) is None
    assert markers.page_of(first[:3]) is None
    assert markers.page_of((*first[:3], 1003)) is None
    with pytest.raises(SettingsError, match="page: found 62500, expected a whole number from 0 to 62499"):
        markers.marker_ids(62_500, 0)
    with pytest.raises(SettingsError, match="key: found 250"):
        markers.marker_ids(0, 250)


def test_markers_along_the_borders_are_like_no_other() -> None:
    """In any turn, mirrored or not: a search that reads two modules wrong takes none for another."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)
    original = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_ARUCO_ORIGINAL)
    corners = [cv2.aruco.generateImageMarker(dictionary, k, 7)[1:-1, 1:-1] for k in range(1000)]
    borders = [cv2.aruco.generateImageMarker(original, k, 7)[1:-1, 1:-1] for k in markers.BORDER_IDS]
    assert len({*markers.BORDER_IDS}) == 8
    for k, one in enumerate(borders):
        others = [other for n, other in enumerate(borders) if n != k]
        for turn in range(4):
            turned = np.rot90(one, turn)
            assert min(np.count_nonzero(turned != other) for other in corners) >= 5
            assert min(np.count_nonzero(turned != other) for other in others) >= 9
            assert turn == 0 or np.count_nonzero(turned != one) >= 8
        drawn = markers.page_markers(7, 3, n_borders=8)[4 + k]
        np.testing.assert_array_equal(drawn[1:-1, 1:-1], one > 0)


@pytest.mark.parametrize("free_mm", [60.0, 150.0, 190.0, 300.0])
def test_markers_along_the_borders_keep_the_middle_free(free_mm: float) -> None:
    corners = Markers.in_corners(width_mm=480.0, height_mm=270.0, module_mm=5.0, margin_mm=5.0)
    laid = corners.with_borders(free_mm=free_mm, step_mm=0.25)
    assert len(laid.borders) == (4 if free_mm == 300.0 else 8)
    for step_mm in (0.25, 0.7):
        steps = (corners.with_borders(free_mm=free_mm, step_mm=step_mm).all_centres_mm[4:] - 27.5) / step_mm
        steps = np.minimum(steps, [425.0, 215.0] / np.array(step_mm) - steps)
        np.testing.assert_allclose(steps, np.rint(steps), atol=1e-6)
    assert laid.borders_beside(free_mm) == tuple(range(len(laid.borders)))
    middle, reach_mm = np.array([240.0, 135.0]), 22.5  # half a marker and its white border
    gaps = np.abs(laid.all_centres_mm - middle).max(axis=1) - reach_mm - free_mm / 2.0
    assert gaps.min() >= 0.0
    if free_mm <= 160.0:  # the middle square ends where the rows of markers begin: thirds
        np.testing.assert_allclose(laid.all_centres_mm[4], [27.5 + 425.0 / 3.0, 27.5], atol=0.25)
    apart = np.abs(laid.all_centres_mm[:, None] - laid.all_centres_mm).max(axis=-1)
    assert (apart + 1e3 * np.eye(len(apart))).min() >= 50.0  # 45 mm with the white borders, 5 mm of background
    # Wider squares than the markers were laid out for: those that reach into them are known.
    gaps = np.abs(laid.all_centres_mm[4:] - middle).max(axis=1) - reach_mm
    for wide_mm in (169.9, 170.1, 260.0, 379.9, 380.1):  # the nearest gaps are 85 mm, the farthest 190
        assert laid.borders_beside(wide_mm) == tuple(np.flatnonzero(gaps >= wide_mm / 2.0).tolist())
