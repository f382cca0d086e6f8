"""Several predictors of the same rows as one: weights by rows that none of them learned from.

Stacked regression with weights that are not negative and sum to one: L. Breiman, "Stacked
regressions", Machine Learning 24 (1996). With e_ik the error of member k in row i, the squared
error of a mixture w is w^T G_i w, G_i = e_i e_i^T, so that weights are functions of these products
alone. A prior of equal weights (J. M. Bates and C. W. J. Granger, "The combination of forecasts",
1969) counts as much as few units of rows do. Weights are learned on some units and tried on the
others: what answers more slowly has to be surely better there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import torch
from scipy.optimize import nnls
from torch import Tensor

from gsparc.physics.decibels import TINY_POWER
from gsparc.processes.uncertainty import mean_and_error, standard_error

# What a mean over rows is taken of: squared errors, as of an NMSE or of decibels, or their
# logarithms, as of a PSNR, in which rows count by ratios.
Loss = Literal["square", "log"]

LEAST_HELD = 4  # rows, for weights to mean anything
UNUSED = 0.1  # weights below are 0
ROWS = 30.0  # that a belief before any row counts as
SPREAD = 0.25  # of weights about equal ones, before rows are seen
PARTS = 5  # of the units; weights are learned on all but one, and tried on that
MOST = 100.0  # times the errors, that the prior weighs where nothing tells
ROUNDS = 12  # of weighing rows by their errors: logarithms move no further
LEAST_ERROR = 1e-9  # of a row: its logarithm stays finite


def weigh(
    products: np.ndarray,
    unit: np.ndarray,
    loss: Loss,
    sure: float = 1.0,
    slow: Sequence[bool] | None = None,
    plain: np.ndarray | None = None,
) -> np.ndarray:
    """Return weights (K,) of members, of sum one, none below `UNUSED` but 0.

    The best alone, unless the mixture of those that cost no more is ahead of it at units that its
    weights were not learned on; then that, unless a mixture with the `slow` ones is.

    Args:
        products: (n, K, K), see `error_products`.
        unit: (n,), rows of one unit are not independent.
        loss: of which the mean over rows is told.
        sure: standard errors of the gain that a mixture must be ahead by.
        slow: (K,) of members that answer more slowly than the others; None: of none.
        plain: (n,) squared errors of the plain mean: members of more have no weight.

    >>> errors = np.random.default_rng(0).normal(size=(200, 2))
    >>> weigh(errors[:, :, None] * errors[:, None], np.arange(200), "square").round(1).tolist()
    [0.5, 0.5]
    """
    losses, count = _losses(np.einsum("nkk->nk", products), loss), products.shape[1]
    mean, cheap = losses.mean(0), np.full(count, True) if slow is None else ~np.array(slow)
    able = np.full(count, True) if plain is None else mean <= _losses(plain, loss).mean()
    able = able if able.any() else mean == mean.min()
    cheap = cheap & able if (cheap & able).any() else able
    winner = int(np.where(cheap, mean, np.inf).argmin())
    weights, reached = np.eye(count)[winner], losses[:, winner]
    number = np.unique(unit, return_inverse=True)[1].reshape(-1)
    units = int(number.max(initial=0)) + 1
    if units < 2:
        return weights
    for members in (cheap, able):
        mixed = np.empty(len(losses))
        for part in range(min(PARTS, units)):
            tested = number % PARTS == part
            learned = _convex_weights(products[~tested], members, unit[~tested], loss)
            mixed[tested] = _losses(mixture_errors(learned, products[tested]), loss)
        gain, error = mean_and_error(reached - mixed, unit)
        if gain > sure * error:
            weights, reached = _convex_weights(products, members, unit, loss), mixed
    return weights


def _losses(errors: np.ndarray, loss: Loss) -> np.ndarray:
    return np.log(errors + LEAST_ERROR) if loss == "log" else errors


def _convex_weights(
    products: np.ndarray, members: np.ndarray, unit: np.ndarray, loss: Loss
) -> np.ndarray:
    """Weights (K,) of the least mean loss of some members, with a prior of equal ones; else 0.

    A mean of logarithms falls with that of errors over what they were: a row counts by 1 / error.
    How far units differ in the slope of the loss tells how sure its least value is.
    """
    used = np.flatnonzero(members)
    some, weights = products[:, used[:, None], used], np.full(len(used), 1 / len(used))
    for _ in range(ROUNDS):
        size = mixture_errors(weights, some) + LEAST_ERROR if loss == "log" else np.ones(len(some))
        gram, slopes = (some / size[:, None, None]).mean(0), (some @ weights) / size[:, None]
        slopes = slopes - slopes.mean(1, keepdims=True)  # weights sum to one
        unsure = sum(standard_error(slope, unit) ** 2 for slope in slopes.T)
        curve = (gram - gram.mean(0)).trace()
        prior = min(unsure / max(2 * SPREAD**2 * curve, TINY_POWER), MOST * gram.trace())
        weights = best_weights(gram + prior * np.eye(len(used)))
    return np.bincount(used, weights, len(members))


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
    some, start = errors[:, used], belief[used] / belief[used].sum()
    least = (some**2).sum(0).min() / max(len(some), 1)
    gram = some.T @ some / max(least, np.finfo(float).tiny)
    away = np.eye(len(used)) - start[:, None]  # w - start, of w of sum one
    weights = np.bincount(used, best_weights(gram + ROWS * away.T @ away), len(belief))
    kept = belief * (weights > 0)  # what is dropped was believed in by nobody
    return weights if (kept == belief).all() else shrunk_weights(errors, kept)


def best_weights(gram: np.ndarray) -> np.ndarray:
    """Return weights (K,) of the smallest w^T `gram` w, of sum one, none below `UNUSED` but 0.

    Scaled to any sum s, the smallest s^2 w^T G w + (s - 1)^2 belongs to the same w: plain
    non-negative least squares.
    """
    used = np.arange(len(gram))
    while True:
        values, vectors = np.linalg.eigh(gram[np.ix_(used, used)])
        root = (
            np.sqrt(np.maximum(values / max(values.sum(), np.finfo(float).tiny), 0.0))[:, None]
            * vectors.T
        )
        shares = nnls(np.vstack([root, np.ones(len(used))]), np.append(np.zeros(len(used)), 1.0))[0]
        large = shares >= UNUSED * shares.sum()
        if large.all():
            return np.bincount(used, shares / shares.sum(), len(gram))
        used = used[large]


def error_products(predicted: Sequence[Tensor], target: Tensor) -> np.ndarray:
    """Return products (n, K, K) of the errors of K predictions (n, ...),
    means over real entries.
    """
    missed = torch.stack([to_real_entries((mean - target).detach()) for mean in predicted], 1)
    return (missed @ missed.mT / missed.shape[2]).numpy()


def mixture_errors(weights: np.ndarray, products: np.ndarray) -> np.ndarray:
    """Return the squared errors (n,) of a mixture (K,) from products (n, K, K)."""
    return np.einsum("k,nkl,l->n", weights, products, weights)


def explained_variance(predicted: Tensor, target: Tensor, remove_mean: bool) -> float:
    """Return the share of variance that a prediction explains, of complex targets about 0;
    at most 1.
    """
    middle = target.mean(0, keepdim=True) if remove_mean else torch.zeros_like(target[:1])
    whole = (target - middle).abs().square().sum().clamp_min(TINY_POWER)
    return 1 - float((predicted - target).abs().square().sum() / whole)


def to_real_entries(values: Tensor) -> Tensor:
    """Return entries (n, P) float64 of values (n, ...),
    real and imaginary parts of complex ones.
    """
    values = torch.view_as_real(values.resolve_conj()) if values.is_complex() else values
    return values.double().flatten(1)
