"""Cholesky factors of covariances that rounding may have left without one."""

from __future__ import annotations

import torch
from torch import Tensor

RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2)  # of the mean variance, tried in turn


def cholesky(covariance: Tensor) -> Tensor:
    """Lower factor (n, n) of a covariance; a ridge is added to it where it has none without.

    Nearly noise-free rows at neighbouring places are alike to the last digit: a covariance of theirs is
    positive definite on paper and has eigenvalues of either sign in floating point. The least ridge that
    mends it is noise that the data cannot tell from rounding.

    Args:
        covariance: (n, n) real or complex, Hermitian.

    Raises:
        ValueError: it has no factor with the largest ridge either.
    """
    lower, failed = torch.linalg.cholesky_ex(covariance)
    if not failed:
        return lower
    mean = covariance.diagonal().real.mean() if covariance.is_complex() else covariance.diagonal().mean()
    for ridge in RIDGES:
        mended = covariance.clone()
        mended.diagonal().add_(ridge * mean)
        lower, failed = torch.linalg.cholesky_ex(mended)
        if not failed:
            return lower
    raise ValueError(
        f"the covariance of {len(covariance)} rows has no Cholesky factor, nor with {RIDGES[-1]:.0%} of "
        "noise: look for rows that are not finite (gsparc check FILE)"
    )
