"""Flat images: SSIM of constant images leaves [-1, 1] and its gradient becomes NaN.

Remedy: second moments are taken about the target's mean and the variance is floored at 0. Shown:
constants 1e-7 apart in float32, against float64 within 1e-5, gradients finite.
"""

import pytest
import torch

from gsparc.field.losses import spectrum_loss, ssim

LEVELS = [0.0, 1e-7, 0.6, 0.6 + 1e-7, 1.0]


def flat(level: float, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.full((1, 24, 40), level, dtype=dtype)


@pytest.mark.parametrize("a", LEVELS)
@pytest.mark.parametrize("b", LEVELS)
def test_constants(a, b):
    prediction = flat(a).requires_grad_()
    similarity = ssim(prediction, flat(b))
    similarity.sum().backward()
    want = ssim(flat(a, torch.float64), flat(b, torch.float64))
    assert -1 <= similarity.item() <= 1 and abs(similarity.item() - want.item()) < 1e-5
    assert prediction.grad.isfinite().all()
    assert spectrum_loss(flat(a), flat(b)).item() >= -1e-6


@pytest.mark.parametrize("noise", [1e-8, 1e-7, 1e-6, 1e-4])
def test_nearly_flat(noise):
    draw = torch.Generator().manual_seed(0)
    images = 0.6 + noise * torch.randn(2, 1, 24, 40, generator=draw, dtype=torch.float64)
    prediction = images[0].float().requires_grad_()
    similarity = ssim(prediction, images[1].float())
    similarity.sum().backward()
    assert similarity.item() <= 1 and prediction.grad.isfinite().all()
    assert abs(similarity.item() - ssim(*images).item()) < 1e-5
