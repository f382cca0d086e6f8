"""Jobs of a multirun, each done once: the same command in the same `hydra.sweep.dir` does what is left."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from gsparc.commands.settings import plain
from gsparc.data.claims import claimed
from gsparc.data.files import whole_file
from gsparc.evaluation.report.sweep import FAILURE

log = logging.getLogger(__name__)

RECORD = "job.json"  # of a job's folder: its settings, when it began, and what it returned
LAST = ("refit/last.ckpt", "last.ckpt")  # the later stage first


def once(run_dir: Path, config: DictConfig, work: Callable[[DictConfig], float]) -> float:
    """What a job returns: as recorded where it has ended in this folder, else from its last checkpoint on.

    Args:
        run_dir: the job's own.
        config: of the job; `ckpt_path` is filled in where there is a checkpoint to go on from.
        work: does the job.

    Raises:
        ValueError: another process is doing it.
    """
    with claimed(run_dir / ".job.lock") as mine:
        if not mine:
            raise ValueError(f"{run_dir}: another process does this job; wait for its end")
        settings = json.loads(json.dumps(plain(config), default=str))
        record = _read(run_dir / RECORD)
        if record is None or record["settings"] != settings:
            record = {"settings": settings, "began": time.time(), "returned": None}
            _write(run_dir / RECORD, record)
        elif record["returned"] is not None:
            log.info("%s: was done before", run_dir)
            return float(record["returned"])
        elif config.ckpt_path is None:
            config.ckpt_path = _left(run_dir, record["began"])
        (run_dir / FAILURE).unlink(missing_ok=True)  # of an earlier try
        value = work(config)
        _write(run_dir / RECORD, {**record, "returned": value})
        return value


def _left(run_dir: Path, began: float) -> str | None:
    """The last checkpoint of this job, or the folder of several folds; None: it begins anew."""
    for name in LAST:
        if _is_of(run_dir / name, began):
            return str(run_dir / name)
    return str(run_dir) if any(_is_of(path, began) for path in run_dir.glob("fold*/last.ckpt")) else None


def _is_of(path: Path, began: float) -> bool:
    """Whether a checkpoint is there and of this job, not of one with other settings before."""
    return path.exists() and path.stat().st_mtime >= began


def _read(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _write(path: Path, record: dict[str, Any]) -> None:
    with whole_file(path) as partial:
        partial.write_text(json.dumps(record, indent=1), encoding="utf-8")
