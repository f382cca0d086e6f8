"""Which of several predictions, or which mixture of them, errs least on rows that none of them learned from.

Stacked regression with weights that are not negative and sum to one: L. Breiman, "Stacked regressions",
Machine Learning 24 (1996). With e_ik the error of prediction k in row i, the squared error of a mixture w is
w^T G_i w, G_i = e_i e_i^T, so that everything here is a function of these products alone.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls
from scipy.stats import norm, t

LEAST_WEIGHT = 0.05  # of a prediction in a mixture, below which it is left out
PARTS = 5  # of the units; weights are learned on all but one, and tried on that


def best_weights(gram: np.ndarray) -> np.ndarray:
    """Weights (K,), none negative, summing to one, of the smallest w^T `gram` w; gram is (K, K).

    Scaled to any sum s, the smallest s^2 w^T G w + (s - 1)^2 belongs to the same w: plain non-negative least
    squares.
    """
    values, vectors = np.linalg.eigh(gram / max(np.trace(gram), np.finfo(float).tiny))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    found = nnls(np.vstack([root, np.ones(len(gram))]), np.append(np.zeros(len(gram)), 1.0))[0]
    return found / found.sum()


def paired(difference: np.ndarray, unit: np.ndarray) -> tuple[float, float]:
    """Mean of differences (n,) and its standard error, rows of one unit (n,) not being independent.

    Of few units it is larger, so that as many normal means lie within it (Student's t). It is infinite where
    all rows are of one unit: then nothing tells how far to trust the mean.
    """
    which = np.unique(unit, return_inverse=True)[1].reshape(-1)
    mean, units = float(difference.mean()), int(which.max()) + 1
    if units < 2:
        return mean, float("inf")
    sums = np.bincount(which, difference - mean)
    few = float(t.ppf(norm.cdf(1.0), units - 1))
    return mean, few * float(np.sqrt(units / (units - 1) * (sums**2).sum())) / len(difference)


def choose(gram: np.ndarray, unit: np.ndarray) -> np.ndarray:
    """Weights (K,) of the predictions: one alone, unless a mixture is better by more than a standard error.

    The mixture is judged on units whose rows its weights were not learned from.

    Args:
        gram: (n, K, K) products of the errors of n rows.
        unit: (n,) of the rows, see `paired`.
    """
    errors = np.einsum("nkk->nk", gram)
    winner = int(errors.mean(0).argmin())
    alone = np.eye(gram.shape[1])[winner]
    part = np.unique(unit, return_inverse=True)[1].reshape(-1) % PARTS
    if gram.shape[1] < 2 or part.max() == 0:
        return alone
    mixed = np.empty(len(gram))
    for number in range(int(part.max()) + 1):
        here = part == number
        mixed[here] = squared(_pruned(gram[~here].mean(0)), gram[here])
    gain, error = paired(errors[:, winner] - mixed, unit)
    return _pruned(gram.mean(0)) if gain > error else alone


def squared(weights: np.ndarray, gram: np.ndarray) -> np.ndarray:
    """Squared errors (n,) of a mixture (K,) from products (n, K, K)."""
    return np.einsum("k,nkl,l->n", weights, gram, weights)


def _pruned(gram: np.ndarray) -> np.ndarray:
    """The best weights (K,) without those that matter little."""
    kept = best_weights(gram) >= LEAST_WEIGHT
    found = np.zeros(len(gram))
    found[kept] = best_weights(gram[np.ix_(kept, kept)])
    return found
