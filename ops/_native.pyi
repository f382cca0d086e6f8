"""The compiled kernels; see csrc/bindings.cpp. Tensors are passed as addresses, 0 for an absent
one."""

from typing import Any

def __getattr__(name: str) -> Any: ...
