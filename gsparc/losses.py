"""Task losses, one value per sample."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

WINDOW_SIGMA = 1.5  # the Gaussian window of Wang et al. 2004, 11 taps
WINDOW_RADIUS = 5
STABILITY = (0.01**2, 0.03**2)  # C1, C2 for data range 1


@functools.lru_cache(maxsize=32)
def _band(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Banded matrix (size - 10, size) that applies the window along one axis, valid part only."""
    taps = torch.exp(
        -0.5 * (torch.arange(-WINDOW_RADIUS, WINDOW_RADIUS + 1, dtype=torch.float64) / WINDOW_SIGMA) ** 2
    )
    taps = taps / taps.sum()
    rows = size - 2 * WINDOW_RADIUS
    if rows < 1:
        raise ValueError(f"SSIM needs images of at least 11 pixels a side, got {size}")
    matrix = torch.zeros(rows, size, dtype=torch.float64)
    for shift in range(len(taps)):
        matrix.diagonal(shift).copy_(taps[shift].expand(rows))
    return matrix.to(device=device, dtype=dtype)


def _blur(images: Tensor) -> Tensor:
    """Gaussian window over (B, H, W), separable, as two matrix products."""
    vertical = _band(images.shape[-2], images.dtype, images.device)
    horizontal = _band(images.shape[-1], images.dtype, images.device)
    return vertical @ images @ horizontal.T


def ssim(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity per image, Gaussian window 11 x 11, sigma 1.5, data range 1.

    Args:
        prediction, target: (B, H, W) in [0, 1]; sides of at least 11.

    Returns:
        (B,) in [-1, 1]; differentiable. Wang et al. 2004, eq. 13.
    """
    count = len(prediction)
    # Second moments are taken about the target's mean: flat images would lose every digit otherwise.
    shift = target.mean(dim=(-2, -1), keepdim=True).detach()
    p, t = prediction - shift, target - shift
    mean_p, mean_t, square_p, square_t, cross = _blur(torch.cat([p, t, p * p, t * t, p * t])).split(count)
    variance_p = (square_p - mean_p**2).clamp_min(0)
    variance_t = (square_t - mean_t**2).clamp_min(0)
    covariance = cross - mean_p * mean_t
    mean_p, mean_t = mean_p + shift, mean_t + shift
    c1, c2 = STABILITY
    luminance = (2 * mean_p * mean_t + c1) / (mean_p**2 + mean_t**2 + c1)
    structure = (2 * covariance + c2) / (variance_p + variance_t + c2)
    return (luminance * structure).mean(dim=(-2, -1))


def spectrum_loss(prediction: Tensor, target: Tensor, ssim_weight: float = 0.2) -> Tensor:
    """(1 - l) L1 + l (1 - SSIM) per image (paper, eq. 6): (B, H, W) twice -> (B,)."""
    absolute = (prediction - target).abs().mean(dim=(-2, -1))
    if ssim_weight == 0:
        return absolute
    return (1 - ssim_weight) * absolute + ssim_weight * (1 - ssim(prediction, target))


def channel_loss(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean squared error of complex channels scaled to unit power (paper, eq. 5): (B, ...) -> (B,)."""
    error = (
        (prediction - target).abs().square() if prediction.is_complex() else (prediction - target).square()
    )
    if mask is None:
        return error.flatten(1).mean(1)
    return (error * mask).flatten(1).sum(1) / mask.flatten(1).sum(1).clamp_min(1)
