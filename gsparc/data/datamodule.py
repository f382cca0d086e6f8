"""Batches in an order that is a pure function of (seed, step), so that a resumed run continues exactly."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import lightning.pytorch as pl
import numpy as np

from gsparc.data.schema import Batch, Measurements
from gsparc.data.splits import Fold


def steps_per_epoch(pool_size: int, batch_size: int) -> int:
    """Batches that show every row of the pool once; the last may be smaller."""
    return -(-pool_size // batch_size)


def order(seed: int, step: int, batch_size: int, pool: np.ndarray) -> np.ndarray:
    """Rows (b,) of training step `step` (from 0): a slice of the permutation seeded by (seed, epoch).

    Args:
        seed: of the run.
        step: number of batches already shown.
        batch_size: rows per batch.
        pool: (n,) training rows.
    """
    epoch, position = divmod(step, steps_per_epoch(len(pool), batch_size))
    permutation = np.random.default_rng([seed, epoch]).permutation(len(pool))
    return pool[permutation[position * batch_size : (position + 1) * batch_size]]


class StepLoader:
    """Iterating yields the batches from step `first_step()` to the end of that step's epoch.

    It holds no state of its own: whoever resumes a run says at which step it stands.
    """

    def __init__(
        self,
        data: Measurements,
        pool: np.ndarray,
        batch_size: int,
        seed: int,
        first_step: Callable[[], int] = lambda: 0,
    ) -> None:
        if batch_size < 1 or len(pool) == 0:
            raise ValueError(f"expected batch_size >= 1 and training rows, got {batch_size} and {len(pool)}")
        self.data, self.pool, self.batch_size, self.seed = data, pool, batch_size, seed
        self.first_step = first_step

    def __len__(self) -> int:
        return steps_per_epoch(len(self.pool), self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        start = self.first_step()
        for step in range(start, (start // len(self) + 1) * len(self)):
            yield self.data.batch(order(self.seed, step, self.batch_size, self.pool))

    def state_dict(self) -> dict[str, int]:
        """Nothing to store: the order is a pure function of (seed, step). Marks the loader as resumable."""
        return {}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Nothing to restore."""


class RowsLoader:
    """The given rows in their order, in batches."""

    def __init__(self, data: Measurements, rows: np.ndarray, batch_size: int) -> None:
        self.data, self.rows, self.batch_size = data, rows, batch_size

    def __len__(self) -> int:
        return steps_per_epoch(len(self.rows), self.batch_size)

    def __iter__(self) -> Iterator[Batch]:
        for start in range(0, len(self.rows), self.batch_size):
            yield self.data.batch(self.rows[start : start + self.batch_size])


class MeasurementsModule(pl.LightningDataModule):
    """Any dataset and one fold for Lightning; data this small needs no worker processes."""

    def __init__(self, measurements: Measurements, fold: Fold, batch_size: int, seed: int = 0) -> None:
        super().__init__()
        self.measurements, self.fold, self.batch_size, self.seed = measurements, fold, batch_size, seed

    def train_dataloader(self) -> StepLoader:
        """Training batches, starting where the trainer stands (also in the middle of an epoch)."""
        return StepLoader(self.measurements, self.fold.train, self.batch_size, self.seed, self._batches_shown)

    def val_dataloader(self) -> RowsLoader:
        """Validation rows in order."""
        return RowsLoader(self.measurements, self.fold.val, self.batch_size)

    def test_dataloader(self) -> RowsLoader:
        """Test rows in order."""
        return RowsLoader(self.measurements, self.fold.test, self.batch_size)

    def transfer_batch_to_device(self, batch: Batch, device, dataloader_idx: int) -> Batch:
        """The batch on `device`; a Batch is a frozen dataclass, which Lightning does not move itself."""
        return batch.to(device)

    def _batches_shown(self) -> int:
        if self.trainer is None:
            return 0
        # `completed` is what a checkpoint restores; `ready` would count the batch a kill interrupted.
        return self.trainer.fit_loop.epoch_loop.batch_progress.total.completed
