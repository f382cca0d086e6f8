"""Arrays too large to be copied in memory: read block by block, results on disk."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterator
from typing import Any

import h5py
import numpy as np

BIG = 2**28  # bytes of a measurement that stays on disk
BLOCK = 2**24  # bytes that are in memory at a time


def is_big(array: Any) -> bool:
    """Whether an array, or a dataset of a file, is to stay on disk."""
    return array.size * array.dtype.itemsize >= BIG


def blocks(array: Any) -> Iterator[slice]:
    """Rows of about `BLOCK` bytes, in their order; at least one block."""
    each = array.size * array.dtype.itemsize // max(len(array), 1)
    step = max(1, BLOCK // max(each, 1))
    yield from (slice(start, start + step) for start in range(0, max(len(array), 1), step))


def contents(array: np.ndarray) -> Iterator[bytes]:
    """Bytes of an array in the order of its entries, a block at a time."""
    if not array.ndim:
        yield array.tobytes()
        return
    for part in blocks(array):
        yield np.ascontiguousarray(array[part]).tobytes()


def scratch(shape: tuple[int, ...], dtype: Any) -> np.memmap:
    """An array of zeros in a file without a name (in TMPDIR), which is gone when the array is.

    Raises:
        OSError: no room.
    """
    with tempfile.TemporaryFile(prefix="gsparc-") as file:
        size = math.prod(shape) * np.dtype(dtype).itemsize
        if size and hasattr(os, "posix_fallocate"):  # a full disk would end the process at the first write
            os.posix_fallocate(file.fileno(), 0, size)
        return np.memmap(file, dtype=dtype, mode="w+", shape=shape)


def on_disk(dataset: h5py.Dataset) -> np.ndarray:
    """A dataset's values where they are, or, stored in chunks, copied beside them block by block."""
    offset = dataset.id.get_offset()
    if offset is not None and dataset.dtype.isnative:
        return np.memmap(dataset.file.filename, dataset.dtype, "r", offset, dataset.shape)
    copy = scratch(dataset.shape, dataset.dtype)
    for part in blocks(dataset):
        copy[part] = dataset[part]
    return copy
