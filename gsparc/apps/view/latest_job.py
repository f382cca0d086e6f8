"""Work that is asked for faster than it is done: of each kind only the newest is,
in a thread of its own.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Hashable, Iterator

log = logging.getLogger(__name__)

Job = Callable[[], Iterator[object]]  # a generator function
OVER = object()


class LatestJobQueue:
    """Runs jobs one step at a time; a job of a key replaces the one before,
    also in the midst of it.

    A job is a generator function: after each `yield` another job may have its turn. Those that
    are urgent go first, the others follow in rotation, so that a long job does not delay a short
    one by more than one of its steps, and a client that asks often does not keep others waiting.
    """

    def __init__(self) -> None:
        self._wake = threading.Condition()
        self._jobs: dict[Hashable, tuple[bool, Iterator[object]]] = {}
        self._over = False
        self._thread = threading.Thread(target=self._work, name="gsparc view", daemon=True)
        self._thread.start()

    def put(self, key: Hashable, job: Job, urgent: bool = False) -> None:
        """Have a job done in place of the key's present one; returns at once."""
        with self._wake:
            self._jobs.pop(key, None)
            self._jobs[key] = urgent, job()
            self._wake.notify_all()

    def drop_client(self, client: Hashable) -> None:
        """Drop the jobs whose keys begin with a client."""
        with self._wake:
            for key in [key for key in self._jobs if isinstance(key, tuple) and key[0] == client]:
                del self._jobs[key]

    def close(self) -> None:
        """End after the present step."""
        with self._wake:
            self._over = True
            self._jobs.clear()
            self._wake.notify_all()
        self._thread.join()

    def _work(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._jobs or self._over)
                if self._over:
                    return
                key = next(
                    (key for key, (urgent, _) in self._jobs.items() if urgent),
                    next(iter(self._jobs)),
                )
                entry = self._jobs[key]
            done = True
            try:
                done = next(entry[1], OVER) is OVER
            except Exception:  # one picture less; the next drag draws again
                log.exception("a step of %s failed", key)
            with self._wake:
                if self._jobs.get(key) is entry:  # neither replaced nor forgotten meanwhile
                    del self._jobs[key]
                    if not done:
                        self._jobs[key] = entry  # at the end of the rotation
