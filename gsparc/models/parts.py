"""Runs of many parts, stations or folds: a part that an interrupted run has finished is not done again."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.models import checkpoint
from gsparc.models.method import Method
from gsparc.models.origin import Origin
from gsparc.training.context import FitContext, FitReport

FOLDS, STATIONS = r"fold\d+", r"station\d+|unheard"  # names of parts' folders
LAST = ("refit/last.ckpt", "last.ckpt")  # what an interrupted part leaves, the later stage first


def fit(method: Method, data: Measurements, fold: Fold, context: FitContext) -> FitReport:
    """Fit a part, go on with it, or take it where `context.resume` is a folder in which it was finished.

    Raises:
        ValueError: the folder holds a part of other data, rows, seed or settings.
    """
    left = context.resume
    if left is not None and left.is_dir():
        if (left / checkpoint.MODEL).exists():
            return _taken(method, data, fold, context, left / checkpoint.MODEL)
        if not method.has_parts:
            resume = next((left / name for name in LAST if (left / name).exists()), None)
            context = replace(context, resume=resume)
    return method.fit(data, fold, context)


def marks(report: FitReport, data: Measurements, fold: Fold, context: FitContext) -> dict[str, Any]:
    """For the `extra` of a finished part's checkpoint: what `fit` compares, and the report."""
    said = {"train_s": report.seconds, "notes": list(report.notes), "limited_by": report.limited_by}
    return {**said, **Origin.of(data, fold, context).marks()}


def folder_of(path: Path, parts: str) -> Path:
    """The folder of a run of `parts` (a pattern of names), given as that or by what is in a part."""
    inside = path if path.is_dir() else path.parent
    if any(re.fullmatch(parts, one.name) for one in inside.glob("*")):
        return inside
    return next((one.parent for one in (inside, *inside.parents) if re.fullmatch(parts, one.name)), inside)


def _taken(method: Method, data: Measurements, fold: Fold, context: FitContext, file: Path) -> FitReport:
    stored = checkpoint.read(file)
    Origin.of(data, fold, context).refuse_other(stored)
    method.restore(data.site, stored.state)
    extra = stored.extra
    return FitReport(float(extra["train_s"]), tuple(extra.get("notes", ())), extra.get("limited_by"))
