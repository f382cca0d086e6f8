"""A file that is read, changed and written again: by one process, and one thread of it, at a time."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock

POLL_S = 0.02  # between two looks whether a lock is free


@contextmanager
def hold_file(path: str | Path, wait_s: float) -> Iterator[None]:
    """Hold a file against all others who hold it so, in turn; the system lets it go when the process ends.

    >>> with hold_file("model.ckpt", wait_s=60):
    ...     pass  # read, change, write

    Raises:
        TimeoutError: others held it for so long [s].
        OSError: it cannot be locked.
    """
    path, end = Path(path).resolve(), time.monotonic() + wait_s  # a link and its file are one
    with ExitStack() as held:
        # Who comes next waits with the turn: else who has just written would be there again before it looks.
        with _held(path.with_name(f".{path.name}.turn"), wait_s):
            held.enter_context(_held(path.with_name(f".{path.name}.lock"), max(end - time.monotonic(), 0)))
        yield


@contextmanager
def _held(file: Path, wait_s: float) -> Iterator[None]:
    with FileLock(file, wait_s, poll_interval=POLL_S):
        try:
            yield
        finally:
            # Deleted while it is held: who locked it meanwhile sees that it is gone, and makes another.
            with suppress(OSError):
                file.unlink()
