"""Whether a file can hold the arrays that it states, and whether there is room for them."""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path
from shutil import disk_usage

from gsparc.base.errors import DataError
from gsparc.data.blocks import BIG, machine_memory

LARGEST = 2**40  # bytes of a file's arrays, ten times the largest campaign that is published
# Times a file's bytes, as deflate packs 1,032 to one at best: the rest was never written
MOST_PACKED = 1100
# Bytes of disk that other programs keep; of memory half, for what is made of the arrays
SPARE = 2**30
# Shapes, and bytes that are taken when they are read
Stated = dict[str, tuple[tuple[int, ...], int]]


def check_array_sizes(path: Path, stated: Stated, to_disk: bool = False) -> None:
    """Raise DataError before an array is read that the file cannot hold,
    or for which there is no room.

    Args:
        path: of the file.
        stated: of its arrays, by the file, which may lie.
        to_disk: whether large ones are copied to TMPDIR.
    """
    rows = Counter(shape[0] for shape, _ in stated.values() if shape)
    name, (shape, size) = max(stated.items(), key=lambda item: item[1][1], default=("", ((), 0)))
    total, packed, disk = (
        sum(size for _, size in stated.values()),
        path.stat().st_size,
        tempfile.gettempdir(),
    )
    copied = sum(size for _, size in stated.values() if size >= BIG) * to_disk
    most, room = min(max(BIG, MOST_PACKED * packed), LARGEST), max(BIG, machine_memory() / 2)
    memory = total - copied
    faults = {
        f"a file of {packed:,} bytes does not hold that": total > most,
        f"no other array has {shape[:1]} rows": size >= BIG
        and rows[shape[0]] < 2
        and name[:5] != "path_",
        f"{disk} has no room; set TMPDIR to a larger disk": copied
        > max(disk_usage(disk).free - SPARE, 0),
        f"too little memory for {memory:,}; HDF5 without a mask may stay on disk": memory > room,
    }
    for fault in (text for text, holds in faults.items() if holds):
        raise DataError(f"{path}, {name}: shape {shape}, {size:,} bytes: {fault}")
