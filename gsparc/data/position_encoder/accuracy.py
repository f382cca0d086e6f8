"""How well codes keep the order of true places; for simulated data, where the truth is known."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

NEIGHBOURS = 20


def judge(codes: np.ndarray, truth: np.ndarray, train: np.ndarray, test: np.ndarray) -> dict[str, float]:
    """Figures of codes (S, 3) against true places (S, 3) [m].

    Returns:
        `trustworthiness`, `continuity` (Venna and Kaski 2001; 1 is perfect, 0.5 is chance),
        `distance_rank` (Spearman's correlation of pairwise distances), and `locating_m`, the median error of
        the place read off the nearest training codes, beside `guessing_m` of the mean place.
    """
    code, real = codes[test], truth[test]
    near = cKDTree(codes[train]).query(code, k=3)[1]
    located = truth[train][near].mean(axis=1)
    first, second = np.triu_indices(len(test), 1)
    pick = np.random.default_rng(0).permutation(len(first))[:20000]
    first, second = first[pick], second[pick]
    apart = [np.linalg.norm(x[first] - x[second], axis=1) for x in (code, real)]
    return {
        "trustworthiness": _kept(real, code),
        "continuity": _kept(code, real),
        "distance_rank": float(spearmanr(*apart).statistic),
        "locating_m": float(np.median(np.linalg.norm(located - real, axis=1))),
        "guessing_m": float(np.median(np.linalg.norm(truth[train].mean(axis=0) - real, axis=1))),
    }


def _kept(reference: np.ndarray, shown: np.ndarray) -> float:
    """Neighbours in `shown` that are near in `reference` too, penalised by their rank there."""
    n, k = len(shown), min(NEIGHBOURS, (len(shown) - 1) // 2)
    rank = np.linalg.norm(reference[:, None] - reference[None], axis=-1).argsort(1).argsort(1)
    near = cKDTree(shown).query(shown, k=k + 1)[1][:, 1:]
    excess = np.maximum(rank[np.arange(n)[:, None], near] - k, 0).sum()
    return float(1 - 2 * excess / (n * k * (2 * n - 3 * k - 1)))
