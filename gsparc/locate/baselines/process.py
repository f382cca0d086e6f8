"""A Gaussian process of each feature, silent ones at a floor, all with one kernel; features are Gaussian.

B. Ferris et al., "Gaussian processes for signal strength-based location estimation", RSS 2006.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from gsparc.locate.baselines.interface import Estimate, filled, floor_of
from gsparc.locate.shared_kernel import settings, stretched
from gsparc.processes.nearest import Values, given


@dataclass(frozen=True)
class Expected:
    """Means (G, P) of features above what stands for silence, their variance (G,), at places (G, D) [m]."""

    mean: np.ndarray
    variance: np.ndarray
    grid: np.ndarray
    floor: float

    def locate(self, features: np.ndarray) -> Estimate:
        """See `Locator`."""
        rows = filled(features, self.floor) - self.floor
        squared = (rows * rows).sum(1)[:, None] - 2 * rows @ self.mean.T + (self.mean * self.mean).sum(1)
        density = -0.5 * (squared / self.variance + self.mean.shape[1] * np.log(self.variance))
        return Estimate.over(self.grid, density)


def fit(
    features: np.ndarray, places: np.ndarray, candidates: np.ndarray | None = None, seed: int = 0
) -> Expected:
    """With places (G, D) where rows may be beside those of training."""
    floor = floor_of(features, places)
    rows = filled(features, floor) - floor
    values = torch.from_numpy(rows - rows.mean(0)).float()
    prior, vertical = settings(values, places, seed)
    process = given(prior, Values.of(stretched(places, vertical), values), seed)
    more = places[:0] if candidates is None else candidates
    grid = np.unique(np.concatenate([places, more]), axis=0)
    found = process.answer(torch.from_numpy(stretched(grid, vertical)))
    left_out, left = process.left_out()
    # One amplitude for all features, of what the process misses at places left out.
    amplitude = float(((process.rest - left_out).square().mean(1) / left).mean())
    return Expected(found.mean.numpy() + rows.mean(0), amplitude * found.left.numpy(), grid, floor)
