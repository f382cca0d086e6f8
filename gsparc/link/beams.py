"""Maximum-ratio transmission: what predicted channels cost a beam."""

from __future__ import annotations

import torch
from torch import Tensor


def gain(true: Tensor, predicted: Tensor) -> Tensor:
    """Power gain over one average antenna, beams from `predicted` (n, A, K): mean over tones (n,), linear."""
    weight = predicted / torch.linalg.vector_norm(predicted, dim=1, keepdim=True).clamp_min(1e-30)
    received = (true * weight.conj()).sum(1).abs().square()
    single = true.abs().square().mean(1)
    return received.mean(1) / single.mean(1).clamp_min(1e-30)


def loss_db(true: Tensor, predicted: Tensor) -> Tensor:
    """What is lost against beams from the true channel (n,) [dB]."""
    return 10 * torch.log10(gain(true, true) / gain(true, predicted).clamp_min(1e-30))
