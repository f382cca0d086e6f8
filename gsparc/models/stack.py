"""Weights of members by rows left out."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

UNUSED = 0.1
ROWS = 30.0  # that a belief before any row counts as
HELD = 1e6


def shrunk_weights(errors: np.ndarray, belief: np.ndarray) -> np.ndarray:
    """Return weights (K,) of sum one: of the least squared error of rows left out, shrunk towards
    what is believed before any row; none below `UNUSED` but 0.

    >>> few, many = np.ones((2, 2)) * [1.0, 2.0], np.ones((2000, 2)) * [1.0, 2.0]
    >>> shrunk_weights(few, np.ones(2)).round(1), shrunk_weights(many, np.ones(2)).round(1)
    (array([0.5, 0.5]), array([1., 0.]))

    Args:
        errors: (n, K) of members.
        belief: (K,) weights before any row, of any sum; 0: left out.
    """
    used = np.flatnonzero(belief)
    while True:
        start = belief[used] / belief[used].sum()
        some = errors[:, used]
        least = (some**2).sum(0).min() / max(len(some), 1)
        gram = some.T @ some / max(least, np.finfo(float).tiny)
        # min w^T G w + ROWS |w - start|^2 over w of sum one, which a large weight holds.
        values, vectors = np.linalg.eigh(gram + ROWS * np.eye(len(used)))
        root = np.sqrt(values)[:, None] * vectors.T
        goal = ROWS * (vectors.T @ start) / np.sqrt(values)
        held = np.sqrt(HELD * gram.trace() + HELD * ROWS)
        shares = nnls(np.vstack([root, np.full(len(used), held)]), np.append(goal, held))[0]
        large = shares >= UNUSED * shares.sum()
        if large.all():
            return np.bincount(used, shares / shares.sum(), len(belief))
        used = used[large]
