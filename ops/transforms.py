"""What torch does to a tensor that reaches the rasterizer: tangents, vmap, nesting,
half precision.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor
from torch._C import _functorch
from torch.autograd import forward_ad

_Function = TypeVar("_Function", bound=Callable[..., Any])


def full_precision(function: _Function) -> _Function:
    """Keep `function` in the precision of its tensors, as the kernels are,
    under `torch.autocast` too.
    """
    # Autocast would render in half precision: 5 % off, and sound rotations refused.
    exact = torch.autocast("cpu", enabled=False)(torch.autocast("cuda", enabled=False)(function))
    return cast(_Function, exact)


def forward_mode_is_active() -> bool:
    """Tell whether forward mode is under way anywhere: this is asked at every call."""
    return forward_ad._current_level >= 0


def carries_tangent(*values: Any) -> bool:
    """Tell whether a tensor among `values` is differentiated in forward mode,
    as by `torch.func.jvp`.
    """
    if not forward_mode_is_active():
        return False
    tensors = (v for v in values if isinstance(v, Tensor) and v.is_floating_point())
    return any(forward_ad.unpack_dual(tensor).tangent is not None for tensor in tensors)


def has_vmap_axis(*values: Any) -> bool:
    """Tell whether `torch.vmap` has hidden an axis of a tensor among `values`."""
    # Looked for only while a transform is under way: this is asked at every call.
    for value in values if transform_is_active() else ():
        # Transforms wrap each other's tensors: every layer is looked at.
        while isinstance(value, Tensor) and _functorch.is_functorch_wrapped_tensor(value):
            if _functorch.is_batchedtensor(value):
                return True
            value = _functorch.get_unwrapped(value)
    return False


def unwrap(value: Tensor, axis: int) -> tuple[Tensor, int]:
    """Return the numbers behind a tensor, hidden axes included,
    and where its axis `axis` is among them.
    """
    while _functorch.is_functorch_wrapped_tensor(value):
        hidden = _functorch.maybe_get_bdim(value)
        # A hidden axis at or before it moves it back by one.
        axis += 0 <= hidden <= axis
        value = _functorch.get_unwrapped(value)
    return value, axis


def transform_is_active() -> bool:
    """Tell whether a transform of `torch.func` is under way."""
    return torch._C._are_functorch_transforms_active()


def needs_reference(*values: Any) -> bool:
    """Tell whether plain PyTorch must compute what a kernel has no derivative of,
    or no answer to.
    """
    return transform_is_active() or carries_tangent(*values)


def is_differentiated(*values: Tensor | None) -> bool:
    """Tell whether autograd, in either mode, or `torch.func` follows any of these."""
    recorded = torch.is_grad_enabled() and any(
        value is not None and value.requires_grad for value in values
    )
    return recorded or needs_reference(*values)


def no_transforms() -> AbstractContextManager[Any]:
    """Return a context within which transforms of `torch.func` do not see what is computed."""
    return torch._C._DisableFuncTorch() if transform_is_active() else nullcontext()


def detach(value: Tensor | None) -> Any:
    """Return the numbers behind a tensor or None, for choices without a derivative,
    in `no_transforms`.
    """
    return None if value is None else unwrap(value, 0)[0].detach()


def to_numpy(value: Tensor) -> np.ndarray:
    """Return the numbers of a tensor without what follows them,
    for choices that have no derivative.
    """
    with no_transforms():
        return detach(value).cpu().numpy()
