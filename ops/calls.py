"""Calls of the compiled kernels: addresses of tensors and a few numbers, in one C structure."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence
from contextlib import nullcontext
from functools import cache, lru_cache
from typing import Any, get_type_hints

import torch
from torch import Tensor

from gsparc.ops.settings import KernelSettings

libraries: dict[str, Any] = {}
"""CUDA libraries (cuda_library.Library) by device type; tests put the host shim under "cpu"."""


@cache
def kernels() -> Any:
    """Return the compiled CPU kernels with the constants of csrc/layout.h;
    None where none were built.
    """
    try:
        from gsparc.ops import _native
    except ImportError:
        return None
    return _native


_C_TYPES: dict[type, Any] = {int: ctypes.c_int32, bool: ctypes.c_bool, float: ctypes.c_double}


class _Settings(ctypes.Structure):
    """`KernelSettings<double>` of csrc/layout.h."""

    # In the order of `KernelSettings`, which is that of the structure in C.
    _fields_ = tuple(
        (name, _C_TYPES[kind]) for name, kind in get_type_hints(KernelSettings).items()
    )


class Call(ctypes.Structure):
    """`Call` of csrc/layout.h."""

    _fields_ = (
        *((name, ctypes.c_int32) for name in ("twice", "threads", "device", "built_for", "driver")),
        ("sizes", ctypes.c_int32 * 12),
        ("settings", _Settings),
        ("numbers", ctypes.c_double * 8),
        ("tensors", ctypes.c_uint64 * 32),
        ("scratch", ctypes.c_uint64),
        ("stream", ctypes.c_uint64),
    )


@lru_cache(maxsize=64)
def _to_c_settings(settings: KernelSettings) -> _Settings:
    return _Settings(*settings)


def make_call(
    like: Tensor,
    *tensors: Tensor | None,
    sizes: Sequence[int] = (),
    numbers: Sequence[float] = (),
    settings: KernelSettings | None = None,
) -> Call:
    """Return a call in the precision and on the device of `like`;
    the caller keeps the tensors alive.
    """
    # Tensors on the CPU are on device -1.
    call = Call(like.dtype == torch.float64, torch.get_num_threads(), max(like.get_device(), 0))
    call.sizes[: len(sizes)] = sizes
    if numbers:
        call.numbers[: len(numbers)] = numbers
    # An absent tensor is a null pointer.
    addresses = [0 if t is None else t.data_ptr() for t in tensors]
    # Ctypes takes far longer
    struct.pack_into(f"{len(addresses)}Q", call, Call.tensors.offset, *addresses)
    if settings is not None:
        call.settings = _to_c_settings(settings)
    return call


def launch(name: str, like: Tensor, *tensors: Tensor | None, **numbers: Any) -> int:
    """Return the result of the kernel `name` on the device of `like`. `numbers` as `make_call`.

    Sizes, numbers and tensors are in the order in which the kernel reads them; tensors are
    contiguous. On a GPU the kernel has scratch memory and runs on torch's current stream.
    """
    call = make_call(like, *tensors, **numbers)
    if not like.is_cuda and "cpu" not in libraries:
        return getattr(kernels(), name)(ctypes.addressof(call))
    device, library = like.device, libraries[like.device.type]
    with torch.cuda.device(device) if like.is_cuda else nullcontext():
        # Called without scratch memory a kernel says how many bytes it needs.
        scratch = torch.empty(library.run(name, call), dtype=torch.uint8, device=device)
        call.scratch = scratch.data_ptr()
        call.stream = torch.cuda.current_stream(device).cuda_stream if like.is_cuda else 0
        return library.run(name, call)
