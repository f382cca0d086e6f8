"""Features of a process whose squared length is the part of it that is known.

A Gaussian process of unit variance and noise s, conditioned on rows X, has at x the mean
`phi(x) . w` and the variance `1 - |phi(x)|^2` with `phi(x) = C^T k(Z, x)`: C C^T = (K + s)^-1 where
Z = X (Rasmussen and Williams 2006, eq. 2.25 and 2.26). Of many rows, inducing places Z stand for
all (Quinonero-Candela and Rasmussen 2005, "A unifying view of sparse approximate Gaussian process
regression", section 5, with the prior's variance).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from gsparc.processes.factor import Factor
from gsparc.processes.kernel import ROUGH_RATIO, ROUGH_SHARE, Shadowing, SmoothRough, distances

Correlation = Literal["matern32", "smooth_rough"]
TERMS = {"matern32": Shadowing, "smooth_rough": SmoothRough}

ENOUGH = 0.5  # of the noise: a row this well known from the places before it is no further place
JITTER = 1e-8  # of the unit variance: places lie apart, this covers rounding
LEAST = 1e-12  # eigenvalue below which a feature is none


def correlation(a: Tensor, b: Tensor, length: float, name: Correlation) -> Tensor:
    """Return correlations (A, B) of unit variance between positions (A, 3) and (B, 3) [m].

    >>> correlation(torch.zeros(1, 3), torch.tensor([[2.0, 0.0, 0.0]]), 2.0, "matern32")
    tensor([[0.4834]])

    Raises:
        ValueError: another name.
    """
    if name not in TERMS:
        raise ValueError(f"correlation {name!r} is none of {', '.join(TERMS)}")
    return TERMS[name](length).correlation(distances(a, b))


def matern_mixture(length: float, name: Correlation) -> tuple[float, float, float, float]:
    """Return share and length [m] of a correlation's Matern-5/2,
    share and length of its Matern-3/2.
    """
    if name == "matern32":
        return 0.0, length, 1.0, length
    return 1 - ROUGH_SHARE, length, ROUGH_SHARE, ROUGH_RATIO * length


@dataclass(frozen=True)
class Features:
    """Features of a process, and what maps values at its rows to their weights.

    Attributes:
        places: (E, 3) float64 [m], Z.
        whitening: (E, E) float64, C: `phi(x) = k(x, Z) C`.
        weigh: (E, n) float64: values V (n, M) at the rows have the posterior mean
            `phi . (weigh V)`.
    """

    places: Tensor
    whitening: Tensor
    weigh: Tensor


def whitened_features(
    rows: Tensor, length: float, noise: float, name: Correlation, most: int
) -> Features:
    """Return features of a process conditioned on rows (n, 3) [m], at `most` places;
    exact up to that many.

    >>> rows = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], dtype=torch.float64)
    >>> known = whitened_features(rows, length=2.0, noise=0.01, name="matern32", most=10)
    >>> known.places.shape, known.whitening.shape, known.weigh.shape
    (torch.Size([2, 3]), torch.Size([2, 2]), torch.Size([2, 2]))

    Args:
        rows: float64.
        length: [m].
        noise: variance of a measurement, of the unit variance of the process; above 0.
        name: of `correlation`.
        most: places.
    """
    if len(rows) <= most:
        gram = correlation(rows, rows, length, name)
        gram.diagonal().add_(noise)
        root = Factor.from_gram(gram).root
        # C = L^-T, as C C^T is to be the inverse of the covariance.
        return Features(rows, root.T.contiguous(), root)
    return place_features(
        rows[pivoted_rows(rows, length, ENOUGH * noise, name, most)], rows, length, noise, name
    )


def place_features(
    places: Tensor, rows: Tensor, length: float, noise: float, name: Correlation
) -> Features:
    """Return features at given places (E, 3) that stand for all rows (n, 3);
    see `whitened_features`.
    """
    gram = correlation(places, places, length, name)
    gram.diagonal().add_(JITTER)
    factor = Factor.from_gram(gram)
    seen = factor.whiten(correlation(places, rows, length, name))
    size, turn = torch.linalg.eigh(seen @ seen.T)
    size = size.clamp_min(LEAST)
    # K_ZZ^-1 - (K_ZZ + K_ZX K_XZ / s)^-1 = L^-T U q / (s + q) U^T L^-1
    back = factor.root.T @ turn
    whitening = back * (size / (noise + size)).sqrt()
    weigh = (turn / (size * (noise + size)).sqrt()).T @ seen
    return Features(places, whitening.contiguous(), weigh)


def pivoted_rows(
    rows: Tensor, length: float, enough: float, name: Correlation, most: int
) -> Tensor:
    """Return indices of up to `most` rows (n, 3),
    each the one that those before it tell least about.

    It ends when every row's variance given these is at most `enough`: a pivoted Cholesky
    factorization (Fine and Scheinberg 2001), n times the square of their number in time.

    >>> rows = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [9.0, 0.0, 0.0]])
    >>> pivoted_rows(rows, length=2.0, enough=0.0, name="matern32", most=2)
    tensor([0, 2])
    """
    most = min(most, len(rows))
    variance, factor = torch.ones(len(rows), dtype=rows.dtype), rows.new_zeros(most, len(rows))
    chosen: list[int] = []
    while len(chosen) < most:
        row, number = int(variance.argmax()), len(chosen)
        if chosen and float(variance[row]) <= max(enough, JITTER):
            break
        column = correlation(rows[row : row + 1], rows, length, name)[0]
        column -= factor[:number, row] @ factor[:number]
        factor[number] = column / variance[row].sqrt()
        variance -= factor[number].square()
        variance[row] = -1.0  # never again, whatever rounding says
        chosen.append(row)
    return torch.tensor(chosen)
