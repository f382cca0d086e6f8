"""Black: the prediction that says nothing, and the floor every error is read against."""

from __future__ import annotations

import numpy as np
import torch

from gsparc.models.baselines.interpolation import Interpolator
from gsparc.models.method import Prediction


class Zero(Interpolator):
    """Predicts zeros."""

    name = "zero"
    baseline_order = 10  # NMSE 1: what is worse is worse than saying nothing
    no_gradient = "predictions are the same everywhere"

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        return ()

    def _look_up(self, queries: np.ndarray) -> Prediction:
        dtype = torch.complex64 if self.target.is_complex else torch.float32
        return Prediction(torch.zeros(len(queries), *self.shape, dtype=dtype))
