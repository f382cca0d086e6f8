"""The rasterizer's own tests, unchanged, with the CUDA kernels instead of the CPU's.

The hard cases run on every backend by themselves (tests/hard_cases/conftest.py).
"""

from __future__ import annotations

import importlib
import inspect
import sys
import types
from pathlib import Path

import pytest

HERE = Path(__file__).parent
NOT_THESE = ("test_operators", "test_at_once", "test_compute_kernels")  # of the CPU alone, or in test_cuda.py
NOT_HERE = {
    "test_absent_backends_say_why": "test_library.py has more of them",
    "test_every_instruction_set": "of the CPU",
    "test_kernels_of_another_compiler_were_the_slowest_ones": "of the CPU",
    "test_networks_channels_and_similarity_have_forward_mode": "networks on a GPU take float32 alone",
    "test_thousands_are_ordered_alike_by_any_threads": "of the CPU",
}


def again(function):
    """A copy of a test that asks for the fixture `where`; the original keeps its own marks."""
    copy = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__
    )
    copy.pytestmark = [*getattr(function, "pytestmark", []), pytest.mark.usefixtures("where")]
    return copy


sys.path.insert(0, str(HERE.parent / "ops"))
for path in sorted((HERE.parent / "ops").glob("test_*.py")):
    drawn = any(f"from {helper} import" in path.read_text() for helper in ("rasters", "oracle"))
    if not drawn or path.stem in NOT_THESE:
        continue
    module = importlib.import_module(path.stem)
    for name, function in inspect.getmembers(module, inspect.isfunction):
        if name.startswith("test_") and name not in NOT_HERE and "naive" not in name:
            globals()[f"{name}__{path.stem}"] = again(function)
