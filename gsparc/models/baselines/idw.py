"""Inverse-distance weighting (Shepard 1968) over the nearest samples."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from scipy.spatial import cKDTree

from gsparc.models.baselines.interpolation import Interpolator
from gsparc.models.method import Prediction

SPACING_ON = 10_000  # rows whose spacing is looked at


class InverseDistance(Interpolator):
    """Averages the `neighbours` nearest samples with weights 1 / distance^power.

    Its confidence is exp(-distance to the nearest / typical spacing of the training set).

    Args:
        neighbours: samples averaged (fewer when the training set is smaller).
        power: exponent of the distance.
    """

    name = "idw"
    baseline_order = 40
    no_gradient: str | None = "its nearest samples change in jumps"
    stored: ClassVar[tuple[str, ...]] = ("positions", "targets")
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
        spacings = nearest[(nearest > 0) & np.isfinite(nearest)]
        # [m], of neighbouring places
        self.spacing = float(np.median(spacings)) if len(spacings) else 1.0
        return ()

    def _look_up(self, queries: np.ndarray) -> Prediction:
        count = min(self.neighbours, len(self.positions))
        distance, row = self.tree.query(queries, k=np.arange(1, count + 1))  # nearest first
        weight = 1 / np.maximum(distance, self.NEAR) ** self.power
        weight = torch.from_numpy(weight / weight.sum(1, keepdims=True)).float()
        result = torch.from_numpy(self.target.to_real(self.targets[row.ravel()]))
        blend = torch.bmm(weight[:, None], result.view(*row.shape, -1))[:, 0]
        unknown = torch.from_numpy(-np.expm1(-distance[:, 0] / self.spacing)).float()
        return Prediction(self._to_targets(blend), unknown=unknown)

    def _relearn(self, state: dict[str, Any]) -> None:
        super()._relearn(state)
        self._learn(self.positions, self.targets)
