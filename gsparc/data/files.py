"""Files and folders that appear whole or not at all, also under a kill or on a full disk; tables in YAML."""

from __future__ import annotations

import csv
import errno
import io
import os
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import yaml
from filelock import FileLock, Timeout

from gsparc.data.errors import DataError, reason


def platform_cache() -> Path:
    """Where caches live on this machine: `$XDG_CACHE_HOME/gsparc` or `~/.cache/gsparc`."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "gsparc"


def read_text(path: Path, missing: str, kind: str = "text") -> str:
    """A text in UTF-8; `DataError` says `missing`, or that the file is not readable as `kind`."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise DataError(f"{path}: {missing}") from None
    except (UnicodeDecodeError, OSError) as error:
        raise DataError(f"{path}: not readable as {kind} ({reason(error)})") from None


def read_csv(path: Path, missing: str) -> list[list[str]]:
    """Cells of each line, between commas; `DataError` as of `read_text`."""
    try:
        return list(csv.reader(io.StringIO(read_text(path, missing, "CSV text"))))
    except csv.Error as error:
        raise DataError(f"{path}: not readable as CSV text ({error})") from None


def read_yaml(path: Path, missing: str, expected: str) -> Mapping[str, Any]:
    """A table in YAML.

    Args:
        path: of the file.
        missing, expected: what the message says is wanted where there is no file, or no table in it.

    Raises:
        DataError: missing, not readable, or no table.
    """
    try:
        content = yaml.safe_load(read_text(path, f"missing; expected {missing}", "YAML"))
    except DataError:
        raise
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: not readable as YAML ({reason(error)})") from None
    if not isinstance(content, Mapping):
        raise DataError(f"{path}: expected {expected}")
    return content


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


def no_room(error: BaseException | None) -> bool:
    """Whether a full disk, quota or limit is what an error, or what it was made of, says."""
    while error is not None and not isinstance(error, OSError):
        error = error.__cause__ or error.__context__
    return error is not None and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)


def _partial(path: Path) -> Path:
    """A name of this process alone: several may fill one cache."""
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


_Piece = TypeVar("_Piece")

POLL_S = 0.5  # between looks at what others are doing


@contextmanager
def claimed(lock: Path) -> Iterator[bool]:
    """Whether the work that a lock file stands for is this process's until the block ends.

    The system unlocks the file when its owner ends, also by SIGKILL: a claim never outlives its process.

    Raises:
        ValueError: the file system has no locks.
    """
    lock.parent.mkdir(parents=True, exist_ok=True)
    file = FileLock(lock, fallback_to_soft=False)  # a soft lock would outlive a killed owner
    try:
        file.acquire(timeout=0)
    except Timeout:
        yield False
        return
    except (NotImplementedError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP):
            raise
        raise ValueError(f"{lock}: this file system has no locks; choose a folder on another") from None
    try:
        yield True
    finally:
        file.release()  # the file stays: without it a third process could lock a new one beside the second


def each_once(
    pieces: Iterable[_Piece],
    lock: Callable[[_Piece], Path],
    done: Callable[[_Piece], bool],
    work: Callable[[_Piece], None],
) -> None:
    """Do every piece that is not done and that no other process is doing; then wait for those.

    What a process that ended has left undone is taken over.

    Args:
        pieces: the first ones first.
        lock: file of a piece's claim, the same for all processes.
        done: whether a piece needs nothing more; asked again under its claim.
        work: does a piece, so that `done` then says so.
    """
    left = list(pieces)
    while left:
        others = []
        for piece in left:
            if done(piece):
                continue
            with claimed(lock(piece)) as mine:
                if not mine:
                    others.append(piece)
                elif not done(piece):
                    work(piece)
        left = others
        if left:
            time.sleep(POLL_S)
