"""The checkpoints of a run with the data and folds they were trained on."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsparc.data.load import datamodule, split_for
from gsparc.data.schema import Measurements, Site
from gsparc.data.splits import Split
from gsparc.evaluation.evaluate import dataset_facts, split_facts
from gsparc.methods import checkpoint
from gsparc.methods.method import Method
from gsparc.methods.predictor import SAME_PLACE_M

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Opened:
    """Checkpoints of one run with their data.

    Attributes:
        methods: one per fold.
        stored: contents of their files.
        data: in the models' local coordinates and units.
        split: the folds the methods were trained on, or others that were asked for.
        foreign: what differs from what the methods were trained on, one clause; None: nothing.
        learned: test rows of which it is known that the methods have learned from them.
    """

    methods: list[Method]
    stored: list[checkpoint.Stored]
    data: Measurements
    split: Split
    foreign: str | None = None
    learned: int = 0

    def facts(self) -> dict[str, Any]:
        """`dataset/*`, `split/*` and `model/name`; `split/foreign` says why rows may not be unseen."""
        own = {"split/foreign": self.foreign, "model/name": self.methods[0].name}
        return dataset_facts(self.data) | split_facts(self.split) | own


def open_files(
    paths: Sequence[str | Path],
    dataset: Mapping[str, Any] | None = None,
    split: Mapping[str, Any] | None = None,
) -> Opened:
    """Load checkpoints of one run, one per fold, and their data.

    Args:
        paths: checkpoint files in the order of their folds.
        dataset, split: settings that replace those stored in the first checkpoint.

    Raises:
        ValueError: unreadable checkpoint or data, wrong kind of data, wrong number of checkpoints.
    """
    loaded = [checkpoint.load(path) for path in paths]
    stored = [one for _, one in loaded]
    chosen_class = "_target_" in (dataset or {})
    module = datamodule(_settings("dataset", stored[0], dataset), trusted=chosen_class)
    data = aligned(module.measurements, stored[0].site)
    whole = split_for(_settings("split", stored[0], split), data)
    chosen = _folds(whole, stored)
    foreign, learned = _foreign(stored, data, whole, chosen)
    if foreign is not None:
        log.warning("%s was trained on %s", stored[0].path, foreign)
    return Opened([method for method, _ in loaded], stored, data, chosen, foreign, learned)


def _settings(group: str, stored: checkpoint.Stored, given: Mapping[str, Any] | None) -> dict[str, Any]:
    """The checkpoint's settings of a config group under the ones given now (those that are not null).

    Another name or a `_target_` given now replaces all that is stored, classes out of the file with it.
    """
    before = stored.configuration.get(group)
    before = before if isinstance(before, dict) else {}
    now = {key: value for key, value in (given or {}).items() if value is not None}
    if "_target_" in now or ("name" in now and now["name"] != before.get("name")):
        before = {}
    settings = {**before, **now}
    if not {"name", "_target_"} & set(settings):
        raise ValueError(f"{stored.path} does not name its {group}; give {group}.name=...")
    return settings


def _folds(split: Split, stored: Sequence[checkpoint.Stored]) -> Split:
    """The folds the checkpoints were trained on: all of them in order, or those each file names."""
    named = all("fold" in one.extra for one in stored)
    numbers = [int(one.extra["fold"]) if named else index for index, one in enumerate(stored)]
    if not named and len(stored) != len(split.folds):
        raise ValueError(
            f"split={split.name} has {len(split.folds)} folds: "
            f"give as many checkpoints in their order, ckpt=[fold0.ckpt,fold1.ckpt,...]"
        )
    if any(number >= len(split.folds) for number in numbers):
        raise ValueError(f"fold {max(numbers)} was trained, split={split.name} has {len(split.folds)} folds")
    return Split(split.name, tuple(split.folds[number] for number in numbers), split.sha256)


def _foreign(
    stored: Sequence[checkpoint.Stored], data: Measurements, whole: Split, chosen: Split
) -> tuple[str | None, int]:
    """What was trained on instead, and how many of these test rows the models have learned from."""
    if data.site.sha256 != stored[0].site.sha256:
        return f"other data than {data.site.name} (content hashes differ)", 0
    if stored[0].extra.get("split_sha256") in (None, whole.sha256):
        return None, 0
    try:
        before = _folds(split_for(_settings("split", stored[0], None), data), stored)
    except ValueError:  # a split file that is gone
        return "another split; its test rows may have been TRAINED on", 0
    pairs = list(zip(before.folds, chosen.folds, strict=True))
    seen = [np.isin(fold.test, np.concatenate([old.train, old.val])) for old, fold in pairs]
    learned, count = int(np.concatenate(seen).sum()), sum(map(len, seen))
    return f"another split ({before.name}): {learned} of these {count} test rows were TRAINED on", learned


def aligned(data: Measurements, site: Site) -> Measurements:
    """`data` in the local coordinates and target units that a model of `site` was trained in.

    Raises:
        ValueError: another kind, grid, moving end or static place.
    """
    own = data.site
    for what in ("kind", "static_end", "grid"):
        here, there = getattr(own, what), getattr(site, what)
        if here != there:
            raise ValueError(f"the model was trained with {what} {there}, {own.name} has {here}")
    shift = own.origin - site.origin
    if own.static_position is not None and site.static_position is not None:
        gap = float(np.linalg.norm(own.static_position + shift - site.static_position))
        if gap > SAME_PLACE_M:
            raise ValueError(f"the static {own.static_end} of {own.name} is {gap:.3g} m from the model's")
    if not shift.any() and own.target_scale == site.target_scale:
        return data
    rescale = own.target_scale / site.target_scale
    there = replace(
        own, origin=site.origin, box=own.box + shift, static_position=site.static_position,
        target_scale=site.target_scale,
    )  # fmt: skip
    return replace(
        data, site=there, tx=data.tx + shift, rx_position=data.rx_position + shift,
        target=_times(data.target, rescale), uplink=_times(data.uplink, rescale),
        noise_variance=_times(data.noise_variance, rescale**2),
    )  # fmt: skip


def _times(values: Any, factor: float) -> Any:
    """An array in another unit, of the same type."""
    return values if values is None or factor == 1 else (values * factor).astype(values.dtype)
