"""Whether text in HDF5 can be read: another process tries first,
as the library may crash or hang.
"""

from __future__ import annotations

import mmap
import subprocess
import sys
from pathlib import Path

HEAP = b"GCOL"  # signature of a global heap (HDF5 file format specification 3.0, III.E)
SECONDS = 20.0
READ = """
import sys, h5py
with h5py.File(sys.argv[1], "r") as file:
    for item in file.values():
        if isinstance(item, h5py.Dataset):
            if item.dtype.hasobject and item.nbytes < 2**28:
                item[()]
            dict(item.attrs)
    dict(file.attrs)
"""


def hdf5_text_error(path: Path, seconds: float = SECONDS) -> str | None:
    """Say why text in HDF5 cannot be read within `seconds`; None when it can,
    or when there is none.
    """
    if not _has_heap(path):
        return None
    try:
        read, nothing = [sys.executable, "-I", "-c", READ, str(path.absolute())], subprocess.DEVNULL
        process = subprocess.run(read, stdin=nothing, capture_output=True, timeout=seconds)
    except subprocess.TimeoutExpired:
        return f"its text cannot be read in {seconds:g} s"
    if process.returncode < 0:
        return "its text crashes the HDF5 library"
    last = process.stderr.decode(errors="replace").strip().splitlines()
    return None if process.returncode == 0 else last[-1] if last else "its text cannot be read"


def _has_heap(path: Path) -> bool:
    if path.stat().st_size == 0:
        return False
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content.find(HEAP) >= 0
