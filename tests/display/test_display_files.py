"""Displays by name and by file: the numbers that are meant arrive, in datasets and in results."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest

import todframes as tod
from todframes.base.errors import SettingsError
from todframes.base.reading import shipped_names, toml_text
from todframes.display.display import FOLDER, Display, LuminanceTable, find_display, read_display, table_of_display
from todframes.frames.dataset import load_dataset

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
    display = load_dataset(made.path).display
    assert display.lut is not None
    assert np.array_equal(display.lut.luminance_cd_m2, [0.5, 80.0])
    assert (display.pitch_mrad, display.background_luminance_cd_m2) == (0.3, 40.0)


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


def test_settings_are_read_again_as_written() -> None:
    content = {
        "schema": 1,
        "name": 'a "name" \\ with\ttrouble\x7f and ü',
        "none": [],
        "on": True,
        "point": {"x": 1 / 3, "y": -1e-300},
        "pairs": [[0.1, 2], [1e22, 3]],
        "pages": [{"number": 1, "items": [{"x": 1.5}, {"x": 2.5, "file": "a.png"}]}, {"number": 2}],
    }
    text = toml_text(content | {"left_out": None}, comment="two\nlines")
    assert text.startswith("# two\n# lines\nschema = 1\n")
    assert tomllib.loads(text) == content
