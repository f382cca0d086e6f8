"""Covariances in a basis of what places can tell apart, and what likelihoods need of them.

The degrees of freedom of waves over a patch grow with its size in wavelengths (R. A. Kennedy et al.,
"Intrinsic limits of dimensionality and richness in random multipath fields", IEEE Trans. Signal Process. 55
(2007)) and are often far fewer than rows; the eigenvectors U of the isotropic field hold all of them, and
outside of them there is noise alone.
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
    kept: T = cache[key]
    return kept


@dataclass(frozen=True)
class Dense:
    """Covariances (m, r, r) complex128."""

    matrices: Tensor

    def add_to(self, covariance: Tensor, power: Tensor) -> Tensor:
        """Return a covariance (r, r), which may be overwritten, with these of powers (m,)."""
        flat = self.matrices.view(len(power), -1)
        return covariance.add_((power.to(flat.dtype) @ flat).view(covariance.shape))

    def traces_of_products(self, weight: Tensor) -> Tensor:
        """Return traces (m,) of products with a Hermitian matrix (r, r)."""
        return (self.matrices.reshape(len(self.matrices), -1) @ weight.T.reshape(-1)).real

    def change_basis(self, coordinates: Tensor) -> Dense:
        """Return them in another basis, of which the old one is (s, r) float64 coordinates."""
        real, imag = self.matrices.real, self.matrices.imag
        return Dense(torch.complex(coordinates @ real @ coordinates.T, coordinates @ imag @ coordinates.T))


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
        key: tuple[Hashable, ...], places: Tensor, gram: Callable[[], Tensor], noise: float, shared: Cache
    ) -> Basis:
        """Return that of a correlation (n, n) float64 beside `noise`, its share."""
        size, vectors = torch.linalg.eigh(gram())
        mask = size > FLOOR * noise
        whole = int(mask.sum()) > WORTH * len(places)
        columns = torch.eye(len(places), dtype=torch.float64) if whole else vectors[:, mask]
        return Basis(key, places, columns, shared)

    def dense_piece(self, key: Hashable, matrices: Callable[[], list[Tensor]]) -> tuple[Dense, ...]:
        """Return a piece of covariances (n, n), which equal places and keys share."""
        return (get_or_make(self.shared, (*self.key, key), lambda: self._compress(matrices())),)

    def _compress(self, matrices: list[Tensor]) -> Dense:
        return Dense(torch.stack([self.compress(matrix) for matrix in matrices]))

    def compress(self, matrix: Tensor) -> Tensor:
        """Return a matrix (n, n) of rows as (r, r) complex128."""
        if self.columns.shape[1] == len(self.columns):
            return matrix.to(torch.complex128)
        if not matrix.is_complex():
            return (self.columns.T @ matrix @ self.columns).to(torch.complex128)
        # The basis is real: two real products take half the time of a complex one.
        return torch.complex(*(self.columns.T @ part @ self.columns for part in (matrix.real, matrix.imag)))
