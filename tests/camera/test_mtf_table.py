"""Tables of a measured MTF: what is read, and what is refused with a line that says where and why."""

from __future__ import annotations

import re

import numpy as np
import pytest

import todframes as tod
from todframes.base.errors import DataError
from todframes.camera.mtf_table import read_mtf_table

F, BAND = "frequency_cyc_per_pixel", "mtf,mtf_lower,mtf_upper"


@pytest.fixture
def written(tmp_path):
    def write(*lines, name="mtf.csv"):
        path = tmp_path / name
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path

    return write


@pytest.mark.parametrize("unit", ["cyc_per_pixel", "cyc_per_mrad", "cyc_per_mm"])
def test_a_table_keeps_its_unit_and_its_numbers(written, unit):
    header = f"note,frequency_{unit},mtf,mtf_upper,mtf_lower"
    table = read_mtf_table(written(header, "a,0,1,1,1", "b,0.1,0.8,0.9,0.7", "c,1.5,0,0.1,0"))
    assert table.unit == unit
    np.testing.assert_array_equal(table.frequency, [0.0, 0.1, 1.5])
    np.testing.assert_array_equal(table.curves["mtf"], [1.0, 0.8, 0.0])
    np.testing.assert_array_equal(table.band, [[1.0, 0.7, 0.0], [1.0, 0.9, 0.1]])
    assert list(table.curves) == ["mtf"] and not table.stops_early


def test_a_table_in_words_and_numbers(written):
    """On straight lines: 0.5 at 0.2 + 0.4/6, 0.1 at 0.2 + 0.4 · 5/6, and 0.15 at Nyquist."""
    result = tod.mtf(written(f"{F},{BAND}", "0,1,1,1", "0.2,0.6,0.5,0.7", "0.6,0,0,0"))
    assert result.sentences() == [
        "MTF50 0.267 (0.200 to 0.314) cycles/pixel.",
        "MTF 0.150 (0.125 to 0.175) at the Nyquist frequency, 0.5 cycles/pixel.",
        "MTF10 0.533 (0.520 to 0.543) cycles/pixel.",
        "Patterns beyond Nyquist are aliased, down to 0.467 cycles/pixel.",
        "Nyquist limits the resolution: 100 pixels are 100 effective.",
    ]
    some, whole = result.tables()
    head, _, _, row, _ = some.markdown().splitlines()
    assert (head, row) == ("| cycles/pixel | mtf | lower | upper |", "| 0.2000 | 0.600 | 0.500 | 0.700 |")
    assert (whole.title, whole.records, result.remarks()) == ("All frequencies", some.records, [])
    stays = tod.mtf(written(f"{F.replace('pixel', 'mm')},mtf", "0,1", "40,0.6"))
    assert stays.sentences() == ["The MTF stays above 0.5 up to 40.0 cycles/mm."]


def test_tangential_and_sagittal(written):
    path = written("frequency_cyc_per_mm,mtf_tangential,mtf_sagittal", "10,0.9,0.95", "40,0.2,0.5")
    table = read_mtf_table(path)
    curves = {name: one.tolist() for name, one in table.curves.items()}
    assert curves == {"mtf_tangential": [0.9, 0.2], "mtf_sagittal": [0.95, 0.5]}
    assert not table.band
    # The curve that ends highest says what is not known.
    assert table.end_mtf == 0.5 and table.stops_early


@pytest.mark.parametrize(
    ("lines", "code", "message"),
    [
        (("0,1", "0.2,1.3", "0.5,0"), "mtf_above_1", "the MTF rises to 1.3, which no lens or detector reaches"),
        (("0,1", "0.2,0.3"), "mtf_stops_early", "ends at 0.2 cycles/pixel with an MTF of 0.3: .* by 0.095 of its"),
    ],
)
def test_the_command_warns_of_a_table_above_1_or_one_that_stops_early(written, todframes, lines, code, message):
    table = written(f"{F},mtf", *lines)
    (warning,) = tod.mtf(table).warnings
    assert warning.code == code and re.search(message, warning.message)
    status, out, _ = todframes("mtf", table, "--strict")
    assert status == 1 and warning.message in " ".join(out.split())


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (("mtf", "1"), r"column 'frequency_cyc_per_pixel' is missing; found mtf"),
        ((f"{F},frequency_cyc_per_mm,mtf", "0,0,1"), "found columns .*pixel and .*mm, expected one of them"),
        ((f"{F},sfr", "0,1"), "column 'mtf' is missing"),
        ((f"{F},mtf_sagittal", "0,1"), "column 'mtf_tangential' is missing"),
        ((f"{F},mtf,mtf_upper", "0,1,1"), "column 'mtf_lower' is missing"),
        ((f"{F},mtf", "0,1"), "found 1 rows, expected at least two"),
        ((f"{F},mtf", "0,1", "x,0.5"), "line 3: frequency_cyc_per_pixel: found 'x', expected a finite number"),
        ((f"{F},mtf", "-1,1", "0,0.5"), "line 2: found frequency -1, expected ascending ones of 0 or"),
        ((f"{F},mtf", "0,1", "0.2,0.5", "0.2,0.4"), "line 4: found frequency 0.2, expected ascending ones"),
        ((f"{F},mtf", "0,1", "0.2,-0.1"), "line 3: found mtf -0.1, expected 0 to 1 within"),
        ((f"{F},mtf", "0,0.9", "0.2,0.1"), "line 2: found mtf 0.9, expected 1 at frequency 0: divide"),
        ((f"{F},mtf", "0,1", "0.2,1.02"), r"line 3: found mtf 1.02, expected 0 to 1 .*sharpened\?"),
        ((f"{F},{BAND}", "0,1,1,1", "0.2,0.5,0.6,0.7"), "line 3: found mtf 0.5, expected mtf_lower <= mtf <="),
        (
            (f"{F},{BAND}", "0,1,1,1", "0.2,1.2,1.1,1.3"),
            r"line 3: found mtf 1.2, expected 0 to 1 within",
        ),
    ],
)
def test_what_is_no_mtf_is_one_line(written, lines, message):
    with pytest.raises(DataError, match=message):
        read_mtf_table(written(*lines))


def test_above_1_within_the_error_or_where_it_may_be(written):
    assert read_mtf_table(written(f"{F},mtf", "0,1", "0.2,1.005")).curves["mtf"][1] == 1.005
    within = written(f"{F},{BAND}", "0,1,1,1", "0.2,1.05,0.98,1.12")
    assert read_mtf_table(within).curves["mtf"][1] == 1.05
    sharpened = written(f"{F},mtf", "0,1", "0.2,1.3")
    assert read_mtf_table(sharpened, may_exceed_1=True).curves["mtf"][1] == 1.3
