"""The kernel of the similarity against the written-out one in float64."""

import pytest
import torch
from torch.library import opcheck

from gsparc.ops import _native, backends
from gsparc.ops.similarity import similarity_op
from gsparc.training.losses import _Kernel, _written_out

backends.named("cpu")  # the operators find its kernels


def images(shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def evaluated(kind, prediction, target):
    leaf = prediction.clone().requires_grad_()
    value = kind(leaf, target)
    (value * torch.arange(1, len(value) + 1)).sum().backward()
    return value.detach().double(), leaf.grad.double()


@pytest.mark.parametrize("name", ["baseline", "avx2", "avx512"])
@pytest.mark.parametrize("shape", [(1, 11, 11), (3, 90, 360), (2, 23, 37), (1, 40, 12), (0, 20, 20)], ids=str)
def test_equals_float64(name, shape):
    fastest = _native.instruction_set()
    if not _native.use_instruction_set(name):
        pytest.skip(f"this machine or build has no {name}")
    a, b = images(shape), images(shape, 1)
    try:
        value, slope = evaluated(_Kernel.apply, a.float(), b.float())
    finally:
        _native.use_instruction_set(fastest)
    wanted, wanted_slope = evaluated(_written_out, a, b)
    assert torch.allclose(value, wanted, atol=1e-5)
    assert not slope.numel() or (slope - wanted_slope).abs().max() < 1e-4 * wanted_slope.abs().max()


def test_flat_images_stay_finite_and_alike():
    a, b = torch.full((1, 20, 20), 0.6), torch.full((1, 20, 20), 0.6 + 1e-7)
    value, slope = evaluated(_Kernel.apply, a, b)
    assert abs(float(value) - 1) < 1e-5 and torch.isfinite(slope).all()


def test_bit_identical_for_any_threads():
    before, a, b = torch.get_num_threads(), images((5, 30, 50)).float(), images((5, 30, 50), 1).float()
    results = []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(evaluated(_Kernel.apply, a, b))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(x, y) for other in results[1:] for x, y in zip(results[0], other, strict=True))


@pytest.mark.parametrize("slope", [True, False])
def test_operator_obeys_the_rules(slope):
    a, b = images((2, 13, 15)).float(), images((2, 13, 15), 1).float()
    opcheck(similarity_op.defined, (a, b, [0.25, 0.5, 0.25], [1e-4, 9e-4], slope))
