"""One run per folder: the second is refused before it writes anything, and told who holds the first."""

from __future__ import annotations

import os
import socket
import sys
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

LOCK, HOLDER = ".lock", ".held-by"
_held: list[FileLock] = []  # by the command that is running


class InUse(BaseException):
    """Another run writes into the folder; no `Exception`, which Hydra makes a warning of in a callback."""


class RunLock(Callback):
    """Hydra calls it before the folder of a run or a multirun is written to; `release` ends it."""

    def on_run_start(self, config: DictConfig, **unused: Any) -> None:
        """Hold the run's folder."""
        hold(_folder(config, "hydra.run.dir"))

    def on_multirun_start(self, config: DictConfig, **unused: Any) -> None:
        """Hold the multirun's folder, and with it those of its jobs."""
        hold(_folder(config, "hydra.sweep.dir"))


def _folder(config: DictConfig, key: str) -> Path:
    HydraConfig.instance().set_config(config)  # the path may name choices of groups
    return Path(str(OmegaConf.select(config, key)))


def hold(folder: Path) -> None:
    """Lock a folder until `release`; the system does so too when the process ends, however it ends.

    Raises:
        InUse: another process has locked it; says which, since when, with which command.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        holder = ""
        with suppress(OSError):
            holder = f" ({(folder / HOLDER).read_text(encoding='utf-8')})"
        raise InUse(
            f"{folder}: another run writes here{holder}; wait for its end, or give hydra.run.dir=..."
        ) from None
    since = datetime.now().isoformat(sep=" ", timespec="seconds")
    who = f"process {os.getpid()} on {socket.gethostname()} since {since}: {' '.join(sys.argv)}"
    (folder / HOLDER).write_text(who, encoding="utf-8")
    _held.append(lock)


def release() -> None:
    """Unlock what this process holds."""
    while _held:
        lock = _held.pop()
        Path(lock.lock_file).with_name(HOLDER).unlink(missing_ok=True)
        lock.release()  # the file stays: removing it would let a third run pass the second
