"""The nearest training sample: the measure of how close the test set lies to the training set."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from gsparc.methods.interpolation import Interpolator, Neighbours
from gsparc.methods.method import Prediction
from gsparc.methods.target_rows import to_real


class Nearest(Interpolator):
    """Repeats the sample measured nearest to the query; its confidence falls off with the distance."""

    name = "nearest"

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        self.samples = Neighbours(positions, targets)
        return ()

    def _look_up(self, queries: np.ndarray) -> Prediction:
        assert self.site is not None
        distance, row = self.samples.find(queries, 1)
        found = torch.from_numpy(to_real(self.samples.targets[row[:, 0]], self.site.kind))
        return Prediction(self._decode(found), confidence=self.samples.confidence(distance[:, 0]))

    def _learned(self) -> dict[str, Any]:
        return self.samples.state()

    def _relearn(self, state: dict[str, Any]) -> None:
        self.samples = Neighbours.from_state(state)
