"""HDF5 datasets whose chunks are compressed in threads: HDF5 itself compresses one after the other.

The chunks are those that HDF5's own filters, shuffle and gzip, write; any HDF5 program reads them.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from nmpm._support.threads import map_ranges, split, usable_cores

_LEVEL = 1
FILTERS: Mapping[str, Any] = MappingProxyType({"shuffle": True, "compression": "gzip", "compression_opts": _LEVEL})
"""Options of h5py for a compressed dataset."""

_AHEAD = 4
"""Compressed chunks per thread that are in memory before they are written."""


def write_compressed(group: Any, name: str, values: np.ndarray, rows: int, threads: int | None = None) -> None:
    """Add a compressed dataset to an HDF5 group.

    Args:
        group: Open for writing.
        name: Of the dataset.
        values: At least one row.
        rows: Of a chunk, along the first axis.
        threads: That compress; one per processor core when left out.
    """
    chunk = (rows, *values.shape[1:])
    dataset = group.create_dataset(name, shape=values.shape, dtype=values.dtype, chunks=chunk, **FILTERS)
    threads = threads or usable_cores()
    ranges, rest = split(len(values), rows), (0,) * (values.ndim - 1)
    for first in range(0, len(ranges), _AHEAD * threads):
        batch = ranges[first : first + _AHEAD * threads]
        packed = map_ranges(lambda low, high: _compress(values[low:high], rows), batch, threads)
        for (low, _), content in zip(batch, packed, strict=True):
            dataset.id.write_direct_chunk((low, *rest), content)


def _compress(values: np.ndarray, rows: int) -> bytes:
    """A chunk as HDF5 stores it: filled with zeros to all its rows, first bytes of all values first, compressed."""
    if len(values) < rows:
        values = np.concatenate([values, np.zeros((rows - len(values), *values.shape[1:]), values.dtype)])
    octets = np.ascontiguousarray(values).reshape(-1).view(np.uint8).reshape(-1, values.itemsize)
    return zlib.compress(octets.T.tobytes(), _LEVEL)
