"""Leave-one-out likelihood of powers under a process with Gaussians, with autograd.

The covariance is that of `gsparc.processes.density`; here its slopes go on to the Gaussians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gsparc.processes.conditioned import Conditioned
from gsparc.processes.kernel import Kernel, matern_sum


@dataclass(frozen=True)
class Covariance:
    """The kernel of `Kernel` in logarithms, as tensors.

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
    def of(cls, kernel: Kernel) -> Covariance:
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
        first = torch.sigmoid(self.share_logit)
        shares = [first, 1 - first] if len(self.log_lengths) == 2 else [torch.ones_like(first)]
        total = matern_sum(distance, list(self.log_lengths.exp()), shares) + terms @ terms.T
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
        NotPositiveDefiniteError: the covariance is not positive definite.
    """
    residual, variance = Conditioned.of(gram, values[:, None], "raise").left_out()
    log_variance = log_amplitude + variance.log()
    return 0.5 * (math.log(2 * math.pi) + log_variance + residual[:, 0].square() * torch.exp(-log_variance))
