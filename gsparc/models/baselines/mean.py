"""The mean of the training targets: what is known without knowing where one is."""

from __future__ import annotations

import numpy as np
import torch

from gsparc.data.blocks import row_blocks
from gsparc.models.baselines.interpolation import Interpolator
from gsparc.models.method import Prediction


class Mean(Interpolator):
    """Predicts the training mean everywhere (of decibels for RSSI)."""

    name = "mean"
    baseline_order = 20
    no_gradient = "predictions are the same everywhere"
    stored = ("value",)

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        total = np.zeros(int(np.prod(self.shape)) * self.target.numbers)
        for part in row_blocks(targets):  # thousands of byte images never become floats at once
            total += self.target.to_real(targets[part]).sum(0, dtype=np.float64)
        self.value = torch.from_numpy(total / len(targets)).float()
        return ()

    def _look_up(self, queries: np.ndarray) -> Prediction:
        return Prediction(self._to_targets(self.value.expand(len(queries), -1).contiguous()))
