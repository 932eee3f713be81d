"""The tidy table of a campaign: one row a reconstruction, one column a fact, as CSV or Parquet."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterable, Mapping
from types import MappingProxyType

from common.extras import require
from simulator.runner import Row

COLUMNS: Mapping[str, type[str] | type[int] | type[float]] = MappingProxyType(
    {
        # what is needed to redo the row
        "campaign": str,
        "version": str,
        "surface": str,
        "points": int,
        "sends": str,
        "kind": str,
        "gap": float,
        "wire": str,
        "rounds": int,
        "axis": str,
        "level": float,
        "channel": str,
        "seed": int,
        "sample": int,
        "transmission": str,
        "draws": str,
        "rows": int,
        "columns": int,
        "method": str,
        # what happened
        "features": int,
        "packets": int,
        "bytes": int,
        "packets_received": int,
        "packets_damaged": int,
        "features_received": int,
        "z_range": float,
        "rmse": float,
        "nrmse": float,
        "max_error": float,
        "failure": str,
    }
)
"""Column -> type. A value that does not apply is empty (None): `level` of a channel without levels, the errors of a
row that has a `failure`."""


def to_csv(rows: Iterable[Row], columns: Collection[str] = COLUMNS) -> str:
    """The rows as CSV with a line of names; floats in the shortest form that reads back to the same bits."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def to_parquet(rows: Iterable[Row]) -> bytes:
    """The rows as Parquet; raises MissingExtraError where pyarrow (the extra ``parquet``) is not installed."""
    require("Parquet", "pyarrow", "parquet")
    import pyarrow
    import pyarrow.parquet

    kinds = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    schema = pyarrow.schema([(name, kinds[kind]) for name, kind in COLUMNS.items()])
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist([dict(row) for row in rows], schema), buffer)
    return buffer.getvalue()
