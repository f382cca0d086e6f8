"""Zip archives that are opened safely, as `torch.save` writes them."""

from __future__ import annotations

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
