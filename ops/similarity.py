"""Mean structural similarity of images with its gradient, as one kernel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsparc.ops import backends, built
from gsparc.ops.operators import KERNELS, operator


def served(images: Tensor) -> bool:
    """Whether a kernel supports these images: float32, on a device whose kernels are loaded."""
    if images.dtype != torch.float32:
        return False
    if images.device.type == "cpu" and built.kernels() is not None:
        backends.named("cpu")  # its kernels are then in the table
    return images.device.type in KERNELS


@operator
def similarity_op(
    prediction: Tensor, target: Tensor, taps: Sequence[float], stability: Sequence[float], slope: bool
) -> tuple[Tensor, Tensor]:
    """Similarity (B,) of float32 images (B, H, W), and its gradient by the prediction (empty unless `slope`).

    `taps` is one axis of a separable, symmetric window of odd length, `stability` the constants C1 and C2.
    """
    return prediction.new_empty(prediction.shape[0]), prediction.new_empty(prediction.shape if slope else 0)
