"""The CUDA kernels in the place of the CPU's, so that every test of the rasterizer can run on them.

`shim` executes the CUDA sources on this CPU; `gpu` copies each call's tensors to the GPU and back.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from filelock import FileLock

from gsparc.ops import backends, calls, cuda, cuda_library, operators

HERE = Path(__file__).parent
KEPT = HERE.parents[1] / "build" / "shim"
SHIM = HERE / "host_shim.cpp"
INCLUDES = (f"-I{cuda_library.SOURCES}", f"-I{HERE}")
FLAGS = ("-std=c++17", "-O2", "-ffp-contract=off", "-fPIC", "-shared", "-x", "c++")


def fingerprint(*also: str) -> str:
    """Hash of the kernels' sources, the shim and `also`."""
    texts = (SHIM.read_text(), SHIM.with_suffix(".h").read_text())
    return cuda_library.hash_sources(*FLAGS, *texts, *also)


def library() -> cuda_library.Library:
    """The sources of the kernels, executed by fibers; built when they have changed."""
    path = KEPT / f"{fingerprint()}.so"
    KEPT.mkdir(parents=True, exist_ok=True)
    with FileLock(path.with_suffix(".lock")):  # of processes of tests one builds
        if not path.exists():
            cuda_library.compile_to(
                path, ["g++", *FLAGS, *INCLUDES, *cuda_library.cuda_sources(), str(SHIM)]
            )
    return cuda_library.Library(path)


def gpu() -> cuda_library.Library:
    """The library on this machine's GPU, or skip the test with the reason."""
    reason = cuda_library.missing_device()
    if reason:
        pytest.skip(reason)
    cuda.load()
    return calls.libraries["cuda"]


def on_gpu(run: Callable) -> Callable:
    """`launch` for tensors in main memory: what it reads and writes goes
    to the GPU and comes back.
    """

    def there(name, like, *tensors, **options):
        moved = [None if t is None else t.cuda() for t in tensors]
        result = run(name, torch.empty(0, dtype=like.dtype, device="cuda"), *moved, **options)
        torch.cuda.synchronize()
        for tensor, copy in zip(tensors, moved, strict=True):
            if tensor is not None:
                tensor.data.copy_(copy)  # unseen by autograd: most of them are inputs
        return result

    return there


@contextmanager
def serving(where: str) -> Iterator[cuda_library.Library]:
    """CPU tensors go through the CUDA kernels, on the `shim` or on the `gpu`."""
    kernels = library() if where == "shim" else gpu()
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(calls.libraries, "cpu", kernels)
        patch.setitem(operators.KERNELS, "cpu", operators.KERNELS["cuda"])
        patch.setattr(backends, "_load_cpu", lambda: cuda)
        patch.setattr(backends, "_load_cuda", lambda: cuda)
        if where == "gpu":
            patch.setattr(calls, "launch", on_gpu(calls.launch))
        cuda._sincos.cache_clear()
        yield kernels
    cuda._sincos.cache_clear()
