"""Tables of many trials are written part by part, as CSV and as Parquet, with the same content."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest

import todframes as tod
from todframes.base.output import write_files
from todframes.results import figures, table
from todframes.results import table as parquet_module
from todframes.results.table import LongRecords, Table, parquet_parts
from todframes.scoring import records

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


@pytest.fixture
def mixed(make_dataset, monkeypatch):
    """A dataset of two groups, one named by a number and one by a text, and by a column of whole numbers.

    No pictures are drawn: they take long.
    """
    monkeypatch.setattr(figures, "pictures", lambda _: [])
    group_by = ["camera", "size_mrad", "polarity"]
    made = make_dataset(contrasts=(0.1, 0.4), repeats=2, experiment={"group_by": group_by})
    for number, row in enumerate(made.rows):
        row |= {"camera": "7" if number % 2 else "left", "polarity": "1", "trial": f"t{number}"}
    made.save()
    return made.path


@pytest.mark.slow
@pytest.mark.usefixtures("blank_pictures")
def test_parquet_has_the_numbers_of_the_csv(mixed, tmp_path, monkeypatch) -> None:
    """The same columns and rows, and all bits of the numbers, over several row groups."""
    parquet = pytest.importorskip("pyarrow.parquet", reason="Parquet needs pyarrow, of the parquet extra")
    monkeypatch.setattr(records, "BLOCK", 3)
    monkeypatch.setattr(parquet_module, "ROWS_A_GROUP", 5)
    result = tod.score(mixed, fit=tod.FitSettings(resamples=0), examples=False)
    result.save(tmp_path / "out")
    file = parquet.ParquetFile(tmp_path / "out" / "scores.parquet")
    assert [file.metadata.row_group(k).num_rows for k in range(file.num_row_groups)] == [5, 5, 5, 1]
    found = file.read().to_pydict()
    assert list(found) == list(result.trials.records[0])
    assert found["camera"] == ["7.0" if number % 2 else "left" for number in range(16)]
    for name, values in found.items():
        expected = [record[name] for record in result.trials.records]
        assert values == ([str(value) for value in expected] if name == "camera" else expected)
    again = tod.load_result(tmp_path / "out")
    assert again.trials.csv() == result.trials.csv()


def test_what_has_no_value_is_null_in_parquet() -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="Parquet needs pyarrow, of the parquet extra")
    content = b"".join(parquet_parts(long_table()))
    found = parquet.read_table(io.BytesIO(content))
    assert [str(one) for one in found.schema.types] == ["string", "int64", "double"]
    assert found.to_pydict() == VALUES | {"value": [0.1, 1e-300, None, -0.0, 2.0]}
    assert np.signbit(found["value"].to_pylist()[3])


@pytest.mark.usefixtures("blank_pictures")
@pytest.mark.oracle
def test_without_pyarrow_there_is_no_parquet(mixed, tmp_path, monkeypatch) -> None:
    """One of an earlier result would be taken for this one's, and goes."""
    pytest.importorskip("pyarrow")
    out = tmp_path / "out"
    result = tod.score(mixed, fit=tod.FitSettings(resamples=0), examples=False)
    result.save(out)
    assert (out / "scores.parquet").is_file()
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    result.save(out)
    assert {path.name for path in out.iterdir()} == {"report.html", "result.json", "scores.csv"}
