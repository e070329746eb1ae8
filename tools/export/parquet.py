"""Parquet files, by pyarrow: the extra `parquet`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from shared.exceptions import RunError
from tools.export.tables import Columns, Kinds

try:
    import pyarrow as pa
    from pyarrow import parquet as pq
except ImportError:
    pa = pq = None


class ParquetFile:
    """A Parquet file; each part of the run is a row group."""

    suffix: Final = ".parquet"

    def __init__(self, path: Path, kinds: Kinds) -> None:
        """Begin it; the suffix is added to the path.

        Raises:
            RunError: pyarrow is not installed.
        """
        require()
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


def require() -> None:
    """Make sure that Parquet can be written.

    Raises:
        RunError: pyarrow is not installed.
    """
    if pa is None:
        raise RunError("--parquet needs pyarrow: pip install 'xrl[parquet]', or take --csv")
