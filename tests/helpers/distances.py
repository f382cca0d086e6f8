"""Distances between numpy places."""

import numpy as np
import torch


def far(queries: np.ndarray, places: np.ndarray) -> torch.Tensor:
    """(m, n) float32 [m] of queries (m, 3) and places (n, 3)."""
    return torch.cdist(*(torch.from_numpy(value) for value in (queries, places))).float()
