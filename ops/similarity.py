"""Mean structural similarity of images with its gradient, as one kernel."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.library import custom_op

from gsparc.ops import built


@custom_op("gsparc::similarity", mutates_args=(), device_types="cpu")
def similarity_op(
    prediction: Tensor, target: Tensor, taps: Sequence[float], stability: Sequence[float], slope: bool
) -> tuple[Tensor, Tensor]:
    """Similarity (B,) of float32 images (B, H, W), and its gradient by the prediction (empty unless `slope`).

    `taps` is one axis of a separable window of odd length, `stability` the constants C1 and C2.
    """
    kernels = built.kernels()
    assert kernels is not None, "the caller has looked"
    inputs = [torch.tensor(taps, dtype=torch.float32), prediction.contiguous(), target.contiguous()]
    value = prediction.new_empty(len(prediction))
    slopes = torch.empty_like(inputs[1]) if slope else None
    outputs = [value.data_ptr(), 0 if slopes is None else slopes.data_ptr()]
    sizes = (*prediction.shape, len(taps) // 2)
    addresses = [tensor.data_ptr() for tensor in inputs] + outputs
    kernels.similarity(sizes, stability, torch.get_num_threads(), addresses)
    return value, prediction.new_empty(0) if slopes is None else slopes


@similarity_op.register_fake
def _(prediction, target, taps, stability, slope):
    return prediction.new_empty(prediction.shape[0]), prediction.new_empty(prediction.shape if slope else 0)
