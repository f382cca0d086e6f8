"""Covariance of a site's sectors, as the sum is written out in numpy."""

import numpy as np
import torch
from scipy.spatial.distance import cdist

from gsparc.processes.sectors import BEARING, SectorKernel


def matern(far: np.ndarray, length: float) -> np.ndarray:
    scaled = np.sqrt(3) * far / length
    return (1 + scaled) * np.exp(-scaled)


def test_rows_of_one_sector_share_shadowing_of_their_own_and_a_bearing():
    rng = np.random.default_rng(0)
    number = np.repeat([0.0, 1.0], 6)[:, None]
    places = np.c_[rng.uniform(0, 300, (12, 3)), np.tile([90.0, 40.0, 25.0], (12, 1)), number]
    towards = places[:, :2] - places[:, 3:5]
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    far, alike = cdist(places[:, :3], places[:, :3]), np.exp((towards @ towards.T - 1) / BEARING**2)
    own = 0.3 * matern(far, 20.0) + 0.2 * alike
    wanted = 0.5 * matern(far, 80.0) + (number == number.T) * own
    at = torch.from_numpy(places)
    found = SectorKernel((80.0, 20.0), (0.5, 0.3, 0.2), 0.1, 9.0).between(at, at)
    np.testing.assert_allclose(found, wanted, atol=1e-9)
