"""The networks' kernels against matrix products, forward and backward."""

import pytest
import torch
from torch.library import opcheck

from gsparc.ops import _native
from gsparc.ops.networks import networks, networks_backward_op, networks_op, products

SHAPES = [
    (1, 5, 3, 16, 2),
    (7, 70, 4, 16, 1),
    (3, 9, 6, 21, 2),
    (5, 2, 30, 32, 3),
    (2, 0, 3, 4, 1),
    (0, 3, 2, 5, 1),
]


def weights(shape, dtype=torch.float64):
    samples, count, inputs, hidden, outputs = shape
    draw = torch.Generator().manual_seed(sum(shape))
    sizes = [
        (samples, inputs),
        (count, inputs, hidden),
        (count, hidden),
        (count, hidden, outputs),
        (count, outputs),
    ]
    return [torch.randn(size, generator=draw, dtype=torch.float64).to(dtype) for size in sizes]


def evaluated(call, encoded, *layers):
    leaves = [layer.clone().requires_grad_() for layer in layers]
    out = call(encoded, *leaves)
    slope = torch.linspace(-1, 2, out.numel(), dtype=torch.float64).to(out.dtype).reshape(out.shape)
    return out.detach(), *torch.autograd.grad(out, leaves, slope)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("name", ["baseline", "avx2", "avx512"])
def test_equals_products(shape, dtype, name):
    fastest = _native.instruction_set()
    if not _native.use_instruction_set(name):
        pytest.skip(f"this machine or build has no {name}")
    try:
        got = evaluated(networks, *weights(shape, dtype))
    finally:
        _native.use_instruction_set(fastest)
    want = evaluated(products, *weights(shape))
    tolerance = 1e-12 if dtype == torch.float64 else 2e-5
    for a, b in zip(got, want, strict=True):
        assert torch.allclose(a.double(), b, rtol=tolerance, atol=tolerance)


def test_bit_identical_for_any_threads():
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(evaluated(networks, *weights((6, 700, 3, 16, 2), torch.float32)))
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_operators_obey_the_rules():
    encoded, *layers = weights((3, 5, 4, 8, 2))
    opcheck(networks_op.defined, (encoded, *[layer.requires_grad_() for layer in layers]))
    plain = [layer.detach() for layer in layers]
    opcheck(networks_backward_op.defined, (torch.ones(3, 5, 2, dtype=torch.float64), encoded, *plain))
    assert torch.autograd.gradcheck(lambda *w: networks(encoded, *w), layers)


def test_a_gradient_for_the_position_goes_through_the_products():
    encoded, *layers = weights((3, 5, 4, 8, 2))
    assert torch.autograd.gradcheck(lambda x: networks(x, *layers), (encoded.requires_grad_(),))


def test_strides_are_understood():
    encoded, weight1, *rest = weights((3, 5, 4, 8, 2))
    wide = torch.empty(5, 8, 4, dtype=torch.float64).mT
    wide.copy_(weight1)
    assert torch.equal(networks(encoded, wide, *rest), networks(encoded, weight1, *rest))


@pytest.mark.parametrize(
    ("part", "shape"),
    [
        (0, (2, 2)),
        (0, (2, 200)),
        (2, (0,)),
        (2, (4, 2)),
        (3, (2, 5, 2)),
        (3, (4, 3, 2)),
        (4, (4, 1)),
        (1, (4, 15)),
    ],
    ids=str,
)
def test_shapes_that_the_kernel_read_out_of_bounds(part, shape):
    """An empty bias was a segmentation fault, a bias (N, 1) other numbers than the products'."""
    tensors = weights((2, 4, 3, 5, 2))
    tensors[part] = torch.ones(shape, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"weights \(N, E, H\) and \(N, H, C\) with biases .* are needed"):
        networks(*tensors)


@pytest.mark.parametrize("part", range(5))
def test_dtypes_that_the_kernel_misread(part):
    tensors = weights((2, 4, 3, 5, 2))
    tensors[part] = tensors[part].float()
    with pytest.raises(TypeError, match="encoded, weights and biases share a dtype"):
        networks(*tensors)
