"""Work shared by processes, of one machine or of several with a common folder: each piece is done once."""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from filelock import FileLock, Timeout

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
