"""The checkpoints of a run with the data and folds they were trained on."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from gsparc.base.errors import DataError
from gsparc.data.inner_folds import cut_folds
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold, Split, hash_indices
from gsparc.datasets.datamodule import DataModule
from gsparc.datasets.load import datamodule, drop_unanswerable_rows, split_for
from gsparc.models import checkpoint, loading
from gsparc.models.method import Method
from gsparc.models.registry import build
from gsparc.prediction.confidence import (
    read_trusted,
)
from gsparc.prediction.left_out import Learned
from gsparc.prediction.predictor import Predictor
from gsparc.runs.align_site import align_to_site
from gsparc.runs.evaluate import dataset_facts, split_facts
from gsparc.runs.experiment.folds import effort_settings
from gsparc.tables import is_table
from gsparc.tables.own import interpret_and_log
from gsparc.tables.raw import read_raw
from gsparc.training.context import FitContext

log = logging.getLogger(__name__)

SAME_ROW_M = 1e-3  # rows of two files this near are of the same place


@dataclass(frozen=True)
class OpenRun:
    """Checkpoints of one run, see `open_run`.

    Attributes:
        methods: one per fold.
        stored: contents of their files.
        dataset: settings of their data that replace those stored in the first.
    """

    methods: list[Method]
    stored: list[checkpoint.StoredModel]
    dataset: Mapping[str, Any]

    @property
    def predictor(self) -> Predictor:
        """The first method, as `gsparc.load` answers by it."""
        site, extra = self.stored[0].site, self.stored[0].extra
        return Predictor(self.methods[0], site, trusted=read_trusted(extra), extra=extra)

    def read(self, split: Mapping[str, Any] | None = None, *, others_whole: bool = False) -> Opened:
        """Read the data.

        Args:
            split: settings that replace those stored in the first checkpoint.
            others_whole: other data than these checkpoints' are test rows throughout, where no
                split is given.

        Raises:
            ValueError: unreadable or wrong kind of data, wrong number of checkpoints.
        """
        stored = self.stored
        data = align_to_site(module_of(stored[0], self.dataset).measurements, stored[0].site)
        other = data.site.sha256 != stored[0].site.sha256
        # Other data than the model's were never learned from, so that all rows can be tested.
        if other and others_whole and all(value is None for value in (split or {}).values()):
            none, all_rows = np.zeros(0, np.int64), np.arange(len(data))
            folds = (Fold(none, none, all_rows),) * len(stored)
            chosen = Split("whole", folds)
        else:
            chosen = _folds(split_for(_settings("split", stored[0], split), data), stored)
        foreign, learned, trained = _foreign(stored, data, chosen)
        if foreign is not None:
            level = logging.INFO if learned == 0 else logging.WARNING
            log.log(level, "%s was trained on %s", stored[0].path, foreign)
        if other and trained is not None:
            chosen = drop_unanswerable_rows(chosen, data, trained)
        return Opened(
            **vars(self), data=data, split=chosen, foreign=foreign, learned=learned, trained=trained
        )


@dataclass(frozen=True)
class Opened(OpenRun):
    """Checkpoints of one run with their data.

    Attributes:
        data: in the models' local coordinates and units.
        split: the folds the methods were trained on, or others that were asked for.
        foreign: what differs from what the methods were trained on, one clause; None: nothing.
        learned: test rows that the methods have learned from, of other data those at places that
            they have learned from; None: not known.
        trained: of other data or rows, what they learned from in their coordinates, and its folds;
            None where that is gone.
    """

    data: Measurements
    split: Split
    foreign: str | None = None
    learned: int | None = 0
    trained: tuple[Measurements, Split] | None = None

    def facts(self) -> dict[str, Any]:
        """Return `dataset/*`, `split/*` and `model/name`;
        `split/foreign` says why rows may not be unseen.
        """
        run_facts = {"split/foreign": self.doubt, "model/name": self.methods[0].name}
        return dataset_facts(self.data) | split_facts(self.split) | run_facts

    @property
    def doubt(self) -> str | None:
        """`foreign` where test rows may have been learned from."""
        return None if self.learned == 0 else self.foreign

    def retraining(self, effort: float | None = None, **others: Any) -> Learned:
        """Return the first method with what it learned from;
        only classes of gsparc make it unfitted.

        Args:
            effort: in place of the run's; None: the run's.
            **others: of `FitContext`, in place of the run's.

        Raises:
            DataError: the file does not name its settings.
        """
        config = self.stored[0].configuration
        if "model" not in config:
            raise DataError(f"{self.stored[0].path} does not say how it was trained: train it anew")
        # Not trusted: a stranger's checkpoint may name any class, and to build is to execute it.
        factory = build(config["model"], trusted=False)
        others |= {} if effort is None else {"effort": effort}
        context = FitContext(**effort_settings(config) | others)
        return Learned(self.methods[0], factory, self.data, self.split.folds[0], context)

    def group_places(self, places: np.ndarray, count: int, seed: int) -> np.ndarray:
        """Return which of `count` groups, cut as test rows were, trained places (n, D) [m] are of,
        or -1.
        """
        fold, split = self.split.folds[0], effort_settings(self.stored[0].configuration)["split"]
        rows, group = fold.learned(), np.full(len(self.data), -1)
        for number, inner in enumerate(cut_folds(self.data, fold, split, count, seed).folds):
            group[inner.test] = number
        return group[rows[cKDTree(self.data.moving[rows]).query(places)[1]]]


def open_run(paths: str | Path | Sequence[str | Path], dataset: Mapping[str, Any]) -> OpenRun:
    """Load a checkpoint, or those of one run, one per fold; their data are not read yet.

    Args:
        paths: checkpoint files in the order of their folds.
        dataset: settings that replace those stored in the first checkpoint, where they are not
            null.

    Raises:
        ValueError: unreadable checkpoints, of several runs, or a setting that their data do not
            have.
    """
    paths = [paths] if isinstance(paths, str | Path) else paths
    loaded = [loading.load(path) for path in paths]
    methods, stored = ([*parts] for parts in zip(*loaded, strict=True))
    # Folds of two runs are of two splits: a test row of one may have taught the other.
    if len({model.extra.get("run_id") for model in stored}) > 1:
        raise ValueError(f"{', '.join(map(str, paths))}: of different runs; give the folds of one")
    if any(value is not None for value in dataset.values()):
        module_of(stored[0], dataset)
    return OpenRun(methods, stored, dataset)


def read_like_stored(
    stored: checkpoint.StoredModel, path: str | Path, *, keep_new: bool = False
) -> tuple[Measurements, bool]:
    """Return the measurements of another file, read as a model's data were, in its coordinates.

    `keep_new`: see `align_to_site`.

    Returns:
        They, and whether the file has places; without, rows lie apart at arbitrary ones.

    Raises:
        ValueError: the file, or the settings, cannot be read.
    """
    site = stored.site
    if not is_table(path):
        raw, place = read_raw(path), f"{site.moving_end}_position"
        placed = place in raw.arrays
        if not placed:
            count = max(len(raw.arrays.get(site.kind, ())), len(raw.arrays.get("rssi_db", ())))
            low, high = site.moving_box + site.origin
            # A diagonal, so that no two are one.
            raw.arrays[place] = np.linspace(low, high, count)
        return align_to_site(interpret_and_log(raw, path), site, keep_new=keep_new), placed
    from gsparc.tables.places import place_by_row  # here, as pandas takes half a second

    before = stored.configuration.get("dataset") or {}
    row_columns = place_by_row(path, before.get("columns") or {}, site.moving_end)
    settings = {"file": str(path)} | ({"columns": row_columns} if row_columns else {})
    data = module_of(stored, settings).measurements
    return align_to_site(data, site, keep_new=keep_new), not row_columns


def module_of(stored: checkpoint.StoredModel, dataset: Mapping[str, Any] | None) -> DataModule:
    """Return what reads a model's data with settings that replace those stored;
    nothing is read yet.

    How they are read is said unless training said it.

    Raises:
        ValueError: a setting that its data do not have, or no name.
    """
    # A class is imported only where the caller named it, never because a file does.
    module = datamodule(
        _settings("dataset", stored, dataset), trusted="_target_" in (dataset or {})
    )
    module.told = stored.extra.get("read_notes", ())
    return module


def _settings(
    group: str, stored: checkpoint.StoredModel, overrides: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The checkpoint's settings of a config group under the ones given now (those
    that are not null).

    Another name or a `_target_` given now replaces all that is stored,
    classes out of the file with it.

    Raises:
        ValueError: no name.
    """
    before = stored.configuration.get(group)
    before = before if isinstance(before, dict) else {}
    now = {key: value for key, value in (overrides or {}).items() if value is not None}
    if "_target_" in now or ("name" in now and now["name"] != before.get("name")):
        before = {}
    settings = {**before, **now}
    for key in [key for key in now if now[key] and isinstance(before.get(key), dict)]:
        # Such as columns; an empty group replaces all of it
        settings[key] = {**before[key], **now[key]}
    if not {"name", "_target_"} & set(settings):
        raise ValueError(f"{stored.path} does not name its {group}; give {group}.name=...")
    return settings


