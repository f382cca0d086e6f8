"""Whether the CPU kernels were compiled."""

from __future__ import annotations

import functools
from typing import Any


@functools.cache
def kernels() -> Any:
    """The compiled kernels, with the constants of csrc/layout.h; None in an install without a compiler."""
    try:
        from gsparc.ops import _native
    except ImportError:
        return None
    return _native
