"""Tables as Parquet, where pyarrow is installed."""

from __future__ import annotations

import io
from collections.abc import Iterator
from importlib.util import find_spec

from todframes.results.table import LongRecords, Table, field_text

ROWS_A_GROUP = 65536


def has_parquet() -> bool:
    """Return whether Parquet can be written: whether pyarrow is installed."""
    return find_spec("pyarrow") is not None


def parquet_parts(table: Table) -> Iterator[bytes]:
    """Yield a table of long records as a Parquet file, made when it is asked for.

    Columns are those of the CSV: texts, whole numbers and exact doubles, and null where there is no value. In a
    column of both numbers and texts all values are texts.
    """
    import pyarrow as pa
    from pyarrow.parquet import write_table

    records = table.records
    assert isinstance(records, LongRecords)
    types = {str: pa.string(), bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
    schema = pa.schema([(name, types[kind]) for name, kind in records.kinds.items()])
    batches = (
        [
            pa.array(map(field_text, block[name]) if kind is str else block[name], types[kind], from_pandas=True)
            for name, kind in records.kinds.items()
        ]
        for block in records.blocks()
    )
    sink = io.BytesIO()
    whole = pa.Table.from_batches([pa.record_batch(batch, schema=schema) for batch in batches], schema)
    write_table(whole, sink, row_group_size=ROWS_A_GROUP)
    yield sink.getvalue()