def _folds(split: Split, stored: Sequence[checkpoint.StoredModel]) -> Split:
    """The folds the checkpoints were trained on: all of them in order, or those each file names."""
    # Files of some folds can be opened alone where each says its number; older ones are counted.
    named = all("fold" in model.extra for model in stored)
    numbers = [int(model.extra["fold"]) if named else index for index, model in enumerate(stored)]
    if not named and len(stored) != len(split.folds):
        raise ValueError(
            f"split={split.name} has {len(split.folds)} folds: "
            f"give as many checkpoints in their order, ckpt=[fold0.ckpt,fold1.ckpt,...]"
        )
    if any(number >= len(split.folds) for number in numbers):
        raise ValueError(
            f"fold {max(numbers)} was trained, split={split.name} has {len(split.folds)} folds"
        )
    return replace(split, folds=tuple(split.folds[number] for number in numbers))


def were_trained_on(stored: Sequence[checkpoint.StoredModel], split: Split) -> bool | None:
    """Return whether checkpoints, one per fold of `split`, say that they were; None:
    one does not say it.

    A finished model has the hash of its whole split, an interrupted training that of its own rows.
    """
    answers = []
    for model, fold in zip(stored, split.folds, strict=True):
        whole, rows = model.extra.get("split_sha256"), model.extra.get("origin", {}).get("rows")
        if whole is None and rows is None:
            return None
        answers.append(rows == hash_indices((fold,)) if whole is None else whole == split.sha256)
    return all(answers)


