"""Maximum-ratio transmission: what predicted channels cost a beam."""

from __future__ import annotations

import torch
from torch import Tensor

LEAST = 1e-10  # of the gain of the true channel's beam: no beam at all is 100 dB off, not infinitely


def gain(true: Tensor, predicted: Tensor) -> Tensor:
    """Power gain over one average antenna, beams from `predicted` (n, A, K): mean over tones (n,), linear."""
    weight = predicted / torch.linalg.vector_norm(predicted, dim=1, keepdim=True).clamp_min(1e-30)
    received = (true * weight.conj()).sum(1).abs().square()
    single = true.abs().square().mean(1)
    return received.mean(1) / single.mean(1).clamp_min(1e-30)


def loss_db(true: Tensor, predicted: Tensor) -> Tensor:
    """What is lost against beams from the true channel (n,) [dB], at most 100; NaN where that is silent."""
    best = gain(true, true)
    return 10 * torch.log10(best / torch.maximum(gain(true, predicted), LEAST * best))
