"""Mean structural similarity of images with its gradient, as one kernel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsparc.ops import calls
from gsparc.ops.operators import register_kernel, run_kernel
from gsparc.ops.transforms import needs_reference


def has_similarity_kernel(images: Tensor) -> bool:
    """Tell whether a kernel supports these images: float32, on a device whose kernels are loaded."""
    device = images.device.type
    if needs_reference(images):
        return False
    loaded = device in calls.libraries or (device == "cpu" and calls.kernels() is not None)
    return images.dtype == torch.float32 and loaded


def similarity_op(
    prediction: Tensor, target: Tensor, taps: Sequence[float], stability: Sequence[float], slope: bool
) -> tuple[Tensor, Tensor]:
    """Return the similarity (B,) of float32 images (B, H, W), and its gradient (empty unless `slope`).

    `taps` (2 `RADIUS` + 1,) are one axis of a separable, symmetric window, `stability` constants C1 and C2.
    """
    out = prediction.new_empty(prediction.shape[0]), prediction.new_empty(prediction.shape if slope else 0)
    return run_kernel("similarity", prediction, out, prediction, target, taps, stability, slope)


@register_kernel("similarity", "cpu")
def _similarity_cpu(
    out: tuple[Tensor, Tensor],
    prediction: Tensor,
    target: Tensor,
    taps: Sequence[float],
    stability: Sequence[float],
    slope: bool,
) -> None:
    value, slopes = out
    window, images = torch.tensor(taps, dtype=torch.float32), (prediction.contiguous(), target.contiguous())
    tensors = (window, *images, value, slopes if slope else None)
    calls.launch("similarity", prediction, *tensors, sizes=prediction.shape, numbers=stability)


@register_kernel("similarity", "cuda")
def _similarity_cuda(
    out: tuple[Tensor, Tensor],
    prediction: Tensor,
    target: Tensor,
    taps: Sequence[float],
    stability: Sequence[float],
    slope: bool,
) -> tuple[Tensor, Tensor]:
    known, (samples, height, width) = calls.kernels(), prediction.shape
    # Only windows that lie inside the image count.
    rows, columns = height - 2 * known.RADIUS, width - 2 * known.RADIUS
    blocks = -(-rows // known.SIMILARITY_HEIGHT) * -(-columns // known.SIMILARITY_WIDTH)
    # A sum for each block of pixels, added up in a fixed order below.
    sums = prediction.new_empty(samples, blocks)
    inputs = (prediction.contiguous(), target.contiguous(), target.mean(dim=(-2, -1)))
    if samples:
        tensors = *inputs, sums, out[1] if slope else None
        # A symmetric window is passed up to its middle.
        numbers = *stability, *taps[: known.RADIUS + 1]
        calls.launch("similarity", prediction, *tensors, sizes=prediction.shape, numbers=numbers)
    return sums.sum(1) / (rows * columns), out[1]