def _foreign(
    stored: Sequence[checkpoint.StoredModel], data: Measurements, chosen: Split
) -> tuple[str | None, int | None, tuple[Measurements, Split] | None]:
    """What was trained on instead, how many of these test rows the models learned from,
    and `_trained`.
    """
    same = data.site.sha256 == stored[0].site.sha256
    same_split = were_trained_on(stored, chosen)
    if same and same_split:
        return None, 0, None
    origin = (
        "another split" if same else f"other data than {data.site.name} (content hashes differ)"
    )
    unplaced = [site for site in (data.site, stored[0].site) if site.georeference is None]
    if not same and len(unplaced) == 1:
        origin += (
            f"; metres of {unplaced[0].name} are about an unknown origin, the others' about degrees"
        )
        return (
            (f"{origin}: whether these test rows lie where it was TRAINED cannot be told"),
            None,
            None,
        )
    trained = _trained(stored, data)
    if trained is None:
        origin = "rows that it does not name" if same and same_split is None else origin
        return f"{origin}; these test rows may have been TRAINED on", None, None
    trained_data, before = trained
    # The same rows under another name or seed of split.
    if same and hash_indices(before.folds) == hash_indices(chosen.folds):
        return None, 0, trained
    tested, learned = np.concatenate([fold.test for fold in chosen.folds]), 0
    unlisted = int((data.censored_side(tested) > 0).sum())
    listed = f" ({len(tested) - unlisted} listed, {unlisted} unlisted)" if unlisted else ""
    for old, fold in zip(before.folds, chosen.folds, strict=True):
        # Rows of `val` decide steps and weights: they count as learned.
        rows = old.learned()
        if same:
            learned += int(np.isin(fold.test, rows).sum())
        else:
            # Order and names may differ between two files:
            # rows at one place are taken for the same.
            gaps, _ = cKDTree(trained_data.moving[rows]).query(data.moving[fold.test])
            learned += int((gaps < SAME_ROW_M).sum())
    if same:
        origin += f" ({before.name})"
    how = ("were " if same else "are at places that were ") + (
        "TRAINED on" if learned else "trained on"
    )
    return (
        (f"{origin}: {learned or 'none'} of these {len(tested)} test rows{listed} {how}"),
        learned,
        trained,
    )


def _trained(
    stored: Sequence[checkpoint.StoredModel], data: Measurements
) -> tuple[Measurements, Split] | None:
    """What checkpoints were trained on (`data` where it is that) and its folds;
    None where these are gone.
    """
    site = stored[0].site
    try:
        if data.site.sha256 != site.sha256:
            data = module_of(stored[0], None).measurements
            # The file was changed or exchanged after training:
            # its rows do not tell what was learned.
            if data.site.sha256 != site.sha256:
                return None
            data = align_to_site(data, site)
        before = _folds(split_for(_settings("split", stored[0], None), data), stored)
    # A file that is gone makes the answer unknown, which is said; it is no reason to refuse.
    except (ValueError, OSError):
        return None
    return None if were_trained_on(stored, before) is False else (data, before)
