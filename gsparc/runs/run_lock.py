"""One run per folder: the second is refused before it writes anything,
and told who holds the first.
"""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from gsparc.base.files import SUMMARY, delete_partial_files, set_aside

LOCK, HOLDER = ".lock", ".held-by"
_locks: list[FileLock] = []  # by the command that is running


class InUse(BaseException):
    """The folder is not ours to write to; no `Exception`,
    which Hydra makes a warning of in a callback.
    """


class RunLock(Callback):
    """Hydra calls it before the folder of a run or a multirun is written to;
    `release_folders` ends it.
    """

    def on_run_start(self, config: DictConfig, **unused: Any) -> None:
        """Hold the run's folder, in which an earlier summary would be that of other files."""
        folder = _folder(config, "hydra.run.dir")
        hold_folder(folder)
        if config.hydra.output_subdir is not None:  # it writes there
            # A log is appended to: of a new training it is a new one.
            anew = "ckpt_path" in config and not config.ckpt_path
            set_aside(folder, SUMMARY, *["*.log"] * anew)

    def on_multirun_start(self, config: DictConfig, **unused: Any) -> None:
        """Hold the multirun's folder, and with it those of its jobs."""
        folder = _folder(config, "hydra.sweep.dir")
        hold_folder(folder, jobs=True)
        set_aside(folder, SUMMARY)


def _folder(config: DictConfig, key: str) -> Path:
    HydraConfig.instance().set_config(config)  # the path may name choices of groups
    return Path(str(OmegaConf.select(config, key)))


def hold_folder(folder: Path, jobs: bool = False) -> None:
    """Lock a folder until `release_folders`; the system does so too when the process ends,
    however it ends.

    Args:
        folder: made where there is none.
        jobs: whether folders in it will be written to as well.

    Raises:
        InUse: another process has locked it, a folder it lies in, or, with `jobs`, one in it: says
            which, since when, with which command. Or it cannot be locked.
    """
    since = datetime.now().isoformat(sep=" ", timespec="seconds")
    who = f"process {os.getpid()} on {socket.gethostname()} since {since}: {' '.join(sys.argv)}"
    _locks.append(_lock(folder, holder=who))  # named before looking: of two, one sees the other
    near = [parent / HOLDER for parent in folder.resolve().parents]
    for other in near + (sorted(folder.rglob(HOLDER)) if jobs else []):
        if other.exists() and other.parent != folder:
            _lock(other.parent).release()
    delete_partial_files(folder)


@contextmanager
def locked(folder: Path, setting: str = "hydra.run.dir") -> Iterator[None]:
    """Hold the folder of a setting meanwhile; nothing where a command of this process holds it.

    Raises:
        ValueError: another process has locked it, or it cannot be locked.
    """
    if folder.resolve() in (Path(lock.lock_file).parent for lock in _locks):
        yield
        return
    try:
        lock = _lock(folder, setting)
    except InUse as busy:
        raise ValueError(str(busy)) from None
    try:
        yield
    finally:
        lock.release()


def _lock(folder: Path, setting: str = "hydra.run.dir", holder: str = "") -> FileLock:
    """Its lock, held, and beside it who holds it, where that is given."""
    lock = FileLock(folder.resolve() / LOCK)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
        if holder:
            (folder / HOLDER).write_text(holder, encoding="utf-8")
        return lock
    except Timeout:
        other = ""
        with suppress(OSError):
            other = f" ({(folder / HOLDER).read_text(encoding='utf-8')})"
        why = f"another run writes here{other}; wait for its end, or"
    except (OSError, NotImplementedError) as error:
        lock.release()
        why = f"cannot be locked ({error});"
    raise InUse(f"{folder}: {why} give another {setting}=...")


def release_folders() -> None:
    """Unlock what this process holds."""
    while _locks:
        lock = _locks.pop()
        with suppress(OSError):
            Path(lock.lock_file).with_name(HOLDER).unlink(missing_ok=True)
        lock.release()  # the file stays: removing it would let a third run pass the second
