"""Tables as Parquet, where pyarrow is installed."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from todframes.report.table import LongRecords, Table, field_text

ROWS_A_GROUP = 65536
"""Least number of rows of a row group, except for the last; they are held as Arrow columns until it is written."""


def has_parquet() -> bool:
    """Return whether Parquet can be written: whether pyarrow is installed."""
    return find_spec("pyarrow") is not None


def parquet_parts(table: Table) -> Iterator[bytes]:
    """Yield a table of long records as a Parquet file, in parts: one for each row group, and the end.

    Columns are those of the CSV: texts, whole numbers and exact doubles, and null where there is no value. In a
    column of both numbers and texts all values are texts.

    Parameters
    ----------
    table : Table
        Table whose records are `LongRecords`.
    """
    import pyarrow as pa
    from pyarrow.parquet import ParquetWriter

    records = table.records
    assert isinstance(records, LongRecords)
    types = {str: pa.string(), bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
    schema = pa.schema([(name, types[kind]) for name, kind in records.kinds.items()])
    sink = _Sink()
    with ParquetWriter(sink, schema) as writer:
        group: list[Any] = []
        for block in records.blocks():
            arrays = [
                pa.Array.from_buffers(types[kind], len(block[name]), _buffers(block[name], kind))
                for name, kind in records.kinds.items()
            ]
            group.append(pa.record_batch(arrays, schema=schema))
            if sum(map(len, group)) >= ROWS_A_GROUP:
                writer.write_table(pa.Table.from_batches(group))
                group = []
                yield sink.taken()
        if group:
            writer.write_table(pa.Table.from_batches(group))
    yield sink.taken()


def _buffers(values: Sequence[Any], kind: type) -> list[Any]:
    """Return the buffers of an Arrow array: validity, in which None and NaN are null, and values.

    `pyarrow.array` would import pandas, which takes a second.
    """
    import pyarrow as pa

    if kind is str:
        texts = [field_text(value).encode() for value in values]
        offsets = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        return [None, pa.py_buffer(offsets), pa.py_buffer(b"".join(texts))]
    found: NDArray[Any]
    if kind is float:
        found = np.array(values, np.float64)  # None becomes NaN
        is_valid = ~np.isnan(found)
    else:
        is_valid = np.array([value is not None for value in values], np.bool_)
        found = np.array([value or 0 for value in values], kind)
    data = np.packbits(found, bitorder="little") if kind is bool else found
    return [pa.py_buffer(np.packbits(is_valid, bitorder="little")), pa.py_buffer(data)]


class _Sink(io.RawIOBase):
    """File that keeps what was written until it is taken."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def writable(self) -> bool:
        return True

    def write(self, content: Any) -> int:
        part = bytes(content)
        self._parts.append(part)
        self._length += len(part)
        return len(part)

    def tell(self) -> int:
        return self._length

    def taken(self) -> bytes:
        """Return what was written since the last call."""
        part = b"".join(self._parts)
        self._parts = []
        return part
