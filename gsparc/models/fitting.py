"""Runs of many parts, stations or folds: what an interrupted run has finished is not done again.

Nothing else goes on from it than what learns from the same rows with the same settings (`Origin`).
"""

from __future__ import annotations

import copy
import logging
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gsparc.base.errors import Caution, list_first
from gsparc.data.assemble import auxiliary_hash
from gsparc.data.row_order import order_rows
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Fold, hash_indices
from gsparc.models import checkpoint
from gsparc.models.aligned_rows import align_phases
from gsparc.models.checkpoint import StoredModel
from gsparc.models.device_offsets import remove_device_offsets
from gsparc.models.method import Method, MethodFactory
from gsparc.models.sanity import create_unfitted, judge_fit
from gsparc.training.context import FitContext, FitReport
from gsparc.training.cost import Cost
from gsparc.training.stopwatch import Stopwatch

log = logging.getLogger(__name__)

FEW_PLACES = 10
FOLDS, STATIONS = r"fold\d+", r"station\d+|unheard"  # names of parts' folders
LAST = ("refit/last.ckpt", "last.ckpt")  # what an interrupted part leaves, the later stage first
# Settings that a run must share with what it goes on from.
DECIDING = ("model", "dataset.batch_size", "init_from", "stations")
CHANGEABLE = ("trainer", "callbacks", "effort", "model.refit")
"""Settings that may change on the way, and are then named."""
UNHASHED = (
    "kind",
    "static_end",
    "grid",
    "normalisation",
    "origin",
    "target_scale",
    "uplink_array",
    "uplink_hz",
    "antennas",
    "unknown_factor",
)
"""Facts of a site that the content hash of its measurements leaves out."""

# What is hashed, the group of settings that names it, in words.
_HASHED = (
    ("data", "dataset", "data"),
    ("auxiliary", "dataset", "directions or uplink"),
    ("rows", "split", "rows"),
)


def fit_or_resume(
    factory: MethodFactory, data: Measurements, fold: Fold, context: FitContext
) -> tuple[Method, FitReport]:
    """Make the method of these measurements and fit it, go on with it, or take what was finished.

    Args:
        factory: decides what the method is, once rows have a phase in common where that is
            possible.
        data, fold: that it learns from.
        context: its `resume` may be a folder in which the part was finished.

    Raises:
        ValueError: the folder holds a part of other data, rows, seed or settings, or there are
            weights to start from (`init_from`), and the method has none.
    """
    watch = Stopwatch()
    # Before the method is made, as another may be called for once rows share a phase.
    ordered, rows = order_rows(data, fold)
    ordered = remove_device_offsets(ordered, rows)
    if context.datamodule is not None and context.datamodule.measurements is data:
        module = copy.copy(context.datamodule)
        module.measurements = ordered
        context = replace(context, datamodule=module)
    (ordered, rows), resume_path = align_phases(ordered, rows), context.resume
    aligning = watch.seconds if ordered.site.unknown_factor != "none" else 0.0
    # The interrupted run had not begun this part
    if resume_path is not None and not resume_path.exists():
        context = replace(context, resume=None)
    elif resume_path is not None and resume_path.is_dir():
        if (resume_path / checkpoint.MODEL).exists():
            whole = replace(data, site=ordered.site)
            return _restore_fit(factory, whole, fold, context, resume_path / checkpoint.MODEL)
        # What has parts looks for each of them in the folder itself.
        if not factory.has_parts:
            resume = next(
                (resume_path / name for name in LAST if (resume_path / name).exists()), None
            )
            context = replace(context, resume=resume)
    method = factory.create_for(ordered)
    if context.init_from is not None and not (method.has_parts or method.takes_weights):
        instead = "Gaussian fields do; start without it"
        raise ValueError(f"init_from: {method.name} takes no weights to start from here, {instead}")
    report = method.fit(ordered, rows, replace(context, fold=fold))
    method, report = judge_fit(method, report, ordered, rows)
    if 0 < (places := len(np.unique(ordered.moving[rows.train], axis=0))) < FEW_PLACES:
        few = Caution(
            f"{places} places to learn from are too few to tell errors: deviations are guesses"
        )
        report = replace(report, notes=(*report.notes, few))
    if aligning:
        cost = Cost({"alignment": aligning}) + report.cost
        report = replace(report, seconds=report.seconds + aligning, cost=cost)
    return method, replace(report, cpu_s=report.cpu_s + watch.cpu_seconds)


def run_extra(
    report: FitReport, data: Measurements, fold: Fold, context: FitContext
) -> dict[str, Any]:
    """Return what the checkpoint of a finished part has as `extra`: what `fit` compares,
    and the report.
    """
    report_fields = {
        "train_s": report.seconds,
        "train_cpu_s": report.cpu_s,
        "notes": list(report.notes),
    }
    report_fields |= {"stages": dict(report.cost.stages), "unused": dict(report.cost.unused)}
    return {**report_fields, **Origin.from_fit(data, fold, context).to_extra()}


