"""Inverse-distance weighting (Shepard 1968) over the nearest samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from gsparc.methods.interpolation import Interpolator, Neighbours
from gsparc.methods.method import Prediction
from gsparc.methods.target_rows import to_real


class InverseDistance(Interpolator):
    """Averages the `neighbours` nearest samples with weights 1 / distance^power.

    Args:
        neighbours: samples averaged (fewer when the training set is smaller).
        power: exponent of the distance.
    """

    name = "idw"
    NEAR = 1e-6  # [m]; a query on a sample repeats it instead of dividing by zero

    def __init__(self, neighbours: int = 8, power: float = 2.0) -> None:
        if neighbours < 1:
            raise ValueError(f"{self.name}: neighbours must be at least 1, got {neighbours}")
        self.neighbours, self.power = neighbours, power

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        self.samples = Neighbours(positions, targets)
        return ()

    def _look_up(self, queries: np.ndarray) -> Prediction:
        assert self.site is not None
        distance, row = self.samples.find(queries, self.neighbours)
        weight = 1 / np.maximum(distance, self.NEAR) ** self.power
        weight = torch.from_numpy(weight / weight.sum(1, keepdims=True)).float()
        found = torch.from_numpy(to_real(self.samples.targets[row.ravel()], self.site.kind))
        blend = torch.bmm(weight[:, None], found.view(*row.shape, -1))[:, 0]
        return Prediction(self._decode(blend), confidence=self.samples.confidence(distance[:, 0]))

    def _learned(self) -> dict[str, Any]:
        kept = self.samples
        return {"positions": torch.from_numpy(kept.positions), "targets": torch.from_numpy(kept.targets)}

    def _relearn(self, state: dict[str, Any]) -> None:
        self.samples = Neighbours(state["positions"].numpy(), state["targets"].numpy())
