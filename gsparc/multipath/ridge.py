"""Cholesky factors of covariances that rounding may have left without one."""

from __future__ import annotations

import torch
from torch import Tensor

from gsparc.methods.worker import ask

# Rounding each entry to float32 moves an eigenvalue by at most `eps trace(K)`, since the Frobenius norm of a
# covariance is at most its trace; entries that are sums are rounded several times.
ROUNDING = torch.finfo(torch.float32).eps
RIDGES = (0.01, 0.1, 1.0, 16.0)  # of that bound, tried in turn


def cholesky(covariance: Tensor) -> Tensor:
    """Lower factor (n, n) of a covariance; in float64 and with a ridge where it has none without.

    Nearly noise-free rows at neighbouring places are alike to the last digit: a covariance of theirs is
    positive definite on paper and, rounded, has eigenvalues of either sign up to `ROUNDING trace(K)`. A ridge
    of that size mends it, and is noise that the data cannot tell from rounding; float64 rounds no more.

    Args:
        covariance: (n, n) real or complex, Hermitian.

    Returns:
        (n, n), dtype of `covariance`.

    Raises:
        ValueError: it has no factor with the largest ridge either.
    """
    ask()
    lower, failed = torch.linalg.cholesky_ex(covariance)
    if not failed:
        return lower
    exact = covariance.to(torch.complex128 if covariance.is_complex() else torch.float64)
    trace = exact.diagonal().real.sum() if exact.is_complex() else exact.trace()
    bound, added = ROUNDING * float(trace), 0.0
    for share in RIDGES:
        exact.diagonal().add_(share * bound - added)
        added = share * bound
        lower, failed = torch.linalg.cholesky_ex(exact)
        if not failed:
            return lower.to(covariance.dtype)
    most = RIDGES[-1] * ROUNDING * len(covariance)
    raise ValueError(
        f"the covariance of {len(covariance)} rows has no Cholesky factor, nor with {most:.1e} of its mean "
        "variance as noise, more than rounding explains: "
        "look for rows that are not finite (gsparc check FILE)"
    )
