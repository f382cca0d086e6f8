"""Mean structural similarity of images with its gradient, as one kernel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsparc.ops import calls
from gsparc.ops.operators import KERNELS, register_kernel, run_kernel
from gsparc.ops.transforms import needs_reference


def has_similarity_kernel(images: Tensor) -> bool:
    """Tell whether a kernel supports these images: float32 on a CPU, outside `torch.func`."""
    # On a GPU sums of shifted images take 3 to 5 ms more in a training step.
    has_kernel = images.dtype == torch.float32 and "similarity" in KERNELS.get(
        images.device.type, ()
    )
    return has_kernel and calls.kernels() is not None and not needs_reference(images)


def similarity_op(
    prediction: Tensor,
    target: Tensor,
    taps: Sequence[float],
    stability: Sequence[float],
    slope: bool,
) -> tuple[Tensor, Tensor]:
    """Return the similarity (B,) of float32 images (B, H, W),
    and its gradient (empty unless `slope`).

    `taps` (11,) are one axis of a separable, symmetric window, `stability` constants C1 and C2.
    """
    out = (
        prediction.new_empty(prediction.shape[0]),
        prediction.new_empty(prediction.shape if slope else 0),
    )
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
    window, images = (
        torch.tensor(taps, dtype=torch.float32),
        (prediction.contiguous(), target.contiguous()),
    )
    tensors = (window, *images, value, slopes if slope else None)
    calls.launch("similarity", prediction, *tensors, sizes=prediction.shape, numbers=stability)
