"""Task losses, one value per sample."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from gsparc.base.limits import Checked, choice, number, setting
from gsparc.data.query import Batch
from gsparc.data.target import Target, Values
from gsparc.field.initial import Snapshot
from gsparc.ops.similarity import has_similarity_kernel, similarity_op
from gsparc.ops.transforms import carries_tangent

SSIM_WEIGHT = 0.2  # of 1 - SSIM in the loss of a spectrum, the rest absolute error (the paper)
WINDOW_SIGMA = 1.5  # the Gaussian window of Wang et al. 2004, 11 taps
WINDOW_RADIUS = 5

DELAYS_PER_TONE = 8  # grid of the delay search; the delay is held constant in the gradient
STABILITY = (0.01**2, 0.03**2)  # C1, C2 for data range 1


@dataclass(frozen=True)
class LossSettings(Checked):
    """Task loss.

    Attributes:
        ssim_weight: lambda of (1 - l) L1 + l (1 - SSIM); 0 leaves L1 alone, as do images
            smaller than 11 x 11.
        snapshot: what every channel snapshot has of its own, `none`, `phase` or `phase_timing`; the
            loss does not look at it.
    """

    ssim_weight: float = setting(SSIM_WEIGHT, number(0, 1))
    snapshot: Snapshot = setting("none", choice(*get_args(Snapshot)))


def _ssim_by_convolution(prediction: Tensor, target: Tensor) -> Tensor:
    """Mean SSIM (B,) of images (B, H, W) that no kernel serves."""
    # Second moments are taken about the target's mean:
    # flat images would lose every digit otherwise.
    shift = target.mean(dim=(-2, -1), keepdim=True)
    p, t = prediction - shift, target - shift
    mean_p, mean_t, square_p, square_t, cross = _blur(torch.cat((p, t, p * p, t * t, p * t))).chunk(
        5
    )
    # Only rounding makes a variance negative.
    variances = (square_p - mean_p**2).clamp_min(0) + (square_t - mean_t**2).clamp_min(0)
    covariance = 2 * (cross - mean_p * mean_t) + STABILITY[1]
    light_p, light_t = mean_p + shift, mean_t + shift
    power = light_p**2 + light_t**2 + STABILITY[0]
    product = 2 * light_p * light_t + STABILITY[0]
    return (product * covariance / (power * (variances + STABILITY[1]))).mean(dim=(-2, -1))


class _Kernel(torch.autograd.Function):
    """`_ssim_by_convolution` as a kernel for float32 images, with its gradient."""

    @staticmethod
    def forward(ctx, prediction: Tensor, target: Tensor) -> Tensor:
        wanted = ctx.needs_input_grad[0]
        value, slope = similarity_op(
            prediction.detach(), target.detach(), _window_taps(), STABILITY, wanted
        )
        if wanted:
            ctx.save_for_backward(slope)
        return value

    @staticmethod
    def backward(ctx, upstream: Tensor) -> tuple[Tensor, None]:
        if torch.is_grad_enabled():  # create_graph
            raise RuntimeError("ssim in float32 has no second derivatives; compute in float64")
        (slope,) = ctx.saved_tensors
        return slope * upstream[:, None, None], None


@functools.lru_cache(maxsize=1)
def _window_taps() -> tuple[float, ...]:
    offsets = range(-WINDOW_RADIUS, WINDOW_RADIUS + 1)
    weights = [math.exp(-0.5 * (k / WINDOW_SIGMA) ** 2) for k in offsets]
    return tuple(w / sum(weights) for w in weights)


def _blur(images: Tensor) -> Tensor:
    """Gaussian window over (B, H, W), valid part: (B, H - 10, W - 10).
    Shifted sums beat a convolution.
    """
    for axis in (1, 2):
        length = images.shape[axis] - 2 * WINDOW_RADIUS
        taps = _window_taps()
        total = images.narrow(axis, 0, length) * taps[0]
        for k in range(1, len(taps)):
            total.add_(images.narrow(axis, k, length), alpha=taps[k])
        images = total
    return images


def fits_ssim_window(images: Tensor | np.ndarray) -> bool:
    """Tell whether images (..., H, W) are as large as the window of `ssim`, 11 x 11."""
    return min(images.shape[-2:]) > 2 * WINDOW_RADIUS


def ssim(prediction: Tensor, target: Tensor) -> Tensor:
    """Return the mean structural similarity per image, Gaussian window 11 x 11, sigma 1.5,
    data range 1.

    Args:
        prediction, target: (B, H, W) in [0, 1].

    Returns:
        (B,) in [-1, 1]. Wang et al. 2004, eq. 13.

    Raises:
        ValueError: an image smaller than the window.
        RuntimeError: a second derivative in float32 outside `torch.func`.
    """
    if not fits_ssim_window(prediction):
        raise ValueError(
            f"SSIM needs images of at least 11 x 11 pixels, got {tuple(prediction.shape[-2:])}"
        )
    kernel = prediction.dtype == target.dtype and has_similarity_kernel(prediction)
    # It knows one slope
    kernel = kernel and not target.requires_grad and not carries_tangent(target)
    return (_Kernel.apply if kernel else _ssim_by_convolution)(prediction, target)


def spectrum_loss(prediction: Tensor, target: Tensor, ssim_weight: float = SSIM_WEIGHT) -> Tensor:
    """Return (1 - l) L1 + l (1 - SSIM) per image (paper, eq. 6): (B, H, W) twice -> (B,).

    L1 alone for images smaller than SSIM's window, which have no SSIM.
    """
    absolute = (prediction - target).abs().mean(dim=(-2, -1))
    if ssim_weight == 0 or not fits_ssim_window(prediction):
        return absolute
    return weigh_losses(absolute, ssim(prediction, target), ssim_weight)


def weigh_losses(absolute: Values, alike: Values, ssim_weight: float = SSIM_WEIGHT) -> Values:
    """Return (1 - l) L1 + l (1 - SSIM) of both (B,)."""
    return (1 - ssim_weight) * absolute + ssim_weight * (1 - alike)


def task_loss(prediction: Tensor, batch: Batch, settings: LossSettings, of: Target) -> Tensor:
    """Return the loss (B,) of spectra, channels or powers; what was not measured counts as met.

    Args:
        prediction: like the targets of `batch`.
        batch: with targets and mask.
        settings: read as far as these targets need: what is not read has no effect, and is said.
        of: facts of the targets.
    """
    if not of.is_image:
        snapshot = settings.snapshot if prediction.is_complex() else "none"
        return channel_loss(prediction, batch.target, batch.mask, snapshot)
    if batch.mask is not None:
        prediction = torch.where(batch.mask, prediction, batch.target)
    return spectrum_loss(prediction, batch.target, settings.ssim_weight)


def channel_loss(
    prediction: Tensor, target: Tensor, mask: Tensor | None = None, snapshot: Snapshot = "none"
) -> Tensor:
    """Return the mean squared error of complex channels scaled to unit power (paper, eq. 5):
    (B, ...) -> (B,).

    Args:
        prediction, target: alike; (B, A, K) complex where snapshots have offsets.
        mask: like target, True where measured.
        snapshot: `phase`: the least error over one phase per sample; `phase_timing`: over a phase
            and a delay, `exp(j (phi - 2 pi f tau))`, tones evenly spaced.
            Both leave the amplitude as it is.

    Raises:
        ValueError: shapes differ; broadcasting would hide a missing antenna.
    """
    if prediction.shape != target.shape:
        raise ValueError(
            f"{tuple(prediction.shape)} channels predicted, {tuple(target.shape)} measured"
        )
    if snapshot != "none":
        return _error_up_to_phase(prediction, target, mask, snapshot == "phase_timing")
    error = (prediction - target).abs().square()
    if mask is None:
        return error.flatten(1).mean(1)
    return (error * mask).flatten(1).sum(1) / mask.flatten(1).sum(1).clamp_min(1)


def _error_up_to_phase(
    prediction: Tensor, target: Tensor, mask: Tensor | None, timing: bool
) -> Tensor:
    """min |h - p exp(j (phi - 2 pi k tau))|^2 over phi (and tau): |h|^2 + |p|^2 - 2 max |<p,
    h>|.
    """
    weights = torch.ones_like(target.real) if mask is None else mask.to(target.real.dtype)
    product = (prediction.conj() * target * weights).sum(1)  # (B, K)
    if timing and product.shape[1] > 1:
        period = DELAYS_PER_TONE * product.shape[1]
        best = torch.fft.ifft(product.detach(), period).abs().argmax(1, keepdim=True)
        turn = 2 * math.pi / period * best * torch.arange(product.shape[1], device=product.device)
        product = product * torch.polar(torch.ones_like(turn), turn)
    power = ((prediction.abs().square() + target.abs().square()) * weights).flatten(1).sum(1)
    alike = torch.view_as_real(product.sum(1)).square().sum(1).clamp_min(1e-20).sqrt()
    return (power - 2 * alike) / weights.flatten(1).sum(1).clamp_min(1)


def squared_error(mean: Tensor, batch: Batch, target: Target) -> Tensor:
    """Return the squared error of each row (B,) of what was measured: per entry,
    of powers [dB^2].
    """
    square = (target.in_error_unit(mean) - target.in_error_unit(batch.target)).abs().square()
    if batch.mask is not None:
        square = torch.where(batch.mask, square, 0)
    return square.flatten(1).mean(1)
