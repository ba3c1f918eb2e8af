"""Text from data: harmless on a terminal and in a spreadsheet, and otherwise as it was."""

from __future__ import annotations

import csv
import io
import json
import unicodedata

from hypothesis import given
from hypothesis import strategies as st

from todframes.base.safe_text import csv_text, visible, visible_json

FORMULAS = "=+-@\t\r\n"


@given(st.text(st.characters(exclude_categories=[])))
def test_nothing_is_left_that_a_terminal_obeys(text: str) -> None:
    shown = visible(text)
    assert not {unicodedata.category(one) for one in shown} & {"Cc", "Cf", "Cs", "Zl", "Zp"}
    if text.isprintable():
        assert shown == text


def test_what_is_hidden_becomes_its_escape() -> None:
    assert visible("a\x1b[31m\x00\n\x7f\x9b\u202e\ud800\U000e0041 ΔT ± 3 µm 大") == (
        r"a\x1b[31m\x00\n\x7f\x9b\u202e\ud800\U000e0041 ΔT ± 3 µm 大"
    )


@given(st.dictionaries(st.text(), st.text()))
def test_json_says_the_same(values: dict[str, str]) -> None:
    shown = visible_json(json.dumps(values, ensure_ascii=False))
    assert json.loads(shown) == values
    assert not set(shown) & set(map(chr, (*range(0x20), *range(0x7F, 0xA0), 0x202E, 0x2066)))


@given(
    st.lists(
        st.lists(st.text() | st.floats(allow_nan=False) | st.integers(-(2**53), 2**53), min_size=1), min_size=1
    )
)
def test_no_text_in_csv_is_a_formula(rows: list[list[object]]) -> None:
    for row, found in zip(rows, csv.reader(io.StringIO(csv_text(rows), newline="")), strict=True):
        for value, text in zip(row, found, strict=True):
            if not isinstance(value, str):
                assert float(text) == value
            elif text != value:
                assert text == f"'{value}"
                assert value[0] in f"{FORMULAS}＝＋－＠"
            elif value[:1] and value[0] in FORMULAS:
                float(value)
