"""Columns of a Parquet file, read by Arrow; for child processes (`nmpm._support.isolated`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from nmpm._support.bounded_files import expansion_limit
from nmpm.errors import DataError

_VALUE_BYTES = 8


def column_names(path: Path) -> list[str]:
    """Names of the columns."""
    from pyarrow.parquet import ParquetFile

    with ParquetFile(path) as file:
        return list(map(str, file.schema_arrow.names))


def read_batches(path: Path, columns: Sequence[str], rows: int) -> Iterator[dict[str, np.ndarray | list[str]]]:
    """Yields some columns, so many rows at a time: numbers, dates, or texts, which are empty where there is no value.

    Raises:
        DataError: if the file declares far more values than it stores.
    """
    from pyarrow.parquet import ParquetFile

    with ParquetFile(path) as file:
        count, size = file.metadata.num_rows, path.stat().st_size
        if count * len(file.schema_arrow.names) * _VALUE_BYTES > expansion_limit(size):
            raise DataError(f"{path}: it declares {count:,} rows but has {size:,} bytes. Is it complete?")
        for batch in file.iter_batches(batch_size=rows, columns=list(columns), use_threads=False):
            yield {name: _values(batch.column(name).to_numpy(zero_copy_only=False)) for name in columns}


def _values(values: np.ndarray) -> np.ndarray | list[str]:
    if values.dtype.kind in "biufmM":
        return values
    return ["" if item is None else str(item) for item in values.tolist()]
