"""Displays: standards' own figures, the viewing geometry, and displays by name and by file."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest

import todframes as tod
from todframes.base.errors import DataError, SettingsError
from todframes.base.reading import shipped_names, toml_text
from todframes.display.display import (
    FOLDER,
    Display,
    LuminanceTable,
    border_values,
    find_display,
    read_display,
    srgb_to_linear,
    table_of_display,
    weber_contrast,
)
from todframes.frames.dataset import load_dataset


def display(**changes: object) -> Display:
    given = {
        "eotf": "linear",
        "white_luminance_cd_m2": 100.0,
        "black_luminance_cd_m2": 2.0,
        "pixel_pitch_mrad": 0.7,
        "background_luminance_cd_m2": 50.0,
    }
    return Display(**(given | changes))  # type: ignore[arg-type]


def grey(*codes: float) -> np.ndarray:
    return np.array(codes).reshape(1, -1, 1)


def test_srgb_at_figures_of_the_standard() -> None:
    # IEC 61966-2-1: the linear piece, where the two meet (0.04045 / 12.92), code 128 of 255, and both ends.
    found = srgb_to_linear(np.array([0.0, 0.02, 0.04045, 128 / 255, 1.0]))
    assert np.allclose(found, [0.0, 0.02 / 12.92, 0.0031308, 0.2158605, 1.0], atol=5e-8)


@pytest.mark.parametrize("black", [0.0, 0.5])
def test_bt1886_meets_both_ends_and_its_own_form(black: float) -> None:
    """L = a max(V + b, 0)^2.4 with a and b as Annex 1 of the recommendation gives them."""
    white = 80.0
    a = (white ** (1 / 2.4) - black ** (1 / 2.4)) ** 2.4
    b = black ** (1 / 2.4) / (white ** (1 / 2.4) - black ** (1 / 2.4))
    code = np.linspace(0, 1, 21)
    shown = display(eotf="bt1886", white_luminance_cd_m2=white, black_luminance_cd_m2=black)
    assert np.allclose(shown.luminance(grey(*code)), [a * (code + b) ** 2.4], rtol=1e-13)


@pytest.mark.parametrize("changes", [{}, {"eotf": "srgb"}, {"eotf": "bt1886"}, {"eotf": "gamma", "gamma": 2.2}])
def test_black_and_white_come_out_as_given(changes: dict[str, object]) -> None:
    assert np.allclose(display(**changes).luminance(grey(0.0, 1.0)), [[2.0, 100.0]], rtol=1e-13)


MEASURED = LuminanceTable(np.array([0.0, 0.5, 1.0]), np.array([1.0, 10.0, 50.0]))


@pytest.mark.parametrize(
    ("changes", "codes", "expected"),
    [
        ({"eotf": "gamma", "gamma": 2.0, "black_luminance_cd_m2": 0.0}, (0.5,), (25.0,)),
        ({"white_luminance_cd_m2": 12.0}, (-1.0, 3.0), (-8.0, 32.0)),
        ({"eotf": "lut", "lut": MEASURED}, (0.0, 0.25, 0.5, 0.75, 1.0), (1.0, 5.5, 10.0, 30.0, 50.0)),
    ],
    ids=["power", "linear goes beyond black and white", "table, linear in between"],
)
def test_luminance_of_codes(changes: dict[str, object], codes, expected) -> None:
    assert np.allclose(display(**changes).luminance(grey(*codes)), [expected], rtol=1e-15)


def test_colour_is_weighed_after_linearisation() -> None:
    pure = display(eotf="srgb", black_luminance_cd_m2=0.0).luminance(np.eye(3)[None])
    assert np.allclose(pure, [[21.26, 71.52, 7.22]], rtol=1e-13)
    code = np.array([[[0.5, 0.25, 0.75]]])
    weighed = 100.0 * srgb_to_linear(code) @ [0.2126, 0.7152, 0.0722]
    assert np.allclose(display(eotf="srgb", black_luminance_cd_m2=0.0).luminance(code), weighed, rtol=1e-13)


@pytest.mark.parametrize("eotf", ["srgb", "bt1886"])
@pytest.mark.parametrize("code", [-0.01, 1.01])
def test_code_values_that_no_transfer_function_is_defined_for(eotf: str, code: float) -> None:
    with pytest.raises(DataError, match=r"code values run from .* expected 0 to 1"):
        display(eotf=eotf).luminance(grey(0.5, code))


def test_lut_is_not_extrapolated() -> None:
    table = LuminanceTable(np.array([0.1, 0.9]), np.array([1.0, 50.0]))
    with pytest.raises(DataError, match=r"expected 0\.1 to 0\.9"):
        display(eotf="lut", lut=table).luminance(grey(0.05))


def test_geometry() -> None:
    found = display(pixel_pitch_mrad=None, pixel_pitch_mm=0.25, viewing_distance_mm=350.0).pitch_mrad
    assert found == pytest.approx(1000.0 * 2.0 * math.atan2(0.125, 350.0), rel=1e-15)
    assert found == pytest.approx(0.25 / 350.0 * 1000.0, rel=1e-7)  # small angle


def test_geometry_given_in_both_ways() -> None:
    lengths = {"pixel_pitch_mm": 0.25, "viewing_distance_mm": 350.0}
    assert display(pixel_pitch_mrad=0.7143, **lengths).pitch_mrad == 0.7143
    with pytest.raises(SettingsError, match=r"pixel_pitch_mrad: found 0\.7, but .* give 0\.714286"):
        display(**lengths)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"eotf": "rec709"}, "eotf: found 'rec709', expected one of linear, srgb"),
        ({"white_luminance_cd_m2": 0.0}, "white_luminance_cd_m2: found 0.0"),
        ({"white_luminance_cd_m2": math.nan}, "white_luminance_cd_m2: found nan"),
        ({"white_luminance_cd_m2": 1e300}, r"m2: found 1e\+300, expected a number > 0 and <= 1e\+12"),
        ({"black_luminance_cd_m2": 100.0}, "black_luminance_cd_m2: found 100.0"),
        ({"black_luminance_cd_m2": -1.0}, "black_luminance_cd_m2: found -1.0"),
        ({"pixel_pitch_mrad": 0.0}, "pixel_pitch_mrad: found 0.0"),
        ({"pixel_pitch_mrad": 1e308}, r"pixel_pitch_mrad: found 1e\+308, expected a"),
        ({"pixel_pitch_mrad": 1e-9}, "pixel_pitch_mrad: found a pitch of 1e-09 mrad, expected 1e-06 to"),
        (
            {"pixel_pitch_mrad": None, "pixel_pitch_mm": 1e-3, "viewing_distance_mm": 1e9},
            "pixel_pitch_mm: found a",
        ),
        ({"pixel_pitch_mrad": None}, "pixel_pitch_mrad: is missing"),
        ({"pixel_pitch_mm": 0.25}, "pixel_pitch_mm and viewing_distance_mm: found one"),
        ({"background_luminance_cd_m2": 0.0}, "background_luminance_cd_m2: found 0.0"),
        ({"background_luminance_cd_m2": "edge"}, "background_luminance_cd_m2: found 'edge'"),
        ({"eotf": "gamma"}, "gamma: is missing"),
        ({"gamma": 2.2}, "gamma: is given but not used"),
        ({"eotf": "lut"}, "lut: is missing"),
    ],
)
def test_bad_settings(changes: dict[str, object], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        display(**changes)


@pytest.mark.parametrize(
    ("code", "luminance", "message"),
    [
        ([0.0], [1.0], "expected two rows or more"),
        ([0.0, 0.0], [1.0, 2.0], "whose code_value rises"),
        ([0.0, 255.0], [1.0, 2.0], "runs from 0 to 255"),
        ([0.0, 1.0], [-1.0, 2.0], "luminance_cd_m2 runs from -1 to 2"),
        ([0.0, 1.0], [1.0, math.nan], "luminance_cd_m2 runs from nan to nan"),
        ([0.0, 1.0], [1.0, 1e300], r"to 1e\+300, expected 0 to 1e\+12"),
    ],
)
def test_bad_lut(code: list[float], luminance: list[float], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        LuminanceTable(np.array(code), np.array(luminance))


def test_border_is_the_outermost_ring() -> None:
    luminance = np.zeros((4, 5))
    luminance[0, 0], luminance[-1, 2], luminance[1:-1, 1:-1] = 7.0, 14.0, 1e6
    assert border_values(luminance).mean() == pytest.approx(21.0 / 14.0)
    assert border_values(np.array([[2.0, 4.0]])).mean() == pytest.approx(3.0)


def test_contrast_is_signed() -> None:
    assert np.allclose(weber_contrast(np.array([0.0, 50.0, 75.0]), 50.0), [-1.0, 0.0, 0.5])


def test_a_background_that_is_no_number() -> None:
    with pytest.raises(DataError, match="background luminance is"):
        weber_contrast(np.ones(3), math.nan)


EXPERIMENT = '\n[experiment]\nlevel = "contrast"\ngroup_by = ["size_mrad"]\n'
MONITOR = """\
schema = 1
title = "Monitor in room 3"
[display]
eotf = "srgb"
white_luminance_cd_m2 = 120.0
pixel_pitch_mrad = 0.25
"""


@pytest.fixture
def dataset_with(make_dataset):
    """Loads a dataset whose settings have these lines about the display."""

    def load(lines: str) -> tod.Dataset:
        made = make_dataset()
        made.settings_file.write_text(f"schema = 1\n{lines}\n{EXPERIMENT}", encoding="utf-8")
        return load_dataset(made.path)

    return load


@pytest.mark.parametrize("name", shipped_names(FOLDER))
def test_each_display_of_the_package_says_what_it_is(name: str, dataset_with) -> None:
    found = find_display(name)
    assert found.title
    assert len(found.source) > 100
    assert found.display.background_luminance_cd_m2 == "surround"
    assert dataset_with(f'display = "{name}"').display == found.display


def test_page_lists_all_displays_with_their_pitch() -> None:
    page = (Path(__file__).parents[2] / "docs" / "explanation" / "displays.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `(\w+)` \| .*? ([\d.]+) mrad \|", page, re.MULTILINE)
    assert sorted(name for name, _ in listed) == sorted(shipped_names(FOLDER))
    for name, pitch in listed:
        assert find_display(name).display.pitch_mrad == pytest.approx(float(pitch), abs=5e-5)  # as rounded


def test_numbers_of_the_standards() -> None:
    """Values of the standards, and geometry computed from what they say."""
    sdr, srgb = find_display("reference_sdr").display, find_display("srgb_monitor").display
    assert sdr.luminance(np.array([[[0.0], [1.0]]])) == pytest.approx(np.array([[0.01, 100.0]]))
    # One arcmin, and 1080 lines in a height seen from 3.2 heights; both are rounded in the standards, to 1 %.
    assert sdr.pitch_mrad == pytest.approx(1000 * math.radians(1 / 60), rel=1e-3)
    assert sdr.pitch_mrad == pytest.approx(1000 / 1080 / 3.2, rel=0.01)
    assert srgb.luminance(np.array([[[0.0], [1.0]]])) == pytest.approx(np.array([[0.8, 80.0]]))
    linear = find_display("reference_linear").display
    assert linear.pitch_mrad == sdr.pitch_mrad
    assert linear.luminance(np.array([[[0.5]]])) == pytest.approx(np.array([[50.0]]))


def test_frames_in_memory_are_shown_on_a_display_by_name() -> None:
    columns = {"orientation": ["up"], "level": 0.1, "size_mrad": 4.0}
    with pytest.raises(SettingsError, match="display: found 'srgb', expected the name of a file"):
        tod.score_frames(np.full((1, 96, 96), 0.5), display="srgb", **columns)
    result = tod.score_frames(np.full((1, 96, 96), 0.5), display="reference_sdr", **columns)
    assert result.dataset.display["pixel_pitch_mrad"] == find_display("reference_sdr").display.pitch_mrad


def test_a_file_in_the_dataset(make_dataset) -> None:
    made = make_dataset()
    (made.path / "displays").mkdir()
    (made.path / "displays" / "lut.csv").write_text("code_value,luminance_cd_m2\n0,0.5\n1,80\n", encoding="utf-8")
    (made.path / "displays" / "monitor.toml").write_text(
        'schema = 1\n[display]\neotf = "lut"\nlut = "lut.csv"\npixel_pitch_mrad = 0.3\n'
        "background_luminance_cd_m2 = 40.0\n",
        encoding="utf-8",
    )
    made.settings_file.write_text(f'schema = 1\ndisplay = "displays/monitor.toml"\n{EXPERIMENT}', encoding="utf-8")
    found = load_dataset(made.path).display
    assert found.lut.luminance_cd_m2.tolist() == [0.5, 80.0]
    assert (found.pitch_mrad, found.background_luminance_cd_m2) == (0.3, 40.0)


LUT = LuminanceTable(np.array([0.0, 0.1, 1.0]), np.array([0.1, 1 / 3, 97.3]))


@pytest.mark.parametrize(
    "display",
    [
        *(find_display(name).display for name in shipped_names(FOLDER)),
        Display(eotf="gamma", gamma=2.2, pixel_pitch_mrad=1 / 3, background_luminance_cd_m2=1 / 7),
        Display(eotf="lut", lut=LUT, pixel_pitch_mrad=0.1, background_luminance_cd_m2="border"),
    ],
    ids=[*shipped_names(FOLDER), "gamma", "lut"],
)
def test_a_display_is_read_again_as_written(display: Display, make_dataset) -> None:
    made = make_dataset()
    text = toml_text({"schema": 1, "display": table_of_display(display, made.path)})
    made.settings_file.write_text(text + EXPERIMENT, encoding="utf-8")
    again = load_dataset(made.path).display
    code = np.linspace(0.0, 1.0, 41).reshape(1, -1, 1)
    assert np.array_equal(again.luminance(code), display.luminance(code))
    assert again.pitch_mrad == display.pitch_mrad
    assert again.background_luminance_cd_m2 == display.background_luminance_cd_m2


def test_files_of_the_package_can_be_copied(tmp_path: Path) -> None:
    copy = tmp_path / "mine.toml"
    copy.write_bytes((FOLDER / "reference_sdr.toml").read_bytes())
    assert read_display(copy) == find_display("reference_sdr")
    assert find_display(str(copy)) == find_display("reference_sdr")


@pytest.mark.parametrize(
    ("lines", "wanted"),
    [
        ('display = "Reference-SDR"', r"dataset\.toml: display: found 'Reference-SDR', .*; write reference_sdr$"),
        ('display = "tv"', r"expected the name of a file that ends with \.toml, or one of reference_linear, "),
        ('display = "gone.toml"', r"gone\.toml: no such file"),
        ('display = "../gone.toml"', r"dataset\.toml: display: \.\./gone\.toml lies outside of the dataset"),
        ("display = 3", r"table \[display\] is missing; expected it, or display = \"NAME or FILE\.toml\" above"),
    ],
)
def test_a_display_that_is_not_there(dataset_with, lines: str, wanted: str) -> None:
    with pytest.raises(SettingsError, match=wanted):
        dataset_with(lines)


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (("schema = 1", "schema = 2"), r"monitor\.toml: schema: found 2, expected 1"),
        (('"Monitor in room 3"', "3"), r"monitor\.toml: title: found 3, expected text"),
        (("title", "titel"), r"monitor\.toml: unknown key 'titel'; the nearest valid one is 'title'"),
        (("eotf", "eof"), r"\[display\]: unknown key 'eof'; the nearest valid one is 'eotf'"),
        (('"srgb"', '"sRGB"'), r"eotf: found 'sRGB', .*; write srgb"),
        (("[display]", ""), r"unknown key 'eotf'"),
        ((MONITOR[MONITOR.index("[display]") :], ""), r"monitor\.toml: table \[display\] is missing"),
        (("white", "black"), r"\[display\]: white_luminance_cd_m2 is missing"),
        (("pixel_pitch_mrad = 0.25", ""), r"pixel_pitch_mrad: is missing"),
        (('eotf = "srgb"', 'eotf = "lut"\nlut = "../lut.csv"'), r"lut \.\./lut\.csv lies outside"),
    ],
)
def test_a_file_that_is_wrong(tmp_path: Path, change: tuple[str, str], wanted: str) -> None:
    path = tmp_path / "monitor.toml"
    path.write_text(MONITOR.replace(*change), encoding="utf-8")
    with pytest.raises(SettingsError, match=wanted):
        read_display(path)
