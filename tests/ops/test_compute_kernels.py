"""Kernels of networks and of the similarity against their definitions in PyTorch."""

import pytest
import torch
from compute_kernels import (
    KIND_SHAPES,
    KINDS,
    SETS,
    assert_equals_reference,
    assert_threads_agree,
    evaluated,
    instruction_set,
    layers,
)

from gsparc.ops.networks import networks

LARGE = {"networks": (6, 700, 3, 16, 2), "similarity": (5, 30, 50)}


@SETS
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("kind,shape", KIND_SHAPES, ids=str)
def test_equals_reference(kind, shape, dtype, name):
    if dtype not in KINDS[kind].tolerance:
        pytest.skip("in float64 no kernel computes the similarity")
    with instruction_set(name):
        assert_equals_reference(kind, shape, dtype)


@pytest.mark.parametrize("kind", KINDS)
def test_bit_identical_for_any_threads(kind):
    of = KINDS[kind]
    assert_threads_agree(lambda: evaluated(of.kernel, of, LARGE[kind], torch.float32))


def test_networks_gradients():
    """By the kernel for the weights, by matrix products for the position."""
    encoded, *weights = layers(3, 5, 4, 8, 2)
    leaves = [layer.clone().requires_grad_() for layer in weights]
    assert torch.autograd.gradcheck(lambda *w: networks(encoded, *w), leaves)
    assert torch.autograd.gradcheck(lambda x: networks(x, *weights), (encoded.clone().requires_grad_(),))


def test_networks_strides():
    encoded, weight1, *rest = layers(3, 5, 4, 8, 2)
    wide = torch.empty(5, 8, 4, dtype=torch.float64).mT
    wide.copy_(weight1)
    assert torch.equal(networks(encoded, wide, *rest), networks(encoded, weight1, *rest))


@pytest.mark.parametrize(
    "part,shape",
    [(0, (2, 2)), (0, (2, 200)), (1, (4, 15)), (2, (0,)), (2, (4, 2)), (3, (2, 5, 2)), (3, (4, 3, 2)),
     (4, (4, 1))],
    ids=str,
)  # fmt: skip
def test_network_shapes_that_the_kernel_read_out_of_bounds(part, shape):
    """An empty bias was a segmentation fault, a bias (N, 1) other numbers than the products'."""
    tensors = layers(2, 4, 3, 5, 2)
    tensors[part] = torch.ones(shape, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"weights \(N, E, H\) and \(N, H, C\) with biases .* are needed"):
        networks(*tensors)


@pytest.mark.parametrize("part", range(5))
def test_network_dtypes_that_the_kernel_misread(part):
    tensors = layers(2, 4, 3, 5, 2)
    tensors[part] = tensors[part].float()
    with pytest.raises(TypeError, match="encoded, weights and biases share a dtype"):
        networks(*tensors)
