"""A method and a dataset of your own in one file: copy it, rename, fill in."""

import numpy as np
import torch
from scipy.spatial import cKDTree

from gsparc.datasets.datamodule import DataModule
from gsparc.models.baselines.interpolation import Interpolator
from gsparc.models.method import Prediction
from gsparc.tables.own import interpret
from gsparc.tables.raw import Raw


class NearestK(Interpolator):
    """Mean of the targets of the `k` nearest training places; `model=nearest_k model.k=5`."""

    name = "nearest_k"  # in tables
    stored = ("places", "rows")  # attributes that a checkpoint keeps: tensors, numbers, strings
    kinds = ()  # of data it serves in `gsparc compare`: "spectrum", "csi", "rssi"; empty for all

    def __init__(self, k: int = 3) -> None:  # settings, with their defaults
        self.k = k

    def _learn(self, positions: np.ndarray, targets: np.ndarray) -> tuple[str, ...]:
        """From places (n, 3) [m] and targets (n, ...); returns remarks, a line each."""
        self.places = torch.from_numpy(positions)
        # (n, D) float32; powers in decibels
        self.rows = torch.from_numpy(self.target.to_real(targets))
        return ()

    def _look_up(self, queries: np.ndarray) -> Prediction:
        """At places (B, 3) [m]; `variance=` (squared error) and `unknown=` (0 to 1), (B,),
        are optional.
        """
        near = cKDTree(self.places.numpy()).query(queries, k=range(1, self.k + 1))[1]
        return Prediction(self._to_targets(self.rows[near].float().mean(1)))


class Corridor(DataModule):
    """Powers along a corridor; `dataset=corridor dataset.count=200`.
    Read your own file here instead.
    """

    def __init__(self, count: int = 200, name: str = "corridor", batch_size: int = 16) -> None:
        super().__init__(name, batch_size)
        self.count = count

    def load(self):
        """Arrays named as in docs/reference/schema.md become measurements, or are refused."""
        rng = np.random.default_rng(0)
        receiver = rng.uniform([1, 0, 1], [60, 2, 2], (self.count, 3))
        transmitter = np.array([0.0, 1.0, 2.5])
        level = -30 - 20 * np.log10(np.linalg.norm(receiver - transmitter, axis=1))
        arrays = {
            "rx_position": receiver,
            "tx_position": transmitter,
            "rssi_db": level + rng.normal(0, 2, self.count),
        }
        return interpret(Raw(arrays, {"name": self.name}), self.name).data