def run_folder(path: Path, parts: str) -> Path:
    """Return the folder of a run of `parts` (a pattern of names),
    given as that or by what is in a part.
    """
    inside = path if path.is_dir() else path.parent
    if any(re.fullmatch(parts, file.name) for file in inside.glob("*")):
        return inside
    return next(
        (parent.parent for parent in (inside, *inside.parents) if re.fullmatch(parts, parent.name)),
        inside,
    )


def _restore_fit(
    factory: MethodFactory, data: Measurements, fold: Fold, context: FitContext, file: Path
) -> tuple[Method, FitReport]:
    stored = checkpoint.read(file)
    Origin.from_fit(data, fold, context).require_same(stored)
    method, extra = create_unfitted(factory, stored.target), stored.extra
    method.restore(data.site, stored.state)
    cost = Cost(extra.get("stages", {}), extra.get("unused", {}))
    notes = tuple(extra.get("notes", ()))
    return method, FitReport(
        float(extra["train_s"]), notes, cost, float(extra.get("train_cpu_s", 0.0))
    )


def common_label(name: str, methods: Sequence[Method]) -> str:
    """Return their label where they share one, else the most frequent:
    `gp (Vecchia 30 in 3 of 5)`.
    """
    result = Counter(method.label for method in methods)
    if not result:
        return name
    label, count = result.most_common(1)[0]
    inner = label.removeprefix(name).strip(" ()")
    return (
        label
        if count == len(methods) or not inner
        else (f"{name} ({inner} in {count} of {len(methods)})")
    )


@dataclass(frozen=True)
class Origin:
    """What is learned from, the seed, and the whole configuration as text.

    Attributes:
        site: of the measurements.
        auxiliary: hash of their directions and uplink, which their content hash leaves out.
        rows: hash of the fold's indices.
        seed: of the run.
        config: YAML text; "" from Python without one.
    """

    site: Site
    auxiliary: str
    rows: str
    seed: int
    config: str = ""

    @classmethod
    def from_fit(cls, data: Measurements, fold: Fold, context: FitContext) -> Origin:
        """Return the origin of a fit that begins."""
        rows = hash_indices((context.fold or fold,))
        return cls(data.site, auxiliary_hash(data), rows, context.seed, context.config_yaml)

    def to_extra(self) -> dict[str, Any]:
        """Return what a checkpoint has as `extra`; it holds the configuration itself."""
        return {"origin": {**self._hashes(), "seed": self.seed}}

    def _hashes(self) -> dict[str, str]:
        return {"data": self.site.sha256, "auxiliary": self.auxiliary, "rows": self.rows}

    def require_same(self, stored: StoredModel) -> None:
        """Tell whether training may go on from `stored`;
        settings of its schedule that changed are logged.

        Raises:
            ValueError: it is of other data, rows, seed or settings, which are named.
        """
        before, now = stored.configuration, yaml.safe_load(self.config) or {}
        hashes, differing = self._hashes(), []
        origin = stored.extra.get("origin")
        if origin is None:
            raise ValueError(
                f"ckpt_path={stored.path}: does not say what it learned from; start without it"
            )
        for name, group, noun in _HASHED:
            if origin[name] != hashes[name]:
                differing += _list_differences(before, now, (group,)) or [f"other {noun}"]
        if stored.site.sha256 == self.site.sha256:  # of other data, all of it may differ
            facts = {
                name: (getattr(stored.site, name), getattr(self.site, name)) for name in UNHASHED
            }
            differing += [
                f"other {name}" for name, both in facts.items() if not np.array_equal(*both)
            ]
        if origin["seed"] != self.seed:
            differing.append(f"seed={origin['seed']} (here {self.seed})")
        differing += _list_differences(before, now, DECIDING)
        if differing:
            raise ValueError(
                f"ckpt_path={stored.path}: was trained with {list_first(differing)}: "
                "go on with the same, or start again without ckpt_path"
            )
        changed = _list_differences(before, now, CHANGEABLE)
        if changed:
            log.warning("continuing from %s, which had %s", stored.path, list_first(changed))


def _list_differences(
    before: Mapping[str, Any], now: Mapping[str, Any], keys: tuple[str, ...]
) -> list[str]:
    """`key=value (here other)` for every setting under `keys` that differs;
    none without a configuration.
    """
    if not before or not now:
        return []
    stored_settings, settings = dict(dotted_settings(before)), dict(dotted_settings(now))
    under = [
        k
        for k in {**stored_settings, **settings}
        if any(k == key or k.startswith(f"{key}.") for key in keys)
    ]
    # `model.refit` lies under `model`, and may change all the same.
    under = [k for k in under if keys is CHANGEABLE or k not in CHANGEABLE]
    return [
        f"{k}={stored_settings.get(k)} (here {settings.get(k)})"
        for k in under
        if stored_settings.get(k) != settings.get(k)
    ]


def dotted_settings(node: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield settings by dotted name."""
    for key, value in node.items():
        if isinstance(value, Mapping):
            yield from dotted_settings(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
