"""Covariances in a basis of what places can tell apart, and what likelihoods need of them.

The degrees of freedom of waves over a patch grow with its size in wavelengths (R. A. Kennedy et
al., "Intrinsic limits of dimensionality and richness in random multipath fields", IEEE Trans.
Signal Process. 55 (2007)) and are often far fewer than rows; the eigenvectors U of the isotropic
field hold all of them, and outside of them there is noise alone.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor

FLOOR = 1e-3  # of the noise: powers of eigenvectors that are left out
WORTH = 0.8  # of the rows, number of eigenvectors from which compression is not worth it

Cache = dict[Hashable, Any]
T = TypeVar("T")


def get_or_make(cache: Cache, key: Hashable, make: Callable[[], T]) -> T:
    """Return what is kept by a key, made the first time."""
    if key not in cache:
        cache[key] = make()
    value: T = cache[key]
    return value


def change_basis(matrix: Tensor, columns: Tensor) -> Tensor:
    """Return matrices (..., n, n) between real columns (n, r), as (..., r, r) complex128."""
    if not matrix.is_complex():
        return (columns.T @ matrix @ columns).to(torch.complex128)
    # Two real products take half the time of a complex one.
    return torch.complex(*(columns.T @ part @ columns for part in (matrix.real, matrix.imag)))


@dataclass(frozen=True)
class Basis:
    """Orthonormal columns for places that differ by one displacement at most.

    Attributes:
        key: of the places, then of what else decides the columns.
        places: (n, D) float64 [m].
        columns: U (n, r) float64, orthonormal; all of them where compression is not worth it.
        shared: what bases of several settings share.
    """

    key: tuple[Hashable, ...]
    places: Tensor
    columns: Tensor
    shared: Cache = field(default_factory=dict)

    @staticmethod
    def from_matrix(
        key: tuple[Hashable, ...],
        places: Tensor,
        gram: Callable[[], Tensor],
        noise: float,
        shared: Cache,
    ) -> Basis:
        """Return that of a correlation (n, n) float64 beside `noise`, its share."""
        size, vectors = torch.linalg.eigh(gram())
        mask = size > FLOOR * noise
        whole = int(mask.sum()) > WORTH * len(places)
        columns = torch.eye(len(places), dtype=torch.float64) if whole else vectors[:, mask]
        return Basis(key, places, columns, shared)

    def compress_once(self, key: Hashable, matrices: Callable[[], list[Tensor]]) -> Tensor:
        """Return covariances (n, n) in the basis (m, r, r), which equal places and keys share."""
        return get_or_make(
            self.shared,
            (*self.key, key),
            lambda: torch.stack([self.compress(matrix) for matrix in matrices()]),
        )

    def compress(self, matrix: Tensor) -> Tensor:
        """Return a matrix (n, n) of rows as (r, r) complex128."""
        whole = self.columns.shape[1] == len(self.columns)
        return matrix.to(torch.complex128) if whole else change_basis(matrix, self.columns)
