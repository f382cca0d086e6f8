"""The rasterizer's own tests and its hard cases, unchanged, with the CUDA kernels instead of the CPU's."""

from __future__ import annotations

import importlib
import inspect
import sys
import types
from pathlib import Path

import pytest

HERE = Path(__file__).parent
NOT_THESE = ("test_operators", "test_threads")  # registration, and threads of the CPU
NOT_HERE = {
    "test_absent_backends_say_why": "test_library.py has more of them",
    "test_every_instruction_set": "of the CPU",
    "test_one_giant_covers_every_strip": "looks into the CPU's plan",
    "test_too_many_entries_are_refused_before_allocation": "counts entries as the CPU does",
    "test_a_million_huge_ones": "measures main memory",
}


def again(function):
    """A copy of a test that asks for the fixture `where`; the original keeps its own marks."""
    copy = types.FunctionType(
        function.__code__, function.__globals__, function.__name__, function.__defaults__
    )
    copy.pytestmark = [*getattr(function, "pytestmark", []), pytest.mark.usefixtures("where")]
    return copy


for folder in ("ops", "hard_cases"):
    sys.path.insert(0, str(HERE.parent / folder))
    for path in sorted((HERE.parent / folder).glob("test_*.py")):
        if "from rasters import" not in path.read_text() or path.stem in NOT_THESE:
            continue
        module = importlib.import_module(path.stem)
        for name, function in inspect.getmembers(module, inspect.isfunction):
            if name.startswith("test_") and name not in NOT_HERE and "naive" not in name:
                globals()[f"{name}__{path.stem}"] = again(function)
