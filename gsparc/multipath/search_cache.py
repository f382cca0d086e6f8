"""Cache of finished searches on disk, from which an interrupted run resumes."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from gsparc.data.files import whole_file
from gsparc.methods.checkpoint import SEARCHES

if TYPE_CHECKING:
    from gsparc.multipath.ensemble import Member
    from gsparc.multipath.phased_gp import PhasedScene

log = logging.getLogger(__name__)

FILE = "last.ckpt"


class SearchCache:
    """Finished searches by name.

    Args:
        folder: of the run; None or an empty path for no cache.
        resume: file of an interrupted run, or None.
        key: hash of what searches depend on; a file of another key is refused.
        pack, unpack: convert a scene to plain containers, and back.

    Attributes:
        spent_s: training time of the interrupted run up to its last finished search [s].

    Raises:
        ValueError: `resume` holds no searches, or those of other data or settings.
    """

    def __init__(
        self,
        folder: Path | None,
        resume: Path | None,
        key: str,
        pack: Callable[[PhasedScene], dict[str, Any]],
        unpack: Callable[[dict[str, Any]], PhasedScene],
    ) -> None:
        self._path = None if folder is None or folder == Path() else folder / FILE
        self._key, self._pack, self._unpack = key, pack, unpack
        self._kept: dict[str, dict[str, Any]] = {}
        self._lock = threading.Lock()
        self.spent_s = 0.0
        if resume is not None:
            self._open(resume)
        self._started = time.monotonic() - self.spent_s

    def _open(self, file: Path) -> None:
        try:
            stored = torch.load(file, weights_only=True)
            key, kept, spent = str(stored["key"]), dict(stored[SEARCHES]), float(stored["spent_s"])
        except Exception as error:  # any error of a damaged or foreign file
            raise ValueError(
                f"ckpt_path={file}: holds no finished searches ({type(error).__name__}); start without it"
            ) from error
        if key != self._key:
            raise ValueError(f"ckpt_path={file}: is of other data, rows or settings; start without it")
        self._kept, self.spent_s = kept, spent
        log.info("reusing %d cached searches (%.0f s of training time)", len(kept), spent)

    def find(self, name: str) -> Member | None:
        """The finished search of this name, or None."""
        from gsparc.multipath.ensemble import Member

        with self._lock:
            kept = self._kept.get(name)
        return None if kept is None else Member(self._unpack(kept["scene"]), float(kept["left_out"]))

    def put(self, name: str, member: Member) -> None:
        """Store a finished search; the file is written atomically."""
        with self._lock:
            self._kept[name] = {"scene": self._pack(member.phased), "left_out": member.left_out}
            if self._path is None:
                return
            spent = time.monotonic() - self._started
            with whole_file(self._path) as partial, partial.open("wb") as file:
                torch.save({"key": self._key, "spent_s": spent, SEARCHES: self._kept}, file)
