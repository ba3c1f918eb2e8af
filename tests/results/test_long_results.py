"""Tables of many trials are written part by part."""

from __future__ import annotations

import pytest

from todframes.base.output import write_files
from todframes.results import table
from todframes.results.table import LongRecords, Table

KINDS = {"name": str, "n": int, "value": float}
VALUES = {
    "name": ["a", "=1", "ü", "-2", "e"],
    "n": [1, 2, 3, 4, 5],
    "value": [0.1, 1e-300, float("nan"), -0.0, 2.0],
}
RECORDS = [dict(zip(VALUES, row, strict=True)) for row in zip(*VALUES.values(), strict=True)]


def long_table() -> Table:
    def blocks():
        for start in range(0, 5, 2):
            yield {name: values[start : start + 2] for name, values in VALUES.items()}

    return Table.of("Trials", "scores.csv", KINDS, LongRecords(KINDS, 5, blocks))


def test_long_records_are_a_sequence() -> None:
    records = long_table().records
    assert len(records) == 5
    assert records == RECORDS  # NaN is the same object
    assert [records[k] for k in range(-5, 5)] == RECORDS + RECORDS
    for part in (slice(None), slice(1, 3), slice(None, None, -2), slice(4, 1)):
        assert records[part] == tuple(RECORDS[part])
    assert records != RECORDS[:4]
    with pytest.raises(IndexError, match="out of range"):
        records[5]


def test_csv_in_parts_is_that_of_the_whole(monkeypatch) -> None:
    monkeypatch.setattr(table, "BLOCK", 2)
    whole = Table.of("Trials", "scores.csv", KINDS, RECORDS)
    parts = list(long_table().csv_parts())
    assert [part.count("\n") for part in parts] == [1, 2, 2, 1]
    assert "".join(parts) == whole.csv() == "name,n,value\na,1,0.1\n'=1,2,1e-300\nü,3,\n-2,4,-0.0\ne,5,2.0\n"


def test_files_are_written_in_parts(tmp_path) -> None:
    write_files(tmp_path, {"whole": b"abc", "parts": (bytes([byte]) for byte in b"abc"), "none": iter(())})
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {
        "whole": b"abc",
        "parts": b"abc",
        "none": b"",
    }
