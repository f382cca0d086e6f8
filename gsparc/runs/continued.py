"""A run that goes on from another one has the settings of that one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import yaml

from gsparc.base.files import SUMMARY
from gsparc.training.effort import GONE

PATHS = ("init_from", "known_walls")  # settings that may be files, beside those of groups
DEEP = 4  # RUN/fold0/refit/last.ckpt


def add_settings_of_run(words: Sequence[str]) -> list[str]:
    """Return a command line with the settings of the run that `ckpt_path=` names; its own win.

    Args:
        words: overrides and options. A group chosen among them, as `model=gp`, leaves out what the
            run was told of that group. A run that was interrupted finishes in its folder,
            unless another is given.
    """
    values = {
        _key(word): word.partition("=")[2].strip("'\"")
        for word in words
        if not word.startswith("-")
    }
    if values.get("ckpt_path", "") in ("", "null"):
        return [*words]
    ckpt = Path(values["ckpt_path"]).resolve()
    notes = [folder / ".hydra" for folder in (ckpt, *ckpt.parents)[:DEEP]]
    hydra_dir = next((folder for folder in notes if (folder / "overrides.yaml").exists()), None)
    if hydra_dir is None:
        return [*words]
    files = (hydra_dir / "overrides.yaml", hydra_dir / "hydra.yaml")
    its, hydra = (yaml.safe_load(file.read_text(encoding="utf-8")) for file in files)
    lines = [line for line in its if not {_key(line), _key(line).partition(".")[0]} & values.keys()]
    # Of runs that seconds ended
    lines = [line for line in lines if _key(line).rpartition(".")[2] not in GONE]
    lines = [_found_from(Path(hydra["hydra"]["runtime"]["cwd"]), line) for line in lines]
    if {"-m", "--multirun"} & {*words}:
        return [*lines, *words]
    lines.append("hydra.mode=RUN")  # it may be a job of a multirun
    # What a finished run has left stays as it is,
    # and so do the settings that an interrupted one began with.
    if "hydra.run.dir" not in values and not (hydra_dir.parent / SUMMARY).exists():
        lines += [f"hydra.run.dir='{hydra_dir.parent}'", "hydra.output_subdir=null"]
    return [*lines, *words]


def _key(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]


def _found_from(folder: Path, override: str) -> str:
    """The override with a path that was given in another working folder made absolute."""
    key, _, value = override.partition("=")
    path = folder / value.strip("'\"")
    moved = folder != Path.cwd() and value and ("." in key or key in PATHS) and path.exists()
    return f"{key}='{path}'" if moved else override
