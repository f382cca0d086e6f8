"""Batches in an order that is a pure function of (seed, step),
so that a resumed run continues exactly.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Self

import lightning.pytorch as pl
import numpy as np
import torch

from gsparc.base.limits import check_arguments, whole
from gsparc.data import outliers
from gsparc.data.query import Batch
from gsparc.data.schema import Measurements
from gsparc.data.splits import Fold
from gsparc.tables.checks.coherence import set_unknown_factor

log = logging.getLogger(__name__)


def steps_per_epoch(pool_size: int, batch_size: int) -> int:
    """Count the batches that show every row of the pool once; the last may be smaller."""
    return -(-pool_size // batch_size)


def rows_of_step(seed: int, step: int, batch_size: int, pool: np.ndarray) -> np.ndarray:
    """Return rows (b,) of step `step` (from 0): a slice of the permutation seeded by (seed, epoch).

    Args:
        seed: of the run.
        step: number of batches already shown.
        batch_size: rows per batch.
        pool: (n,) training rows.
    """
    epoch, position = divmod(step, steps_per_epoch(len(pool), batch_size))
    return pool[
        _permutation(seed, epoch, len(pool))[position * batch_size : (position + 1) * batch_size]
    ]


@lru_cache(maxsize=2)
def _permutation(seed: int, epoch: int, count: int) -> np.ndarray:
    """Of an epoch, drawn once: that of a million rows takes as long as a step."""
    return np.random.default_rng([seed, epoch]).permutation(count)


@dataclass
class StepLoader:
    """Iterating yields the batches from step `first_step()` to the end of that step's epoch.

    It holds no state of its own: whoever resumes a run says at which step it stands.

    Args:
        data, pool: measurements and the rows that are shown.
        batch_size: rows of a batch, over all devices.
        seed: of the order.
        first_step: number of batches already shown.
        rank, devices: which share of every batch is yielded.
    """

    data: Measurements
    pool: np.ndarray
    batch_size: int
    seed: int
    first_step: Callable[[], int] = lambda: 0
    rank: int = 0
    devices: int = 1

    def __post_init__(self) -> None:
        size, count = self.batch_size, len(self.pool)
        if size < 1 or count == 0:
            raise ValueError(f"expected batch_size >= 1 and training rows, got {size} and {count}")

    def __len__(self) -> int:
        return steps_per_epoch(len(self.pool), self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        start = self.first_step()
        for step in range(start, (start // len(self) + 1) * len(self)):
            rows = rows_of_step(self.seed, step, self.batch_size, self.pool)
            mine = rows[self.rank :: self.devices]
            mine = mine if len(mine) else rows[self.rank % len(rows) :][:1]  # all take the step
            # A device without a row of its own repeats one, so that it joins the step,
            # with weight 0.
            part = len(mine) / len(rows) if self.rank < len(rows) else 0.0
            yield replace(self.data.batch(mine), share=part)

    def state_dict(self) -> dict[str, int]:
        """Store nothing: the order is a pure function of (seed, step).
        Marks the loader as resumable.
        """
        return {}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Restore nothing."""


class RowsLoader:
    """The given rows in their order, in batches."""

    def __init__(self, data: Measurements, rows: np.ndarray, batch_size: int) -> None:
        self.data, self.rows, self.batch_size = data, rows, batch_size

    def __len__(self) -> int:
        return steps_per_epoch(len(self.rows), self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        for start in range(0, len(self.rows), self.batch_size):
            yield self.data.batch(self.rows[start : start + self.batch_size])


class DataModule(pl.LightningDataModule, ABC):
    """A dataset for Lightning, and after `use` the fold that its loaders show.

    A dataset of your own is a subclass with `load`, named as `_target_` in a file of conf/dataset.

    Args:
        name: names run directories.
        batch_size: rows of a training step, shared by all devices.

    Raises:
        SettingError: a batch without rows.
    """

    free = "auto"  # `dataset.align`: what of each row's factor is free
    notes: Sequence[str] = ()  # how the data were understood, once they are read
    told: Sequence[str] = ()  # notes that a user has seen, at the training of a model
    said: Mapping[str, object] = {}  # of a table, its columns by quantity, answers included

    def __init__(self, name: str, batch_size: int = 16) -> None:
        super().__init__()
        check_arguments(locals(), batch_size=whole(1))
        self.name, self.batch_size = name, batch_size
        self.fold: Fold | None = None
        self.seed = 0

    @abstractmethod
    def load(self) -> Measurements:
        """Read all measurements; called once.

        Raises:
            DataError: bad input, one line.
        """

    @cached_property
    def measurements(self) -> Measurements:
        """All measurements, read when first asked for; rows far beyond all others are warned of."""
        data = set_unknown_factor(self.load(), self.free)
        for warning in outliers.outlier_warnings(data):
            log.warning("%s: %s", self.name, warning)
        return data

    def use(self, fold: Fold, seed: int = 0) -> Self:
        """Show the rows of `fold`, training rows in the order of `seed`; returns itself."""
        self.fold, self.seed = fold, seed
        return self

    def setup(self, stage: str) -> None:
        """Read the measurements."""
        self.measurements  # noqa: B018 (reading is what is wanted)

    def train_dataloader(self) -> StepLoader:
        """Return training batches, starting where the trainer stands (also
        in the middle of an epoch).
        """
        trainer = self.trainer
        rank, devices = (0, 1) if trainer is None else (trainer.global_rank, trainer.world_size)
        return StepLoader(
            self.measurements,
            self._rows().train,
            self.batch_size,
            self.seed,
            self._batches_shown,
            rank,
            devices,
        )

    def val_dataloader(self) -> RowsLoader:
        """Return validation rows in order, all of them on every device."""
        return RowsLoader(self.measurements, self._rows().val, self.batch_size)

    def test_dataloader(self) -> RowsLoader:
        """Return test rows in order, all of them on every device."""
        return RowsLoader(self.measurements, self._rows().test, self.batch_size)

    def predict_dataloader(self) -> RowsLoader:
        """Return the test rows; `Trainer.predict` asks for them."""
        return self.test_dataloader()

    def transfer_batch_to_device(
        self, batch: Batch, device: torch.device, dataloader_idx: int
    ) -> Batch:
        """Move the batch, a frozen dataclass, which Lightning does not move itself."""
        return batch.to(device)

    def _rows(self) -> Fold:
        if self.fold is None:
            raise RuntimeError(f"{self.name}: say which rows to show with use(fold, seed)")
        return self.fold

    def _batches_shown(self) -> int:
        # Without a trainer, as in a notebook, batches begin with the first one.
        if self.trainer is None:
            return 0
        # `completed` is what a checkpoint restores;
        # `ready` would count the batch a kill interrupted.
        return self.trainer.fit_loop.epoch_loop.batch_progress.total.completed


class Loaded(DataModule):
    """Measurements that are already in memory.

    Args:
        measurements: all rows.
        batch_size: rows of a training step.
    """

    def __init__(self, measurements: Measurements, batch_size: int = 16) -> None:
        super().__init__(measurements.site.name, batch_size)
        # Takes the place of the cached property: nothing is read.
        self.measurements = measurements

    def load(self) -> Measurements:
        """Return what it was given."""
        return self.measurements
