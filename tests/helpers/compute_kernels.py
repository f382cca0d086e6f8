"""Kernels beside the rasterizer's with what defines them in PyTorch, and how a kernel is run in every way."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from gsparc.field.losses import _Kernel, _ssim_by_convolution
from gsparc.ops import _native, backends
from gsparc.ops.networks import networks, plain_networks

backends.backend_named("cpu")  # the operators find its kernels
SETS = pytest.mark.parametrize("name", ["baseline", "avx2", "avx512"])


def random(*sizes: tuple[int, ...]) -> list[Tensor]:
    """Normal float64 numbers of each size."""
    draw = torch.Generator().manual_seed(sum(map(sum, sizes)))
    return [torch.randn(size, generator=draw, dtype=torch.float64) for size in sizes]


def layers(samples: int, count: int, inputs: int, hidden: int, outputs: int) -> list[Tensor]:
    """Encoded positions, then weights and biases of networks."""
    shapes = (count, inputs, hidden), (count, hidden), (count, hidden, outputs), (count, outputs)
    return random((samples, inputs), *shapes)


def images(*shape: int) -> list[Tensor]:
    """Two images."""
    return [part.sigmoid() for part in random(shape, shape)]


@dataclass(frozen=True)
class Kind:
    """A kernel beside its definition.

    Attributes:
        kernel, reference: of the shape, then tensors.
        inputs: tensors of a shape, in float64.
        trained: those whose gradients are compared.
        shapes: to compare at.
        tolerance: of outputs, and of gradients by their largest, by dtype.
    """

    kernel: Callable[..., Tensor]
    reference: Callable[..., Tensor]
    inputs: Callable[..., list[Tensor]]
    trained: slice
    shapes: tuple[tuple[int, ...], ...]
    tolerance: dict[torch.dtype, tuple[float, float]]

    def cast(self, shape: tuple[int, ...], dtype: torch.dtype) -> list[Tensor]:
        """Inputs in a precision."""
        return [tensor.to(dtype) for tensor in self.inputs(*shape)]


KINDS = {
    "networks": Kind(
        lambda shape, *tensors: networks(*tensors), lambda shape, *tensors: plain_networks(*tensors), layers,
        slice(1, None),
        ((1, 5, 3, 16, 2), (7, 70, 4, 16, 1), (3, 9, 6, 21, 2), (5, 2, 30, 32, 3), (2, 0, 3, 4, 1),
         (0, 3, 2, 5, 1), (5, 9, 33, 40, 1), (37, 9, 256, 32, 4)),
        {torch.float64: (1e-12, 1e-12), torch.float32: (2e-5, 2e-5)},
    ),
    "similarity": Kind(
        lambda shape, *pair: _Kernel.apply(*pair), lambda shape, *pair: _ssim_by_convolution(*pair), images,
        slice(0, 1),
        ((1, 11, 11), (3, 90, 360), (2, 23, 37), (1, 40, 12), (2, 12, 70), (0, 20, 20)),
        {torch.float32: (1e-5, 1e-4)},
    ),
}  # fmt: skip
KIND_SHAPES = [(kind, shape) for kind, of in KINDS.items() for shape in of.shapes]


def evaluated(
    call: Callable[..., Tensor], kind: Kind, shape: tuple[int, ...], dtype: torch.dtype
) -> list[Tensor]:
    """The output and the gradients of `kind.trained` for a slope that rises from -1 to 2."""
    tensors = kind.cast(shape, dtype)
    leaves = [tensor.requires_grad_() for tensor in tensors[kind.trained]]
    out = call(shape, *tensors)
    slope = torch.linspace(-1, 2, out.numel(), dtype=torch.float64).reshape(out.shape).to(out.dtype)
    return [out.detach(), *torch.autograd.grad(out, leaves, slope)]


def assert_equals_reference(name: str, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """The kernel in `dtype` against its definition in float64, forward and backward."""
    kind = KINDS[name]
    got, want = (
        evaluated(kind.kernel, kind, shape, dtype),
        evaluated(kind.reference, kind, shape, torch.float64),
    )
    forward, backward = kind.tolerance[dtype]
    assert got[0].dtype == dtype and got[0].shape == want[0].shape
    for number, (a, b) in enumerate(zip(got, want, strict=True)):
        largest = float(b.abs().max()) if b.numel() else 0.0
        bound = backward * largest if number else forward * (1 + largest)
        assert ((a.double() - b).abs() <= bound).all(), number


@contextmanager
def instruction_set(name: str) -> Iterator[None]:
    """The CPU kernels of one instruction set; skips the test where this machine or build has none."""
    fastest = _native.instruction_set()
    if not _native.use_instruction_set(name):
        pytest.skip(f"this machine or build has no {name}")
    try:
        yield
    finally:
        _native.use_instruction_set(fastest)


def assert_threads_agree(call: Callable[[], list[Tensor]]) -> list[Tensor]:
    """The same bits by 1, 2 and 5 threads, which are returned."""
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 5):
            torch.set_num_threads(threads)
            results.append(call())
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))
    return results[0]
