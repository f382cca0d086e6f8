"""Weights of several predictors: of least squared error, or of largest PSNR, on held-out rows.

Stacked regression with weights that are not negative and sum to one: L. Breiman, "Stacked regressions",
Machine Learning 24 (1996). With e_ik the error of prediction k in row i, the squared error of a mixture w is
w^T G_i w, G_i = e_i e_i^T, so that weights are functions of these products alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import nnls
from scipy.stats import norm, t
from torch import Tensor

from gsparc.data.schema import Site
from gsparc.physics.decibels import RELATIVE_DB, TINY_POWER

LEAST_HELD = 4  # rows, for weights to mean anything
LEAST_GAIN_DB = 0.1  # for which a query may take several times as long
FEW_ROWS = 40  # fewer do not tell a weight from a half, where the two differ by less than twice the error
UNUSED = 0.05  # weight below which a predictor is left out of a mixture
SHARES = np.linspace(0, 1, 21)  # candidates of a weight of two
PARTS = 5  # of the units; weights are learned on all but one, and tried on that
LEAST_ERROR = 1e-9  # of a row: its logarithm stays finite


def stacking_weights(
    predicted: list[Tensor], target: Tensor, unit: np.ndarray, deviations: float = 1.0
) -> tuple[float, ...]:
    """Return weights in [0, 1] of sum one: one alone, unless a mixture is surely better.

    Args:
        predicted: M of (n, ...), real or complex, in the unit that errors are counted in.
        target: (n, ...).
        unit: (n,), rows of one unit are not independent.
        deviations: see `choose_weights`.
    """
    missed = torch.stack([to_real_entries((one - target).detach()) for one in predicted], 1)  # (n, M, P)
    chosen = choose_weights((missed @ missed.mT).numpy(), unit, deviations)
    return tuple(float(weight) for weight in chosen)


@dataclass(frozen=True)
class HeldOutPair:
    """Rows that two predictors did not learn from.

    Attributes:
        own, plain: (n, P) predictions of the first and the second.
        target: (n, P), the same entries as measured.
    """

    own: np.ndarray
    plain: np.ndarray
    target: np.ndarray

    def log_errors(self, weight: float) -> np.ndarray:
        """Return the log (n,) of each row's mean squared error, the second weighed by `weight`."""
        mixed = (1 - weight) * self.own + weight * self.plain
        return np.log(((mixed - self.target) ** 2).mean(1) + LEAST_ERROR)


def share_of_second(parts: Sequence[HeldOutPair]) -> float:
    """Return the weight in [0, 1] of the second of two predictors that makes the mean PSNR of rows largest.

    0 or 1 where it is within `UNUSED` of them; 0 where less than `LEAST_GAIN_DB`, or twice its standard
    error, is gained, but not where the second alone is better than the first: a query may take longer rather
    than lose to it. Few rows that do not tell the two apart weigh them alike (J. M. Bates and C. W. J.
    Granger, 1969).
    """
    logs = np.stack([np.concatenate([part.log_errors(share) for part in parts]) for share in SHARES])
    chosen, rows = int(logs.mean(1).argmin()), np.arange(logs.shape[1])
    gain, unsure = mean_and_error(logs[0] - logs[-1], rows)
    if len(rows) < FEW_ROWS and abs(gain) < 2 * unsure:
        return 0.5
    mixed, unsure = mean_and_error(logs[0] - logs[chosen], rows)
    if gain <= 0 and mixed < max(LEAST_GAIN_DB / RELATIVE_DB, 2 * unsure):
        return 0.0
    best = float(SHARES[chosen])
    return round(best) if min(best, 1 - best) <= UNUSED + LEAST_ERROR else best


def explained_variance(predicted: Tensor, target: Tensor, remove_mean: bool) -> float:
    """Return the share of variance that a prediction explains, of complex targets about 0; at most 1."""
    middle = target.mean(0, keepdim=True) if remove_mean else torch.zeros_like(target[:1])
    whole = (target - middle).abs().square().sum().clamp_min(TINY_POWER)
    return 1 - float((predicted - target).abs().square().sum() / whole)


def in_error_unit(values: Tensor, site: Site) -> Tensor:
    """Return values in the unit that errors are counted in: powers in decibels."""
    return site.target.in_error_unit(values)


def to_real_entries(values: Tensor) -> Tensor:
    """Return entries (n, P) float64 of values (n, ...), real and imaginary parts of complex ones."""
    values = torch.view_as_real(values.resolve_conj()) if values.is_complex() else values
    return values.double().flatten(1)


def best_weights(gram: np.ndarray) -> np.ndarray:
    """Return weights (K,), none negative, summing to one, of the smallest w^T `gram` w; gram is (K, K).

    Scaled to any sum s, the smallest s^2 w^T G w + (s - 1)^2 belongs to the same w: plain non-negative least
    squares.
    """
    values, vectors = np.linalg.eigh(gram / max(np.trace(gram), np.finfo(float).tiny))
    root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    result = nnls(np.vstack([root, np.ones(len(gram))]), np.append(np.zeros(len(gram)), 1.0))[0]
    return result / result.sum()


def mean_and_error(difference: np.ndarray, unit: np.ndarray) -> tuple[float, float]:
    """Return the mean of differences (n,) and its standard error,
    rows of one unit (n,) not being independent.

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


def choose_weights(gram: np.ndarray, unit: np.ndarray, deviations: float = 1.0) -> np.ndarray:
    """Return weights (K,) of predictions: one alone, unless a mixture is better by over `deviations` errors.

    The mixture is judged on units whose rows its weights were not learned from.

    Args:
        gram: (n, K, K) products of the errors of n rows.
        unit: (n,) of the rows, see `mean_and_error`.
        deviations: standard errors of the gain.
    """
    errors = np.einsum("nkk->nk", gram)
    winner = int(errors.mean(0).argmin())
    single = np.eye(gram.shape[1])[winner]
    part = np.unique(unit, return_inverse=True)[1].reshape(-1) % PARTS
    if gram.shape[1] < 2 or part.max() == 0:
        return single
    mixed = np.empty(len(gram))
    for number in range(int(part.max()) + 1):
        here = part == number
        mixed[here] = mixture_errors(_weights_of_large(gram[~here].mean(0)), gram[here])
    gain, error = mean_and_error(errors[:, winner] - mixed, unit)
    return _weights_of_large(gram.mean(0)) if gain > deviations * error else single


def mixture_errors(weights: np.ndarray, gram: np.ndarray) -> np.ndarray:
    """Return the squared errors (n,) of a mixture (K,) from products (n, K, K)."""
    return np.einsum("k,nkl,l->n", weights, gram, weights)


def _weights_of_large(gram: np.ndarray) -> np.ndarray:
    """The best weights (K,) without those that matter little."""
    large = best_weights(gram) >= UNUSED
    result = np.zeros(len(gram))
    result[large] = best_weights(gram[np.ix_(large, large)])
    return result
