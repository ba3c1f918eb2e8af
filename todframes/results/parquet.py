"""Tables as Parquet, where pyarrow is installed."""

from __future__ import annotations

import io
from collections.abc import Iterator
from importlib.util import find_spec
from typing import Any

from todframes.results.table import LongRecords, Table, field_text

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
            columns = {
                name: pa.array(
                    map(field_text, block[name]) if kind is str else block[name], types[kind], from_pandas=True
                )
                for name, kind in records.kinds.items()
            }
            group.append(pa.table(columns, schema=schema))
            if sum(map(len, group)) >= ROWS_A_GROUP:
                writer.write_table(pa.concat_tables(group))
                group = []
                yield sink.taken()
        if group:
            writer.write_table(pa.concat_tables(group))
    yield sink.taken()


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
