"""The kernel of the similarity with what defines it in PyTorch,
and how a kernel is run in every way.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor

from gsparc.ops import _native, backends

backends.backend_named("cpu")  # the operators find its kernels
SETS = pytest.mark.parametrize("name", ["baseline", "avx2", "avx512"])


def random(*sizes: tuple[int, ...]) -> list[Tensor]:
    """Normal float64 numbers of each size."""
    draw = torch.Generator().manual_seed(sum(map(sum, sizes)))
    return [torch.randn(size, generator=draw, dtype=torch.float64) for size in sizes]


def images(*shape: int) -> list[Tensor]:
    """Two images."""
    return [part.sigmoid() for part in random(shape, shape)]


SHAPES = ((1, 11, 11), (3, 90, 360), (2, 23, 37), (1, 40, 12), (2, 12, 70), (0, 20, 20))


def evaluated(
    call: Callable[..., Tensor], shape: tuple[int, ...], dtype: torch.dtype = torch.float32
) -> list[Tensor]:
    """The similarity of two images and its gradient by the first,
    for a slope that rises from -1 to 2.
    """
    shown, target = (image.to(dtype) for image in images(*shape))
    out = call(shown.requires_grad_(), target)
    slope = torch.linspace(-1, 2, out.numel(), dtype=torch.float64).reshape(out.shape).to(out.dtype)
    return [out.detach(), *torch.autograd.grad(out, shown, slope)]


@contextmanager
def instruction_set(name: str) -> Iterator[None]:
    """The CPU kernels of one instruction set;
    skips the test where this machine or build has none.
    """
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
    assert all(
        torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True)
    )
    return results[0]
