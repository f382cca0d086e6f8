"""`gsparc export ckpt=FILE to=c`: a trained model for programs without Python."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import DictConfig

import gsparc.ops
from gsparc.commands.output import finish, run_directory
from gsparc.commands.settings import RunSettings
from gsparc.data.files import whole_folder
from gsparc.data.limits import SettingError, choice, whole
from gsparc.prediction.compiled.blob import write
from gsparc.prediction.compiled.make import compiled
from gsparc.prediction.operating_point import load

SOURCES = Path(gsparc.ops.__file__).parent / "csrc"


def task(config: DictConfig) -> dict[str, Any]:
    """Export, and say what is lost; returns the facts of `summary.json`."""
    RunSettings.of(config)
    choice("c").check("to", config.to)
    whole(1).check("places", config.places)
    path = Path(config.ckpt)
    out = path.with_name(f"{path.stem}-{config.to}") if config.out is None else Path(config.out)
    if out.exists():
        raise SettingError(f"out={out}: is there already; remove it or name another folder")
    predictor = load(path)
    predictor = predictor if config.station is None else predictor.at(config.station)
    found = compiled(predictor, int(config.places))
    with whole_folder(out) as folder:
        size = write(folder / "field.gsparc", found.form, np.asarray(predictor.site.origin), found.error)
        shutil.copy(SOURCES / "field" / "gsparc_field.h", folder)
        shutil.copytree(
            SOURCES, folder / "source", ignore=shutil.ignore_patterns("cuda", "projection", "bindings.cpp")
        )
    facts = {
        "export/bytes": size, "export/error": found.error, "export/form": found.form.kind,
        "model/name": predictor.method.name, "out": str(out), "ckpt": str(path),
    }  # fmt: skip
    build = f"cmake -S {out}/source/field -B {out}/build && cmake --build {out}/build"
    lines = [found.said, f"{size / 1e6:.2f} MB in {out}/field.gsparc; the library: {build}"]
    return finish(run_directory(), facts, lines=lines, before="summary ")
