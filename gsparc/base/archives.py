"""Archives that are opened safely: zip, as `torch.save` writes it, and text in HDF5, which another
process reads first, as the library may crash or hang.
"""

from __future__ import annotations

import mmap
import subprocess
import sys
import zipfile
from io import BytesIO
from pathlib import Path


def is_archive(path: Path) -> bool:
    """Tell whether a file is a zip archive from its first byte on."""
    try:
        with path.open("rb") as file:
            if file.read(4) != b"PK\x03\x04":
                return False
        return zipfile.is_zipfile(path)
    except zipfile.BadZipFile:  # a damaged directory of a large archive
        return False


def verified_archive(path: Path) -> BytesIO:
    """Return what `torch.save` wrote, written anew from bytes whose checksums are right.

    torch looks at no checksum, takes entries marked as folders for read, and inflates what is
    deflated whatever its size.

    Raises:
        ValueError: it is damaged, or nothing that torch writes.
    """
    clean = BytesIO()
    if not is_archive(path):
        raise ValueError("not a gsparc checkpoint, or cut short")
    try:
        with zipfile.ZipFile(path) as archive, zipfile.ZipFile(clean, "w") as copy:
            entries = archive.infolist()
            names = {entry.filename for entry in entries}
            stored = all(entry.compress_type == zipfile.ZIP_STORED for entry in entries)
            stored &= sum(entry.file_size for entry in entries) <= path.stat().st_size
            faults = {
                "an archive, but not a gsparc checkpoint": not any(
                    n.endswith("/data.pkl") for n in names
                ),
                "damaged (an entry is there twice)": len(names) < len(entries),
                "damaged (entries are compressed, or larger than the file)": not stored,
            }
            wrong = next((fault for fault, holds in faults.items() if holds), None)
            for entry in () if wrong else entries:
                copy.writestr(entry.filename, archive.read(entry))
    except Exception as error:  # whatever a damaged archive raises
        wrong = f"damaged ({type(error).__name__}: {error})"
    if wrong:
        raise ValueError(wrong)
    clean.seek(0)
    return clean


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
