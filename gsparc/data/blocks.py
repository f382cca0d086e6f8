"""Arrays too large to be copied in memory: read block by block, results on disk."""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Callable, Iterator
from multiprocessing import context, reduction
from typing import IO, TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import h5py  # opened by who reads files

BIG = 2**28  # bytes of a measurement that stays on disk
BLOCK = 2**24  # bytes that are in memory at a time


def machine_memory() -> float:
    """Return the memory of the machine [bytes]."""
    return float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


def is_big(array: Any) -> bool:
    """Tell whether an array, or a dataset of a file, is to stay on disk."""
    return array.size * array.dtype.itemsize >= BIG


def row_blocks(array: Any) -> Iterator[slice]:
    """Yield rows of about `BLOCK` bytes, in their order; at least one block."""
    each = array.size * array.dtype.itemsize // max(len(array), 1)
    step = max(1, BLOCK // max(each, 1))
    yield from (slice(start, start + step) for start in range(0, max(len(array), 1), step))


def iterate_bytes(array: np.ndarray) -> Iterator[bytes]:
    """Yield bytes of an array in the order of its entries, a block at a time."""
    array = np.atleast_1d(array)
    for part in row_blocks(array):
        yield np.ascontiguousarray(array[part]).tobytes()


class OnDisk(np.memmap):
    """An array in a file. A process that is started with it opens the file,
    instead of getting a copy.

    Attributes:
        file: what it maps, kept open; parts of the array have none, and are copied.
    """

    file: IO[bytes] | None = None

    @staticmethod
    def from_file(
        file: IO[bytes], dtype: Any, mode: Any, shape: tuple[int, ...], offset: int = 0
    ) -> OnDisk:
        """Return what lies in an open file from `offset` on [bytes]."""
        array = OnDisk(file, dtype, mode, offset, shape)
        array.file = file
        return array

    def __reduce__(self) -> Any:
        """For a process that is being started: a duplicate of the open file,
        which may have no name.
        """
        if self.file is None or context.get_spawning_popen() is None:
            return super().__reduce__()
        duplicate = reduction.DupFd(self.file.fileno())
        return _opened, (duplicate, self.dtype, self.shape, self.offset)


def _opened(handle: Any, dtype: Any, shape: tuple[int, ...], offset: int) -> OnDisk:
    return OnDisk.from_file(os.fdopen(handle.detach(), "rb"), dtype, "r", shape, offset)


def allocate_on_disk(shape: tuple[int, ...], dtype: Any) -> OnDisk:
    """Return zeros in a file without a name (in TMPDIR), which is gone when the array is.

    Raises:
        OSError: no room.
    """
    file = tempfile.TemporaryFile(prefix="gsparc-")  # noqa: SIM115 (the array keeps it)
    size = math.prod(shape) * np.dtype(dtype).itemsize
    if size:  # a full disk would end the process at the first write
        os.posix_fallocate(file.fileno(), 0, size)
    return OnDisk.from_file(file, dtype, "w+", shape)


def write_blocks(shape: tuple[int, ...], dtype: Any, values: Callable[[slice], Any]) -> OnDisk:
    """Return an array on disk, its rows written as `values` of each block of them are made."""
    array = allocate_on_disk(shape, dtype)
    for part in row_blocks(array):
        array[part] = values(part)
    return array


def allocate(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Return an array to be filled, on disk where it is large.

    Raises:
        OSError: no room.
    """
    large = math.prod(shape) * np.dtype(dtype).itemsize >= BIG
    return allocate_on_disk(shape, dtype) if large else np.empty(shape, dtype)


def take(array: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return rows (n,) of an array, on disk where they are many and lie there already."""
    if not isinstance(array, np.memmap) or len(rows) * array[:1].nbytes < BIG:
        return array[rows]
    return write_blocks((len(rows), *array.shape[1:]), array.dtype, lambda part: array[rows[part]])


def map_from_disk(dataset: h5py.Dataset) -> OnDisk:
    """Return a dataset's values where they are, or, stored in chunks,
    copied beside them by blocks.
    """
    offset = dataset.id.get_offset()
    if offset is not None and dataset.dtype.isnative:
        file = open(dataset.file.filename, "rb")  # noqa: SIM115 (the array keeps it)
        return OnDisk.from_file(file, dataset.dtype, "r", dataset.shape, offset)
    return write_blocks(dataset.shape, dataset.dtype, lambda part: dataset[part])


def rows_by(label: np.ndarray) -> Iterator[tuple[Any, np.ndarray]]:
    """Yield each different label of (n,), and the rows (k,) that have it."""
    for value in np.unique(label).tolist():
        yield value, np.flatnonzero(label == value)
