"""Baselines fitted once per dataset, split and settings, and cached on disk."""

from __future__ import annotations

import functools
import hashlib
import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import gsparc
from gsparc.data.assemble import identity
from gsparc.data.files import whole_file
from gsparc.data.schema import Measurements
from gsparc.data.splits import Split
from gsparc.evaluation.scores import Scores, score
from gsparc.models import checkpoint, loading
from gsparc.models.method import Method
from gsparc.models.per_station import for_links, trained_stations
from gsparc.models.registry import method_class
from gsparc.training.context import FitContext

log = logging.getLogger(__name__)

BASELINES = ("zero", "mean", "nearest", "idw", "gp")
STORE_ABOVE_S = 3.0  # processor time; cheaper fits are repeated, so that their times are current


def fitting(data: Measurements, split: Split) -> tuple[str, ...]:
    """Names of all plain methods that serve these measurements and rows."""
    site, names = data.site, BASELINES
    if site.kind == "rssi":
        return (*names, "distance_law", "kriging")
    carrier = site.carrier_hz is not None or (
        site.stations is not None and site.stations.carrier_hz is not None
    )
    if site.kind != "csi" or not carrier:
        return names
    folds = split.folds if data.station is not None else ()  # of all stations of test rows enough are known
    few = (trained_stations(method_class("complex_gp")(), data, fold)[1].any() for fold in folds)
    return names if any(few) else (*names, "complex_gp")


@dataclass(frozen=True)
class Fitted:
    """A baseline on every fold of a split.

    Attributes:
        methods: one fitted method per fold.
        scores: pooled results.
        train_s: fitting time of each fold, as first measured [s].
    """

    methods: tuple[Method, ...]
    scores: Scores
    train_s: tuple[float, ...]


@functools.cache
def program() -> str:
    """Hash of the program text that baselines and their figures come from."""
    folder = Path(gsparc.__file__).parent
    parts = ("models", "processes", "physics", "evaluation/metrics.py", "evaluation/scores.py")
    paths = (folder / part for part in parts)
    files = (file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path]))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]


def baseline(
    name: str, data: Measurements, split: Split, eval_on: str = "test", cache: Path | None = None,
    learned: tuple[Measurements, Split] | None = None,
) -> Fitted:  # fmt: skip
    """Fit (or find) the baseline `name` with its default settings on each fold, and score it.

    Args:
        name: as in `gsparc.models.registry.known()`.
        data: the dataset.
        split: folds; baselines learn from train and val rows, or from train rows when `val` is scored.
        eval_on: `train`, `val` or `test`.
        cache: folder of earlier results; None keeps nothing.
        learned: other measurements to learn from, and the folds of these; None: `data` and `split`.
    """
    own, before = learned or (data, split)
    unseen = eval_on == "val" and learned is None
    scored = eval_on if learned is None else f"{eval_on}-{identity(data)[:24]}-{split.sha256[:24]}"
    # The same data may be in another model's local coordinates and units, and count its stations.
    key = hashlib.sha256(f"{identity(own)} {before.sha256}".encode()).hexdigest()[:24]
    folder = None if cache is None else Path(cache) / f"baselines-{program()}" / key
    folder = folder and folder / (f"{name}-train" if unseen else name)
    methods, seconds = [], []
    for number, fold in enumerate(before.folds):
        fit = None if folder is None else _stored_fit(folder / f"fold{number}.ckpt")
        if fit is None:
            method = for_links(method_class(name), own)
            known = replace(fold, val=fold.val[:0]) if unseen else fold
            spent = time.process_time()
            report = method.fit(own, known, FitContext(folder or Path()))
            spent = time.process_time() - spent  # wall time on a busy machine would mislead
            for note in report.notes:
                log.info("fold %d: %s", number, note)
            fit = (method, report.seconds)
            if folder is not None and spent > STORE_ABOVE_S:
                checkpoint.save(folder / f"fold{number}.ckpt", method, extra={"train_s": report.seconds})
        methods.append(fit[0])
        seconds.append(fit[1])
    scores = None if folder is None else _stored_scores(folder / f"{scored}.npz")
    if scores is None:
        scores = score(methods, data, split, eval_on)
        if folder is not None:
            with whole_file(folder / f"{scored}.npz") as partial, partial.open("wb") as file:
                np.savez(file, allow_pickle=False, **scores.arrays())
    return Fitted(tuple(methods), scores, tuple(seconds))


def _stored_fit(path: Path) -> tuple[Method, float] | None:
    if not path.exists():
        return None
    try:
        method, stored = loading.load(path)
        return method, float(stored.extra["train_s"])
    except (checkpoint.CheckpointError, KeyError, ValueError) as error:
        log.warning("a cached baseline is unusable and fitted again: %s", error)
        return None


def _stored_scores(path: Path) -> Scores | None:
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            return Scores.from_arrays(dict(file))
    except Exception as error:  # whatever a damaged archive raises: it is only a cache
        log.warning("cached results are unusable and computed again: %s (%s)", path, error)
        return None
