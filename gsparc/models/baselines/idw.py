"""Inverse-distance weighting (Shepard 1968) over the nearest samples."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gsparc.models.baselines.interpolation import Differentiable
from gsparc.models.method import Prediction
from gsparc.models.target_rows import to_real
from gsparc.processes.neighbourhood import nearest_distances

SPACING_ON = 10_000  # rows whose spacing is looked at


class InverseDistance(Differentiable):
    """Averages the `neighbours` nearest samples with weights 1 / distance^power.

    Its confidence is exp(-distance to the nearest / typical spacing of the training set).

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
        # Targets keep their stored type: bytes stay bytes.
        self.positions, self.targets, self.tree = positions, targets, cKDTree(positions)
        some = positions[:: -(-len(positions) // SPACING_ON)]
        nearest = self.tree.query(some, k=[2])[0][:, 0]  # infinite where there is no second place
        apart = nearest[(nearest > 0) & np.isfinite(nearest)]
        self.spacing = float(np.median(apart)) if len(apart) else 1.0  # [m], of neighbouring places
        return ()

    def _answered(self, queries: Tensor, dtype: torch.dtype) -> Prediction:
        count = min(self.neighbours, len(self.positions))
        distance, row = nearest_distances(self.tree, queries, np.arange(1, count + 1))  # nearest first
        weight = 1 / distance.clamp_min(self.NEAR) ** self.power
        weight = (weight / weight.sum(1, keepdim=True)).to(dtype)
        found = torch.from_numpy(to_real(self.targets[row.ravel()], self.kind)).to(dtype)
        blend = torch.bmm(weight[:, None], found.view(*row.shape, -1))[:, 0]
        sure = (-distance[:, 0] / self.spacing).exp().to(dtype)
        return Prediction(self._decode(blend), confidence=sure)

    def _learned(self) -> dict[str, Any]:
        return {"positions": torch.from_numpy(self.positions), "targets": torch.from_numpy(self.targets)}

    def _relearn(self, state: dict[str, Any]) -> None:
        self._learn(state["positions"].numpy(), state["targets"].numpy())
