"""Files and folders that appear whole or not at all, also under a kill or on a full disk."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def platform_cache() -> Path:
    """Where caches live on this machine: `$XDG_CACHE_HOME/gsparc` or `~/.cache/gsparc`."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "gsparc"


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """A path beside `path` to write a file to; its folder is made.

    When the block ends the file is on the disk and takes the place of `path`. A block that fails leaves what
    was there, and nothing else.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = _partial(path)
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: str | Path) -> Iterator[Path]:
    """An empty folder beside `path`, which must not exist; it becomes `path` when the block ends.

    For contents that are a function of the name: where another process made `path` meanwhile, that one stays.
    """
    path = Path(path)
    partial = _partial(path)
    partial.mkdir(parents=True)
    try:
        yield partial
        try:
            os.rename(partial, path)
        except OSError:
            if not path.is_dir():
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _partial(path: Path) -> Path:
    """A name of this process alone: several may fill one cache."""
    return path.with_name(f".{path.name}.{os.getpid()}.partial")
