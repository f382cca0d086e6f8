"""Choice of backend, with the reason where one is unavailable."""

from __future__ import annotations

from functools import cache
from types import ModuleType

import torch

from gsparc.ops import reference_backend


class BackendUnavailable(RuntimeError):
    """The requested backend is not available; the message says why."""


def choose_backend(name: str | None, device: torch.device) -> ModuleType:
    """Return the backend called `name`, or the one of `device` (BackendUnavailable, ValueError)."""
    if name is None:
        name = device.type
    backend = backend_named(name)
    # The reference runs wherever torch does.
    if name in ("cpu", "cuda") and device.type != name:
        raise BackendUnavailable(f"backend {name!r} needs tensors on {name}, these are on {device}")
    return backend


def backend_named(name: str) -> ModuleType:
    """Return the backend called `name` (BackendUnavailable, ValueError).

    >>> backend_named("tpu")
    Traceback (most recent call last):
        ...
    ValueError: backend is 'reference', 'cpu' or 'cuda', got 'tpu'
    """
    if name == "reference":
        return reference_backend
    if name == "cpu":
        return _load_cpu()
    if name == "cuda":
        return _load_cuda()
    raise ValueError(f"backend is 'reference', 'cpu' or 'cuda', got {name!r}")


@cache
def _load_cpu() -> ModuleType:
    try:
        from gsparc.ops import native
    except ImportError as error:
        raise BackendUnavailable(
            f"the CPU kernels are not built ({error}); install gsparc with a C++17 compiler at "
            "hand, "
            "or pass backend='reference' for small scenes"
        ) from error
    return native


def _load_cuda() -> ModuleType:
    _load_cpu()  # defines the operators
    from gsparc.ops import cuda, cuda_library

    try:
        cuda.load()
    except cuda_library.LibraryUnavailable as error:
        raise BackendUnavailable(f"backend 'cuda' is not available: {error}") from error
    return cuda
