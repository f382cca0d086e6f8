"""One run per folder: the second is refused before it writes anything,
and told who holds the first.
"""

from __future__ import annotations

import os
import socket
import sys
from contextlib import ExitStack, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import AcquireReturnProxy, FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from gsparc.base.files import SUMMARY, delete_partial_files, set_aside

LOCK = ".run.lock"  # says who holds the folder, while it is held
_held = ExitStack()  # folders of the command that is running
release_folders = _held.close  # of this process; the files stay, or a third would pass the second


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
    try:
        _held.enter_context(locked(folder))  # before looking: of two, one sees the other
        around = [parent / LOCK for parent in folder.resolve().parents]
        for lock in around + (sorted(folder.rglob(LOCK)) if jobs else []):
            if lock.exists():
                locked(lock.parent).lock.release()
    except ValueError as busy:
        raise InUse(str(busy)) from None
    delete_partial_files(folder)


def locked(folder: Path, setting: str = "hydra.run.dir") -> AcquireReturnProxy:
    """Lock the folder of a setting, where it is not this thread's already; a `with` ends that.

    Raises:
        ValueError: another process or thread has locked it, or it cannot be locked.
    """
    lock = FileLock(folder.resolve() / LOCK, is_singleton=True, on_acquired=_sign)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        return lock.acquire(timeout=0)
    except Timeout:
        other = ""
        with suppress(OSError):
            other = f" ({Path(lock.lock_file).read_text(encoding='utf-8')})"
        why = f"another run writes here{other}; wait for its end, or"
    except (OSError, NotImplementedError) as error:
        why = f"cannot be locked ({error});"
    raise ValueError(f"{folder}: {why} give another {setting}=...")


def _sign(lock: int) -> None:
    since = datetime.now().isoformat(sep=" ", timespec="seconds")
    who = f"process {os.getpid()} on {socket.gethostname()} since {since}: {' '.join(sys.argv)}"
    with suppress(OSError):  # somebody else's file, of a run that has ended
        os.ftruncate(lock, 0)
        os.write(lock, who.encode())
