"""What was interrupted goes on: runs, and jobs of a multirun, each done once in its `hydra.sweep.dir`."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig

from gsparc.commands.shared.run_lock import locked
from gsparc.commands.shared.settings import plain
from gsparc.data.files import whole_file
from gsparc.evaluation.report.sweep import FAILURE
from gsparc.models.parts import LAST

log = logging.getLogger(__name__)

RECORD = "job.json"  # of a job's folder: its settings and data, when it began, and what it returned
WHERE = ("engine", "workers", "ray")  # settings of where a job is done
PATHS = ("init_from", "known_walls")  # settings that may be files, beside those of groups
DEEP = 4  # RUN/fold0/refit/last.ckpt
PARTS = ("fold*/**/*.ckpt", "station*/*.ckpt", "unheard/*.ckpt")  # finished or not


def with_settings_of_run(words: Sequence[str]) -> list[str]:
    """A command line with the settings of the run that its `ckpt_path=` names; what it says itself wins.

    Args:
        words: overrides and options. A group chosen among them, as `model=gp`, leaves out what the run was
            told of that group.
    """
    said = {_key(word): word.partition("=")[2].strip("'\"") for word in words if not word.startswith("-")}
    if not said.get("ckpt_path"):
        return [*words]
    left = Path(said["ckpt_path"]).resolve()
    notes = [folder / ".hydra" for folder in (left, *left.parents)[:DEEP]]
    told = next((folder for folder in notes if (folder / "overrides.yaml").exists()), None)
    if told is None:
        return [*words]
    files = (told / "overrides.yaml", told / "hydra.yaml")
    its, hydra = (yaml.safe_load(file.read_text(encoding="utf-8")) for file in files)
    own = [one for one in its if not {_key(one), _key(one).partition(".")[0]} & said.keys()]
    own = [_found_from(Path(hydra["hydra"]["runtime"]["cwd"]), one) for one in own]
    once_only = [] if {"-m", "--multirun"} & {*words} else ["hydra.mode=RUN"]  # it may be a job of a multirun
    return [*own, *once_only, *words]


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]


def _found_from(folder: Path, override: str) -> str:
    """The override with a path that was given in another working folder made absolute."""
    key, _, value = override.partition("=")
    path = folder / value.strip("'\"")
    moved = folder != Path.cwd() and value and ("." in key or key in PATHS) and path.exists()
    return f"{key}='{path}'" if moved else override


def once(
    run_dir: Path, config: DictConfig, work: Callable[[DictConfig], float], again: bool = False
) -> float:
    """What a job returns: as recorded where it has ended in this folder, else from its last checkpoint on.

    Args:
        run_dir: the job's own.
        config: of the job; `ckpt_path` is filled in where there is a checkpoint to go on from.
        work: does the job.
        again: it is a run by itself: done anew where it has ended.

    Raises:
        ValueError: another process is doing it.
    """
    with locked(run_dir / ".job"):  # the run's own is its work's
        stated = {name: value for name, value in plain(config).items() if name not in WHERE}
        settings = json.loads(json.dumps(stated, default=str))
        now = {"settings": settings, "data": _files(settings.get("dataset"), run_dir)}
        record = _read(run_dir / RECORD)
        same = record is not None and all(record.get(key, now[key]) == now[key] for key in now)
        if record is None or not same or (again and record["returned"] is not None):
            record = {**now, "began": time.time(), "returned": None}
            _write(run_dir / RECORD, record)
        elif record["returned"] is not None:
            log.info("%s: was done before", run_dir)
            return float(record["returned"])
        elif config.ckpt_path is None:
            config.ckpt_path = _last_state(run_dir, record["began"])
        (run_dir / FAILURE).unlink(missing_ok=True)  # of an earlier try
        value = work(config)
        _write(run_dir / RECORD, {**record, "returned": value})
        return value


def _files(dataset: Any, run_dir: Path) -> dict[str, list[int]]:
    """Number, bytes and last change [ns] of the files that settings of a dataset name, but for runs' own."""
    named = {Path(value) for value in dict(dataset or {}).values() if isinstance(value, str) and value}
    stats = {}
    for path in sorted(one.resolve() for one in named if one.exists()):
        runs = {run_dir.resolve(), *(one.parent for one in path.rglob(RECORD))}
        runs = {one for one in runs if path in one.parents}  # as with dataset.root=.
        every = path.rglob("*") if path.is_dir() else [path]
        inside = [one.stat() for one in every if one.is_file() and runs.isdisjoint(one.parents)]
        newest = max((one.st_mtime_ns for one in inside), default=0)
        stats[str(path)] = [len(inside), sum(one.st_size for one in inside), newest]
    return stats


def _last_state(run_dir: Path, began: float) -> str | None:
    """The last checkpoint of this job, not of one with other settings before, or the folder of one of many
    parts; None: it begins anew."""

    def own(path: Path) -> bool:
        return path.exists() and path.stat().st_mtime >= began

    for name in LAST:
        if own(run_dir / name):
            return str(run_dir / name)
    return str(run_dir) if any(own(path) for pattern in PARTS for path in run_dir.glob(pattern)) else None


def _read(path: Path) -> dict[str, Any] | None:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None


def _write(path: Path, record: dict[str, Any]) -> None:
    with whole_file(path) as partial:
        partial.write_text(json.dumps(record, indent=1), encoding="utf-8")
