"""Parquet files, by pyarrow: the extra `parquet`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from shared.extras import late
from tools.export.tables import Columns, Kinds

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow import parquet as pq
else:
    pa = late("pyarrow")
    pq = late("pyarrow.parquet")


class ParquetFile:
    """A Parquet file; each part of the run is a row group."""

    suffix: Final = ".parquet"

    def __init__(self, path: Path, kinds: Kinds) -> None:
        types = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}
        self._schema = pa.schema([(name, types[kind]) for name, kind in kinds.items()])
        path = path.with_name(path.name + self.suffix)
        self._writer: Any = pq.ParquetWriter(path, self._schema)

    def add(self, columns: Columns) -> None:
        """Append rows."""
        self._writer.write_table(pa.table(dict(columns), schema=self._schema))

    def close(self) -> None:
        """Finish it."""
        self._writer.close()
