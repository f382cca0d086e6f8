"""Leave-one-out likelihood of powers under a process with Gaussians, with autograd.

The covariance is that of `gsparc.methods.power_kernel`; here its slopes go on to the Gaussians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.methods.power_kernel import PowerKernel


@dataclass(frozen=True)
class Covariance:
    """The kernel of `PowerKernel` in logarithms, as tensors.

    Attributes:
        log_lengths: (1,) or (2,), of metres.
        share_logit: () of the first length; not read where there is one.
        log_noise: () variance relative to the amplitude.
        log_amplitude: () [dB^2].
    """

    log_lengths: Tensor
    share_logit: Tensor
    log_noise: Tensor
    log_amplitude: Tensor

    @classmethod
    def of(cls, kernel: PowerKernel) -> Covariance:
        """A kernel's, float64."""
        shares = kernel.shares
        logit = math.log(shares[0] / shares[1]) if len(shares) == 2 else 0.0
        parts = (
            [math.log(v) for v in kernel.lengths],
            logit,
            math.log(kernel.noise),
            math.log(kernel.amplitude),
        )
        return cls(*(torch.tensor(part, dtype=torch.float64) for part in parts))

    def gram(self, distance: Tensor, terms: Tensor) -> Tensor:
        """Covariance (n, n) with noise, relative to the amplitude.

        Args:
            distance: (n, n) [m].
            terms: (n, P) of the mean law and the Gaussians.
        """
        total = terms @ terms.T
        first = torch.sigmoid(self.share_logit)
        shares = [first, 1 - first] if len(self.log_lengths) == 2 else [torch.ones_like(first)]
        for log_length, share in zip(self.log_lengths, shares, strict=True):
            far = distance * (math.sqrt(3) * torch.exp(-log_length))
            total = total + share * (1 + far) * torch.exp(-far)
        return total + self.log_noise.exp() * torch.eye(len(terms), dtype=terms.dtype)


def left_out_losses(gram: Tensor, values: Tensor, log_amplitude: Tensor) -> Tensor:
    """Negative log density (n,) [nats] of each value given the others.

    With R = K^-1 y and q = diag(K^-1) the left-out errors are R_i / q_i, their variances amplitude / q_i
    (Rasmussen and Williams 2006, eqs. 5.10 to 5.12).

    Args:
        gram: (n, n) relative to the amplitude.
        values: (n,) less the mean law [dB].
        log_amplitude: () of dB^2.

    Raises:
        torch.linalg.LinAlgError: the covariance is not positive definite.
    """
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(gram))
    share = inverse.diagonal()
    log_variance = log_amplitude - share.log()
    squared = ((inverse @ values) / share).square()
    return 0.5 * (math.log(2 * math.pi) + log_variance + squared * torch.exp(-log_variance))
