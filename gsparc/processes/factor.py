"""Cholesky factors of covariances, and all that is solved with them.

LAPACK in place factors a single matrix without gradients, and solves for many columns, in .4 to .9
of torch's time from some hundred rows on. Few rows, inverses, batches, gradients and matrices worth
several threads go to torch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from scipy.linalg import get_blas_funcs, get_lapack_funcs
from threadpoolctl import ThreadpoolController
from torch import Tensor

from gsparc.ops.transforms import is_differentiated
from gsparc.processes.worker import raise_if_cancelled

Failing = Literal["mend", "raise", "ignore"]
# Rounding each entry to float32 moves an eigenvalue by at most `eps trace(K)`, since the Frobenius
# norm of a covariance is at most its trace; entries that are sums are rounded several times.
ROUNDING = torch.finfo(torch.float32).eps
RIDGES = (0.01, 0.1, 1.0, 16.0)  # of that bound, tried in turn
ALONE = 2_000  # rows up to which one thread is as good as several
BANDS = 8  # of an inverse's rows, that are stored up to its diagonal
FEW = 128  # rows below which torch is as quick
# Two threads of OpenBLAS beside other work took 10 to 400 times as long as one.
BLAS = ThreadpoolController().select(user_api="blas")


class NotDefiniteError(ValueError):
    """A covariance has no Cholesky factor."""


@dataclass(frozen=True)
class Factor:
    """`K = L L^H`.

    >>> factor = Factor.from_gram(torch.tensor([[4.0, 2.0], [2.0, 3.0]]))
    >>> factor.solve(torch.tensor([[8.0], [7.0]])).T
    tensor([[1.2500, 1.5000]])
    >>> Factor.from_gram(torch.tensor([[1.0, 2.0], [2.0, 1.0]]), failing="raise")
    Traceback (most recent call last):
        ...
    gsparc.processes.factor.NotDefiniteError: a covariance is not positive definite

    Attributes:
        lower: L (..., n, n), real or complex.
    """

    lower: Tensor

    @classmethod
    def from_gram(
        cls, covariance: Tensor, failing: Failing = "mend", overwrite: bool = False
    ) -> Factor:
        """Factor a Hermitian covariance (..., n, n);
        in float64 and with a ridge where there is none without.

        Nearly noise-free rows at neighbouring places are alike to the last digit: a covariance of
        theirs is positive definite on paper and, rounded, has eigenvalues of either sign up to
        `ROUNDING trace(K)`. A ridge of that size mends it, and is noise that the data cannot tell
        from rounding; float64 rounds no more.

        Args:
            covariance: real or complex.
            failing: what follows where there is none: a ridge, an error, or nothing: of a batch of
                steps some may fail.
            overwrite: whether L may take the place of the covariance, which then is not to be
                mended.

        Raises:
            NotDefiniteError: it has no factor, nor with the largest ridge.
        """
        raise_if_cancelled()
        lower, failed = _cholesky(covariance, overwrite)
        if not failed or failing == "ignore":
            return cls(lower)
        if failing == "raise":
            raise NotDefiniteError("a covariance is not positive definite")
        if covariance.dim() > 2:
            return cls(torch.stack([cls.from_gram(matrix).lower for matrix in covariance]))
        exact = covariance.to(torch.complex128 if covariance.is_complex() else torch.float64)
        exact = exact.clone() if exact is covariance else exact
        bound, added = ROUNDING * float(exact.diagonal().real.sum()), 0.0
        for share in RIDGES:
            # A ridge replaces the one before: what that added is part of it.
            exact.diagonal().add_(share * bound - added)
            added = share * bound
            lower, failed = _cholesky(exact)
            if not failed:
                return cls(lower.to(covariance.dtype))
        most = RIDGES[-1] * ROUNDING * len(covariance)
        raise NotDefiniteError(
            f"the covariance of {len(covariance)} rows has no Cholesky factor, nor with "
            f"{most:.1e} of its "
            "mean variance as noise, more than rounding explains: "
            "look for rows that are not finite (gsparc check FILE)"
        )

    def whiten(self, values: Tensor) -> Tensor:
        """Return `L^-1 V` of values (..., n, R)."""
        if values.is_complex() and not self.lower.is_complex():
            return solve_as_pairs(self.whiten, values)
        values = values.to(self.lower.dtype)
        if values.shape[-1] == 1 or not _suits_lapack(self.lower, values):
            return torch.linalg.solve_triangular(self.lower, values, upper=False)
        return self._solve_triangular(values, adjoint=False)

    @cached_property
    def _inverse_in_float32(self) -> list[np.ndarray]:
        root, step = self._invert_lower().float().numpy(), -(-len(self.lower) // BANDS)
        # A band of rows ends at its diagonal: the zeros above are neither stored nor read.
        return [
            np.ascontiguousarray(root[i : i + step, : i + step]) for i in range(0, len(root), step)
        ]

    def solve(self, values: Tensor) -> Tensor:
        """Return `K^-1 V` of values (..., n, R)."""
        if values.is_complex() and not self.lower.is_complex():
            return solve_as_pairs(self.solve, values)
        values = values.to(self.lower.dtype)
        if not _suits_lapack(self.lower, values):
            return torch.cholesky_solve(values, self.lower)
        return self._solve_triangular(self.whiten(values), adjoint=True)

    def _solve_triangular(self, values: Tensor, adjoint: bool) -> Tensor:
        """`L^-1 V`, or `L^-H V`."""
        # The transpose of an array in C's order is one in Fortran's:
        # LAPACK reads it without a copy.
        upper, right = _to_numpy(self.lower).T, np.ascontiguousarray(_to_numpy(values))
        trsm = get_blas_funcs("trsm", (upper,))
        with BLAS.limit(limits=1):
            return torch.from_numpy(
                trsm(1.0, upper, right.T, side=1, lower=0, trans_a=2 if adjoint else 0).T
            )

    @cached_property
    def root(self) -> Tensor:
        """`L^-1` (..., n, n): `K^-1 = root^H root`."""
        return self._invert_lower()

    def _invert_lower(self) -> Tensor:
        if not _suits_lapack(self.lower):
            eye = torch.eye(self.lower.shape[-1], dtype=self.lower.dtype, device=self.lower.device)
            return torch.linalg.solve_triangular(self.lower, eye, upper=False)
        upper = _to_numpy(self.lower).T
        with BLAS.limit(limits=1):
            return torch.from_numpy(get_lapack_funcs("trtri", (upper,))(upper, lower=0)[0].T)

    @cached_property
    def inverse(self) -> Tensor:
        """`K^-1` (..., n, n)."""
        return torch.cholesky_inverse(self.lower)

    @cached_property
    def precision(self) -> Tensor:
        """Diagonal (..., n) of `K^-1`, real; without forming the rest."""
        if "inverse" in vars(self):
            return self.inverse.diagonal(dim1=-2, dim2=-1).real
        # diag(L^-H L^-1) is the squared length of each column of L^-1.
        return self.root.abs().square().sum(-2)

    def root_of(self, rows: Tensor) -> Tensor:
        """Return some columns (n, m) of `L^-1`, of which few cost less than all."""
        unit = torch.zeros(len(self.lower), len(rows), dtype=self.lower.dtype)
        unit[rows, torch.arange(len(rows))] = 1
        return self.whiten(unit)

    def precision_of(self, rows: Tensor) -> Tensor:
        """Return `precision` of some rows (m,)."""
        return self.root_of(rows).abs().square().sum(0)

    @cached_property
    def log_determinant(self) -> Tensor:
        """Of K (...), float64."""
        # In float64: a sum of thousands of logarithms loses digits in float32.
        return 2 * self.lower.diagonal(dim1=-2, dim2=-1).real.double().log().sum(-1)


def whiten_in_float32(factors: Sequence[Factor], values: Sequence[Tensor]) -> list[Tensor]:
    """Whiten (n, R) by stored inverses in float32: half the memory to read for few columns.

    Rounding moves their squares by 1e-6 where the noise is a hundredth of the signal's variance.
    """
    if is_differentiated(*values) or max(len(factor.lower) for factor in factors) > ALONE:
        return [factor.whiten(part) for factor, part in zip(factors, values, strict=True)]
    single, result = [part.float().numpy() for part in values], []
    # OpenBLAS multiplies few columns in a third of torch's time.
    with BLAS.limit(limits=1):
        for own, part in zip(factors, single, strict=True):
            result.append(
                np.concatenate([band @ part[: band.shape[1]] for band in own._inverse_in_float32])
            )
    return [torch.from_numpy(part).to(values[0].dtype) for part in result]


def solve_as_pairs(solve: Callable[[Tensor], Tensor], values: Tensor) -> Tensor:
    """Solve for complex values (..., n, R) through a real factor, as twice as many real ones."""
    pairs = torch.view_as_real(values.resolve_conj()).flatten(-2)
    return torch.view_as_complex(solve(pairs).unflatten(-1, (-1, 2)).contiguous())


def _suits_lapack(*parts: Tensor) -> bool:
    """Whether these are single matrices for one thread of the processor, without gradients."""
    grows = is_differentiated(*parts)
    fits = all(part.dim() == 2 and part.device.type == "cpu" for part in parts)
    fits = fits and parts[0].dtype not in (torch.float16, torch.bfloat16)
    many = len(parts[0]) > ALONE and torch.get_num_threads() > 1
    return fits and not grows and not many and len(parts[0]) >= FEW


def _to_numpy(values: Tensor) -> np.ndarray:
    # Conjugates and signs are lazy in torch; NumPy takes the numbers alone.
    return values.detach().resolve_conj().resolve_neg().numpy()


def _cholesky(covariance: Tensor, overwrite: bool = False) -> tuple[Tensor, bool]:
    """L, and whether there is none."""
    if not _suits_lapack(covariance):
        lower, info = torch.linalg.cholesky_ex(covariance)
        return lower, bool(info.any())
    transposed = _to_numpy(covariance).T  # in LAPACK's order of columns as it lies, its conjugate
    potrf = get_lapack_funcs("potrf", (transposed,))
    with BLAS.limit(limits=1):
        # LAPACK factors in place: a copy, where the caller keeps the covariance.
        given = transposed if overwrite else np.array(transposed, order="F")
        upper, info = potrf(given, lower=0, clean=1, overwrite_a=1)
    return torch.from_numpy(upper.T), bool(info)
