"""The one face of every method: learned fields, Gaussian processes and the mean image alike."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from gsparc.data.schema import Batch, Measurements, Site
from gsparc.data.splits import Fold
from gsparc.ops import Pose


@dataclass(frozen=True)
class Prediction:
    """What a method says about B positions, in the units of the stored targets.

    Attributes:
        mean: (B, H, W) float32 in [0, 1], (B, antennas, subcarriers) complex64, or (B, 1) float32.
        confidence: (B,) float32 in [0, 1], larger is surer; None when the method has none.
        variance: (B,) float32, expected squared error per entry; None when the method has none.
    """

    mean: Tensor
    confidence: Tensor | None = None
    variance: Tensor | None = None


@dataclass(frozen=True)
class FitReport:
    """What fitting cost.

    Attributes:
        seconds: training time without validation, testing or pictures [s].
        notes: what a reader must know (early stop, dropped components), one line each.
    """

    seconds: float
    notes: tuple[str, ...] = ()


class Method(ABC):
    """fit, predict, save, load; nothing else is asked of a method."""

    name: str

    @abstractmethod
    def fit(self, data: Measurements, fold: Fold, run_dir: Path) -> FitReport:
        """Learn from `fold.train` (and choose settings on `fold.val`); `fold.test` is not looked at."""

    @abstractmethod
    def predict(self, tx: Tensor, rx: Pose) -> Prediction:
        """Predict at tx (B, 3) [m] and one shared or B receiver poses, all in local coordinates."""

    def answer(self, batch: Batch) -> Prediction:
        """Predict a batch; a method that reads the fresh uplink of its snapshots overrides this."""
        return self.predict(batch.tx, batch.rx)

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Tensors, numbers and strings that `restore` needs (weights-only unpickling must accept them)."""

    @abstractmethod
    def restore(self, site: Site, state: dict[str, Any]) -> None:
        """Become the method whose `state()` this was."""

    def size(self) -> int:
        """Number of Gaussians, sources or stored training samples."""
        return 0
