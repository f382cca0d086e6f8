"""Fetch a set from a hub of data sets: one revision,
its sum kept at the first fetch and compared later.
"""

from __future__ import annotations

import json
import logging
from hashlib import sha256
from pathlib import Path

from gsparc.base.errors import DataError, explain_error
from gsparc.base.files import write_whole

log = logging.getLogger(__name__)

FACTS = "fetched.json"  # beside the files: revision, bytes and sum of the first fetch
WANTS = "gsparc data: this set needs the hub's own client: pip install 'gsparc[hub]'"


def fetch_from_hub(repository: str, part: str, folder: Path) -> Path:
    """Fetch one folder of a hub's repository, or compare what is there with its first fetch.

    Args:
        repository: owner and name at the hub (HF_ENDPOINT names a mirror).
        part: folder inside the repository.
        folder: what it is stored in.

    Raises:
        DataError: no client, no network, no such folder there, or files that differ from their
            first fetch.
    """
    place, facts = folder / part, folder / FACTS
    first = json.loads(facts.read_text(encoding="utf-8")) if facts.is_file() else {}
    if "sha256" not in first:
        first["revision"] = _download(repository, part, folder, first.get("revision"), facts)
    size, sha256 = _sum_of(place)
    if "sha256" in first and sha256 != first["sha256"]:
        fault = (
            f"{size:,} bytes, SHA-256 {sha256}, are not those of the first fetch "
            f"({first['sha256']})"
        )
        raise DataError(f"{place}: {fault}; delete {folder} and fetch again")
    log.info(
        "%s at %s: %s bytes, SHA-256 %s",
        repository,
        first["revision"][:10],
        f"{size:,}",
        sha256,
    )
    write_whole(facts, json.dumps({**first, "bytes": size, "sha256": sha256}) + "\n")
    return place


def _download(repository: str, part: str, folder: Path, revision: str | None, facts: Path) -> str:
    """Fetch what is missing and return the revision: the newest,
    or that of a fetch that was cut off.
    """
    try:
        import httpx2
        from huggingface_hub import HfApi, snapshot_download
    except ImportError:
        raise DataError(WANTS) from None
    try:
        about = HfApi().dataset_info(repository, revision=revision, files_metadata=True)
        sizes = [
            sibling.size or 0
            for sibling in about.siblings or ()
            if sibling.rfilename.startswith(f"{part}/")
        ]
        if not sizes or about.sha is None:
            raise DataError(
                f"{repository} has no folder {part} any more; what it has is listed at the hub"
            )
        log.info("%s: %s files, %.0f MB", repository, f"{len(sizes):,}", sum(sizes) / 1e6)
        write_whole(facts, json.dumps({"revision": about.sha}) + "\n")
        snapshot_download(
            repository,
            repo_type="dataset",
            revision=about.sha,
            allow_patterns=f"{part}/*",
            local_dir=folder,
        )
    except (httpx2.HTTPError, OSError, ValueError) as error:
        why = f"{explain_error(error)}; what is there is kept: say it again"
        raise DataError(f"{repository}: {why}") from None
    return about.sha


def _sum_of(folder: Path) -> tuple[int, str]:
    """Return the bytes of a folder's files and one SHA-256 of all names and contents."""
    total, size = sha256(), 0
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        content = path.read_bytes()
        total.update(
            f"{path.relative_to(folder).as_posix()} {sha256(content).hexdigest()}\n".encode()
        )
        size += len(content)
    return size, total.hexdigest()
