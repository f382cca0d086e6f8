"""Cache of finished searches on disk, from which an interrupted run resumes."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gsparc.data.files import whole_file
from gsparc.data.raw import stored_archive
from gsparc.models.checkpoint import SEARCHES
from gsparc.models.image_sources.scene import Scene
from gsparc.models.plain import made, plain
from gsparc.training.time_budget import NOTHING, Clock, Spent, TimeBudget, less_repeatable

log = logging.getLogger(__name__)

FILE = "last.ckpt"


@dataclass(frozen=True)
class Member:
    """Result of one search.

    Attributes:
        scene: with phases.
        left_out: NMSE of its own rows, each receiver predicted from the others.
        number: of the search, from 0.
    """

    scene: Scene
    left_out: float
    number: int = 0


class SearchCache:
    """Finished searches by number.

    Args:
        folder: of the run; None or an empty path for no cache.
        resume: file of an interrupted run, or None.
        depends_on: what searches depend on, by name; a file with other values is refused.

    Attributes:
        spent: training time of the interrupted run up to its last finished search.
        limited_by: the clock whose seconds ended one of the searches.

    Raises:
        ValueError: `resume` holds no searches, or those of other data or settings.
    """

    def __init__(
        self, folder: Path | None = None, resume: Path | None = None,
        depends_on: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        self._path = None if folder is None or folder == Path() else folder / FILE
        self._depends_on = dict(depends_on or {})
        self._searches: dict[str, dict[str, Any]] = {}
        # Searches end in several threads.
        self._lock = threading.Lock()
        self.spent = NOTHING
        self.limited_by: Clock | None = None
        if resume is not None:
            self._open(resume)
        # After `_open`, which reads what the interrupted run had spent.
        self._watch = TimeBudget(before=self.spent)

    def _open(self, file: Path) -> None:
        try:
            # With `weights_only` nothing that a checkpoint holds is executed.
            stored = torch.load(stored_archive(file), weights_only=True)
            before, wall = dict(stored["depends_on"]), float(stored["spent_s"])
            searches, spent = dict(stored[SEARCHES]), Spent(wall, float(stored["processor_s"]))
        except Exception as error:  # any error of a damaged or foreign file
            raise ValueError(
                f"ckpt_path={file}: holds no finished searches ({type(error).__name__}); start without it"
            ) from error
        other = [name for name, value in self._depends_on.items() if before.get(name) != value]
        if other:
            raise ValueError(f"ckpt_path={file}: is of other {', '.join(other)}; start without it")
        self._searches, self.spent, self.limited_by = searches, spent, stored.get("limited_by")
        log.info("reusing %d cached searches (%.0f s of training time)", len(searches), wall)

    def find(self, number: int) -> Member | None:
        """Return the finished search of this number, or None."""
        with self._lock:
            search = self._searches.get(f"search {number}")
        return None if search is None else made(Member, search)

    def put(self, member: Member, limited_by: Clock | None) -> None:
        """Store a finished search, and what has ended one so far; the file is written atomically."""
        with self._lock:
            self.limited_by = less_repeatable(self.limited_by, limited_by)
            self._searches[f"search {member.number}"] = plain(member)
            self._write()

    def interrupted(self) -> str:
        """Write what has finished, if only the time spent; what to do to go on from it, for a person."""
        with self._lock:
            if self._path is None:
                return "the search was interrupted; it has no folder to leave a checkpoint in"
            self._write()
            count = len(self._searches)
        return f"the search was interrupted, {count} finished; go on with ckpt_path={self._path}"

    def _write(self) -> None:
        if self._path is None:
            return
        spent = self._watch.counted
        facts = {"spent_s": spent.wall, "processor_s": spent.processor, "limited_by": self.limited_by}
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(self._path) as partial, partial.open("wb") as file:
            torch.save({"depends_on": self._depends_on, **facts, SEARCHES: self._searches}, file)
