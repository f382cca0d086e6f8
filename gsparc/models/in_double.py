"""Copies of what answers in float32 that answer in float64."""

from __future__ import annotations

import io
import pickle
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

T = TypeVar("T")
DOUBLE = {torch.float32: torch.float64, torch.complex64: torch.complex128}


def in_double(part: T) -> T:
    """Return a copy of anything that pickles, its tensors constants in float64 or complex128.

    What is of these types already, and arrays of NumPy, are shared and not copied.
    """
    tensors: dict[int, Any] = {}  # alive as long as their numbers are asked for

    class Parts(pickle.Pickler):
        def persistent_id(self, value: Any) -> int | None:
            if not isinstance(value, Tensor | np.ndarray):
                return None
            tensors[id(value)] = value
            return id(value)

    class Doubled(pickle.Unpickler):
        def persistent_load(self, number: int) -> Any:
            value = tensors[number]
            if isinstance(value, Tensor):
                tensors[number] = value = value.detach().to(DOUBLE.get(value.dtype, value.dtype))
            return value

    whole = io.BytesIO()
    Parts(whole, pickle.HIGHEST_PROTOCOL).dump(part)
    whole.seek(0)
    result: T = Doubled(whole).load()
    return result
