"""The kernel of the similarity against its definition in PyTorch."""

import pytest
import torch
from compute_kernels import SETS, SHAPES, assert_threads_agree, evaluated, instruction_set

from gsparc.field.losses import _Kernel, _ssim_by_convolution


@SETS
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_equals_reference(shape, name):
    with instruction_set(name):
        value, gradient = evaluated(_Kernel.apply, shape)
    wanted, slope = evaluated(_ssim_by_convolution, shape, torch.float64)
    largest = [float(part.abs().max()) if part.numel() else 0.0 for part in (wanted, slope)]
    assert value.dtype == torch.float32 and value.shape == wanted.shape
    assert ((value.double() - wanted).abs() <= 1e-5 * (1 + largest[0])).all()
    assert ((gradient.double() - slope).abs() <= 1e-4 * largest[1]).all()


def test_bit_identical_for_any_threads():
    assert_threads_agree(lambda: evaluated(_Kernel.apply, (5, 30, 50)))
